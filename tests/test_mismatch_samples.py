"""Simulations that are samples of another time, or of a simulator that rounds: lattices and humps of their own."""

from __future__ import annotations

import math

import pytest
import torch
from mismatch_draws import SCENE, drawn
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.lattices import exact_lattices, missing_lattices
from gyrofuse.mismatch.mechanisms.quantization import Quantization

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
    case = Case.of(SCENE, clean[0], rounded(clean, step))
    rounding = Quantization.of_simulation(case)
    assert rounding is not None
    brought = rounding.brought_forward(case, g)
    torch.testing.assert_close(brought.simulated.signal, case.simulated.signal, rtol=0, atol=1e-9)
    for lag in range(4):
        end = clean.shape[-1] - lag
        wanted, found, before = (
            (x[..., lag:] * x[..., :end]).mean() for x in (clean, brought.analog, case.simulated.signal)
        )
        # Rounding adds step^2/12, and even places within steps would add as much again.
        assert abs(found - wanted) < 0.002 + 0.15 * step**2 / 12
        if lag == 0:
            assert before - wanted == pytest.approx(step**2 / 12, rel=0.3)


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
    case = Case.of(SCENE, recording, rounded(noise(N, g), 0.25)[None])
    rounding = Quantization.of_simulation(case)
    assert rounding is not None
    built = rounding.brought_forward(case, g).built_in(lambda x: x + weak)
    assert all(lattice is not None for lattice in exact_lattices(built.simulated))
    change = built.simulated.signal - case.simulated.signal
    assert float((change * weak).sum() / weak.square().sum()) == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize("seed", range(3))
def test_a_hump_that_the_simulation_has_elsewhere_is_not_doubled(seed: int) -> None:
    g = generator(seed)
    recording, simulation = (noise(N, g) + wandering(frequency, g) for frequency in (20.5, 19.8))
    report = gf.diagnose(recording, simulation, rate=RATE)
    assert report.mismatch
    assert not report.findings
    assert {"spectrum", "shape", "bump"} & {evidence.witness for evidence in report.unexplained}
    assert report.held_out.after < 1.2 * max(report.held_out.before, 1.0)


@pytest.mark.parametrize("amplitude", [0.08, 0.38])  # steps; the larger one hides the step itself, J0 is 0
def test_a_recording_that_something_was_taken_off_has_the_lattice_of_its_simulation_still(amplitude: float) -> None:
    recording, simulation, _ = drawn(5)
    step = float(recording.diff().std()) / 2
    left = amplitude * step * torch.cos(0.7 * torch.arange(recording.shape[-1]) + 1.0)  # of a tone not quite the one
    given = rounded(recording, step) - left
    assert Quantization.nominate(Case.of(SCENE, given, rounded(simulation, step)), 1e-3) is None
    assert missing_lattices(Case.of(SCENE, given, rounded(simulation, step)), 1.0).lattices == {}
    assert Quantization.nominate(Case.of(SCENE, given, simulation), 1e-3) is not None
