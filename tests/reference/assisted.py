"""Naive twin of the model-assisted covariance, by its definition: likelihood, penalty and Akaike's criterion."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def penalised_log_likelihood(theta: ArrayLike, unit: ArrayLike, gamma: ArrayLike, eta: ArrayLike) -> float:
    """Wishart likelihood of levels taken for independent, minus `p(p+1)/2 ln tr Theta_k` for each component."""
    T, f, G, n = (np.asarray(v, dtype=float) for v in (theta, unit, gamma, eta))
    p = G.shape[-1]
    total = -p * (p + 1) / 2 * sum(np.log(np.trace(t)) for t in T)
    for j in range(len(G)):
        if n[j] > 0:
            S = sum(f[j, k] * T[k] for k in range(len(T)))
            total -= n[j] / 2 * (np.linalg.slogdet(S)[1] + np.trace(np.linalg.solve(S, G[j])))
    return float(total)


def criterion(model: ArrayLike, gamma: ArrayLike, eta: ArrayLike, own: ArrayLike, n_matrices: int) -> float:
    """Half of Akaike's criterion; levels that may keep their own covariance count from the likelihood of that."""
    S, G = np.asarray(model, dtype=float), np.asarray(gamma, dtype=float)
    p = G.shape[-1]
    misfit = 0.0
    for s, g, n, keeps in zip(S, G, np.asarray(eta), np.asarray(own), strict=True):
        level = np.linalg.slogdet(s)[1] + np.trace(np.linalg.solve(s, g))
        if keeps:
            level -= np.linalg.slogdet(g)[1] + p
        misfit += n * level / 2
    return float(misfit + p * (p + 1) / 2 * n_matrices)
