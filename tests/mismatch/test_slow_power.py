"""Power of all that is slow: as often by chance as its p value says, and seen where bands by themselves say nothing."""

from __future__ import annotations

import math

import pytest
import torch
from bounds import at_most

import gyrofuse as gf
from gyrofuse.mismatch.detectors.slow.slow_power import slow_power
from gyrofuse.mismatch.repair.inputs import modelled, prepared
from gyrofuse.mismatch.signals.comparison import Comparison

N, RATE = 8192, 100.0
NOISE = gf.parse_model("WN(variance=1) + AR1(phi=0.995,variance=1e-4) + RW(variance=1e-7)")


def compared(seed: int, path: torch.Tensor | float = 0.0, length: int = N) -> Comparison:
    g = torch.Generator().manual_seed(seed)
    recording = NOISE.simulate(N, batch=(3,), generator=g) + path
    simulation = NOISE.simulate(length, batch=(3,), generator=g)
    given = [gf.Recording(x, rate=RATE, unit="deg/s") for x in (recording, simulation)]
    return prepared(given[0], given[1], None, g)


@pytest.mark.parametrize("length", [N, 3 * N, N // 2])
def test_the_same_noise_differs_as_often_as_its_p_value_says(length: int):
    n_runs, level = 60, 0.05
    found = [slow_power(compared(seed, length=length)) for seed in range(n_runs)]
    assert sum(one is not None and one.p_value < level for one in found) <= at_most(n_runs, level)


def test_a_swing_of_one_and_a_half_periods_is_seen():
    t = torch.arange(N, dtype=torch.float64)
    comparison = compared(100, 0.5 * torch.sin(3 * math.pi * t / N))
    found = slow_power(comparison)
    assert found is not None
    assert found.p_value < 1e-4
    assert found.ratio > 5


def test_a_fit_says_little_of_what_is_slow():
    record = NOISE.simulate(N, batch=(3,), generator=torch.Generator().manual_seed(1))
    fitted = gf.fit_gmwm(record, "WN + AR1 + RW")
    recording = gf.Recording(record, rate=RATE, unit="deg/s")
    comparison = prepared(recording, modelled(fitted, recording), None, torch.Generator().manual_seed(0))
    assert comparison.reference.uncertainty is not None
    assert slow_power(comparison) is None
