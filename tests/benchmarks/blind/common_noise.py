"""Noise that is not Gaussian, or not steady, alike in recording and simulation: nothing is missing there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .analog import Base, relaxator, relaxator_bank
from .converter import round_to_lattice

Array = NDArray[np.float64]
Noise = Callable[[tuple[int, int], np.random.Generator], Array]
OUTLIERS, HEIGHT = 2e-4, 10.0  # share of the samples that are hit, and by how many standard deviations
BURST, BURSTS, LOUDER = 20, 1e-3, 3.0  # samples of a burst, of which so many begin per sample; factor on the deviation


def student(freedom: float) -> Noise:
    """Student's law, of variance one."""
    return lambda shape, rng: rng.standard_t(freedom, shape) * math.sqrt((freedom - 2) / freedom)


def laplace(shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Laplace's law, of variance one."""
    return rng.laplace(0, math.sqrt(0.5), shape)


def wandering(time_constant: float) -> Noise:
    """Gaussian noise whose log variance wanders, standard deviation 1/2, alike in all sensors."""

    def noise(shape: tuple[int, int], rng: np.random.Generator) -> Array:
        course = relaxator(shape[-1], math.exp(-1 / time_constant), 0.25, rng)
        return np.exp(course / 2 - 0.0625) * rng.standard_normal(shape)

    return noise


def bursts(shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Gaussian noise with short loud stretches, in each sensor at times of its own."""
    starts = rng.uniform(size=shape) < BURSTS
    loud = starts.copy()
    for lag in range(1, BURST):
        loud[:, lag:] |= starts[:, :-lag]
    return np.where(loud, LOUDER, 1.0) * rng.standard_normal(shape)


def spiky(shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Gaussian noise with outliers of either sign."""
    hit = rng.uniform(size=shape) < OUTLIERS
    return rng.standard_normal(shape) + hit * HEIGHT * rng.choice([-1.0, 1.0], shape)


LAWS: dict[str, Noise] = {
    "t5": student(5),
    "t8": student(8),
    "laplace": laplace,
    "wandering_fast": wandering(200),
    "wandering_slow": wandering(2000),
    "bursts": bursts,
    "spiky": spiky,
    "flicker": lambda shape, rng: rng.standard_normal(shape),  # whose 1/f part is added below
    "rounded": lambda shape, rng: rng.standard_normal(shape),  # and rounded below
}


def simulated(law: str, base: Base, n: int, rng: np.random.Generator) -> Array:
    """One side's record (sensor, n): white noise of that law, and the base's slow noise."""
    sigma = np.sqrt(base.white)[:, None]
    signal = replace(base, white=0 * base.white).simulate(n, rng)
    signal = signal + sigma * LAWS[law]((len(base.white), n), rng)
    if law == "flicker":
        taus = np.geomspace(2, 1e5, 12)  # samples, whatever the record's length: the same noise on both sides
        signal = signal + 0.3 * sigma * np.stack([relaxator_bank(n, taus, np.ones(12) / 12, rng) for _ in signal])
    if law == "rounded":
        # The step is the noise's own size, and each record begins somewhere else on the lattice.
        signal = round_to_lattice(signal + sigma * rng.uniform(size=sigma.shape), sigma)
    return signal
