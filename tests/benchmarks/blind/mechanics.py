"""What moves: rotors, structures that ring, and the acceleration that an accelerometer beside the gyroscopes sees."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from .analog import relaxator

Array = NDArray[np.float64]


def rotor_phase(n: int, frequency: float, wander: float, time_constant: float, rng: np.random.Generator) -> Array:
    """Phase in rad of a rotor whose speed wanders.

    Args:
        n: Steps.
        frequency: Cycles per step.
        wander: Standard deviation of the frequency, cycles per step; 0 for a governed rotor.
        time_constant: Of the wander, in steps.
        rng: Random numbers.
    """
    speed = np.full(n, frequency)
    if wander > 0:
        speed += relaxator(n, math.exp(-1 / time_constant), wander**2, rng)
    return 2 * np.pi * (rng.uniform() + np.cumsum(speed))


def resonator_taps(frequency: float, quality: float) -> tuple[list[float], list[float]]:
    """Numerator and denominator of a second-order resonator, by its poles; `frequency` in cycles per step."""
    radius = math.exp(-math.pi * frequency / quality)
    return [1.0], [1.0, -2 * radius * math.cos(2 * math.pi * frequency), radius**2]


def resonator_spectrum(nu: Array, frequency: float, quality: float) -> Array:
    """Two-sided spectrum per step of the resonator driven by white noise, variance 1."""
    _, (_, a1, a2) = resonator_taps(frequency, quality)
    z = np.exp(-2j * np.pi * nu)
    spectrum = 1 / np.abs(1 + a1 * z + a2 * z**2) ** 2
    variance = (1 + a2) / ((1 - a2) * ((1 + a2) ** 2 - a1**2))
    return spectrum / variance


def resonator(n: int, frequency: float, quality: float, rng: np.random.Generator) -> Array:
    """A structure driven by noise, variance 1, in its stationary state."""
    numerator, denominator = resonator_taps(frequency, quality)
    a1, a2 = denominator[1:]
    variance = (1 + a2) / ((1 - a2) * ((1 + a2) ** 2 - a1**2))
    lead = int(5 * quality / (math.pi * frequency)) + 1
    return lfilter(numerator, denominator, rng.standard_normal(n + lead))[lead:] / math.sqrt(variance)


def floor_vibration(n: int, step_rate: float, rng: np.random.Generator) -> Array:
    """Acceleration (3, n) in g of a machine's foundation: broad modes at 5 to 40 Hz, gravity on the last axis."""
    acceleration = np.zeros((3, n))
    for axis in range(3):
        for _ in range(3):
            frequency = rng.uniform(5, 40) / step_rate
            acceleration[axis] += rng.uniform(0.01, 0.05) * resonator(n, frequency, rng.uniform(1, 4), rng)
    acceleration[2] += 1.0
    return acceleration
