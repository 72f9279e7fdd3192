"""Objectives of fits, as profiles need them: their increase where one unknown is held fixed."""

from __future__ import annotations

import itertools
import math
from typing import Protocol

import torch
from torch import Tensor

from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.inference import Fit
from gyrofuse.fitting.spectral.bands import BandSpectrum, Bins
from gyrofuse.fitting.spectral.search import deviance, maximise
from gyrofuse.fitting.structure import ModelStructure

# Gain, as a share of the objective or in nats, below which a profile needs no further step: 1e-3 of the `z^2` that it
# is compared with.
_ENOUGH = 1e-3


class ProfileObjective(Protocol):
    """Objective of a fit. Unknowns are `p` of the processes first, then `x` of the shaped ones.

    Attributes:
        linear: `p` at the minimum, `(item, process)`.
        shape: `x` there, `(item, shaped)`.
    """

    linear: Tensor
    shape: Tensor

    def knows(self, unknown: int) -> bool:
        """Whether the objective depends on the unknown."""

    def rise(self, items: Tensor, unknown: int, value: Tensor, in_order: Tensor | None = None) -> Tensor:
        """Deviance increase: minimum with the unknown fixed less the minimum with all free, `(item,)`.

        Args:
            items: Items, `(item,)`.
            unknown: Index of the unknown.
            value: Value at which it is fixed, `(item,)`.
            in_order: Items whose AR1s have to stay in the order of the estimates, `(item,)`: another minimum may be
                that of the estimates with two of them exchanged.
        """

    def divergence(self, linear: Tensor, shape: Tensor) -> Tensor:
        """Objective at a point, had the model at the minimum been measured without error, `(item,)`."""


