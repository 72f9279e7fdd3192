"""Haar wavelet variance of stationary processes whose autocovariance is a sum of powers."""

from __future__ import annotations

import torch
from torch import Tensor

SMALLEST = 1e-300  # stands for 0 under a logarithm, dimensionless: near the smallest normal float64


def haar_kernel(z: Tensor, tau: Tensor) -> Tensor:
    """Haar wavelet variance of a process with autocovariance `z^k`, `k >= 0`, to rounding.

    The closed form `[tau (1 - z^2) - 2 z (3 - 4 z^h + z^tau)] / (tau (1 - z))^2`, `h = tau/2`, cancels to
    third order near `z = 1`. Compare the halves of a window instead: with `within` the mean correlation
    inside a half and `between` that of one half with the other, `nu = (within - between)/2`. Doubling the
    window gives `within <- (within + between)/2`, and `between = z m^2` with `m = (1 - z^h)/(h (1 - z))`.
    While `z^h` is near 1, the complements to 1 obey the same recursion. Both are sums of terms of one sign.

    Args:
        z: `(..., 1)`, real between -1 and 1, or complex with `|z| < 1`: the wavelet variance of the
            autocovariance `Re sum_i b_i z_i^k` is the same combination of kernels.
        tau: Filter lengths `(level,)`, all of 2, 4, .. in order.

    Returns:
        `(..., level)`.
    """
    half = tau / 2
    log_z = z.log() if z.is_complex() else z.abs().clamp(min=SMALLEST).log()
    loss = torch.where(half == 1, 1 - z, -torch.expm1(half * log_z))  # 1 - z^h; h is even beyond the first
    log_m = sum_before(torch.log1p(-loss / 2))  # m_2h = m_h (1 + z^h)/2
    between = z * torch.exp(2 * log_m)
    not_between = (1 - z) - z * torch.expm1(2 * log_m)
    correlated = (z.real > 0.5) & (loss.abs() < 0.5)
    return compared_halves(half, between, not_between, correlated)


def haar_kernel_slope(z: Tensor, tau: Tensor) -> Tensor:
    """Derivative of `haar_kernel` with respect to `z`, by the same recursion, `(..., level)`.

    Args:
        z: `(..., 1)`, real between -1 and 1.
        tau: Filter lengths `(level,)`, all of 2, 4, .. in order.
    """
    half = tau / 2
    power = torch.where(half == 1, z, torch.exp(half * z.abs().clamp(min=SMALLEST).log()))  # z^h
    loss = 1 - power
    loss_slope = -half * torch.where(z == 0, (half == 1).to(z), power / torch.where(z == 0, 1.0, z))
    log_m = sum_before(torch.log1p(-loss / 2))
    log_m_slope = sum_before(-loss_slope / (2 - loss))
    between_slope = torch.exp(2 * log_m) * (1 + 2 * z * log_m_slope)
    return (within_halves(half, between_slope) - between_slope) / 2


def compared_halves(half: Tensor, between: Tensor, not_between: Tensor, correlated: Tensor) -> Tensor:
    """Haar wavelet variance of a process of variance 1 from the mean correlation of the halves of a window.

    Args:
        half: Length `h` of a half, `(level,)`, all of 1, 2, 4, .. in order.
        between: Mean correlation of a sample of one half with a sample of the other, `(..., level)`.
        not_between: `1 - between`, with digits of its own, `(..., level)`.
        correlated: Whether the difference of the complements to 1 has more digits, `(..., level)`.

    Returns:
        `(..., level)`.
    """
    within = 1 / half + within_halves(half, between)
    not_within = within_halves(half, not_between)
    return torch.where(correlated, not_between - not_within, within - between) / 2


def within_halves(half: Tensor, between: Tensor) -> Tensor:
    """Mean correlation of the pairs of different samples of a half, from that between the halves of its parts."""
    return sum_before(half * between) / half


def sum_before(terms: Tensor) -> Tensor:
    """Sum of the terms before each, along the last dimension."""
    return torch.nn.functional.pad(terms[..., :-1].cumsum(-1), (1, 0))
