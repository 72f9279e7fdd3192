"""A bent scale, and noise that only looks like one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import gyrofuse as gf
from gyrofuse.mismatch.detectors.values.bends import bends
from gyrofuse.mismatch.likelihoods.laws.bend import BentNoise, Curve
from gyrofuse.mismatch.mechanisms.values.nonlinearity import Nonlinearity
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from tests.slow_cases import slow_but_for

RATE, N, P = 200.0, 24_000, 3
Array = np.ndarray
CURVE = Curve(np.array([-1.5, -0.5, 0.0, 1.0, 2.5]), np.array([0.4, 0.9, 1.0, 1.3, 2.2]))


def noise(seed: int, phi: float = 0.8) -> Array:
    """White noise and an AR1 of about the same size, `(sensor, time)`."""
    rng = np.random.default_rng(seed)
    return lfilter([0.5], [1, -phi], rng.normal(size=(P, N))) + rng.normal(size=(P, N))


def compared(recording: Array, simulation: Array) -> Comparison:
    info = RecordingInfo(RATE, "deg/s", ("a", "b", "c"))
    return Comparison.of(info, torch.from_numpy(recording), torch.from_numpy(simulation)[None])


def unequal(x: Array) -> Array:
    """Another gain on either side."""
    return x + 0.35 * np.hypot(x, 1.0)


def saturating(x: Array) -> Array:
    return 2.0 * np.tanh(x / 2.0)


def expanding(x: Array) -> Array:
    return x + 0.12 * x**3


BENT: dict[str, Callable[[Array], Array]] = {"unequal": unequal, "saturating": saturating, "expanding": expanding}


def test_a_curve_has_the_slope_that_it_says_and_an_inverse():
    y = np.linspace(-4, 5, 2001)
    middle = (y[1:] + y[:-1]) / 2
    np.testing.assert_allclose(np.diff(CURVE.at(y)) / np.diff(y), CURVE.slope(middle), rtol=1e-3)
    np.testing.assert_allclose(CURVE.inverse(CURVE.at(y)), y, atol=1e-12)
    assert CURVE.at(np.zeros(1)) == 0


def test_coefficients_are_those_of_a_polynomial():
    """Of a curve whose inverse is nearly one: `y = x + q x^2`, within the values that it has."""
    q, knots = 0.05, np.linspace(-4, 5, 60)
    x = (-1 + np.sqrt(1 + 4 * q * knots)) / (2 * q)
    found = Curve(knots, 1 / (1 + 2 * q * x)).coefficients(0.0, 0.8)
    np.testing.assert_allclose(found, [q, 0.0], atol=1e-3)


def test_the_likeliest_curve_is_the_one_that_was_there():
    x = noise(1)[0]
    base = compared(noise(1), noise(2)).base
    y = CURVE.inverse(x - x.mean())
    put_out = torch.from_numpy(y - y.mean())
    found = BentNoise.of(put_out, base, 0, CURVE.knots - y.mean())
    slopes = found.likeliest().slopes
    sd = np.sqrt(np.diag(found.covariance(Curve(found.knots, slopes))))
    middle = len(slopes) // 2
    truth = np.log(CURVE.slopes / CURVE.slopes[middle])
    assert sd.max() < 0.2
    assert (np.abs(np.log(slopes) - truth) <= 4 * sd + 1e-9).all()


def test_scores_of_bends_are_no_larger_than_chance_has_them():
    """Of Gaussian noise, of heavy tails alike in both, and of a tone in both."""
    t = np.arange(N) / RATE
    for seed in range(8):
        p, q = noise(seed), noise(seed + 100)
        assert float(bends(compared(p, q)).p_values.min()) > 1e-4
        tone = 2 * np.sin(2 * np.pi * 31.3 * t)
        assert float(bends(compared(p + tone, q + tone)).p_values.min()) > 1e-4
        rng = np.random.default_rng(seed)
        heavy = [one + rng.standard_t(4, (P, N)) for one in (p, q)]
        assert float(bends(compared(*heavy)).p_values.min()) > 1e-4


@pytest.mark.parametrize("form", BENT)
def test_a_bent_scale_is_found_and_taken_back(form: str):
    recording = noise(3)
    felt = recording[1].copy()
    recording[1] = BENT[form](felt)
    comparison = compared(recording, noise(4))
    finding = Nonlinearity.detect_and_fit(comparison, 1e-3)
    assert finding is not None
    assert finding.sensors == (1,)
    straight = finding.effect.repair(comparison, torch.Generator().manual_seed(0)).recording
    np.testing.assert_array_equal(straight[[0, 2]], comparison.recording[[0, 2]])
    off = straight[1].numpy() - straight[1].numpy().mean() - (felt - felt.mean())
    assert off.std() < 0.07 * felt.std()
    quadratic, cubic = (finding.parameters[f"{name}[1]"] for name in ("quadratic", "cubic"))
    assert (quadratic.low > 0) == (form == "unequal")
    assert (cubic.high < 0) == (form == "saturating")


def test_heavy_tails_tones_and_episodes_are_no_bent_scale():
    rng, t = np.random.default_rng(5), np.arange(N) / RATE
    tone = 2 * np.sin(2 * np.pi * 31.3 * t) + 0.8 * np.cos(4 * np.pi * 31.3 * t)
    episodes = 1 + 1.5 * (lfilter([1], [1, -0.9], rng.normal(size=N)) > 2)
    for made in (
        noise(6) + 0.7 * rng.standard_t(4, (P, N)),
        noise(6) + tone,
        noise(6) * episodes,
        noise(6) + 3 * (np.cumsum(rng.random(N) < 0.01) % 2),
        noise(6) + (rng.random((P, N)) < 0.003) * rng.exponential(8, (P, N)),
    ):
        assert Nonlinearity.detect_and_fit(compared(made, noise(7)), 1e-3) is None


@pytest.mark.parametrize("form", slow_but_for({"saturating"}, list(BENT)))
def test_is_named_with_nothing_beside_it(form: str):
    recording = noise(8)
    recording[:2] = BENT[form](recording[:2])
    report = gf.diagnose(torch.from_numpy(recording), torch.from_numpy(noise(9)), rate=RATE)
    assert [(f.mechanism, f.sensors) for f in report.findings] == [("nonlinearity", (0, 1))]
    assert not report.unexplained
    assert report.held_out.after < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("law", ["student", "laplace"])
def test_noise_of_heavy_tails_has_a_name(law: str):
    rng, recording = np.random.default_rng(10), noise(11)
    drawn = rng.standard_t(4, N) if law == "student" else rng.laplace(size=N)
    recording[2] += drawn
    report = gf.diagnose(torch.from_numpy(recording), torch.from_numpy(noise(12)), rate=RATE)
    assert "scale_mixture" in [f.mechanism for f in report.findings]
    assert "nonlinearity" not in [f.mechanism for f in report.findings]
    assert report.held_out.after < 1.5
