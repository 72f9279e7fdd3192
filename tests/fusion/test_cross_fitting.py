"""Variance of fitted weights in other recordings: against exact truths, by coverage judged with a binomial test."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from gyrofuse import ArrayModel, RandomWalk, WhiteNoise, fit_multiscale, fit_svo
from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit
from gyrofuse.wavelets.intervals import wavelet_variance_interval

REFUSED = 1e-3  # the chance that a true claim is refused


def spd(n_sensors: int, seed: int) -> Tensor:
    """A covariance between sensors whose standard deviations are 1 to 4."""
    generator = np.random.default_rng(seed)
    size = generator.permutation(np.geomspace(1, 4, n_sensors))
    correlation = np.corrcoef(generator.standard_normal((n_sensors, 4 * n_sensors)))
    return torch.from_numpy(correlation * size * size[:, None])


def model(n_sensors: int) -> ArrayModel:
    return ArrayModel([(WhiteNoise(1.0), spd(n_sensors, 1)), (RandomWalk(1e-5), spd(n_sensors, 2))])


def modulated(n_samples: int, batch: int, generator: torch.Generator) -> Tensor:
    """Factor `(batch, 1, time)` of mean square 1: a log-variance of sd 1/2 that wanders with time constant 200."""
    phi = 0.995
    steps = torch.randn(batch, n_samples, generator=generator, dtype=torch.float64) / 2 * (1 - phi**2) ** 0.5
    steps[:, 0] /= (1 - phi**2) ** 0.5
    log_variance = torch.empty_like(steps)
    log_variance[:, 0] = steps[:, 0]
    for t in range(1, n_samples):
        log_variance[:, t] = phi * log_variance[:, t - 1] + steps[:, t]
    return ((log_variance - 0.125) / 2).exp()[:, None]


def fewest_covered(n: int, tests: int) -> int:
    return int(stats.binom.ppf(REFUSED / tests, n, 0.95))


def covered(result, truth: Tensor) -> Tensor:
    low, high = result.interval_of(result.virtual_wavelet_variance)
    return ((low <= truth) & (truth <= high)).sum(0)


def left_by(weights: Tensor, wccv: Tensor) -> Tensor:
    return torch.einsum("ri,jik,rk->rj", weights, wccv, weights)


def test_long_weights_of_nine_sensors():
    """48 recordings of 8209 samples: limits hold what the weights leave in others, and the estimate is on its level."""
    array = model(9)
    signal = array.simulate(8209, batch=(48,), generator=torch.Generator().manual_seed(3))
    result = fit_svo(signal, "long", covariance="none")
    truth = left_by(result.weights, array.wavelet_cross_covariance(result.n_levels))
    assert (covered(result, truth) >= fewest_covered(48, result.n_levels)).all()
    found, flattered = (v / truth for v in (result.virtual_wavelet_variance, result.in_sample_wavelet_variance))
    assert (flattered[:, -4:].mean(0) < 0.75).all()
    off = (found.mean(0) - 1) / (found.std(0) / 48**0.5)
    assert (off[:-3].abs() < stats.norm.isf(REFUSED / 20)).all(), off.tolist()


def test_a_variance_that_wanders():
    """40 recordings whose noise level wanders: Gaussian degrees of freedom hold a tenth to a half of the truths."""
    generator, array = torch.Generator().manual_seed(4), model(3)
    white, walk = (ArrayModel([part]).simulate(30011, batch=(40,), generator=generator) for part in array.components)
    result = fit_svo(modulated(30011, 40, generator) * white + walk, "short", covariance="none")
    truth = left_by(result.weights, array.wavelet_cross_covariance(result.n_levels))
    assert (covered(result, truth) >= fewest_covered(40, result.n_levels)).all()


def test_bands():
    """16 recordings, the true variance of the filter by its response: limits hold it, and the estimate is not low."""
    array, n_samples, n_levels = model(5), 8209, 13
    signal = array.simulate(n_samples, batch=(16,), generator=torch.Generator().manual_seed(5))
    result = fit_multiscale(signal, n_levels=n_levels)
    # What each sensor's impulse comes out as, (run, sensor, time), and of a step for the random walk.
    length = 2 ** (result.n_bands - 1) + 2**n_levels
    means = [torch.zeros(2 * length, dtype=torch.float64) for _ in range(result.n_bands)]
    for k, mean in enumerate(means):
        mean[: 2**k] = 2.0**-k
    bands = torch.stack([a - b for a, b in pairwise(means)] + [means[-1]])
    response = torch.einsum("rks,kt->rst", result.weights, bands)
    truth = torch.zeros(16, n_levels, dtype=torch.float64)
    for j in range(1, n_levels + 1):
        haar = torch.zeros(2 * length, dtype=torch.float64)
        haar[: 2 ** (j - 1)], haar[2 ** (j - 1) : 2**j] = 2.0**-j, -(2.0**-j)
        out = torch.fft.irfft(torch.fft.rfft(response) * torch.fft.rfft(haar), 2 * length)
        for (_, matrix), series, size in zip(array.components, (out, out.cumsum(-1)), (1.0, 1e-5), strict=True):
            truth[:, j - 1] += size * torch.einsum("rat,ab,rbt->r", series, matrix, series)
    assert (covered(result, truth) >= fewest_covered(16, n_levels)).all()
    assert (result.cross_fit.optimism[:, -3:].median(0).values > 0.1).all()
    off = result.virtual_wavelet_variance / truth - 1
    off = off.mean(0) / (off.std(0) / 16**0.5)
    assert (off.abs() < stats.t.isf(REFUSED / 26, 15)).all(), off.tolist()


@pytest.mark.filterwarnings("ignore:RDVG")
@pytest.mark.parametrize("method", ["equal", "rdvg"])
def test_weights_that_are_not_fitted_are_not_corrected(method):
    signal = model(4).simulate(4100, generator=torch.Generator().manual_seed(6))
    result = fit_svo(signal, method=method)
    torch.testing.assert_close(result.virtual_wavelet_variance, result.in_sample_wavelet_variance)
    torch.testing.assert_close(result.cross_fit.left, torch.ones_like(result.cross_fit.left))
    # Their limits are those of the virtual gyro as a sensor of its own; the pilot of the whole array knows more.
    own = wavelet_variance_interval(result.virtual(signal)[None], result.n_levels)
    for limit, expected in zip(result.interval_of(result.virtual_wavelet_variance), own, strict=True):
        torch.testing.assert_close(limit[:8], expected[:8, 0], rtol=0.03, atol=0)


def test_a_batch_is_its_items_and_can_be_indexed():
    signal = model(4).simulate(1000, batch=(2, 2), generator=torch.Generator().manual_seed(7))
    whole = fit_svo(signal, "long", method="auto")
    alone = fit_svo(signal[1, 0], "long", method="auto")
    for name in CrossFit.__dataclass_fields__:
        got = getattr(whole[1, 0].cross_fit, name)
        # Iterations stop within a millionth; some processors add up the products of a batch in another order.
        torch.testing.assert_close(got, getattr(alone.cross_fit, name), rtol=1e-5, atol=1e-9, equal_nan=True)


def test_levels_of_which_nothing_is_known_have_no_limits():
    signal = model(3).simulate(1000, generator=torch.Generator().manual_seed(8))
    signal[:, ::100] = torch.nan
    omega = [1.0] * 5 + [0.0] * 2
    result = fit_svo(signal, omega)
    assert result.cross_fit.low.isfinite().tolist() == result.virtual_wavelet_variance.isfinite().tolist()
    assert result.cross_fit.low.isfinite().any()
