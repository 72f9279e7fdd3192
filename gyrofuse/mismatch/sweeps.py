"""A line whose frequency moves steadily, as that of a machine that runs up: in no bin for long, a line all the same.

Records, whitened and without what sensors have in common over broad bands, are cut into segments, in each of which a
rate of change is undone before the transform: what is left is normal, with power one, in segments and bins. Powers are
added up along all straight tracks, by a tree that shares the sums of shorter ones (Taylor, 1974). Where the sum over
the sensors is largest, sums of sensors with either sign are asked for, whose power is Gamma distributed on every track.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence, corrected
from gyrofuse.mismatch.impulses import ENDS, left_out
from gyrofuse.mismatch.lines import sets_of
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.shape_law import decorrelated
from gyrofuse.mismatch.side import Side
from gyrofuse.mismatch.witnesses import level_of

_SEGMENT = 16  # roots of the record's length
_EVERY = 4  # bins that a frequency moves within a segment, from one rate that is undone to the next
_CUT = 8.0  # power of a sensor: a steady line that is crossed is no track
_CANDIDATES = 16  # of each rate, that are looked at closely
_NOTABLE = 0.05  # p value
_SIGNED = 7  # sensors up to which every sign is tried


class Sweep(NamedTuple):
    """The most conspicuous track.

    Attributes:
        p_value: For having looked at all.
        first, last: Frequencies at the record's ends, cycles per sample; beyond a half they are folded back.
        sensors: In which it was seen.
        nats: By which the power of most segments is above what noise has on a track.
    """

    p_value: float
    first: float
    last: float
    sensors: tuple[int, ...]
    nats: float


def sweep_witness(case: Case) -> Evidence:
    """A line whose frequency moves, that the simulation does not have."""
    found, p_value = _strongest(case.recorded), _p_value(case)
    first, last = (f * case.scene.rate for f in (found.first, found.last))
    return Evidence(
        "sweep",
        p_value,
        f"a line that moves from {first:.4g} Hz to {last:.4g} Hz in {case.scene.named(found.sensors, 'all sensors')}",
        sensors=found.sensors,
        levels=tuple(sorted({level_of(max(f, 1 / case.n_samples)) for f in (found.first, found.last)})),
    )


def swept(case: Case, nats: float, level: float) -> bool:
    """Whether a line whose frequency moves is seen, and tells more than so many nats of the spectrum.

    What it sweeps over has more power, as if noise had been added there or filtered away elsewhere.
    """
    return _p_value(case) <= level and _strongest(case.recorded).nats > nats


def _p_value(case: Case) -> float:
    p_value = _strongest(case.recorded).p_value
    # Lines that both have leave traces here of any size: what the simulation may show is nothing to surpass.
    seen_in_both = p_value < _NOTABLE and _strongest(case.simulated).p_value < _NOTABLE
    return 1.0 if seen_in_both else p_value


@remembered
def _strongest(side: Side) -> Sweep:
    """In the first record."""
    return strongest_sweep(_decorrelated(side))


def _decorrelated(side: Side) -> Tensor:
    """Whitened record `(sensor, time)` without the coherence of broad bands."""
    white = left_out(side).white[0]
    n = white.shape[-1]
    transform = torch.fft.rfft(white)
    edges = [0, *(round(e * n / side.bands.n_samples) for e in side.bands.edges[1:-1]), transform.shape[-1]]
    transform = decorrelated(transform, edges, side.dof)
    white = torch.fft.irfft(transform, n=n)
    white = white / white.square().mean(-1, keepdim=True).sqrt()
    # Beside lines the ends are mirrored from what is next to them: seen twice, chance would look like more.
    end = n // ENDS
    white[:, :end], white[:, -end:] = 0.0, 0.0
    return white


def strongest_sweep(white: Tensor) -> Sweep:
    """Of independent whitened samples `(sensor, time)`."""
    p, n = white.shape
    length = 2 ** round(math.log2(_SEGMENT * math.sqrt(n)))
    count = 2 ** int(math.log2(n // length))
    segments = white[:, : count * length].view(p, count, length).to(torch.float32)
    moves = length // (2 * count)  # bins from segment to segment, for half a cycle per sample over the record
    centred = ((torch.arange(length) - (length - 1) / 2) / length).square()
    signs = _signs(p)
    sizes = signs.abs().sum(-1)
    best, first, rate, sensors, nats = 0.0, 0.0, 0.0, tuple(range(p)), 0.0
    for undone in range(_EVERY // 2, moves + _EVERY // 2, _EVERY):
        turn = torch.polar(torch.full((length,), length**-0.5), -math.pi * undone * centred)
        bins = torch.fft.fft(segments * turn)  # (sensor, segment, bin)
        powers = bins.abs().square().clamp(max=_CUT)
        for move in range(max(undone - _EVERY // 2, 1), min(undone + _EVERY // 2, moves)):
            sums = _tracks(powers.sum(0), move)
            at = sums.flatten().topk(_CANDIDATES).indices
            every = _followed(bins, move, at // length, at % length)  # (sensor, candidate, segment)
            tracks = every * (every.abs().clamp(max=math.sqrt(_CUT)) / every.abs().clamp(min=1e-20))
            power = (signs @ tracks.flatten(1)).abs().square().view(len(signs), *tracks.shape[1:]).sum(-1)
            which, place = divmod(int((power / sizes[:, None]).argmax()), len(at))
            highest = float(power[which, place] / sizes[which])
            if highest > best:
                best, first = highest, int(at[place]) % length / length
                rate = (move + int(at[place]) // length / max(count - 1, 1)) / length
                sensors = tuple(signs[which].abs().nonzero()[:, 0].tolist())
                whole = (signs[which] @ every[:, place]).abs().square() / sizes[which]
                nats = count * (float(whole.median()) / math.log(2) - 1)
    tail = float(torch.special.gammaincc(*torch.tensor([count, best], dtype=torch.float64)))
    places = float((moves - 1) * count * length * len(signs))
    start, stop = (abs(math.remainder(f, 1.0)) for f in (first - rate / 2, first + (count - 0.5) * rate))
    return Sweep(corrected(tail, places), start, stop, sensors, nats)


def _signs(p: int) -> Tensor:
    """Combinations of `p` sensors, each left out, or of either sign against the first one that takes part."""
    if p > _SIGNED:
        return sets_of(p)[0].to(torch.complex64)
    every = torch.tensor(list(itertools.product((0.0, 1.0, -1.0), repeat=p)))
    first = every.gather(-1, (every != 0).to(torch.int64).argmax(-1, keepdim=True))[:, 0]
    return every[first > 0].to(torch.complex64)


def _followed(bins: Tensor, move: int, more: Tensor, start: Tensor) -> Tensor:
    """Values along tracks, `(sensor, candidate, segment)`."""
    count, length = bins.shape[1:]
    segment = torch.arange(count)
    at = (start[:, None] + move * segment + _drift(more, count)) % length  # (candidate, segment)
    return bins[:, segment, at]


def _drift(more: Tensor, count: int) -> Tensor:
    """Bins by which tracks that move by `more` in the end have moved in each segment, as the tree has it."""
    drift = torch.zeros(len(more), 1, dtype=torch.int64)
    shifts, size = [more], 1
    while 2 * size <= count:
        shifts.append(shifts[-1] // 2)
        size *= 2
    for d in shifts[-2::-1] if count > 1 else []:
        drift = torch.cat([drift, drift + ((d + 1) // 2)[:, None]], -1)
    return drift


def _tracks(powers: Tensor, move: int) -> Tensor:
    """Sums along tracks that begin at each bin and move by `move` bins a segment, and some more, `(more, bin)`.

    Args:
        powers: `(segment, bin)`, as many segments as a power of two.
        move: At least; by the record's end a track has moved up to as many bins more as there are segments, less one.
    """
    count, length = powers.shape
    bins = torch.arange(length)
    at = (bins + move * torch.arange(count)[:, None]) % length
    sums = powers.gather(-1, at)[:, None]  # (group, shift, bin)
    while len(sums) > 1:
        early, late = sums[::2], sums[1::2]
        shifts = [early[:, d // 2] + late[:, d // 2].roll(-((d + 1) // 2), -1) for d in range(2 * sums.shape[1])]
        sums = torch.stack(shifts, 1)
    return sums[0]
