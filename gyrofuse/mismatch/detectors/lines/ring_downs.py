"""Test of ring-downs: a tone that sets in at once and dies away, as a structure rings after a knock.

Whitened records of a steady level are seen through windows that begin at once and decay as `exp(-t / tau)`, for `tau`
from 8 samples on in octaves. Powers `v` of cells of time and frequency are over the median of all times of their
frequency, so that a line or a resonance that is there all the time does not count; of noise they are exponential. A
ring-down whose power is `a` times that of the noise has the likelihood ratio

    exp(a / (1 + a) v) / (1 + a)

in each sensor. The mean over cells, sizes and sensors that have it exceeds `x` with probability `1/x` at most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.decisions import CHANCE
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.known_lines import without_lines
from gyrofuse.mismatch.signals.lines import simulated_lines, whitened
from gyrofuse.mismatch.stats.level_scan import local_level
from gyrofuse.mismatch.stats.multiplicity import e_value_of_some, p_value_beyond_reference

_SHORTEST = 8  # samples of a time constant: shorter ones are spikes
_LONGEST_SHARE = 96  # of a record, a time constant at most: medians over time take a hundred windows
_REACH = 4  # time constants of a window
_CLIP = 4.5  # standard deviations: no spike rings
_PER_TAU = 2  # windows for a time constant
_MOST_FRAMES = 512  # that tell the median of a frequency
_AT_ONCE = 2**22  # numbers of windows at a time, to bound memory
_SIZES = (6.0, 24.0, 96.0)  # power of a ring-down over that of the noise in a cell
_WORTH = 6.0  # nats of some sensor from which a cell is looked at
_LOWEST = _REACH  # cycles in a window, one for a time constant: slower ones are steps and drifts


class RingCell(NamedTuple):
    """A cell of time and frequency that stands out.

    Attributes:
        onset: Sample.
        frequency: Cycles per sample.
        tau: Samples.
        log_ratio: Logarithm of its likelihood ratio.
        score: `v` of each sensor, `(sensor,)`.
    """

    onset: int
    frequency: float
    tau: int
    log_ratio: float
    score: Tensor


class RingScan(NamedTuple):
    """The mean likelihood ratio of all cells, and those that stand out, the likeliest first.

    Attributes:
        log_ratio: Logarithm of the mean.
        n_cells: How many were searched.
        cells: The likeliest of each stretch of time.
    """

    log_ratio: float
    n_cells: int
    cells: tuple[RingCell, ...]

    @property
    def p_value(self) -> float:
        """Ville's bound: medians of frequencies are known to some tenths, and spend what it has to spare."""
        return math.exp(min(-self.log_ratio, 0.0))


def ring_down_test(comparison: Comparison) -> TestResult:
    """A tone that sets in at once and dies away, and that the simulation does not have."""
    found, info = ring_downs(comparison), comparison.info
    if not found.cells:
        return TestResult("ring", 1.0, "nothing rings")
    cell = found.cells[0]
    sensors = tuple((cell.score > max(_WORTH, float(cell.score.max()) / 4)).nonzero()[:, 0].tolist())
    f = cell.frequency * info.rate
    return TestResult(
        "ring",
        ring_down_p_value(comparison),
        f"a tone at {f:.4g} Hz sets in at {cell.onset / info.rate:.5g} s and dies away, in "
        f"{info.named(sensors, 'all sensors')}",
        sensors=sensors,
        levels=(level_of(cell.frequency),),
        frequency_hz=f,
        time_s=cell.onset / info.rate,
    )


@derived
def ring_downs(comparison: Comparison) -> RingScan:
    """Ring-downs of the recording."""
    return scanned_ring_downs(comparison.lineless)


def ring_down_p_value(comparison: Comparison) -> float:
    """p value of the recording's, beyond what the simulation has itself."""
    own = ring_downs(comparison).p_value
    return own if own > CHANCE else p_value_beyond_reference(own, _simulated(comparison).p_value)


