"""Intervals: by hand, against theory, and by coverage judged with a binomial test."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from reference import haar as naive
from scipy import stats
from torch import Tensor

from gyrofuse import fit_svo, inverse_variance_weights, resolve_scale_weights, svo_weights, uncertainty

# Coverage studies: arrays of 4 sensors, 4096 samples, as many as this; the chance that a true claim is refused.
N_RUNS, N_SENSORS, N_SAMPLES, REFUSED = 300, 4, 4096, 1e-3


@functools.cache
def covariance(n_sensors: int = N_SENSORS, seed: int = 3) -> Tensor:
    """A covariance between sensors with correlations of up to 0.6."""
    mix = np.eye(n_sensors) + 0.4 * np.random.default_rng(seed).normal(size=(n_sensors, n_sensors))
    return torch.from_numpy(mix @ mix.T)


# Degrees of freedom


def exact_degrees(weights: np.ndarray, n_coefficients: int) -> float:
    """Degrees of freedom `2 nu^2 / Var nu` of white noise through a filter, for many coefficients."""
    autocovariance = np.correlate(weights, weights, "full")
    return n_coefficients * autocovariance.max() ** 2 / (autocovariance**2).sum()


@pytest.mark.parametrize("level", range(1, 10))
def test_degrees_are_those_of_the_least_favourable_of_white_noise_and_random_walk(level):
    counts = torch.zeros(9, dtype=torch.float64)
    counts[level - 1] = 1e6
    got = uncertainty.degrees_of_freedom(counts)[level - 1].item()
    haar = np.repeat([1.0, -1.0], 2 ** (level - 1))
    least = min(exact_degrees(haar, 10**6), exact_degrees(haar.cumsum(), 10**6))
    assert 0.89 * least < got <= least * (1 + 1e-3)
    if level in (1, 9):
        assert got == pytest.approx(least, rel=1e-4)


def test_degrees_are_at_least_one_and_follow_the_batch():
    counts = torch.tensor([[100.0, 97.0, 0.0], [3.0, 1.0, 0.0]])
    degrees = uncertainty.degrees_of_freedom(counts)
    k = 280 / 151
    expected = [[4 / 3 * 50, k * 97 / 4, 1.0], [2.0, 1.0, 1.0]]
    np.testing.assert_allclose(degrees, expected, rtol=1e-6)


# Limits


@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
def test_chi_square_limits_are_scipys(level):
    variance = torch.tensor([[1e-12, 0.2], [3.0, 1e12]], dtype=torch.float64)
    degrees = torch.tensor([1.0, 57.3], dtype=torch.float64)
    low, high = uncertainty.chi_square_interval(variance, degrees, level)
    quantile = stats.chi2(degrees.numpy()).ppf
    scaled = (variance * degrees).numpy()
    np.testing.assert_allclose(low, scaled / quantile((1 + level) / 2), rtol=1e-12)
    np.testing.assert_allclose(high, scaled / quantile((1 - level) / 2), rtol=1e-12)


@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
def test_weights_limits_are_scipys(level):
    estimate = torch.tensor([1.0, -2.0], dtype=torch.float64)
    variance, degrees = torch.diag(torch.tensor([4.0, 0.25]).double()), torch.tensor([3.5, torch.inf]).double()
    low, high = uncertainty.weights_interval(estimate, variance, degrees, level)
    half = stats.t.ppf((1 + level) / 2, [3.5, np.inf]) * np.array([2.0, 0.5])
    np.testing.assert_allclose(low, estimate.numpy() - half, rtol=1e-12)
    np.testing.assert_allclose(high, estimate.numpy() + half, rtol=1e-12)


# Covariance of the weights


def delta_method(weights_of, wccv: Tensor, degrees: Tensor) -> Tensor:
    """Covariance of weights by their Jacobian, for one level of Gaussian coefficients."""
    jacobian = torch.autograd.functional.jacobian(weights_of, wccv)[:, 0]  # (sensor, a, b)
    gamma = wccv[0]
    moments = (torch.einsum("ac,bd->abcd", gamma, gamma) + torch.einsum("ad,bc->abcd", gamma, gamma)) / degrees[0]
    return torch.einsum("iab,abcd,kcd->ik", jacobian, moments, jacobian)


def svo_covariance(*arguments: Tensor) -> Tensor:
    """Covariance without what the fitted residual adds to it."""
    inflated, left = uncertainty.svo_weights_covariance(*arguments)
    observations = left + arguments[2].shape[-1] - 1
    return inflated / (observations / left).max()


METHODS = {
    "svo": (svo_weights, svo_covariance),
    "inverse_variance": (inverse_variance_weights, uncertainty.inverse_variance_weights_covariance),
}


@pytest.mark.parametrize("method", METHODS)
def test_one_level_is_the_delta_method(method):
    weights_of, covariance_of = METHODS[method]
    wccv, omega, degrees = covariance()[None], torch.ones(1).double(), torch.tensor([37.0]).double()
    got = covariance_of(wccv, omega, weights_of(wccv, omega), degrees)
    torch.testing.assert_close(got, delta_method(lambda x: weights_of(x, omega), wccv, degrees), rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("method", METHODS)
def test_levels_add_up_with_their_correlation(method):
    """Levels of one shape and size `s_j` give the covariance of one level times `sum_jk r_jk a_j a_k`."""
    weights_of, covariance_of = METHODS[method]
    size, omega = torch.tensor([1.0, 0.3, 2.0]).double(), torch.tensor([0.2, 0.3, 0.5]).double()
    degrees = torch.tensor([500.0, 200.0, 70.0]).double()
    wccv = size[:, None, None] * covariance()
    got = covariance_of(wccv, omega, weights_of(wccv, omega), degrees)
    one, many = torch.ones(1, dtype=torch.float64), torch.tensor([1e6], dtype=torch.float64)
    alone = 1e6 * covariance_of(covariance()[None], one, weights_of(covariance()[None], one), many)
    share = omega * size / (omega * size).sum() / degrees.sqrt()
    # falls faster than white noise, then rises faster than a random walk
    far = 0.53 * 0.887
    pairs = torch.tensor([[1, 0.53, far], [0.53, 1, 0.887], [far, 0.887, 1]], dtype=torch.float64)
    torch.testing.assert_close(got, alone * (share @ pairs.double() @ share), rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("size", [1e-150, 1e-12, 1e150])
@pytest.mark.parametrize("method", METHODS)
def test_the_unit_of_the_signal_does_not_matter(method, size):
    wccv = torch.from_numpy(naive.wavelet_cross_covariance(naive.array(4, 400), 6))
    weights_of, covariance_of = METHODS[method]
    omega, degrees = resolve_scale_weights("short", 6), torch.full((6,), 50.0).double()
    weights = weights_of(wccv, omega)
    torch.testing.assert_close(
        covariance_of(wccv * size**2, omega, weights, degrees), covariance_of(wccv, omega, weights, degrees)
    )


def test_the_residual_is_that_of_the_observations_left():
    """One level of `eta` observations is a regression on `p - 1` differences."""
    wccv, omega, degrees = covariance()[None], torch.ones(1).double(), torch.tensor([37.0]).double()
    weights = svo_weights(wccv, omega)
    inflated, left = uncertainty.svo_weights_covariance(wccv, omega, weights, degrees)
    torch.testing.assert_close(left, torch.full_like(weights, 37.0 - N_SENSORS + 1))
    torch.testing.assert_close(inflated, svo_covariance(wccv, omega, weights, degrees) * 37 / 34)


def test_weights_that_sum_to_one_have_no_variance_along_their_sum():
    for method in METHODS:
        cov = fit_svo(torch.from_numpy(naive.array(5, 2000)), "long", method=method).weights_cov
        assert (cov - cov.mT).abs().max() <= 1e-15
        assert cov.sum(-1).abs().max() <= 1e-12 * cov.diagonal().max()
        assert torch.linalg.eigvalsh(cov)[0] >= -1e-12 * cov.diagonal().max()


# Coverage


def true_wccv(noise: str, n_levels: int) -> Tensor:
    """Wavelet cross-covariance of the noises below: `1/tau` for white, `(tau^2 + 2)/(12 tau)` for a random walk."""
    tau = torch.exp2(torch.arange(1, n_levels + 1, dtype=torch.float64))[:, None, None]
    white, walk = covariance() / tau, covariance(seed=8) * (tau**2 + 2) / (12 * tau)
    return {"white": white, "walk": walk, "white and walk": white + 1e-3 * walk}[noise]


@functools.cache
def arrays(noise: str) -> Tensor:
    """`(run, sensor, time)`, Gaussian, from a generator of their own."""
    generator = torch.Generator().manual_seed(20)

    def drawn(seed: int) -> Tensor:
        unit = torch.randn(N_RUNS, N_SENSORS, N_SAMPLES, generator=generator, dtype=torch.float64)
        return torch.linalg.cholesky(covariance(seed=seed)) @ unit

    if noise == "white":
        return drawn(3)
    if noise == "walk":
        return drawn(8).cumsum(-1)
    return drawn(3) + 1e-3**0.5 * drawn(8).cumsum(-1)


def fewest_covered(n: int, tests: int, confidence_level: float = 0.95) -> int:
    """How many of `n` intervals hold the truth at least, if the claim is true, with all `tests` passing at once."""
    return int(stats.binom.ppf(REFUSED / tests, n, confidence_level))


@pytest.mark.parametrize("noise", ["white", "walk", "white and walk"])
def test_coverage_of_wavelet_variances(noise):
    """`interval_of` holds the true wavelet variance of a sensor in 95 % of arrays or more, at each of 12 levels.

    300 arrays of 4096 samples; with 12 levels of 4 sensors judged at once, 267 of 300 are as few as a true 95 % gives
    by chance in one study of a thousand. The last level has one coefficient.
    """
    result, truth = fit_svo(arrays(noise)), true_wccv(noise, 12)
    for sensor in range(N_SENSORS):
        low, high = result.interval_of(result.wavelet_variance[..., sensor])
        expected = truth[:, sensor, sensor]
        covered = ((low <= expected) & (expected <= high)).sum(0)
        assert (covered >= fewest_covered(N_RUNS, 12 * N_SENSORS)).all(), f"sensor {sensor}: {covered.tolist()}"


def test_coverage_of_the_virtual_gyro():
    """The same for fixed weights: the band that the plot shows, 300 arrays, 12 levels judged at once."""
    result, truth = fit_svo(arrays("white and walk"), method="equal"), true_wccv("white and walk", 12).mean((-1, -2))
    low, high = result.interval_of(result.virtual_wavelet_variance)
    covered = ((low <= truth) & (truth <= high)).sum(0)
    assert (covered >= fewest_covered(N_RUNS, 12)).all(), covered.tolist()


def covered_weights(noise: str, scale_weights: str, n_levels: int, method: str = "svo") -> Tensor:
    """How many of the runs' intervals hold the weights that the true covariances give, per sensor."""
    result = fit_svo(arrays(noise), scale_weights, n_levels=n_levels, method=method)
    weights_of = METHODS[method][0]
    truth = weights_of(true_wccv(noise, n_levels), resolve_scale_weights(scale_weights, n_levels))
    low, high = result.confidence_interval
    return ((low <= truth) & (truth <= high)).sum(0)


