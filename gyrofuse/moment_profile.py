"""Confidence limits by profile: how far an unknown may go until the best fit with it held is too bad for chance.

For variances near zero, and whatever else the data say little about, the distance from the estimate in standard
deviations says little: the objective is no parabola there, and may have several valleys. Here an interval holds every
value for which

    rise(value) = min over the others with the unknown at `value` - min over all <= z^2

with the `z` of two limits also where there is one: a variance's interval ends at zero where zero itself is not ruled
out.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from gyrofuse import _moment_search as search
from gyrofuse._composition import Composition
from gyrofuse._cosine_bins import Bins, Noise
from gyrofuse._profile import crossings, grid
from gyrofuse._spectral_search import deviance, maximise
from gyrofuse.moment_identity import uncertain
from gyrofuse.moment_inference import WEAKLY_DETERMINED, Fit, Inference
from gyrofuse.processes import AR1, Drift, Sinusoid
from gyrofuse.uncertainty import normal_quantile

_STARTS, _FIRST_STEPS, _STEPS, _ENOUGH = 2, 6, 5, 1e-3
_CLIMB = 15
# AR1s from which the likelihood is climbed besides: `x` of one that is nearly white, and time constants in a record.
_NO_MEMORY, _SHARE_OF_RECORD, _OFF_ZERO = 0.25, 30, 1e-6
# Nats below the estimate, or below what there is room for, and times the latter: where variances are looked at.
_BELOW, _MOST_ROOM = 9.0, 32.0


class Surface(Protocol):
    """What a fit minimises. Unknowns are `p` of the processes first, then `x` of the shaped ones.

    Attributes:
        linear: `p` at the minimum, `(item, process)`.
        shape: `x` there, `(item, shaped)`.
    """

    linear: Tensor
    shape: Tensor

    def knows(self, unknown: int) -> bool:
        """Whether the unknown is one of this surface's."""

    def rise(self, items: Tensor, unknown: int, value: Tensor) -> Tensor:
        """How much higher the minimum lies with the unknown at `value` `(item,)`, for the items `(item,)`."""


