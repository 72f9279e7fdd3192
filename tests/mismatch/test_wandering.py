"""A weak tone that wanders, and noise of the same spectrum that all sensors share, told apart."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from scipy import stats
from shape_draws import SIGNS, N, array, comparison, generator, oscillating

from gyrofuse.mismatch.detectors.spectra.frequency_courses import _cell, _courses, _hump, wandering_log_ratio
from gyrofuse.mismatch.detectors.spectra.peak_fit import oscillation_of
from gyrofuse.mismatch.detectors.spectra.steadiness import steadiness
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone

WIDTH, RMS = 60 / N, 9e-4  # half width in cycles per sample; deg/s


def wandering(g: torch.Generator, width: float = WIDTH) -> torch.Tensor:
    """A tone that goes up and down by a few half widths, eleven times in the record."""
    knots = torch.randn(1, 1, 12, generator=g, dtype=torch.float64) * 1.5 * width
    speed = torch.nn.functional.interpolate(knots, N, mode="linear", align_corners=True)[0]
    return math.sqrt(2) * torch.cos(2 * math.pi * (0.2 + speed).cumsum(-1))


@pytest.mark.statistical
@pytest.mark.parametrize("tone", [True, False])
def test_weak_ones_are_told_apart(tone: bool):
    n_runs, right, wrong, seen = 8, 0, 0, 0
    for seed in range(n_runs):
        g = generator(900 + seed)
        records = array().simulate(N, batch=(4,), generator=g)
        source = wandering(g) if tone else oscillating(g, 0.2, WIDTH, 1)
        given = comparison(records[0] + RMS * SIGNS[:, None] * source, records[1:])
        peak = oscillation_of(given)
        if peak is None or peak.gain is None:
            continue
        seen += 1
        verdict = steadiness(given, peak)
        right += verdict.tone == tone
        wrong += verdict.tone != tone and not verdict.open
    assert seen >= n_runs - 1
    assert right >= stats.binom.ppf(1e-2, seen, 0.9)
    assert wrong == 0


@pytest.mark.statistical
@pytest.mark.parametrize("tone", [True, False])
def test_strong_ones_are_told_apart_that_hardly_wander(tone: bool):
    """Of a bump a few bins wide the envelope has a few independent values, but no noise is as steady as a tone."""
    for seed in range(3):
        g, width = generator(930 + seed), 3 / N
        records = array().simulate(N, batch=(4,), generator=g)
        source = wandering(g, width) if tone else oscillating(g, 0.2, width, 1)
        given = comparison(records[0] + 8 * RMS * SIGNS[:, None] * source, records[1:])
        peak = oscillation_of(given)
        assert peak is not None
        verdict = steadiness(given, peak)
        assert verdict.tone == tone
        assert not (tone and verdict.open)


def test_a_band_is_cleaned_to_the_level_of_the_noise_whatever_is_slow():
    """What a walk leaves in the slowest ordinates is many times the noise, and none of the band's."""
    records = array().simulate(N, batch=(5,), generator=generator(940))
    slow = torch.sin(2 * math.pi * torch.arange(N, dtype=torch.float64) / N * 1.7)
    given = comparison(records[0] + 0.01 * slow, records[1:])
    mode = Mode(500 / N, 45 / N, SIGNS.to(torch.complex128), True)
    cleaned = DriftingTone(mode, True).repair(given, generator(941))
    bins = torch.arange(60, 940)
    power = torch.fft.rfft(cleaned.recording)[:, bins].abs().square() / given.base.spectrum(bins / N) / N
    assert float((power.mean(-1) - 1).abs().max()) < 5 / math.sqrt(len(bins)) + 0.05  # which the base is off


def test_a_strong_tone_leaves_nothing_beside_the_middle_of_its_line():
    """Its line is seen farther out than any number of its half widths, and falls as no Lorentzian does."""
    g, width = generator(942), 3 / N
    records = array().simulate(N, batch=(5,), generator=g)
    given = comparison(records[0] + 30 * RMS * SIGNS[:, None] * wandering(g, width), records[1:])
    mode = Mode(0.2, 1.5 / N, 30 * RMS * SIGNS.to(torch.complex128), True)
    cleaned = DriftingTone(mode, True).repair(given, g)
    bins = round(0.2 * N) + torch.arange(-80, 81)
    power = torch.fft.rfft(cleaned.recording)[:, bins].abs().square() / given.base.spectrum(bins / N) / N
    assert float(power.mean()) < 2


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
    given = comparison(
        array().simulate(N, generator=generator(1)), array().simulate(N, batch=(2,), generator=generator(2))
    )
    peak = oscillation_of(
        comparison(given.recording + 3e-3 * oscillating(generator(3), 0.2, WIDTH, 1), given.reference.signal)
    )
    assert peak is not None
    weights = torch.ones(len(SIGNS), dtype=torch.complex128)

    assert wandering_log_ratio(given, dataclasses.replace(peak, centre=20 / N), weights) == 0.0