@pytest.mark.parametrize("n_levels", [6, 9, 12])
@pytest.mark.parametrize("scale_weights", ["flat", "short", "long"])
@pytest.mark.parametrize("method", METHODS)
def test_coverage_of_weights_in_white_noise(method, scale_weights, n_levels):
    """95 % intervals hold the true weights in 95 % of arrays or more.

    300 arrays of 4096 samples; with 4 sensors judged at once, 270 of 300 or more are what a true 95 % gives in all
    but one study of a thousand.
    """
    covered = covered_weights("white", scale_weights, n_levels, method)
    assert (covered >= fewest_covered(N_RUNS, N_SENSORS)).all(), covered.tolist()


@pytest.mark.parametrize(("noise", "n_levels"), [("walk", 6), ("walk", 9), ("walk", 11), ("white and walk", 9)])
@pytest.mark.parametrize("scale_weights", ["flat", "short", "long"])
def test_coverage_of_weights_with_random_walks(noise, scale_weights, n_levels):
    """The same with random walks, whose levels correlate by up to 0.89 and whose last levels hold few observations.

    A mixture of which the last two levels, of one to six observations, decide is beyond this law: 79 to 98 % with flat
    scale weights at 11 levels.
    """
    covered = covered_weights(noise, scale_weights, n_levels)
    assert (covered >= fewest_covered(N_RUNS, N_SENSORS)).all(), covered.tolist()
