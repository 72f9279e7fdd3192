"""What users meet most, by generators of their own: one effect or two, named, with the truth in their limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from bounds import at_least
from mismatch_draws import SCENE, drawn
from scipy import signal
from slow_cases import slow_but_for
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.moving.moving_lines import MovingLine, moving_line
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.selection.residue import is_left_of_form
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

N, RATE = 16_384, 200.0
T = np.arange(N) / RATE
MODEL = gf.WhiteNoise(1.0) + gf.AR1(0.999, 1e-5)


def noise(seed: int, sensors: int = 3) -> np.ndarray:
    return MODEL.simulate(N, batch=(sensors,), generator=torch.Generator().manual_seed(seed)).numpy()


def diagnosed(recording: np.ndarray, simulation: np.ndarray | None = None, **channels: Tensor) -> gf.MismatchReport:
    simulated = MODEL if simulation is None else gf.Recording(torch.from_numpy(simulation), rate=RATE, unit="deg/s")
    x = gf.Recording(torch.from_numpy(recording), rate=RATE, unit="deg/s", channels=channels)
    return gf.diagnose(x, simulated)


class Case(NamedTuple):
    """A recording of a seed, its names in any order, and what limits of their numbers hold."""

    recording: Callable[[int], np.ndarray]
    names: tuple[str, ...]
    truth: dict[str, float]


def runs_up(seed: int) -> np.ndarray:
    phase = 2 * math.pi * (10 * T + (80 - 10) * T**2 / 2 / T[-1])
    return noise(seed) + 0.6 * np.cos(phase)


def runs_up_and_stays(seed: int) -> np.ndarray:
    f = np.clip((T - 15) / 10, 0, 1) * 60
    return noise(seed) + 0.8 * np.cos(2 * math.pi * np.cumsum(f) / RATE) * (f > 15)


def speeds_of_a_rotor(seed: int) -> np.ndarray:
    """Four of them, at each of which it stays for 20 s, so that each is a line of the record."""
    asked = np.repeat([14.0, 23.0, 35.0, 44.0], N // 4)
    late = 1 - math.exp(-1 / (0.5 * RATE))
    f = 14.0 + signal.lfilter([late], [1, late - 1], asked - 14.0)
    return noise(seed) + np.array([[0.0], [0.8], [1.1]]) * np.cos(2 * math.pi * np.cumsum(f) / RATE)


def tone_in_a_stop_band(seed: int) -> np.ndarray:
    filtered = signal.sosfilt(signal.butter(4, 24, fs=RATE, output="sos"), noise(seed), axis=-1)
    return filtered + 0.05 * np.cos(2 * math.pi * 72.1 * T)


def clock_of_one(seed: int) -> np.ndarray:
    x = noise(seed)
    for i in range(3):
        x[i] += 1.5 * np.cos(2 * math.pi * 31.4 * T * (1 + 200e-6 * (i == 1)))
    return x


def louder_beside_a_filter(seed: int) -> np.ndarray:
    x = noise(seed)
    x[0] = signal.sosfilt(signal.butter(2, 40, fs=RATE, output="sos"), x[0])
    x[2, 4000:8000] *= 1.7
    return x


def angle_counts(seed: int) -> np.ndarray:
    angle = np.random.default_rng(seed).standard_normal((3, N + 1))
    return noise(seed) + 0.5 * np.diff(angle, axis=-1)


def thermostat(seed: int) -> np.ndarray:
    x = noise(seed)
    x[1:] += 0.12 * np.sin(2 * math.pi * T / 13 + 0.4)
    return x


def switches(seed: int) -> np.ndarray:
    return noise(seed) + np.array([[0.6], [0.3], [-0.5]]) * signal.square(2 * math.pi * 13.7123 * T)


def two_blades(seed: int) -> np.ndarray:
    parts = ((1, 0.25), (2, 0.7), (3, 0.2), (5, 0.2))
    return noise(seed) + sum(size * np.cos(2 * math.pi * k * 8.4321 * T + k) for k, size in parts)


def rotor(seed: int) -> np.ndarray:
    """Speed that wanders by a few hundredths of a hertz, and lines at one, two and three times it."""
    steps = np.random.default_rng(seed).standard_normal(N)
    f = 17.3 + 0.2 * signal.lfilter([math.sqrt(1 - 0.9995**2)], [1, -0.9995], steps)
    phase = 2 * math.pi * np.cumsum(f) / RATE
    lines = sum(size * np.cos(k * phase + k) for k, size in ((1, 1.0), (2, 0.6), (4, 0.3)))
    return noise(seed) + np.array([[1.0], [-0.6], [0.4]]) * lines


def handled(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turns = signal.sosfilt(signal.butter(2, [0.5, 4], "band", fs=RATE, output="sos"), rng.standard_normal((3, N)))
    return noise(seed) + 2 * turns / turns.std() * ((T > 41) & (T < 47))


def started_anew(seed: int) -> np.ndarray:
    x = noise(seed)
    x[1] += np.where(T >= 31.234, 1.2 * np.exp(-(T - 31.234).clip(0) / 7), 0.0)
    return x


def shocks(seed: int) -> np.ndarray:
    x = noise(seed)
    for onset, sign in ((3000, 1), (9000, -1), (12_345, 1)):
        x[:, onset : onset + 20] += (
            sign * np.array([[8.0], [5.0], [-6.0]]) * np.sin(math.pi * (np.arange(20) + 0.5) / 20)
        )
    return x


def glitches_of_three(seed: int) -> np.ndarray:
    x = noise(seed)
    for onset in np.random.default_rng(seed).integers(10, N - 10, 15):
        x[0, onset : onset + 3] += np.array([9.0, 9.0, 6.0])
    return x


def converters_in_turns(seed: int) -> np.ndarray:
    return noise(seed) + np.array([[0.0], [0.2], [-0.3]]) * (-1.0) ** np.arange(N)


def one_way(seed: int) -> np.ndarray:
    x = noise(seed)
    x[1] += 0.25 * x[0]
    return x


CASES = {
    "runs up": Case(
        runs_up, ("chirp",), {"chirp.start_frequency": 10.0, "chirp.stop_frequency": 80.0, "chirp.amplitude[1]": 0.6}
    ),
    "runs up and stays": Case(
        runs_up_and_stays, ("chirp", "vibration_tone"), {"chirp.stop": 25.0, "vibration_tone.frequency": 60.0}
    ),
    "speeds of a rotor": Case(
        speeds_of_a_rotor, ("chirp",), {"chirp.start_frequency": 14.0, "chirp.stop_frequency": 44.0}
    ),
    "tone in a stop band": Case(
        tone_in_a_stop_band,
        ("vibration_tone", "low_pass"),
        {"vibration_tone.amplitude[0]": 0.05, "low_pass.corner[1]": 24.0},
    ),
    "clock of one": Case(
        clock_of_one, ("clock_skew", "vibration_tone"), {"clock_skew.skew": 200.0, "vibration_tone.amplitude[2]": 1.5}
    ),
    "louder beside a filter": Case(
        louder_beside_a_filter,
        ("variance_change", "low_pass"),
        {"variance_change.factor[2]": 1.7**2, "low_pass.corner[0]": 40.0},
    ),
    "angle counts": Case(angle_counts, ("quantization_noise",), {"quantization_noise.angle[0]": 0.5 / RATE}),
    "thermostat": Case(
        thermostat, ("bias_oscillation",), {"bias_oscillation.period": 13.0, "bias_oscillation.amplitude[2]": 0.12}
    ),
    "switches": Case(
        switches,
        ("vibration_tone",),
        {"vibration_tone.frequency": 13.7123, "vibration_tone.amplitude[0]": 2.4 / math.pi}
        | {f"vibration_tone.harmonic_{k}[0]": 2.4 / math.pi / k for k in (3, 5)},
    ),
    "two blades": Case(
        two_blades,
        ("vibration_tone",),
        {"vibration_tone.frequency": 2 * 8.4321, "vibration_tone.amplitude[1]": 0.7},
    ),
    "rotor": Case(rotor, ("drifting_tone",), {"drifting_tone.harmonic_2[0]": 0.6, "drifting_tone.harmonic_4[0]": 0.3}),
    "handled": Case(handled, ("motion",), {}),
    "started anew": Case(
        started_anew,
        ("warm_up_transient",),
        {"warm_up_transient.onset": 31.234, "warm_up_transient.time_constant": 7.0, "warm_up_transient.size[1]": 1.2},
    ),
    "shocks": Case(shocks, ("pulses",), {"pulses.width": 20 / RATE}),
    "glitches of three": Case(glitches_of_three, ("pulses",), {}),
    "converters in turns": Case(
        converters_in_turns, ("interleaving",), {"interleaving.offset[1]": 0.2, "interleaving.offset[2]": -0.3}
    ),
    "one way": Case(one_way, ("cross_talk",), {"cross_talk.part_of_1[1]": 0.25}),
}


QUICK = ("rotor", "thermostat", "handled", "converters in turns", "switches", "shocks")


@pytest.mark.parametrize("case", slow_but_for(QUICK, CASES))
def test_it_is_named_and_nothing_else_is(case: Case) -> None:
    report = diagnosed(case.recording(1))
    assert sorted(f.mechanism for f in report.findings) == sorted(case.names)
    assert report.held_out.after < 2
    said = {f"{f.mechanism}.{name}": entry for f in report.findings for name, entry in f.parameters.items()}
    for name, value in case.truth.items():
        entry = said[name]
        middle, half = (entry.low + entry.high) / 2, (entry.high - entry.low) / 2
        assert abs(value - middle) < 1.7 * half, name  # of several limits of 95 %


@pytest.mark.slow
def test_a_filter_of_the_simulation_alone_is_told_as_such() -> None:
    design = signal.butter(2, 40.0, fs=RATE, output="sos")
    report = diagnosed(noise(1)[:, 200:], signal.sosfilt(design, noise(2))[:, 200:])
    (finding,) = report.findings
    assert finding.mechanism == "low_pass"
    assert report.held_out.after < 2
    assert "the simulation has a low-pass filter" in finding.sentence
    assert abs(finding.parameters["corner[0]"].value - 40.0) < 0.5


def test_swapped_sensors_are_told_by_their_names() -> None:
    """And what else is there is found in their places."""
    own = np.array([[1.0], [1.6], [2.5]])
    report = diagnosed((own * noise(1))[[2, 1, 0]] + tone_of_one(), own * noise(2))
    assert sorted(f.mechanism for f in report.findings) == ["sensor_order", "vibration_tone"]
    order = next(f for f in report.findings if f.mechanism == "sensor_order")
    assert order.sensors == (0, 2)
    assert "1 is like the simulation's 3, 3 is like the simulation's 1" in order.sentence
    assert report.held_out.after < 2


def tone_of_one() -> np.ndarray:
    return np.array([[0.0], [0.5], [0.0]]) * np.cos(2 * math.pi * 31.27 * T)


def ringing(seed: int, frequency: float, sd: float) -> np.ndarray:
    """Modes of their own in all sensors, of quality factor 15."""
    driven = np.random.default_rng(seed).standard_normal((3, N))
    x = signal.lfilter(*signal.iirpeak(frequency, 15, fs=RATE), driven, axis=-1)
    return sd * x / x.std()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_a_resonance_of_the_simulation_alone_is_told_as_such(seed: int) -> None:
    report = diagnosed(noise(seed), noise(seed + 1) + ringing(seed, 30.0, 0.6))
    (finding,) = report.findings
    assert (finding.mechanism, report.held_out.after < 2) == ("resonance", True)
    assert "that only the simulation has" in finding.sentence
    assert finding.parameters["frequency"].value == pytest.approx(30, abs=0.5)
    assert finding.parameters["rms[1]"].value == pytest.approx(0.6, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 5])
def test_a_resonance_at_another_frequency_is_told_with_both(seed: int) -> None:
    """What the one has at its foot stands for a part of the other: neither is found alone."""
    report = diagnosed(noise(seed) + ringing(seed, 36.0, 0.8), noise(seed + 1) + ringing(seed + 1, 33.0, 0.8))
    (finding,) = report.findings
    assert (finding.mechanism, report.held_out.after < 2) == ("resonance", True)
    said = finding.sentence.removeprefix("the simulation's resonance at ").split()
    assert (float(said[0]), float(said[7])) == (pytest.approx(33, abs=0.5), pytest.approx(0.8, rel=0.2))
    assert finding.parameters["frequency"].value == pytest.approx(36, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.4, 20.0])
def test_common_noise_of_the_simulation_alone_is_told_as_such(size: float) -> None:
    """Which is no gain of whole sensors, however much louder all of them are."""
    source = size * np.random.default_rng(5).standard_normal(N) * np.array([[1.0], [-0.8], [0.6]])
    report = diagnosed(noise(1), noise(2) + source)
    assert {f.mechanism for f in report.findings} == {"common_mode"}
    assert "that only the simulation has, with a gain of up to" in report.findings[0].sentence
    assert report.findings[0].parameters["gain[1]"].value == pytest.approx(0.8 * size, rel=0.1)


def test_harmonics_are_those_of_the_fundamental_frequency() -> None:
    tone = diagnosed(two_blades(1)).findings[0].effect
    assert isinstance(tone, VibrationTone)
    assert (tone.multiple, [one.multiple for one in tone.harmonics]) == (2, [1, 3, 5])
    sizes = torch.tensor([0.25, 0.2, 0.2])[:, None].expand(-1, 3)
    found = torch.stack([torch.hypot(one.cosine, one.sine) for one in tone.harmonics])
    torch.testing.assert_close(found, sizes.to(found), atol=5 * math.sqrt(2 / N), rtol=0)


@pytest.mark.statistical
@pytest.mark.parametrize("half", [0, 1])
def test_they_are_named_nearly_always(half: int, draws: Callable[[int, int], int]) -> None:
    """Right names, or listed as what the data do not tell apart, and no other: 95 % and more, but for chance."""
    cases, seeds = list(CASES.values())[half::2], range(2, 2 + draws(1, 12))
    right = 0
    for case in cases:
        for seed in seeds:
            findings = diagnosed(case.recording(seed)).findings
            told = [name for name in case.names if any(name in (f.mechanism, *f.alternatives) for f in findings)]
            right += len(told) == len(case.names) == len(findings)
    assert right >= at_least(len(cases) * len(seeds), 0.95)


@pytest.mark.slow
def test_what_follows_a_motor_is_told_as_such() -> None:
    command = torch.from_numpy(np.repeat(np.random.default_rng(3).uniform(size=N // 512 + 1), 512)[:N])
    late = signal.lfilter([0.02], [1, -0.98], command.numpy())
    x = noise(4) + np.array([[2.0], [0.0], [-1.5]]) * late
    report = diagnosed(x, None, motor=command, count=torch.arange(N, dtype=torch.float64))
    assert [(f.mechanism, f.channel) for f in report.findings] == [("channel_coupling", "motor")]
    assert set(report.findings[0].sensors) == {0, 2}


def louder(seed: int, sd: np.ndarray) -> np.ndarray:
    """White noise of a sd `(time,)`, beside slow noise as it is."""
    g = torch.Generator().manual_seed(seed)
    white, slow = (process.simulate(N, batch=(3,), generator=g).numpy() for process in MODEL.processes)
    return sd * white + slow


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["level", "size", "vibration"])
def test_noise_as_loud_as_a_channel_says_names_the_channel(kind: str) -> None:
    rng = np.random.default_rng(5)
    if kind == "level":  # a motor's command, in steps
        channel = np.repeat(rng.uniform(0, 1, N // 800 + 1), 800)[:N]
        sd = 1 + channel
    elif kind == "size":  # a rate of turn that goes both ways
        channel = 40 * np.sin(2 * math.pi * 0.05 * T)
        sd = 1 + np.abs(channel) / 40
    else:  # an accelerometer on what shakes in spells
        sd = 1 + np.repeat(rng.uniform(0, 1, N // 1000 + 1), 1000)[:N]
        channel = 9.8 + (sd - 0.5) * rng.standard_normal(N)
    other = torch.from_numpy(rng.standard_normal((1, N)))
    report = diagnosed(louder(31, sd), motor=torch.from_numpy(channel)[None], other=other)
    (found,) = report.findings
    assert (found.mechanism, found.channel, found.effect.kind) == ("variance_change", "motor", kind)
    assert "follows" in found.sentence
    for i in range(3):
        assert found.parameters[f"factor[{i}]"].value == pytest.approx(4.0, rel=0.25)
    assert report.held_out.after < 1.5
    simulated = report.model.simulate(N, channels={"motor": torch.from_numpy(channel)[None]})
    loud = torch.from_numpy(sd > np.quantile(sd, 0.8)), torch.from_numpy(sd < np.quantile(sd, 0.2))
    within, without = (simulated[:, part].var(-1) for part in loud)
    assert bool((within > 1.8 * without).all())


@pytest.mark.slow
def test_noise_that_is_louder_for_a_while_follows_no_channel() -> None:
    loud = np.where((T > 20) & (T < 50), 1.6, 1.0)
    command = torch.from_numpy(np.cumsum(np.random.default_rng(6).standard_normal((1, N)), -1))
    (found,) = diagnosed(louder(32, loud), motor=command).findings
    assert (found.mechanism, found.channel) == ("variance_change", None)


@pytest.mark.slow
def test_jumps_are_seen_beside_a_course_of_temperature() -> None:
    g = np.random.default_rng(3)
    temperature = 25 + 8 * np.sin(2 * math.pi * T / T[-1] / 0.7)
    x = noise(3, 2) + 0.1 * (temperature - 25)
    x[0] += 0.6 * np.where(np.cumsum(g.random(N) < 1 / 300) % 2, 1.0, -1.0)
    report = diagnosed(x, temperature=torch.from_numpy(temperature))
    assert {f.mechanism for f in report.findings} == {"temperature_drift", "random_telegraph"}


@pytest.mark.slow
def test_what_wanders_about_a_frequency_is_no_chirp() -> None:
    g = np.random.default_rng(4)
    f = 60 + signal.lfilter([math.sqrt(1 - 0.998**2)], [1, -0.998], g.standard_normal(N))
    report = diagnosed(noise(4) + 0.7 * np.cos(2 * math.pi * np.cumsum(f) / RATE))
    assert [finding.mechanism for finding in report.findings] == ["drifting_tone"]


@pytest.mark.statistical
def test_paths_of_noise_have_a_mean_likelihood_ratio_below_one() -> None:
    """Ville's bound: of 200 records of one to four sensors one in a hundred may exceed a hundred."""
    found: list[MovingLine] = []
    for seed in range(200):
        recording, simulation, _ = drawn(9000 + seed)
        rows = 1 + seed % 3
        info = SCENE if rows == 3 else RecordingInfo(100.0, "deg/s", ("x", "y", "z")[:rows], {})
        found.append(moving_line(Comparison.of(info, recording[:rows], simulation[:, :rows]).observed))
    ratios = torch.tensor([line.log_ratio for line in found]).exp()
    assert float(ratios.clamp(max=1e3).mean()) < 2
    assert int((ratios > 20).sum()) <= 6


