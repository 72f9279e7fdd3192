"""Lost samples as steps of a phase: the mean likelihood ratio over all paths, and the single losses."""

from __future__ import annotations

import math

import torch
from scipy import stats

from gyrofuse.mismatch.detectors.lines.lost_samples import losses_of, paths_of
from gyrofuse.mismatch.stats.multiplicity import p_value_from_e_value

BLOCKS, ANGLE = 512, 2 * math.pi * 0.23
TOGETHER = torch.ones(1, 2, dtype=torch.float64)


def tones(g: torch.Generator, amplitude: float, lost: torch.Tensor, n_sensors: int = 2) -> torch.Tensor:
    """Demodulated tones `(sensor, block)` with noise of one, turned by what was lost before each block."""
    parts = torch.randn(2, n_sensors, BLOCKS, generator=g, dtype=torch.float64) / math.sqrt(2)
    turn = 2 * math.pi * torch.rand(n_sensors, 1, generator=g, dtype=torch.float64)
    return torch.polar(torch.full((n_sensors, BLOCKS), amplitude, dtype=torch.float64), turn + ANGLE * lost) + (
        torch.complex(*parts)
    )


def steps(*places: int) -> torch.Tensor:
    """One sample lost at each of these blocks."""
    return torch.stack([(torch.arange(BLOCKS) >= place).double() for place in places]).sum(0)


def test_nothing_lost_is_seldom_doubted():
    g, n_runs, nothing = torch.Generator().manual_seed(1), 150, torch.zeros(BLOCKS)
    amplitudes = (10 ** (0.8 * k / n_runs - 1) for k in range(n_runs))
    values = [
        p_value_from_e_value(float(paths_of(tones(g, a, nothing)[None], TOGETHER, ANGLE).log_ratio)) for a in amplitudes
    ]
    hits = sum(p < 0.05 for p in values)
    assert stats.binom.sf(hits - 1, n_runs, 0.05) > 1e-3, f"{hits} of {n_runs}"


def test_losses_whose_places_nobody_could_tell_are_seen_together():
    # Each alone is worth less than the search for its place.
    g, n_runs, found, held = torch.Generator().manual_seed(2), 20, 0, 0
    lost = steps(120, 200, 330, 400)
    line = torch.polar(torch.ones(BLOCKS, dtype=torch.float64), ANGLE * lost)
    amplitude = math.sqrt(25 / 2 / float((line - line.mean()).abs().square().sum()))
    for _ in range(n_runs):
        paths = paths_of(tones(g, amplitude, lost)[None], TOGETHER, ANGLE)
        found += p_value_from_e_value(float(paths.log_ratio)) < 1e-3
        low, high = paths.limits(0)
        held += low <= 4 <= high
    assert found >= stats.binom.ppf(1e-3, n_runs, 0.9)
    assert held >= stats.binom.ppf(1e-3, n_runs, 0.95)


def test_a_loud_tone_tells_place_and_count_of_each_loss():
    z = tones(torch.Generator().manual_seed(3), 3.0, steps(100, 301, 301))
    paths = paths_of(z[None], TOGETHER, ANGLE)
    assert paths.limits(0) == (3, 3)
    losses, gain = losses_of(z, paths.lost[0], ANGLE)
    assert [(loss.at, loss.count) for loss in losses] == [(100, 1), (301, 2)]
    assert all(loss.at_limits[0] <= loss.at <= loss.at_limits[1] for loss in losses)
    assert gain > 100


def test_what_is_lost_near_the_end_is_told_by_limits():
    # A tone of a few nats says nothing of the last blocks: more may have been lost there.
    z = tones(torch.Generator().manual_seed(4), 0.2, steps(250))
    low, high = paths_of(z[None], TOGETHER, ANGLE).limits(0)
    assert low <= 1 < high
