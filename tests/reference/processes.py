"""Naive twins of the noise processes and of their Haar moments, written for clarity alone."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def haar_filter(level: int) -> Array:
    """Mean of the newest half minus mean of the older half, over 2: coefficients `(tau,)`."""
    tau = 2**level
    return np.repeat([-1.0, 1.0], tau // 2) / tau


def haar_coefficients(x: Array, level: int) -> Array:
    """Coefficients `(..., time_j)` of `x` `(..., time)`."""
    windows = np.lib.stride_tricks.sliding_window_view(x, 2**level, axis=-1)
    return windows @ haar_filter(level)


def wavelet_variance(x: Array, n_levels: int) -> Array:
    """Mean square of the coefficients `(..., level)`."""
    return np.stack([(haar_coefficients(x, j) ** 2).mean(-1) for j in range(1, n_levels + 1)], axis=-1)


def wavelet_cross_covariance(x: Array, n_levels: int) -> Array:
    """Mean products of coefficients `(..., level, sensor, sensor)` of `x` `(..., sensor, time)`."""
    levels = []
    for j in range(1, n_levels + 1):
        w = haar_coefficients(x, j)
        levels.append(w @ np.swapaxes(w, -1, -2) / w.shape[-1])
    return np.stack(levels, axis=-3)


def expected_wavelet_variance(second_moment: Array, n_levels: int) -> Array:
    """`a' E[x x'] a` for each level's filter `a`, from second moments `(time, time)`."""
    filters = [haar_filter(j) for j in range(1, n_levels + 1)]
    return np.array([a @ second_moment[: a.size, : a.size] @ a for a in filters])


def exact_ar1_wavelet_variance(phi: float, level: int) -> float:
    """Closed form of an AR(1) with unit innovations in rational arithmetic, rounded once."""
    z, tau = Fraction(phi), 2**level
    numerator = tau * (1 - z**2) - 2 * z * (3 - 4 * z ** (tau // 2) + z**tau)
    return float(numerator / (tau**2 * (1 - z) ** 2 * (1 - z**2)))


def odd_harmonic(n: Array) -> Array:
    """`sum_{m=1}^n 1 / (2m - 1)`, term by term."""
    n = np.asarray(n)
    sums = np.concatenate([[0.0], np.cumsum(1 / (2.0 * np.arange(1, n.max() + 1) - 1))])
    return sums[n.astype(int)]


def squared_gain(level: int, f: Array) -> Array:
    """`|H_j(f)|^2 = 4 sin^4(pi f tau/2) / (tau^2 sin^2(pi f))`."""
    tau = 2**level
    return 4 * np.sin(np.pi * f * tau / 2) ** 4 / (tau * np.sin(np.pi * f)) ** 2


def ar1_path(innovations: Array, phi: float) -> Array:
    """`x_t = phi x_{t-1} + e_t` from `x_0 = 0`, along the last axis."""
    x = np.zeros_like(innovations)
    previous = np.zeros(innovations.shape[:-1])
    for t in range(innovations.shape[-1]):
        previous = phi * previous + innovations[..., t]
        x[..., t] = previous
    return x
