"""Wavelet variance (WV) and wavelet cross-covariance (WCCV) of arrays.

`gamma_{ik,j} = (1/M_j) sum_t W_{i,j,t} W_{k,j,t}` over the `M_j = T - 2**j + 1` windows inside the recording, no mean
removed ([Z] section II). Two paths compute it: tiles of time in cache for data, and differentiable operations on
the coefficients for gradients. They are one definition, tested against each other.
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor, nn

from gyrofuse._base.checks import check_floating, check_n_levels, check_signal
from gyrofuse.wavelets.haar import haar_coefficients
from gyrofuse.wavelets.moments import Moments


def wavelet_cross_covariance(signal: Tensor, n_levels: int | None = None) -> Tensor:
    """Wavelet cross-covariance of an array at every level.

    Missing (non-finite) samples are left out, never interpolated: entry `(i, k)` averages over the windows that are
    complete in both sensors. A level without any such window is NaN, with a warning. Memory beyond the signal: at
    most its own size, unless the signal requires gradients, when every coefficient is kept.

    Args:
        signal: `(..., sensor, time)`, any unit.
        n_levels: Number of levels J; the largest with `2**J <= time` by default.

    Returns:
        `(..., level, sensor, sensor)`, unit of the signal squared.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: The shape is not `(..., sensor, time)`, or the signal is too short for `n_levels`.

    References:
        [Z] section II, the estimator between equations (6) and (7).
    """
    check_signal("signal", signal)
    n_levels = check_n_levels(n_levels, signal.shape[-1])
    if torch.compiler.is_compiling() or (signal.requires_grad and torch.is_grad_enabled()):
        return cross_covariance(haar_coefficients(signal, n_levels))
    sums, counts = wavelet_products(signal.detach(), n_levels)
    return mean_products(sums, counts).to(signal.dtype)


def wavelet_variance(signal: Tensor, n_levels: int | None = None) -> Tensor:
    """Wavelet variance of every sensor at every level; twice it is the (overlapped) Allan variance.

    Allan variance at averaging time `m = 2**(j-1)` samples is `2 * wavelet_variance[..., j-1, :]`. Missing samples
    as in `wavelet_cross_covariance`.

    Args:
        signal: `(..., sensor, time)`, any unit.
        n_levels: Number of levels J; the largest with `2**J <= time` by default.

    Returns:
        `(..., level, sensor)`, unit of the signal squared.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: The shape is not `(..., sensor, time)`, or the signal is too short for `n_levels`.

    References:
        [Z] section II; Percival & Walden, Wavelet Methods for Time Series Analysis, equation (306b).
    """
    check_signal("signal", signal)
    # A sensor on its own is an array of one, whose only entry is the variance.
    alone = wavelet_cross_covariance(signal.unsqueeze(-2), n_levels)  # (..., sensor, level, 1, 1)
    return alone[..., 0, 0].transpose(-1, -2)


def cross_covariance(coefficients: list[Tensor]) -> Tensor:
    """Wavelet cross-covariance from coefficients; differentiable.

    Args:
        coefficients: List over level of `(..., sensor, time_j)`, NaN where missing.

    Returns:
        `(..., level, sensor, sensor)`, unit of the coefficients squared; NaN where no product exists.

    Raises:
        TypeError: An entry is not a floating point tensor.
        ValueError: The list is empty.
    """
    if not coefficients:
        raise ValueError("`coefficients`: expected a list of one tensor per level, got an empty list")
    levels = []
    for level in coefficients:
        check_floating("coefficients", level)
        known = level.isfinite()
        filled = torch.where(known, level, 0.0)
        present = known.to(level.dtype)
        levels.append((filled @ filled.transpose(-1, -2)) / (present @ present.transpose(-1, -2)))
    return torch.stack(levels, dim=-3)


class CrossCovariance(nn.Module):
    """`cross_covariance` as a layer: a list of coefficients to the wavelet cross-covariance."""

    def forward(self, coefficients: list[Tensor]) -> Tensor:
        """Map coefficients to their wavelet cross-covariance.

        Args:
            coefficients: List over level of `(..., sensor, time_j)`.

        Returns:
            `(..., level, sensor, sensor)`.

        Raises:
            TypeError, ValueError: As `cross_covariance`.
        """
        return cross_covariance(coefficients)


def mean_products(sums: Tensor, counts: Tensor) -> Tensor:
    """Divide sums of products by their counts, with one warning that names the levels without any product.

    Args:
        sums: Sums of products, `(..., level, sensor, sensor)`.
        counts: Number of products in each sum, of the same shape.

    Returns:
        Means of the same shape, NaN without any product.
    """
    empty = (counts == 0).movedim(-3, 0).flatten(1).any(1).nonzero().flatten() + 1
    if empty.numel():
        warnings.warn(
            f"no complete window for some sensors at level(s) {empty.tolist()}: NaN there; "
            "missing samples leave no window of that length, ask for fewer levels",
            stacklevel=3,
        )
    return sums / counts


def wavelet_products(signal: Tensor, n_levels: int) -> tuple[Tensor, Tensor]:
    """Sums of products of wavelet coefficients over a whole recording.

    Args:
        signal: `(..., sensor, time)`.
        n_levels: Number of levels J.

    Returns:
        Sums and counts, `(..., level, sensor, sensor)` each, float64.
    """
    moments = Moments.of(signal, n_levels)
    return moments.sums.squeeze(-4), moments.counts.squeeze(-4)
