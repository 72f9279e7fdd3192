"""Simulations that are samples of another time, or of a simulator that rounds: lattices and humps of their own."""

from __future__ import annotations

import math

import pytest
import torch
from mismatch_draws import SCENE, drawn
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.values.lattices import exact_lattices
from gyrofuse.mismatch.detectors.values.quantisation_grid import missing_lattices
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.signals.comparison import Comparison

N, P, RATE = 16384, 3, 100.0
NOISE = gf.WhiteNoise(1.0) + gf.AR1(0.98, 0.004)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(n: int, g: torch.Generator) -> Tensor:
    return NOISE.simulate(n, batch=(P,), generator=g)


def rounded(x: Tensor, step: float) -> Tensor:
    return step * torch.round(x / step)


def wandering(frequency: float, g: torch.Generator) -> Tensor:
    """A tone of the last sensor that stays within some tenths of a hertz."""
    walk = gf.AR1(0.9995, 2 * 0.0005 * 0.15**2).simulate(N, generator=g)
    phase = 2 * math.pi * torch.cumsum((frequency + walk) / RATE, -1)
    return torch.stack([torch.zeros(N, dtype=torch.float64)] * (P - 1) + [1.2 * phase.sin()])


@pytest.mark.parametrize("step", [0.2, 0.8])
def test_what_was_rounded_had_the_variance_and_the_correlation_of_the_noise(step: float) -> None:
    g = generator(1)
    clean = gf.AR1(0.6, 0.64).simulate(2**18, batch=(2, P), generator=g)  # of variance one
    comparison = Comparison.of(SCENE, clean[0], rounded(clean, step))
    rounding = Quantization.in_reference(comparison)
    assert rounding is not None
    undone = rounding.undo_in_reference(comparison, g)
    assert undone.reference.signal is comparison.reference.signal
    again = undone.apply(lambda x: x).reference.signal
    torch.testing.assert_close(again, comparison.reference.signal, rtol=0, atol=1e-9)
    for lag in range(4):
        end = clean.shape[-1] - lag
        wanted, found, before = (
            (x[..., lag:] * x[..., :end]).mean() for x in (clean, undone.analog, comparison.reference.signal)
        )
        # Rounding adds step^2/12, and even places within steps would add as much again.
        assert abs(found - wanted) < 0.002 + 0.15 * step**2 / 12
        if lag == 0:
            assert before - wanted == pytest.approx(step**2 / 12, rel=0.3)


@pytest.mark.slow
def test_what_is_built_into_rounded_samples_is_rounded_as_they_are() -> None:
    g = generator(2)
    t = torch.arange(N) / RATE
    tone = torch.tensor([0.12, 0.1, 0.0], dtype=torch.float64)[:, None] * torch.cos(2 * math.pi * 11.3 * t)
    recording, simulation = rounded(noise(N, g) + tone, 0.25), rounded(noise(4 * N, g), 0.25)
    report = gf.diagnose(recording, simulation, rate=RATE)
    assert [finding.mechanism for finding in report.findings] == ["vibration_tone"]
    assert not report.unexplained
    assert report.held_out.auc_after < 0.55
    made = report.model.simulate(N, generator=g)
    assert float((made / 0.25 - torch.round(made / 0.25)).abs().max()) < 1e-6
    assert not gf.diagnose(recording, report.model, rate=RATE).mismatch
    # What is far smaller than a step is there as well, on average.
    weak = (tone / 10).unsqueeze(0)
    comparison = Comparison.of(SCENE, recording, rounded(noise(N, g), 0.25)[None])
    rounding = Quantization.in_reference(comparison)
    assert rounding is not None
    built = rounding.undo_in_reference(comparison, g).apply(lambda x: x + weak)
    assert all(lattice is not None for lattice in exact_lattices(built.reference))
    change = built.reference.signal - comparison.reference.signal
    assert float((change * weak).sum() / weak.square().sum()) == pytest.approx(1.0, abs=0.35)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_hump_that_the_simulation_has_elsewhere_is_not_doubled(seed: int) -> None:
    g = generator(seed)
    recording, simulation = (noise(N, g) + wandering(frequency, g) for frequency in (20.5, 19.8))
    report = gf.diagnose(recording, simulation, rate=RATE)
    assert report.mismatch
    assert not report.findings
    assert {"spectrum", "shape", "bump"} & {evidence.test for evidence in report.unexplained}
    assert report.held_out.after < 1.2 * max(report.held_out.before, 1.0)


@pytest.mark.slow
def test_a_hump_is_not_doubled_after_another_repair() -> None:
    """What an earlier finding mended is no room for a later one that leads away."""
    g = generator(0)
    recording, simulation = (noise(N, g) + wandering(frequency, g) for frequency in (20.5, 19.8))
    louder = torch.tensor([1.6, 1.0, 1.0], dtype=torch.float64)[:, None]
    report = gf.diagnose(louder * recording, simulation, rate=RATE)
    named = [finding.mechanism for finding in report.findings]
    assert named[0] == "parameter_shift"
    assert not {"resonance", "drifting_tone"} & set(named)
    assert report.held_out.before > 50
    assert report.held_out.after < 2


