"""Test of ring-downs: a tone that sets in at once and dies away, as a structure rings after a knock.

Whitened records of a steady level are seen through windows that begin at once and decay as `exp(-t / tau)`, for `tau`
from 8 samples on in octaves. Powers `v` of cells of time and frequency are over the median of all times of their
frequency, so that a line or a resonance that is there all the time does not count, and over the median of their octave
at about that time, so that slow noise does not where fast noise is quieter; of noise they are exponential. A ring-down
whose power is `a` times that of the noise has the likelihood ratio

    exp(a / (1 + a) v) / (1 + a)

in each sensor. The mean over cells, sizes and sensors that have it exceeds `x` with probability `1/x` at most. Where
noise is heavy-tailed or wanders it does more often: the simulation's own strongest cells tell how much.

A line that wanders or comes and goes is as strong in the record run backwards; of a ring-down about half is left there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.decisions import CHANCE, NATS_AS_GOOD
from gyrofuse.mismatch.detectors.lines.ring_cells import (
    RingCell,
    RingScan,
    apart,
    in_another_order,
    irreversible,
    p_value_beside,
)
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.stats.level_scan import local_level, octave_level, octaves
from gyrofuse.mismatch.stats.multiplicity import e_value_of_some


def ring_down_test(comparison: Comparison) -> TestResult:
    """A tone that sets in at once and dies away, and that the simulation does not have."""
    found, info = ring_downs(comparison), comparison.info
    if not found.cells:
        return TestResult("ring", 1.0, "nothing rings")
    cell = found.cells[0]
    sensors, f = cell.sensors, cell.frequency * info.rate
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
    return scanned_ring_downs(comparison.lineless, comparison.steady_share)


def ring_down_p_value(comparison: Comparison) -> float:
    """p value of the recording's, by Ville's bound and beside the strongest cells of the simulation."""
    own = ring_downs(comparison)
    if own.p_value > CHANCE:
        return own.p_value
    return p_value_beside(own, _simulated(comparison), disordered(comparison))


@derived
def disordered(comparison: Comparison) -> RingScan:
    """The same of the recording's samples in another order, of which none lasts."""
    return scanned_ring_downs(in_another_order(comparison.lineless), comparison.steady_share)


@derived
def _simulated(comparison: Comparison) -> RingScan:
    return scanned_ring_downs(comparison.lineless_reference[0], comparison.steady_share)


def scanned_ring_downs(white: Tensor, steady: Callable[[Tensor], Tensor] = torch.ones_like) -> RingScan:
    """All ring-downs of whitened samples `(sensor, time)`, without what is as strong in them run backwards.

    Args:
        white: The samples.
        steady: Share of the ordinates at frequencies, cycles per sample, that powers are known from: where it is below
            a half the simulation's own lines wander, which is no ring.
    """
    clip, n = 4.5, white.shape[-1]  # standard deviations: no spike rings
    level = (white / local_level(white).sqrt()).clamp(-clip, clip)
    found = _scanned(level, steady)
    if found.p_value > CHANCE:
        return found
    kept = irreversible(found, _scanned(level.flip(-1), steady), n)
    if kept.p_value <= CHANCE:
        return kept
    # A loud one is a level of its own, over which it does not die away.
    loud = tuple(cell for cell in found.cells if _dies_away(white, cell))
    if not loud:
        return kept
    total = torch.tensor([cell.log_ratio for cell in loud], dtype=torch.float64).logsumexp(0)
    return RingScan(float(total) - math.log(found.n_cells), found.n_cells, loud)


