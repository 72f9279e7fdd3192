"""The result of a fit: summary, JSON and what it holds."""

from __future__ import annotations

import json
import warnings

import numpy as np
import torch
from reference import haar as naive

from gyrofuse import fit_svo


def array(n_samples: int = 3000) -> torch.Tensor:
    return torch.from_numpy(naive.array(4, n_samples))


def test_summary_is_reproducible_and_fixed_in_width():
    result = fit_svo(array(), "long")
    text = result.summary()
    assert text == str(result) == fit_svo(array(), "long").summary()
    lines = text.splitlines()
    assert lines[0] == "Virtual gyro (SVO) of 4 sensors, 3000 samples"
    table = lines[lines.index("Allan deviation (signal) at averaging time tau") + 1 :]
    assert len(table) == 1 + result.n_levels
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
