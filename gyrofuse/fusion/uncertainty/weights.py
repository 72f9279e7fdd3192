"""How far the weights of a virtual gyro can be off.

Two ways, each where it is right. Where the levels that decide hold many windows side by side, the influence of each
stretch of the recording on the weights is a series whose own variance tells (`gyrofuse.wavelets.long_run_variance`).
Where they do not, the last levels are drawn again from a pilot model, with the weights fitted anew each time
(`gyrofuse.fusion.uncertainty.parametric`), and lower levels add what their series tells. Where both can be had and the
series shows far more than the model allows, the series is believed: the noise is none that the model knows.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gyrofuse._base.linalg import oriented_eigh
from gyrofuse.fusion.uncertainty.parametric import resample_combined
from gyrofuse.wavelets import long_run_variance as series
from gyrofuse.wavelets.equivalent_dof import normal_quantile, t_quantile
from gyrofuse.wavelets.pilot import Pilot, fit_pilot

# Windows side by side from which on the series alone is believed.
_MANY_WINDOWS = 64
# The share of the variance from which levels of fewer decide: nothing below them shall bend their model.
_MOST = 0.9985
# 1.5 for white noise, 1.4 for flicker, 1.25 for a random walk.
_CORRELATION = 1.3
# A half width that draws common to all arrays leave 1.5 % uncertain: 0.3 % of coverage.
_N_RESAMPLES, _MOST_RESAMPLES = 3_999, 9_999
# So many of them beyond the limits; farther out the tail is taken for a normal one.
_BEYOND = 50
# Blocks of the resampled record; a longer one is a stretch of so many, with less noise.
_MOST_BLOCKS = 256
_ITEMS_AT_ONCE = 16
# The series is believed against the model when its variance is so many times larger than what chance allows, for
# the model is rough.
_CLEARLY, _REFUSED = 2.0, 1e-4


@dataclass(frozen=True, eq=False)
class WeightsSpread:
    """Spread of estimated weights.

    Attributes:
        covariance: `(..., sensor, sensor)` of the weights themselves.
        degrees: `(..., sensor)`, degrees of freedom of their variances.
        half_width: `(..., sensor)`, half of the symmetric interval.
    """

    covariance: Tensor
    degrees: Tensor
    half_width: Tensor

    def __getitem__(self, items: Tensor) -> WeightsSpread:
        """Some items of the leading batch dimension."""
        return WeightsSpread(*(getattr(self, field.name)[items] for field in fields(self)))


def certain(weights: Tensor) -> WeightsSpread:
    """Of weights that do not depend on data."""
    zero = torch.zeros_like(weights)
    return WeightsSpread(torch.diag_embed(zero), torch.full_like(weights, torch.inf), zero)


def unknown(weights: Tensor) -> WeightsSpread:
    """Of weights whose spread was not asked for, or has no law here."""
    unsaid = torch.full_like(weights, torch.nan)
    return WeightsSpread(unsaid[..., None].expand(*weights.shape, weights.shape[-1]), unsaid, unsaid)


def normal_spread(covariance: Tensor, confidence_level: float) -> WeightsSpread:
    """Of weights that follow a normal law."""
    degrees = torch.full_like(covariance[..., 0], torch.inf)
    return WeightsSpread(covariance, degrees, t_quantile(degrees, confidence_level) * _sd(covariance))


def spread_of_weights(
    sums: Tensor,
    counts: Tensor,
    scale_weights: Tensor,
    n_samples: int,
    weights_of: Callable[[Tensor], Tensor],
    confidence_level: float,
) -> WeightsSpread:
    """Spread of weights that are a function of `A = sum_j omega_j Gamma_j`.

    Args:
        sums: `(item, bin, level, sensor, sensor)`, of `gyrofuse.wavelets.covariance.binned_products`.
        counts: The same shape.
        scale_weights: `(level,)`.
        n_samples: Length T of the recordings.
        weights_of: Maps `A` `(..., sensor, sensor)` to weights `(..., sensor)`; differentiable.
        confidence_level: Probability that the interval holds the true weight.

    Returns:
        The spread of each item.

    References:
        [Z] Theorem 2 for the influence; the law of the last levels is that of a model, not of a bootstrap.
    """
    parts, disagree = [], 0
    for items in torch.arange(len(sums), device=sums.device).split(_ITEMS_AT_ONCE):
        part, refuted = _spread(sums[items], counts[items], scale_weights, n_samples, weights_of, confidence_level)
        parts.append(part)
        disagree += refuted
    if disagree:
        warnings.warn(
            f"the weights vary more along the recording than a model of smooth noise allows ({disagree} of {len(sums)} "
            "arrays): their intervals are those that the recording itself shows; look for steps, bursts or telegraph "
            "noise, and take intervals at the last levels as indicative",
            stacklevel=3,
        )
    return WeightsSpread(*(torch.cat([getattr(p, field.name) for p in parts]) for field in fields(WeightsSpread)))


def _spread(
    sums: Tensor,
    counts: Tensor,
    omega: Tensor,
    n_samples: int,
    weights_of: Callable[[Tensor], Tensor],
    confidence_level: float,
) -> tuple[WeightsSpread, int]:
    totals = counts.sum(1)  # M: (item, level, sensor, sensor)
    measured = sums.sum(1) / totals
    wccv = torch.where(omega[:, None, None] > 0, measured, 0.0)
    # What each bin adds to A, less what it would add if all were alike: (item, bin, level, sensor, sensor)
    excess = (sums - counts * wccv[:, None]) / totals[:, None] * omega[:, None, None]
    combined = torch.einsum("j,njik->nik", omega, wccv)
    jacobian = _jacobian(weights_of, combined)  # (item, sensor, sensor, sensor)
    spread = _spread_by_level(wccv, totals, omega, jacobian)
    # Windows side by side at the scale that the variance of the weights comes from: (item,)
    windows = _deciding(spread, _windows(totals))

    shown, terms = _series_covariance(excess, counts, jacobian, windows)
    by_series = WeightsSpread(
        shown, terms[:, None].expand_as(shown[..., 0]), t_quantile(terms, confidence_level)[:, None] * _sd(shown)
    )
    few = windows < _MANY_WINDOWS
    if not bool(few.any()):
        return by_series, 0

    by_model = by_series
    share = (spread * (_windows(totals) < _MANY_WINDOWS)).sum(-1) / spread.sum(-1)
    last_levels_decide = share > _MOST
    for needed, levels_below in ((last_levels_decide, 0), (few & ~last_levels_decide, 2)):
        if bool(needed.any()):
            pilot = fit_pilot(measured[needed], n_samples, levels_below)
            part = _resampled(
                wccv[needed],
                totals[needed],
                omega,
                pilot,
                weights_of,
                *_lower(
                    excess[needed],
                    counts[needed],
                    wccv[needed],
                    jacobian[needed],
                    spread[needed],
                    totals[needed],
                    pilot.first_level,
                ),
                confidence_level,
            )
            by_model = _with(by_model, needed, part)
    ratio = (_sd(shown).square() / _sd(by_model.covariance).square()).median(-1).values
    refuted = few & (windows >= series.FEWEST_WINDOWS) & (ratio > _largest_ratio(terms))
    chosen = few & ~refuted
    return _with(by_series, chosen, by_model[chosen]), int(refuted.sum())


def _lower(
    excess: Tensor, counts: Tensor, wccv: Tensor, jacobian: Tensor, spread: Tensor, totals: Tensor, first: int
) -> tuple[Tensor, Tensor]:
    """Covariance of the weights that the levels below `first` cause, by their series, and the cosines it rests on."""
    low = excess[:, :, :first].sum(2, keepdim=True)
    # Half as many cosines: here the levels near the last of them decide, whose memory is long.
    windows = _deciding(spread[:, :first], _windows(totals)[:, :first]) / 2
    lower, terms = _series_covariance(low, counts, jacobian, windows)
    return lower * _across(spread, wccv, first)[:, None, None], terms


def _with(spread: WeightsSpread, which: Tensor, part: WeightsSpread) -> WeightsSpread:
    """`spread` with `part` in place of those items."""
    values = []
    for field in fields(spread):
        merged = getattr(spread, field.name).clone()
        merged[which] = getattr(part, field.name)
        values.append(merged)
    return WeightsSpread(*values)


def _resampled(
    wccv: Tensor,
    totals: Tensor,
    omega: Tensor,
    pilot: Pilot,
    weights_of: Callable[[Tensor], Tensor],
    lower: Tensor,
    terms_below: Tensor,
    confidence_level: float,
) -> WeightsSpread:
    """Spread of the weights over resamples of the last levels, with the `lower` levels' covariance added."""
    generator = torch.Generator().manual_seed(0)  # the same recording gets the same intervals
    first = pilot.first_level
    n_sensors = lower.shape[-1]
    resampled_level = min(confidence_level, 1 - _BEYOND / _MOST_RESAMPLES)
    n_resamples = max(_N_RESAMPLES, math.ceil(_BEYOND / (1 - resampled_level)))
    stretch = min(pilot.n_samples, _MOST_BLOCKS << first)
    resamples, expected = resample_combined(pilot, omega, stretch, n_resamples, generator)
    below = torch.einsum("j,njik->nik", omega[:first], wccv[:, :first])
    center = weights_of(expected + below)
    # Missing samples leave fewer products than the model counts, and a stretch counts fewer than there are.
    whole = stretch - torch.exp2(torch.arange(1, len(omega) + 1, dtype=omega.dtype, device=omega.device)) + 1
    share = torch.einsum("j,ni,njik,nk->nj", omega, center, wccv, center).clamp(min=0)
    missing = (share * (whole / totals.amin((-1, -2)))).sum(-1) / share.sum(-1)
    combined = resamples + below[:, None]
    moved = missing.sqrt()[:, None, None] * (weights_of(combined) - center[:, None])
    # The model is fitted too, and the weights have used up a part of what it was fitted to.
    certainty = pilot.certainty(center, omega)
    moved = moved * (certainty / (certainty - n_sensors + 1).clamp(min=2)).sqrt()[:, None, None]
    normal = torch.randn(n_resamples, n_sensors, generator=generator, dtype=lower.dtype).to(lower.device)
    values, vectors = oriented_eigh(lower)
    noise = normal @ (vectors * values.clamp(min=0).sqrt()[:, None, :]).mT
    # Their covariance is itself an estimate: chi-square of as many cosines (Wilson & Hilferty) makes them Student's t.
    width = 2 / (9 * terms_below[:, None])
    draw = torch.randn(n_resamples, generator=generator, dtype=lower.dtype).to(lower.device)
    noise = noise / (1 - width + width.sqrt() * draw).clamp(min=0.1).pow(1.5)[..., None]
    moved = moved + noise
    covariance = moved.mT @ moved / n_resamples  # (item, sensor, sensor), the bias of few observations included
    # Percentile t: where a recording shows little noise by chance it is off by more of what it shows.
    own = _spread_of_one(weights_of, torch.einsum("j,njik->nik", omega, wccv))
    rank = min(math.ceil(resampled_level * (n_resamples + 1)), n_resamples)
    half_width = own * (moved / _spread_of_one(weights_of, combined)).abs().kthvalue(rank, dim=1).values
    if confidence_level > resampled_level:
        half_width = half_width * (
            normal_quantile((1 + confidence_level) / 2) / normal_quantile((1 + resampled_level) / 2)
        )
    return WeightsSpread(covariance, _observations_left(expected + below, center, covariance), half_width)


