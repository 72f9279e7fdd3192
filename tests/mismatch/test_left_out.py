"""Noise that a simulation leaves out altogether, or has a multiple of: it is named, the repaired simulation has it."""

from __future__ import annotations

import math

import pytest
import scipy.signal
import torch

import gyrofuse as gf
from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.signals.filters import filtered
from gyrofuse.mismatch.signals.noise_spectrum import fit_base
from gyrofuse.mismatch.signals.psd import bands

N, RATE, P = 2**14, 100.0, 3
WHITE = gf.WhiteNoise(1e-3)


def observed(model: gf.Model | gf.Process, seed: int) -> gf.Recording:
    signal = model.simulate(N, batch=(P,), generator=torch.Generator().manual_seed(seed))
    return gf.Recording(signal, rate=RATE, unit="deg/s")


@pytest.mark.statistical
@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize(
    ("kind", "truth"),
    [
        ("random walk", WHITE + gf.RandomWalk(1e-7)),
        ("AR1 noise", WHITE + gf.AR1(0.98, 3e-6)),
        ("random walk", gf.WhiteNoise(5e-4) + gf.RandomWalk(1e-7)),
    ],
    ids=["walk", "ar1", "walk_and_less_white"],
)
def test_what_white_noise_leaves_out(kind: str, truth: gf.Model, sampled: bool):
    simulation = observed(WHITE, 100) if sampled else WHITE
    report = gf.diagnose(observed(truth, 1), simulation)
    assert [finding.mechanism for finding in report.findings] == ["parameter_shift"]
    sentence = report.findings[0].sentence
    assert sentence.startswith("the simulation shows no ")
    assert f" {kind} " in sentence.split(":")[0]
    assert report.unexplained == ()
    assert report.held_out is not None
    assert report.held_out.after < 1.5


def test_white_noise_that_is_left_out():
    memory = gf.AR1(0.9, 1e-4)
    report = gf.diagnose(observed(memory + gf.WhiteNoise(1e-4), 3), memory)
    assert [finding.mechanism for finding in report.findings] == ["parameter_shift"]
    assert "white noise of sensor 1 none -> " in report.findings[0].sentence
    said = float(report.findings[0].sentence.split("none -> ")[1].split()[0])
    assert said == pytest.approx(1e-2, rel=0.1)
    assert report.unexplained == ()


@pytest.mark.slow
def test_a_filter_that_is_found_later_leaves_a_tone_as_it_is():
    """Its amplitude is that of the recording, whatever other numbers make of the noise."""
    tone = gf.Sinusoid(0.05, 0.34)
    recording = observed(gf.WhiteNoise(1e-2) + tone, 4)
    report = gf.diagnose(recording, WHITE)
    assert [finding.mechanism for finding in report.findings] == ["vibration_tone", "parameter_shift"]
    reference = report.model.simulate(N, generator=torch.Generator().manual_seed(5))
    t = torch.arange(N, dtype=torch.float64)
    amplitude = (reference * torch.polar(torch.ones_like(t), -0.34 * t)).sum(-1).abs() * 2 / N
    assert (amplitude - 0.05).abs().max() < 4 * 0.1 * math.sqrt(2 / N)
    assert float(reference.var(-1).mean()) == pytest.approx(float(recording.signal.var(-1).mean()), rel=0.05)
    # As the simulation of another recording it agrees.
    assert not gf.diagnose(observed(gf.WhiteNoise(1e-2) + tone, 6), report.model).mismatch


def test_white_noise_that_is_made_a_walk_gets_no_slope():
    """Its ordinates are as large as those of a walk, from the slowest on."""
    white = torch.randn(200, N, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    walks = filtered(white, lambda f: (1 / (2 * torch.sin(math.pi * f.clamp(min=0.5 / N)))).expand(200, -1))
    k = torch.arange(1, 9, dtype=torch.float64)
    power = cosine_ordinates(walks)[:, 1:9].square().mean(0) * (2 * torch.sin(math.pi * k / (2 * N))).square()
    assert (power - 1).abs().max() < 4 * math.sqrt(2 / 200)


@pytest.mark.parametrize("n", [2**16, 2**17, 2**18])
def test_fast_noise_is_described_whatever_the_length(n: int):
    """By AR1s of corners that are near enough to its own."""
    truth, f = gf.AR1(0.338, 1.0), bands(n).frequency
    base = fit_base(truth.spectrum(f)[None], bands(n), n, bands(n).dof)
    assert float((base.spectrum(f)[0] / truth.spectrum(f) - 1).abs().max()) < 0.06


@pytest.mark.slow
@pytest.mark.parametrize(("order", "corner"), [(1, 0.3), (2, 0.25)])
def test_an_ar1_that_stands_for_a_filter_is_told(order: int, corner: float):
    """Of a filtered gyroscope a model of white noise, an AR1 and a walk is fitted; a resonance would mend its form."""
    numerator, denominator = scipy.signal.butter(order, 2 * corner)

    def device(seed: int) -> gf.Recording:
        drawn = torch.randn(2, 8192, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        filtered = torch.from_numpy(scipy.signal.lfilter(numerator, denominator, drawn.numpy()))
        return gf.Recording(filtered, rate=RATE, unit="deg/s")

    fit = gf.fit_gmwm(device(1), "WN + AR1 + RW")
    simulation = gf.ArrayModel.from_sensors([fit.model.with_params(row) for row in fit.params])
    report = gf.diagnose(device(2), simulation, judge=device(3))
    assert [finding.mechanism for finding in report.findings] == ["parameter_shift", "low_pass"]
    shift, low_pass = report.findings
    assert shift.sentence.startswith("AR1 noise of the simulation stands for a filter of white noise")
    assert low_pass.frequency_hz == pytest.approx(corner * RATE, rel=0.1)  # beside what is left of the AR1
    assert report.judged is not None
    assert report.judged.helps
    assert report.judged.after < report.judged.before / 3


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.8, pytest.param(0.5, marks=pytest.mark.statistical)])
def test_a_fit_without_the_quantisation_of_an_angle(size: float):
    """What is left out has made the white noise that was fitted too loud: both are told, and explain all."""
    truth = gf.WhiteNoise(1.0) + gf.QuantizationNoise(size**2) + gf.RandomWalk(1e-7)
    g = torch.Generator().manual_seed(5)
    x, earlier = (truth.simulate(n, batch=(3,), generator=g) for n in (20_000, 28_000))
    fit = gf.fit_gmwm(gf.Recording(earlier, 100.0, unit="deg/s"), gf.WhiteNoise() + gf.RandomWalk())
    report = gf.diagnose(gf.Recording(x, 100.0, unit="deg/s"), fit)
    assert {f.mechanism for f in report.findings} == {"parameter_shift", "quantization_noise"}
    assert report.held_out.before > 10
    assert report.held_out.after < 1.7
    added = next(f for f in report.findings if f.mechanism == "quantization_noise")
    white = next(f for f in report.findings if f.mechanism == "parameter_shift")
    for i, fitted in enumerate(fit.params[:, 0].tolist()):
        factor, angle = white.parameters[f"white_factor[{i}]"], added.parameters[f"angle[{i}]"]
        assert fitted > 1.2
        assert abs(1 / fitted / factor.value - 1) < 0.15
        assert abs(size / 100 / angle.value - 1) < 0.05