class MomentSurface:
    """`r' V^-1 r` with `V` of the fit that holds the unknown, as a test of that value needs it.

    The residuals are those of cube roots, which are nearly normal at few degrees of freedom: the variance itself is at
    most `sqrt(eta / 2)` standard deviations below its mean, which rules out nothing where `eta` is two.

    Args:
        fit: Where the search ended.
        made_of: Structure of the model.
    """

    def __init__(self, fit: Fit, made_of: Composition) -> None:
        self.linear, self.shape = fit.linear, fit.shape
        # Scaled so that no record is small to rounding.
        self._size = fit.variance.amax(-1)
        self._target, self._tau = fit.variance / self._size[:, None], fit.tau
        self._made_of, self._records = made_of, fit.records

    def knows(self, unknown: int) -> bool:
        at = unknown - self._made_of.n_linear
        return at < 0 or self._made_of.shaped[at] in self._made_of.curved

    def rise(self, items: Tensor, unknown: int, value: Tensor) -> Tensor:
        made_of, tau = self._made_of, self._tau
        target, own_x = self._target[items], self.shape[items]
        at = unknown - made_of.n_linear
        fixed, still = ((unknown, value / self._size[items]), None) if at < 0 else (None, at)
        weight = self._records.observations.to(target) / target.square()
        start = own_x[:, None]
        if made_of.curved:
            held = own_x[:, [i for i, k in enumerate(made_of.shaped) if k not in made_of.curved]]
            others = search.starting_points(target, weight, tau, made_of, held, _STARTS, fixed)
            start = torch.cat([start, others], 1)
        if still is not None:
            start[..., still] = value[:, None]
        linear, x, least = self._lowest(target, weight.sqrt(), start, _FIRST_STEPS, fixed, still)
        for _ in range(2):
            as_normal, root = self._normal(target, linear, x)
            linear, x, least = self._lowest(as_normal, root, x[:, None], _STEPS, fixed, still)
        _, _, free = self._lowest(as_normal, root, torch.stack([x, own_x], 1), _STEPS, None, None)
        # With V of a fit that is far off the free one may be as bad; then the estimate, with its own V, is the measure.
        own_linear = self.linear[items] / self._size[items, None]
        own, own_root = self._normal(target, own_linear, own_x)
        off = (own_root @ (own - made_of.wavelet_variance(tau, own_linear, own_x))[..., None]).square().sum((-2, -1))
        return (least - free).maximum(least - off - len(tau)).clamp(min=0)

    def _normal(self, target: Tensor, linear: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """The wavelet variances as if they were normal, and `W` of a model."""
        covariance = self._records.covariance(self._made_of.model(linear, x))
        expected = self._made_of.wavelet_variance(self._tau, linear, x)
        return _as_normal(target, expected, covariance), search.whitening(covariance)

    def _lowest(
        self,
        target: Tensor,
        root: Tensor,
        start: Tensor,
        n_steps: int,
        fixed: tuple[int, Tensor] | None,
        still: int | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The lowest of the minima next to the starts `(item, start, shaped)`."""
        n_items, n = start.shape[:2]
        linear, x, objective, _ = search.minimise(
            target.repeat_interleave(n, 0),
            root.repeat_interleave(n, 0),
            self._tau,
            self._made_of,
            start.flatten(0, 1),
            n_steps,
            fixed=(fixed[0], fixed[1].repeat_interleave(n)) if fixed else None,
            still=still,
            enough=_ENOUGH,
        )
        best = _first_of(objective.view(n_items, n))
        return linear[best], x[best], objective[best]


class SpectralSurface:
    """Minus twice the spectral log likelihood of what tones and ramps leave; their own unknowns are not profiled.

    Args:
        linear: `p` at the maximum, `(item, process)`.
        shape: `x` there, `(item, shaped)`.
        energy: Sums of squared ordinates, `(item, bin)`.
        count: Ordinates, `(item, bin)`.
        made_of: Structure of the model.
        n_samples: Length T of the records.
    """

    def __init__(
        self, linear: Tensor, shape: Tensor, energy: Tensor, count: Tensor, made_of: Composition, n_samples: int
    ) -> None:
        self.linear, self.shape = linear, shape
        self._energy, self._count = energy, count
        self._noise, self._bins = Noise(made_of), Bins(n_samples, linear.device)
        self._unknowns = [*self._noise.which, *(made_of.n_linear + at for at in self._noise.at_x)]
        self._least = deviance(energy, count, self._bins, self._noise, *self._at(slice(None)))
        self._starts = [_NO_MEMORY, math.atanh(math.exp(-_SHARE_OF_RECORD / n_samples))]

    def knows(self, unknown: int) -> bool:
        return unknown in self._unknowns

    def rise(self, items: Tensor, unknown: int, value: Tensor) -> Tensor:
        held = self._unknowns.index(unknown)
        energy, count = self._energy[items], self._count[items]
        p, x = self._at(items)
        # Somewhat off zero, as nothing could be left once the unknown is taken away.
        p = p.maximum(_OFF_ZERO * energy.sum(-1, keepdim=True) / count.sum(-1, keepdim=True))
        p_and_x = torch.cat([p, x], -1)
        starts: list[tuple[int, Tensor | float]] = [(held, value)]
        starts += itertools.product(range(p.shape[-1], p_and_x.shape[-1]), self._starts)
        found = []
        for at, start in starts:
            unknowns = p_and_x.clone()
            unknowns[:, at] = start
            unknowns[:, held] = value
            at_p, at_x = unknowns.split([p.shape[-1], x.shape[-1]], -1)
            at_p, at_x, _ = maximise(energy, count, self._bins, self._noise, at_p, at_x, held, _ENOUGH, _CLIMB)
            found.append(deviance(energy, count, self._bins, self._noise, at_p, at_x))
        return (torch.stack(found).nan_to_num(nan=torch.inf).amin(0) - self._least[items]).clamp(min=0)

    def _at(self, items: Tensor | slice) -> tuple[Tensor, Tensor]:
        return self.linear[items][:, self._noise.which], self.shape[items][:, self._noise.at_x]


def _first_of(objective: Tensor) -> Tensor:
    """Flat index of the least of each row."""
    best = objective.nan_to_num(nan=torch.inf).argmin(-1)
    return best + objective.shape[-1] * torch.arange(len(objective), device=objective.device)


def _as_normal(variance: Tensor, expected: Tensor, covariance: Tensor) -> Tensor:
    """As many standard deviations off as a normal variable was: the cube root of a chi-square is nearly normal.

    References:
        E. B. Wilson, M. M. Hilferty, PNAS 17, 1931.
    """
    spread = covariance.diagonal(dim1=-2, dim2=-1)
    small = spread / expected.square() / 9  # 2 / (9 eta)
    off = ((variance / expected).pow(1 / 3) - 1 + small) / small.sqrt()
    return expected + off * spread.sqrt()


def profiled(
    inference: Inference,
    surface: Surface,
    fit: Fit,
    made_of: Composition,
    confidence_level: float,
    which: Tensor | None = None,
) -> Inference:
    """Replace the limits of what is uncertain, see `moment_identity.uncertain`, by those of the profile.

    Where the model does not fit, what is minimised may rise steeply without any meaning: the wider one of both
    intervals is kept.

    Args:
        inference: Estimates, and whether the model fits.
        surface: What was minimised.
        fit: Of the moments.
        made_of: Structure of the model.
        confidence_level: Probability that an interval holds the true value.
        which: Items, `(item,)`; all by default.
    """
    estimates, refused = inference.estimates, inference.refused
    needed = uncertain(made_of, estimates, fit.records.longest, confidence_level)
    needed &= estimates.params.isfinite().all(-1, keepdim=True)
    if fit.omega != "optimal" and isinstance(surface, MomentSurface):
        # What is minimised here is not what was minimised there: an estimate off its edge lies elsewhere.
        needed[:, : made_of.n_linear] &= fit.linear == 0
        needed[:, made_of.n_linear :] = False
    if which is not None:
        needed &= which[:, None]
    z = _widths(surface, made_of, needed, confidence_level)
    low, high, determined = estimates.low.clone(), estimates.high.clone(), estimates.determined.clone()
    sds = estimates.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    for unknown, place in enumerate(made_of.places):
        items = needed[:, unknown].nonzero()[:, 0]
        if not len(items):
            continue
        own, sd = estimates.params[items, place], sds[items, place]
        if not surface.knows(unknown):
            # Amplitudes of tones and slopes of ramps are measured, nearly normal; what is at zero keeps its limit.
            measured = (unknown < made_of.n_linear) & (own > 0)
            low[items, place] = torch.where(measured, (own - z[items] * sd).clamp(min=0), low[items, place])
            high[items, place] = torch.where(measured, own + z[items] * sd, high[items, place])
            continue
        if unknown < made_of.n_linear:
            squared = isinstance(made_of.processes[unknown], (Sinusoid, Drift))
            sd = sd / own * (2 if squared else 1)
            first, last = _variance_limits(surface, items, unknown, sd, _room(fit, made_of, items, unknown), z[items])
            width = (last / first).log()
            if squared:
                first, last = first.sqrt(), last.sqrt()
        else:
            at = unknown - made_of.n_linear
            moving = isinstance(made_of.processes[made_of.shaped[at]], AR1)
            sd = sd / (1 - own.square() if moving else own * (1 - own / torch.pi))
            least, most = (float(end[at]) for end in search.limits(made_of, fit.tau, fit.shape))
            first, last = _shape_limits(surface, items, unknown, sd, least, most, z[items])
            width = last - first
            first, last = (v.tanh() if moving else torch.pi * v.sigmoid() for v in (first, last))
        first, last = torch.minimum(first, own), torch.maximum(last, own)
        wide, linear = refused[items], (estimates.low[items, place], estimates.high[items, place])
        low[items, place] = torch.where(wide, torch.minimum(first, linear[0]), first)
        high[items, place] = torch.where(wide, torch.maximum(last, linear[1]), last)
        determined[items, place] = width < 2 * z[items] * WEAKLY_DETERMINED
    return replace(inference, estimates=replace(estimates, low=low, high=high, determined=determined))


def _widths(surface: Surface, made_of: Composition, needed: Tensor, confidence_level: float) -> Tensor:
    """Square root of the rise that chance makes, `(item,)`.

    An AR1 that may as well be absent leaves its memory free to be what suits the record best: its two unknowns come and
    go together, and the rise is more nearly that of two.
    """
    one, two = normal_quantile((1 + confidence_level) / 2), math.sqrt(-2 * math.log1p(-confidence_level))
    width = surface.linear.new_full((len(needed),), one)
    items = needed.any(-1).nonzero()[:, 0]
    for k, process in enumerate(made_of.processes):
        if isinstance(process, AR1) and len(items):
            absent = surface.rise(items, k, torch.zeros_like(width[items]))
            width[items[absent <= two**2]] = two
    return width


def _room(fit: Fit, made_of: Composition, items: Tensor, k: int) -> Tensor:
    """About the largest `p` that the wavelet variances leave room for, `(item,)`."""
    variance, shape = fit.variance[items], fit.shape[items]
    if isinstance(made_of.processes[k], AR1):
        return 2 * variance[:, 0]  # without memory
    ratio = variance / made_of.columns(fit.tau, shape)[..., k].clamp(min=1e-300)
    # The last levels may be small by chance.
    return ratio.sort(-1)[0][:, :3].amax(-1)


def _variance_limits(
    surface: Surface, items: Tensor, k: int, sd: Tensor, room: Tensor, z: Tensor
) -> tuple[Tensor, Tensor]:
    """Of a variance, zero or infinite where there is none; looked for on a logarithmic scale."""
    own = surface.linear[items, k]
    least = torch.where(own > 0, own, room).minimum(room).log() - _BELOW
    values = grid(own.log(), sd, least, (_MOST_ROOM * room).maximum(3 * own).log())
    values[:, 0] = -torch.inf

    def rise(which: Tensor, at: Tensor) -> Tensor:
        return surface.rise(items[which], k, at.exp())

    low, high = crossings(rise, own.log(), values, z)
    return low.exp(), high.exp()


def _shape_limits(
    surface: Surface, items: Tensor, unknown: int, sd: Tensor, least: float, most: float, z: Tensor
) -> tuple[Tensor, Tensor]:
    """Of `x`, infinite where there is none."""
    x = surface.shape[items, unknown - surface.linear.shape[-1]]
    values = grid(x, sd, torch.full_like(x, least), torch.full_like(x, most))

    def rise(which: Tensor, at: Tensor) -> Tensor:
        return surface.rise(items[which], unknown, at)

    return crossings(rise, x, values, z)
