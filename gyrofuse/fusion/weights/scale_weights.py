"""How much each scale counts when an array is fused."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

ScaleWeights = str | Sequence[float] | Tensor


def resolve_scale_weights(scale_weights: ScaleWeights, n_levels: int) -> Tensor:
    """Turn a name or numbers into scale weights that sum to 1.

    `"flat"` weighs all levels alike. `"short"` is `1/(1 + exp(j - j0))` with `j0 = J // 2`, `"long"` is
    `1/(1 + exp(j0 - j))` with `j0 = J - 6`, or two thirds of J, rounded up, when that is more: the logistic shapes of
    [Z] sections V and VI, whose printed digits they reproduce (J = 19 and 21).

    Args:
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level (normalised here).
        n_levels: Number of levels J.

    Returns:
        `(level,)`, float64, sum 1.

    Raises:
        TypeError: Neither a name nor numbers.
        ValueError: An unknown name, another number of weights than levels, or weights that are negative, not
            finite or all zero.
    """
    if isinstance(scale_weights, str):
        level = torch.arange(1, n_levels + 1, dtype=torch.float64)
        if scale_weights == "flat":
            weights = torch.ones_like(level)
        elif scale_weights == "short":
            weights = torch.sigmoid(n_levels // 2 - level)
        elif scale_weights == "long":
            weights = torch.sigmoid(level - max(n_levels - 6, math.ceil(2 * n_levels / 3)))
        else:
            raise ValueError(
                f"`scale_weights`: expected 'flat', 'short', 'long' or one number per level, got {scale_weights!r}"
            )
        return weights / weights.sum()
    weights = normalised(scale_weights)
    if len(weights) != n_levels:
        raise ValueError(f"`scale_weights`: expected one number for each of {n_levels} levels, got {len(weights)}")
    return weights


def normalised(scale_weights: Sequence[float] | Tensor) -> Tensor:
    """Numbers as scale weights that sum to 1, one for each level.

    Args:
        scale_weights: `(level,)`, >= 0.

    Returns:
        `(level,)`, float64.

    Raises:
        TypeError: Not numbers.
        ValueError: Not one number per level, or numbers that are negative, not finite or all zero.
    """
    try:
        weights = torch.as_tensor(scale_weights, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(
            f"`scale_weights`: expected 'flat', 'short', 'long' or one number per level, got {scale_weights!r}"
        ) from None
    if weights.ndim != 1:
        raise ValueError(f"`scale_weights`: expected one number per level, got shape {tuple(weights.shape)}")
    if not bool((weights.isfinite() & (weights >= 0)).all()) or not bool(weights.sum() > 0):
        raise ValueError(
            f"`scale_weights`: expected finite numbers >= 0, not all zero, got {weights.detach().tolist()}"
        )
    return weights / weights.sum()
