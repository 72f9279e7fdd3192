"""The bench: one array on the table, and what an effect does to it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .analog import OVERSAMPLING, Base
from .converter import decimate
from .likelihood import OutOfReachError, coefficients, distinct_nats, divergence, shape_llr, solve, whitened_energy

Array = NDArray[np.float64]
Cumulants = tuple[float, float, float]
CERTAIN = 1e6  # nats that stand for certainty, where a single altered sample proves the effect
SEPARABLE = 5.0  # nats below which two explanations cannot be told apart


@dataclass(frozen=True)
class Part:
    """One effect on one recording, and what is true of it.

    The effect acts by `signal`, added to the sampled output; by `analog`, on the oversampled signal before the
    converter; by `converter`, on the numbers after it; or through `base`, the physics that the recording has instead of
    the simulated one. `llr` gives the oracle's log likelihood ratio from the recording free of all other parts.
    """

    mechanism: str
    nats: float
    sensors: tuple[int, ...]
    llr: Callable[[Array], float]
    signal: Array | None = None
    analog: Callable[[Array], Array] | None = None
    converter: Callable[[Array], Array] | None = None
    base: Base | None = None
    look_alikes: tuple[str, ...] = ()
    sensor_nats: tuple[float, ...] = ()
    affected: list[int] | None = None  # those of `sensors` that it turned out to touch; None: all
    oracle_law: str = "cumulants"
    oracle_nats: float | None = None  # expected `llr`; None: `nats`
    oracle_null: Cumulants | None = None  # under the base; None: those of a known signal
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    frequency_hz: float | None = None
    frequency_sd_hz: float | None = None
    time_s: float | None = None
    onset_sd_s: float | None = None
    channel: str | None = None
    channels: dict[str, Array] = field(default_factory=dict)
    simulation: Callable[[Array], Array] | None = None
    form: str | None = None  # where it is not that of any equation


class Bench:
    """An array, its length and the random numbers of the effect."""

    def __init__(
        self,
        base: Base,
        n_samples: int,
        rng: np.random.Generator,
        share: float = math.inf,
        reach: str | None = None,
    ) -> None:
        """`share`: length of the simulation over that of the recording, infinite for a model.

        `reach`: how many of the sensors an effect is in, "one", "some" or "all"; None where it draws them itself.
        """
        self.base, self.n, self.rng, self.share, self.reach = base, n_samples, rng, share, reach
        self.rate = base.rate
        self.n_sensors = len(base.white)
        self.steps, self.step_rate = OVERSAMPLING * n_samples, OVERSAMPLING * base.rate
        self.duration = n_samples / base.rate
        self.components = base.components(n_samples)
        self.spectrum: Array = np.sum(self.components, axis=0)

    @property
    def sigma(self) -> Array:
        """Standard deviation of the white noise per sensor."""
        return np.sqrt(self.base.white)

    def some_sensors(self, least: int = 1, most: int | None = None, *, shared: bool = False) -> tuple[int, ...]:
        """A random set of sensors, all of them included among the choices; of an effect that is `shared`, two or more.

        Raises:
            OutOfReachError: A single sensor shares nothing.
        """
        if shared and self.n_sensors < 2:
            raise OutOfReachError("expected two sensors or more for an effect that sensors share, got one")
        most = min(most or self.n_sensors, self.n_sensors)
        least = min(least, most)
        if self.reach == "one":
            least = most = 2 if shared else 1
        elif self.reach == "all":
            least = most
        count = int(self.rng.integers(least, most + 1))
        return tuple(sorted(int(i) for i in self.rng.choice(self.n_sensors, count, replace=False)))

    def gains(self, sensors: tuple[int, ...], *, signed: bool = True) -> Array:
        """(sensor,) of like sizes, zero where the effect is not."""
        gains = np.zeros(self.n_sensors)
        sign = self.rng.choice([-1.0, 1.0], len(sensors)) if signed else 1.0
        gains[list(sensors)] = sign * self.rng.uniform(0.8, 1.25, len(sensors))
        return gains

    def sampled(self, analog: Array) -> Array:
        """What the converter makes of an oversampled signal."""
        return decimate(analog, OVERSAMPLING)

    def shape(
        self, mechanism: str, nats: float, unit: Array, *, known: bool = False, **truth: Any
    ) -> tuple[Part, float]:
        """A signal of a given shape, at the size where it is worth `nats`; and that size.

        These are the divergence of its spectrum, or where a channel or few numbers make the shape `known`, half its
        whitened energy.
        """
        power = coefficients(unit) ** 2
        size = math.sqrt(2 * nats / float((power / self.spectrum).sum()))

        def worth(size: float) -> Array:
            return divergence(self.spectrum + size**2 * power, self.spectrum)

        if not known:
            size = solve(nats, lambda x: float(worth(x).sum()), 0.5 * size, 1e3 * size)
        signal = size * unit
        energy = whitened_energy(signal, self.spectrum)
        each = energy / 2 if known else worth(size)
        sensors = tuple(int(i) for i in np.flatnonzero(np.any(unit, axis=1)))
        part = Part(
            mechanism,
            nats,
            sensors,
            lambda recording: shape_llr(recording, signal, self.spectrum),
            signal=signal,
            oracle_nats=float(energy.sum()) / 2,
            sensor_nats=tuple(float(each[i]) for i in sensors),
            **truth,
        )
        return part, size

    def frequency_sd(self, tone: Array) -> float:
        """Cramer-Rao standard deviation in Hz of a tone (sensor, time) with unknown phases."""
        energy = float(whitened_energy(tone, self.spectrum).sum())  # sum over sensors of a^2 T/(2 S)
        return self.rate / (2 * math.pi) * math.sqrt(12 / energy) / self.n

    def looks_like_parameters(self, after: Array) -> bool:
        """Whether free parameters of the base come within five nats of a spectrum."""
        slower = replace(self.base, phi=self.base.phi**0.9, variance=self.base.variance * self._corner_change(0.9))
        free = [*self.components, *(b - a for a, b in zip(self.components, slower.components(self.n), strict=True))]
        directions = [d / self.spectrum for d in free if np.any(d)]
        return self.distinct(after, directions) < SEPARABLE

    def distinct(self, after: Array, directions: list[Array]) -> float:
        """`distinct_nats` from the base, of which a simulation tells as much as its length allows."""
        return distinct_nats(after, self.spectrum, directions) / (1 + 1 / self.share)

    def _corner_change(self, power: float) -> Array:
        """Change of the innovation variance that leaves an AR1's level at low frequency where it was."""
        return (1 - self.base.phi**power) ** 2 / (1 - self.base.phi) ** 2

    def rivals(self, signal: Array, courses: dict[str, Array]) -> tuple[str, ...]:
        """What comes within five nats of a known signal: other courses of time, or other parameters of the noise.

        `courses` maps a mechanism to its possible courses (course, time), their size free at each sensor.
        """
        sensors = np.flatnonzero(np.any(signal, axis=1))
        m = coefficients(signal[sensors]) / np.sqrt(self.spectrum[sensors])
        energy = float((m**2).sum())
        names = []
        for name, course in courses.items():
            transformed = coefficients(course)
            explained = np.zeros(len(course))
            for i, sensor in enumerate(sensors):
                white = transformed / np.sqrt(self.spectrum[sensor])
                explained += (white @ m[i]) ** 2 / (white**2).sum(axis=1)
            if (energy - explained.max()) / 2 < SEPARABLE:
                names.append(name)
        if energy / 2 - self._explained_by_noise(signal, sensors) < SEPARABLE:
            names.append("parameter_shift")
        return tuple(names)

    def _explained_by_noise(self, signal: Array, sensors: NDArray[np.int64]) -> float:
        """Nats of a known signal that one louder component of the base takes, the best at each sensor."""
        power = coefficients(signal)
        total = 0.0
        for sensor in sensors:
            before = self.spectrum[sensor]
            expected = before + power[sensor] ** 2
            gains = [0.0]
            for component in self.components:
                for factor in (1.5, 3.0, 10.0, 30.0, 100.0, 1000.0):
                    after = before + (factor - 1) * component[sensor]
                    gains.append(float((expected / before - expected / after - np.log(after / before)).sum() / 2))
            total += max(gains)
        return total


def quantity(value: float, unit: str, per_sensor: Array | None = None) -> dict[str, Any]:
    """A true parameter: one number for the array, and one for each affected sensor where they differ."""
    entry: dict[str, Any] = {"value": float(value), "unit": unit}
    if per_sensor is not None:
        entry["per_sensor"] = [float(v) for v in per_sensor]
    return entry


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
