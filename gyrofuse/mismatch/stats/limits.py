"""Confidence limits."""

from __future__ import annotations

from collections.abc import Sequence

Z = 1.959963984540054  # standard deviations of a normal estimate from its 95 % limits: the 0.975 quantile


def variance_of(low: float, high: float) -> float:
    """Variance of a normal estimate with those 95 % limits."""
    return ((high - low) / (2 * Z)) ** 2


def weighted_mean(values: Sequence[float], variances: Sequence[float]) -> tuple[float, float]:
    """Mean weighted by inverse variances, and the sum of the weights: one over its variance."""
    weights = [1 / variance for variance in variances]
    return sum(w * v for w, v in zip(weights, values, strict=True)) / sum(weights), sum(weights)
