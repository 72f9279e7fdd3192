"""Naive twins of the moving block bootstrap, written for clarity alone: [Z] Algorithm 1, draw by draw, start by start.

Coefficients come from their definition (`haar.coefficients`); missing ones are NaN and their products are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from reference import haar

Array = NDArray[np.float64]


def resample(signal: Array, n_levels: int, block_length: int, starts: NDArray, completions: NDArray) -> Array:
    """WCCV of one resample, `(level, sensor, sensor)`, by writing down all of its coefficients.

    `starts` of the blocks, one for each; `completions`, where the stretch that completes each level starts.
    """
    coefficients = [haar.coefficients(signal, level).astype(float) for level in range(1, n_levels + 1)]
    columns = coefficients[-1].shape[-1]
    out = []
    for w, completion in zip(coefficients, completions, strict=True):
        trimmed = w[:, :columns]
        blocks = np.concatenate([trimmed[:, u : u + block_length] for u in starts], axis=-1)[:, :columns]
        missing = w.shape[-1] - columns
        whole = np.concatenate([blocks, w[:, completion : completion + missing]], axis=-1)
        assert whole.shape == w.shape
        out.append(np.nanmean(whole[:, None, :] * whole[None, :, :], axis=-1))
    return np.stack(out)


def linear_moments(influences: list[Array], block_length: int, step: int = 1) -> tuple[Array, Array]:
    """Mean and covariance, over all draws, of the resampled sum of influences `(row, M_j)` of each level.

    Every block sum at every start is added up by itself; completing stretches start at multiples of `step`.
    """
    columns = influences[-1].shape[-1]
    joint = sum(u[:, :columns] for u in influences)
    n_blocks, rest = divmod(columns, block_length)
    starts = range(columns - block_length + 1)
    pieces = [(n_blocks, np.stack([joint[:, s : s + block_length].sum(-1) for s in starts]))]
    pieces.append((1, np.stack([joint[:, s : s + rest].sum(-1) for s in starts])))
    for u in influences:
        missing = u.shape[-1] - columns
        pieces.append((1, np.stack([u[:, s : s + missing].sum(-1) for s in range(0, columns + 1, step)])))
    mean = sum(n * sums.mean(0) for n, sums in pieces)
    covariance = sum(n * np.cov(sums.T, bias=True).reshape(len(mean), len(mean)) for n, sums in pieces)
    return np.asarray(mean), np.asarray(covariance)


def about_estimate(moments: tuple[Array, Array]) -> Array:
    """Second moment about the estimate, for influences that sum to zero over all times."""
    mean, covariance = moments
    return covariance + np.outer(mean, mean)


def product_influences(signal: Array, n_levels: int) -> list[Array]:
    """Influence of each time on the WCCV, `(sensor * sensor, M_j)` per level: `(W_i W_k - gamma_ik) / count_ik`."""
    out = []
    for level in range(1, n_levels + 1):
        w = haar.coefficients(signal, level).astype(float)
        products = w[:, None, :] * w[None, :, :]
        count = np.isfinite(products).sum(-1, keepdims=True).clip(1)
        mean = np.nansum(products, axis=-1, keepdims=True) / count
        out.append((np.nan_to_num(products - mean) / count).reshape(-1, w.shape[-1]))
    return out


def wccv_covariance(signal: Array, n_levels: int, block_length: int) -> Array:
    """Closed form for the WCCV, `(level * sensor * sensor, the same)`."""
    per_level = product_influences(signal, n_levels)
    n = len(per_level[0])
    stacked = [np.zeros((n * n_levels, u.shape[-1])) for u in per_level]
    for j, u in enumerate(per_level):
        stacked[j][j * n : (j + 1) * n] = u
    return about_estimate(linear_moments(stacked, block_length))


def weights_influences(signal: Array, omega: Array) -> list[Array]:
    """Influence of each time on the SVO weights, `(sensor, M_j)` per level, by differences of the weights.

    The weights are linearised by moving one entry of `A` at a time.
    """
    n_levels, p = len(omega), len(signal)
    wccv = haar.wavelet_cross_covariance(signal, n_levels)
    combined = np.einsum("j,jik->ik", omega, np.nan_to_num(wccv))
    inverse = np.linalg.inv(combined)
    c = inverse.sum(-1) / inverse.sum()
    jacobian = np.zeros((p, p, p))  # of the weights with respect to A
    for i in range(p):
        for k in range(p):
            unit = np.zeros((p, p))
            unit[i, k] = 1.0
            moved = -inverse @ unit @ inverse @ np.ones(p)  # derivative of A^-1 1
            jacobian[:, i, k] = (moved - c * moved.sum()) / inverse.sum()
    flat = jacobian.reshape(p, p * p)
    return [
        w * flat @ u if w else 0 * (flat @ u) for w, u in zip(omega, product_influences(signal, n_levels), strict=True)
    ]


def weights_covariance(signal: Array, omega: Array, block_length: int, step: int = 1) -> Array:
    """Closed form for the SVO weights, `(sensor, sensor)`."""
    return about_estimate(linear_moments(weights_influences(signal, omega), block_length, step))


def inverse_variance_weights_covariance(signal: Array, omega: Array, block_length: int, step: int = 1) -> Array:
    """Closed form for weights `1/A_ii`, normalised."""
    p = len(signal)
    wccv = haar.wavelet_cross_covariance(signal, len(omega))
    variance = np.einsum("j,jii->i", omega, wccv)
    c = 1 / variance / (1 / variance).sum()
    jacobian = np.array([[(c[i] * c[k] - c[i] * (i == k)) / variance[k] for k in range(p)] for i in range(p)])
    influences = product_influences(signal, len(omega))
    own = [w * jacobian @ u[:: p + 1] for w, u in zip(omega, influences, strict=True)]
    return about_estimate(linear_moments(own, block_length, step))


def signal_resample(signal: Array, n_levels: int, block_length: int, starts: NDArray) -> Array:
    """WCCV of a signal rebuilt from blocks of its samples, the last one cut."""
    rebuilt = np.concatenate([signal[:, u : u + block_length] for u in starts], axis=-1)[:, : signal.shape[-1]]
    return haar.wavelet_cross_covariance(rebuilt, n_levels)


def politis_white(x: Array) -> float:
    """Best block length of one series for blocks that may overlap, lag by lag."""
    n = len(x)
    y = x - x.mean()
    quiet = max(5, int(np.ceil(np.log10(n))))
    last = int(np.ceil(np.sqrt(n))) + 2 * quiet
    r = [float(y[k:] @ y[: n - k]) / n for k in range(last + 1)]
    noise = 2 * np.sqrt(np.log10(n) / n)
    m = next(
        (m for m in range(last - quiet + 1) if all(abs(r[m + k] / r[0]) <= noise for k in range(1, quiet + 1))), last
    )
    m = min(max(m, 1), last // 2)
    flat_top = [1.0 if k <= m else 2 * (1 - k / (2 * m)) for k in range(2 * m + 1)]
    g = r[0] + 2 * sum(flat_top[k] * r[k] for k in range(1, 2 * m + 1))
    bend = 2 * sum(flat_top[k] * k * r[k] for k in range(1, 2 * m + 1))
    return float((2 * bend**2 / (4 / 3 * g**2)) ** (1 / 3) * n ** (1 / 3))
