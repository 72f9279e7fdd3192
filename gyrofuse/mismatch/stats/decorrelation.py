"""Rows of an array made independent of each other, each as near to its sensor as can be."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def decorrelated(rows: Tensor, correlation: Tensor) -> Tensor:
    """`R^(-1/2)` times rows `(..., sensor, time)` of correlation `R` `(..., sensor, sensor)`, by its symmetric root.

    Eigenvalues below 1e-6 are taken for that: sensors that are copies of each other differ by rounding alone.
    """
    values, vectors = torch.linalg.eigh(correlation)
    return (vectors / values.clamp(min=1e-6).sqrt()[..., None, :]) @ vectors.mT @ rows


def sign_correlation(z: Tensor) -> Tensor:
    """Correlation `(..., sensor, sensor)` of normal values `(..., sensor, time)`, in which outliers weigh no more.

    `sin(pi/2 mean sign_i sign_j)` (Sheppard, Phil. Trans. R. Soc. A 192 (1899), 101).
    """
    sign = z.sign()
    return torch.sin(math.pi / 2 * (sign @ sign.mT) / z.shape[-1])


def norms(z: Tensor) -> Tensor:
    """Mahalanobis norms `(..., time)` of normal values `(..., sensor, time)`: chi distributed over the sensors."""
    return decorrelated(z, sign_correlation(z)).square().sum(-2).sqrt()
