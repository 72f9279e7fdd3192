"""Naive twin of the live virtual gyro: one sample after another, straight from its description."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
RAMP_STEPS = 8


def subset_weights(combined: Array, live: NDArray[np.bool_]) -> Array:
    """Optimal weights of the live sensors alone, 0 for the others."""
    weights = np.zeros(len(combined))
    solved = np.linalg.inv(combined[np.ix_(live, live)]).sum(1)
    weights[live] = solved / solved.sum()
    return weights


def fuse(signal: Array, combined: Array, time_constant: float, hold: int, settle: int) -> Array:
    """Fuse `(sensor, time)` into `(time,)`."""
    n_sensors, n_samples = signal.shape
    offset = np.zeros(n_sensors)
    gap = np.full(n_sensors, hold + 1)
    age = np.zeros(n_sensors, dtype=int)
    n_tracked = 0
    fused = np.full(n_samples, np.nan)
    for t in range(n_samples):
        x = signal[:, t]
        live = np.isfinite(x)
        known = age > 0
        age[live] = np.where(gap[live] > hold, 1, age[live] + 1)
        gap = np.where(live, 0, gap + 1)
        if not live.any():
            continue
        if not (live & (age > settle)).any():
            # nobody to compare with: those that were there before, or else whoever is there
            trusted = live & known if (live & known).any() else live
            age[trusted] = 2 * settle + 1
        n_tracked += 1
        steps = np.ceil((age - settle) * RAMP_STEPS / settle)
        sets = [live & (age > settle)]
        for step in range(2, RAMP_STEPS + 1):
            further = live & (age > settle) & (steps >= step)
            sets.append(further if further.any() else sets[-1])
        weights = np.mean([subset_weights(combined, some) for some in sets], axis=0)
        fused[t] = weights[live] @ (x - offset)[live]
        gain = np.where(age > settle, max(1 / n_tracked, 1 / time_constant), 1 / np.maximum(age, 1))
        offset[live] += (gain * (x - offset - fused[t]))[live]
    return fused
