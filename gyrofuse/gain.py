"""How many times smaller the wavelet variance of a virtual gyro is than that of the plain mean, level by level.

Both variances come from the same sensors, so that their ratio is known far better than either: Pitman's law of the
ratio of two correlated variances gives its interval, exact for weights chosen beforehand. Weights fitted to the
recording flatter themselves in it. Their variance is made larger by that optimism, as in Akaike's final prediction
error, and as many observations less are left as their fit has used up.

References:
    E. J. G. Pitman, Biometrika 31, 1939; H. Akaike, Annals of the Institute of Statistical Mathematics 21, 1969.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._result import ConfidenceInterval
from gyrofuse.hypotheses import Answer, Evidence

# Of the correlation between levels: white noise has 1.5, flicker 1.4 and a random walk 1.25.
_KAPPA = 1.3
# Degrees of freedom below which the law of a ratio says nothing.
_FEWEST_SPARE = 0.5


@dataclass(frozen=True, eq=False)
class Gain(Answer):
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
    weights: Tensor, wccv: Tensor, degrees: Tensor, optimism: Tensor, confidence_level: float = 0.95
) -> tuple[Tensor, ConfidenceInterval]:
    """Ratio of the wavelet variance of the plain mean to that of a virtual gyro, at each level.

    Args:
        weights: `(..., sensor)`, sum 1.
        wccv: `(..., level, sensor, sensor)`.
        degrees: `(..., level)`, independent observations of each level.
        optimism: `(..., level)`, how much larger the variance of the virtual gyro is in other recordings; a ratio
            less 1.
        confidence_level: Probability that an interval holds the true ratio.

    Returns:
        Estimate and limits, `(..., level)` each.
    """
    from scipy import stats

    fused = torch.einsum("...jik,...k->...ji", wccv, weights)  # Gamma_j c: (..., level, sensor)
    virtual = torch.einsum("...i,...ji->...j", weights, fused)
    equal, product = wccv.mean((-1, -2)), fused.mean(-1)
    left = degrees / (1 + optimism / 2)  # n - p + 1 of n for one level
    unshared = (1 - product.square() / (equal * virtual)).clamp(min=0) + 1 - left / degrees
    spare = (left - 1).clamp(min=0)
    quantile = torch.as_tensor(stats.t.ppf((1 + confidence_level) / 2, spare.cpu().numpy())).to(spare)
    spread = torch.where(spare > _FEWEST_SPARE, 1 + 2 * unshared * quantile.square() / spare, torch.inf)
    factor = spread + (spread.square() - 1).sqrt()
    found = equal / virtual
    estimate = found / (1 + optimism)
    # How much of the optimism falls on this level is known roughly: the upper limit does without the correction.
    return estimate, ConfidenceInterval(estimate / factor, found * factor)


def optimism(evidence: Evidence) -> Tensor:
    """How much larger the wavelet variance of SVO weights is in other recordings than in their own, by level.

    `2 tr(V A)` over all levels together, for `V = Cov(B dA c)`. The share of level j is taken to be that of Gaussian
    observations, `sum_k omega_k E[c' dGamma_j B dGamma_k c]` with

        E[...] = r_jk (sqrt(nu_j nu_k tr(B Gamma_j) tr(B Gamma_k)) + c' Gamma_j B Gamma_k c) / sqrt(eta_j eta_k)

    where `nu_j = c' Gamma_j c` and `r_jk` is the correlation between levels.

    Returns:
        `(..., level)`, a ratio less 1; 0 at levels that are not known.
    """
    wccv, influence, omega = evidence.wccv, evidence.influence, evidence.scale_weights
    fused = torch.einsum("...jik,...k->...ji", wccv, evidence.weights)  # Gamma_j c: (..., level, sensor)
    virtual = torch.einsum("...i,...ji->...j", evidence.weights, fused).clamp(min=0)
    root = (virtual * torch.einsum("...ik,...jki->...j", influence, wccv).clamp(min=0)).sqrt()
    error = root[..., :, None] * root[..., None, :] + fused @ influence @ fused.mT  # (..., level, level)
    scale = evidence.degrees.rsqrt()
    error = _level_correlation(wccv) * scale[..., :, None] * error * scale[..., None, :]
    share = error @ omega
    total = 2 * torch.einsum("...ik,...ki->...", evidence.covariance, evidence.combined)
    scaled = share * (total / (share @ omega))[..., None]
    return torch.where(virtual > 0, scaled / virtual, 0.0)


def _level_correlation(wccv: Tensor) -> Tensor:
    """Correlation `(..., level, level)` of wavelet variances between levels.

    `kappa sqrt(nu_k / nu_j) tau_j / tau_k` for `k > j`, with the sensors' mean variance `nu`: what power laws have.
    """
    variance = wccv.diagonal(dim1=-2, dim2=-1).mean(-1)
    slope = variance.log2().diff(dim=-1).nan_to_num(nan=0.0).clamp(-1, 1)
    fall = torch.nn.functional.pad((1 - slope / 2).cumsum(-1), (1, 0))  # -log2 of sqrt(nu_j) / tau_j
    correlation = (_KAPPA * torch.exp2(-(fall[..., :, None] - fall[..., None, :]).abs())).clamp(max=1)
    same = torch.eye(variance.shape[-1], dtype=torch.bool, device=variance.device)
    return torch.where(same, 1.0, correlation)


def _limits(low: float, high: float) -> str:
    return f"[{low:.3f}, {high:.3f}]" if high < 1000 else f"[{low:.3f}, inf)"
