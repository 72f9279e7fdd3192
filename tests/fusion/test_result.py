"""The result of a fit: summary, JSON and what it holds."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
import torch
from reference import haar as naive

from gyrofuse import fit_svo


def array(n_samples: int = 3000) -> torch.Tensor:
    return torch.from_numpy(naive.array(4, n_samples))


def test_summary_is_reproducible_and_fixed_in_width():
    result = fit_svo(array(), "short")
    text = result.summary()
    assert text == str(result) == fit_svo(array(), "short").summary()
    lines = text.splitlines()
    assert lines[0] == "Virtual gyro (SVO) of 4 sensors, 3000 samples"
    start = lines.index("Allan deviation (signal) at averaging time tau, of the virtual gyro in other recordings") + 1
    table, below = lines[start : start + 1 + result.n_levels], lines[start + 1 + result.n_levels :]
    assert [line.partition(":")[0] for line in below] == ["", "Equal weights", "Sensors", "Recording"]
    assert len({len(line) for line in table}) == 1
    assert max(map(len, lines)) <= 120


def test_summary_of_a_batch_names_its_items():
    signal = array().expand(3, 4, 3000)
    assert fit_svo(signal).summary().count("Virtual gyro (SVO)") == 3
    assert "... and 2 more" in fit_svo(array().expand(10, 4, 3000)).summary()


def test_a_result_becomes_json():
    result = fit_svo(array(), covariance="none")
    values = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert values["weights"] == result.weights.tolist()
    assert values["confidence_interval"]["low"] == [None] * 4
    assert np.shape(values["wavelet_cross_covariance"]) == (result.n_levels, 4, 4)
    assert values["tau"] == [2.0**j for j in range(result.n_levels)]


def test_a_result_does_not_keep_the_recording_alive():
    signal = array(100_000)
    result = fit_svo(signal)
    size = sum(v.untyped_storage().nbytes() for v in vars(result).values() if isinstance(v, torch.Tensor))
    assert size < 0.02 * signal.untyped_storage().nbytes()


def test_nothing_warns_on_good_data():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_svo(array()).summary()


def test_motion_is_recognised_and_noise_is_not():
    """Sensors that agree at a scale that counts have felt the same motion."""
    still = array()
    assert fit_svo(still).motion == ""
    turned = still + 3 * torch.sin(2 * torch.pi * torch.arange(3000, dtype=torch.float64) / 64)
    result = fit_svo(turned)
    assert result.agreement.argmax().item() in (4, 5)  # half a period is 32 samples
    assert "the array seems to have moved" in result.motion
    assert result.summary().endswith("fit the weights on a stretch at rest.")
    elsewhere = [1.0] + 10 * [0.0]
    assert fit_svo(turned, elsewhere).motion == ""


@pytest.mark.statistical
@pytest.mark.parametrize("n_samples", [4096, 5000])
@pytest.mark.parametrize("walk", [False, True])
@pytest.mark.filterwarnings("ignore:the block bootstrap trims all levels")
def test_independent_sensors_hardly_ever_seem_to_have_moved(n_samples: int, walk: bool):
    """At most 1 of 100 pairs, the hardest case: a level of one observation agrees or disagrees fully."""
    unit = torch.randn(100, 2, n_samples, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    signal = unit.cumsum(-1) if walk else unit
    for scale_weights in ("flat", "long"):
        # The degrees of freedom that count are the default's, at a sixth of the time.
        result = fit_svo(signal, scale_weights, covariance="block_bootstrap")
        assert sum(bool(result[i].motion) for i in range(100)) <= 1


def test_agreement_by_hand():
    wccv = torch.from_numpy(naive.wavelet_cross_covariance(naive.array(4, 300), 3))
    result = fit_svo(torch.from_numpy(naive.array(4, 300)), n_levels=3)
    for level in range(3):
        correlation = wccv[level].numpy().copy()
        correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
        expected = np.median(correlation[np.triu_indices(4, 1)])
        np.testing.assert_allclose(result.agreement[level], expected, rtol=1e-9)
