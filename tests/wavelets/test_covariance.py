"""Wavelet variance and cross-covariance against their definition, on both of the paths that compute them."""

from __future__ import annotations

import functools
import warnings

import numpy as np
import pytest
import torch
from reference import haar as naive

from gyrofuse import CrossCovariance, HaarFilterBank, haar_coefficients, wavelet_cross_covariance, wavelet_variance
from gyrofuse.wavelets import cross_covariance
from gyrofuse.wavelets import tiles as _tiles

NO_WINDOW = r"no complete window for some sensors at level\(s\) "


def with_gaps(signal: np.ndarray) -> np.ndarray:
    """Missing samples of every kind: single, in a row, infinite, at both ends, in several sensors at once."""
    signal, length = signal.copy(), signal.shape[-1]
    signal[..., 0, [0, length // 3, length // 2]] = np.nan
    signal[..., 1, length // 2 : length // 2 + length // 40] = np.inf
    signal[..., 1, length // 7] = -np.inf
    signal[..., -1, -1] = np.nan
    return signal


SIGNALS = {
    "plain": naive.array(3, 1100),
    "offset": naive.array(3, 1100) + 250,
    "drift": naive.array(3, 1100) + 250 + 1e-3 * np.arange(1100),
    "gaps": with_gaps(naive.array(3, 1100) + 250 + 1e-3 * np.arange(1100)),
}


@functools.cache
def expected_of(name: str) -> np.ndarray:
    return naive.wavelet_cross_covariance(SIGNALS[name], 10)


def tiled(signal: torch.Tensor, n_levels: int) -> torch.Tensor:
    return wavelet_cross_covariance(signal, n_levels)


def differentiable(signal: torch.Tensor, n_levels: int) -> torch.Tensor:
    return wavelet_cross_covariance(signal.clone().requires_grad_(), n_levels).detach()


def function(signal: torch.Tensor, n_levels: int) -> torch.Tensor:
    return cross_covariance(haar_coefficients(signal, n_levels))


def layers(signal: torch.Tensor, n_levels: int) -> torch.Tensor:
    return torch.nn.Sequential(HaarFilterBank(n_levels), CrossCovariance())(signal)


PATHS = [tiled, differentiable, function, layers]


def test_by_hand():
    signal = torch.tensor([[0.0, 2.0, 4.0, 8.0], [1.0, 0.0, 0.0, 2.0]], dtype=torch.float64)
    # W_1 = (1, 1, 2) and (-1/2, 0, 1); W_2 = 5/2 and 1/4.
    expected = [[[2.0, 0.5], [0.5, 1.25 / 3]], [[6.25, 0.625], [0.625, 0.0625]]]
    torch.testing.assert_close(wavelet_cross_covariance(signal), torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(
        wavelet_variance(signal), torch.tensor([[2.0, 1.25 / 3], [6.25, 0.0625]], dtype=torch.float64)
    )


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("name", SIGNALS)
def test_equals_the_definition(path, name):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", NO_WINDOW)
        got = path(torch.from_numpy(SIGNALS[name]), 10)
    assert naive.relative_error(got, expected_of(name)) < 1e-10


@pytest.mark.parametrize("threads", [1, 3, 8])
@pytest.mark.parametrize("samples", [16, 128])
@pytest.mark.parametrize("name", SIGNALS)
def test_tiles_of_any_length_on_any_number_of_threads_give_the_same(monkeypatch, name, samples, threads):
    """Lags shorter than a tile, as long and longer; tiles finished and not; products in stripes and not."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(_tiles, "_CPU_TILE", 3 * samples // threads)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", NO_WINDOW)
        got = wavelet_cross_covariance(torch.from_numpy(SIGNALS[name]))
    assert naive.relative_error(got, expected_of(name)) < 1e-10


@pytest.mark.parametrize("n_samples", [2, 3, 4, 15, 16, 17, 31, 32, 33, 1023, 1024, 1025])
def test_recordings_of_any_length(n_samples):
    signal = naive.array(2, n_samples)
    got = wavelet_cross_covariance(torch.from_numpy(signal))
    assert got.shape == (int(np.log2(n_samples)), 2, 2)
    assert naive.relative_error(got, naive.wavelet_cross_covariance(signal, len(got))) < 1e-10


@pytest.mark.parametrize("n_sensors", [1, 2, 13, 64])
def test_arrays_of_any_size(n_sensors):
    signal = naive.array(n_sensors, 300)
    got = wavelet_cross_covariance(torch.from_numpy(signal), 8)
    assert naive.relative_error(got, naive.wavelet_cross_covariance(signal, 8)) < 1e-10


@pytest.mark.parametrize("shape", [(5, 2, 700), (2, 3, 2, 90), (1, 2, 2000), (300, 2, 8)])
def test_a_batch_equals_its_items(shape):
    signal = torch.from_numpy(with_gaps(np.random.default_rng(3).normal(size=shape) + 250))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", NO_WINDOW)
        got = wavelet_cross_covariance(signal)
        items = [wavelet_cross_covariance(item) for item in signal.reshape(-1, *shape[-2:])]
    expected = torch.stack(items).view(got.shape)
    assert naive.relative_error(got, expected) < 1e-10


def test_a_batch_without_items():
    nothing = torch.zeros(0, 3, 40, dtype=torch.float64)
    assert wavelet_cross_covariance(nothing).shape == (0, 5, 3, 3)
    assert wavelet_cross_covariance(nothing.requires_grad_()).shape == (0, 5, 3, 3)
    assert wavelet_variance(nothing).shape == (0, 5, 3)


@pytest.mark.parametrize("path", PATHS)
def test_float32_under_an_offset_of_250(path):
    """A float32 recording at 250 deg/s, 14 levels: its own rounding is in the data, the rest is ours."""
    signal = torch.from_numpy(naive.array(3, 2**14) + 250).float()
    got = path(signal, 14)
    assert got.dtype == torch.float32
    expected = wavelet_cross_covariance(signal.double(), 14)
    assert naive.relative_error(got, expected) < 3e-3
    # Over the levels with more than a handful of coefficients float32 is far better than that.
    assert naive.relative_error(got[:10], expected[:10]) < 1e-4


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("size", [1e-150, 1e-20, 1e20, 1e150])
def test_huge_and_tiny_signals(path, size):
    signal = torch.from_numpy(naive.array(3, 200))
    torch.testing.assert_close(path(signal * size, 7) / size / size, path(signal, 7), rtol=1e-12, atol=1e-14)


def test_linear_mixtures_of_the_sensors_mix_the_moments():
    signal = torch.from_numpy(naive.array(4, 500))
    mix = torch.from_numpy(np.random.default_rng(5).normal(size=(6, 4)))
    mixed = wavelet_cross_covariance(mix @ signal + torch.arange(6)[:, None])
    torch.testing.assert_close(mixed, mix @ wavelet_cross_covariance(signal) @ mix.T, rtol=1e-10, atol=1e-13)


def test_symmetric_and_positive_semidefinite():
    wccv = wavelet_cross_covariance(torch.from_numpy(naive.array(5, 4000)))
    assert (wccv - wccv.mT).abs().max() <= 1e-15 * wccv.abs().max()
    values = torch.linalg.eigvalsh(wccv)
    assert (values[:, 0] >= -1e-14 * values[:, -1]).all()


def test_a_drift_is_known_exactly():
    """A drift of w per sample has wavelet variance `w^2 tau^2 / 16`, its covariance with another likewise."""
    slopes = torch.tensor([1e-3, -2e-3], dtype=torch.float64)
    tau = torch.exp2(torch.arange(1, 15, dtype=torch.float64))
    got = wavelet_cross_covariance(250 + slopes[:, None] * torch.arange(20_000))
    expected = slopes[:, None] * slopes * (tau**2 / 16)[:, None, None]
    torch.testing.assert_close(got, expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("name", SIGNALS)
def test_wavelet_variance_is_the_diagonal(name):
    signal = torch.from_numpy(SIGNALS[name])
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", NO_WINDOW)
        variance, wccv = wavelet_variance(signal), wavelet_cross_covariance(signal)
    torch.testing.assert_close(variance, wccv.diagonal(dim1=-2, dim2=-1), rtol=1e-12, atol=0, equal_nan=True)
    np.testing.assert_allclose(variance[:4], naive.wavelet_variance(SIGNALS[name], 4), rtol=1e-10)


def test_variance_is_accurate_relative_to_each_sensor():
    """A quiet sensor beside a loud one keeps its own digits."""
    signal = naive.array(3, 3000) * np.array([[1e-8], [1.0], [1e8]]) + np.array([[250.0], [0.0], [-1e9]]) * 1e-6
    expected = naive.wavelet_variance(signal, 11)
    got = wavelet_cross_covariance(torch.from_numpy(signal), 11).diagonal(dim1=-2, dim2=-1)
    np.testing.assert_allclose(got, expected, rtol=1e-10)


@pytest.mark.parametrize("path", [wavelet_cross_covariance, wavelet_variance])
def test_a_level_without_any_complete_window_is_nan_and_said(path):
    signal = torch.from_numpy(naive.array(3, 1000))
    signal[1, ::5] = torch.nan
    with pytest.warns(UserWarning, match=NO_WINDOW + r"\[3, 4\]: NaN there.*fewer levels"):
        got = path(signal, 4)
    if path is wavelet_cross_covariance:
        got = got.diagonal(dim1=-2, dim2=-1)
    assert got[:2].isfinite().all()
    assert got[2:].isnan().tolist() == [[False, True, False]] * 2


def test_sensors_never_recorded_together_have_no_covariance():
    signal = torch.from_numpy(naive.array(2, 400))
    signal[0, 200:] = torch.nan
    signal[1, :200] = torch.nan
    with pytest.warns(UserWarning, match=NO_WINDOW + r"\[1, 2\]"):
        got = wavelet_cross_covariance(signal, 2)
    assert got.isnan().tolist() == [[[False, True], [True, False]]] * 2


def test_complete_recordings_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wavelet_cross_covariance(torch.from_numpy(naive.array(3, 64)))


@pytest.mark.parametrize("gaps", [False, True])
def test_gradients_are_those_of_the_definition(gaps):
    signal = torch.from_numpy(naive.array(2, 40))
    if gaps:
        signal[0, 11] = torch.nan
    signal.requires_grad_()
    wccv = wavelet_cross_covariance(signal, 3)
    known = signal.detach().isfinite()
    gradient = torch.autograd.grad((wccv * torch.arange(12.0).view(3, 2, 2)).sum(), signal)[0]
    step = torch.from_numpy(np.random.default_rng(7).normal(size=(2, 40)))
    with torch.no_grad():
        sides = [wavelet_cross_covariance(signal + h * step, 3) for h in (1e-5, -1e-5)]
    difference = ((sides[0] - sides[1]) / 2e-5 * torch.arange(12.0).view(3, 2, 2)).sum()
    assert gradient.isfinite().all()
    assert (gradient[~known] == 0).all()
    torch.testing.assert_close((gradient * step).sum(), difference, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize(
    ("coefficients", "error", "message"),
    [
        ([], ValueError, "`coefficients`: expected a list of one tensor per level, got an empty list"),
        ([torch.ones(2, 3, dtype=torch.int64)], TypeError, "`coefficients`: expected float32 or float64"),
        ([[1.0, 2.0]], TypeError, "`coefficients`: expected a torch tensor, got list"),
    ],
)
def test_bad_coefficients_are_named(coefficients, error, message):
    with pytest.raises(error, match=message):
        cross_covariance(coefficients)


@pytest.mark.parametrize("function_under_test", [wavelet_cross_covariance, wavelet_variance])
@pytest.mark.parametrize(
    ("signal", "n_levels", "error", "message"),
    [
        (torch.zeros(2, 8, dtype=torch.int16), 2, TypeError, "`signal`: expected float32 or float64, got torch.int16"),
        (torch.zeros(2, 8, dtype=torch.bfloat16), 2, TypeError, "`signal`: expected float32 or float64"),
        (torch.zeros(8), 2, ValueError, r"`signal`: expected \(..., sensor, time\), got shape \(8,\)"),
        (torch.zeros(2, 1), None, ValueError, "`signal`: expected at least 2 samples for one wavelet level, got 1"),
        (torch.zeros(2, 0), None, ValueError, "`signal`: expected at least 2 samples for one wavelet level, got 0"),
        (torch.zeros(2, 15), 4, ValueError, "`n_levels`: expected at most 3 for 15 samples"),
    ],
)
def test_bad_input_is_named(function_under_test, signal, n_levels, error, message):
    with pytest.raises(error, match=message):
        function_under_test(signal, n_levels)
