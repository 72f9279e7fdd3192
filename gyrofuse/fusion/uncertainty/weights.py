"""Sampling distribution of the weights of a virtual gyro.

Where the levels that dominate the variance of the weights hold many non-overlapping windows, the influence of each bin
of time on the weights is a series, whose long-run variance gives the covariance of the weights
(`gyrofuse.wavelets.long_run_variance`). Elsewhere the last levels are drawn from a pilot model and the weights fitted
to each draw (`gyrofuse.fusion.uncertainty.parametric`), and the covariance that lower levels cause is added from their
series. Where both are available and the series varies far more than the model allows, the series is used: the noise is
not of the kind that the model describes.
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
from gyrofuse.fusion.weights.svo import influence_matrix
from gyrofuse.wavelets import long_run_variance as series
from gyrofuse.wavelets.intervals import normal_quantile, t_quantile
from gyrofuse.wavelets.moments import Moments, combined_covariance, filter_lengths
from gyrofuse.wavelets.pilot import Pilot, fit_pilot

# Number of resamples at least: the margin of error, a quantile of draws that are common to all arrays, is then known to
# 1.5 %, which moves the coverage by 0.3 %.
_N_RESAMPLES = 3_999
# Number of resamples at most, for confidence levels near 1.
_MOST_RESAMPLES = 9_999
# Number of resamples beyond the limits at least; farther out the tail is taken to be normal.
_BEYOND = 50


@dataclass(frozen=True, eq=False)
class WeightsUncertainty:
    """Uncertainty of estimated weights.

    Attributes:
        covariance: `(..., sensor, sensor)`, covariance of the weights themselves.
        dof: `(..., sensor)`, degrees of freedom of their variances.
        margin: `(..., sensor)`, margin of error: half of the symmetric interval.
    """

    covariance: Tensor
    dof: Tensor
    margin: Tensor

    def __getitem__(self, items: Tensor) -> WeightsUncertainty:
        """Some items of the leading batch dimension."""
        return WeightsUncertainty(*(getattr(self, field.name)[items] for field in fields(self)))


def zero_uncertainty(weights: Tensor) -> WeightsUncertainty:
    """Uncertainty of weights that do not depend on data.

    Args:
        weights: `(..., sensor)`.
    """
    zero = torch.zeros_like(weights)
    return WeightsUncertainty(torch.diag_embed(zero), torch.full_like(weights, torch.inf), zero)


def undefined_uncertainty(weights: Tensor) -> WeightsUncertainty:
    """NaN: uncertainty of weights whose covariance was not asked for, or is unknown.

    Args:
        weights: `(..., sensor)`.
    """
    missing = torch.full_like(weights, torch.nan)
    return WeightsUncertainty(missing[..., None].expand(*weights.shape, weights.shape[-1]), missing, missing)


def normal_uncertainty(covariance: Tensor, confidence_level: float) -> WeightsUncertainty:
    """Uncertainty of weights that follow a normal law.

    Args:
        covariance: Covariance of the weights, `(..., sensor, sensor)`.
        confidence_level: Probability that the interval holds the true weight.
    """
    dof = torch.full_like(covariance[..., 0], torch.inf)
    return WeightsUncertainty(covariance, dof, t_quantile(dof, confidence_level) * _std(covariance))


def weights_uncertainty(
    moments: Moments, scale_weights: Tensor, weights_of: Callable[[Tensor], Tensor], confidence_level: float
) -> WeightsUncertainty:
    """Uncertainty of weights that are a function of `A = sum_j omega_j Gamma_j`.

    Args:
        moments: Moments of the recordings, batch `(item,)`.
        scale_weights: `omega`, `(level,)`.
        weights_of: Maps `A` `(..., sensor, sensor)` to weights `(..., sensor)`; differentiable.
        confidence_level: Probability that the interval holds the true weight.

    Returns:
        The uncertainty, batch `(item,)`.

    References:
        [Z] Theorem 2 for the influence; the law of the last levels is that of a model, not of a bootstrap.
    """
    parts, n_refuted = [], 0
    n_items = len(moments.sums)
    for items in torch.arange(n_items, device=moments.sums.device).split(16):  # the draws of 16 arrays fit into memory
        part, refuted = _uncertainty(moments[items], scale_weights, weights_of, confidence_level)
        parts.append(part)
        n_refuted += refuted
    if n_refuted:
        warnings.warn(
            f"the weights vary more along the recording than a model of smooth noise allows ({n_refuted} of {n_items} "
            "arrays): their intervals are those that the recording itself shows; look for steps, bursts or telegraph "
            "noise, and take intervals at the last levels as indicative",
            stacklevel=3,
        )
    columns = (torch.cat([getattr(part, field.name) for part in parts]) for field in fields(WeightsUncertainty))
    return WeightsUncertainty(*columns)


@dataclass(frozen=True, eq=False)
class _Influence:
    """How the weights depend on each level and bin of a recording, batch `(item,)`.

    Attributes:
        moments: Moments of the recording.
        wccv: Wavelet cross-covariance `(item, level, sensor, sensor)`, 0 at levels without scale weight.
        excess: `(item, bin, level, sensor, sensor)`, share of a bin in `A`, less the share that it would have if all
            bins were alike.
        jacobian: Derivative of each weight by `A`, `(item, sensor, sensor, sensor)`.
        by_level: Approximate variance of the weights that each level causes, summed over sensors, `(item, level)`.
    """

    moments: Moments
    wccv: Tensor
    excess: Tensor
    jacobian: Tensor
    by_level: Tensor

    def __getitem__(self, items: Tensor) -> _Influence:
        return _Influence(*(getattr(self, field.name)[items] for field in fields(self)))

    def covariance(self, n_levels: int, windows: Tensor) -> tuple[Tensor, Tensor]:
        """Covariance of the weights that the first levels cause, by their series, and its number of cosines."""
        influence = torch.einsum("niab,ntab->nti", self.jacobian, self.excess[:, :, :n_levels].sum(2))
        present = self.moments.counts[:, :, 0].amax((-1, -2))  # (item, bin)
        cosines = series.n_basis(windows)
        return series.mean_covariance(influence * present.sum(1)[:, None, None], present, cosines), cosines


def _uncertainty(
    moments: Moments, omega: Tensor, weights_of: Callable[[Tensor], Tensor], confidence_level: float
) -> tuple[WeightsUncertainty, int]:
    totals, windows = moments.totals, moments.observations
    wccv = torch.where(omega[:, None, None] > 0, moments.wccv, 0.0)
    excess = (moments.sums - moments.counts * wccv[:, None]) / totals[:, None] * omega[:, None, None]
    jacobian = torch.stack(list(_jacobian_rows(weights_of, moments.combined(omega))), 1)
    by_level = _variance_by_level(wccv, windows, omega, jacobian)
    influence = _Influence(moments, wccv, excess, jacobian, by_level)
    dominant = _dominant(by_level, windows)  # windows at the levels that dominate: (item,)

    own, cosines = influence.covariance(moments.n_levels, dominant)
    margin = t_quantile(cosines, confidence_level)[:, None] * _std(own)
    by_series = WeightsUncertainty(own, cosines[:, None].expand_as(margin), margin)
    few = dominant < series.MANY_WINDOWS
    if not bool(few.any()):
        return by_series, 0

    by_model = by_series
    share = (by_level * (windows < series.MANY_WINDOWS)).sum(-1) / by_level.sum(-1)
    # Where levels of few windows cause practically all of the variance, the model is fitted to them alone: levels below
    # could only bias it. 0.15 % of the variance are less than the error of the quantile of the resamples.
    only_last = share > 0.9985
    for needed, levels_below in ((only_last, 0), (few & ~only_last, 2)):
        if bool(needed.any()):
            pilot = fit_pilot(moments.wccv[needed], moments.n_samples, levels_below)
            part = _resampled(influence[needed], omega, pilot, weights_of, confidence_level)
            by_model = _with(by_model, needed, part)
    ratio = (_std(own).square() / _std(by_model.covariance).square()).median(-1).values
    refuted = few & (dominant >= series.FEWEST_WINDOWS) & (ratio > _largest_ratio(cosines))
    chosen = few & ~refuted
    return _with(by_series, chosen, by_model[chosen]), int(refuted.sum())


def _with(whole: WeightsUncertainty, which: Tensor, part: WeightsUncertainty) -> WeightsUncertainty:
    """`whole` with `part` in place of some items."""
    values = []
    for field in fields(whole):
        merged = getattr(whole, field.name).clone()
        merged[which] = getattr(part, field.name)
        values.append(merged)
    return WeightsUncertainty(*values)


def _resampled(
    influence: _Influence,
    omega: Tensor,
    pilot: Pilot,
    weights_of: Callable[[Tensor], Tensor],
    confidence_level: float,
) -> WeightsUncertainty:
    """Uncertainty over resamples of the last levels, with the covariance that lower levels cause added."""
    generator = torch.Generator().manual_seed(0)  # the same recording gets the same intervals
    first, wccv, by_level = pilot.first_level, influence.wccv, influence.by_level
    # Half as many cosines below: the levels near the last of them dominate, whose memory is long.
    windows = _dominant(by_level[:, :first], influence.moments.observations[:, :first]) / 2
    lower, cosines = influence.covariance(first, windows)
    lower = lower * _across(by_level, wccv, first)[:, None, None]
    n_sensors = lower.shape[-1]
    resampled_level = min(confidence_level, 1 - _BEYOND / _MOST_RESAMPLES)
    n_resamples = max(_N_RESAMPLES, math.ceil(_BEYOND / (1 - resampled_level)))
    # No more than 256 blocks of the first level are drawn: of a longer recording a part, whose noise is scaled down.
    stretch = min(pilot.n_samples, 256 << first)
    resamples, expected = resample_combined(pilot, omega, stretch, n_resamples, generator)
    below = combined_covariance(wccv[:, :first], omega[:first])
    center = weights_of(expected + below)
    # Numbers of products in the resampled stretch over those in the recording, which may lack samples.
    whole = stretch - filter_lengths(len(omega)).to(omega) + 1
    share = torch.einsum("j,ni,njik,nk->nj", omega, center, wccv, center).clamp(min=0)
    missing = (share * (whole / influence.moments.fewest)).sum(-1) / share.sum(-1)
    combined = resamples + below[:, None]
    moved = missing.sqrt()[:, None, None] * (weights_of(combined) - center[:, None])
    # The model is fitted to the same data as the weights, which have used up p - 1 of its degrees of freedom.
    fit = pilot.dof_of_fit(center, omega)
    moved = moved * (fit / (fit - n_sensors + 1).clamp(min=2)).sqrt()[:, None, None]
    normal = torch.randn(n_resamples, n_sensors, generator=generator, dtype=lower.dtype).to(lower.device)
    values, vectors = oriented_eigh(lower)
    noise = normal @ (vectors * values.clamp(min=0).sqrt()[:, None, :]).mT
    # Divided by the root of a chi-square variable over its degrees of freedom (Wilson & Hilferty), for Student's t: the
    # covariance of the lower levels is itself an estimate.
    width = 2 / (9 * cosines[:, None])
    draw = torch.randn(n_resamples, generator=generator, dtype=lower.dtype).to(lower.device)
    noise = noise / (1 - width + width.sqrt() * draw).clamp(min=0.1).pow(1.5)[..., None]
    moved = moved + noise
    covariance = moved.mT @ moved / n_resamples  # (item, sensor, sensor), the bias of few observations included
    # Percentile t: deviations in units of the standard error that the resample itself shows.
    own = _std_of_one(weights_of, combined_covariance(wccv, omega))
    rank = min(math.ceil(resampled_level * (n_resamples + 1)), n_resamples)
    margin = own * (moved / _std_of_one(weights_of, combined)).abs().kthvalue(rank, dim=1).values
    if confidence_level > resampled_level:
        margin = margin * (normal_quantile((1 + confidence_level) / 2) / normal_quantile((1 + resampled_level) / 2))
    return WeightsUncertainty(covariance, _observations_left(expected + below, center, covariance), margin)


def _std_of_one(weights_of: Callable[[Tensor], Tensor], combined: Tensor) -> Tensor:
    """Standard deviation `(..., sensor)` of each weight if `A` rested on one observation: `2 tr(J A J A)`."""
    half = [row @ combined for row in _jacobian_rows(weights_of, combined)]
    return torch.stack([(2 * (x * x.mT).sum((-2, -1))).sqrt() for x in half], -1)


def _observations_left(combined: Tensor, weights: Tensor, covariance: Tensor) -> Tensor:
    """Observations `B_ii c' A c / V_ii` of each weight, less the p - 1 that the weights use up."""
    influence = influence_matrix(combined, weights)  # B
    residual = torch.einsum("ni,nik,nk->n", weights, combined, weights)
    observations = influence.diagonal(dim1=-2, dim2=-1) * residual[:, None] / _std(covariance).square()
    return (observations - weights.shape[-1] + 1).clamp(min=1)


def _variance_by_level(wccv: Tensor, windows: Tensor, omega: Tensor, jacobian: Tensor) -> Tensor:
    """Approximate variance of the weights that each level causes, summed over sensors, `(item, level)`.

    `Var(J dGamma) = 2 tr(J Gamma J Gamma) / n` for a Wishart matrix of `n` observations.
    """
    half = torch.einsum("niab,njbc->njiac", jacobian, wccv)
    variance = torch.einsum("njiac,njica->nj", half, half) * omega.square() / windows
    # With missing samples a level's matrix may be indefinite.
    return torch.where(omega > 0, variance.clamp(min=0), 0.0)


def _dominant(by_level: Tensor, windows: Tensor) -> Tensor:
    """Non-overlapping windows of the levels that cause most of the variance, in the harmonic mean, `(item,)`."""
    return (by_level.sum(-1) / (by_level / windows).sum(-1)).nan_to_num(nan=1.0)


def _across(by_level: Tensor, wccv: Tensor, first: int) -> Tensor:
    """Factor on the variance of the lower levels for their covariance with the levels above, `(item,)`."""
    std = by_level.sqrt()
    level = torch.arange(by_level.shape[1], dtype=by_level.dtype, device=by_level.device)
    # Wavelet variances of two levels correlate by about k sqrt(nu_upper / nu_lower) tau_lower / tau_upper, where k is
    # 1.5 for white noise, 1.4 for flicker and 1.25 for a random walk.
    size = wccv.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(wccv.dtype).tiny).log2().mean(-1) / 2 - level
    correlation = (1.3 * torch.exp2(-(size[:, :, None] - size[:, None, :]).abs())).clamp(max=1)
    correlation = torch.where(level[:, None] == level, 1.0, correlation)
    within = torch.einsum("nj,njk,nk->n", std[:, :first], correlation[:, :first, :first], std[:, :first])
    across = torch.einsum("nj,njk,nk->n", std[:, :first], correlation[:, :first, first:], std[:, first:])
    return torch.where(within > 0, 1 + 2 * across / within, 1.0)


def _jacobian_rows(weights_of: Callable[[Tensor], Tensor], combined: Tensor) -> Iterator[Tensor]:
    """Derivatives of one weight after the other, each of the shape of `combined`."""
    with torch.inference_mode(False), torch.enable_grad():
        leaf = combined.clone().requires_grad_()
        weights = weights_of(leaf).unbind(-1)
    for weight in weights:
        with torch.inference_mode(False), torch.enable_grad():
            row = torch.autograd.grad(weight.sum(), leaf, retain_graph=True)[0]
        yield (row + row.mT) / 2


def _std(covariance: Tensor) -> Tensor:
    return covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()


def _largest_ratio(cosines: Tensor, factor: float = 2.0, alpha: float = 1e-4) -> Tensor:
    """Ratio of the series' variance to the model's beyond which the model is refuted.

    Args:
        cosines: Degrees of freedom of the series' variance, `(item,)`.
        factor: Ratio that is allowed beyond chance, as the model is rough.
        alpha: Probability that chance alone exceeds its part of the limit.
    """
    from scipy import stats

    dof = cosines.cpu().numpy()
    return torch.as_tensor(factor * stats.chi2.ppf(1 - alpha, dof) / dof).to(cosines)
