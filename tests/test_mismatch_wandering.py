"""A weak tone that wanders, and noise of the same spectrum that all sensors share, told apart."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from scipy import stats
from shape_draws import SIGNS, N, array, case, generator, oscillating

from gyrofuse.mismatch.bump_fit import oscillation_of
from gyrofuse.mismatch.steadiness import steadiness
from gyrofuse.mismatch.wandering import _cell, _courses, _hump, wandering_log_ratio

WIDTH, RMS = 60 / N, 9e-4  # half width in cycles per sample; deg/s


def wandering(g: torch.Generator) -> torch.Tensor:
    """A tone that goes up and down by a few half widths, eleven times in the record."""
    knots = torch.randn(1, 1, 12, generator=g, dtype=torch.float64) * 1.5 * WIDTH
    speed = torch.nn.functional.interpolate(knots, N, mode="linear", align_corners=True)[0]
    return math.sqrt(2) * torch.cos(2 * math.pi * (0.2 + speed).cumsum(-1))


@pytest.mark.parametrize("tone", [True, False])
def test_weak_ones_are_told_apart(tone: bool):
    n_runs, right, wrong, seen = 8, 0, 0, 0
    for seed in range(n_runs):
        g = generator(900 + seed)
        records = array().simulate(N, batch=(4,), generator=g)
        source = wandering(g) if tone else oscillating(g, 0.2, WIDTH, 1)
        given = case(records[0] + RMS * SIGNS[:, None] * source, records[1:])
        bump = oscillation_of(given)
        if bump is None or bump.gain is None:
            continue
        seen += 1
        verdict = steadiness(given, bump)
        right += verdict.tone == tone
        wrong += verdict.tone != tone and not verdict.open
    assert seen >= n_runs - 1
    assert right >= stats.binom.ppf(1e-2, seen, 0.9)
    assert wrong == 0


def test_courses_have_a_mean_ratio_of_one_in_noise():
    power = torch.empty(4000, 12, 16, dtype=torch.float64).exponential_(generator=generator(910))
    ratios = torch.stack([_courses(p, 4.0 / 12).logsumexp(0).exp() / 15 for p in power])
    assert abs(float(ratios.mean()) - 1) < 4 * float(ratios.std()) / math.sqrt(len(ratios))


@pytest.mark.parametrize("n_bins", [4096, 12288])
@pytest.mark.parametrize("normal", [True, False])
def test_the_shape_of_a_strong_hump_is_told(normal: bool, n_bins: int):
    k = torch.arange(n_bins, dtype=torch.float64) - 0.49 * n_bins
    width = 60 * n_bins / 4096
    shape = torch.exp(-(k / width).square() / 2) if normal else 1 / (1 + (k / width).square())
    noise = torch.empty(n_bins, dtype=torch.float64).exponential_(generator=generator(920))
    hump = _hump(3.0 * noise * (1 + 10 * shape))
    assert hump.normal == pytest.approx(float(normal), abs=1e-3)
    assert hump.level == pytest.approx(3.0, rel=0.1)
    assert hump.energy == pytest.approx(10 * float(shape.sum()), rel=0.4)  # widths and heights are a grid of octaves


def test_half_of_a_band_is_a_whole_number_of_cells():
    for half in (100, 2048, 2049, 4100, 20_485, 60_000):
        reach = half - half % _cell(2 * half)
        assert 2 * half / _cell(2 * half) <= 4096
        assert 2 * reach % _cell(2 * reach) == 0
        assert reach > half - half / 1000


def test_no_room_for_a_band_says_nothing():
    given = case(array().simulate(N, generator=generator(1)), array().simulate(N, batch=(2,), generator=generator(2)))
    bump = oscillation_of(
        case(given.recording + 3e-3 * oscillating(generator(3), 0.2, WIDTH, 1), given.simulated.signal)
    )
    assert bump is not None
    weights = torch.ones(len(SIGNS), dtype=torch.complex128)

    assert wandering_log_ratio(given, dataclasses.replace(bump, centre=20 / N), weights) == 0.0
