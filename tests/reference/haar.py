"""Naive twins of the filter bank, of the wavelet moments and of the weights, written for clarity alone.

Coefficients come straight from their definition, as differences of two window means in extended precision; there is
no pyramid and no tile. A non-finite sample is missing, and so is every window that holds one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def array(n_sensors: int, n_samples: int, seed: int = 0) -> Array:
    """White noise and random walks, of another size for each sensor and correlated between them."""
    rng = np.random.default_rng(seed)
    mix = np.eye(n_sensors) + 0.3 * rng.normal(size=(n_sensors, n_sensors))
    white = rng.normal(size=(n_sensors, n_samples)) * rng.uniform(0.5, 2, (n_sensors, 1))
    return white + 0.02 * mix @ rng.normal(size=white.shape).cumsum(-1)


def coefficients(signal: ArrayLike, level: int) -> NDArray[np.longdouble]:
    """Half the difference between the means of the newest and the previous half window: `(..., time - tau + 1)`."""
    known = np.asarray(signal, dtype=np.longdouble).copy()
    known[~np.isfinite(known)] = np.nan
    half = 2 ** (level - 1)
    means = np.lib.stride_tricks.sliding_window_view(known, half, axis=-1).mean(-1)
    return (means[..., half:] - means[..., :-half]) / 2


def products(signal: ArrayLike, n_levels: int) -> tuple[Array, Array]:
    """Sums over time of the products of two sensors' coefficients, and how many there are: `(..., level, p, p)`."""
    sums, counts = [], []
    for level in range(1, n_levels + 1):
        w = coefficients(signal, level).astype(float)
        known = np.isfinite(w)
        filled = np.where(known, w, 0.0)
        sums.append(np.einsum("...it,...kt->...ik", filled, filled))
        counts.append(np.einsum("...it,...kt->...ik", known.astype(float), known.astype(float)))
    return np.stack(sums, axis=-3), np.stack(counts, axis=-3)


def wavelet_cross_covariance(signal: ArrayLike, n_levels: int) -> Array:
    """Mean product of the coefficients over the windows complete in both sensors: `(..., level, sensor, sensor)`."""
    sums, counts = products(signal, n_levels)
    return np.asarray(np.where(counts > 0, sums, np.nan) / np.where(counts > 0, counts, 1), dtype=float)


def relative_error(got: ArrayLike, expected: ArrayLike) -> float:
    """Largest error of a cross-covariance, `(i, k)` in units of the square root of variance i times variance k.

    NaN has to be where NaN is expected.
    """
    got, expected = np.asarray(got, dtype=float), np.asarray(expected)
    if not np.array_equal(np.isnan(got), np.isnan(expected)):
        return np.inf
    deviation = np.sqrt(np.einsum("...ii->...i", expected))
    error = np.abs(got - expected) / (deviation[..., :, None] * deviation[..., None, :])
    return float(np.nanmax(error, initial=0.0))


def wavelet_variance(signal: ArrayLike, n_levels: int) -> Array:
    """Mean square of the coefficients: `(..., level, sensor)`."""
    return np.stack(
        [np.nanmean(coefficients(signal, j).astype(float) ** 2, axis=-1) for j in range(1, n_levels + 1)], axis=-2
    )


def scale_weights(name: str, n_levels: int) -> Array:
    """The logistic shapes of Zhang et al., normalised; the midpoints are theirs at 19 and 21 levels."""
    level = np.arange(1, n_levels + 1)
    if name == "flat":
        shape = np.ones(n_levels)
    elif name == "short":
        shape = 1 / (1 + np.exp(level - {19: 9, 21: 10}[n_levels]))
    else:
        shape = 1 / (1 + np.exp({19: 13, 21: 15}[n_levels] - level))
    return shape / shape.sum()


def svo_weights(wccv: ArrayLike, omega: ArrayLike) -> Array:
    """`A^-1 1 / (1' A^-1 1)` with `A = sum_j omega_j Gamma_j`: `(sensor,)`."""
    combined = sum(w * g for w, g in zip(np.asarray(omega), np.asarray(wccv), strict=True))
    solved = np.linalg.inv(combined) @ np.ones(len(combined))
    return solved / solved.sum()


def risk(wccv: ArrayLike, omega: ArrayLike, weights: ArrayLike) -> float:
    """Wavelet variance of the fused signal summed over levels, `sum_j omega_j c' Gamma_j c`."""
    c = np.asarray(weights)
    return float(sum(w * c @ g @ c for w, g in zip(np.asarray(omega), np.asarray(wccv), strict=True)))