def _dies_away(white: Tensor, cell: RingCell) -> bool:
    """Whether a cell is loud in whitened samples `(sensor, time)`, and rises much faster than it falls."""
    least, share, reach = 5.0, 0.25, 2 * cell.tau  # sd of its amplitude; of the energy that may come first; samples
    first, end = max(cell.onset - 4 * cell.tau, 0), min(cell.onset + cell.length + 4 * cell.tau, white.shape[-1])
    t = torch.arange(end - first, dtype=torch.float64)
    turned = white[int(cell.score.argmax()), first:end] * torch.polar(
        torch.ones_like(t), -2 * math.pi * cell.frequency * t
    )
    width = max(round(1 / cell.frequency), cell.tau // 8) // 2 * 2 + 1
    both = torch.nn.functional.avg_pool1d(torch.view_as_real(turned).mT, width, 1, width // 2)
    power = both.square().sum(0)
    peak = int(power.argmax())
    before, after = power[max(peak - reach, 0) : peak].sum(), power[peak : peak + reach].sum()
    return 2 * math.sqrt(float(power[peak])) > least and float(before) < share * float(after)


def _scanned(white: Tensor, steady: Callable[[Tensor], Tensor]) -> RingScan:
    white = white.to(torch.float32)  # enough to find a place; numbers are fitted to the samples as they are
    n, total, n_cells, found = white.shape[-1], -math.inf, 0, list[RingCell]()
    tau, windows = 8, 96  # a shorter one is a spike; medians over time take a hundred windows
    while tau * windows <= n:
        for part in _powers(white, tau):
            n_cells += part.power[0].numel()
            f = (part.lowest + torch.arange(part.power.shape[-1], dtype=torch.float64)) / part.length
            frame, place = ((part.power.amax(0) > NATS_AS_GOOD) & (steady(f) > 0.5)).nonzero(as_tuple=True)
            if not len(frame):
                continue
            own = part.power[:, frame, place].to(torch.float64)
            log_ratios = _log_ratios(own)
            total = float(torch.logaddexp(log_ratios.logsumexp(0), torch.tensor(total, dtype=torch.float64)))
            found += part.likeliest(log_ratios, own, frame, place)
        tau *= 2
    found.sort(key=lambda cell: -cell.log_ratio)
    return RingScan(total - math.log(max(n_cells, 1)), n_cells, tuple(apart(found)))


class _Part(NamedTuple):
    """Some windows of one decay.

    Attributes:
        power: Over the median of the frequency, `(sensor, frame, bin)`.
        first, hop: Sample at which the first begins, and samples from one to the next.
        lowest: First bin.
        tau, length: Time constant and length of a window, samples.
    """

    power: Tensor
    first: int
    hop: int
    lowest: int
    tau: int
    length: int

    def likeliest(self, log_ratios: Tensor, score: Tensor, frame: Tensor, place: Tensor) -> Iterator[RingCell]:
        """The best of cells `(cell,)`, some dozens of each octave: a line that lasts has as many itself."""
        most = 16
        best = log_ratios.argsort(descending=True)
        for octave in octaves(0, self.power.shape[-1]):
            there = (place[best] >= octave.start) & (place[best] < octave.stop)
            for k in best[there][:most].tolist():
                onset, frequency = self.first + int(frame[k]) * self.hop, float(self.lowest + place[k]) / self.length
                yield RingCell(onset, frequency, self.tau, self.length, float(log_ratios[k]), score[:, k])


def _powers(white: Tensor, tau: int) -> Iterator[_Part]:
    """Windows `exp(-t / tau)` over whitened samples, two for a time constant, some at a time to bound memory."""
    reach, most_for_median, numbers_at_once, leaks, local = 4, 512, 4_000_000, 1.6, 48
    length, hop = reach * tau, tau // 2
    lowest = reach  # a cycle for a time constant: what is slower is a step or a drift
    taper = torch.exp(-torch.arange(length, dtype=white.dtype) / tau)
    taper /= taper.square().sum().sqrt()
    late = 2  # frames: what the start of a record lets in has died away by then, as a tone from then on has not
    frames = white.unfold(-1, length, hop)[:, late:]  # (sensor, frame, time)
    some = frames[:, :: -(-frames.shape[1] // most_for_median)]

    def transform(part: Tensor, taper: Tensor) -> Tensor:
        return torch.fft.rfft(part * taper)[..., lowest:-1]

    apart = _decorrelating(transform(some, taper))

    def power(part: Tensor, taper: Tensor) -> Tensor:
        return squared_modulus(_apart_by(apart, transform(part, taper))).clamp(min=1e-30)

    def middle(taper: Tensor) -> Tensor:
        """Median over time, in units of the mean of exponential values, `(sensor, 1, bin)`."""
        return power(some, taper).median(1, keepdim=True).values / math.log(2)

    smooth = torch.hann_window(length, dtype=white.dtype)
    own = middle(smooth / smooth.norm())
    # A window that begins at once leaks: where a filter holds nearly all back its first sample is all the power.
    usual = torch.where((usual := middle(taper)) < leaks * own, usual, torch.nan)
    at_once, first = max(numbers_at_once // (length * len(white)), local), late * hop
    for part in frames.tensor_split(max(frames.shape[1] // at_once, 1), 1):
        over = power(part, taper) / usual
        for stretch in over.tensor_split(max(over.shape[1] // local, 1), 1):
            stretch /= octave_level(stretch, 0).clamp(min=1.0)  # a lower one may be chance
        yield _Part(over.nan_to_num_(0.0), first, hop, lowest, tau, length)
        first += hop * part.shape[1]


def _decorrelating(transform: Tensor) -> list[tuple[slice, Tensor]]:
    """What takes off what sensors `(sensor, frame, bin)` share, octave by octave; each stays as near as it can.

    Moduli are cut to 3.4 medians of their bin, one in three thousand of noise: what rings is nothing that they share.
    """
    if len(transform) == 1:
        return []
    size = transform.abs()
    usual = size.median(1, keepdim=True).values.clamp(min=1e-15)
    cut = transform / usual * (3.4 * usual / size.clamp(min=1e-15)).clamp(max=1.0)
    found = []
    for octave in octaves(0, transform.shape[-1]):
        cells = cut[..., octave].flatten(1)
        shared = cells @ cells.mH
        norm = shared.diagonal().real.clamp(min=1e-15).rsqrt()
        values, vectors = torch.linalg.eigh(shared * norm[:, None] * norm)
        root = (vectors * values.clamp(min=1e-2).rsqrt()) @ vectors.mH  # in float32 a hundredth is known
        scale = usual[:, 0, octave].mean(-1)
        found.append((octave, root * scale[:, None] / scale))
    return found


def _apart_by(roots: list[tuple[slice, Tensor]], transform: Tensor) -> Tensor:
    """A transform `(sensor, frame, bin)` without what sensors share."""
    if not roots:
        return transform
    parts = [torch.einsum("ij,jtf->itf", root, transform[..., octave]) for octave, root in roots]
    return torch.cat(parts, -1)


def _log_ratios(score: Tensor) -> Tensor:
    """Of cells `(cell,)`, from the scores of their sensors `(sensor, cell)`."""
    sizes = (6.0, 24.0, 96.0)  # power of a ring-down over that of the noise
    each = torch.stack([e_value_of_some(a / (1 + a) * score - math.log1p(a)) for a in sizes])
    return each.logsumexp(0) - math.log(len(sizes))