@derived
def _simulated(comparison: Comparison) -> RingScan:
    bare = without_lines(comparison.reference.signal, simulated_lines(comparison.reference))
    return scanned_ring_downs(whitened(comparison.reference.steadied(bare), comparison.base)[0])


def scanned_ring_downs(white: Tensor) -> RingScan:
    """All ring-downs of whitened samples `(sensor, time)`."""
    white = (white / local_level(white).sqrt()).clamp(-_CLIP, _CLIP)
    white = white.to(torch.float32)  # enough to find a place; numbers are fitted to the samples as they are
    n, total, n_cells, found = white.shape[-1], -math.inf, 0, list[RingCell]()
    tau = _SHORTEST
    while tau * _LONGEST_SHARE <= n:
        for first, scores in _scores(white, tau):  # (sensor, frame, bin)
            n_cells += scores[0].numel()
            frame, place = (scores.amax(0) > _WORTH).nonzero(as_tuple=True)
            if not len(frame):
                continue
            own = scores[:, frame, place].to(torch.float64)
            log_ratios = _log_ratios(own)
            total = float(torch.logaddexp(log_ratios.logsumexp(0), torch.tensor(total, dtype=torch.float64)))
            found += _likeliest(log_ratios, own, first + frame * tau // _PER_TAU, _LOWEST + place, tau)
        tau *= 2
    found.sort(key=lambda cell: -cell.log_ratio)
    return RingScan(total - math.log(max(n_cells, 1)), n_cells, tuple(_apart(found)))


def _scores(white: Tensor, tau: int) -> Iterator[tuple[int, Tensor]]:
    """First sample and powers `v` of windows `(sensor, frame, bin)`, some at a time, from the lowest bin on."""
    length, hop = _REACH * tau, tau // _PER_TAU
    taper = torch.exp(-torch.arange(length, dtype=white.dtype) / tau)
    taper /= taper.square().sum().sqrt()
    frames = white.unfold(-1, length, hop)  # (sensor, frame, time)

    def power(part: Tensor) -> Tensor:
        return squared_modulus(torch.fft.rfft(part * taper))[..., _LOWEST:-1].clamp(min=1e-30)

    step = -(-frames.shape[1] // _MOST_FRAMES)
    usual = power(frames[:, ::step]).median(1, keepdim=True).values / math.log(2)  # (sensor, 1, bin)
    at_once = max(_AT_ONCE // (length * len(white)), 1)
    for a in range(0, frames.shape[1], at_once):
        yield a * hop, power(frames[:, a : a + at_once]) / usual


def _log_ratios(score: Tensor) -> Tensor:
    """Of cells `(cell,)`, from the scores of their sensors `(sensor, cell)`."""
    each = torch.stack([e_value_of_some(a / (1 + a) * score - math.log1p(a)) for a in _SIZES])
    return each.logsumexp(0) - math.log(len(_SIZES))


def _likeliest(log_ratios: Tensor, score: Tensor, onset: Tensor, place: Tensor, tau: int) -> Iterator[RingCell]:
    """The best of the cells of one decay, windows apart."""
    most = 64  # of one decay
    for k in log_ratios.argsort(descending=True).tolist()[:most]:
        frequency = float(place[k]) / (_REACH * tau)
        yield RingCell(int(onset[k]), frequency, tau, float(log_ratios[k]), score[:, k])


def _apart(cells: list[RingCell]) -> Iterator[RingCell]:
    """Those that no likelier one comes near to, in time and frequency."""
    kept: list[RingCell] = []
    for cell in cells:
        if not any(_near(cell, other) for other in kept):
            kept.append(cell)
            yield cell


def _near(cell: RingCell, other: RingCell) -> bool:
    tau = max(cell.tau, other.tau)
    return abs(cell.onset - other.onset) < _REACH * tau and abs(cell.frequency - other.frequency) < 2 / min(
        cell.tau, other.tau
    )
