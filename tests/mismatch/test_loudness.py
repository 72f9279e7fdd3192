"""Episodes as they act on records: from which frequency on they are louder, and what that does to whitened samples."""

from __future__ import annotations

import pytest
import torch

import gyrofuse as gf
from gyrofuse.mismatch.detectors.spectra.peaks import strongest_peak
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.variance_course import (
    VarianceCourse,
    corner_of,
    fast_factor,
    fast_share,
    whitened_factor,
)
from gyrofuse.mismatch.stats.segments import Episode, Episodes, _factors, first_segment_posterior

N = 2**16
INSIDE = (torch.arange(N) >= 20_000) & (torch.arange(N) < 40_000)


def white(seed: int, n_sensors: int = 3) -> torch.Tensor:
    return torch.randn(n_sensors, N, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("corner", [2.0**-14, 2.0**-6, 2.0**-4])
def test_a_whitened_factor_is_the_mean_over_all_frequencies(corner: float):
    factor = torch.tensor([0.5, 1.0, 1.3, 4.0], dtype=torch.float64)
    f = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 400_000
    expected = 1 + (factor - 1) * fast_share(f, corner).mean()
    torch.testing.assert_close(whitened_factor(factor, corner), expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(fast_factor(whitened_factor(factor, corner), corner), factor)


def test_noise_never_gets_a_negative_power():
    assert (fast_factor(torch.tensor([1e-3, 0.1], dtype=torch.float64), 2.0**-4) > 0).all()


def test_what_is_added_is_as_loud_as_it_says_and_can_be_taken_off():
    factor = torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
    loud = VarianceCourse(INSIDE, factor, 2.0**-6)
    noise = white(1)
    louder = loud.added(noise)
    torch.testing.assert_close(louder[:, ~INSIDE], noise[:, ~INSIDE])
    torch.testing.assert_close(louder[0], noise[0])
    ratio = louder[:, INSIDE].var(-1) / noise[:, INSIDE].var(-1)
    assert ratio.tolist() == pytest.approx(whitened_factor(factor, 2.0**-6).tolist(), rel=0.02)
    inner = slice(20_500, 39_500)  # at the ends of an episode filters see what is not louder
    torch.testing.assert_close(loud.taken_off(louder)[:, inner], noise[:, inner], rtol=0, atol=0.05)
    assert float((loud.taken_off(louder) - noise).square().mean()) < 1e-4


def test_another_length_has_as_large_a_share_of_it():
    for n in (1000, N // 2, N, 100_000):
        other = VarianceCourse(INSIDE, torch.ones(1), 0.1).of_length(n)
        assert len(other.course) == n
        assert float(other.course.double().mean()) == pytest.approx(20_000 / N, abs=2 / n)


def test_the_corner_is_where_slow_noise_hides_what_is_louder():
    factor = torch.full((3,), 1.96, dtype=torch.float64)
    walk = gf.RandomWalk(4e-3).simulate(N, batch=(3,), generator=torch.Generator().manual_seed(5))  # as strong at 0.01
    everything = torch.where(INSIDE, 1.4 * white(2), white(2))
    assert corner_of(everything, INSIDE, factor) <= 2.0**-10
    beside = torch.where(INSIDE, 1.4 * white(3), white(3)) + walk
    assert 2.0**-8 <= corner_of(beside, INSIDE, whitened_factor(factor, 0.01)) <= 2.0**-6


def test_where_nothing_tells_it_is_a_64th():
    short = torch.zeros(N, dtype=torch.bool)
    short[1000:1100] = True
    assert corner_of(white(4), short, torch.full((3,), 2.0, dtype=torch.float64)) == 1 / 64
    assert corner_of(white(4), INSIDE, torch.full((3,), 1.001, dtype=torch.float64)) == 1 / 64


@pytest.mark.parametrize("true", [9.0, 400.0])
def test_a_level_is_known_however_loud_it_is(true: float):
    noise = white(7)
    noise[1, INSIDE] *= true**0.5
    noise[:, 100] = 30.0  # an outlier is none of it
    episodes = Episodes((Episode(20_000, 40_000),), torch.ones(3, dtype=torch.float64))
    factor = _factors(noise, episodes.inside(N), None)
    assert factor.tolist() == pytest.approx([1, true, 1], rel=0.04)
    told = first_segment_posterior(noise[1:2], episodes.episodes)
    assert float(told.log_factor.exp()) == pytest.approx(true, rel=0.04)


def test_a_few_wild_samples_are_no_level():
    noise = white(8)
    noise[0, 500:510] = 40.0
    episodes = Episodes((Episode(500, 510),), torch.ones(3, dtype=torch.float64))
    assert float(_factors(noise, episodes.inside(N), None)[0]) <= 25.5


def test_nothing_bulges_where_a_part_of_the_record_has_all_power():
    """Its noise fills neighbouring bins alike, as a bump does."""
    n, least = 8192, []
    course = (torch.arange(n) >= 3000) & (torch.arange(n) < 3600)
    for seed in range(6):
        noise = white(20 + seed, 2)[..., : 3 * n].unflatten(-1, (3, n)).movedim(1, 0)
        known = VarianceCourse(course, torch.full((2,), 300.0, dtype=torch.float64), 1e-4)
        observed = known.added(noise[0])
        comparison = Comparison.of(RecordingInfo(100.0, "deg/s", ("1", "2")), observed, noise[1:]).made_louder(known)
        least.append(strongest_peak(comparison).p_value)
    assert min(least) > 1e-3
