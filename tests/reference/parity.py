"""Naive twin of the parity test: windows, levels and sensors one by one, differences by explicit regression."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]


def differences(n_sensors: int, of: list[int]) -> Array:
    """Basis `(sensor, len(of) - 1)` of the combinations of some sensors that do not hold a common rate."""
    basis = np.zeros((n_sensors, len(of) - 1))
    for k, sensor in enumerate(of[1:]):
        basis[of[0], k], basis[sensor, k] = -1, 1
    return basis


def contrast(gamma: Array, sensor: int, live: list[int]) -> Array:
    """The sensor minus the combination of the others, of sum 1, that predicts it best."""
    others = [k for k in live if k != sensor]
    start = np.zeros(len(gamma))
    start[sensor], start[others[0]] = 1, -1
    if len(others) == 1:
        return start
    basis = differences(len(gamma), others)
    coefficient = np.linalg.solve(basis.T @ gamma @ basis, basis.T @ gamma @ start)
    return start - basis @ coefficient


def degrees(n: float, level: int) -> float:
    """Independent observations among `n` coefficients, on the safe side."""
    return max((4 / 3 if level == 1 else 280 / 151) * n / 2**level, 1.0)


def window_coefficients(signal: Array, level: int, window: int, number: int) -> Array:
    """Coefficients of a level that end in a window, from the samples that all sensors have, `(sensor, time)`."""
    half = 2 ** (level - 1)
    common = np.isfinite(signal).all(0)
    some = []
    for end in range(number * window, (number + 1) * window):
        first = end + 1 - 2 * half
        if first < 0:
            continue
        halves = [np.arange(start, start + half) for start in (first, first + half)]
        older, newer = (half_window[common[half_window]] for half_window in halves)
        if min(len(older), len(newer)) < 0.75 * half:
            continue
        # what white noise gains in variance where samples are left out
        excess = (half / len(older) + half / len(newer)) / 2
        some.append((signal[:, newer].mean(1) - signal[:, older].mean(1)) / 2 / np.sqrt(excess))
    return np.array(some).T.reshape(len(signal), -1)


def p_values(
    signal: Array, gamma: Array, own: Array, observations: Array, window: int, number: int
) -> tuple[Array, Array, int]:
    """p-values `(level, sensor)` of too much difference and of too little variance, and how many there are."""
    n_levels, n_sensors = gamma.shape[:2]
    loud, quiet = np.full((n_levels, n_sensors), np.nan), np.full((n_levels, n_sensors), np.nan)
    live = list(range(n_sensors))
    for j in range(n_levels):
        w = window_coefficients(signal, j + 1, window, number)
        if not w.shape[1]:
            continue
        eta, seen = observations[j], degrees(w.shape[1], j + 1)
        for i in live:
            e = contrast(gamma[j], i, live)
            energy = ((e @ w) ** 2).mean() / (e @ gamma[j] @ e)
            rest = 0.0
            if n_sensors > 2:
                basis = differences(n_sensors, [k for k in live if k != i])
                parity = np.linalg.solve(np.linalg.cholesky(basis.T @ gamma[j] @ basis), basis.T @ w)
                rest = (parity**2).sum(0).mean()
            left = eta - (n_sensors - 2)
            loud[j, i] = stats.f.sf(energy * left / eta / (1 + rest / eta), seen, left)
            if seen >= 8:
                quiet[j, i] = stats.f.cdf((w[i] ** 2).mean() / own[j, i], seen, eta)
    return loud, quiet, int(np.isfinite(loud).sum() + np.isfinite(quiet).sum())
