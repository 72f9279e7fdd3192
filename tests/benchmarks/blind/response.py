"""A response to rates that is no straight line, or another one at every second sample: sizes by simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray
from scipy.fft import idct

from .bench import Bench, Part, quantity, rms
from .likelihood import coefficients, solve

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Response:
    """A rising curve of strength `c` in units of a rate, its inverse, and the slope of that."""

    put_out: Callable[[Array, float], Array]
    felt: Callable[[Array, float], Array]
    slope: Callable[[Array, float], Array]
    most: float


def _unequal(x: Array, c: float) -> Array:
    """Another gain on one side than on the other."""
    return x + c * (np.sqrt(1 + x**2) - 1)


def _unequal_felt(y: Array, c: float) -> Array:
    k = y + c
    return (k - c * np.sqrt(k**2 + 1 - c**2)) / (1 - c**2)


RESPONSES = {
    "unequal": Response(
        _unequal, _unequal_felt,
        lambda y, c: (1 - c * (y + c) / np.sqrt((y + c) ** 2 + 1 - c**2)) / (1 - c**2),
        0.9,
    ),
    "saturating": Response(
        lambda x, c: np.arcsinh(c * x) / c, lambda y, c: np.sinh(c * y) / c, lambda y, c: np.cosh(c * y), 5.0
    ),
    "expanding": Response(
        lambda x, c: np.sinh(c * x) / c, lambda y, c: np.arcsinh(c * y) / c, lambda y, c: 1 / np.sqrt(1 + (c * y) ** 2),
        0.8,
    ),
}  # fmt: skip


def nonlinearity(bench: Bench, nats: float) -> Part:
    """A scale that is bent; nats: the mean log likelihood ratio of what was felt, with the slope of the curve."""
    sensors = list(bench.some_sensors(1))
    form = str(bench.rng.choice(list(RESPONSES)))
    response = RESPONSES[form]
    middle, (draws, root) = bench.base.bias[sensors, None], _noise(bench, sensors)
    spread = draws.std(axis=1, keepdims=True)

    def ratio(y: Array, c: float) -> Array:
        """Log likelihood ratio of what a sensor puts out, over its spread, `(sensor, time)` -> `(sensor,)`."""
        energies = [((coefficients(x * spread) / root) ** 2).sum(axis=1) / 2 for x in (y, response.felt(y, c))]
        return energies[0] - energies[1] + np.log(response.slope(y, c)).sum(axis=1)

    def each(c: float) -> Array:
        return ratio(response.put_out(draws / spread, c), c)

    strength = solve(nats, lambda c: float(each(c).sum()), 1e-3, response.most)

    def convert(signal: Array) -> Array:
        out = signal.copy()
        out[sensors] = middle + spread * response.put_out((signal[sensors] - middle) / spread, strength)
        return out

    u, weight = hermegauss(60)
    weight = weight / weight.sum()
    y = response.put_out(u, strength)
    rise, square, cube = (float((weight * y * he).sum()) for he in (u, (u**2 - 1) / 2, (u**3 - 3 * u) / 6))
    quadratic, cubic = (own / rise / spread[:, 0] ** power for own, power in ((square, 1), (cube, 2)))
    return Part(
        "nonlinearity",
        nats,
        tuple(sensors),
        lambda recording: float(ratio((recording[sensors] - middle) / spread, strength).sum()),
        converter=convert,
        oracle_law="bound",
        # White noise behind a bent scale is white noise of another law; what is slow in it says which it is.
        look_alikes=("scale_mixture", "parameter_shift") if form == "expanding" else (),
        sensor_nats=tuple(each(strength).tolist()),
        parameters={
            "quadratic": quantity(rms(quadratic), "/(deg/s)", quadratic),
            "cubic": quantity(rms(cubic), "/(deg/s)^2", cubic),
        },
    )


def interleaved_gain(bench: Bench, nats: float) -> Part:
    """Two converters take turns, and the gain of one is off; nats: the mean log likelihood ratio without it."""
    sensors = list(bench.some_sensors(1))
    middle, (draws, root) = bench.base.bias[sensors, None], _noise(bench, sensors)
    odd = np.arange(bench.n) % 2 == 1
    sign = bench.rng.choice([-1.0, 1.0])

    def factors(size: float) -> Array:
        return np.where(odd, np.exp(sign * size), 1.0)

    def ratio(y: Array, size: float) -> Array:
        """Log likelihood ratio of what a sensor puts out, `(sensor, time)` -> `(sensor,)`."""
        energies = [((coefficients(x) / root) ** 2).sum(axis=1) / 2 for x in (y, y / factors(size))]
        return energies[0] - energies[1] - np.log(factors(size)).sum()

    strength = solve(nats, lambda size: float(ratio(draws * factors(size), size).sum()), 1e-4, 1.5)

    def convert(signal: Array) -> Array:
        out = signal.copy()
        out[sensors] = middle + (signal[sensors] - middle) * factors(strength)
        return out

    return Part(
        "interleaving",
        nats,
        tuple(sensors),
        lambda recording: float(ratio(recording[sensors] - middle, strength).sum()),
        converter=convert,
        oracle_law="bound",
        sensor_nats=tuple(ratio(draws * factors(strength), strength).tolist()),
        frequency_hz=bench.rate / 2,
        parameters={"gain_ratio": quantity(float(np.exp(sign * strength)), "")},
    )


def _noise(bench: Bench, sensors: list[int]) -> tuple[Array, Array]:
    """A draw of the noise of some sensors, and the root of its spectrum."""
    root = np.sqrt(bench.spectrum[sensors])
    ordinates = bench.rng.standard_normal((len(sensors), bench.n - 1)) * root
    return idct(np.concatenate([np.zeros((len(sensors), 1)), ordinates], axis=1), norm="ortho", axis=-1), root
