"""Confidence limits by profile: the values of an unknown with which the best fit is not significantly worse.

For variances near zero and other weakly identified unknowns a standard error is of little use: the objective is no
parabola there, and may have several minima. Here an interval holds every value with a deviance increase

    rise(value) = min over the others with the unknown at `value` - min over all <= z^2

with the `z` of two limits also where there is one: the interval of a variance ends at zero where zero itself is not
rejected.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.identifiability import ar1s_differ, weakly_identified
from gyrofuse.fitting.moments.inference import WEAKLY_DETERMINED, Estimates, Fit, Inference
from gyrofuse.fitting.moments.profile_objectives import MomentProfile, ProfileObjective
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.wavelets.intervals import normal_quantile

# Nats by which the logarithm of a variance may fall below its estimate, or the largest one possible: e^-9, a ten
# thousandth, which no record tells from zero.
_TO_ZERO = 9.0

# Deviance increase of items `(n,)` at values `(n,)`.
Rise = Callable[[Tensor, Tensor], Tensor]


def profiled(
    inference: Inference,
    surface: ProfileObjective,
    fit: Fit,
    structure: ModelStructure,
    confidence_level: float,
    which: Tensor | None = None,
) -> Inference:
    """Replace the limits of weakly identified unknowns by those of the profile.

    Where the model does not fit, a steep objective has no meaning: the wider one of both intervals is kept.

    Args:
        inference: Estimates with symmetric intervals, and the J test.
        surface: Objective that was minimised.
        fit: Fit of the moments.
        structure: Structure of the model.
        confidence_level: Probability that an interval holds the true value.
        which: Items that may change, `(item,)`, bool; all by default.

    References:
        Profile likelihood intervals: D. J. Venzon, S. H. Moolgavkar, Applied Statistics 37, 1988.
    """
    estimates, rejected = inference.estimates, inference.clearly_rejected
    needed = weakly_identified(structure, estimates, fit.records.longest, confidence_level)
    needed |= _bent(surface, structure, estimates, fit.tau, confidence_level)
    needed &= estimates.params.isfinite().all(-1, keepdim=True)
    if fit.omega != "optimal" and isinstance(surface, MomentProfile):
        # The fit minimised another objective: an estimate that is not zero is no minimum of this one.
        needed[:, : structure.n_linear] &= fit.linear == 0
        needed[:, structure.n_linear :] = False
    if which is not None:
        needed &= which[:, None]
    z = _quantiles(surface, structure, needed, confidence_level)
    in_order = ar1s_differ(structure, estimates, confidence_level)
    low, high, determined = estimates.low.clone(), estimates.high.clone(), estimates.determined.clone()
    sds = estimates.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    for unknown, place in enumerate(structure.places):
        items = needed[:, unknown].nonzero()[:, 0]
        if not len(items):
            continue
        own, sd = estimates.params[items, place], sds[items, place]
        if not surface.knows(unknown):
            # Amplitudes of sinusoids and slopes of drifts are nearly normal; one at zero keeps its limit.
            measured = (unknown < structure.n_linear) & (own > 0)
            low[items, place] = torch.where(measured, (own - z[items] * sd).clamp(min=0), low[items, place])
            high[items, place] = torch.where(measured, own + z[items] * sd, high[items, place])
            continue
        if unknown < structure.n_linear:
            squared = structure.processes[unknown].squared
            sd = sd / own * (2 if squared else 1)
            first, last = _variance_limits(
                surface,
                items,
                unknown,
                sd,
                _largest_variance(fit, structure, items, unknown),
                z[items],
                in_order[items],
            )
            width = (last / first).log()
            if squared:
                first, last = first.sqrt(), last.sqrt()
        else:
            at = unknown - structure.n_linear
            process = structure.processes[structure.nonlinear[at]]
            sd = sd / process.unconstrained_slope(surface.shape[items, at])
            least, most = (float(end[at]) for end in search.limits(structure, fit.tau, fit.shape))
            first, last = _shape_limits(surface, items, unknown, sd, least, most, z[items], in_order[items])
            width = last - first
            first, last = (process.from_unconstrained(x) for x in (first, last))
        first, last = torch.minimum(first, own), torch.maximum(last, own)
        wide, linear = rejected[items], (estimates.low[items, place], estimates.high[items, place])
        low[items, place] = torch.where(wide, torch.minimum(first, linear[0]), first)
        high[items, place] = torch.where(wide, torch.maximum(last, linear[1]), last)
        determined[items, place] = width < 2 * z[items] * WEAKLY_DETERMINED
    return replace(inference, estimates=replace(estimates, low=low, high=high, determined=determined))


def _bent(
    surface: ProfileObjective,
    structure: ModelStructure,
    estimates: Estimates,
    tau: Tensor,
    confidence_level: float,
    tolerance: float = 0.1,
) -> Tensor:
    """Unknowns whose limit is not where a parabola puts it, `(item, unknown)`.

    Between the estimate and the point where an unknown has its limit, and the others their conditional means, the
    objective rises by `z^2` if it is a parabola. With similar AR1s, or time constants near the length of the record, it
    is none.

    Args:
        surface: Objective that was minimised.
        structure: Structure of the model.
        estimates: Estimates with symmetric intervals.
        tau: Filter lengths, `(level,)`.
        confidence_level: Probability that an interval holds the true value.
        tolerance: Relative difference between `z` and the square root of the rise, about the relative error of the
            limit: an interval of 95 % that is a tenth too short holds 92 %.

    References:
        D. M. Bates, D. G. Watts, Nonlinear Regression Analysis and Its Applications, 1988, chapter 6.
    """
    z = normal_quantile((1 + confidence_level) / 2)
    n_linear, linear, shape = structure.n_linear, surface.linear, surface.shape
    # Of ln p and x, from those of the parameters: sinusoids and drifts stay where they are.
    still = [unknown for unknown in range(len(structure.places)) if not surface.knows(unknown)]
    x_scale = torch.ones_like(shape)
    for at, k in enumerate(structure.nonlinear):
        process = structure.processes[k]
        x_scale[:, at] = 0.0 if process.has_line else process.unconstrained_slope(shape[:, at])
    scale = torch.cat([linear, x_scale], -1)
    tones = [k for k, p in enumerate(structure.processes) if not p.gaussian]
    scale[:, [*still, *tones]] = 0.0
    inverse = torch.where(scale > 0, 1 / scale, 0.0)
    spread = (
        estimates.covariance[:, structure.places][:, :, structure.places] * inverse[:, :, None] * inverse[:, None, :]
    )
    sd = spread.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    least, most = search.limits(structure, tau, shape)
    bent = torch.zeros_like(sd, dtype=torch.bool)
    for unknown in range(sd.shape[-1]):
        step = z * spread[:, unknown] / sd[:, unknown, None]
        for sign in (-1, 1):
            p = linear * (sign * step[:, :n_linear]).clamp(-_TO_ZERO, _TO_ZERO).exp()
            x = (shape + sign * step[:, n_linear:]).clamp(least, most)
            rise = surface.divergence(p, x)
            bent[:, unknown] |= (rise.sqrt() / z - 1).abs() > tolerance
    return bent & (sd > 0)


def _quantiles(surface: ProfileObjective, structure: ModelStructure, needed: Tensor, confidence_level: float) -> Tensor:
    """Quantile `z` of the square root of the deviance increase, `(item,)`.

    An AR1 that may as well be absent leaves its `phi` unidentified: its two unknowns vanish together, and the deviance
    increase has nearly two degrees of freedom.
    """
    one, two = normal_quantile((1 + confidence_level) / 2), math.sqrt(-2 * math.log1p(-confidence_level))
    width = surface.linear.new_full((len(needed),), one)
    items = needed.any(-1).nonzero()[:, 0]
    for k, process in enumerate(structure.processes):
        if process.has_memory() and len(items):
            absent = surface.rise(items, k, torch.zeros_like(width[items]))
            width[items[absent <= two**2]] = two
    return width


def _largest_variance(fit: Fit, structure: ModelStructure, items: Tensor, k: int) -> Tensor:
    """About the largest `p` that the wavelet variances allow, `(item,)`."""
    variance, shape = fit.variance[items], fit.shape[items]
    if structure.processes[k].alternates:
        return 2 * variance[:, 0]  # without memory
    ratio = variance / structure.columns(fit.tau, shape)[..., k].clamp(min=1e-300)
    # The last levels may be small by chance.
    return ratio.sort(-1)[0][:, :3].amax(-1)


def _variance_limits(
    surface: ProfileObjective, items: Tensor, k: int, sd: Tensor, largest: Tensor, z: Tensor, in_order: Tensor
) -> tuple[Tensor, Tensor]:
    """Limits of a variance, on a logarithmic scale; zero or infinite where there is none."""
    own = surface.linear[items, k]
    least = torch.where(own > 0, own, largest).minimum(largest).log() - _TO_ZERO
    values = profile_grid(own.log(), sd, least, (32 * largest).maximum(3 * own).log())
    values[:, 0] = -torch.inf

    def rise(which: Tensor, at: Tensor) -> Tensor:
        return surface.rise(items[which], k, at.exp(), in_order[which])

    low, high = profile_limits(rise, own.log(), values, z)
    return low.exp(), high.exp()


def _shape_limits(
    surface: ProfileObjective,
    items: Tensor,
    unknown: int,
    sd: Tensor,
    least: float,
    most: float,
    z: Tensor,
    in_order: Tensor,
) -> tuple[Tensor, Tensor]:
    """Limits of an `x`, infinite where there is none."""
    x = surface.shape[items, unknown - surface.linear.shape[-1]]
    values = profile_grid(x, sd, torch.full_like(x, least), torch.full_like(x, most))

    def rise(which: Tensor, at: Tensor) -> Tensor:
        return surface.rise(items[which], unknown, at, in_order[which])

    return profile_limits(rise, x, values, z)


def profile_grid(own: Tensor, sd: Tensor, least: Tensor, most: Tensor) -> Tensor:
    """First values of a profile, `(item, value)`, ascending: ten over the whole range, four near the estimate."""
    share = torch.linspace(0, 1, 10, dtype=own.dtype, device=own.device)
    wide = least[:, None] + (most - least)[:, None] * share
    near = own[:, None] + sd[:, None] * own.new_tensor((-3.0, -1.5, 1.5, 3.0))
    near = torch.where(near.isfinite(), near, least[:, None]).clamp(least[:, None], most[:, None])
    return torch.cat([wide, near], -1).sort(-1)[0]


def profile_limits(rise: Rise, own: Tensor, values: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Outermost limits of the values with a deviance increase of at most `z^2`.

    Args:
        rise: Deviance increase of items `(n,)` at values `(n,)`.
        own: Estimate, whose deviance increase is zero, `(item,)`.
        values: First values, `(item, value)`; more follow about the two limits.
        z: Normal quantile, `(item,)`.

    Returns:
        Lower and upper end, `(item,)`, infinite where the grid ends before.
    """
    everyone = torch.arange(len(own), device=own.device)
    values = torch.cat([values, own[:, None]], -1)
    height = torch.where(values == own[:, None], -z[:, None], _heights(rise, everyone, values, z))
    values, order = values.sort(-1)
    height = height.gather(-1, order)
    held, n = height <= 0, values.shape[-1]
    place = torch.arange(n, device=own.device)
    ends = []
    for sign, at in ((-1, torch.where(held, place, n).amin(-1)), (1, torch.where(held, place, -1).amax(-1))):
        crossed = ((at + sign >= 0) & (at + sign < n)).nonzero()[:, 0]
        pair = torch.stack([at, at + sign], -1)[crossed]
        limit = torch.full_like(own, sign * torch.inf)
        limit[crossed] = _closer(
            rise, crossed, values[crossed].gather(-1, pair), height[crossed].gather(-1, pair), z[crossed]
        )
        ends.append(limit)
    return ends[0], ends[1]


