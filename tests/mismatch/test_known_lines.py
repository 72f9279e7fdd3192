"""Tones that the simulation knows of: no finding where the recording has them alike, one where they differ."""

from __future__ import annotations

import math

import pytest
import torch

import gyrofuse as gf
from gyrofuse.mismatch.detectors import tests as court
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.repair.serialise import repaired_from_dict
from gyrofuse.mismatch.signals import known_lines
from gyrofuse.mismatch.signals.known_lines import amplitudes, precise, without_lines
from gyrofuse.mismatch.signals.lines import simulated_lines

N, RATE = 16_384, 100.0
NOISE = gf.parse_model("WN(variance=1e-3) + AR1(phi=0.99,variance=1e-6)")


def toned(amplitude: float = 0.02, beta: float = 0.34) -> gf.Model:
    return NOISE + gf.Sinusoid(amplitude, beta)


def observed(model: gf.Model, seed: int, n_samples: int = N) -> gf.Recording:
    signal = model.simulate(n_samples, batch=(3,), generator=torch.Generator().manual_seed(seed))
    return gf.Recording(signal, rate=RATE, unit="deg/s")


@pytest.mark.parametrize("frequency", [0.0007, 0.05411, 0.43])
@pytest.mark.parametrize("off", [-0.4, 0.12])
def test_a_frequency_is_made_precise(frequency: float, off: float):
    t = torch.arange(N, dtype=torch.float64)
    phases = torch.tensor([[0.3], [2.0]], dtype=torch.float64)
    signal = (0.3 * torch.sin(2 * math.pi * frequency * t + phases) + 5.0)[None]  # (record, sensor, time)
    (found,) = precise(signal, (frequency + off / N,))
    assert abs(found - frequency) * N < 1e-5
    torch.testing.assert_close(amplitudes(signal, (found,)), torch.full((1, 2, 1), 0.3, dtype=torch.float64))
    torch.testing.assert_close(without_lines(signal, (found,)), torch.full_like(signal, 5.0), atol=1e-6, rtol=0)


def test_stretches_make_no_difference(monkeypatch: pytest.MonkeyPatch):
    signal = observed(toned(), 1).signal
    frequencies = (0.0541, 0.2)
    whole = without_lines(signal, frequencies), amplitudes(signal, frequencies)
    monkeypatch.setattr(known_lines, "_STRETCH", 1000)
    torch.testing.assert_close((without_lines(signal, frequencies), amplitudes(signal, frequencies)), whole)


@pytest.mark.parametrize(("times", "differs"), [(1.0, False), (4.0, True)])
def test_a_faint_line_of_the_simulation_hides_no_plain_one(times: float, differs: bool):
    """That stands out among few frequencies and not among all; of the same size on both sides it is no difference."""
    frequency, nats = 0.1234, 11.0
    t = torch.arange(N, dtype=torch.float64)
    line = math.sqrt(4 * nats / (3 * N)) * torch.sin(2 * math.pi * frequency * t)

    def noise(seed: int) -> torch.Tensor:
        return torch.randn(3, N, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)

    recording, simulation = (
        gf.Recording(noise(seed) + size * line, rate=RATE, unit="deg/s") for seed, size in ((1, times), (2, 1.0))
    )
    comparison = prepared(recording, simulation, None, torch.Generator().manual_seed(0))
    assert simulated_lines(comparison.reference) == ()
    assert (comparison.line.p_value < 1e-6) == differs
    if differs:
        assert comparison.line.frequency == pytest.approx(frequency, abs=1 / N)


@pytest.mark.statistical
@pytest.mark.parametrize("sampled", [False, True])
def test_a_tone_that_both_have_is_no_mismatch(sampled: bool):
    """Of the same size, and of any phase: sensors agree at its frequency in the one as in the other, and by chance."""
    tones = toned() + gf.Sinusoid(0.003, 1.1) + gf.Sinusoid(0.2, 0.0031 if not sampled else 2.0)
    p_values = []
    for seed in range(8):
        simulation = observed(tones, 100 + seed) if sampled else tones
        comparison = prepared(observed(tones, seed), simulation, None, torch.Generator().manual_seed(seed))
        assert len(comparison.reference.lines) == 3
        p_values.append(court.family_wise_p_value(court.run_tests(comparison)))
    assert min(p_values) > 0.01 / 8
    assert sum(p < 0.1 for p in p_values) <= 3


def test_side_lobes_of_a_strong_tone_hide_no_weak_one():
    tones = toned(0.3, 0.5) + gf.Sinusoid(0.004, 0.56) + gf.Sinusoid(0.004, 1.9)
    comparison = prepared(observed(tones, 1), observed(tones, 2), None, torch.Generator().manual_seed(0))
    found = sorted(2 * math.pi * f for f in simulated_lines(comparison.reference))
    assert found == pytest.approx([0.5, 0.56, 1.9], abs=2e-4)


@pytest.mark.parametrize("factor", [0.0, 0.8, 1.5])
def test_a_tone_of_another_size_is_told(factor: float):
    comparison = prepared(observed(toned(0.02 * factor), 3), toned(), None, torch.Generator().manual_seed(0))
    evidence = min(court.run_tests(comparison), key=lambda e: e.p_value)
    assert evidence.test == "line"
    assert evidence.p_value < 1e-10
    assert evidence.sensors == (0, 1, 2)
    assert evidence.frequency_hz == pytest.approx(0.34 / (2 * math.pi) * RATE)
    said = float(evidence.words.split(" has ")[1].split()[0])
    assert said == pytest.approx(factor, abs=0.1)


