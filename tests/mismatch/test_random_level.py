"""Noise whose level goes up and down at random: the law by its hidden chain, and what a diagnosis makes of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import gyrofuse as gf
from gyrofuse.mismatch.likelihoods.laws.random_level import RandomLevel, chain
from gyrofuse.mismatch.stats.hmm import forward_backward

Array = np.ndarray
N = 24_000


def on_and_off(seed: int, mean_on: float, mean_off: float) -> Array:
    rng = np.random.default_rng(seed)
    lengths = rng.geometric((1 / mean_off, 1 / mean_on), (N, 2)).ravel()
    return np.repeat(np.tile([0.0, 1.0], N), lengths)[:N]


def wandering(seed: int, phi: float, sd: float) -> Array:
    """A log variance that is an AR(1)."""
    steps = np.random.default_rng(seed).normal(size=N) * sd * np.sqrt(1 - phi**2)
    return lfilter([1.0], [1.0, -phi], steps)


def squares(variance: Array, seed: int) -> torch.Tensor:
    z = np.random.default_rng(seed).normal(size=N) * np.sqrt(variance)
    return torch.from_numpy(z**2).view(32, -1)


@pytest.mark.parametrize("sources", [1, 2, 5])
def test_the_chain_is_the_sum_of_sources_that_are_on_or_off(sources):
    start, transition = chain(sources, 0.03, 0.2)
    torch.testing.assert_close(transition.sum(-1), torch.ones(sources + 1, dtype=torch.float64))
    torch.testing.assert_close(start @ transition, start)
    count = torch.arange(sources + 1, dtype=torch.float64)
    centred = count - start @ count
    variance, next_one = start @ centred**2, (start * centred) @ transition @ centred
    assert float(next_one / variance) == pytest.approx(1 - 0.03 - 0.2)


def test_products_in_a_tree_give_the_likelihood_of_all_paths():
    law = RandomLevel(3, 0.8, 6.0, 0.05, 0.2)
    start, transition = chain(3, 0.05, 0.2)
    values = torch.rand(4, 37, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    variance = 0.8 * 6.0 ** (torch.arange(4, dtype=torch.float64) / 3)
    density = -(variance.log() + values[..., None] / variance) / 2
    torch.testing.assert_close(law.log_likelihood(values), forward_backward(density, start, transition)[0])


def test_the_mean_is_that_of_all_states():
    law = RandomLevel(4, 0.8, 6.0, 0.05, 0.2)
    start, _ = chain(4, 0.05, 0.2)
    states = 0.8 * 6.0 ** (torch.arange(5, dtype=torch.float64) / 4)
    assert law.mean == pytest.approx(float(start @ states))


def test_numbers_of_bursts_are_found():
    law = RandomLevel.fitted(squares(1 + 4 * on_and_off(1, 15, 150), 2))
    assert law.sources <= 2
    assert 1 / law.leave == pytest.approx(15, rel=0.25)
    assert law.factor == pytest.approx(5, rel=0.15)
    assert law.base == pytest.approx(1, rel=0.03)


def test_a_level_that_wanders_has_several_sources_and_its_time_constant():
    law = RandomLevel.fitted(squares(np.exp(wandering(3, 0.98, 0.8)), 4))
    assert law.sources >= 4
    assert law.samples == pytest.approx(-1 / np.log(0.98), rel=0.25)
    spread = np.log(law.factor) * np.sqrt(law.share * (1 - law.share) / law.sources)
    assert abs(spread) == pytest.approx(0.8, rel=0.2)


def test_sensors_at_the_same_time_say_more_together():
    on = 1 + 1.2 * on_and_off(5, 15, 150)
    rows = [squares(on, seed) for seed in (6, 7, 8)]
    apart = sum(float(RandomLevel.fitted(row).gains(row).sum()) for row in rows)
    total = torch.stack(rows).sum(0)
    assert float(RandomLevel.fitted(total, 3).gains(total).sum()) > 1.5 * apart


def noise(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(3, N)) + 0.1 * lfilter([1.0], [1.0, -0.999], rng.normal(size=(3, N)))


def with_level(seed: int, level: Array) -> Array:
    """Noise whose white part is louder in two sensors."""
    recording, rng = noise(seed), np.random.default_rng(seed + 1000)
    for i in (0, 2):
        recording[i] += np.sqrt(level) * rng.normal(size=N)
    return recording


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bursts", "wandering"])
def test_a_random_level_is_named_once_and_nothing_is_left(kind):
    level = 5 * on_and_off(11, 12, 120) if kind == "bursts" else np.exp(wandering(12, 0.97, 1.0))
    report = gf.diagnose(torch.from_numpy(with_level(13, level)), torch.from_numpy(noise(14)), rate=200.0)
    assert report.findings[0].mechanism == "variance_change"
    assert report.findings[0].sensors == (0, 2)
    assert {f.mechanism for f in report.findings} <= {"variance_change", "parameter_shift"}
    assert not report.unexplained
    assert report.held_out is not None
    assert report.held_out.after < 1.5
    again = gf.diagnose(torch.from_numpy(with_level(15, level[::-1].copy())), report.model, rate=200.0)
    assert "variance_change" not in {f.mechanism for f in again.findings}