def _closer(
    rise: Rise, items: Tensor, ends: Tensor, heights: Tensor, z: Tensor, n_between: int = 4, n_rounds: int = 2
) -> Tensor:
    """Root between a value within the limit and one beyond it, the nearest to the second, `(item,)`.

    Args:
        rise: Deviance increase of items at values.
        items: Items, `(item,)`.
        ends: The two values, `(item, 2)`.
        heights: Square root of the deviance increase there, less `z`, `(item, 2)`.
        z: Normal quantile, `(item,)`.
        n_between: Number of values between the two in each round.
        n_rounds: Number of rounds: two of four values, and linear interpolation, divide the interval by 25.
    """
    inside, outside = ends.unbind(-1)
    inside = torch.where(inside.isinf(), outside - _TO_ZERO, inside)
    outside = torch.where(outside.isinf(), inside - _TO_ZERO, outside)
    share = torch.linspace(0, 1, n_between + 2, dtype=ends.dtype, device=ends.device)
    place = torch.arange(n_between + 2, device=ends.device)
    for _ in range(n_rounds if len(items) else 0):
        values = inside[:, None] + (outside - inside)[:, None] * share
        found = _heights(rise, items, values[:, 1:-1], z)
        found = torch.cat([heights[:, :1], found, heights[:, 1:]], -1)
        last = torch.where(found <= 0, place, 0).amax(-1, keepdim=True)
        pair = torch.cat([last, last + 1], -1)
        (inside, outside), heights = values.gather(-1, pair).unbind(-1), found.gather(-1, pair)
    below, above = heights.unbind(-1)
    return inside + (outside - inside) * (below / (below - above)).clamp(0, 1)


def _heights(rise: Rise, items: Tensor, values: Tensor, z: Tensor) -> Tensor:
    """Square root of the deviance increase at values `(item, value)` less `z`; infinite where it is not known."""
    n_items, n = values.shape
    found = rise(items.repeat_interleave(n), values.flatten()).sqrt().view(n_items, n)
    return (found - z[:, None]).nan_to_num(nan=torch.inf)