@pytest.mark.slow
def test_lines_that_both_have_do_not_speak_against_other_levels() -> None:
    g = generator(3)
    line = 4 * torch.cos(0.9 * torch.arange(4 * N))
    report = gf.diagnose(1.25 * noise(N, g) + line[:N], noise(4 * N, g) + line, rate=RATE)
    assert report.findings[0].mechanism == "parameter_shift"


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_a_model_of_rounded_samples_is_rounded_once(step: float) -> None:
    g = generator(6)
    recording, simulation = rounded(noise(N, g), step), rounded(noise(2 * N, g), step)
    model = gf.diagnose(recording, simulation, rate=RATE).model
    made = model.simulate(2 * N, generator=g)
    torch.testing.assert_close(made.var(-1), simulation.var(-1), rtol=0.05, atol=0)
    assert not gf.diagnose(recording, model, rate=RATE).mismatch


@pytest.mark.parametrize("factor", [math.pi / 180, 180 / math.pi])
def test_other_units_of_rounded_samples(factor: float) -> None:
    g = generator(7)
    recording, simulation = factor * rounded(noise(N, g), 0.2), rounded(noise(N, g), 0.2)
    report = gf.diagnose(recording, simulation, rate=RATE)
    assert [finding.mechanism for finding in report.findings] == ["parameter_shift"]
    assert not report.unexplained
    made = report.model.simulate(N, generator=g) / (0.2 * factor)
    assert float((made - made.round()).abs().max()) < 1e-6
    torch.testing.assert_close(made.var(-1), (recording / (0.2 * factor)).var(-1), rtol=0.1, atol=0)


def test_what_was_rounded_keeps_its_lines_and_what_sensors_share() -> None:
    g = generator(8)
    n = 2**17
    common = torch.randn(n, generator=g, dtype=torch.float64)
    white = torch.randn(P, n, generator=g, dtype=torch.float64)
    line = 4 * torch.cos(0.9 * torch.arange(n, dtype=torch.float64))
    clean = (2 * common + white) / math.sqrt(5) + line
    comparison = Comparison.of(SCENE, clean, rounded(clean, 0.5)[None]).knowing((0.9 / (2 * math.pi),))
    rounding = Quantization.in_reference(comparison)
    assert rounding is not None
    analog = rounding.undo_in_reference(comparison, g).analog[0]
    amplitude = 2 * (analog * torch.cos(0.9 * torch.arange(n))).mean(-1)
    torch.testing.assert_close(amplitude, torch.full((P,), 4.0, dtype=torch.float64), rtol=0, atol=0.015)
    shared = torch.cov(analog - line) - torch.cov(clean - line)
    assert float(shared.abs().max()) < 0.008  # without them 0.02


@pytest.mark.parametrize("amplitude", [0.08, 0.38])  # steps; the larger one hides the step itself, J0 is 0
def test_a_recording_that_something_was_taken_off_has_the_lattice_of_its_simulation_still(amplitude: float) -> None:
    recording, simulation, _ = drawn(5)
    step = float(recording.diff().std()) / 2
    left = amplitude * step * torch.cos(0.7 * torch.arange(recording.shape[-1]) + 1.0)  # of a tone not quite the one
    given = rounded(recording, step) - left
    taken = Comparison.of(SCENE, rounded(recording, step), rounded(simulation, step)).subtract(left)
    assert Quantization.detect_and_fit(taken, 1e-3) is None
    assert missing_lattices(Comparison.of(SCENE, given, rounded(simulation, step)), 1.0).lattices == {}
    assert Quantization.detect_and_fit(Comparison.of(SCENE, given, simulation), 1e-3) is not None


@pytest.mark.slow
@pytest.mark.parametrize("finer", [0.0, 0.2], ids=["no step", "finer steps"])
def test_rounding_that_only_the_simulation_has_is_told_and_goes(finer: float) -> None:
    g = generator(21)
    x = noise(N, g)
    given = rounded(x, finer) if finer else x
    report = gf.diagnose(given, rounded(noise(2 * N, g), 0.8), rate=RATE)
    (found,) = report.findings
    assert found.mechanism == "quantization"
    assert "the simulation rounds to steps of 0.8" in found.sentence
    assert found.parameters["simulated_lsb[0]"].value == pytest.approx(0.8)
    assert [name in found.parameters for name in ("lsb[0]",)] == [bool(finer)]
    assert not report.unexplained
    if not finer:
        before, after = (ax.dataLim.height for ax in found.plot())
        assert before > 5 * after > 0  # the peak of the simulation's steps goes
    simulated = report.model.simulate(N, generator=g)
    lattices = exact_lattices(Comparison.of(report.model.info, simulated, simulated[None]).observed)
    assert [None if own is None else round(own.step, 6) for own in lattices] == [finer or None] * P
    assert not gf.diagnose(given, report.model, rate=RATE).mismatch


def test_rounding_of_one_sensor_of_the_simulation_alone() -> None:
    g = generator(22)
    x, simulation = noise(N, g), rounded(noise(2 * N, g), 0.8)
    given = torch.cat([rounded(x[:2], 0.8), x[2:]])
    (found,) = gf.diagnose(given, simulation, rate=RATE).findings
    assert (found.mechanism, found.sensors) == ("quantization", (2,))
    # So much finer than the noise that nothing of it can be seen but the values themselves.
    assert not gf.diagnose(x, rounded(noise(2 * N, g), 0.05), rate=RATE).mismatch
    # Gaps were filled with means of their neighbours.
    filled = rounded(x, 0.8)
    filled[:, 1000:11000:50] = (filled[:, 999:10999:50] + filled[:, 1001:11001:50]) / 2
    assert "quantization" not in {f.mechanism for f in gf.diagnose(filled, simulation, rate=RATE).findings}
