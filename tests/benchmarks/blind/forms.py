"""The catalogue's physics in other forms than any equation has it: harmonics, bursts, lags.

What such an effect is called is settled by its physics; that its form differs, by whoever looks closely.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal as sps

from . import marginal, mechanics, shapes, thermal
from .analog import OVERSAMPLING, relaxator
from .bench import Bench, Part, quantity, rms
from .likelihood import ar1_spectrum, divergence, folded, grid, spectral_llr, within
from .spectral import added, resonance
from .strange import noise_of_level

Array = NDArray[np.float64]


def harmonics(bench: Bench, nats: float) -> Part:
    """A rotor that is out of true: a line at its frequency and at several multiples, weaker as they go."""
    sensors = bench.some_sensors()
    f = bench.rng.uniform(0.03, 0.12) * bench.rate
    turn = 2 * np.pi * f / bench.step_rate * np.arange(bench.steps)
    unit = np.zeros((bench.n_sensors, bench.n))
    for i in sensors:
        for k in range(1, 5):
            wave = np.cos(k * turn + bench.rng.uniform(0, 2 * np.pi))
            unit[i] += bench.rng.uniform(0.5, 1.5) / k * bench.sampled(wave)
    part, _ = bench.shape("vibration_tone", nats, unit, frequency_hz=f, look_alikes=("drifting_tone", "resonance"))
    return replace(part, form="harmonics")


def modulated(bench: Bench, nats: float) -> Part:
    """A tone whose frequency, or whose size, follows a sine: a controller that hunts, a beat."""
    sensors = bench.some_sensors()
    f, slow = bench.rng.uniform(0.1, 0.35) * bench.rate, bench.rng.uniform(15, 200) / bench.duration
    t = np.arange(bench.steps) / bench.step_rate
    swing = np.sin(2 * np.pi * slow * t + bench.rng.uniform(0, 2 * np.pi))
    if bench.rng.integers(2):
        phase, size = bench.rng.uniform(0.8, 6) * swing, np.ones_like(t)
    else:
        phase, size = np.zeros_like(t), 1 + bench.rng.uniform(0.3, 0.95) * swing
    unit = np.zeros((bench.n_sensors, bench.n))
    for i in sensors:
        own = bench.rng.uniform(0, 2 * np.pi)
        unit[i] = bench.rng.uniform(0.5, 1.5) * bench.sampled(size * np.cos(2 * np.pi * f * t + phase + own))
    look_alikes = ("drifting_tone", "resonance")
    part, _ = bench.shape("vibration_tone", nats, unit, frequency_hz=f, look_alikes=look_alikes)
    return replace(part, form="modulated")


def rotor(bench: Bench, nats: float) -> Part:
    """A rotor out of true whose speed wanders: lines in step at several multiples. Nats: of the spectra alone."""
    sensors = bench.some_sensors()
    f = bench.rng.uniform(0.05, 0.11) * bench.rate
    wander, seconds = bench.rng.uniform(5, 60) / bench.duration, bench.duration / bench.rng.uniform(5, 20)
    phase = mechanics.rotor_phase(
        bench.steps, f / bench.step_rate, wander / bench.step_rate, seconds * bench.step_rate, bench.rng
    )
    unit, power = np.zeros((bench.n_sensors, bench.n)), np.zeros((bench.n_sensors, len(bench.spectrum.T)))
    course = np.diff(phase) * bench.step_rate / (2 * np.pi) / bench.rate
    edges = (np.arange(bench.n) + 0.5) / (2 * bench.n)
    for k in range(1, 5):
        share = np.convolve(np.histogram(k * course, bins=edges)[0] / len(course), [0.1, 0.2, 0.4, 0.2, 0.1], "same")
        for i in sensors:
            size = bench.rng.uniform(0.5, 1.5) / k
            wave = size * bench.sampled(np.cos(k * phase[: bench.steps] + bench.rng.uniform(0, 2 * np.pi)))
            unit[i] += wave
            power[i] += np.sum(wave**2) * share
    part, size = added(bench, "drifting_tone", nats, power)
    return replace(part, signal=math.sqrt(size) * unit, look_alikes=("vibration_tone", "resonance"), form="rotor")


def bursts_of_a_tone(bench: Bench, nats: float) -> Part:
    """A rotor that is switched on for some stretches of the record."""
    sensors = bench.some_sensors()
    f = bench.rng.uniform(0.05, 0.45) * bench.rate
    count = int(bench.rng.integers(3, 9))
    edges = np.sort(bench.rng.choice(np.arange(1, 200), 2 * count, replace=False)) * bench.n // 200
    on = np.zeros(bench.n)
    for start, stop in edges.reshape(-1, 2):
        on[start:stop] = 1.0
    phase = 2 * np.pi * f / bench.rate * np.arange(bench.n)
    unit = np.zeros((bench.n_sensors, bench.n))
    for i, gain in zip(sensors, bench.gains(sensors, signed=False)[list(sensors)], strict=True):
        unit[i] = gain * on * np.cos(phase + bench.rng.uniform(0, 2 * np.pi))
    part, _ = bench.shape("vibration_tone", nats, unit, frequency_hz=f, look_alikes=("drifting_tone", "resonance"))
    return replace(part, form="bursts")


def curved_temperature(bench: Bench, nats: float) -> Part:
    """A bias that follows a die which lags far behind the thermometer, and not in a straight line."""
    sensors = bench.some_sensors()
    room = thermal.room(bench.n, bench.rate, bench.rng)
    inside = thermal.box(room, bench.rate, bench.rng.uniform(3, 15), bench.rng.uniform(10, 60))
    lag = bench.rng.uniform(0.02, 0.1) * bench.duration
    die = thermal.lagged(inside, lag * bench.rate, float(inside[0]))
    x = (die - die.mean()) / np.std(die)
    gains = bench.gains(sensors)
    part, _ = bench.shape(
        "temperature_drift", nats, gains[:, None] * (x + bench.rng.uniform(-0.7, 0.7) * (x**2 - 1)), known=True,
        channel="temperature", channels={"temperature": thermal.thermometer(inside, bench.rng)},
    )  # fmt: skip
    assert part.signal is not None
    courses = {"step": shapes.steps(bench), "warm_up_transient": shapes.warm_ups(bench)}
    return replace(part, look_alikes=bench.rivals(part.signal, courses), form="curved and late")


def two_time_constants(bench: Bench, nats: float) -> Part:
    """Self-heating of a die in a case, each with its own time constant."""
    sensors = bench.some_sensors()
    fast = bench.duration * bench.rng.uniform(0.01, 0.05)
    slow = fast * bench.rng.uniform(4, 10)
    share = bench.rng.uniform(0.3, 0.7)
    course = sum(
        weight * thermal.warm_up(bench.n, bench.rate, tau) for weight, tau in ((share, fast), (1 - share, slow))
    )
    part, _ = bench.shape("warm_up_transient", nats, bench.gains(sensors)[:, None] * course, time_s=0.0)
    assert part.signal is not None
    return replace(
        part, look_alikes=bench.rivals(part.signal, {"step": shapes.steps(bench)}), form="two time constants"
    )


def heater(bench: Bench, nats: float) -> Part:
    """Something is switched on while it records, and heats the device."""
    return _from_a_time_on(bench, nats, lambda since: -np.expm1(-since), "switched on late")


def restarted(bench: Bench, nats: float) -> Part:
    """A part is started anew while it records, or knocked, and its bias decays again."""
    return _from_a_time_on(bench, nats, lambda since: np.exp(-since), "started anew")


def _from_a_time_on(bench: Bench, nats: float, course_of: Callable[[Array], Array], form: str) -> Part:
    """A course of the time since an onset, in time constants."""
    onset, tau = bench.duration * bench.rng.uniform(0.1, 0.7), bench.duration * bench.rng.uniform(0.03, 0.1)
    since = np.arange(bench.n) / bench.rate - onset
    course = np.where(since < 0, 0.0, course_of(since.clip(min=0) / tau))
    part, _ = bench.shape("warm_up_transient", nats, bench.gains(bench.some_sensors())[:, None] * course, time_s=onset)
    assert part.signal is not None
    return replace(part, look_alikes=bench.rivals(part.signal, {"step": shapes.steps(bench)}), form=form)


def handled(bench: Bench, nats: float) -> Part:
    """Somebody moves the device for a while: every axis turns, smoothly, and comes to rest again."""
    length = int(bench.n * bench.rng.uniform(0.03, 0.12))
    start = int(bench.rng.uniform(0.05, 0.95) * (bench.n - length))
    cut = math.exp(bench.rng.uniform(math.log(min(6 / length, 0.02)), math.log(0.03)))  # cycles per sample
    turns = sps.sosfiltfilt(sps.butter(2, 2 * cut, output="sos"), bench.rng.standard_normal((3, length + 8000)))
    window = sps.windows.tukey(length, 0.3)
    axes = bench.rng.standard_normal((bench.base.white.shape[0], 3))
    course = axes / np.linalg.norm(axes, axis=-1, keepdims=True) @ (turns[:, 4000:-4000] * window)
    unit = np.zeros((len(axes), bench.n))
    unit[:, start : start + length] = course / np.std(course)
    part, _ = bench.shape("motion", nats, unit, time_s=start / bench.rate)
    return replace(part, form="moved by hand")


def thermal_loop(bench: Bench, nats: float) -> Part:
    """A bias with a share of the temperature and one of its rate of change, in every sensor others."""
    sensors = bench.some_sensors()
    inside = thermal.box(thermal.room(bench.n, bench.rate, bench.rng), bench.rate, bench.rng.uniform(3, 15), 20.0)
    late = thermal.lagged(inside, 0.03 * bench.n, float(inside[0]))
    parts = [(x - x.mean()) / np.std(x) for x in (inside, inside - late)]
    unit = sum(bench.gains(sensors)[:, None] * x for x in parts)
    part, _ = bench.shape(
        "temperature_drift", nats, np.asarray(unit), known=True,
        channel="temperature", channels={"temperature": thermal.thermometer(inside, bench.rng)},
    )  # fmt: skip
    assert part.signal is not None
    courses = {"step": shapes.steps(bench), "warm_up_transient": shapes.warm_ups(bench)}
    return replace(part, look_alikes=bench.rivals(part.signal, courses), form="a loop")


def ramp_of_level(bench: Bench, nats: float) -> Part:
    """Noise that grows louder, or fades, along the record or a part of it."""
    sensors = bench.some_sensors()
    start, stop = np.sort(bench.rng.uniform(0, 1, 2))
    if stop - start < 0.3:
        start, stop = 0.0, 1.0
    course = np.clip((np.arange(bench.n) / bench.n - start) / (stop - start), 0, 1) * bench.rng.choice([-1.0, 1.0])
    return replace(noise_of_level(bench, "variance_change", nats, sensors, course), form="ramp")


def level_of_channel(bench: Bench, nats: float) -> Part:
    """Noise that is louder the more a motor is asked for, whose command is a channel: steps, or a course of its own."""
    sensors = bench.some_sensors()
    changes = np.sort(bench.rng.integers(0, bench.n, int(bench.rng.integers(8, 40))))
    if bench.rng.uniform() < 0.5:
        levels = bench.rng.uniform(0, 1, len(changes) + 1)
        command = levels[np.searchsorted(changes, np.arange(bench.n), side="right")]
    else:
        t = np.arange(bench.n) / bench.n
        command = 0.5 + 0.5 * np.sin(2 * np.pi * (bench.rng.uniform(1, 6) * t + bench.rng.uniform()))
    part = noise_of_level(bench, "variance_change", nats, sensors, command)
    return replace(part, form="of a channel", channel="motor_command", channels={"motor_command": command})


def tone_of_channel(bench: Bench, nats: float) -> Part:
    """Vibration of a motor, whose command is a channel: it turns faster, a little late, and shakes more as it does."""
    sensors = bench.some_sensors(1)
    t = np.arange(bench.n) / bench.n
    swings = [np.sin(2 * np.pi * (bench.rng.uniform(1, 12) * t + bench.rng.uniform())) for _ in range(5)]
    course = np.sum(swings, 0)
    command = (course - course.min()) / (course.max() - course.min())
    keeps = math.exp(-1 / (bench.rng.uniform(0.0, 0.1) * bench.rate + 1e-3))
    speed = sps.lfilter([1 - keeps], [1, -keeps], command, zi=[keeps * command[0]])[0]
    low, high = bench.rng.uniform(0.05, 0.15), bench.rng.uniform(0.25, 0.4)
    f = low + (high - low) * speed
    shake = f ** int(bench.rng.integers(0, 3)) * np.sin(2 * np.pi * (f.cumsum() + bench.rng.uniform()))
    part, _ = bench.shape(
        "drifting_tone",
        nats,
        bench.gains(sensors)[:, None] * shake / np.abs(shake).max(),
        known=True,
        channel="motor_command",
        channels={"motor_command": command},
    )
    return replace(part, form="of a channel")


def several_modes(bench: Bench, nats: float) -> Part:
    """A structure with two modes."""
    sensors = bench.some_sensors()
    nu = np.arange(bench.steps + 1) / (2 * bench.steps)
    first = bench.rng.uniform(0.06, 0.3)
    modes = [(first, bench.rng.uniform(8, 40)), (first * bench.rng.uniform(1.15, 1.4), bench.rng.uniform(8, 40))]
    gains = bench.gains(sensors, signed=False)
    fine = np.sum([mechanics.resonator_spectrum(nu, f / OVERSAMPLING, q) for f, q in modes], axis=0)
    part, size = added(bench, "resonance", nats, gains[:, None] ** 2 * folded(fine, OVERSAMPLING)[1:-1])
    signal = np.zeros((bench.n_sensors, bench.n))
    for i in sensors:
        for f, q in modes:
            ringing = mechanics.resonator(bench.steps, f / OVERSAMPLING, q, bench.rng)
            signal[i] += math.sqrt(size) * gains[i] * bench.sampled(ringing)
    return replace(part, signal=signal, frequency_hz=first * bench.rate, form="two modes")


def swapped(bench: Bench, nats: float) -> Part:
    """Two cables in each other's place: those of the sensors whose spectra differ most, by as many nats at least."""
    spectra = bench.spectrum
    apart = np.array([divergence(spectra, other).reshape(-1) for other in spectra[:, None]])  # (sensor, sensor)
    apart = apart + apart.T
    i, j = sorted(int(k) for k in np.unravel_index(apart.argmax(), apart.shape))
    within("spectra that tell two sensors", nats, float(apart[i, j]), "nats")
    order = np.arange(len(spectra))
    order[[i, j]] = j, i
    return Part(
        "sensor_order",
        nats,
        (i, j),
        lambda recording: spectral_llr(recording, spectra[order], spectra),
        converter=lambda x: x[order],
        oracle_nats=float(apart[i, j]),
        form="swapped",
    )


