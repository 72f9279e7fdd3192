"""The rough model: that it climbs, finds what is there, and says how many observations a level holds."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fusion.uncertainty.parametric import resample_combined
from gyrofuse.wavelets import pilot
from gyrofuse.wavelets.covariance import wavelet_products

N_SAMPLES, N_LEVELS = 4096, 11
WHITE = torch.tensor([[1.0, 0.3, 0], [0.3, 2.0, -0.4], [0, -0.4, 0.7]]).double()
WALK = torch.tensor([[1.0, -0.5, 0.2], [-0.5, 1.5, 0.1], [0.2, 0.1, 0.4]]).double() * 1e-3


def arrays(n: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    unit = torch.randn(2, n, 3, N_SAMPLES, generator=generator, dtype=torch.float64)
    return torch.linalg.cholesky(WHITE) @ unit[0] + (torch.linalg.cholesky(WALK) @ unit[1]).cumsum(-1)


def true_wccv() -> Tensor:
    tau = torch.exp2(torch.arange(1, N_LEVELS + 1).double())[:, None, None]
    return WHITE / tau + WALK * (tau**2 + 2) / (12 * tau)


def measured(signal: Tensor) -> Tensor:
    sums, counts = wavelet_products(signal, N_LEVELS)
    return sums / counts


def random_walk(first_level: int) -> pilot.Pilot:
    return with_memory(torch.tensor(0), first_level)


def with_memory(memory: Tensor, first_level: int) -> pilot.Pilot:
    theta = torch.stack([WHITE, WALK]).expand(*memory.shape, 2, 3, 3)
    return pilot.Pilot(theta, memory, N_SAMPLES, first_level, N_LEVELS, torch.ones(*memory.shape, N_LEVELS))


def test_exact_covariances_give_the_model_back():
    fitted = pilot.fit_pilot(true_wccv(), N_SAMPLES)
    torch.testing.assert_close(fitted.theta[-1], WALK, rtol=0, atol=3e-2 * WALK.max().item())
    got = fitted.wavelet_cross_covariance[fitted.first_level :]
    torch.testing.assert_close(got, true_wccv()[fitted.first_level :], rtol=0.05, atol=1e-3)


def test_every_step_raises_the_likelihood():
    gamma = measured(arrays(1))[0]
    unit = pilot._unit_variances(N_SAMPLES, N_LEVELS)[0]
    unit = unit / unit.amax(0)
    eta = torch.full((N_LEVELS,), 20.0, dtype=torch.float64)
    theta = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    before = pilot._likelihood(pilot.mixture(theta, unit), gamma, eta)
    for _ in range(30):
        theta = pilot.climb_likelihood(theta, gamma, unit, eta[:, None] * unit, n_steps=1)
        after = pilot._likelihood(pilot.mixture(theta, unit), gamma, eta)
        assert after >= before - 1e-9 * abs(before)
        before = after
    assert (torch.linalg.eigvalsh(theta) > -1e-12).all()


def test_degrees_are_those_of_the_estimates():
    """`2 nu^2 / Var nu` over 1500 arrays, within four standard errors of such a variance."""
    sums, counts = wavelet_products(arrays(1500), N_LEVELS)
    nu = (sums / counts)[..., 0, 0]  # (run, level)
    found = 2 * true_wccv()[:, 0, 0].square() / nu.var(0)
    fitted = random_walk(first_level=0)
    expected = fitted.dof(torch.tensor([[1.0, 0, 0]]).double())[:, 0]
    # A chi-square variable has the excess kurtosis 12 / eta.
    error = ((2 + 12 / expected) / 1500).sqrt()
    assert ((found / expected - 1).abs() < 4 * error).all(), (found / expected).tolist()


def test_covariance_of_moments_is_that_of_recordings():
    """Levels 1, 4 and 9 of two sensors, over 1500 arrays: every entry within five standard errors."""
    sums, counts = wavelet_products(arrays(1500, seed=8), N_LEVELS)
    fitted = random_walk(first_level=0)
    levels = [0, 3, 8]
    found = (sums / counts)[:, levels, :2, :2].flatten(1)
    expected = fitted.covariance_of_moments()[levels][:, :2, :2][:, :, :, levels][..., :2, :2].reshape(12, 12)
    scale = expected.diagonal().sqrt()
    # sd of a covariance of two Gaussian variables: sqrt((1 + r^2) / n) of the product of their sds
    assert ((found.T.cov() - expected) / scale / scale[:, None]).abs().max() < 5 * (2 / 1500) ** 0.5


def test_memory_is_the_random_walk_s_unless_an_ar1_is_far_likelier():
    """Of 40 arrays each; a sixteenth of the record is a time constant that an AR1 may have."""
    sums, counts = wavelet_products(arrays(40, seed=2), N_LEVELS)
    assert (pilot.fit_pilot(sums / counts, N_SAMPLES).memory == 0).sum() >= 38
    slow = gf.AR1(math.exp(-16 / N_SAMPLES), 1.0)
    model = gf.ArrayModel([(gf.WhiteNoise(1.0), WHITE), (slow, 10 * WALK)])
    signal = model.simulate(N_SAMPLES, batch=(40,), generator=torch.Generator().manual_seed(3))
    sums, counts = wavelet_products(signal, N_LEVELS)
    fitted = pilot.fit_pilot(sums / counts, N_SAMPLES)
    assert (fitted.memory == 2).sum() >= 32
    # The variance at the last level, where the walk that goes as far at the first ones would have many times as much.
    last = fitted.wavelet_cross_covariance.diagonal(dim1=-2, dim2=-1)[:, -1]
    truth = model.wavelet_cross_covariance(N_LEVELS).diagonal(dim1=-2, dim2=-1)[-1]
    found = last[fitted.memory == 2].mean(0)
    torch.testing.assert_close(found, truth, rtol=0.25, atol=0)


def test_resamples_of_a_mixed_batch_are_those_of_its_items():
    omega = torch.arange(N_LEVELS).double()
    mixed = with_memory(torch.tensor([0, 2, 0]), 5)
    drawn, expected = resample_combined(mixed, omega, mixed.n_samples, 50, torch.Generator().manual_seed(1))
    for item in range(3):
        alone = resample_combined(mixed[[item]], omega, mixed.n_samples, 50, torch.Generator().manual_seed(1))
        torch.testing.assert_close(alone, (drawn[[item]], expected[[item]]))
    assert (expected[0] - expected[1]).abs().max() > 0.1 * expected[0].abs().max()


@pytest.mark.parametrize("memory", [0, 1, 2])
def test_a_stretch_of_the_record_has_the_same_noise(memory):
    """The last levels of half a record: what is expected of them does not depend on how long the record is."""
    omega = torch.tensor([0.0] * 7 + [1, 1, 1, 0]).double() / 3
    model = with_memory(torch.tensor([memory]), 6)
    _, whole = resample_combined(model, omega, N_SAMPLES, 2, torch.Generator().manual_seed(1))
    _, half = resample_combined(model, omega, N_SAMPLES // 2, 2, torch.Generator().manual_seed(1))
    torch.testing.assert_close(half, whole, rtol=1e-6, atol=1e-9)


def test_certainty_is_that_of_the_fit():
    """`2 s^2 / Var s` of a fixed combination over 300 fits, a fifth or more: the last levels depend on each other."""
    fitted = pilot.fit_pilot(measured(arrays(300, seed=5)), N_SAMPLES)
    weights = torch.tensor([0.2, 0.5, 0.3]).double()
    omega = torch.tensor([0] * 7 + [1, 2, 3, 4]).double() / 10
    model = torch.einsum("i,njio,o->nj", weights, fitted.wavelet_cross_covariance, weights)
    combined = model[:, fitted.first_level :] @ omega[fitted.first_level :]
    found = 2 * combined.mean() ** 2 / combined.var()
    said = fitted.dof_of_fit(weights.expand(300, 3), omega).median()
    assert 0.2 < found / said < 1.2, (found.item(), said.item())


def test_what_is_peculiar_below_does_not_bend_the_fit():
    """A tone at the levels just below the last ones; without it they help to fit."""
    first = pilot.fit_pilot(true_wccv(), N_SAMPLES).first_level
    tone = true_wccv()
    tone[first - 1] *= 3
    got = pilot.fit_pilot(tone, N_SAMPLES).wavelet_cross_covariance[first:]
    torch.testing.assert_close(got, true_wccv()[first:], rtol=0.05, atol=1e-3)


def test_a_batch_is_its_items():
    wccv = measured(arrays(4))
    together = pilot.fit_pilot(wccv, N_SAMPLES)
    torch.testing.assert_close(together[torch.tensor([2])].theta[0], pilot.fit_pilot(wccv[2], N_SAMPLES).theta)


@pytest.mark.parametrize("scale_weights", [[0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 4]])
def test_resamples_follow_the_law_of_recordings(scale_weights):
    """Mean and covariance of `A` over 4000 resamples against 1500 recordings of the same model."""
    omega = torch.tensor(scale_weights).double() / sum(scale_weights)
    sums, counts = wavelet_products(arrays(1500, seed=4), N_LEVELS)
    real = torch.einsum("j,njik->nik", omega, sums / counts)
    model = with_memory(torch.tensor([0]), 5)
    drawn, expected = (x[0] for x in resample_combined(model, omega, N_SAMPLES, 4000, torch.Generator().manual_seed(1)))
    exact = torch.einsum("j,jik->ik", omega, true_wccv())
    torch.testing.assert_close(expected, exact, rtol=0.02, atol=1e-5)
    scale = real.std(0)
    assert ((drawn.mean(0) - exact) / scale).abs().max() < 0.1
    torch.testing.assert_close(drawn.std(0), scale, rtol=0.1, atol=0)
    # Medians and tails: quantiles of the first variance.
    q = torch.tensor([0.05, 0.25, 0.5, 0.75, 0.95]).double()
    torch.testing.assert_close(drawn[:, 0, 0].quantile(q), real[:, 0, 0].quantile(q), rtol=0.12, atol=0)
