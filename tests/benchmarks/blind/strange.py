"""Effects outside the catalogue, and effects that no one could identify."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from . import clock, thermal
from .analog import relaxator
from .bench import Bench, Part, quantity, rms
from .likelihood import quadratic_null, solve
from .marginal import innovations
from .shapes import vibration_tone

Array = NDArray[np.float64]


def chirp(bench: Bench, nats: float) -> Part:
    """A sweep over most of the band. Nats: half the whitened energy."""
    sensors = bench.some_sensors(3)
    t = np.arange(bench.steps) / bench.steps
    low, high = 0.05 * bench.rate, 0.42 * bench.rate
    phase = 2 * np.pi * bench.duration * (low * t + (high - low) * t**2 / 2)
    unit = bench.gains(sensors)[:, None] * bench.sampled(np.cos(phase + bench.rng.uniform(0, 2 * np.pi)))
    return bench.shape("chirp", nats, unit, known=True)[0]


def hysteresis(bench: Bench, nats: float) -> Part:
    """A bias that remembers from which side its temperature came: a relay with two thresholds. Nats as for a signal.

    Turned only once it is a step, and nothing tells otherwise.
    """
    sensors = bench.some_sensors(2)
    inside = thermal.box(thermal.room(bench.n, bench.rate, bench.rng), bench.rate, 5.0, 30.0)
    low, high = np.quantile(inside, [0.35, 0.65])
    turned = np.where(inside > high, 1.0, np.where(inside < low, -1.0, 0.0))
    last = np.maximum.accumulate(np.where(turned != 0, np.arange(bench.n), 0))
    path = np.where(turned[last] == 0, -1.0, turned[last])
    alike = ("step",) if np.count_nonzero(np.diff(path)) == 1 else ()
    return bench.shape(
        "hysteresis", nats, bench.gains(sensors)[:, None] * path, known=True, channel="temperature",
        channels={"temperature": thermal.thermometer(inside, bench.rng)}, look_alikes=alike,
    )[0]  # fmt: skip


def laplace_noise(bench: Bench, nats: float) -> Part:
    """White noise of the right level, part of it Laplace. Nats: n sensors KL of the marginal law, by quadrature."""
    sensors = bench.some_sensors(2)
    x = np.linspace(-14, 14, 2**12, endpoint=False) + 14 / 2**12
    width = x[1] - x[0]

    def density(share: float) -> Array:
        """Of N(0, 1 - share) + Laplace of variance `share`, through the characteristic function."""
        u = 2 * np.pi * np.fft.fftfreq(len(x), width)
        transform = np.exp(-(1 - share) * u**2 / 2) / (1 + share * u**2 / 2)
        return np.maximum(np.fft.fftshift(np.fft.fft(transform).real) / (len(x) * width), 1e-30)

    grid = np.fft.fftshift(np.fft.fftfreq(len(x), 1 / (len(x) * width)))
    normal = norm.pdf(grid)

    def expected(share: float) -> float:
        d = density(share)
        inside = np.abs(grid) < 11  # beyond, the normal density drowns in rounding
        return bench.n * len(sensors) * width * float(np.sum((d * np.log(d / np.maximum(normal, 1e-30)))[inside]))

    share = solve(nats, expected, 0.004, 0.99)
    log_ratio = np.log(density(share) / np.maximum(normal, 1e-30))
    white = bench.base.white.copy()
    white[list(sensors)] *= 1 - share
    signal = np.zeros((bench.n_sensors, bench.n))
    heavy = bench.rng.laplace(0, math.sqrt(share / 2), (len(sensors), bench.n))
    signal[list(sensors)] = bench.sigma[list(sensors), None] * heavy

    def llr(recording: Array) -> float:
        e = innovations(recording, bench.spectrum)[list(sensors)]
        return float(np.interp(e, grid, log_ratio).sum())

    return Part(
        "scale_mixture",
        nats,
        sensors,
        llr,
        signal=signal,
        base=replace(bench.base, white=white),
        oracle_law="bound",
        form="laplace",
    )


def modulated_noise(bench: Bench, nats: float, *, slow: bool) -> Part:
    """White noise whose level follows a sine wave of 0.1 to 10 Hz (cyclostationary), or a slow random course.

    Nats: the sum over samples of 1/2 (r - 1 - log r), r the ratio of variances, course known.
    """
    sensors = bench.some_sensors(2)
    t = np.arange(bench.n) / bench.rate
    if slow:
        course = relaxator(bench.n, math.exp(-10 / bench.n), 1.0, bench.rng)
    else:
        course = np.sin(2 * np.pi * (bench.rng.uniform(0.1, 10) * t + bench.rng.uniform()))
    name, alike = ("am_noise", ("variance_change",)) if slow else ("variance_change", ())
    part = noise_of_level(bench, name, nats, sensors, course, look_alikes=alike)
    return part if slow else replace(part, form="periodic")


def bursts_of_noise(bench: Bench, nats: float) -> Part:
    """White noise that is louder at random, for some tens of samples at a time: a bad contact, something that fires."""
    sensors = bench.some_sensors(2)
    length = bench.rng.uniform(6, 120)
    lengths = bench.rng.exponential((length, length * bench.rng.uniform(2, 10)), (bench.n, 2)) + 1
    ends = np.cumsum(lengths.ravel())
    on = (np.searchsorted(ends, np.arange(bench.n), side="right") % 2 == 0).astype(float)
    return replace(noise_of_level(bench, "variance_change", nats, sensors, on), form="bursts of noise")


def noise_of_level(
    bench: Bench,
    mechanism: str,
    nats: float,
    sensors: tuple[int, ...],
    course: Array,
    look_alikes: tuple[str, ...] = (),
) -> Part:
    """White noise whose log variance follows a `course` (time,), to the depth worth `nats`; its mean is kept."""

    def ratio(depth: float) -> Array:
        r = np.exp(depth * course)
        return r / r.mean()

    def expected(depth: float) -> float:
        r = ratio(depth)
        return len(sensors) * float(np.sum(r - 1 - np.log(r))) / 2

    r = ratio(solve(nats, expected, 1e-4, 8.0))
    white = bench.base.white.copy()
    white[list(sensors)] = 0.0
    signal = np.zeros((bench.n_sensors, bench.n))
    noise = bench.rng.standard_normal((len(sensors), bench.n))
    signal[list(sensors)] = bench.sigma[list(sensors), None] * np.sqrt(r) * noise

    def llr(recording: Array) -> float:
        e = innovations(recording, bench.spectrum)[list(sensors)]
        return float((e**2 * (1 - 1 / r) - np.log(r)).sum() / 2)

    return Part(
        mechanism,
        nats,
        sensors,
        llr,
        oracle_null=quadratic_null(np.tile(r, len(sensors))),
        signal=signal,
        base=replace(bench.base, white=white),
        sensor_nats=(nats / len(sensors),) * len(sensors),
        look_alikes=look_alikes,
    )


def lost_samples(bench: Bench, nats: float) -> Part:
    """The bus loses some samples of what is white noise to all practical purposes, and closes the gaps."""
    everyone = tuple(range(bench.n_sensors))
    count = int(bench.rng.integers(20, 200))
    at = np.zeros(bench.n, dtype=bool)
    at[bench.rng.choice(np.arange(bench.n // 10, bench.n), count, replace=False)] = True
    tail = bench.rng.standard_normal((bench.n_sensors, count)) * bench.sigma[:, None]

    def convert(x: Array) -> Array:
        more = x.mean(axis=1, keepdims=True) + tail
        return clock.lose(np.concatenate([x, more], axis=1), np.append(at, np.zeros(count, bool)), bench.n)

    return Part("not_identifiable", 0.0, everyone, lambda recording: 0.0, converter=convert)


def alias(bench: Bench, nats: float) -> Part:
    """A rotor above the Nyquist frequency, whose image the simulator has as a line of its own, amplitude and all.

    Only the true frequency differs, f + k fs against f: nothing in the samples tells them apart.
    """
    drawn = vibration_tone(bench, nats)
    assert drawn.signal is not None
    assert drawn.frequency_hz is not None
    nu = drawn.frequency_hz / bench.rate
    t, image = np.arange(bench.n), int(bench.rng.integers(1, 4))
    basis = np.stack([np.cos(2 * np.pi * nu * t), np.sin(2 * np.pi * nu * t)], axis=1)
    inside = np.linalg.lstsq(basis, drawn.signal.T, rcond=None)[0]

    def with_line(simulated: Array) -> Array:
        s = np.arange(simulated.shape[-1])
        line = np.stack([np.cos(2 * np.pi * nu * s), np.sin(2 * np.pi * nu * s)], axis=1) @ inside
        return simulated + line.T

    amplitude = np.hypot(*inside[:, list(drawn.sensors)])
    return Part(
        "not_identifiable",
        0.0,
        drawn.sensors,
        lambda recording: 0.0,
        signal=drawn.signal,
        look_alikes=("vibration_tone",),
        frequency_hz=drawn.frequency_hz,
        simulation=with_line,
        parameters={
            "true_frequency": quantity(drawn.frequency_hz + image * bench.rate, "Hz"),
            "amplitude": quantity(rms(amplitude), "deg/s", amplitude),
        },
    )
