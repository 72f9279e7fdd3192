"""Variance of a mean from the series itself: by hand, against theory, and by coverage."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from gyrofuse.wavelets import long_run_variance as series


def test_terms_follow_the_windows():
    windows = torch.tensor([1.0, 16.0, 70.0, 1e6])
    assert series.n_basis(windows).tolist() == [2, 4, 17, series.MOST_BASIS]


@pytest.mark.parametrize(("n_samples", "n_sensors", "n_levels"), [(100, 6, 6), (8192, 6, 13), (4_000_000, 12, 21)])
def test_bins_are_powers_of_two_within_twice_the_data(n_samples, n_sensors, n_levels):
    length = series.bin_length(n_samples, n_sensors)
    assert length & (length - 1) == 0
    n_bins = math.ceil(n_samples / length)
    assert n_bins * n_levels * n_sensors**2 <= 2 * n_samples * n_sensors + n_levels * n_sensors**2
    assert n_bins <= 8 * series.MOST_BASIS


def test_one_bin_for_each_sample_is_the_cosine_transform():
    x = torch.from_numpy(np.random.default_rng(0).normal(size=(512, 2)))
    got = series.mean_covariance(x, torch.ones(512, dtype=torch.float64), torch.tensor(6.0))
    time = (np.arange(512) + 0.5) / 512
    looks = np.stack([math.sqrt(2) * np.cos(math.pi * b * time) @ x.numpy() / 512 for b in range(1, 7)])
    np.testing.assert_allclose(got, looks.T @ looks / 6, rtol=1e-4)


def test_gaps_close_up():
    """Terms that are not known are left out, and the cosines run over those that are."""
    x = np.random.default_rng(1).normal(size=400)
    sums = torch.zeros(500, 1, dtype=torch.float64)
    counts = torch.zeros(500, dtype=torch.float64)
    kept = np.r_[0:120, 220:500]
    sums[kept, 0], counts[kept] = torch.from_numpy(x), 1.0
    whole = series.mean_covariance(torch.from_numpy(x)[:, None], torch.ones(400).double(), torch.tensor(8.0))
    torch.testing.assert_close(series.mean_covariance(sums, counts, torch.tensor(8.0)), whole)


@pytest.mark.parametrize("phi", [0.0, 0.9])
def test_intervals_of_a_mean_hold(phi):
    """95 % intervals of the mean of 2000 AR1 series of 4096 samples, 16 cosines, in 64 bins; two-sided binomial."""
    rng = np.random.default_rng(2)
    noise = rng.normal(size=(2000, 4196))
    x = np.zeros_like(noise)
    for t in range(1, noise.shape[1]):
        x[:, t] = phi * x[:, t - 1] + noise[:, t]
    x = torch.from_numpy(x[:, 100:])
    sums = x.unflatten(-1, (64, 64)).sum(-1)[..., None]
    variance = series.mean_covariance(sums, torch.full((2000, 64), 64.0).double(), torch.full((2000,), 16.0))
    half = stats.t.ppf(0.975, 16) * variance[:, 0, 0].sqrt()
    covered = int((x.mean(-1).abs() <= half).sum())
    low, high = stats.binom.ppf([5e-4, 1 - 5e-4], 2000, 0.95)
    assert low <= covered <= high
