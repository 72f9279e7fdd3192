"""Effects that are a known signal: their size is half the whitened energy."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import mechanics, thermal
from .bench import Bench, Part, quantity, rms
from .clock import sample_times
from .likelihood import OutOfReachError, coefficients, within
from .spectral import added

Array = NDArray[np.float64]
MOST_PER_G = 10.0  # deg/s/g: data sheets of the poorest gyroscopes state 0.2, a board that rocks has some more
MOST_PER_G_SQUARED = 5.0  # deg/s/g^2: rectification is 1e-3 to 0.1
MOST_PER_KELVIN = 2.0  # deg/s/K: of the poorest gyroscopes, uncompensated, some tenths
MOST_SCALE_ERROR = 0.2  # share: uncalibrated gyroscopes are off by up to a tenth
MOST_SKEW = 1e4  # ppm: of the oscillators inside of sensors


def _amplitudes(bench: Bench, part: Part) -> Array:
    assert part.signal is not None
    return math.sqrt(2) * np.std(part.signal[list(part.sensors)], axis=1)


def _at_sensors(bench: Bench, sensors: tuple[int, ...], phase: NDArray[Any]) -> Array:
    """A rotor's oscillation as each sensor has it: gain and phase of its own."""
    unit = np.zeros((bench.n_sensors, bench.n))
    for sensor, gain in zip(sensors, bench.gains(sensors, signed=False)[list(sensors)], strict=True):
        unit[sensor] = gain * bench.sampled(np.cos(phase + bench.rng.uniform(0, 2 * np.pi)))
    return unit


def vibration_tone(bench: Bench, nats: float, *, frequency: float | None = None) -> Part:
    """A governed rotor: one line, its phase different at each sensor."""
    sensors = bench.some_sensors(2)
    f = bench.rng.uniform(0.05, 0.45) * bench.rate if frequency is None else frequency
    phase = 2 * np.pi * f / bench.step_rate * np.arange(bench.steps)
    unit = _at_sensors(bench, sensors, phase)
    part, size = bench.shape(
        "vibration_tone",
        nats,
        unit,
        frequency_hz=f,
        look_alikes=("drifting_tone", "resonance") if nats < 8 else (),
    )
    part = replace(part, frequency_sd_hz=bench.frequency_sd(size * unit))
    amplitude = _amplitudes(bench, part)
    part.parameters.update(
        amplitude=quantity(rms(amplitude), "deg/s", amplitude),
        frequency=quantity(f, "Hz"),
    )
    return part


def _at_unknown_times(bench: Bench, mechanism: str, nats: float, unit: Array, unknown: float) -> Part:
    """A signal of a given shape that is worth so many nats on top of those that finding it costs."""
    part, _ = bench.shape(mechanism, nats + unknown, unit, known=True)
    llr = part.llr
    return replace(
        part, nats=nats, llr=lambda recording: llr(recording) - unknown, oracle_nats=nats, oracle_law="bound"
    )


def tone_in_spells(bench: Bench, nats: float) -> Part:
    """A motor that runs for a while, once or several times, and starts in another phase each time.

    Either end of each spell costs the logarithm of the number of samples on top.
    """
    sensors, spells = bench.some_sensors(2), int(bench.rng.integers(1, 4))
    f = bench.rng.uniform(0.05, 0.45) * bench.rate
    ends = np.sort(bench.rng.uniform(0, 1, 2 * spells)) * 0.5 + 0.4 * np.repeat(np.arange(spells) / spells, 2)
    t, on = np.arange(bench.steps) / bench.steps, np.full(bench.steps, np.nan)
    for start, stop in ends.reshape(-1, 2) + np.array([0.02, 0.08]):
        on[(t >= start) & (t < stop)] = bench.rng.uniform(0, 2 * np.pi)
    phase = 2 * np.pi * f / bench.step_rate * np.arange(bench.steps) + np.nan_to_num(on)
    unit = bench.sampled(bench.gains(sensors)[:, None] * np.where(np.isnan(on), 0.0, np.cos(phase)))
    unknown = 2 * spells * math.log(bench.n)
    return replace(
        _at_unknown_times(bench, "vibration_tone", nats, unit, unknown),
        frequency_hz=f,
        look_alikes=("resonance", "drifting_tone") if nats < 50 else (),
        parameters={"frequency": quantity(f, "Hz")},
        form="on for a while",
    )


