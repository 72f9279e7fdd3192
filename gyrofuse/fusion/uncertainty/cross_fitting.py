"""Wavelet variance that weights fitted to one recording have in other recordings of the same array.

In the recording that weights were fitted to, their variance is too small. At a level with many non-overlapping windows
the recording is cut into folds of time, and each fold is fused with weights fitted without it (cross-fitting): no model
is needed, and the interval follows from the variation along the recording, as for a single sensor. A level of few
windows cannot be cut. There the weights are fitted again to draws from a pilot model, under which the true variance is
known, and two ratios are taken: how much smaller the variance is in the draw than in truth, and how much more it varies
between draws than that of fixed weights.

References:
    V. Chernozhukov et al., Econometrics Journal 21, 2018, for cross-fitting; B. Efron, Journal of the American
    Statistical Association 99, 2004, for the parametric bootstrap of optimism.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.results import ConfidenceInterval, Result
from gyrofuse.fusion.uncertainty.parametric import resample_wccv
from gyrofuse.wavelets import long_run_variance as series
from gyrofuse.wavelets.intervals import chi_square_interval, t_quantile
from gyrofuse.wavelets.moments import Moments, filter_lengths
from gyrofuse.wavelets.pilot import Pilot

# Number of draws of a pilot model. Draws of fitted and of fixed weights are paired, so that their common chance cancels
# and 200 give the ratio of the means within a few per cent at the last levels.
MANY_DRAWS = 200


@dataclass(frozen=True, eq=False)
class CrossFit(Result):
    """How the wavelet variance of fitted weights in other recordings compares with that in their own.

    Attributes:
        optimism: `(..., level)`, variance in other recordings over that in the recording fitted to, less 1; 0 for
            weights that do not depend on data.
        low: `(..., level)`, lower limit of the variance in other recordings, in units of its estimate.
        high: `(..., level)`, upper limit in the same units.
        left: `(..., level)`, fraction of a level's observations that the fit has not used up.
        reduction_error: `(..., level)`, standard error of the logarithm of the plain mean's variance over that of the
            weights, from its variation along the recording; NaN at levels of too few windows.
        reduction_dof: `(..., level)`, degrees of freedom of the square of `reduction_error`.
    """

    optimism: Tensor
    low: Tensor
    high: Tensor
    left: Tensor
    reduction_error: Tensor
    reduction_dof: Tensor

    _batched = ("optimism", "low", "high", "left", "reduction_error", "reduction_dof")

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions; `()` for a single array."""
        return tuple(self.optimism.shape[:-1])

    def reshape(self, *batch: int) -> CrossFit:
        """The same items in other batch dimensions.

        Args:
            *batch: Dimensions of the new batch.
        """
        values = (getattr(self, field.name) for field in fields(self))
        return CrossFit(*(value.reshape(*batch, value.shape[-1]) for value in values))

    def limits_of(self, variance: Tensor) -> ConfidenceInterval:
        """Limits of the variance of these weights, or of another combination with as many observations.

        Args:
            variance: `(..., level)`.
        """
        return ConfidenceInterval(variance * self.low.to(variance), variance * self.high.to(variance))

    @classmethod
    def cat(cls, parts: Sequence[CrossFit]) -> CrossFit:
        """Join along the first batch dimension.

        Args:
            parts: Of the same levels.
        """
        return cls(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def padded(self, n_levels: int) -> CrossFit:
        """With NaN at further levels.

        Args:
            n_levels: Number of levels of the result.
        """
        values = (getattr(self, field.name) for field in fields(self))
        return CrossFit(*(pad(value, (0, n_levels - value.shape[-1]), value=torch.nan) for value in values))


@dataclass(frozen=True)
class Fusion:
    """Functions of a method that fits weights to arrays, batch `(item,)`.

    Attributes:
        weights_of: Wavelet cross-covariance `(item, draw, level, sensor, sensor)` and numbers of windows
            `(item, draw, level)` to weights `(item, draw, ...)`.
        variance_of: Weights `(item, draw, ...)` and a wavelet cross-covariance `(item, draw, level, sensor, sensor)` to
            the wavelet variance `(item, draw, level)` of the fused signal.
        squares_of: Weights `(item, ...)`, two bins of time and a number of levels to sums and counts
            `(item, bin, level)` of the squared wavelet coefficients of the fused recording, from the first bin up to
            the second.
        n_draws: Number of draws from a model that the weights are fitted to.
    """

    weights_of: Callable[[Tensor, Tensor], Tensor]
    variance_of: Callable[[Tensor, Tensor], Tensor]
    squares_of: Callable[[Tensor, int, int, int], tuple[Tensor, Tensor]]
    n_draws: int = MANY_DRAWS


def cross_fit(
    fusion: Fusion,
    weights: Tensor,
    moments: Moments,
    pilot: Pilot,
    dof: Tensor,
    confidence_level: float,
) -> CrossFit:
    """Estimate the wavelet variance of fitted weights in other recordings.

    Args:
        fusion: The method that fitted the weights.
        weights: `(item, ...)`, as fitted to the whole recording.
        moments: Moments of the recording, batch `(item,)`.
        pilot: Model of the noise at the last levels, batch `(item,)`.
        dof: `(item, level)`, independent observations of the virtual gyro that a level holds.
        confidence_level: Probability that the limits hold the variance in other recordings.

    Returns:
        The comparison, batch `(item,)`.
    """
    n_bins, n_levels = moments.sums.shape[1:3]
    totals = moments.totals
    own, present = fusion.squares_of(weights, 0, n_bins, n_levels)  # (item, bin, level)
    tau = filter_lengths(n_levels).to(own)
    # With 64 windows each of eight folds holds eight, and loses one at either end.
    n_cut = int(((pilot.n_samples + 1) / tau - 1 >= series.MANY_WINDOWS).sum())
    judged = own.clone()
    if n_cut:
        judged[..., :n_cut] = _by_folds(fusion, own[..., :n_cut], moments)
    inflation, left = torch.ones_like(dof), torch.ones_like(dof)
    if n_cut < n_levels:
        inflation[:, n_cut:], left[:, n_cut:] = _by_draws(fusion, moments, pilot, n_cut)
    mean = judged.sum(1) / own.sum(1)
    optimism = inflation * torch.where(mean > 0, mean, torch.nan) - 1

    windows = present.sum(1) / tau
    enough = (windows >= series.FEWEST_WINDOWS) & (judged.sum(1) > 0)
    cosines = series.n_basis(windows)
    even = (moments.sums / totals[:, None]).mean((-1, -2)) * totals.amax((-1, -2))[:, None]  # squares of the plain mean
    error = _relative_error(judged, present, cosines) / left.sqrt()
    along = _relative_error(judged, present, cosines, even) / left.sqrt()
    # The loss by errors of the weights is q ~ chi-square of p - 1 degrees of freedom, and the optimism 2 E q; that of
    # these weights differs from it by 2 (q - E q), which matters where equal weights are nearly the best.
    reduction_error = torch.hypot(along, optimism.log1p() / (moments.n_sensors - 1) ** 0.5)
    step = t_quantile(cosines, confidence_level) * error / 3  # for the cube root, as of a single sensor
    by_series = (1 - step).clamp(min=0).pow(3), (1 + step).pow(3)
    by_model = chi_square_interval(torch.ones_like(dof), dof * left, confidence_level)
    low, high = (torch.where(enough, s, m) for s, m in zip(by_series, by_model, strict=True))
    return CrossFit(optimism, low, high, left, torch.where(enough, reduction_error, torch.nan), cosines)


def _relative_error(squares: Tensor, counts: Tensor, cosines: Tensor, other: Tensor | None = None) -> Tensor:
    """Standard error `(item, level)` of the logarithm of a mean of squares, or of its ratio to another, by series."""
    total = counts.sum(1, keepdim=True)
    relative = squares * (total / squares.sum(1, keepdim=True))
    if other is not None:
        relative = relative - other * (total / other.sum(1, keepdim=True))
    # Every level is a series of its own: (item, level, bin, 1)
    return series.mean_covariance(relative.mT[..., None], counts.mT, cosines)[..., 0, 0].clamp(min=0).sqrt()


def _by_folds(fusion: Fusion, own: Tensor, moments: Moments, most_folds: int = 8) -> Tensor:
    """Sums of squares `(item, bin, level)` of the first levels, every fold fused with weights fitted without it."""
    sums, counts = moments.sums, moments.counts
    n_bins, n_levels = sums.shape[1:3]
    n_folds = min(most_folds, n_bins // 2)
    if n_folds < 2:
        return own
    n_cut, device, bin_length = own.shape[-1], sums.device, moments.bin_length
    edges = [n_bins * fold // n_folds for fold in range(n_folds + 1)]
    tau = filter_lengths(n_levels).to(device)
    # A window belongs to the bin of its newest sample: windows of a fold begin before it, later ones reach back into
    # it.
    before = -(-(2**n_cut) // bin_length)
    after = (tau / bin_length).ceil()[:, None]
    bins = torch.arange(n_bins, device=device)
    apart = torch.stack(
        [(bins < first - before) | (bins >= last + after) for first, last in pairwise(edges)]
    )  # (fold, level, bin)
    # Levels of few windows would lose most of them, and are octaves away from the levels that the folds are judged on.
    few = moments.n_samples + 1 - tau < series.FEWEST_WINDOWS * tau
    apart = (apart | few[:, None]).to(sums)
    number = torch.einsum("fjb,nbjik->nfjik", apart, counts)
    fitted_to = torch.einsum("fjb,nbjik->nfjik", apart, sums) / number
    whole = moments.wccv[:, None]
    known = (number > 0).all(-1, keepdim=True).all(-2, keepdim=True)
    weights = fusion.weights_of(torch.where(known, fitted_to, whole), number.amin((-1, -2)))
    parts = [
        fusion.squares_of(weights[:, fold], first, last, n_cut)[0] for fold, (first, last) in enumerate(pairwise(edges))
    ]
    return torch.cat(parts, 1)


def _by_draws(fusion: Fusion, moments: Moments, pilot: Pilot, n_cut: int) -> tuple[Tensor, Tensor]:
    """Variance in truth over that in the draw, and the share of observations left, `(item, level)` from `n_cut` on."""
    generator = torch.Generator().manual_seed(0)  # the same recording gets the same intervals
    first = max(pilot.first_level, n_cut - 2)
    drawn = resample_wccv(pilot, first, fusion.n_draws, generator)  # (item, draw, level, sensor, sensor)
    truth = moments.wccv[:, None].clone()
    truth[:, :, first : pilot.n_levels] = pilot.wavelet_cross_covariance[:, None, first:]
    draws = truth.expand(-1, fusion.n_draws, -1, -1, -1).clone()
    draws[:, :, first : pilot.n_levels] = drawn
    number = moments.fewest[:, None]  # (item, 1, level)
    ratios = []
    for weights in (
        fusion.weights_of(draws, number.expand(-1, fusion.n_draws, -1)),
        fusion.weights_of(truth, number),
    ):
        seen, met = fusion.variance_of(weights, draws), fusion.variance_of(weights, truth)
        ratios.append((seen / met)[..., n_cut:])
    fitted, fixed = ratios  # (item, draw, level)
    inflation = fixed.mean(1) / fitted.mean(1)
    variance = [(ratio.log() - ratio.log().mean(1, keepdim=True)).square().sum(1) for ratio in (fixed, fitted)]
    left = variance[0] / variance[1]
    return inflation.clamp(min=1), left.clamp(max=1)
