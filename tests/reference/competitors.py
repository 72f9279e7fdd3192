"""Naive twins of the relatives of SVO, written for clarity alone."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import multigammaln

Array = NDArray[np.float64]


def nonnegative_weights(combined: ArrayLike) -> Array:
    """The best of all subsets of the sensors whose optimal weights are not negative."""
    A = np.asarray(combined, dtype=float)
    p = len(A)
    best, least = np.zeros(p), np.inf
    for n in range(1, p + 1):
        for chosen in itertools.combinations(range(p), n):
            solved = np.linalg.solve(A[np.ix_(chosen, chosen)], np.ones(n))
            weights = np.zeros(p)
            weights[list(chosen)] = solved / solved.sum()
            if weights.min() >= 0 and weights @ A @ weights < least:
                best, least = weights, weights @ A @ weights
    return best


def neighbouring_correlations(wccv: ArrayLike, degrees: ArrayLike) -> Array:
    """Variances of each level with the mean correlations of the others, by degrees of freedom times 0.15^distance."""
    G, eta = np.asarray(wccv, dtype=float), np.asarray(degrees, dtype=float)
    out = G.copy()
    for j in range(len(G)):
        if eta[j] >= 1000:
            continue
        weights = np.array([eta[k] * 0.15 ** abs(k - j) if k != j else 0.0 for k in range(len(G))])
        correlations = [g / np.sqrt(np.outer(np.diag(g), np.diag(g))) for g in G]
        mean = sum(w * r for w, r in zip(weights / weights.sum(), correlations, strict=True))
        mean = (1 - 1e-6) * mean + 1e-6 * np.eye(G.shape[-1])
        out[j] = mean * np.sqrt(np.outer(np.diag(G[j]), np.diag(G[j])))
    return out


def log_marginal_likelihood(gamma: ArrayLike, target: ArrayLike, eta: float, nu: float) -> float:
    """Log density of a Wishart `eta gamma` whose expectation is inverse Wishart with mean `eta target`.

    Without the factor `|gamma|^((eta-p-1)/2)`, which depends on the data alone and does not exist for `eta < p`.
    """
    G, T = np.asarray(gamma), np.asarray(target)
    p = len(G)
    n, prior = nu + p + 1, nu * T
    log_det_prior = np.linalg.slogdet(prior)[1]
    log_det_posterior = np.linalg.slogdet(prior + eta * G)[1]
    gain = multigammaln((n + eta) / 2, p) - multigammaln(n / 2, p)
    return float(gain + n / 2 * log_det_prior - (n + eta) / 2 * log_det_posterior)
