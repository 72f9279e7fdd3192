"""Bumps of a spectrum wider than a line and narrower than an octave."""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import torch
from scipy import stats
from scipy.signal import windows
from torch import Tensor

from gyrofuse._base.transforms import fast_length, squared_modulus
from gyrofuse.mismatch.bump_scan import flank_of, least_flank, log_ratios, scanned_bumps
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence, corrected, ratio_p_value
from gyrofuse.mismatch.hump_scan import scanned_humps
from gyrofuse.mismatch.known_lines import without_lines
from gyrofuse.mismatch.lines import simulated_lines, whitened
from gyrofuse.mismatch.modulated_ordinates import level_correlations
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.shape_law import decorrelated
from gyrofuse.mismatch.witnesses import level_of

_ENDS = 0.1  # of the record, under the taper: lines leak as far as twenty bins
_DEPENDENT = 1.15  # bins under it for an independent one, as far tails have it
_TRIES = 6
_MOST = 3.4  # medians of a modulus: one bin in three thousand is above
_LINE = 0.6  # of the excess in three bins
_AS_WELL = 0.01  # p value at which the simulation has it as well


class Stretch(NamedTuple):
    """Bins that stand out.

    Attributes:
        frequency: Of their middle, cycles per sample.
        width: Cycles per sample.
        p_value: For all stretches, sensor by sensor and together.
        sensors: In which it alone stands out.
    """

    frequency: float
    width: float
    p_value: float
    sensors: tuple[int, ...]


def bump_witness(case: Case) -> Evidence:
    """The strongest bump that the simulation does not have."""
    found = strongest_bump(case)
    f = found.frequency * case.scene.rate
    names = ", ".join(case.scene.sensors[i] for i in found.sensors)
    return Evidence(
        "bump",
        found.p_value,
        f"a bump {found.width * case.scene.rate:.3g} Hz wide at {f:.5g} Hz in sensors {names}",
        sensors=found.sensors,
        levels=(level_of(found.frequency),),
        frequency_hz=f,
    )


@remembered
def strongest_bump(case: Case) -> Stretch:
    """The most conspicuous bump of the recording that is neither a line nor in the simulation."""
    transform, length = _transformed(case.lineless)
    last = int((0.5 - 2 / case.n_samples) * length)
    transform = transform[:, :last]
    worth = case.n_samples / length / _DEPENDENT
    levels, width = level_correlations(case.lineless), case.n_samples / length
    scans = list(scanned_humps(squared_modulus(_apart(transform, length, case)), worth, levels, width))
    if case.n_sensors > 1:
        scans += scanned_bumps(transform, worth, levels, width)
    power, nothing = squared_modulus(transform), Stretch(0.25, 0.5, 1.0, tuple(range(case.n_sensors)))
    simulated: tuple[Tensor, int] | None = None
    for _ in range(_TRIES if scans else 0):
        best = max(scans, key=lambda scan: float(scan.log_ratio.amax()))
        a, n = int(best.first[best.log_ratio.argmax()]), best.width
        if not bool(best.log_ratio.isfinite().any()):
            return nothing
        means = [torch.logsumexp(scan.log_ratio, 0) - math.log(len(scan.first)) for scan in scans]
        p_value = ratio_p_value(float(torch.logsumexp(torch.stack(means), 0)) - math.log(len(scans)))
        sensors = _alone(power, a, n, n * worth)
        stretch = Stretch((a + (n - 1) / 2) / length, n / length, p_value, sensors)
        if p_value > _AS_WELL:
            return stretch
        excess = (power[:, a : a + n].mean(0) - _flanks(power, a, n).mean()).clamp(min=0)
        line = float(excess.topk(3).values.sum()) > _LINE * float(excess.sum())
        if simulated is None:
            bare = without_lines(case.simulated.signal, simulated_lines(case.simulated))
            simulated = _transformed(whitened(case.simulated.steadied(bare), case.base))
        if not line and not _has_it(simulated, stretch, case):
            return stretch
        for scan in scans:
            over = (scan.first < a + 2 * n) & (scan.first + scan.width > a - n)
            scan.log_ratio[over] = -math.inf
    return nothing


