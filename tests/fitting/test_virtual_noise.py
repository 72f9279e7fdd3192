"""Noise that a virtual gyro is left with: exact for one vector, against spectra and recordings for bands."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from gyrofuse import AR1, ArrayModel, Drift, RandomWalk, Sinusoid, WhiteNoise, wavelet_variance
from gyrofuse.fitting import virtual_noise
from gyrofuse.fitting.virtual_noise import response
from gyrofuse.fusion.multiscale_result import fuse_bands
from gyrofuse.noise.state_space import state_space

WHITE = torch.tensor([[1.0, 0.2, 0.0], [0.2, 2.0, 0.3], [0.0, 0.3, 1.5]], dtype=torch.float64)
SLOW = torch.tensor([1e-3, 2e-4, 5e-4], dtype=torch.float64).diag()
WALK = torch.tensor([1e-7, 3e-6, 1e-6], dtype=torch.float64).diag()
GAINS = torch.tensor([0.5, -0.3, 0.2], dtype=torch.float64)
BETA = 2 * math.pi * 0.05


def array() -> ArrayModel:
    slow = [(WhiteNoise(1.0), WHITE), (AR1(0.99, 1.0), SLOW), (RandomWalk(1.0), WALK)]
    return ArrayModel([*slow, (Sinusoid(1.0, BETA), GAINS)])


def bands(n_bands: int) -> Tensor:
    weights = torch.rand(n_bands, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    return weights / weights.sum(-1, keepdim=True)


def test_one_vector_is_exact():
    weights = torch.tensor([0.5, 0.7, -0.2], dtype=torch.float64)
    noise = virtual_noise(weights, array())
    assert noise.deviation == 0
    expected = torch.einsum("i,jik,k->j", weights, array().wavelet_cross_covariance(14), weights)
    torch.testing.assert_close(noise.model.wavelet_variance(14), expected, rtol=1e-9, atol=0)
    assert state_space(noise.model, 100.0).F.shape == (4, 4)


def test_bands_that_are_alike_are_one_vector():
    weights = torch.tensor([0.5, 0.7, -0.2], dtype=torch.float64)
    one, same = virtual_noise(weights, array()), virtual_noise(weights.expand(6, 3), array())
    assert same.deviation < 1e-6
    torch.testing.assert_close(same.model.wavelet_variance(16), one.model.wavelet_variance(16), rtol=1e-5, atol=0)


def test_the_response_is_that_of_the_filter():
    weights, n = bands(5), 256
    impulses = torch.eye(3, dtype=torch.float64)[:, :, None] * torch.eye(1, n, dtype=torch.float64)
    impulses = torch.nn.functional.pad(impulses, (32, 0))  # past the start, of which the means know less
    out = fuse_bands(weights.expand(3, -1, -1), impulses)[0][:, 32:]
    expected = np.fft.rfft(out.numpy())
    got = response(weights, torch.fft.rfftfreq(n, dtype=torch.float64)[1:])
    np.testing.assert_allclose(got, expected[:, 1:], rtol=0, atol=1e-12)


def test_noise_of_bands_against_recordings():
    """The wavelet variance of 20 long recordings, past the start of the filter, within its accuracy and chance."""
    weights, n_samples = bands(7), 2**16
    noise = virtual_noise(weights, array())
    assert 0 < noise.deviation < 0.5
    signal = array().simulate(n_samples, batch=(20,), generator=torch.Generator().manual_seed(3))
    fused = fuse_bands(weights.expand(20, -1, -1), signal)[0][:, None, 2**7 :]
    found = wavelet_variance(fused, 10)[..., 0]
    error = found.std(0) / 20**0.5
    off = (noise.model.wavelet_variance(10) - found.mean(0)).abs()
    assert (off < noise.deviation * found.mean(0) + 4 * error).all(), (off / found.mean(0)).tolist()
    assert (off < 0.15 * found.mean(0) + 4 * error).all(), (off / found.mean(0)).tolist()


def test_sensors_with_models_of_their_own():
    sensors = ArrayModel.from_sensors([WhiteNoise(float(k)) + RandomWalk(1e-6 * k) for k in (1, 2, 3)])
    weights = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)
    model = virtual_noise(weights, sensors).model
    assert sorted(model.param_names) == ["random_walk.variance", "white_noise.variance"]
    expected = torch.einsum("i,jik,k->j", weights, sensors.wavelet_cross_covariance(8), weights)
    torch.testing.assert_close(model.wavelet_variance(8), expected, rtol=1e-9, atol=0)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"`weights`: expected \(sensor,\) or \(band, sensor\) for the 3 sensors"):
        virtual_noise(torch.ones(4, dtype=torch.float64) / 4, array())
    drifting = array() + ArrayModel([(Drift(1.0), GAINS)])
    with pytest.raises(ValueError, match="`array`: expected noise, got a Drift"):
        virtual_noise(bands(3), drifting)
