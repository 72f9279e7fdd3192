"""Optimal weights in closed form, as a function and as a layer.

The weights minimise the wavelet variance of the virtual signal, summed over levels with scale weights `omega_j`:

    A = sum_j omega_j Gamma_j,   c = A^-1 1 / (1' A^-1 1)                                   [Z] equations (4), (7)

Scale weights say how much each level counts: a name, or one number >= 0 per level, of which the sum does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gyrofuse._base.checks import check_floating
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse.wavelets.moments import combined_covariance

# How much each scale counts: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
ScaleWeights = str | Sequence[float] | Tensor


def svo_weights(wccv: Tensor, scale_weights: ScaleWeights = "flat") -> Tensor:
    """Optimal weights of an array from its wavelet cross-covariance; differentiable.

    Args:
        wccv: `(..., level, sensor, sensor)`, signal^2.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.

    Returns:
        `(..., sensor)`, sum 1, may be negative.

    Raises:
        TypeError: `wccv` is not a floating point tensor.
        ValueError: Wrong shape or scale weights.
        SingularCovarianceError: `A` is not positive definite (a dead or duplicated sensor, say).

    References:
        [Z] equation (7).
    """
    return optimal_weights(checked_combination(wccv, scale_weights))


class SVOWeights(nn.Module):
    """`svo_weights` as a layer, without checks of values in `forward`.

    `nn.Sequential(HaarFilterBank(J), CrossCovariance(), SVOWeights("long"))` maps a signal to its weights,
    differentiable end to end.

    Args:
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
    """

    def __init__(self, scale_weights: ScaleWeights = "flat") -> None:
        super().__init__()
        self.scale_weights = scale_weights
        # The values of numbers are checked here, once.
        self._numbers = None if isinstance(scale_weights, str) else normalised(scale_weights)

    def forward(self, wccv: Tensor) -> Tensor:
        """Map a wavelet cross-covariance to weights.

        Args:
            wccv: `(..., level, sensor, sensor)`.

        Returns:
            `(..., sensor)`, sum 1.

        Raises:
            TypeError: `wccv` is not a floating point tensor.
            ValueError: Wrong shape, or another number of levels than scale weights.
        """
        n_levels, omega = check_levels(wccv), self._numbers
        if omega is None:
            omega = resolve_scale_weights(self.scale_weights, n_levels)
        elif len(omega) != n_levels:
            raise ValueError(f"`wccv`: expected {len(omega)} levels, one for each scale weight, got {n_levels}")
        return optimal_weights(combined_covariance(wccv, omega))


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


def check_scale_weights(scale_weights: ScaleWeights) -> None:
    """Check scale weights before the number of levels is known.

    Args:
        scale_weights: As for `svo_weights`.

    Raises:
        TypeError: Neither a name nor numbers.
        ValueError: An unknown name, or numbers that are negative, not finite or all zero.
    """
    resolve_scale_weights(scale_weights, 1 if isinstance(scale_weights, str) else len(normalised(scale_weights)))


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


def optimal_weights(combined: Tensor) -> Tensor:
    """`c = A^-1 1 / (1' A^-1 1)`, [Z] equation (7).

    Args:
        combined: `A`, `(..., sensor, sensor)`.

    Returns:
        `(..., sensor)`, sum 1.
    """
    solved = torch.linalg.solve(combined, combined.new_ones(combined.shape[-1]).expand(combined.shape[:-1]))
    return solved / solved.sum(-1, keepdim=True)


def influence_matrix(combined: Tensor, weights: Tensor) -> Tensor:
    """`B = (I - c 1') A^-1`, by which optimal weights follow a change of `A`: `dc = -B dA c`.

    Args:
        combined: `A`, `(..., sensor, sensor)`.
        weights: `c`, `(..., sensor)`.

    Returns:
        `(..., sensor, sensor)`.

    References:
        [Z] Theorem 2.
    """
    inverse = torch.linalg.inv(combined)
    return inverse - weights[..., :, None] * inverse.sum(-2, keepdim=True)


def checked_combination(wccv: Tensor, scale_weights: ScaleWeights, labels: Sequence[str] | None = None) -> Tensor:
    """`A = sum_j omega_j Gamma_j`, [Z] equation (4), positive definite.

    Args:
        wccv: `(..., level, sensor, sensor)`; a level whose scale weight is 0 may be unknown (NaN).
        scale_weights: As for `svo_weights`.
        labels: Names of the sensors, for the message.

    Returns:
        `(..., sensor, sensor)`.

    Raises:
        TypeError: `wccv` is not a floating point tensor.
        ValueError: Wrong shape or scale weights.
        SingularCovarianceError: `A` is not positive definite.
    """
    combined = combined_covariance(wccv, resolve_scale_weights(scale_weights, check_levels(wccv)))
    check_positive_definite("the wavelet cross-covariance combined over scales", combined, labels)
    return combined


def check_levels(wccv: Tensor) -> int:
    """Number of levels of a wavelet cross-covariance.

    Args:
        wccv: `(..., level, sensor, sensor)`.

    Raises:
        TypeError: Not a floating point tensor.
        ValueError: Another shape.
    """
    check_floating("wccv", wccv)
    if wccv.ndim < 3 or wccv.shape[-1] != wccv.shape[-2]:
        raise ValueError(f"`wccv`: expected (..., level, sensor, sensor), got shape {tuple(wccv.shape)}")
    return wccv.shape[-3]
