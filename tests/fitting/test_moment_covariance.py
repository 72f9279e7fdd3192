"""Covariances of wavelet variances: against exact sums over every pair of coefficients, and against simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from reference import processes as naive
from torch import Tensor

from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.noise.model import Model
from gyrofuse.noise.processes import AR1, Drift, QuantizationNoise, RandomWalk, Sinusoid, WhiteNoise
from gyrofuse.wavelets.covariance import wavelet_variance
from gyrofuse.wavelets.lag_sums import covariance_table

Array = NDArray[np.float64]


def exact(noise: Array, n_levels: int, other: Array | None = None) -> Array:
    """`2 sum C_jk^2 / (M_j M_k)` over all pairs of coefficients of a Gaussian record with covariance `(time, time)`.

    With the second moments of something else in the record, the covariance of its product with the noise.
    """
    pairs = [(j, k) for j in range(1, n_levels + 1) for k in range(1, j + 1)]
    if other is None:
        entries = [2 * (_filtered(noise, j, k) ** 2).mean() for j, k in pairs]
    else:
        entries = [4 * (_filtered(noise, j, k) * _filtered(other, j, k)).mean() for j, k in pairs]
    full = np.zeros((n_levels, n_levels))
    full[np.tril_indices(n_levels)] = entries
    return full + np.tril(full, -1).T


def _filtered(moments: Array, j: int, k: int) -> Array:
    return naive.haar_coefficients(naive.haar_coefficients(moments, k).T, j).T


def toeplitz(autocovariance: Array) -> Array:
    lag = np.arange(len(autocovariance))
    return autocovariance[np.abs(lag[:, None] - lag)]


def assert_relative(got: Tensor, expected: Array, tolerance: float) -> None:
    """Every entry, in units of the standard deviations of its two levels."""
    size = np.sqrt(np.diag(expected))
    error = (got.numpy() - expected) / np.outer(size, size)
    assert np.abs(error).max() < tolerance, np.abs(error).max()


def measured(model: Model, n_runs: int, n_samples: int, n_levels: int, seed: int) -> tuple[Tensor, Tensor]:
    """Covariance of the wavelet variances of simulated records, and its standard error, `(level, level)`."""
    generator = torch.Generator().manual_seed(seed)
    return covariance_of(wavelet_variance(model.simulate(n_samples, batch=(n_runs, 1), generator=generator), n_levels))


def covariance_of(nu: Tensor) -> tuple[Tensor, Tensor]:
    """The same of wavelet variances `(run, level, 1)`."""
    apart = (nu - nu.mean(0))[..., 0]
    products = apart[:, :, None] * apart[:, None, :]
    return products.mean(0), products.std(0) / math.sqrt(len(nu))


# --- noise ------------------------------------------------------------------------------------------------

LAG = np.arange(200)


@pytest.mark.parametrize(
    ("model", "autocovariance", "tolerance"),
    [
        (WhiteNoise(2.0), 2.0 * (LAG == 0), 1e-9),
        (QuantizationNoise(0.3), 0.6 * (LAG == 0) - 0.3 * (LAG == 1), 1e-9),
        (AR1(0.0, 1.0), 1.0 * (LAG == 0), 1e-9),
        *((AR1(phi, 1.0), phi**LAG / (1 - phi**2), 0.01) for phi in (-0.9, -0.5, -0.05, 0.05, 0.4, 0.9, 0.995)),
        (AR1(-0.985, 1.0), (-0.985) ** LAG / (1 - 0.985**2), 0.05),
        (QuantizationNoise(1.0) + AR1(0.8, 1e-3), 2.0 * (LAG == 0) - (LAG == 1) + 0.8**LAG / 360, 0.01),
    ],
    ids=lambda value: str(value) if isinstance(value, Model) else "",
)
def test_noise_term_is_the_sum_over_all_pairs(model, autocovariance, tolerance):
    assert_relative(moment_covariance(model, 200, 7), exact(toeplitz(autocovariance), 7), tolerance)


@pytest.mark.parametrize(("n_samples", "n_levels"), [(4096, 12), (5000, 12)])
def test_noise_term_is_that_of_the_exact_tables(n_samples, n_levels):
    """White noise, AR1s with memories between two samples and many records, a random walk, and sums, up to `T/2`."""
    constants = (2.0, 3.1, 12.0, 55.0, 400.0, n_samples / 3, 1.0 * n_samples, 20.0 * n_samples)
    table = covariance_table(n_samples, n_levels, constants)
    mixtures = list(np.eye(len(constants) + 2))
    mixtures += [np.array([1, 0, 0.3, 0, 1e-2, 0, 1e-2, 0, 0, 1e-5]), np.array([1, *[0] * 8, 1e-3])]
    for mixture in mixtures:
        model = WhiteNoise(mixture[0]) + RandomWalk(mixture[-1])
        for constant, variance in zip(constants, mixture[1:-1], strict=True):
            model = model + AR1(math.exp(-1 / constant), -math.expm1(-2 / constant) * variance)
        expected = 2 * np.einsum("jkab,a,b->jk", table, mixture, mixture)
        got = moment_covariance(model, n_samples, n_levels)
        np.testing.assert_allclose(got.numpy(), expected, rtol=0.01)


def test_long_records_and_long_memories():
    model = WhiteNoise(1.0) + AR1(0.999995, 3e-11) + RandomWalk(1e-13)
    for case in (model, AR1(0.999995, 3e-11)):
        covariance = moment_covariance(case, 10_000_000, 22)
        size = covariance.diagonal().sqrt()
        assert covariance.isfinite().all()
        assert torch.linalg.eigvalsh(covariance / size / size[:, None])[0] > 1e-3
        assert torch.equal(covariance, covariance.mT)


# --- noise times what is not noise ------------------------------------------------------------------------


def test_tone_term_is_the_sum_over_all_pairs():
    time = np.arange(400)
    noise = toeplitz(0.9**time / 0.19)
    tone = toeplitz(0.85**2 / 2 * np.cos(0.35 * time))  # over its random phase
    got = moment_covariance(AR1(0.9, 1.0) + Sinusoid(0.85, 0.35), 400, 8)
    assert_relative(got, exact(noise, 8) + exact(noise, 8, tone), 0.02)


def test_tone_term_is_that_of_a_step_in_its_power():
    """`(8 a^2 S / M) h h'` with `h = d nu / d a^2`."""
    a, beta, n = 0.7, 0.3, 5000
    noise = WhiteNoise(0.5) + AR1(0.9, 0.02)
    got = moment_covariance(noise + Sinusoid(a, beta), n, 9) - moment_covariance(noise, n, 9)
    h = Sinusoid(a, beta).wavelet_variance(9) / a**2
    fewest = torch.minimum(*torch.meshgrid(*[torch.exp2(torch.arange(1.0, 10))] * 2, indexing="ij")).double()
    expected = 8 * a**2 * noise.spectrum(beta / (2 * math.pi)) * h[:, None] * h / (n + 1 - fewest)
    torch.testing.assert_close(got, expected, rtol=1e-8, atol=1e-12)
    assert torch.equal(moment_covariance(noise + Sinusoid(0.0, beta), n, 9), moment_covariance(noise, n, 9))


@pytest.mark.parametrize(
    ("model", "noise"),
    [
        (WhiteNoise(1.0), 1.0 * (LAG == 0)),
        (AR1(0.9, 1.0), 0.9**LAG / 0.19),
        (RandomWalk(1.0), -LAG / 2.0),
    ],
    ids=lambda value: str(value) if isinstance(value, Model) else "",
)
def test_drift_term_is_the_sum_over_all_pairs(model, noise):
    ramp = 0.3 * np.arange(200.0)
    got = moment_covariance(model + Drift(0.3), 200, 7)
    assert_relative(got, exact(toeplitz(noise), 7) + exact(toeplitz(noise), 7, np.outer(ramp, ramp)), 0.01)


def test_kurtosis_adds_a_rank_one_term():
    model, kappa = WhiteNoise(2.0) + RandomWalk(0.1), torch.tensor([0.0, 3.0]).double()
    got = moment_covariance(model, 1000, 3, excess_kurtosis=kappa)
    torch.testing.assert_close(got[0], moment_covariance(model, 1000, 3))
    tau = [2, 4, 8]
    expected = [[3 * (2 / j) * (2 / k) / (1001 - min(j, k)) for j in tau] for k in tau]
    torch.testing.assert_close(got[1] - got[0], torch.tensor(expected).double())


# --- against simulation -----------------------------------------------------------------------------------

# Every entry of 6000 records within five standard errors: four tests of 36 entries exceed that once in 10^4 times.
RUNS, Z = 6000, 5.0


@pytest.mark.parametrize(
    "model",
    [
        WhiteNoise(1.0) + RandomWalk(1e-3),
        AR1(0.95, 0.1) + RandomWalk(1e-3),
        WhiteNoise(1.0) + Sinusoid(0.85, 0.35),
        WhiteNoise(1.0) + Drift(5e-3),
    ],
    ids=str,
)
def test_covariances_are_those_of_records(model):
    found, error = measured(model, RUNS, 512, 8, seed=3)
    z = (moment_covariance(model, 512, 8) - found) / error
    assert (z.abs() < Z).all(), z


def test_without_tone_or_drift_terms_variances_are_far_too_small():
    for extra in (Sinusoid(0.85, 0.35), Drift(5e-3)):
        found = measured(WhiteNoise(1.0) + extra, 2000, 512, 8, seed=4)[0].diagonal()
        noise_only = moment_covariance(WhiteNoise(1.0), 512, 8).diagonal()
        assert (found / noise_only).max() > 3


def test_kurtosis_term_is_that_of_laplace_noise():
    generator = torch.Generator().manual_seed(5)
    uniform = torch.rand(RUNS, 1, 512, generator=generator, dtype=torch.float64) - 0.5
    signal = -uniform.sign() * torch.log1p(-2 * uniform.abs())  # variance 2, excess kurtosis 3
    found, error = covariance_of(wavelet_variance(signal, 6))
    z = (moment_covariance(WhiteNoise(2.0), 512, 6, excess_kurtosis=3.0) - found) / error
    assert (z.abs() < Z).all(), z
    gaussian = (moment_covariance(WhiteNoise(2.0), 512, 6) - found) / error
    assert gaussian[0, 0] < -3 * Z


# --- contracts --------------------------------------------------------------------------------------------

MODEL = WhiteNoise() + QuantizationNoise() + AR1() + RandomWalk() + Drift() + Sinusoid()
PARAMS = torch.tensor([1.0, 0.5, 0.9, 0.1, 1e-3, 1e-2, 0.5, 0.3]).double()


def test_a_batch_is_its_items():
    params = PARAMS * torch.linspace(0.8, 1.05, 6, dtype=torch.float64).reshape(2, 3, 1)
    kurtosis = torch.arange(6.0).double().reshape(2, 3)
    got = moment_covariance(MODEL.with_params(params), 300, 6, excess_kurtosis=kurtosis)
    assert got.shape == (2, 3, 6, 6)
    assert got.dtype == torch.float64
    for i in range(2):
        for k in range(3):
            one = moment_covariance(MODEL.with_params(params[i, k]), 300, 6, excess_kurtosis=kurtosis[i, k])
            torch.testing.assert_close(got[i, k], one, rtol=1e-10, atol=0)


def test_numbers_and_batches_of_parameters_mix():
    phi = torch.tensor([[0.5], [0.9]]).double()
    slope = torch.tensor([0.0, 1e-3, 1e-2]).double()
    rest = WhiteNoise(1.0) + QuantizationNoise(0.5) + Sinusoid(0.5, 0.3)
    got = moment_covariance(rest + AR1(phi, 0.1) + Drift(slope), 300, 6)
    assert got.shape == (2, 3, 6, 6)
    torch.testing.assert_close(got[1, 2], moment_covariance(rest + AR1(0.9, 0.1) + Drift(1e-2), 300, 6))


def test_an_item_that_failed_stays_alone():
    params = torch.stack([PARAMS, PARAMS * math.nan])
    got = moment_covariance(MODEL.with_params(params), 300, 6)
    assert got[0].isfinite().all()
    assert got[1].isnan().all()


def test_gradients():
    def covariance(params: Tensor) -> Tensor:
        return moment_covariance(MODEL.with_params(params), 40, 4)

    assert torch.autograd.gradcheck(covariance, (PARAMS.clone().requires_grad_(),))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_the_device_of_the_parameters():
    got = moment_covariance(MODEL.with_params(PARAMS.cuda()), 300, 6)
    assert got.is_cuda
    torch.testing.assert_close(got.cpu(), moment_covariance(MODEL.with_params(PARAMS), 300, 6), rtol=1e-10, atol=0)


def test_arguments_are_checked():
    with pytest.raises(ValueError, match=r"`n_levels`: expected at most 8 for 300 samples .* got 9"):
        moment_covariance(WhiteNoise(1.0), 300, 9)
    with pytest.raises(ValueError, match="`n_samples`: expected a whole number >= 1"):
        moment_covariance(WhiteNoise(1.0), 0, 1)
    with pytest.raises(ValueError, match=r"`white_noise\.variance`.*to be estimated"):
        moment_covariance(WhiteNoise(), 300, 3)
    with pytest.raises(ValueError, match="`excess_kurtosis`: expected a model with WhiteNoise"):
        moment_covariance(RandomWalk(1.0), 300, 3, excess_kurtosis=1.0)
