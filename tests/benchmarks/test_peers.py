"""The comparison is fair only when every peer gives the same numbers."""

import sys
from pathlib import Path

import numpy as np
import torch

import gyrofuse as gf

sys.path.insert(0, str(Path(__file__).parent))
from peers import blocked_numpy_variance, blocked_numpy_wccv, conv1d_wccv


def signal() -> torch.Tensor:
    noise = gf.parse_model("WN(variance=1) + RW(variance=1e-2)")
    return noise.simulate(30_000, batch=(3,), generator=torch.Generator().manual_seed(0))


def test_cross_covariances_agree():
    x = signal()
    ours = gf.wavelet_cross_covariance(x, 14).numpy()
    scale = np.sqrt(np.einsum("jii,jkk->jik", ours, ours))
    for block in (512, 8192):
        assert np.abs(blocked_numpy_wccv(x.numpy(), 14, block) - ours).max() <= 1e-11 * scale.max()
        np.testing.assert_array_less(np.abs(blocked_numpy_wccv(x.numpy(), 14, block) - ours) / scale, 1e-10)
    np.testing.assert_array_less(np.abs(conv1d_wccv(x, 14).numpy() - ours) / scale, 1e-10)


def test_variances_agree():
    x = signal()[:1]
    ours = gf.wavelet_variance(x, 14)[:, 0].numpy()
    np.testing.assert_allclose(blocked_numpy_variance(x[0].numpy(), 14, 1000), ours, rtol=1e-9)