def _spread_of_one(weights_of: Callable[[Tensor], Tensor], combined: Tensor) -> Tensor:
    """Standard deviation `(..., sensor)` of each weight if `A` rested on one observation: `2 tr(J A J A)`."""
    half = [row @ combined for row in _jacobian_rows(weights_of, combined)]
    return torch.stack([(2 * (x * x.mT).sum((-2, -1))).sqrt() for x in half], -1)


def _observations_left(combined: Tensor, weights: Tensor, covariance: Tensor) -> Tensor:
    """Observations `B_ii c' A c / V_ii` that each weight rests on, less those that the weights use up."""
    inverse = torch.linalg.inv(combined)
    influence = inverse - weights[..., :, None] * inverse.sum(-2, keepdim=True)  # B
    residual = torch.einsum("ni,nik,nk->n", weights, combined, weights)
    observations = influence.diagonal(dim1=-2, dim2=-1) * residual[:, None] / _sd(covariance).square()
    return (observations - weights.shape[-1] + 1).clamp(min=1)


def _series_covariance(excess: Tensor, counts: Tensor, jacobian: Tensor, windows: Tensor) -> tuple[Tensor, Tensor]:
    """Covariance of the weights from their influence along the recording, and the cosines it rests on."""
    influence = torch.einsum("niab,ntab->nti", jacobian, excess.sum(2))  # (item, bin, sensor)
    present = counts[:, :, 0].amax((-1, -2))  # (item, bin)
    terms = series.number_of_terms(windows)
    return series.mean_covariance(influence * present.sum(1)[:, None, None], present, terms), terms