def test_a_tone_at_another_frequency_is_named_and_the_missing_one_told():
    report = gf.diagnose(observed(toned(beta=0.345), 4), toned())
    assert [finding.mechanism for finding in report.findings] == ["vibration_tone", "parameter_shift"]
    assert report.findings[0].frequency_hz == pytest.approx(0.345 / (2 * math.pi) * RATE, rel=1e-5)
    assert "the simulation's tone at 5.4112" in report.findings[1].sentence
    assert "is not in the recording" in report.findings[1].sentence
    assert report.unexplained == ()


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [False, True])
def test_a_tone_that_is_nearly_where_it_was_shows_another_clock_or_frequency(sampled: bool):
    """A phase that slips by less than a cycle: no other amplitude, and limits hold the factor of the frequencies."""
    report = gf.diagnose(observed(toned(beta=0.3401), 4), observed(toned(), 100) if sampled else toned())
    (finding,) = report.findings
    assert finding.mechanism == "clock_skew"
    assert finding.alternatives == ("vibration_tone",)
    said = finding.parameters["skew"]
    assert said.low < 1e6 * (0.3401 / 0.34 - 1) < said.high
    assert said.high - said.low < 100
    assert "the simulation's tone at 5.4112" in finding.sentence
    assert not report.unexplained


@pytest.mark.statistical
@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("factor", [0.25, 0.8, 1.5])
def test_another_size_is_a_number_that_was_wrong(sampled: bool, factor: float):
    simulation = observed(toned(), 100) if sampled else toned()
    report = gf.diagnose(observed(toned(0.02 * factor), 3), simulation)
    (finding,) = report.findings
    assert finding.mechanism == "parameter_shift"
    assert report.unexplained == ()
    for i in range(3):
        said = finding.parameters[f"amplitude[{i}]"]
        assert said.low < 0.02 * factor < said.high
        assert said.high - said.low < 0.004
    drawn = report.model.simulate(N, generator=torch.Generator().manual_seed(1))
    assert amplitudes(drawn, (0.34 / (2 * math.pi),))[:, 0] == pytest.approx([0.02 * factor] * 3, abs=0.002)
    again = gf.diagnose(observed(toned(0.02 * factor), 4), repaired_from_dict(report.model.to_dict()))
    assert not again.mismatch


@pytest.mark.slow
def test_only_the_sensor_whose_tone_is_another_is_named():
    signal = observed(toned(), 7).signal
    others = observed(toned(0.03), 7).signal
    report = gf.diagnose(gf.Recording(torch.stack([signal[0], others[1], signal[2]]), rate=RATE), toned())
    (finding,) = report.findings
    assert finding.sensors == (1,)
    assert finding.effect.amplitude[[0, 2]].tolist() == pytest.approx([0.02, 0.02], rel=1e-2)


@pytest.mark.statistical
def test_a_tone_found_in_one_recording_is_known_in_another_whatever_its_phase():
    """Phases count from when a record began."""
    first = gf.diagnose(observed(toned(), 11), NOISE)
    assert [finding.mechanism for finding in first.findings] == ["vibration_tone"]
    p_values = [gf.diagnose(observed(toned(), 20 + seed), first.model).p_value for seed in range(4)]
    assert min(p_values) > 0.01
    larger = gf.diagnose(observed(toned(0.03), 30), first.model)
    assert [finding.mechanism for finding in larger.findings] == ["parameter_shift"]
    assert "instead of 0.02" in larger.findings[0].sentence


def test_what_is_missing_is_found_beside_a_tone_that_both_have():
    recording = observed(toned(), 5)
    late = torch.arange(N) >= 10_000
    stepped = gf.Recording(recording.signal + 0.012 * late, rate=RATE, unit="deg/s")
    report = gf.diagnose(stepped, toned())
    assert [finding.mechanism for finding in report.findings] == ["step"]
    assert report.unexplained == ()


@pytest.mark.statistical
def test_a_strong_tone_is_not_swallowed_by_what_its_fit_leaves():
    """A model fitted as if there were no tone is wrong over the whole spectrum: a hump of it is no wandering tone.

    As one, all of its band would be taken off, and the tone with it.
    """
    n, g = 2**18, torch.Generator().manual_seed(0)
    noise = gf.parse_model("WN(variance=3.09e-3) + AR1(phi=0.998,variance=2.1e-7) + RW(variance=2e-10)")
    tone = 0.0717 * torch.sin(2 * math.pi * 0.113 * torch.arange(n, dtype=torch.float64))
    recording = gf.Recording(noise.simulate(n, batch=(1,), generator=g) + tone, rate=RATE, unit="deg/s")
    fitted = gf.parse_model("AR1(phi=0.338,variance=5.18e-3) + RW(variance=2.57e-8)")
    report = gf.diagnose(recording, fitted)
    assert report.findings[0].mechanism == "vibration_tone"
    assert report.findings[0].frequency_hz == pytest.approx(11.3, rel=1e-6)
    assert "drifting_tone" not in [finding.mechanism for finding in report.findings]
    assert report.held_out.after < 3 < 300 < report.held_out.before
