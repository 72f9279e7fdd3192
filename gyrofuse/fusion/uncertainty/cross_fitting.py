"""What weights that were fitted to a recording leave in other recordings of the same array.

Weights flatter themselves in the recording that they were fitted to. At a level that holds many windows side by side
the recording is cut into folds of time, and each fold is judged by weights fitted without it (cross-fitting): no model
is needed, and the spread of the estimate along the recording tells its interval, as it does for a single sensor. A
level of few windows cannot be cut. There the weights are fitted anew to draws from a pilot model, where what they leave
is known, and two ratios are read off: how much smaller their variance is in the draw than in truth, and how much more
it scatters than that of weights which were not fitted.

References:
    V. Chernozhukov et al., Econometrics Journal 21, 2018, for cross-fitting; B. Efron, Journal of the American
    Statistical Association 99, 2004, for the parametric bootstrap of optimism.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.results import ConfidenceInterval
from gyrofuse.fusion.uncertainty.parametric import resample_wccv
from gyrofuse.wavelets import long_run_variance as series
from gyrofuse.wavelets.equivalent_dof import chi_square_interval, t_quantile
from gyrofuse.wavelets.pilot import Pilot

# Windows side by side from which on a level is cut into folds: eight of a fold then, and one lost at either end.
_FEWEST_TO_CUT = 64
_N_FOLDS = 8
# Draws of a pilot model. Those of fitted and of fixed weights are paired: what both share by chance cancels.
MANY_DRAWS = 200


@dataclass(frozen=True, eq=False)
class CrossFit:
    """How the wavelet variance of fitted weights in other recordings compares with that in their own.

    Attributes:
        optimism: `(..., level)`, variance in other recordings over that in the recording fitted to, less 1; 0 for
            weights that do not depend on data.
        low: `(..., level)`, lower limit of the variance in other recordings, in units of its estimate.
        high: `(..., level)`, upper limit in the same units.
        left: `(..., level)`, share of a level's observations that the fit has not used up.
        gain_error: `(..., level)`, standard error of the logarithm of the plain mean's variance over that of the
            weights, as the recording's own course tells; NaN at levels of too few windows for that.
        gain_degrees: `(..., level)`, degrees of freedom of `gain_error` squared.
    """

    optimism: Tensor
    low: Tensor
    high: Tensor
    left: Tensor
    gain_error: Tensor
    gain_degrees: Tensor

    def __getitem__(self, index: Any) -> CrossFit:
        """One item, or some, of the leading batch dimensions."""
        return CrossFit(*(getattr(self, field.name)[index] for field in fields(self)))

    def reshape(self, *batch: int) -> CrossFit:
        """The same items in other batch dimensions."""
        values = (getattr(self, field.name) for field in fields(self))
        return CrossFit(*(value.reshape(*batch, value.shape[-1]) for value in values))

    def limits_of(self, variance: Tensor) -> ConfidenceInterval:
        """Limits of a variance `(..., level)` that is as uncertain as that of the weights."""
        return ConfidenceInterval(variance * self.low.to(variance), variance * self.high.to(variance))

    @classmethod
    def cat(cls, parts: Sequence[CrossFit]) -> CrossFit:
        """One batch of several."""
        return cls(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def padded(self, n_levels: int) -> CrossFit:
        """With NaN at levels that nothing is known of, up to `n_levels` of them."""
        values = (getattr(self, field.name) for field in fields(self))
        return CrossFit(*(pad(value, (0, n_levels - value.shape[-1]), value=torch.nan) for value in values))


@dataclass(frozen=True)
class Fusion:
    """A way of fusing arrays `(item, ...)` whose weights are fitted.

    Attributes:
        weights_of: Wavelet cross-covariance `(item, draw, level, sensor, sensor)` and numbers of windows
            `(item, draw, level)` to weights `(item, draw, ...)`.
        variance_of: Such weights and the covariance `(item, draw, level, sensor, sensor)` that they meet to the
            variance `(item, draw, level)` that they leave.
        squares_of: Weights `(item, ...)`, two bins of time and a number of levels to sums and counts
            `(item, bin, level)` of the squared wavelet coefficients of the fused recording, of the bins from the first
            up to the second.
        n_draws: How often weights may be fitted anew to draws from a model.
    """

    weights_of: Callable[[Tensor, Tensor], Tensor]
    variance_of: Callable[[Tensor, Tensor], Tensor]
    squares_of: Callable[[Tensor, int, int, int], tuple[Tensor, Tensor]]
    n_draws: int = MANY_DRAWS


def cross_fit(
    fusion: Fusion,
    weights: Tensor,
    sums: Tensor,
    counts: Tensor,
    pilot: Pilot,
    degrees: Tensor,
    confidence_level: float,
) -> CrossFit:
    """Judge fitted weights by what they leave in other recordings.

    Args:
        fusion: How the weights were fitted.
        weights: `(item, ...)`, as fitted to the whole recording.
        sums: `(item, bin, level, sensor, sensor)`, of `gyrofuse.wavelets.covariance.binned_products`.
        counts: The same shape.
        pilot: Model of the noise at the last levels, batch `(item,)`.
        degrees: `(item, level)`, independent observations of the virtual gyro that a level holds.
        confidence_level: Probability that the limits hold the variance in other recordings.

    Returns:
        The comparison, batch `(item,)`.
    """
    n_bins, n_levels = sums.shape[1:3]
    totals = counts.sum(1)
    wccv = sums.sum(1) / totals
    own, present = fusion.squares_of(weights, 0, n_bins, n_levels)  # (item, bin, level)
    tau = torch.exp2(torch.arange(1, n_levels + 1, dtype=wccv.dtype, device=wccv.device))
    n_cut = int(((pilot.n_samples + 1) / tau - 1 >= _FEWEST_TO_CUT).sum())
    judged = own.clone()
    if n_cut:
        judged[..., :n_cut] = _by_folds(fusion, own[..., :n_cut], sums, counts, pilot.n_samples)
    inflation, left = torch.ones_like(degrees), torch.ones_like(degrees)
    if n_cut < n_levels:
        inflation[:, n_cut:], left[:, n_cut:] = _by_draws(fusion, wccv, totals, pilot, n_cut)
    mean = judged.sum(1) / own.sum(1)
    optimism = inflation * torch.where(mean > 0, mean, torch.nan) - 1

    windows = present.sum(1) / tau
    shown = (windows >= series.FEWEST_WINDOWS) & (judged.sum(1) > 0)
    terms = series.number_of_terms(windows)
    even = (sums / totals[:, None]).mean((-1, -2)) * totals.amax((-1, -2))[:, None]  # squares of the plain mean
    spread = _relative_error(judged, present, terms) / left.sqrt()
    along = _relative_error(judged, present, terms, even) / left.sqrt()
    # What the weights lose by their errors is q ~ chi-square of p - 1 degrees, and the optimism 2 E q: that of these
    # very weights is off by 2 (q - E q) from it. It decides where equal weights are nearly the best.
    gain_error = torch.hypot(along, optimism.log1p() / (sums.shape[-1] - 1) ** 0.5)
    step = t_quantile(terms, confidence_level) * spread / 3  # on the scale of the cube root, as a single sensor's
    by_series = (1 - step).clamp(min=0).pow(3), (1 + step).pow(3)
    by_model = chi_square_interval(torch.ones_like(degrees), degrees * left, confidence_level)
    low, high = (torch.where(shown, s, m) for s, m in zip(by_series, by_model, strict=True))
    return CrossFit(optimism, low, high, left, torch.where(shown, gain_error, torch.nan), terms)


def _relative_error(squares: Tensor, counts: Tensor, terms: Tensor, other: Tensor | None = None) -> Tensor:
    """Standard error `(item, level)` of the logarithm of a mean of squares, or of its ratio to another, by series."""
    total = counts.sum(1, keepdim=True)
    relative = squares * (total / squares.sum(1, keepdim=True))
    if other is not None:
        relative = relative - other * (total / other.sum(1, keepdim=True))
    # Every level is a series of its own: (item, level, bin, 1)
    return series.mean_covariance(relative.mT[..., None], counts.mT, terms)[..., 0, 0].clamp(min=0).sqrt()


def _by_folds(fusion: Fusion, own: Tensor, sums: Tensor, counts: Tensor, n_samples: int) -> Tensor:
    """Sums of squares `(item, bin, level)` of the first levels, every fold fused with weights fitted without it."""
    n_bins, n_levels = sums.shape[1:3]
    n_folds = min(_N_FOLDS, n_bins // 2)
    if n_folds < 2:
        return own
    n_cut, device = own.shape[-1], sums.device
    bin_length = series.bin_length(n_samples, sums.shape[-1])
    edges = [n_bins * fold // n_folds for fold in range(n_folds + 1)]
    tau = torch.exp2(torch.arange(1, n_levels + 1, dtype=torch.float64, device=device))
    # A window belongs to the bin of its newest sample: those of a fold begin before it, others reach back into it.
    before = -(-(2**n_cut) // bin_length)
    after = (tau / bin_length).ceil()[:, None]
    bins = torch.arange(n_bins, device=device)
    apart = torch.stack(
        [(bins < first - before) | (bins >= last + after) for first, last in pairwise(edges)]
    )  # (fold, level, bin)
    # Levels of few windows would lose most of them. They are octaves away from what the folds are judged on.
    few = n_samples + 1 - tau < series.FEWEST_WINDOWS * tau
    apart = (apart | few[:, None]).to(sums)
    number = torch.einsum("fjb,nbjik->nfjik", apart, counts)
    fitted_to = torch.einsum("fjb,nbjik->nfjik", apart, sums) / number
    whole = (sums.sum(1) / counts.sum(1))[:, None]
    known = (number > 0).all(-1, keepdim=True).all(-2, keepdim=True)
    weights = fusion.weights_of(torch.where(known, fitted_to, whole), number.amin((-1, -2)))
    parts = [
        fusion.squares_of(weights[:, fold], first, last, n_cut)[0] for fold, (first, last) in enumerate(pairwise(edges))
    ]
    return torch.cat(parts, 1)


def _by_draws(fusion: Fusion, wccv: Tensor, totals: Tensor, pilot: Pilot, n_cut: int) -> tuple[Tensor, Tensor]:
    """Variance in truth over that in the draw, and the share of observations left, `(item, level)` from `n_cut` on."""
    generator = torch.Generator().manual_seed(0)  # the same recording gets the same intervals
    first = max(pilot.first_level, n_cut - 2)
    drawn = resample_wccv(pilot, first, fusion.n_draws, generator)  # (item, draw, level, sensor, sensor)
    truth = wccv[:, None].clone()
    truth[:, :, first : pilot.n_levels] = pilot.wavelet_cross_covariance[:, None, first:]
    draws = truth.expand(-1, fusion.n_draws, -1, -1, -1).clone()
    draws[:, :, first : pilot.n_levels] = drawn
    number = totals.amin((-1, -2))[:, None]  # (item, 1, level)
    ratios = []
    for weights in (
        fusion.weights_of(draws, number.expand(-1, fusion.n_draws, -1)),
        fusion.weights_of(truth, number),
    ):
        seen, met = fusion.variance_of(weights, draws), fusion.variance_of(weights, truth)
        ratios.append((seen / met)[..., n_cut:])
    fitted, fixed = ratios  # (item, draw, level)
    inflation = fixed.mean(1) / fitted.mean(1)
    scatter = [(ratio.log() - ratio.log().mean(1, keepdim=True)).square().sum(1) for ratio in (fixed, fitted)]
    left = scatter[0] / scatter[1]
    return inflation.clamp(min=1), left.clamp(max=1)
