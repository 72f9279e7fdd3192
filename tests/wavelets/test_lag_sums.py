"""Finite-sample covariances: against sums over every lag, against exact wavelet variances, and against simulation."""

from __future__ import annotations

import numpy as np
import pytest
from reference import processes as naive

from gyrofuse.wavelets.lag_sums import (
    block_mean_covariances,
    covariance_table,
    unit_covariances,
    unit_wavelet_variances,
)

TIME_CONSTANTS = (0.7, 2.0, 50.0, 3e5)
# Autocovariances of the components, of the AR1s less the one at lag 0: no filter sees the difference.
AUTOCOVARIANCES = [
    lambda lag: (lag == 0) * 1.0,
    *(lambda lag, t=t: np.expm1(-np.abs(lag) / t) for t in TIME_CONSTANTS),
    lambda lag: -np.abs(lag) / 2,
]


@pytest.mark.parametrize(("h", "k"), [(1, 1), (4, 1), (1, 8), (16, 8), (32, 32)])
def test_cross_covariances_are_those_of_the_filters(h, k):
    lags = np.arange(-4 * k - 5, 4 * h + 6).astype(float)
    first, second = (np.repeat([1.0, -1.0], n) / (2 * n) for n in (h, k))
    apart = lags[:, None, None] - np.arange(2 * h)[:, None] + np.arange(2 * k)
    got = unit_covariances(h, k, lags, TIME_CONSTANTS)
    for row, autocovariance in zip(got, AUTOCOVARIANCES, strict=True):
        expected = np.einsum("i,lik,k->l", first, autocovariance(apart), second)
        np.testing.assert_allclose(row, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize(("n_samples", "n_levels"), [(1000, 9), (700, 5)])
def test_table_is_the_sum_over_every_lag(n_samples, n_levels):
    constants = (2.0, 30.0, 400.0)
    got = covariance_table(n_samples, n_levels, constants)
    lags = np.arange(-n_samples, n_samples + 1).astype(float)
    for j in range(n_levels):
        for k in range(n_levels):
            s = unit_covariances(2**j, 2**k, lags, constants)
            start = np.maximum(2 ** (j + 1) - 1, 2 ** (k + 1) - 1 + lags)
            pairs = np.maximum(np.minimum(n_samples - 1, n_samples - 1 + lags) - start + 1, 0)
            counts = (n_samples - 2 ** (j + 1) + 1) * (n_samples - 2 ** (k + 1) + 1)
            np.testing.assert_allclose(got[j, k], (s * pairs) @ s.T / counts, rtol=1e-4)


def test_wavelet_variances_are_the_exact_ones():
    got = unit_wavelet_variances(12, (25.0,))
    for j, (white, ar1, walk) in enumerate(got):
        tau = 2.0 ** (j + 1)
        phi = np.exp(-1 / 25.0)
        np.testing.assert_allclose(white, 1 / tau, rtol=1e-12)
        np.testing.assert_allclose(walk, (tau**2 + 2) / (12 * tau), rtol=1e-9)
        np.testing.assert_allclose(ar1, (1 - phi**2) * naive.exact_ar1_wavelet_variance(phi, j + 1), rtol=1e-8)


@pytest.mark.parametrize("block", [1, 4, 32])
def test_block_means_have_the_mean_covariance_of_their_samples(block):
    got = block_mean_covariances(block, 5, TIME_CONSTANTS[:3])
    sample = np.arange(block)
    for row, autocovariance in zip(got, AUTOCOVARIANCES[:4] + AUTOCOVARIANCES[-1:], strict=True):
        for lag in range(5):
            apart = lag * block + sample[:, None] - sample
            expected = autocovariance(apart.astype(float)).mean()
            first = autocovariance((sample[:, None] - sample).astype(float)).mean()
            # Up to a constant, which no wavelet sees.
            np.testing.assert_allclose(row[lag] - row[0], expected - first, rtol=1e-6, atol=1e-10)
