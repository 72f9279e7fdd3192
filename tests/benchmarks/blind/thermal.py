"""Temperature of a box: first-order heat equation, driven by the power switched on and by the room."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from .analog import relaxator

Array = NDArray[np.float64]


def lagged(drive: Array, time_constant: float, start: float) -> Array:
    """Solution of tau dT/dt = drive - T for a drive held over each step; `time_constant` in steps."""
    keep = np.exp(-1 / time_constant)
    return lfilter([1 - keep], [1.0, -keep], drive, zi=[keep * start])[0]


def room(n: int, step_rate: float, rng: np.random.Generator) -> Array:
    """Room temperature in Celsius: an air conditioner that switches, and slow weather."""
    t = np.arange(n) / step_rate
    period, swing = rng.uniform(60, 240), rng.uniform(0.5, 3.0)
    switching = swing * np.where((t / period + rng.uniform()) % 1 < rng.uniform(0.3, 0.7), 1.0, -1.0)
    weather = relaxator(n, float(np.exp(-1 / (600 * step_rate))), rng.uniform(0.5, 2.0) ** 2, rng)
    return 22 + switching + weather


def box(ambient: Array, step_rate: float, heating: float, time_constant: float) -> Array:
    """Temperature inside, from power-on: `heating` K above the room in the end, `time_constant` in s."""
    return lagged(ambient + heating, time_constant * step_rate, start=float(ambient[0]))


def warm_up(n: int, step_rate: float, time_constant: float) -> Array:
    """Departure from the settled state after power-on, 1 at the start; `time_constant` in s."""
    return 1 - lagged(np.ones(n), time_constant * step_rate, start=0.0)


def thermometer(temperature: Array, rng: np.random.Generator, noise: float = 0.01) -> Array:
    """What the sensor's own thermometer reports, in Celsius."""
    return temperature + noise * rng.standard_normal(len(temperature))
