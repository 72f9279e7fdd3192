"""How many times smaller the wavelet variance of a virtual gyro is than that of the plain mean, level by level.

Both variances come from the same sensors, so that their ratio is known far better than either. Where a level holds many
windows, the course of the ratio along the recording tells how far it can be off; elsewhere Pitman's law of the ratio of
two correlated variances does, exact for weights chosen beforehand. Weights fitted to the recording flatter themselves
in it. Their variance is the one in other recordings (`gyrofuse.fusion.uncertainty.cross_fitting`), and as many
observations less are left as their fit has used up.

Reference:
    E. J. G. Pitman, Biometrika 31, 1939.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.results import ConfidenceInterval
from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit
from gyrofuse.fusion.uncertainty.tests import Answer
from gyrofuse.wavelets.equivalent_dof import t_quantile

# Degrees of freedom below which the law of a ratio says nothing.
_FEWEST_SPARE = 0.5


@dataclass(frozen=True, eq=False)
class VarianceReduction(Answer):
    """How many times smaller the wavelet variance of the virtual gyro is than that of the plain mean, by level.

    Attributes:
        estimate: `(..., level)`, of the ratio for these weights in any other recording of the same array; above 1
            where they gain.
        confidence_interval: Limits `(..., level)`; 0 and infinity where a level holds too few observations to say.
        confidence_level: Of the intervals.
        in_sample: `(..., level)`, the ratio in the recording that the weights were fitted to, which flatters them.
        tau: `(level,)`, averaging time.
        tau_unit: Of the averaging time.
    """

    estimate: Tensor
    confidence_interval: ConfidenceInterval
    confidence_level: float
    in_sample: Tensor
    tau: Tensor
    tau_unit: str

    def summary(self) -> str:
        """The gain by level as a table of fixed width, for each item of a batch."""
        interval = f"{100 * self.confidence_level:g} % interval"
        head = f"{'level':>5}  {f'tau ({self.tau_unit})':>13}  {'gain':>8}  {interval:>20}"
        columns = (self.tau.expand_as(self.estimate), self.estimate, *self.confidence_interval)
        levels = range(1, len(self.tau) + 1)
        tables = []
        for rows in zip(*(column.reshape(-1, len(self.tau)).tolist() for column in columns), strict=True):
            lines = [
                f"{j:>5}  {tau:>13.6g}  {gain:>8.3f}  {_limits(low, high):>20}"
                for j, tau, gain, low, high in zip(levels, *rows, strict=True)
            ]
            tables.append("\n".join([head, *lines]))
        return "\n\n".join(tables)


def ratio_to_equal(
    weights: Tensor, wccv: Tensor, degrees: Tensor, fit: CrossFit, confidence_level: float = 0.95
) -> tuple[Tensor, ConfidenceInterval]:
    """Ratio of the wavelet variance of the plain mean to that of a virtual gyro, at each level.

    Args:
        weights: `(..., sensor)`, sum 1.
        wccv: `(..., level, sensor, sensor)`.
        degrees: `(..., level)`, independent observations of each level.
        fit: How the weights compare in other recordings, batched as they are.
        confidence_level: Probability that an interval holds the true ratio.

    Returns:
        Estimate and limits, `(..., level)` each.
    """
    from scipy import stats

    fused = torch.einsum("...jik,...k->...ji", wccv, weights)  # Gamma_j c: (..., level, sensor)
    virtual = torch.einsum("...i,...ji->...j", weights, fused)
    equal, product = wccv.mean((-1, -2)), fused.mean(-1)
    left = degrees * fit.left  # n - p + 1 of n for one level
    unshared = (1 - product.square() / (equal * virtual)).clamp(min=0) + 1 - left / degrees
    spare = (left - 1).clamp(min=0)
    quantile = torch.as_tensor(stats.t.ppf((1 + confidence_level) / 2, spare.cpu().numpy())).to(spare)
    spread = torch.where(spare > _FEWEST_SPARE, 1 + 2 * unshared * quantile.square() / spare, torch.inf)
    factor = spread + (spread.square() - 1).sqrt()
    found = equal / virtual
    estimate = found / (1 + fit.optimism)
    shown = (t_quantile(fit.gain_degrees, confidence_level) * fit.gain_error).exp()
    by_series = fit.gain_error.isfinite()
    low = torch.where(by_series, estimate / shown, estimate / factor)
    # What a few observations tell of the optimism is rough: there the upper limit does without the correction.
    high = torch.where(by_series, estimate * shown, torch.maximum(found, estimate) * factor)
    return estimate, ConfidenceInterval(low, high)


def _limits(low: float, high: float) -> str:
    return f"[{low:.3f}, {high:.3f}]" if high < 1000 else f"[{low:.3f}, inf)"
