"""Effects that the spectrum does not show: their size is worked out from the law of single samples or by simulation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import idct
from scipy.stats import norm

from . import clock, converter
from .analog import OVERSAMPLING
from .bench import CERTAIN, Bench, Cumulants, Part, quantity, rms
from .likelihood import OutOfReachError, coefficients, quadratic_null, solve

Array = NDArray[np.float64]
Convert = Callable[[Array], Array]
MOST_CLIPPED = 0.2  # share of the samples at either end: a front end that clips more is not in use
MOST_REPEATED = 0.3  # share of the samples: a bus that repeats more carries no signal


def innovations(recording: Array, spectrum: Array) -> Array:
    """The recording whitened without a shift of time: standard normal (sensor, time) under the base."""
    white = coefficients(recording) / np.sqrt(spectrum)
    return idct(np.concatenate([np.zeros((len(white), 1)), white], axis=1), norm="ortho", axis=-1)


def spikes(bench: Bench, nats: float, *, simultaneous: bool | None = None) -> Part:
    """Isolated outliers of one height: a shock hits several sensors at once, a bus fault one at a time.

    The oracle knows rate and height, not the epochs. The nats are n E1[log L + 1/L - 1], L the likelihood ratio of one
    sample (the two added terms cancel in the mean and take out the variance), by simulation with fixed draws.
    """
    sensors = bench.some_sensors(2)
    together = bool(bench.rng.integers(2)) if simultaneous is None else simultaneous
    share = bench.rng.uniform(20, 60) / bench.n
    count = len(sensors) if together else 1

    def log_ratio(e: Array, height: float) -> Array:
        """(sensor, sample) innovations to the log ratio per sample, of all sensors together."""
        gain = np.logaddexp(height * e, -height * e) - math.log(2) - height**2 / 2
        if together:
            return np.logaddexp(math.log1p(-share), math.log(share) + gain.sum(axis=0))
        return np.logaddexp(math.log1p(-share), math.log(share) + gain).sum(axis=0)

    quiet, hit = bench.rng.standard_normal((count, 40_000)), bench.rng.standard_normal((count, 8_000))

    def expected(height: float) -> float:
        ratios = [log_ratio(quiet, height), log_ratio(hit + height, height)]
        means = [float(np.mean(r + np.exp(-r) - 1)) for r in ratios]
        per_sample = (1 - share) * means[0] + share * means[1]
        return per_sample * bench.n * (1 if together else len(sensors))

    height = solve(nats, expected, 0.05, 60.0)
    at = np.zeros((1 if together else len(sensors), bench.n), dtype=bool)
    for row in at:  # as many as expected: their number would scatter the size
        row[bench.rng.choice(bench.n, round(share * bench.n), replace=False)] = True
    signs = bench.rng.choice([-1.0, 1.0], (len(sensors), bench.n))
    signal = np.zeros((bench.n_sensors, bench.n))
    signal[list(sensors)] = at * signs * height * bench.sigma[list(sensors), None]
    heights = height * bench.sigma[list(sensors)]
    return Part(
        "spikes",
        nats,
        sensors,
        lambda recording: float(log_ratio(innovations(recording, bench.spectrum)[list(sensors)], height).sum()),
        signal=signal,
        # a shock is seen in all of its sensors together: what one adds depends on what the others show
        sensor_nats=() if together else (nats / len(sensors),) * len(sensors),
        oracle_law="bound",
        look_alikes=("parameter_shift",) if height < 2 else (),
        parameters={
            "amplitude": quantity(rms(heights), "deg/s", heights),
            "rate": quantity(3600 * share * bench.rate, "1/h"),
        },
    )


def variance_change(bench: Bench, nats: float, *, episodes: int = 1) -> Part:
    """White noise that is louder in episodes. Nats: 1/2 (r - 1 - log r) for each of its samples there.

    Less, where there are several, what says which of so many places are theirs: that nobody is told.
    """
    sensors, unknown = bench.some_sensors(2), 0.0
    if episodes == 1:
        length = int(bench.rng.uniform(0.1, 0.4) * bench.n)
        starts = np.array([int(bench.rng.uniform(0.1, 0.5) * bench.n)])
    else:
        length = max(int(0.15 * bench.n / episodes), 8)
        places = bench.n // (2 * length) - 1
        starts = np.sort(bench.rng.choice(places, episodes, replace=False)) * 2 * length
        unknown = math.log(math.comb(places, episodes))
    loud = np.zeros(bench.n, dtype=bool)
    for start in starts:
        loud[start : start + length] = True
    per_sample = (nats + unknown) / (len(sensors) * loud.sum())
    ratio = 1 + solve(per_sample, lambda x: (x - math.log1p(x)) / 2, 1e-6, 1e4)
    signal = np.zeros((bench.n_sensors, bench.n))
    extra = bench.sampled(math.sqrt(OVERSAMPLING) * bench.rng.standard_normal((len(sensors), bench.steps)))
    signal[list(sensors)] = math.sqrt(ratio - 1) * bench.sigma[list(sensors), None] * extra * loud

    def llr(recording: Array) -> float:
        e = innovations(recording, bench.spectrum)[list(sensors)][:, loud]
        return float((e**2 * (1 - 1 / ratio) - math.log(ratio)).sum() / 2) - unknown

    truth = Part(
        "variance_change",
        nats,
        sensors,
        llr,
        oracle_null=quadratic_null(np.full(len(sensors) * int(loud.sum()), ratio)),
        signal=signal,
        sensor_nats=(nats / len(sensors),) * len(sensors),
        parameters={"factor": quantity(ratio, "")},
    )
    if episodes > 1:
        return replace(truth, look_alikes=("spikes",) if length < 64 else (), oracle_law="bound")
    delta = len(sensors) * math.log(ratio) ** 2 / 2
    start_s = float(starts[0] / bench.rate)
    return replace(
        truth,
        time_s=start_s,
        onset_sd_s=math.sqrt(26) / delta / bench.rate,
        parameters=truth.parameters
        | {"start": quantity(start_s, "s"), "stop": quantity(start_s + length / bench.rate, "s")},
    )


def cumulants(values: Array, weights: Array) -> Cumulants:
    """First three cumulants of a discrete law."""
    mean = float(values @ weights)
    return mean, float((values - mean) ** 2 @ weights), float((values - mean) ** 3 @ weights)


def _lattice_log_ratio(y: Array, blur: float) -> Array:
    """log density of y mod 1 (a wrapped normal of sd `blur`) over the uniform one."""
    phase = y - np.round(y)
    total = np.zeros_like(phase)
    for k in range(-3, 4):
        total += norm.pdf(phase + k, scale=blur)
    return np.log(np.maximum(total, 1e-300))


def quantization(bench: Bench, nats: float) -> Part:
    """Rounding that a later digital stage blurs; the level of the white noise is what the simulator expects.

    The less the blur the larger the nats: n sensors E[log f], f the wrapped normal law of the residues.
    """
    sensors = bench.some_sensors(2)
    step = bench.rng.uniform(0.5, 1.2) * float(bench.sigma.mean())
    residues = (np.arange(2000) + 0.5) / 2000

    def expected(sharpness: float) -> float:
        log_ratio = _lattice_log_ratio(residues, 1 / sharpness)
        return bench.n * len(sensors) * float(np.mean(np.exp(log_ratio) * log_ratio))

    blur = 1 / solve(nats, expected, 1 / 0.75, 1 / 0.005)
    white = bench.base.white.copy()
    white[list(sensors)] -= step**2 * (1 / 12 + blur**2)
    noise = blur * step * bench.rng.standard_normal((len(sensors), bench.n))

    def convert(signal: Array) -> Array:
        out = signal.copy()
        out[list(sensors)] = converter.round_to_lattice(signal[list(sensors)], step) + noise
        return out

    null = cumulants(_lattice_log_ratio(residues, blur), np.full(len(residues), 1 / len(residues)))
    count = bench.n * len(sensors)
    return Part(
        "quantization",
        nats,
        sensors,
        lambda recording: float(_lattice_log_ratio(recording[list(sensors)] / step, blur).sum()),
        oracle_null=(count * null[0], count * null[1], count * null[2]),
        converter=convert,
        base=replace(bench.base, white=white),
        sensor_nats=(nats / len(sensors),) * len(sensors),
        parameters={"lsb": quantity(step, "deg/s")},
    )


def _touched(
    mechanism: str, nats: float, sensors: tuple[int, ...], each: Iterable[float], *, converter: Convert, **truth: Any
) -> Part:
    """An effect that one altered sample proves: the nats are the expected number of altered samples, also of `each`.

    A sensor of which no sample was altered is none that it affects.
    """
    altered: list[int] = []

    def watched(signal: Array) -> Array:
        converted = converter(signal)
        altered[:] = np.flatnonzero(np.any(converted != signal, axis=1)).tolist()
        return converted

    def llr(recording: Array) -> float:
        return CERTAIN if altered else -nats

    return Part(
        mechanism, nats, sensors, llr,
        converter=watched, affected=altered, oracle_law="certain", sensor_nats=tuple(each), **truth,
    )  # fmt: skip


def _in_steps(bench: Bench, name: str, step: float, convert: Callable[[Array, float], Array]) -> Part:
    """What alters every sample of every sensor, so that it is certain."""
    everyone = tuple(range(bench.n_sensors))
    return _touched(
        name, CERTAIN, everyone, [CERTAIN] * len(everyone),
        converter=lambda x: convert(x, step),
        parameters={"lsb": quantity(step, "deg/s")},
    )  # fmt: skip


def lattice(bench: Bench, nats: float) -> Part:
    """Bare rounding to a consumer sensor's LSB; `nats` are unused."""
    step = float(bench.rng.choice([0.00875, 0.01526, 0.0305, 0.061]))
    return _in_steps(bench, "quantization", step, converter.round_to_lattice)