def ring_down(bench: Bench, nats: float) -> Part:
    """Knocks on a mount, which rings in one mode each time: an oscillator that is struck while it is at rest.

    Where they are is not known beforehand: each knock costs the logarithm of the number of samples on top.
    """
    sensors, knocks = bench.some_sensors(2), int(bench.rng.integers(1, 5))
    decay = math.exp(bench.rng.uniform(math.log(12), math.log(200))) / bench.rate  # s
    f = bench.rng.uniform(0.03, 0.4) * bench.rate
    t = np.arange(bench.steps) / bench.step_rate
    struck = np.zeros(bench.steps)
    onsets = np.sort(bench.rng.uniform(0.02, 0.9, knocks)) * bench.duration
    for onset in onsets:
        since = np.clip(t - onset, 0, None)
        struck += (
            bench.rng.choice([-1, 1])
            * bench.rng.uniform(0.7, 1.4)
            * (np.exp(-since / decay) * np.sin(2 * np.pi * f * since))
        )
    unit = bench.sampled(bench.gains(sensors)[:, None] * struck)
    unknown = knocks * math.log(bench.n)
    return replace(
        _at_unknown_times(bench, "ring_down", nats, unit, unknown),
        frequency_hz=f,
        look_alikes=("pulses",) if f * decay < 1 else (),  # what is gone within a cycle is a pulse that overshoots
        parameters={"frequency": quantity(f, "Hz"), "decay_time": quantity(decay, "s")},
    )


def pulses(bench: Bench, nats: float) -> Part:
    """Shocks that do not ring: half sines, haversines or sawteeth, at times that are not known beforehand."""
    sensors, n_pulses = bench.some_sensors(2), int(bench.rng.integers(1, 6))
    width = math.exp(bench.rng.uniform(math.log(4), math.log(60))) / bench.rate  # s
    t = np.arange(bench.steps) / bench.step_rate
    onsets = np.sort(bench.rng.uniform(0.02, 0.95, n_pulses)) * bench.duration
    form = [lambda u: np.sin(np.pi * u), lambda u: np.sin(np.pi * u) ** 2, lambda u: np.minimum(3 * u, 1.5 * (1 - u))]
    course, made = np.zeros(bench.steps), form[int(bench.rng.integers(3))]
    for onset in onsets:
        u = (t - onset) / width
        inside = (u > 0) & (u < 1)
        course[inside] += bench.rng.choice([-1, 1]) * bench.rng.uniform(0.7, 1.4) * made(u[inside])
    unit = bench.sampled(bench.gains(sensors)[:, None] * course)
    part = _at_unknown_times(bench, "pulses", nats, unit, n_pulses * math.log(bench.n))
    return replace(part, parameters={"width": quantity(width, "s")})


def interleaving(bench: Bench, nats: float) -> Part:
    """Two converters take turns, and their zeros differ."""
    sensors = bench.some_sensors(1)
    gains = bench.gains(sensors)
    unit = gains[:, None] * (1.0 - 2.0 * (np.arange(bench.n) % 2))
    part, size = bench.shape("interleaving", nats, unit, frequency_hz=bench.rate / 2, look_alikes=("vibration_tone",))
    offset = size * gains[list(sensors)]
    part.parameters.update(offset=quantity(rms(offset), "deg/s", offset))
    return part


def drifting_tone(bench: Bench, nats: float) -> Part:
    """A rotor whose speed wanders by many line widths.

    The oracle knows the spectrum of the wandering line (the time it spends at each frequency), not its path: a lower
    bound of the divergence, which a known path would exceed.
    """
    sensors = bench.some_sensors(3)
    f = bench.rng.uniform(0.1, 0.4) * bench.rate
    wander = bench.rng.uniform(20, 200) / bench.duration  # Hz
    seconds = bench.duration / bench.rng.uniform(5, 20)
    phase = mechanics.rotor_phase(
        bench.steps, f / bench.step_rate, wander / bench.step_rate, seconds * bench.step_rate, bench.rng
    )
    unit = _at_sensors(bench, sensors, phase)
    course = np.diff(phase) * bench.step_rate / (2 * np.pi)  # Hz
    if not 0 < course.min() <= course.max() < bench.rate / 2:
        raise OutOfReachError(
            f"expected a rotor below half the rate of {bench.rate:.4g} Hz, got {course.min():.4g} to {course.max():.4g}"
        )
    # half the power in each of the 2n bins of width rate/(2n), as long as the line stays there, two bins blurred
    share, _ = np.histogram(course / bench.rate, bins=(np.arange(bench.n) + 0.5) / (2 * bench.n), density=False)
    share = np.convolve(share / len(course), [0.1, 0.2, 0.4, 0.2, 0.1], "same")
    power = np.sum(unit**2, axis=1)  # over all coefficients, by Parseval
    part, size = added(bench, "drifting_tone", nats, power[:, None] * share)
    amplitude = math.sqrt(2 * size) * np.std(unit[list(sensors)], axis=1)
    return replace(
        part,
        signal=math.sqrt(size) * unit,
        frequency_hz=float(course.mean()),
        parameters={
            "amplitude": quantity(rms(amplitude), "deg/s", amplitude),
            "frequency": quantity(float(course.mean()), "Hz"),
            "wander": quantity(float(np.std(course)), "Hz"),
        },
    )