@functools.lru_cache(maxsize=8)
def light_taper(n: int) -> Tensor:
    """For whitened samples `(n,)`, of squares that sum to one: one that holds back what is red costs half of them."""
    taper = torch.from_numpy(windows.tukey(n, _ENDS))
    return taper / taper.square().sum().sqrt()


def _transformed(white: Tensor) -> tuple[Tensor, int]:
    """Transform of whitened samples, `(..., sensor, bin)`, and the length padded to."""
    n = white.shape[-1]
    length = fast_length(n)
    return torch.fft.rfft(white * light_taper(n), n=length), length


def _apart(transform: Tensor, length: int, case: Case) -> Tensor:
    """Without what sensors `(sensor, bin)` share over broad bands of both.

    Bins are cut to a few times the power around: lines are nothing that bands share.
    """
    scale = length / case.n_samples
    edges = [0, *(round(e * scale) for e in case.bands.edges[1:-1]), transform.shape[-1]]
    parts = [transform[:, a:b] for a, b in itertools.pairwise(edges)]
    limits = [_MOST * part.abs().median(-1, keepdim=True).values for part in parts]
    cut = [part * (limit / part.abs()).clamp(max=1) for part, limit in zip(parts, limits, strict=True)]
    return decorrelated(torch.cat(cut, -1), edges, case.recorded.dof)


def _flanks(power: Tensor, a: int, n: int) -> Tensor:
    """Mean of both flanks, `(sensor,)`, as far as they reach."""
    gap, wide = n // 2, flank_of(n, power.shape[-1])
    left, right = power[:, max(a - gap - wide, 0) : a - gap], power[:, a + n + gap : a + n + gap + wide]
    return torch.cat([left, right], -1).mean(-1)


def band_of(place: Tensor, length: int, case: Case) -> Tensor:
    edges = torch.tensor(case.bands.edges[1:-1], dtype=torch.float64) / case.n_samples
    return torch.bucketize(place.to(torch.float64) / length, edges, right=True)


def _alone(power: Tensor, a: int, n: int, d: float) -> tuple[int, ...]:
    """Sensors in which so many bins, worth `d` ordinates, stand out alone."""
    tails = stats.f.sf((power[:, a : a + n].mean(-1) / _flanks(power, a, n)).numpy(), 2 * d, 6 * d)
    p = len(power)
    return tuple(i for i in range(p) if corrected(float(tails[i]), p) < 0.01) or (int(tails.argmin()),)


def _has_it(simulated: tuple[Tensor, int], stretch: Stretch, case: Case) -> bool:
    """Whether the simulation has a bump at the same place."""
    transform, length = simulated
    n = max(round(stretch.width * length) // 2, 2) * 2
    a, gap = round(stretch.frequency * length - (n - 1) / 2), n // 2
    wide = min(flank_of(n, transform.shape[-1]), a - gap, transform.shape[-1] - a - n - gap)
    if wide < least_flank(n):
        return False
    bins = transform.movedim(1, 0)  # (sensor, record, bin)
    inside, left, right = (
        bins[..., b : b + wide_as].flatten(1) for b, wide_as in ((a, n), (a - gap - wide, wide), (a + n + gap, wide))
    )
    flanks = torch.cat([left, right], -1)
    worth = case.simulated.signal.shape[-1] / length / _DEPENDENT
    m, f = max(inside.shape[-1] * worth, 1.0), flanks.shape[-1] * worth
    log_ratio = log_ratios((inside @ inside.mH)[None], (flanks @ flanks.mH)[None], m, f)
    return ratio_p_value(float(log_ratio)) < _AS_WELL
