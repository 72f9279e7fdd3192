"""Spectra of short blocks, whose bands let in what is far above or below them."""

import numpy as np
import pytest
import torch
from scipy import signal as sps

from gyrofuse.mismatch.likelihoods.spectra.data import N_JUDGED, block_bands, compared_bands
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import filter_corner, filter_power, filter_strength
from gyrofuse.mismatch.signals.psd import cross_spectra

LENGTH, N = 34.4, 9821


def of_mean(length: float) -> np.ndarray:
    """Taps of a mean over so many samples, the last of which counts in part."""
    taps = np.append(np.ones(int(length)), length % 1)
    return taps / taps.sum()


def test_bands_of_blocks_are_what_blocks_of_a_moving_average_show():
    rng = np.random.default_rng(0)
    noise = sps.lfilter(of_mean(LENGTH), [1.0], rng.standard_normal(40 * N))[N:]
    n = N // N_JUDGED
    blocks = torch.from_numpy(noise[: len(noise) // n * n]).view(-1, 1, n)
    seen = cross_spectra(blocks, block_bands(n)).mean(0)[:, 0, 0].real
    bands = compared_bands(N)
    f = bands.nodes
    power = torch.from_numpy(np.abs(sps.freqz(of_mean(LENGTH), worN=2 * np.pi * f.numpy())[1]) ** 2)
    inside = slice(len(bands.below), len(bands.below) + len(seen))
    np.testing.assert_allclose(bands.mean_of(power)[inside] / seen, 1.0, atol=0.08)  # 1248 blocks; 0.76 to 1.10 before


def test_bands_of_flat_noise_are_its_level():
    bands = compared_bands(N)
    torch.testing.assert_close(bands.mean_of(torch.ones_like(bands.nodes)), torch.ones_like(bands.dof))


def test_a_mean_over_a_number_of_samples_that_is_not_whole():
    f = torch.linspace(0.001, 0.499, 200, dtype=torch.float64)
    for length in (1.5, 7.0, LENGTH):
        exact = np.abs(sps.freqz(of_mean(length), worN=2 * np.pi * f.numpy())[1]) ** 2
        power = filter_power("average", torch.tensor([length**2 - 1], dtype=torch.float64), f)[0]
        np.testing.assert_allclose(power, exact, rtol=1e-9, atol=1e-12)
    corner = torch.tensor([0.0129], dtype=torch.float64)
    half = filter_power("average", filter_strength("average", corner), corner[:, None])
    torch.testing.assert_close(half, torch.full_like(half, 0.5), rtol=1e-6, atol=0)


@pytest.mark.parametrize(("kind", "means"), [("integrated", 1), ("integrated2", 2)])
def test_what_sampling_leaves_of_analogue_means(kind: str, means: int):
    """The transform of the autocovariance: a triangle of one mean, a cubic spline of two."""
    f = torch.linspace(0.001, 0.499, 200, dtype=torch.float64)
    for length in (1.3, 3.0, 7.7):
        lags = np.abs(np.arange(-20, 21)) / length
        spline = np.where(lags < 1, 2 / 3 - lags**2 + lags**3 / 2, np.clip(2 - lags, 0, None) ** 3 / 6)
        covariance = np.clip(1 - lags, 0, None) if means == 1 else spline
        exact = np.cos(2 * np.pi * f.numpy()[:, None] * np.arange(-20, 21)) @ covariance / covariance.sum()
        power = filter_power(kind, torch.tensor([length**2], dtype=torch.float64), f)[0]
        np.testing.assert_allclose(power, exact, atol=1e-12 if means == 1 else 1e-4)  # images beyond the seventh
    corner = torch.tensor([0.0129, 0.2], dtype=torch.float64)
    half = filter_power(kind, filter_strength(kind, corner), corner[:, None])
    torch.testing.assert_close(half, torch.full_like(half, 0.5), rtol=1e-6, atol=0)
    torch.testing.assert_close(filter_corner(kind, filter_strength(kind, corner)), corner, rtol=1e-6, atol=0)