def simulated_resonance(bench: Bench, nats: float) -> Part:
    """A structure that the simulator lets ring, and the device has not."""
    return _of_the_simulation(resonance(bench, nats))


def simulated_source(bench: Bench, nats: float) -> Part:
    """White noise of one supply that the simulator has, and the device has not."""
    sensors = bench.some_sensors(2, shared=True)
    gains = bench.gains(sensors) * bench.sigma
    part, size = added(bench, "common_mode", nats, gains[:, None] ** 2 * np.ones_like(bench.spectrum), broad=True)
    return _of_the_simulation(
        replace(part, signal=math.sqrt(size) * gains[:, None] * bench.rng.standard_normal(bench.n))
    )


def simulated_spikes(bench: Bench, nats: float) -> Part:
    """Outliers that the simulator draws, as a real device of the kind had them, and this one has not."""
    return _of_the_simulation(marginal.spikes(bench, nats))


def _of_the_simulation(part: Part) -> Part:
    """A part whose signal is the simulation's: an oracle of the recording does not see it."""
    nats, path = part.nats, part.signal
    assert path is not None
    return replace(
        part, signal=None, simulation=lambda simulated: simulated + path, llr=lambda recording: nats, form="simulated"
    )


def late_acceleration(bench: Bench, nats: float) -> Part:
    """A gain on acceleration that comes through a mount: filtered, so that it differs from frequency to frequency."""
    sensors = bench.some_sensors()
    true = bench.sampled(mechanics.floor_vibration(bench.steps, bench.step_rate, bench.rng))
    seen = true + 2e-4 * math.sqrt(bench.rate) * bench.rng.standard_normal(true.shape)
    mount = sps.butter(1, min(2 * bench.rng.uniform(10, 30) / bench.rate, 0.9), output="sos")
    felt = sps.sosfilt(mount, true - true.mean(axis=1, keepdims=True), axis=-1)
    axes = bench.rng.standard_normal((bench.n_sensors, 3)) * bench.gains(sensors, signed=False)[:, None]
    part, size = bench.shape(
        "g_sensitivity", nats, axes @ felt, known=True, channel="acceleration", channels={"acceleration": seen}
    )
    gain = size * np.linalg.norm(axes[list(sensors)], axis=1)
    within("a gain on acceleration", float(gain.max()), shapes.MOST_PER_G, "deg/s/g")
    return replace(part, form="through a mount")


def coloured_source(bench: Bench, nats: float) -> Part:
    """Noise of one supply that is not white, in several sensors on top of their own. Nats: of their spectra alone."""
    sensors = bench.some_sensors(3, shared=True)
    phi = math.exp(-1 / bench.rng.uniform(3, 60))
    gains = bench.gains(sensors)
    unit = gains[:, None] ** 2 * ar1_spectrum(grid(bench.n), phi, 1 - phi**2)
    part, size = added(bench, "common_mode", nats, unit, broad=True)
    source = relaxator(bench.n, phi, 1.0, bench.rng)
    level = math.sqrt(size) * gains
    return replace(
        part,
        signal=level[:, None] * source,
        look_alikes=(),
        parameters={"gain": quantity(rms(level[list(sensors)]), "deg/s", np.abs(level[list(sensors)]))},
        form="coloured",
    )