def tone_beside_shaking(bench: Bench, nats: float) -> Part:
    """A line near twice the frequency of an acceleration line, and not linked to it: some line widths off."""
    part = vibration_tone(bench, nats, frequency=bench.rng.uniform(0.1, 0.45) * bench.rate)
    assert part.frequency_hz is not None
    half = part.frequency_hz / 2 + bench.rng.choice([-1, 1]) * bench.rng.uniform(4, 20) / bench.duration
    _, seen = _acceleration(bench)
    seen[0] += 0.4 * common_line(bench.n, half / bench.rate, 1.0, bench.rng)
    return replace(part, channels={"acceleration": seen})


def step(bench: Bench, nats: float, *, count: int = 1) -> Part:
    """Bias steps; one by default."""
    sensors = bench.some_sensors(1)
    n = bench.n
    if count == 1:
        onsets = np.array([int(bench.rng.uniform(0.15, 0.85) * n)])
        sizes = np.ones(1)
    else:
        onsets = np.sort(bench.rng.choice(np.arange(n // 50, n - n // 50), count, replace=False))
        sizes = bench.rng.standard_normal(count)
    course = (sizes[:, None] * (np.arange(n) >= onsets[:, None])).sum(axis=0)
    gains = bench.gains(sensors)
    part, size = bench.shape("step", nats, gains[:, None] * course)
    assert part.signal is not None
    look_alikes = bench.rivals(part.signal, {"warm_up_transient": warm_ups(bench)})
    if count > 1:
        return replace(part, look_alikes=(*look_alikes, "random_telegraph"))
    jump = size * gains[list(sensors)]
    onset = float(onsets[0] / bench.rate)
    # change of mean in white noise: the maximum-likelihood epoch has variance 26/delta^4 samples^2
    delta = float(np.sum(jump**2 / bench.base.white[list(sensors)]))
    return replace(
        part,
        look_alikes=look_alikes,
        time_s=onset,
        onset_sd_s=math.sqrt(26) / delta / bench.rate,
        parameters={"size": quantity(rms(jump), "deg/s", jump), "onset": quantity(onset, "s")},
    )


def ramp(bench: Bench, nats: float) -> Part:
    """The bias drifts in a line from a time on."""
    sensors = bench.some_sensors(1)
    n, onset = bench.n, int(bench.rng.uniform(0.1, 0.6) * bench.n)
    gains = bench.gains(sensors)
    course = np.clip(np.arange(n) - onset, 0, None) / bench.rate
    part, size = bench.shape("ramp", nats, gains[:, None] * course)
    assert part.signal is not None
    slope = size * gains[list(sensors)]
    return replace(
        part,
        look_alikes=bench.rivals(part.signal, {"warm_up_transient": warm_ups(bench), "step": steps(bench)}),
        time_s=onset / bench.rate,
        parameters={"slope": quantity(rms(slope), "deg/s/s", slope), "onset": quantity(onset / bench.rate, "s")},
    )


def bias_oscillation(bench: Bench, nats: float) -> Part:
    """The bias swings with one period, a few times in the record."""
    sensors = bench.some_sensors(1)
    f = bench.rng.uniform(2.2, 9.0) / bench.n * bench.rate
    t = np.arange(bench.n) / bench.rate
    gains = bench.gains(sensors)
    course = np.sin(2 * np.pi * f * t + bench.rng.uniform(0, 2 * np.pi))
    part, size = bench.shape("bias_oscillation", nats, gains[:, None] * course)
    assert part.signal is not None
    amplitude = size * np.abs(gains[list(sensors)])
    return replace(
        part,
        look_alikes=bench.rivals(part.signal, {"warm_up_transient": warm_ups(bench), "step": steps(bench)}),
        parameters={"amplitude": quantity(rms(amplitude), "deg/s", amplitude), "period": quantity(1 / f, "s")},
    )


def steps(bench: Bench) -> Array:
    """Steps at 50 epochs: (epoch, time)."""
    return (np.arange(bench.n) >= np.linspace(0.01, 0.99, 50)[:, None] * bench.n).astype(float)


def warm_ups(bench: Bench) -> Array:
    """Transients of 20 time constants: (time constant, time)."""
    return np.exp(-np.arange(bench.n) / (np.geomspace(0.003, 1.0, 20)[:, None] * bench.n))


def temperature_drift(bench: Bench, nats: float) -> Part:
    """The bias follows the temperature of the die, which lags behind the thermometer."""
    sensors = bench.some_sensors(2)
    inside = thermal.box(
        thermal.room(bench.n, bench.rate, bench.rng), bench.rate, bench.rng.uniform(3, 15), bench.rng.uniform(10, 60)
    )
    lag = bench.rng.uniform(0.5, 5.0)
    die = thermal.lagged(inside, lag * bench.rate, float(inside[0]))
    gains = bench.gains(sensors)
    part, size = bench.shape(
        "temperature_drift",
        nats,
        gains[:, None] * (die - die.mean()),
        known=True,
        channel="temperature",
        channels={"temperature": thermal.thermometer(inside, bench.rng)},
    )
    assert part.signal is not None
    slope = size * gains[list(sensors)]
    within("a temperature coefficient", float(np.abs(slope).max()), MOST_PER_KELVIN, "deg/s/K")
    return replace(
        part,
        look_alikes=bench.rivals(part.signal, {"step": steps(bench), "warm_up_transient": warm_ups(bench)}),
        parameters={"coefficient": quantity(rms(slope), "deg/s/K", slope), "lag": quantity(lag, "s")},
    )


def warm_up_transient(bench: Bench, nats: float, *, thermometer: str = "none") -> Part:
    """Self-heating after power-on; thermometer "board" sees the room only, "die" the heating only."""
    sensors = bench.some_sensors(2)
    seconds = bench.duration * bench.rng.uniform(0.03, 0.25)
    course = thermal.warm_up(bench.n, bench.rate, seconds)
    gains = bench.gains(sensors)
    ambient = thermal.room(bench.n, bench.rate, bench.rng)
    channels = {}
    if thermometer == "board":
        channels = {"temperature": thermal.thermometer(thermal.box(ambient, bench.rate, 0.0, 40.0), bench.rng)}
    elif thermometer == "die":
        heated = thermal.box(np.full(bench.n, 22.0), bench.rate, 9.0, seconds)
        channels = {"temperature": thermal.thermometer(heated, bench.rng)}
    part, size = bench.shape(
        "warm_up_transient",
        nats,
        gains[:, None] * course,
        time_s=0.0,
        channels=channels,
    )
    assert part.signal is not None
    rivals = {"step": steps(bench)}
    if "temperature" in channels:
        rivals["temperature_drift"] = channels["temperature"][None]
    height = size * gains[list(sensors)]
    return replace(
        part,
        look_alikes=bench.rivals(part.signal, rivals),
        parameters={"size": quantity(rms(height), "deg/s", height), "time_constant": quantity(seconds, "s")},
    )


def _acceleration(bench: Bench) -> tuple[Array, Array]:
    """What shakes the gyroscopes, and what the accelerometer (0.2 mg/sqrt(Hz)) says of it."""
    true = bench.sampled(mechanics.floor_vibration(bench.steps, bench.step_rate, bench.rng))
    return true, true + 2e-4 * math.sqrt(bench.rate) * bench.rng.standard_normal(true.shape)


def g_sensitivity(bench: Bench, nats: float) -> Part:
    """A gain on acceleration, the same at every frequency."""
    sensors = bench.some_sensors(2)
    true, seen = _acceleration(bench)
    axes = bench.rng.standard_normal((bench.n_sensors, 3)) * (bench.gains(sensors, signed=False)[:, None])
    part, size = bench.shape(
        "g_sensitivity", nats, axes @ (true - true.mean(axis=1, keepdims=True)), known=True, channel="acceleration",
        channels={"acceleration": seen},
    )  # fmt: skip
    gain = size * np.linalg.norm(axes[list(sensors)], axis=1)
    within("a gain on acceleration", float(gain.max()), MOST_PER_G, "deg/s/g")
    part.parameters.update(gain=quantity(rms(gain), "deg/s/g", gain))
    return part


def quadratic_coupling(bench: Bench, nats: float) -> Part:
    """The rate answers to the square of one axis' acceleration: a line at twice its frequency, and a slow bias.

    It does so before the converter, whose average of a square is not the square of an average: the gain is that on the
    square of what the accelerometer's own converter lets through, as far as it explains the rate.
    """
    sensors = bench.some_sensors(2)
    f = bench.rng.uniform(0.06, 0.22) * bench.rate
    loudness = 1 + 0.5 * np.sin(2 * np.pi * bench.rng.uniform(1, 4) * np.arange(bench.steps) / bench.steps)
    phase = mechanics.rotor_phase(
        bench.steps, f / bench.step_rate, 3 / bench.duration / bench.step_rate, bench.steps / 10, bench.rng
    )
    shaking = mechanics.floor_vibration(bench.steps, bench.step_rate, bench.rng)
    shaking[0] += 0.4 * loudness * np.cos(phase)
    seen = bench.sampled(shaking)
    gains = bench.gains(sensors)
    course = bench.sampled(shaking[0] ** 2)
    part, size = bench.shape(
        "quadratic_coupling",
        nats,
        gains[:, None] * course,
        known=True,
        frequency_hz=2 * f,
        channel="acceleration",
        channels={"acceleration": seen + 2e-4 * math.sqrt(bench.rate) * bench.rng.standard_normal(seen.shape)},
    )
    own, of_square = (coefficients(x) / np.sqrt(bench.spectrum[list(sensors)]) for x in (course, seen[0] ** 2))
    gain = size * gains[list(sensors)] * (own * of_square).sum(axis=1) / (of_square**2).sum(axis=1)
    within("a gain on squared acceleration", float(np.abs(gain).max()), MOST_PER_G_SQUARED, "deg/s/g^2")
    part.parameters.update(gain=quantity(rms(gain), "deg/s/g^2", gain))
    return part


def scale_factor(bench: Bench, nats: float, *, constant: bool = False) -> Part:
    """A rate table: the gyroscopes' output less the table's rate, which is a channel; each gain is off by its own."""
    sensors = bench.some_sensors(2)
    t = np.arange(bench.n) / bench.rate
    turn = np.full(bench.n, 30.0)
    for _ in range(0 if constant else 4):
        swing = 2 * np.pi * (bench.rng.uniform(0.02, 0.3) * t + bench.rng.uniform())
        turn += bench.rng.uniform(10, 40) * np.sin(swing)
    gains = bench.gains(sensors)
    unit = gains[:, None] * turn
    channels = {"reference_rate": turn + (0.0 if constant else 0.002 * bench.rng.standard_normal(bench.n))}
    if constant:
        return Part(
            "not_identifiable", 0.0, sensors, lambda recording: 0.0, signal=1e-3 * unit, channels=channels,
            channel="reference_rate", look_alikes=("scale_factor",),
        )  # fmt: skip
    part, size = bench.shape("scale_factor", nats, unit, known=True, channel="reference_rate", channels=channels)
    error = size * gains[list(sensors)]
    within("a scale error", float(np.abs(error).max()), MOST_SCALE_ERROR, "of the rate")
    part.parameters.update(error=quantity(1e6 * rms(error), "ppm", 1e6 * error))
    return part


def channel_coupling(bench: Bench, nats: float) -> Part:
    """The supply of some sensors sags under a motor, whose command is a channel: steps of random size and length."""
    sensors = bench.some_sensors(1)
    changes = np.sort(bench.rng.integers(0, bench.n, int(bench.rng.integers(8, 40))))
    levels = bench.rng.uniform(0, 1, len(changes) + 1)
    command = levels[np.searchsorted(changes, np.arange(bench.n), side="right")]
    gains = bench.gains(sensors)
    channels = {"motor_command": command}
    part, size = bench.shape(
        "channel_coupling", nats, gains[:, None] * command, known=True, channel="motor_command", channels=channels
    )
    gain = size * gains[list(sensors)]
    part.parameters.update(gain=quantity(rms(gain), "deg/s per unit of motor_command", gain))
    return part


def clock_skew(bench: Bench, nats: float, *, lost: bool = False) -> Part:
    """Some sensors run on a clock of their own: a line that all share, known to the simulator, slips in phase there.

    The clock is off by some ppm, or it loses samples. The oracle fits phase and amplitude of the line at each sensor
    under both hypotheses; what is left of the difference is the signal. The offset sets its size; for lost samples, the
    amplitude of the line, which the simulator knows.
    """
    sensors = bench.some_sensors(1, 3)
    chosen, n = np.isin(np.arange(bench.n_sensors), sensors)[:, None], bench.n
    f = bench.rng.uniform(0.1, 0.4) * bench.rate
    turn, start = 2 * np.pi * f / bench.rate, bench.rng.uniform(0, 2 * np.pi)
    amplitude, ppm = 0.5 * float(bench.sigma.mean()), float(bench.rng.choice([-1.0, 1.0]))
    angle = turn * np.arange(n) + start
    quadratures = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def slipped(times: Array) -> tuple[Array, Array]:
        """The line at these times, and what is left of it beside the regular one."""
        line = np.cos(turn * times + start)
        return line, line - quadratures @ np.linalg.lstsq(quadratures, line, rcond=None)[0]

    if lost:
        gone = bench.rng.choice(np.arange(n // 10, 9 * n // 10), int(bench.rng.integers(1, 6)), replace=False)
        line, rest = slipped(sample_times(n, 0.0, gone))
        part, amplitude = bench.shape("clock_skew", nats, chosen * rest)
        parameters = {"lost": quantity(len(gone), "")}
    else:
        # the residual grows in proportion to a small offset, so a few corrections reach the size asked for
        for _ in range(40):
            line, rest = slipped(sample_times(n, ppm, np.empty(0)))
            part, size = bench.shape("clock_skew", nats, chosen * rest)
            if abs(math.log(size / amplitude)) < 1e-4:
                break
            ppm *= min(max(size / amplitude, 1e-2), 2.0)
            # of a line that has slipped off itself no offset tells more
            within("an offset of the clock", ppm, MOST_SKEW, "ppm")
        else:
            raise OutOfReachError(f"`nats`: expected less than a line of half the noise tells, got {nats:g}")
        parameters = {"skew": quantity(ppm, "ppm")}
    seen = 2e-4 * math.sqrt(bench.rate) * bench.rng.standard_normal((3, n)) + 0.05 * np.cos(angle)
    seen[2] += 1.0
    return replace(
        part,
        signal=amplitude * np.where(chosen, line, np.cos(angle)),  # the oracle's residual is orthogonal to the line
        look_alikes=("drifting_tone", "vibration_tone"),
        frequency_hz=f,
        channels={"acceleration": seen},
        simulation=lambda simulated: simulated + common_line(simulated.shape[-1], f / bench.rate, amplitude, bench.rng),
        parameters={**parameters, "frequency": quantity(f, "Hz")},
    )


def time_scale(bench: Bench, nats: float) -> Part:
    """The recording's rate is not the one on its label: lines of the simulator are all there, a factor off."""
    ratio = 1 + float(bench.rng.choice([-1.0, 1.0])) * bench.rng.uniform(0.01, 0.1)
    known = bench.rng.uniform(0.05, 0.2), bench.rng.uniform(0.24, 0.4)
    t = np.arange(bench.n)
    lines = sum(np.cos(2 * np.pi * (ratio * nu * t + bench.rng.uniform())) for nu in known)
    part, amplitude = bench.shape("time_scale", nats, np.ones((bench.n_sensors, 1)) * lines)
    assert part.signal is not None

    def with_lines(simulated: Array) -> Array:
        return simulated + sum(common_line(simulated.shape[-1], nu, amplitude, bench.rng) for nu in known)

    return replace(
        part,
        look_alikes=("vibration_tone", "clock_skew"),
        frequency_hz=ratio * known[0] * bench.rate,
        simulation=with_lines,
        parameters={"ratio": quantity(ratio, "")},
    )


def common_line(n: int, nu: float, amplitude: float, rng: np.random.Generator) -> Array:
    """A line that all sensors share, `nu` in cycles per sample, its phase drawn."""
    return amplitude * np.cos(2 * np.pi * (nu * np.arange(n) + rng.uniform()))
