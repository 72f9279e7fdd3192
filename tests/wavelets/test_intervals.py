"""Intervals of wavelet variances and cross-covariances: by coverage at every level, and by their form."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from reference import haar as naive
from scipy import stats
from torch import Tensor

from gyrofuse import wavelet_cross_covariance, wavelet_cross_covariance_interval, wavelet_variance_interval
from gyrofuse._base.checks import check_confidence_level

N_RUNS, N_SAMPLES, N_LEVELS = 120, 2048, 10
MIX = np.array([[1.0, 0, 0], [0.6, 0.8, 0], [-0.3, 0.2, 0.9]])
WALK = np.array([[1.0, 0, 0], [-0.5, 0.7, 0], [0.1, 0.4, 1.2]]) * 0.02


@functools.cache
def arrays(noise: str) -> Tensor:
    """`(run, 3, time)`."""
    rng = np.random.default_rng(5)
    draw = rng.laplace if noise == "laplace" else rng.normal
    scale = 1 / np.sqrt(2) if noise == "laplace" else 1.0
    x = np.einsum("ik,nkt->nit", MIX, scale * draw(size=(N_RUNS, 3, N_SAMPLES)))
    return torch.from_numpy(x + np.einsum("ik,nkt->nit", WALK, rng.normal(size=(N_RUNS, 3, N_SAMPLES))).cumsum(-1))


def truth() -> np.ndarray:
    tau = 2.0 ** np.arange(1, N_LEVELS + 1)[:, None, None]
    return MIX @ MIX.T / tau + WALK @ WALK.T * (tau**2 + 2) / (12 * tau)


def fewest(n: int, tests: int) -> int:
    """Of `n` intervals, as few as hold the truth by chance in one study of a thousand, all `tests` judged at once."""
    return int(stats.binom.ppf(1e-3 / tests, n, 0.95))


@pytest.mark.statistical
@pytest.mark.parametrize("noise", ["gauss", "laplace"])
def test_coverage_of_wavelet_variances(noise):
    """At every level with two observations or more, 120 runs of 2048 samples; neither too few nor all."""
    low, high = wavelet_variance_interval(arrays(noise), N_LEVELS)
    expected = torch.from_numpy(truth()).diagonal(dim1=-2, dim2=-1)
    covered = ((low <= expected) & (expected <= high)).sum(0)  # (level, sensor)
    assert (covered >= fewest(N_RUNS, covered.numel())).all(), covered.tolist()
    # 95 % and no more, over all levels and sensors: at most 97 %.
    assert covered.double().mean() <= 0.97 * N_RUNS


@pytest.mark.statistical
def test_coverage_of_cross_covariances():
    """Every entry at every level: 120 runs."""
    low, high = wavelet_cross_covariance_interval(arrays("gauss"), N_LEVELS)
    expected = torch.from_numpy(truth())
    covered = ((low <= expected) & (expected <= high)).sum(0)
    assert (covered >= fewest(N_RUNS, covered.numel())).all(), covered.tolist()
    assert covered.double().mean() <= 0.98 * N_RUNS


def test_the_diagonal_of_one_is_the_other_at_low_levels():
    """There both look at the series; at the last levels one model knows of the other sensors."""
    signal = arrays("gauss")[0]
    pairs = wavelet_cross_covariance_interval(signal, 5)
    alone = wavelet_variance_interval(signal, 5)
    for both, one in zip(pairs, alone, strict=True):
        torch.testing.assert_close(both.diagonal(dim1=-2, dim2=-1), one, rtol=0.05, atol=0)


def test_limits_enclose_the_estimate_and_are_symmetric_in_the_sensors():
    signal = torch.from_numpy(naive.array(4, 3000))
    low, high = wavelet_cross_covariance_interval(signal)
    wccv = wavelet_cross_covariance(signal)
    assert ((low < wccv) & (wccv < high)).all()
    torch.testing.assert_close(low, low.mT)
    assert (low.diagonal(dim1=-2, dim2=-1) >= 0).all()


def test_more_confidence_is_wider():
    signal = torch.from_numpy(naive.array(2, 1000))
    narrow, wide = (wavelet_variance_interval(signal, confidence_level=level) for level in (0.5, 0.99))
    assert (wide.low < narrow.low).all()
    assert (narrow.high < wide.high).all()


def test_a_batch_is_its_items_and_the_dtype_stays():
    signal = torch.from_numpy(np.stack([naive.array(3, 600), 3 * naive.array(3, 600)])).float()
    low, _ = wavelet_variance_interval(signal, 6)
    assert low.dtype == torch.float32
    assert low.shape == (2, 6, 3)
    torch.testing.assert_close(low[1], wavelet_variance_interval(signal[1], 6).low)


def test_levels_without_a_window_are_unknown():
    signal = torch.from_numpy(naive.array(2, 400)).clone()
    signal[1, ::20] = torch.nan
    low, high = wavelet_variance_interval(signal, 6)
    assert low[:, 0].isfinite().all()
    assert low[:4, 1].isfinite().all()
    assert low[4:, 1].isnan().all()
    assert high[4:, 1].isnan().all()


@pytest.mark.parametrize("interval", [wavelet_variance_interval, wavelet_cross_covariance_interval])
def test_bad_input_is_named(interval):
    with pytest.raises(TypeError, match=r"`confidence_level`: expected a number between 0 and 1 .* got str 'a'"):
        check_confidence_level("a")
    with pytest.raises(TypeError, match=r"`confidence_level`: expected a number .* got NoneType None"):
        check_confidence_level(None)
    with pytest.raises(ValueError, match=r"`confidence_level`: expected a number .* got nan"):
        check_confidence_level(float("nan"))
    with pytest.raises(ValueError, match="`confidence_level`: expected a number between 0 and 1"):
        interval(torch.zeros(2, 100), confidence_level=95)
    with pytest.raises(ValueError, match="`n_levels`: expected at most 6"):
        interval(torch.zeros(2, 100), 7)
    with pytest.raises(TypeError, match="`signal`: expected a torch tensor"):
        interval([1.0, 2.0])


@pytest.mark.parametrize("kind", ["stuck", "copied", "two samples", "three samples"])
def test_arrays_that_no_model_fits_have_the_intervals_of_their_single_sensors(kind):
    """A stuck sensor has none; beside it, or beside a copy, the others' are those that they have alone."""
    x = torch.from_numpy(np.random.default_rng(3).normal(size=(3, 256)))
    if kind == "stuck":
        x[0] = 3.0
    elif kind == "copied":
        x[0] = x[1]
    else:
        x = x[:, : 2 if kind == "two samples" else 3]
    alone, pairs = wavelet_variance_interval(x), wavelet_cross_covariance_interval(x)
    for limit, matrix in zip(alone, pairs, strict=True):
        assert limit[:, 1:].isfinite().all()
        assert bool(limit[:, 0].isnan().all()) == (kind == "stuck")
        assert bool(matrix[:, 0].isnan().all()) == (kind == "stuck")
        # Several sensors have their series in longer bins than one.
        torch.testing.assert_close(matrix.diagonal(dim1=-2, dim2=-1), limit, equal_nan=True, rtol=0.05, atol=0)
