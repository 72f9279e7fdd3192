"""What takes turns: converters of two gains, and tones and noise that go up and down with a period."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import gyrofuse as gf
from gyrofuse.mismatch.detectors.lines.interleaving import size_alternation
from gyrofuse.mismatch.mechanisms.regimes.periodic_noise import PeriodicNoise
from gyrofuse.mismatch.mechanisms.signals.harmonics import harmonics_of, sidebands_of
from gyrofuse.mismatch.mechanisms.transients.modulated_tone import ModulatedTone
from gyrofuse.mismatch.mechanisms.values.interleaved_gain import InterleavedGain
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

RATE, N, P = 200.0, 24_000, 3
T = np.arange(N) / RATE
Array = np.ndarray


def noise(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return lfilter([0.5], [1, -0.8], rng.normal(size=(P, N))) + rng.normal(size=(P, N))


def compared(recording: Array, simulation: Array) -> Comparison:
    info = RecordingInfo(RATE, "deg/s", ("a", "b", "c"))
    return Comparison.of(info, torch.from_numpy(recording), torch.from_numpy(simulation)[None])


def with_gains(seed: int, even: float, odd: float) -> Array:
    recording = noise(seed)
    recording[1, ::2] *= even
    recording[1, 1::2] *= odd
    return recording


def hunting(seed: int, frequency_hz: float, slow_hz: float, turn: float, size: float = 0.5) -> Array:
    """A frequency that follows a sine, in all sensors."""
    phase = 2 * np.pi * frequency_hz * T + turn * np.sin(2 * np.pi * slow_hz * T)
    return noise(seed) + size * np.array([[1.0], [-0.7], [0.5]]) * np.cos(phase)


def beating(seed: int, frequency_hz: float, slow_hz: float) -> Array:
    """A size that follows a sine, in all sensors."""
    size = 1 + 0.8 * np.sin(2 * np.pi * slow_hz * T)
    return noise(seed) + 0.5 * np.array([[1.0], [-0.7], [0.5]]) * size * np.cos(2 * np.pi * frequency_hz * T)


def test_gains_of_every_second_sample_are_seen_where_they_are():
    for seed in range(6):
        assert size_alternation(compared(noise(seed), noise(seed + 50))).p_value > 1e-3
        found = size_alternation(compared(with_gains(seed, 1.0, 1.15), noise(seed + 50)))
        assert found.p_value < 1e-7
        assert int(found.square.argmax()) == 1


def test_pulses_at_even_samples_are_no_gain():
    recording = noise(1)
    recording[:, ::400] += 8.0
    assert size_alternation(compared(recording, noise(2))).p_value > 1e-3


@pytest.mark.parametrize(("even", "odd"), [(1.0, 1.5), (0.7, 1.0), (1.3, 1.7)])
def test_gains_have_their_limits_and_are_taken_back(even: float, odd: float):
    comparison = compared(with_gains(3, even, odd), noise(4))
    finding = InterleavedGain.detect_and_fit(comparison, 1e-3)
    assert finding is not None
    assert finding.sensors == (1,)
    ratio = finding.parameters["gain_ratio[1]"]
    assert ratio.low < odd / even < ratio.high < 1.1 * ratio.low
    left = finding.effect.repair(comparison, torch.Generator().manual_seed(0)).recording
    np.testing.assert_allclose(left, noise(3), atol=0.05 * np.abs(noise(3)).max())


@pytest.mark.slow
def test_gains_are_named_with_nothing_beside_them():
    report = gf.diagnose(torch.from_numpy(with_gains(5, 1.0, 1.4)), torch.from_numpy(noise(6)), rate=RATE)
    assert [(f.mechanism, f.sensors) for f in report.findings] == [("interleaving", (1,))]
    assert not report.unexplained
    assert report.held_out.after < 1.5


@pytest.mark.parametrize("slow_hz", [0.4, 1.9])
def test_a_tone_that_hunts_has_lines_evenly_beside_it(slow_hz: float):
    turn = 2.0
    comparison = compared(hunting(7, 37.3, slow_hz, turn), noise(8))
    found = ModulatedTone.detect_and_fit(comparison, 1e-3)
    assert found is not None
    assert found.sensors == (0, 1, 2)
    for name, truth in (("frequency", 37.3), ("modulation", slow_hz)):
        limits = found.parameters[name]
        assert limits.low - (limits.high - limits.low) < truth < limits.high + (limits.high - limits.low)
    path = found.effect.remove(torch.zeros(P, N, dtype=torch.float64), comparison.info)
    wanted = hunting(7, 37.3, slow_hz, turn) - noise(7)
    assert float((path.numpy() + wanted).std()) < 0.05


def test_a_tone_that_beats_has_one_line_on_either_side():
    comparison = compared(beating(9, 41.7, 0.8), noise(10))
    found = sidebands_of(comparison, comparison.line.frequency)
    assert found is not None
    assert found.orders == (-1, 1)
    assert found.spacing * RATE == pytest.approx(0.8, abs=0.02)


def test_tones_without_a_period_in_common_are_no_sidebands():
    tones = sum(np.cos(2 * np.pi * f * T) for f in (31.0, 33.3, 38.4, 47.9))
    comparison = compared(noise(11) + 0.4 * tones, noise(12))
    assert sidebands_of(comparison, comparison.line.frequency) is None


def test_multiples_of_one_frequency_are_no_sidebands():
    rotor = sum(np.cos(2 * np.pi * k * 9.1 * T + k) for k in (1, 2, 3, 4, 5))
    comparison = compared(noise(13) + 0.4 * rotor, noise(14))
    assert ModulatedTone.detect_and_fit(comparison, 1e-3) is None


def test_pulses_that_come_again_and_again_are_harmonics_of_one_frequency():
    """Whose strongest line is a multiple of it."""
    recording = noise(15)
    for k in range(3):
        recording[:, k::120] += 4.0
    comparison = compared(recording, noise(16))
    series = harmonics_of(comparison, 6 / 120, 1e-9)
    assert series.multiple == 6
    assert len(series.others) > 20


@pytest.mark.slow
@pytest.mark.parametrize("made", [hunting(17, 60.0, 0.7, 3.0), beating(18, 25.0, 1.3)], ids=["hunting", "beating"])
def test_they_are_named_once(made: Array):
    report = gf.diagnose(torch.from_numpy(made), torch.from_numpy(noise(19)), rate=RATE)
    assert [f.mechanism for f in report.findings] == ["vibration_tone"]
    assert report.held_out.after < 1.5
    assert math.isfinite(report.findings[0].parameters["modulation"].value)


def breathing(seed: int, frequency_hz: float, depth: float) -> Array:
    """Noise of two sensors whose size follows a sine."""
    made = noise(seed)
    made[:2] *= 1 + depth * np.sin(2 * np.pi * frequency_hz * T)
    return made


@pytest.mark.parametrize("frequency_hz", [0.13, 1.7])
def test_noise_that_breathes_has_its_period_and_its_factor(frequency_hz: float):
    found = PeriodicNoise.detect_and_fit(compared(breathing(20, frequency_hz, 0.4), noise(21)), 1e-3)
    assert found is not None
    assert found.sensors == (0, 1)
    limits = found.parameters["frequency"]
    assert limits.low - (limits.high - limits.low) < frequency_hz < limits.high + (limits.high - limits.low)
    assert found.parameters["factor[0]"].value == pytest.approx((1.4 / 0.6) ** 2, rel=0.25)


def test_a_level_that_wanders_or_changes_once_has_no_period():
    rng = np.random.default_rng(22)
    wander = np.exp(0.5 * lfilter([0.045], [1, -0.999], rng.normal(size=N)))
    once = np.where(np.arange(N) > N // 2, 1.5, 1.0)
    for course in (wander, once):
        assert PeriodicNoise.detect_and_fit(compared(noise(23) * course, noise(24)), 1e-3) is None


@pytest.mark.slow
def test_noise_that_breathes_is_named():
    report = gf.diagnose(torch.from_numpy(breathing(25, 0.6, 0.4)), torch.from_numpy(noise(26)), rate=RATE)
    assert [(f.mechanism, f.sensors) for f in report.findings] == [("variance_change", (0, 1))]
    assert report.held_out.after < 1.5