def _spread_by_level(wccv: Tensor, totals: Tensor, omega: Tensor, jacobian: Tensor) -> Tensor:
    """Roughly the variance of the weights that each level is the cause of, summed over sensors, `(item, level)`.

    `Var(J dGamma) = 2 tr(J Gamma J Gamma) / n` for a Wishart matrix of `n` observations.
    """
    half = torch.einsum("niab,njbc->njiac", jacobian, wccv)
    spread = torch.einsum("njiac,njica->nj", half, half) * omega.square() / _windows(totals)
    # With missing samples a level's matrix may be indefinite.
    return torch.where(omega > 0, spread.clamp(min=0), 0.0)


def _windows(totals: Tensor) -> Tensor:
    """Windows side by side `M / tau` of each level, `(item, level)`."""
    tau = torch.exp2(torch.arange(1, totals.shape[1] + 1, dtype=totals.dtype, device=totals.device))
    return totals.amin((-1, -2)) / tau


def _deciding(spread: Tensor, windows: Tensor) -> Tensor:
    """Windows side by side at the scale that most of the variance comes from, `(item,)`."""
    return (spread.sum(-1) / (spread / windows).sum(-1)).nan_to_num(nan=1.0)


def _across(spread: Tensor, wccv: Tensor, first: int) -> Tensor:
    """How many times larger the lower levels' variance is with their covariance with the levels above, `(item,)`."""
    sd = spread.sqrt()
    level = torch.arange(spread.shape[1], dtype=spread.dtype, device=spread.device)
    # Wavelet variances of two levels correlate by about k sqrt(nu_upper / nu_lower) tau_lower / tau_upper.
    size = wccv.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(wccv.dtype).tiny).log2().mean(-1) / 2 - level
    correlation = (_CORRELATION * torch.exp2(-(size[:, :, None] - size[:, None, :]).abs())).clamp(max=1)
    correlation = torch.where(level[:, None] == level, 1.0, correlation)
    within = torch.einsum("nj,njk,nk->n", sd[:, :first], correlation[:, :first, :first], sd[:, :first])
    across = torch.einsum("nj,njk,nk->n", sd[:, :first], correlation[:, :first, first:], sd[:, first:])
    return torch.where(within > 0, 1 + 2 * across / within, 1.0)


def _jacobian(weights_of: Callable[[Tensor], Tensor], combined: Tensor) -> Tensor:
    """Derivative `(item, sensor, sensor, sensor)` of each weight by the symmetric matrix `A`."""
    return torch.stack(list(_jacobian_rows(weights_of, combined)), 1)


def _jacobian_rows(weights_of: Callable[[Tensor], Tensor], combined: Tensor) -> Iterator[Tensor]:
    """Derivatives of one weight after the other, each of the shape of `combined`."""
    with torch.inference_mode(False), torch.enable_grad():
        leaf = combined.clone().requires_grad_()
        weights = weights_of(leaf).unbind(-1)
    for weight in weights:
        with torch.inference_mode(False), torch.enable_grad():
            row = torch.autograd.grad(weight.sum(), leaf, retain_graph=True)[0]
        yield (row + row.mT) / 2


def _sd(covariance: Tensor) -> Tensor:
    return covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()


def _largest_ratio(terms: Tensor) -> Tensor:
    """Ratio of the series' variance to the model's beyond which the model is refuted."""
    from scipy import stats

    degrees = terms.cpu().numpy()
    return torch.as_tensor(_CLEARLY * stats.chi2.ppf(1 - _REFUSED, degrees) / degrees).to(terms)