def test_errors_far_beyond_the_noise_are_outliers_and_no_noise() -> None:
    x = noise(5)
    at = np.random.default_rng(5).choice(N, 40, replace=False)
    x[1, at] += 400 * np.sign(np.random.default_rng(6).standard_normal(40))
    report = diagnosed(x)
    assert [(f.mechanism, f.sensors) for f in report.findings] == [("spikes", (1,))]
    assert not report.unexplained
    (found,) = report.findings
    assert found.parameters["amplitude[1]"].low < 400 < found.parameters["amplitude[1]"].high


@pytest.mark.slow
def test_physics_is_complete_only_where_nothing_else_is_seen() -> None:
    complete = "The physics is complete, the numbers were wrong."
    assert complete in diagnosed(1.3 * noise(7)).summary()
    at_random = np.random.default_rng(8).choice([1.0, 3.0], N // 512 + 1).repeat(512)[:N]
    assert complete not in diagnosed(at_random * noise(8)).summary()


@pytest.mark.slow
def test_noise_that_is_far_louder_for_a_while_is_no_other_unit() -> None:
    """Its power on average is that of 9.81 times the noise."""
    loud = np.where((T > 20) & (T < 45), 17.5, 1.0)
    (found,) = diagnosed(louder(41, loud)).findings
    assert found.mechanism == "variance_change"
    (found,) = diagnosed(9.80665 * noise(42)).findings
    assert "m/s^2 against g" in found.sentence


@pytest.mark.slow
@pytest.mark.parametrize("half_width", [0.5, 2.0])
def test_a_dead_band_of_nearly_all_values_is_one(half_width: float) -> None:
    """Of 2 sd 95 % of the values are zero, which a sensor that hangs would hold as well."""
    x = noise(43)
    findings = diagnosed(np.where(np.abs(x) < half_width, 0.0, x)).findings
    assert [f.mechanism for f in findings] == ["quantization"]
    assert "a dead band" in findings[0].sentence
    assert findings[0].parameters["dead_band[0]"].value == pytest.approx(half_width, rel=0.01)


@pytest.mark.slow
def test_a_pulse_in_quiet_times_is_none_beside_a_tone_in_spells() -> None:
    x = noise(44) + 6.0 * np.cos(2 * math.pi * 71.3 * T) * ((T > 20) & (T < 45))
    findings = diagnosed(x).findings
    assert [f.mechanism for f in findings] == ["vibration_tone"]


def test_what_is_left_of_the_form_of_something_far_stronger_has_no_name() -> None:
    """A hundredth of the power of what was taken off, in the same bands; the same without it is physics."""
    start = Comparison.of(SCENE, *drawn(45)[:2])
    f = start.bands.frequency
    near = ((f / 0.2).log().abs() < 0.3).to(torch.float64)

    class Louder(Mechanism):
        def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
            return matrices * (1 + 0.5 * near)[:, None, None]

    t = torch.arange(start.n_samples, dtype=torch.float64)
    tones = sum(torch.cos(2 * math.pi * float(fk) * t) for fk in f[near > 0])
    sd = start.reference.power.mean().sqrt()
    for size, left in ((0.0, False), (0.02, False), (20.0, True)):
        path = size * sd * tones.expand_as(start.recording)
        given = replace(start, as_came=replace(start.as_came, signal=(start.recording + path)[None]))
        assert is_left_of_form(Louder(), start, given) is left, size
    # A hundredth of what a filter has taken away is no part of its form.
    loud = replace(start, reference=replace(start.reference, signal=1e3 * start.reference.signal))
    assert not is_left_of_form(Louder(), loud, start)
