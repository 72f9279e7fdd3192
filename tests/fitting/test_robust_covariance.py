"""Covariances of robust wavelet variances, against exact sums and simulation, and the fits that rest on them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from reference import processes as naive
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import GMWMResult
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.wavelets.robust import biweight_of

Array = NDArray[np.float64]
MODEL = gf.WhiteNoise(1.0) + gf.RandomWalk(4e-4)


def exact(second_moment: Array, n_levels: int, efficiency: float) -> Array:
    """The sum over all pairs of coefficients of a Gaussian record with covariance `(time, time)`, order by order."""

    def cross(j: int, k: int) -> Array:
        return naive.haar_coefficients(naive.haar_coefficients(second_moment, k).T, j).T

    nu = [cross(j, j)[0, 0] for j in range(1, n_levels + 1)]
    orders = biweight_of(efficiency).orders
    full = np.empty((n_levels, n_levels))
    for j in range(n_levels):
        for k in range(n_levels):
            rho = cross(j + 1, k + 1) / math.sqrt(nu[j] * nu[k])
            series = sum(order * (rho ** (2 * (m + 1))).mean() for m, order in enumerate(orders))
            full[j, k] = 2 * nu[j] * nu[k] * series
    return full


def simulated(n: int, n_samples: int, model: gf.Model = MODEL, seed: int = 0) -> Tensor:
    return model.simulate(n_samples, batch=(n,), generator=torch.Generator().manual_seed(seed))[:, None]


LAG = np.abs(np.arange(200)[:, None] - np.arange(200))
EARLIER = np.minimum(np.arange(1, 201)[:, None], np.arange(1, 201)).astype(float)
CASES = [
    (gf.WhiteNoise(2.0), 2.0 * (LAG == 0)),
    (gf.RandomWalk(1.0) + gf.WhiteNoise(0.1), EARLIER + 0.1 * (LAG == 0)),
    (gf.AR1(0.9, 1.0) + gf.WhiteNoise(0.5), 0.9**LAG / 0.19 + 0.5 * (LAG == 0)),
    (gf.AR1(-0.6, 1.0), (-0.6) ** LAG / 0.64),
    (gf.QuantizationNoise(1.0) + gf.WhiteNoise(0.2), 2.2 * (LAG == 0) - (LAG == 1)),
]


@pytest.mark.parametrize("efficiency", [0.5, 0.6, 0.95])
@pytest.mark.parametrize(("model", "second_moment"), CASES, ids=[str(model) for model, _ in CASES])
def test_is_the_exact_sum(model, second_moment, efficiency):
    """1 % of the standard deviations of the two levels."""
    got = moment_covariance(model, 200, 6, efficiency=efficiency).numpy()
    expected = exact(second_moment, 6, efficiency)
    size = np.sqrt(np.diag(expected))
    assert np.abs((got - expected) / np.outer(size, size)).max() < 0.01


def test_lies_between_the_classic_and_that_of_independent_coefficients():
    classic, robust = moment_covariance(MODEL, 10_000, 9), moment_covariance(MODEL, 10_000, 9, efficiency=0.6)
    ratio = (robust / classic).diagonal()
    assert (ratio > 1.25).all()
    assert (ratio < 1 / 0.6).all()
    assert torch.equal(moment_covariance(MODEL, 10_000, 9, efficiency=1), classic)
    assert int(torch.linalg.cholesky_ex(robust)[1]) == 0


def test_is_that_of_simulated_records():
    """1000 records, 16 windows at the last level: within 4 standard errors and 6 % of the variances."""
    n_samples, n_levels = 2048, 7
    nu = gf.robust_wavelet_variance(simulated(1000, n_samples, seed=7), n_levels)[..., 0]
    expected = moment_covariance(MODEL, n_samples, n_levels, efficiency=0.6)
    size = expected.diagonal().sqrt()
    got = torch.cov(nu.T) / size / size[:, None]
    expected = expected / size / size[:, None]
    error = ((1 + expected.square()) / 1000).sqrt()  # of a Gaussian covariance
    assert ((got - expected).abs() < 4 * error + 0.06).all(), got - expected


def test_batches_and_gradients():
    params = torch.tensor([[1.0, 4e-4], [2.0, 1e-3], [0.5, 0.0]], dtype=torch.float64)
    got = moment_covariance(MODEL.with_params(params), 300, 5, efficiency=0.6)
    for own, one in zip(params, got, strict=True):
        torch.testing.assert_close(
            one, moment_covariance(MODEL.with_params(own), 300, 5, efficiency=0.6), rtol=1e-10, atol=0
        )

    def of(values: Tensor) -> Tensor:
        return moment_covariance(MODEL.with_params(values), 40, 3, efficiency=0.6)

    assert torch.autograd.gradcheck(of, params[1].clone().requires_grad_())


@pytest.mark.parametrize("other", [gf.Sinusoid(0.5, 0.3), gf.Drift(0.1)])
def test_only_gaussian_processes(other):
    with pytest.raises(ValueError, match="`model`: expected Gaussian processes with a robust wavelet variance"):
        moment_covariance(MODEL + other, 300, 4, efficiency=0.6)
    with pytest.raises(ValueError, match="`model`: expected Gaussian processes"):
        gf.fit_gmwm(simulated(1, 1024), "WN + SIN" if isinstance(other, gf.Sinusoid) else "WN + DR", efficiency=0.6)


@pytest.fixture(scope="module")
def many() -> GMWMResult:
    """200 records of 2048 samples."""
    return gf.fit_gmwm(simulated(200, 2048, seed=3), "WN + RW", efficiency=0.6)


@pytest.mark.statistical
def test_intervals_of_robust_fits_hold_the_truth(many):
    """95 % intervals: within the 99.9 % binomial bounds of 200 runs."""
    low, high = many.confidence_interval
    held = ((low <= MODEL.params) & (MODEL.params <= high)).sum((0, 1))
    assert (held >= stats.binom.ppf(0.0005, 200, 0.95)).all(), held.tolist()
    assert bool(many.converged.all())


def test_spread_and_j_test_of_robust_fits(many):
    """Spread within 20 % (3.3 standard errors are 17), means within 0.2 of it and 3.3 standard errors."""
    found = many.params[:, 0]
    said = many.param_cov[:, 0].diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    spread = found.std(0)
    assert ((spread / said - 1).abs() < 0.2).all(), (spread / said).tolist()
    assert ((found.mean(0) - MODEL.params).abs() < (0.2 + 3.3 / math.sqrt(200)) * spread).all()
    rejected = int((many.p_value < 0.05).sum())
    assert rejected <= stats.binom.ppf(0.9995, 200, 0.1), rejected  # at most 10 % at nominal 5 %


def test_robust_fits_bear_spikes():
    """Four spikes of 50 standard deviations in 8192 samples double the classic white noise, and move no robust fit."""
    signal = simulated(20, 8192, seed=11)
    places = torch.randint(8192, (20, 1, 4), generator=torch.Generator().manual_seed(12))
    hit = signal.scatter_add(-1, places, torch.full_like(places, 50.0, dtype=torch.float64))
    white = {}
    for efficiency in (1.0, 0.6):
        clean, wild = (gf.fit_gmwm(x, "WN + RW", efficiency=efficiency, n_levels=8) for x in (signal, hit))
        white[efficiency] = (wild.params[..., 0] / clean.params[..., 0]).mean().item()
    assert white[1.0] > 1.8
    assert abs(white[0.6] - 1) < 0.02, white


def test_what_a_robust_fit_says_of_itself(many):
    alone = gf.fit_gmwm(simulated(1, 2048, seed=3)[0], "WN + RW", efficiency=0.6)
    assert "2048 samples, 7 levels, robust, efficiency 0.6" in alone.summary()
    assert "robust" not in gf.fit_gmwm(simulated(1, 2048)[0], "WN + RW").summary()
    assert alone.to_dict()["efficiency"] == many.efficiency == 0.6
    # A robust wavelet variance may be given instead of the signal.
    nu = gf.robust_wavelet_variance(simulated(1, 2048, seed=3)[0], 7)
    given = gf.fit_gmwm_moments(nu, 2048, "WN + RW", efficiency=0.6)
    torch.testing.assert_close(given.param_cov, alone.param_cov)
    # Without the higher orders intervals would be narrower.
    classic = gf.fit_gmwm_moments(nu, 2048, "WN + RW")
    assert (classic.param_cov.diagonal(dim1=-2, dim2=-1) < 0.9 * given.param_cov.diagonal(dim1=-2, dim2=-1)).all()


def test_refinement_is_not_robust():
    with pytest.raises(ValueError, match="`refine`: expected `efficiency=1`"):
        gf.fit_gmwm(simulated(1, 1024), "WN", efficiency=0.6, refine=True)
    with pytest.raises(ValueError, match=r"`efficiency`: expected 0\.5 to 1"):
        gf.fit_gmwm(simulated(1, 1024), "WN", efficiency=0.0)
