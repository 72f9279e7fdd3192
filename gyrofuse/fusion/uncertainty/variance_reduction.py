"""Variance reduction: the ratio of the wavelet variance of the plain mean to that of a virtual gyro, level by level.

Both variances come from the same sensors, so that their ratio is known far better than either. Where a level holds many
windows, the interval follows from the variation of the ratio along the recording; elsewhere from Pitman's law of the
ratio of two correlated variances, exact for weights chosen beforehand. For weights fitted to the recording the variance
is that in other recordings (`gyrofuse.fusion.uncertainty.cross_fitting`), and the observations are reduced by those
that the fit has used up.

Reference:
    E. J. G. Pitman, Biometrika 31, 1939.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.deprecation import moved_names
from gyrofuse._base.results import ConfidenceInterval, Result
from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit
from gyrofuse.wavelets.intervals import t_quantile

__getattr__ = moved_names(__name__, {"Gain": "gyrofuse.fusion.VarianceReduction"})


@dataclass(frozen=True, eq=False)
class VarianceReduction(Result):
    """Wavelet variance of the plain mean over that of the virtual gyro, by level.

    Attributes:
        estimate: `(..., level)`, ratio for these weights in any other recording of the same array; above 1 where the
            virtual gyro has the smaller variance.
        confidence_interval: Limits `(..., level)`; 0 and infinity where a level holds too few observations.
        confidence_level: Confidence level of the intervals.
        in_sample: `(..., level)`, ratio in the recording that the weights were fitted to, which is too large.
        tau: `(level,)`, averaging time.
        tau_unit: Unit of the averaging time.
    """

    estimate: Tensor
    confidence_interval: ConfidenceInterval
    confidence_level: float
    in_sample: Tensor
    tau: Tensor
    tau_unit: str

    _batched = ("estimate", "confidence_interval", "in_sample")

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions; `()` for a single array."""
        return tuple(self.estimate.shape[:-1])

    def summary(self) -> str:
        """The ratio by level as a table of fixed width, for each item of a batch."""
        interval = f"{100 * self.confidence_level:g} % interval"
        head = f"{'level':>5}  {f'tau ({self.tau_unit})':>13}  {'gain':>8}  {interval:>20}"
        columns = (self.tau.expand_as(self.estimate), self.estimate, *self.confidence_interval)
        levels = range(1, len(self.tau) + 1)
        tables = []
        for rows in zip(*(column.reshape(-1, len(self.tau)).tolist() for column in columns), strict=True):
            lines = [
                f"{j:>5}  {tau:>13.6g}  {ratio:>8.3f}  {_limits(low, high):>20}"
                for j, tau, ratio, low, high in zip(levels, *rows, strict=True)
            ]
            tables.append("\n".join([head, *lines]))
        return "\n\n".join(tables)


def ratio_to_equal(
    weights: Tensor, wccv: Tensor, dof: Tensor, fit: CrossFit, confidence_level: float = 0.95
) -> tuple[Tensor, ConfidenceInterval]:
    """Ratio of the wavelet variance of the plain mean to that of a virtual gyro, at each level.

    Args:
        weights: `(..., sensor)`, sum 1.
        wccv: `(..., level, sensor, sensor)`.
        dof: `(..., level)`, independent observations of each level.
        fit: Cross-fit of the weights, batched as the weights.
        confidence_level: Probability that an interval holds the true ratio.

    Returns:
        Estimate and limits, `(..., level)` each.
    """
    from scipy import stats

    fused = torch.einsum("...jik,...k->...ji", wccv, weights)  # Gamma_j c: (..., level, sensor)
    virtual = torch.einsum("...i,...ji->...j", weights, fused)
    equal, product = wccv.mean((-1, -2)), fused.mean(-1)
    left = dof * fit.left  # n - p + 1 of n for one level
    unshared = (1 - product.square() / (equal * virtual)).clamp(min=0) + 1 - left / dof
    spare = (left - 1).clamp(min=0)
    quantile = torch.as_tensor(stats.t.ppf((1 + confidence_level) / 2, spare.cpu().numpy())).to(spare)
    # With half a degree of freedom or less the quantile is beyond any use: no limits.
    arc = torch.where(spare > 0.5, 1 + 2 * unshared * quantile.square() / spare, torch.inf)
    factor = arc + (arc.square() - 1).sqrt()
    found = equal / virtual
    estimate = found / (1 + fit.optimism)
    step = (t_quantile(fit.reduction_dof, confidence_level) * fit.reduction_error).exp()
    by_series = fit.reduction_error.isfinite()
    low = torch.where(by_series, estimate / step, estimate / factor)
    # A few observations give a rough optimism only: there the upper limit is not corrected for it.
    high = torch.where(by_series, estimate * step, torch.maximum(found, estimate) * factor)
    return estimate, ConfidenceInterval(low, high)


def _limits(low: float, high: float) -> str:
    return f"[{low:.3f}, {high:.3f}]" if high < 1000 else f"[{low:.3f}, inf)"