def angle_counts(bench: Bench, nats: float) -> Part:
    """An angle counted in whole steps, as of an optical gyro; `nats` are unused."""
    step = float(bench.rng.uniform(0.7, 3.0) * bench.sigma.mean())
    return _in_steps(bench, "quantization_noise", step, converter.count_angle)


def dead_band(bench: Bench, nats: float) -> Part:
    """Rates near zero read as zero; nats: the expected number of zeros."""
    sensors = bench.some_sensors(2)
    chosen = np.isin(np.arange(bench.n_sensors), sensors)[:, None]
    z = bench.base.bias[list(sensors)] / bench.sigma[list(sensors)]

    def expected(width: float) -> Array:
        return bench.n * (norm.cdf(width - z) - norm.cdf(-width - z))

    relative = solve(nats, lambda width: float(expected(width).sum()), 1e-9, 3.0)
    width = relative * float(bench.sigma.mean())
    return _touched(
        "quantization", nats, sensors, expected(relative).tolist(), look_alikes=("stuck_samples", "clipping"),
        converter=lambda x: np.where(chosen, converter.dead_band(x, width), x),
        parameters={"dead_band": quantity(width, "deg/s")},
    )  # fmt: skip


def clipping(bench: Bench, nats: float) -> Part:
    """A front end that saturates; nats: the expected number of samples at full scale."""
    sensors = bench.some_sensors(2)
    beyond = nats / (2 * bench.n * len(sensors))
    if beyond > MOST_CLIPPED:
        raise OutOfReachError(
            f"`nats`: expected at most {MOST_CLIPPED:g} of the samples at either end, got {beyond:.2g}"
        )
    z = norm.isf(beyond)

    parameters: dict[str, dict[str, Any]] = {}

    def convert(x: Array) -> Array:
        middle, reach = x.mean(axis=1), np.where(np.isin(np.arange(len(x)), sensors), z * x.std(axis=1), np.inf)
        for name, limit in (("low", middle - reach), ("high", middle + reach)):
            own = limit[list(sensors)]
            parameters[name] = quantity(float(own.mean()), "deg/s", own)
        return converter.clip(x, middle - reach, middle + reach)

    each = [nats / len(sensors)] * len(sensors)
    return _touched("clipping", nats, sensors, each, converter=convert, parameters=parameters)


def stuck_samples(bench: Bench, nats: float) -> Part:
    """The bus sends a sample twice or more, to several sensors at once; nats: the expected number of such faults."""
    sensors = bench.some_sensors(2)
    run = int(bench.rng.integers(1, 4))
    share = nats / bench.n
    if share * run > MOST_REPEATED:
        raise OutOfReachError(f"`nats`: expected at most {MOST_REPEATED:g} of the samples, got {share * run:.2g}")
    at = bench.rng.uniform(size=bench.n) < share
    for _ in range(run - 1):
        at[1:] |= at[:-1]

    def convert(x: Array) -> Array:
        out = x.copy()
        for i in sensors:
            out[i] = clock.repeat_last(x[i], at)
        return out

    return _touched(
        "stuck_samples", nats, sensors, [nats] * len(sensors), converter=convert,
        parameters={"probability": quantity(share * run, "")},
    )  # fmt: skip
