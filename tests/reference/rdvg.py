"""Naive twin of RDVG (Vaccaro & Zaki 2017), one number at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def scales(n_samples: int) -> list[int]:
    """Cluster sizes 2, 4, ..., 2^J with J = floor(log2 N) - 3."""
    return [2**j for j in range(1, int(np.floor(np.log2(n_samples))) - 2)]


def allan_covariance(x: Array, y: Array, m: int) -> float:
    """Over clusters that do not overlap; pairs of clusters with a missing sample are left out."""
    products = []
    for k in range(len(x) // m - 1):
        step = [s[(k + 1) * m : (k + 2) * m].mean() - s[k * m : (k + 1) * m].mean() for s in (x, y)]
        products.append(step[0] * step[1])
    return float(np.nanmean(products) / 2)


def allan_covariances(signal: ArrayLike) -> Array:
    """`(scale, sensor, sensor)`."""
    x = np.asarray(signal, dtype=float)
    return np.array([[[allan_covariance(a, b, m) for b in x] for a in x] for m in scales(x.shape[-1])])


def sampling_covariance(sizes: list[int], n_samples: int, R2: float, Q2: float) -> Array:
    """`CR + CQ` between scales."""
    out = np.zeros((len(sizes), len(sizes)))
    for i, a in enumerate(sizes):
        for k, b in enumerate(sizes):
            m1, m2 = min(a, b), max(a, b)
            r, M1, M2 = m2 / m1, n_samples / m1, n_samples / m2
            white = (3 * M2 - 4) / ((M1 - 1) * (M2 - 1) * r**2) * R2 / m1**2
            top = (12 * r**3 - 6 * r + 3) * M2 - 2 * (6 * r**3 - 3 * r + 2)
            out[i, k] = white + top * Q2 * m1**2 / (36 * (M1 - 1) * (M2 - 1) * r**2)
    return out


def least_squares(regressors: Array, covariance: Array, values: Array) -> Array:
    """Generalised least squares."""
    weight = np.linalg.inv(covariance)
    return np.linalg.solve(regressors.T @ weight @ regressors, regressors.T @ weight @ values)


def fit(covariances: Array, n_samples: int) -> tuple[Array, Array]:
    """`R` and `Q`."""
    sizes = [2 ** (j + 1) for j in range(len(covariances))]
    m = np.array(sizes, dtype=float)
    p = covariances.shape[-1]
    R, Q, used = np.zeros(p), np.zeros((p, p)), np.zeros((p, 2))
    for i in range(p):
        variance = covariances[:, i, i]
        m0 = m[variance.argmin()]
        n_short = max(int((m < m0 / 8).sum()), 1)
        cov = sampling_covariance(sizes[:n_short], n_samples, 1.0, 0.0)
        R0 = least_squares(1 / m[:n_short, None], cov, variance[:n_short])[0]
        Q0 = 3 * R0 / m0**2
        cov = sampling_covariance(sizes, n_samples, R0**2, Q0**2)
        Q[i, i], R[i] = least_squares(np.stack([m / 3, 1 / m], 1), cov, variance)
        used[i] = R[i] if R[i] > 0 else R0, Q[i, i] if Q[i, i] > 0 else Q0
    for i in range(p):
        for k in range(p):
            if i != k:
                R2, Q2 = used[i] * used[k] / 2
                cov = sampling_covariance(sizes, n_samples, R2, Q2)
                Q[i, k] = least_squares(m[:, None] / 3, cov, covariances[:, i, k])[0]
    return R, Q
