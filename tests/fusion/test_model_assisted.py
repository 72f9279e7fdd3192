"""Covariances with a model's help: the fit against its definition, and what it gains and never loses."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from reference import assisted as naive
from torch import Tensor

import gyrofuse as gf
from gyrofuse._base.linalg import geometric_mean
from gyrofuse.fusion.weights import model_assisted as assisted
from gyrofuse.fusion.weights.model_assisted import assisted_covariance
from gyrofuse.fusion.weights.svo import optimal_weights, resolve_scale_weights
from gyrofuse.wavelets.covariance import wavelet_products
from gyrofuse.wavelets.moments import combined_covariance

R = torch.tensor([2.8, 1.4, 1.0, 2.0], dtype=torch.float64).diag()
Q = 1e-3 * torch.tensor(
    [[1.0, 0.1, -0.5, 0.2], [0.1, 2.0, 0.6, 0.3], [-0.5, 0.6, 3.0, -0.4], [0.2, 0.3, -0.4, 1.5]], dtype=torch.float64
)
WALKS = gf.ArrayModel([(gf.WhiteNoise(1.0), R), (gf.RandomWalk(1.0), Q)])
N_LEVELS, N_SAMPLES = 13, 2**13


def moments(signal: Tensor, n_levels: int = N_LEVELS) -> tuple[Tensor, Tensor]:
    """Cross-covariance and how many coefficients each level has."""
    sums, counts = wavelet_products(signal, n_levels)
    return sums / counts, counts.amin((-1, -2))


def simulated(n: int, seed: int = 0, model: gf.ArrayModel = WALKS) -> Tensor:
    return model.simulate(N_SAMPLES, batch=(n,), generator=torch.Generator().manual_seed(seed))


def excess(wccv: Tensor, truth: Tensor, scale_weights: Tensor) -> Tensor:
    """Risk of the weights from `wccv` over the least, less one."""
    A = combined_covariance(truth, scale_weights)
    best, weights = optimal_weights(A), optimal_weights(combined_covariance(wccv, scale_weights))
    return torch.einsum("...i,ik,...k->...", weights, A, weights) / (best @ A @ best) - 1


# The fit


def fitted(n_steps: int, monkeypatch: pytest.MonkeyPatch) -> tuple[Tensor, ...]:
    """The last eight levels of an array, all components, after so many steps."""
    wccv, counts = moments(simulated(1)[0])
    gamma, eta = wccv[5:], (2 * counts * torch.exp2(-torch.arange(1.0, 14)))[5:].clamp(1, 300)
    unit = assisted._unit_variances(N_LEVELS)[5:]
    own = torch.arange(8) < 4
    kept: list[Tensor] = []
    mixture = assisted.mixture
    monkeypatch.setattr(assisted, "mixture", lambda theta, unit: kept.append(theta) or mixture(theta, unit))
    model, score = assisted._fit(gamma, eta, unit, own, n_steps)
    monkeypatch.setattr(assisted, "mixture", mixture)
    return gamma, eta, unit / unit.amax(0), own, kept[-1], model, score


def test_no_step_lowers_the_penalised_likelihood(monkeypatch):
    values = []
    for n in (0, 1, 2, 3, 5, 8, 12):
        gamma, eta, unit, _, theta, model, _ = fitted(n, monkeypatch)
        values.append(naive.penalised_log_likelihood(theta, unit, gamma, eta))
        np.testing.assert_allclose(model, np.einsum("jk,kab->jab", unit, theta), rtol=1e-12)
        assert torch.linalg.eigvalsh(theta).min() >= -1e-14 * theta.abs().max()
    assert (np.diff(values) > 0).all()


def test_components_that_the_data_do_not_ask_for_go(monkeypatch):
    *_, theta, _, _ = fitted(150, monkeypatch)
    size = theta.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert (size > 1e-6 * size.max()).sum() <= 4  # of seven, where the truth has two


def test_the_score_is_half_of_akaikes_criterion(monkeypatch):
    gamma, eta, _, own, theta, model, score = fitted(100, monkeypatch)
    size = theta.diagonal(dim1=-2, dim2=-1).sum(-1)
    n_matrices = int((size > 1e-6 * size.max()).sum())
    assert score.item() == pytest.approx(naive.criterion(model, gamma, eta, own, n_matrices), rel=1e-9)


def test_the_geometric_mean_solves_its_equation():
    factors = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 5, 4, 6)))
    inverse, other = factors @ factors.mT
    mean = geometric_mean(inverse, other)
    torch.testing.assert_close(mean @ inverse @ mean, other)
    assert torch.linalg.eigvalsh(mean).min() > 0


# What comes of it


def test_lower_levels_stay_as_measured_and_higher_ones_come_close_to_the_truth():
    wccv, counts = moments(simulated(30))
    got = assisted_covariance(wccv, counts)
    n_own = int((counts[0] * torch.exp2(-torch.arange(1.0, 14)) > 2**9).sum())
    assert n_own == 3
    assert torch.equal(got[:, :n_own], wccv[:, :n_own])
    truth = WALKS.wavelet_cross_covariance(N_LEVELS)
    scale = truth.diagonal(dim1=-2, dim2=-1).sqrt()
    scale = scale[..., :, None] * scale[..., None, :]
    error, raw = (((v - truth) / scale).square().mean((0, 2, 3)) for v in (got, wccv))
    assert (error[-3:] < raw[-3:] / 5).all()
    # Where a level holds many observations the model may cost something, of very little.
    assert (error[n_own:-3] < 1.5 * raw[n_own:-3]).all()


def test_weights_gain_most_where_the_record_is_short():
    wccv, counts = moments(simulated(60, seed=1))
    assisted_wccv = assisted_covariance(wccv, counts)
    truth = WALKS.wavelet_cross_covariance(N_LEVELS)
    for scale_weights, most in (("long", 1 / 3), ("flat", 1 / 3), ("short", 1.1)):
        omega = resolve_scale_weights(scale_weights, N_LEVELS)
        raw, helped = (excess(v, truth, omega) for v in (wccv, assisted_wccv))
        assert helped.mean() < most * raw.mean()
        if most < 1:
            # Of sixty arrays fewer than 40 would be a chance of 0.7 % if neither were better.
            assert (helped < raw).sum() >= 40


def with_tone(n: int, amplitude: float = 0.6) -> tuple[Tensor, Tensor]:
    """Two sensors with a tone, a quarter of a period apart, that shows at level 7; and the truth."""
    beta = 2 * math.pi / 2**7
    phase = torch.tensor([0.0, math.pi / 2]).double()
    start = 2 * math.pi * torch.rand(n, 1, 1, generator=torch.Generator().manual_seed(4)).double()
    signal = simulated(n, seed=3)
    signal[:, :2] += amplitude * torch.sin(beta * torch.arange(N_SAMPLES) + phase[:, None] + start)
    tone = gf.Sinusoid(amplitude, beta).wavelet_variance(N_LEVELS)
    pair = torch.tensor([1.0, 1.0, 0.0, 0.0]).double().diag()
    return signal, WALKS.wavelet_cross_covariance(N_LEVELS) + tone[:, None, None] * pair


def with_telegraph(n: int) -> tuple[Tensor, Tensor]:
    """Three sensors that jump between two values, some fifty times each; and the truth."""
    generator, rate, height = torch.Generator().manual_seed(5), 1 / 160, 0.8
    steps = (torch.rand(n, 3, N_SAMPLES, generator=generator) < rate).cumsum(-1)
    signal = simulated(n, seed=6)
    signal[:, :3] += height * ((steps + torch.randint(2, (n, 3, 1), generator=generator)) % 2)
    phi = 1 - 2 * rate
    telegraph = gf.AR1(phi, height**2 / 4 * (1 - phi**2)).wavelet_variance(N_LEVELS)
    three = torch.tensor([1.0, 1.0, 1.0, 0.0]).double().diag()
    return signal, WALKS.wavelet_cross_covariance(N_LEVELS) + telegraph[:, None, None] * three


@pytest.mark.statistical
@pytest.mark.parametrize("noise", [with_tone, with_telegraph])
def test_little_is_lost_where_the_model_does_not_hold(noise):
    signal, truth = noise(50)
    wccv, counts = moments(signal)
    long = resolve_scale_weights("long", N_LEVELS)
    middle = torch.exp(-((torch.arange(1, N_LEVELS + 1) - 7) ** 2) / 2).double()
    assisted_wccv = assisted_covariance(wccv, counts)
    for omega, most in ((long, 1 / 2), (middle / middle.sum(), 1.25)):
        raw, helped = (excess(v, truth, omega).mean() for v in (wccv, assisted_wccv))
        assert helped < most * raw


def test_levels_up_to_a_strong_tone_keep_their_own_covariance():
    signal, _ = with_tone(20, amplitude=2.0)
    wccv, counts = moments(signal)
    same = (assisted_covariance(wccv, counts) - wccv).abs().amax((-1, -2)) < 1e-9 * wccv.abs().amax((-1, -2))
    assert same[:, :7].all()
    assert not same[:, -1].any()


# Batches, units, gaps


def test_units_of_the_sensors_do_not_matter():
    wccv, counts = moments(simulated(3))
    unit = torch.tensor([1e-8, 1.0, 3e4, 1e2], dtype=torch.float64)
    scaled = assisted_covariance(unit[:, None] * wccv * unit, counts)
    # The penalty looks at the trace, in units of each sensor's largest variance, so that they cancel but for rounding.
    torch.testing.assert_close(
        scaled / (unit[:, None] * unit), assisted_covariance(wccv, counts), rtol=1e-8, atol=1e-10
    )


def test_items_of_a_batch_do_not_see_each_other():
    signal = simulated(4).view(2, 2, 4, N_SAMPLES)
    signal[0, 1, 2, 1000:3300] = torch.nan
    wccv, counts = moments(signal, 12)
    got = assisted_covariance(wccv, counts)
    for i, k in np.ndindex(2, 2):
        torch.testing.assert_close(got[i, k], assisted_covariance(wccv[i, k], counts[i, k]), rtol=1e-8, atol=1e-12)


def test_levels_without_coefficients_may_hold_anything():
    wccv, counts = moments(simulated(2))
    counts[0, -2:], wccv[0, -2:] = 0, torch.nan
    counts[1], wccv[1] = 0, torch.nan
    got = assisted_covariance(wccv, counts)
    assert got[0].isfinite().all()
    known = assisted_covariance(torch.where(wccv[0].isnan(), 123.0, wccv[0]), counts[0])
    torch.testing.assert_close(got[0], known)


@pytest.mark.parametrize(("n_sensors", "n_samples"), [(2, 4), (4, 8), (12, 64), (32, 100)])
def test_short_records_of_many_sensors_stay_regular(n_sensors, n_samples):
    signal = torch.randn(3, n_sensors, n_samples, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    wccv, counts = moments(signal, n_samples.bit_length() - 1)
    got = assisted_covariance(wccv, counts)
    assert got.shape == wccv.shape
    assert torch.linalg.eigvalsh(got).min() > 0


def test_float32_gives_what_float64_gives():
    wccv, counts = moments(simulated(2))
    single = assisted_covariance(wccv.float(), counts)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), assisted_covariance(wccv, counts), rtol=1e-3, atol=1e-4)
