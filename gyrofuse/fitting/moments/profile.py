"""Confidence limits by profile: how far an unknown may go until the best fit with it held is too bad for chance.

For variances near zero, and whatever else the data say little about, the distance from the estimate in standard
deviations says little: the objective is no parabola there, and may have several valleys. Here an interval holds every
value for which

    rise(value) = min over the others with the unknown at `value` - min over all <= z^2

with the `z` of two limits also where there is one: a variance's interval ends at zero where zero itself is not ruled
out.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.identifiability import told_apart, uncertain
from gyrofuse.fitting.moments.inference import WEAKLY_DETERMINED, Estimates, Fit, Inference
from gyrofuse.fitting.moments.profile_limits import crossings, grid
from gyrofuse.fitting.moments.profile_surfaces import MomentSurface, Surface
from gyrofuse.fitting.structure import Composition
from gyrofuse.wavelets.equivalent_dof import normal_quantile

# Share of `z` by which the square root of the rise at a limit may differ from it: as much as the limit would be off. An
# interval of 95 % a tenth too short holds 92 %.
_BENT = 0.1
# Nats below the estimate, or below what there is room for, and times the latter: where variances are looked at.
_BELOW, _MOST_ROOM = 9.0, 32.0


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
    needed |= _bent(surface, made_of, estimates, fit.tau, confidence_level)
    needed &= estimates.params.isfinite().all(-1, keepdim=True)
    if fit.omega != "optimal" and isinstance(surface, MomentSurface):
        # What is minimised here is not what was minimised there: an estimate off its edge lies elsewhere.
        needed[:, : made_of.n_linear] &= fit.linear == 0
        needed[:, made_of.n_linear :] = False
    if which is not None:
        needed &= which[:, None]
    z = _widths(surface, made_of, needed, confidence_level)
    in_order = told_apart(made_of, estimates, confidence_level)
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
            squared = made_of.processes[unknown].squared
            sd = sd / own * (2 if squared else 1)
            first, last = _variance_limits(
                surface, items, unknown, sd, _room(fit, made_of, items, unknown), z[items], in_order[items]
            )
            width = (last / first).log()
            if squared:
                first, last = first.sqrt(), last.sqrt()
        else:
            at = unknown - made_of.n_linear
            process = made_of.processes[made_of.shaped[at]]
            sd = sd / process.unconstrained_slope(fit.shape[items, at])
            least, most = (float(end[at]) for end in search.limits(made_of, fit.tau, fit.shape))
            first, last = _shape_limits(surface, items, unknown, sd, least, most, z[items], in_order[items])
            width = last - first
            first, last = (process.from_unconstrained(x) for x in (first, last))
        first, last = torch.minimum(first, own), torch.maximum(last, own)
        wide, linear = refused[items], (estimates.low[items, place], estimates.high[items, place])
        low[items, place] = torch.where(wide, torch.minimum(first, linear[0]), first)
        high[items, place] = torch.where(wide, torch.maximum(last, linear[1]), last)
        determined[items, place] = width < 2 * z[items] * WEAKLY_DETERMINED
    return replace(inference, estimates=replace(estimates, low=low, high=high, determined=determined))


def _bent(surface: Surface, made_of: Composition, estimates: Estimates, tau: Tensor, confidence_level: float) -> Tensor:
    """Unknowns of which a limit is not as far from the estimate as a straight line has it, `(item, unknown)`.

    From the estimate to where an unknown has its limit and the others what they are then expected to be, the objective
    rises by `z^2` where it is a parabola. Where AR1s are alike, or hardly shorter than the record, it is none.

    References:
        D. M. Bates, D. G. Watts, Nonlinear Regression Analysis and Its Applications, 1988, chapter 6.
    """
    z = normal_quantile((1 + confidence_level) / 2)
    n_linear, linear, shape = made_of.n_linear, surface.linear, surface.shape
    # Of ln p and x, from the parameters' own: tones and ramps stay where they are.
    still = [unknown for unknown in range(len(made_of.places)) if not surface.knows(unknown)]
    x_scale = torch.ones_like(shape)
    for at, k in enumerate(made_of.shaped):
        process = made_of.processes[k]
        x_scale[:, at] = 0.0 if process.has_line else process.unconstrained_slope(shape[:, at])
    scale = torch.cat([linear, x_scale], -1)
    tones = [k for k, p in enumerate(made_of.processes) if not p.gaussian]
    scale[:, [*still, *tones]] = 0.0
    inverse = torch.where(scale > 0, 1 / scale, 0.0)
    spread = estimates.covariance[:, made_of.places][:, :, made_of.places] * inverse[:, :, None] * inverse[:, None, :]
    sd = spread.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    least, most = search.limits(made_of, tau, shape)
    bent = torch.zeros_like(sd, dtype=torch.bool)
    for unknown in range(sd.shape[-1]):
        step = z * spread[:, unknown] / sd[:, unknown, None]
        for sign in (-1, 1):
            p = linear * (sign * step[:, :n_linear]).clamp(-_BELOW, _BELOW).exp()
            x = (shape + sign * step[:, n_linear:]).clamp(least, most)
            rise = surface.divergence(p, x)
            bent[:, unknown] |= (rise.sqrt() / z - 1).abs() > _BENT
    return bent & (sd > 0)


def _widths(surface: Surface, made_of: Composition, needed: Tensor, confidence_level: float) -> Tensor:
    """Square root of the rise that chance makes, `(item,)`.

    An AR1 that may as well be absent leaves its memory free to be what suits the record best: its two unknowns come and
    go together, and the rise is more nearly that of two.
    """
    one, two = normal_quantile((1 + confidence_level) / 2), math.sqrt(-2 * math.log1p(-confidence_level))
    width = surface.linear.new_full((len(needed),), one)
    items = needed.any(-1).nonzero()[:, 0]
    for k, process in enumerate(made_of.processes):
        if process.has_memory() and len(items):
            absent = surface.rise(items, k, torch.zeros_like(width[items]))
            width[items[absent <= two**2]] = two
    return width


def _room(fit: Fit, made_of: Composition, items: Tensor, k: int) -> Tensor:
    """About the largest `p` that the wavelet variances leave room for, `(item,)`."""
    variance, shape = fit.variance[items], fit.shape[items]
    if made_of.processes[k].alternates:
        return 2 * variance[:, 0]  # without memory
    ratio = variance / made_of.columns(fit.tau, shape)[..., k].clamp(min=1e-300)
    # The last levels may be small by chance.
    return ratio.sort(-1)[0][:, :3].amax(-1)


def _variance_limits(
    surface: Surface, items: Tensor, k: int, sd: Tensor, room: Tensor, z: Tensor, in_order: Tensor
) -> tuple[Tensor, Tensor]:
    """Of a variance, zero or infinite where there is none; looked for on a logarithmic scale."""
    own = surface.linear[items, k]
    least = torch.where(own > 0, own, room).minimum(room).log() - _BELOW
    values = grid(own.log(), sd, least, (_MOST_ROOM * room).maximum(3 * own).log())
    values[:, 0] = -torch.inf

    def rise(which: Tensor, at: Tensor) -> Tensor:
        return surface.rise(items[which], k, at.exp(), in_order[which])

    low, high = crossings(rise, own.log(), values, z)
    return low.exp(), high.exp()


def _shape_limits(
    surface: Surface, items: Tensor, unknown: int, sd: Tensor, least: float, most: float, z: Tensor, in_order: Tensor
) -> tuple[Tensor, Tensor]:
    """Of `x`, infinite where there is none."""
    x = surface.shape[items, unknown - surface.linear.shape[-1]]
    values = grid(x, sd, torch.full_like(x, least), torch.full_like(x, most))

    def rise(which: Tensor, at: Tensor) -> Tensor:
        return surface.rise(items[which], unknown, at, in_order[which])

    return crossings(rise, x, values, z)
