"""A tone that starts and stops: told from one that is there all the time, from beats, resonances and knocks."""

from __future__ import annotations

import math

import pytest
import torch
from mismatch_draws import normal
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.mechanisms.transients.tone_in_spells import ToneInSpells
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

N, RATE, F = 16384, 200.0, 26.0
GAINS = torch.tensor([1.0, 0.8, -0.6], dtype=torch.float64)[:, None]
INFO = RecordingInfo(RATE, "deg/s", ("1", "2", "3"))
MODEL = gf.ArrayModel.from_sensors([gf.Model([gf.WhiteNoise(1.0)])] * 3)
T = torch.arange(N, dtype=torch.float64) / RATE
SPELLS = ((5.0, 15.0), (40.0, 45.0), (60.0, 77.5))


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def running(spells: tuple[tuple[float, float], ...], nats: float, *, anew: bool = True) -> Tensor:
    """Of nats in noise of variance one, `(sensor, time)`; in another phase after each start, or in one."""
    path = torch.zeros(N, dtype=torch.float64)
    for k, (start, stop) in enumerate(spells):
        on = (start <= T) & (stop > T)
        path += on * torch.sin(2 * math.pi * F * T + 2.0 * k * anew)
    signal = GAINS * path
    return signal * math.sqrt(2 * nats / float(signal.square().sum()))


def found_in(effect: Tensor, seed: int) -> gf.MismatchReport:
    signal = normal(3, N, g=generator(seed)) + effect
    return gf.diagnose(gf.Recording(signal, rate=RATE, unit="deg/s"), MODEL)


@pytest.mark.slow
@pytest.mark.parametrize("nats", [3000.0, 100_000.0])
@pytest.mark.parametrize("anew", [True, False])
def test_all_spells_are_one_finding(nats: float, anew: bool):
    report = found_in(running(SPELLS, nats, anew=anew), 1)
    (finding,) = report.findings
    assert finding.mechanism == "vibration_tone"
    assert isinstance(finding.effect, ToneInSpells)
    ends = torch.stack([finding.effect.start_s, finding.effect.stop_s], -1)
    torch.testing.assert_close(ends, torch.tensor(SPELLS, dtype=torch.float64), rtol=0, atol=1500 / nats + 2 / RATE)
    value, low, high, _ = finding.parameters["frequency"]
    assert low <= F <= high
    assert high - low < 0.1
    assert value == finding.frequency_hz
    assert report.held_out.after < 1.3
    assert not report.unexplained


def test_a_weak_spell_is_measured():
    report = found_in(running(((25.0, 45.0),), 100.0), 7)
    (finding,) = report.findings
    assert isinstance(finding.effect, ToneInSpells)
    for name, truth in (("start", 25.0), ("stop", 45.0)):
        value, low, high, _ = finding.parameters[name]
        assert abs(value - truth) < high - low


def test_what_is_there_all_the_time_has_no_spells():
    steady = running(((0.0, N / RATE),), 1000.0)
    swelling = steady * (1 + 0.9 * torch.sin(2 * math.pi * 3 * T / T[-1]))
    g = generator(2)
    noise = normal(1, N, g=g)
    bump = torch.fft.irfft(torch.fft.rfft(noise) * (((torch.fft.rfftfreq(N) * RATE) - F).abs() < 0.2), n=N)
    for effect in (steady, swelling, 0.5 * GAINS * bump / bump.std()):
        comparison = Comparison.of(INFO, normal(3, N, g=g) + effect, normal(4, 3, N, g=g))
        assert ToneInSpells.detect_and_fit(comparison, 1e-3) is None


@pytest.mark.slow
def test_a_repaired_simulation_is_on_as_long_at_other_times():
    report = found_in(running(SPELLS, 30_000.0), 3)
    drawn = report.model.simulate(N, batch=(20,), generator=generator(4))
    share = (drawn[:, 0, : N // 64 * 64].unflatten(-1, (-1, 64)).std(-1) > 2).to(torch.float64)
    expected = sum(stop - start for start, stop in SPELLS) / (N / RATE)
    assert float(share.mean()) == pytest.approx(expected, abs=0.03)
    assert float(share.mean(0).std()) < 0.25  # at other times in each record


@pytest.mark.statistical
def test_a_tone_that_swells_and_fades_is_three():
    """An amplitude that swings has a line on either side, which together come and go as spells do."""
    swelling = (1 + 0.7 * torch.sin(2 * math.pi * 5 / N * RATE * T)) * torch.sin(2 * math.pi * F * T)
    report = found_in(0.6 * GAINS * swelling, 4)
    assert [finding.mechanism for finding in report.findings] == ["vibration_tone"] * 3
    assert all(isinstance(finding.effect, VibrationTone) for finding in report.findings)
    found = sorted(finding.frequency_hz for finding in report.findings)
    assert found == pytest.approx([F - 5 / N * RATE, F, F + 5 / N * RATE], abs=1e-3)
