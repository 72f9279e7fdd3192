"""Saturated samples are missing ones, and the full scale shows in the data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from reference import haar as naive_haar
from torch import Tensor

from gyrofuse.io.saturation import find_saturation, mask_saturated


def array(n_samples: int = 3000) -> Tensor:
    return torch.from_numpy(naive_haar.array(4, n_samples))


def test_saturated_samples_and_their_neighbours_are_missing():
    signal = torch.tensor([[0.0, 1, 2, 3, 2, 1, 0, -3.5, 0], [0, 0, 0, 0, 0, 0, 0, 0, 3]])
    nan = torch.nan
    expected = torch.tensor([[0.0, 1, nan, nan, nan, 1, nan, nan, nan], [0, 0, 0, 0, 0, 0, 0, nan, nan]])
    torch.testing.assert_close(mask_saturated(signal, 3.0), expected, equal_nan=True)
    bare = mask_saturated(signal, 3.0, guard=0)
    assert bare.isnan().sum() == 3
    own = mask_saturated(signal, torch.tensor([4.0, 3.0]), guard=0)
    assert own.isnan().sum() == 1
    batch = mask_saturated(signal.expand(2, 2, 9), torch.tensor([[4.0, 3.0], [3.0, 4.0]]), guard=0)
    assert batch.isnan().sum((-1, -2)).tolist() == [1, 2]
    assert mask_saturated(signal, 3.0, guard=20).isnan().all()


def test_a_bad_full_scale_is_named():
    with pytest.raises(ValueError, match=r"`full_scale`: expected numbers > 0, got 0\.0"):
        mask_saturated(array(), 0.0)
    with pytest.raises(ValueError, match="`guard`: expected a whole number >= 0, got -1"):
        mask_saturated(array(), 1.0, guard=-1)
    for guard in (2.5, torch.nan, True):
        with pytest.raises(ValueError, match=f"`guard`: expected a whole number >= 0, got {guard}"):
            mask_saturated(array(), 1.0, guard=guard)
    for full_scale in (torch.ones(3), torch.ones(2, 3)):
        with pytest.raises(ValueError, match="`full_scale`: expected one number, or one for each of 4 sensors in a"):
            mask_saturated(array(), full_scale)


def test_nothing_holds_no_saturation():
    assert find_saturation(torch.zeros(2, 3, 0)).tolist() == [[torch.inf] * 3] * 2
    assert mask_saturated(torch.zeros(2, 3, 0), 1.0).shape == (2, 3, 0)


def test_full_scale_is_found_from_the_pile_of_clipped_values():
    signal = 3 * array(5000)
    assert find_saturation(signal).isinf().all()
    clipped = signal.clone()
    clipped[1] = clipped[1].clamp(-4, 5)
    clipped[2] = clipped[2].clamp(max=3)
    clipped[3, 10] = torch.nan
    assert find_saturation(clipped).tolist() == [torch.inf, 4.0, 3.0, torch.inf]
    assert find_saturation(clipped.expand(2, 4, 5000)).shape == (2, 4)


@pytest.mark.parametrize("step", [0.01, 0.3, 1.0, 3.0])
def test_rounded_noise_and_motion_do_not_look_saturated(step):
    noise = (array(20_000) / step).round() * step
    assert find_saturation(noise).isinf().all()
    time = torch.arange(20_000, dtype=torch.float64)
    for amplitude in torch.linspace(10, 12, 21):
        motion = (amplitude * torch.sin(time / 97.3) / step).round() * step
        assert find_saturation(motion[None]).isinf().all(), amplitude


def test_a_constant_is_not_saturated():
    assert find_saturation(torch.ones(2, 50)).isinf().all()


def test_the_full_scale_of_a_real_array_is_found(data: Path):
    """The gyros of the board saturate at what 16 bits hold when it is turned by hand."""
    file = np.load(data / "mimu4444_8imu.npz")
    counts = torch.from_numpy(file["exp1"][:, :, 3:].astype(float)).permute(2, 1, 0)  # (axis, sensor, time)
    full_scale = find_saturation(counts)
    found = full_scale[full_scale.isfinite()]
    assert len(found) > 0
    assert ((found == 32767) | (found == 32768)).all()
    assert (full_scale.isfinite() == (counts.abs() >= 32767).sum(-1).ge(5)).all()
