"""Other ways to weigh the sensors of an array, from the same wavelet cross-covariance."""

from __future__ import annotations

import torch
from torch import Tensor


def equal_weights(wccv: Tensor) -> Tensor:
    """The plain mean: `1/p` for each of p sensors.

    Args:
        wccv: `(..., level, sensor, sensor)`; only its shape, dtype and device matter.

    Returns:
        `(..., sensor)`.
    """
    n_sensors = wccv.shape[-1]
    return wccv.new_full((*wccv.shape[:-3], n_sensors), 1 / n_sensors)


def inverse_variance_weights(wccv: Tensor, scale_weights: Tensor) -> Tensor:
    """Weights `1/A_ii`, normalised to sum 1: optimal when the sensors do not correlate.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        scale_weights: `(level,)`.

    Returns:
        `(..., sensor)`.
    """
    precision = torch.einsum("j,...jii->...i", scale_weights.to(wccv), wccv).reciprocal()
    return precision / precision.sum(-1, keepdim=True)