class MomentProfile:
    """`r' V^-1 r` with `V` of the fit with the fixed unknown, as a test of its value needs it.

    The residuals are those of cube roots, which are nearly normal at few degrees of freedom: the variance itself is at
    most `sqrt(eta / 2)` standard deviations below its mean, which rejects nothing where `eta` is two.

    Args:
        fit: Fit of the moments.
        structure: Structure of the model.
    """

    def __init__(self, fit: Fit, structure: ModelStructure) -> None:
        self.linear, self.shape = fit.linear, fit.shape
        # Scaled so that no record is small to rounding.
        self._size = fit.variance.amax(-1)
        self._target, self._tau = fit.variance / self._size[:, None], fit.tau
        self._made_of, self._records = structure, fit.records

    def knows(self, unknown: int) -> bool:
        at = unknown - self._made_of.n_linear
        return at < 0 or self._made_of.nonlinear[at] in self._made_of.free_nonlinear

    def rise(self, items: Tensor, unknown: int, value: Tensor, in_order: Tensor | None = None) -> Tensor:
        structure, tau = self._made_of, self._tau
        target, own_x = self._target[items], self.shape[items]
        at = unknown - structure.n_linear
        fixed, still = ((unknown, value / self._size[items]), None) if at < 0 else (None, at)
        weight = self._records.observations.to(target) / target.square()
        start = own_x[:, None]
        if structure.free_nonlinear:
            held = own_x[:, [i for i, k in enumerate(structure.nonlinear) if k not in structure.free_nonlinear]]
            others = search.starting_points(target, weight, tau, structure, held, 2, fixed)
            start = torch.cat([start, others], 1)
        if still is not None:
            start[..., still] = value[:, None]
        linear, x, least = self._lowest(target, weight.sqrt(), start, 6, fixed, still, in_order)
        for _ in range(2):
            as_normal, root = self._normal(target, linear, x)
            linear, x, least = self._lowest(as_normal, root, x[:, None], 5, fixed, still)
        _, _, free = self._lowest(as_normal, root, torch.stack([x, own_x], 1), 5, None, None)
        if in_order is not None:
            least = torch.where(in_order & ~_in_order(structure, x), torch.inf, least)
        # With V of a fit that is far off the free one may be as bad: compare with the estimate and its own V then.
        own_linear = self.linear[items] / self._size[items, None]
        own, own_root = self._normal(target, own_linear, own_x)
        off = (own_root @ (own - structure.wavelet_variance(tau, own_linear, own_x))[..., None]).square().sum((-2, -1))
        return (least - free).maximum(least - off - len(tau)).clamp(min=0)

    def divergence(self, linear: Tensor, shape: Tensor) -> Tensor:
        structure, tau, size = self._made_of, self._tau, self._size[:, None]
        exact = structure.wavelet_variance(tau, self.linear / size, self.shape)
        as_normal, root = self._normal(exact, linear / size, shape)
        residual = as_normal - structure.wavelet_variance(tau, linear / size, shape)
        return (root @ residual[..., None]).square().sum((-2, -1))

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
        in_order: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Lowest of the minima next to the starts `(item, start, shaped)`, among those in order where there are any."""
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
        if in_order is not None:
            turned = in_order.repeat_interleave(n) & ~_in_order(self._made_of, x)
            objective = torch.where(turned, torch.finfo(objective.dtype).max, objective)
        best = _first_of(objective.view(n_items, n))
        return linear[best], x[best], objective[best]


class SpectralProfile:
    """Minus twice the spectral log likelihood of the noise without sinusoids and drifts, which are not profiled.

    Args:
        linear: `p` at the maximum, `(item, process)`.
        shape: `x` there, `(item, shaped)`.
        energy: Sums of squared ordinates, `(item, bin)`.
        count: Ordinates, `(item, bin)`.
        structure: Structure of the model.
        n_samples: Length T of the records.
    """

    def __init__(
        self, linear: Tensor, shape: Tensor, energy: Tensor, count: Tensor, structure: ModelStructure, n_samples: int
    ) -> None:
        self.linear, self.shape = linear, shape
        self._energy, self._count = energy, count
        self._noise, self._bins = BandSpectrum(structure), Bins(n_samples, linear.device)
        self._unknowns = [*self._noise.which, *(structure.n_linear + at for at in self._noise.at_x)]
        self._least = deviance(energy, count, self._bins, self._noise, *self._at(slice(None)))
        # AR1s of other minima: one that is nearly white, and one with a time constant of a thirtieth of the record.
        self._starts = [0.25, math.atanh(math.exp(-30 / n_samples))]

    def knows(self, unknown: int) -> bool:
        return unknown in self._unknowns

    def rise(self, items: Tensor, unknown: int, value: Tensor, in_order: Tensor | None = None) -> Tensor:
        held = self._unknowns.index(unknown)
        energy, count = self._energy[items], self._count[items]
        p, x = self._at(items)
        # A millionth above zero: without the fixed unknown, no variance at all could be left.
        p = p.maximum(1e-6 * energy.sum(-1, keepdim=True) / count.sum(-1, keepdim=True))
        p_and_x = torch.cat([p, x], -1)
        starts: list[tuple[int, Tensor | float]] = [(held, value)]
        starts += itertools.product(range(p.shape[-1], p_and_x.shape[-1]), self._starts)
        found = []
        for at, start in starts:
            unknowns = p_and_x.clone()
            unknowns[:, at] = start
            unknowns[:, held] = value
            at_p, at_x = unknowns.split([p.shape[-1], x.shape[-1]], -1)
            at_p, at_x, _ = maximise(energy, count, self._bins, self._noise, at_p, at_x, held, _ENOUGH, 15)
            height = deviance(energy, count, self._bins, self._noise, at_p, at_x)
            if in_order is not None:
                turned = (at_x.diff(dim=-1) > 0).any(-1)
                height = torch.where(in_order & turned, torch.inf, height)
            found.append(height)
        return (torch.stack(found).nan_to_num(nan=torch.inf).amin(0) - self._least[items]).clamp(min=0)

    def divergence(self, linear: Tensor, shape: Tensor) -> Tensor:
        exact = self._noise.variances(self._bins, *self._at(slice(None))) * self._count
        own = linear[:, self._noise.which], shape[:, self._noise.at_x]
        return deviance(exact, self._count, self._bins, self._noise, *own)

    def _at(self, items: Tensor | slice) -> tuple[Tensor, Tensor]:
        return self.linear[items][:, self._noise.which], self.shape[items][:, self._noise.at_x]


def _in_order(structure: ModelStructure, shape: Tensor) -> Tensor:
    """Whether processes of each class with a memory go from slow to fast, `(item,)`."""
    in_order = torch.ones(len(shape), dtype=torch.bool, device=shape.device)
    kinds = [type(structure.processes[k]) for k in structure.nonlinear]
    for kind in {kind for kind in kinds if kind.has_memory()}:
        at = [at for at, other in enumerate(kinds) if other is kind]
        in_order &= (shape[:, at].diff(dim=-1) <= 0).all(-1)
    return in_order


def _first_of(objective: Tensor) -> Tensor:
    """Flat index of the least of each row."""
    best = objective.nan_to_num(nan=torch.inf).argmin(-1)
    return best + objective.shape[-1] * torch.arange(len(objective), device=objective.device)


def _as_normal(variance: Tensor, expected: Tensor, covariance: Tensor) -> Tensor:
    """Wavelet variances as if they were normal: the cube root of a chi-square nearly is.

    References:
        E. B. Wilson, M. M. Hilferty, PNAS 17, 1931.
    """
    spread = covariance.diagonal(dim1=-2, dim2=-1)
    small = spread / expected.square() / 9  # 2 / (9 eta)
    off = ((variance / expected).pow(1 / 3) - 1 + small) / small.sqrt()
    return expected + off * spread.sqrt()
