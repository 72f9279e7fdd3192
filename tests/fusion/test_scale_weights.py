"""Scale weights by name and by number."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference import haar as naive

from gyrofuse import SVOWeights, fit_svo, svo_weights, wavelet_cross_covariance
from gyrofuse.fusion.weights.svo import resolve_scale_weights

NAMES = ["flat", "short", "long"]


def array() -> torch.Tensor:
    return torch.from_numpy(naive.array(4, 3000))


@pytest.mark.parametrize("n_levels", [1, 2, 6, 12, 19, 21])
@pytest.mark.parametrize("name", NAMES)
def test_named_scale_weights_sum_to_one_and_lean_their_way(name, n_levels):
    weights = resolve_scale_weights(name, n_levels)
    assert weights.shape == (n_levels,)
    assert weights.dtype == torch.float64
    torch.testing.assert_close(weights.sum().item(), 1.0, rtol=0, atol=1e-15)
    steps = weights.diff()
    assert {"flat": steps == 0, "short": steps < 0, "long": steps > 0}[name].all()


@pytest.mark.parametrize("n_levels", [19, 21])
@pytest.mark.parametrize("name", NAMES)
def test_named_scale_weights_are_the_papers(name, n_levels):
    np.testing.assert_allclose(resolve_scale_weights(name, n_levels), naive.scale_weights(name, n_levels), rtol=1e-13)


@pytest.mark.parametrize(
    "numbers", [[1, 0, 3], (1, 0, 3), np.array([1.0, 0.0, 3.0]), torch.tensor([1, 0, 3]), [0.25, 0.0, 0.75]]
)
def test_numbers_are_normalised(numbers):
    assert resolve_scale_weights(numbers, 3).tolist() == [0.25, 0.0, 0.75]


@pytest.mark.parametrize(
    ("scale_weights", "error", "message"),
    [
        ("medium", ValueError, "`scale_weights`: expected 'flat', 'short', 'long' or .* per level, got 'medium'"),
        ([1.0, 1.0], ValueError, "`scale_weights`: expected one number for each of 3 levels, got 2"),
        (torch.ones(3, 1), ValueError, r"`scale_weights`: expected one number per level, got shape \(3, 1\)"),
        ([1.0, -1.0, 1.0], ValueError, r"`scale_weights`: expected finite numbers >= 0, not all zero, got \[1.0, -1.0"),
        ([0.0, 0.0, 0.0], ValueError, "`scale_weights`: expected finite numbers >= 0, not all zero"),
        ([1.0, float("nan"), 1.0], ValueError, "`scale_weights`: expected finite numbers >= 0"),
        ([1.0, float("inf"), 1.0], ValueError, "`scale_weights`: expected finite numbers >= 0"),
        (None, TypeError, "`scale_weights`: expected 'flat', 'short', 'long' or one number per level, got None"),
        (["a", "b", "c"], TypeError, r"`scale_weights`: expected 'flat', .* got \['a', 'b', 'c'\]"),
    ],
)
def test_bad_scale_weights_are_named(scale_weights, error, message):
    three_levels = wavelet_cross_covariance(array(), 3)
    for use in (
        lambda: resolve_scale_weights(scale_weights, 3),
        lambda: svo_weights(three_levels, scale_weights),
        lambda: fit_svo(array(), scale_weights, n_levels=3),
    ):
        with pytest.raises(error, match=message):
            use()


def test_a_layer_looks_at_its_numbers_once():
    with pytest.raises(ValueError, match="`scale_weights`: expected finite numbers >= 0"):
        SVOWeights([1.0, -1.0])
    with pytest.raises(TypeError, match=r"`scale_weights`: expected 'flat', 'short', 'long' or .*, got None"):
        SVOWeights(None)
    with pytest.raises(ValueError, match=r"`scale_weights`: expected one number per level, got shape \(\)"):
        SVOWeights(3)
    with pytest.raises(ValueError, match=r"`scale_weights`: expected 'flat', 'short', 'long' .*, got 'medium'"):
        SVOWeights("medium")(torch.eye(2).expand(3, 2, 2))
    with pytest.raises(ValueError, match="`wccv`: expected 2 levels, one for each scale weight, got 3"):
        SVOWeights([1.0, 1.0])(torch.eye(2).expand(3, 2, 2))
