"""The sensor before its converter: noise in continuous time, eight times oversampled.

White noise, Ornstein-Uhlenbeck relaxators and a random walk run at `OVERSAMPLING` times the output rate; the converter
averages them over each sample (integrate and dump), which leaves white noise exactly white. The user's simulator is
a separate thing: the discrete processes, at the output rate, with random numbers of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from .likelihood import ar1_spectrum, grid

Array = NDArray[np.float64]
OVERSAMPLING = 8


@dataclass(frozen=True)
class Base:
    """Parameters of the noise per sensor, in the discrete terms that a simulator uses.

    `white` (sensor,), `phi` and `variance` (sensor, relaxator) of AR1 processes, `walk` (sensor,), `bias` (sensor,) in
    deg/s, which the simulator does not know, `rate` in Hz.
    """

    white: Array
    phi: Array
    variance: Array
    walk: Array
    bias: Array
    rate: float

    def copies(self, sensor: int, count: int) -> Base:
        """An array of `count` sensors that are all like one."""
        rows = np.full(count, sensor)
        return Base(self.white[rows], self.phi[rows], self.variance[rows], self.walk[rows], self.bias[rows], self.rate)

    def spectrum(self, n_samples: int) -> Array:
        """(sensor, n_samples - 1) on the grid of the DCT-II."""
        return np.sum(self.components(n_samples), axis=0)

    def components(self, n_samples: int) -> list[Array]:
        """White noise, each AR1 and random walk apart."""
        f = grid(n_samples)
        walk = self.walk[:, None] / (4 * np.sin(np.pi * f) ** 2)
        relaxators = [
            ar1_spectrum(f, phi[:, None], variance[:, None])
            for phi, variance in zip(self.phi.T, self.variance.T, strict=True)
        ]
        return [np.broadcast_to(self.white[:, None], walk.shape), *relaxators, walk]

    def terms(self) -> list[list[list[Any]]]:
        """The simulator's dictionary entry per sensor: [name, parameters] of each process."""
        return [
            [
                ["white_noise", {"variance": float(self.white[i])}],
                *(
                    ["ar1", {"phi": float(p), "variance": float(v)}]
                    for p, v in zip(self.phi[i], self.variance[i], strict=True)
                ),
                ["random_walk", {"variance": float(self.walk[i])}],
            ]
            for i in range(len(self.white))
        ]

    def analog(self, n_samples: int, rng: np.random.Generator) -> Array:
        """(sensor, OVERSAMPLING n_samples) of the continuous-time physics, bias included."""
        n = OVERSAMPLING * n_samples
        signal = rng.standard_normal((len(self.white), n)) * np.sqrt(OVERSAMPLING * self.white)[:, None]
        for i in range(len(self.white)):
            for phi, variance in zip(self.phi[i], self.variance[i], strict=True):
                signal[i] += relaxator(n, phi ** (1 / OVERSAMPLING), variance / (1 - phi**2), rng)
            steps = rng.standard_normal(n) * math.sqrt(self.walk[i] / OVERSAMPLING)
            signal[i] += self.bias[i] + np.cumsum(steps)
        return signal

    def simulate(self, n_samples: int, rng: np.random.Generator) -> Array:
        """(sensor, n_samples) of the user's simulator: the discrete processes, no bias."""
        shape = (len(self.white), n_samples)
        signal = rng.standard_normal(shape) * np.sqrt(self.white)[:, None]
        for i in range(len(self.white)):
            for phi, variance in zip(self.phi[i], self.variance[i], strict=True):
                signal[i] += relaxator(n_samples, phi, variance / (1 - phi**2), rng)
            signal[i] += np.cumsum(rng.standard_normal(n_samples) * math.sqrt(self.walk[i]))
        return signal


def relaxator(n: int, phi: float, variance: float, rng: np.random.Generator) -> Array:
    """Ornstein-Uhlenbeck process of stationary `variance`, exact at its samples, started in its stationary law."""
    kicks = rng.standard_normal(n) * math.sqrt(variance * (1 - phi**2))
    kicks[0] = rng.standard_normal() * math.sqrt(variance)
    return lfilter([1.0], [1.0, -phi], kicks)


def relaxator_bank(n: int, time_constants: Array, variances: Array, rng: np.random.Generator) -> Array:
    """Sum of relaxators: equal variances at log-spaced time constants (in steps) give 1/f noise, others 1/f^a."""
    total = np.zeros(n)
    for tau, variance in zip(time_constants, variances, strict=True):
        total += relaxator(n, math.exp(-1 / tau), variance, rng)
    return total


def bank_spectrum(f: Array, time_constants: Array, variances: Array) -> Array:
    """Spectrum per step of `relaxator_bank`."""
    phi = np.exp(-1 / time_constants)
    return np.sum(
        [ar1_spectrum(f, float(p), float(v * (1 - p**2))) for p, v in zip(phi, variances, strict=True)], axis=0
    )


def consumer_base(rng: np.random.Generator, rate: float, n_sensors: int = 6, relaxators: int | None = None) -> Base:
    """An array of consumer MEMS gyroscopes: alike, not equal.

    Noise density 0.005 to 0.014 deg/s/sqrt(Hz); bias floor of 3 to 30 deg/h by one or two relaxators of 0.1 to 60 s;
    a random walk that overtakes them at the end of some minutes; a turn-on bias of some 0.1 deg/s.
    """

    def spread(n: int, share: float) -> Array:
        return np.exp(share * rng.standard_normal((n_sensors, n)))

    density = rng.uniform(0.005, 0.014)
    white = rate * (density * spread(1, 0.1)[:, 0]) ** 2
    count = int(rng.integers(1, 3)) if relaxators is None else relaxators
    # the slower the relaxator, the smaller it is: all stand out of the white noise by a like amount
    taus = np.array([rng.uniform(5, 60), rng.uniform(0.1, 1.0)])[:count] * spread(count, 0.2)
    excess = rng.uniform(0.5, 8.0, count) * spread(count, 0.3)  # spectrum of the relaxator at 0 over white
    phi = np.exp(-1 / (rate * taus))
    walk_corner = rng.uniform(0.002, 0.01)  # Hz, where the walk equals the white noise
    walk = white * (2 * np.pi * walk_corner / rate) ** 2
    return Base(white, phi, excess * white[:, None] * (1 - phi) ** 2, walk, 0.1 * rng.standard_normal(n_sensors), rate)
