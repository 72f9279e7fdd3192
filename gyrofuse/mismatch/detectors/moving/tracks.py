"""Search for the least probable straight track through time and frequency.

Whitened records are cut into segments, in each of which a rate of change is undone before the transform: what is left
is normal, with power one, in segments and bins, fine ones so that no line is lost between two. Powers are added up
along all straight tracks, by a tree that shares the sums of shorter ones (Taylor, 1974). Where the sum over the
sensors is large, sums of sensors with either sign are asked for, whose power is Gamma distributed on every track, and
the tracks that have most of it are fitted.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.detectors.moving.track_fit import AROUND, Candidates, fitted_track
from gyrofuse.mismatch.signals.lines import sets_of
from gyrofuse.mismatch.stats.multiplicity import sidak

# Bins that a frequency moves within a segment, from one rate that is undone to the next: 7 % of power are lost, on
# average.
_EVERY = 4
_FINER = 2  # fine bins in a bin
_CUT = 8.0  # power of a sensor: a steady line that is crossed is no track


class Sweep(NamedTuple):
    """The least probable track.

    Attributes:
        p_value: Corrected for the tracks of the search.
        first, last: Frequencies at the record's ends, cycles per sample; beyond a half they are folded back.
        turns: Where they are folded in between: a half, or zero.
        sensors: Positions of the sensors that have it.
        nats: By which the power of most segments is above what noise has on a track.
    """

    p_value: float
    first: float
    last: float
    sensors: tuple[int, ...]
    nats: float
    turns: tuple[float, ...] = ()


def strongest_sweep(white: Tensor) -> Sweep:
    """Of independent whitened samples `(sensor, time)`."""
    p, n = white.shape
    length = 2 ** round(math.log2(16 * math.sqrt(n)))  # a chirp of half the rate moves 128 bins in a segment
    count = 2 ** int(math.log2(n // length))
    moves = length // (2 * count)  # bins from segment to segment, for half a cycle per sample over the record
    signs = _signs(p)
    kept = _conspicuous(white[:, : count * length].view(p, count, length).to(torch.float32), moves, signs)
    track = fitted_track(kept, signs, length, _CUT)
    searched = float((moves - 1) * count * length * len(signs))
    begun, seen = track.ends
    ends = begun, begun + (seen - begun) * n / (count * length)  # segments do not fill the record
    first, last = (abs(math.remainder(end, 1.0)) for end in ends)
    sensors = tuple(track.signs.nonzero()[:, 0].tolist())
    nats = count * (float(track.powers.median()) / math.log(2) - 1)
    near = 0.01  # halves of a cycle per sample next to which a frequency has not turned yet
    low, high = (2 * end for end in sorted(ends))  # halves of a cycle per sample
    turns = tuple(0.5 if k % 2 else 0.0 for k in range(math.ceil(low + near), math.floor(high - near) + 1))
    return Sweep(sidak(math.exp(track.log_tail), searched), first, last, sensors, nats, turns)


def _conspicuous(segments: Tensor, moves: int, signs: Tensor) -> Candidates:
    """The tracks with most power, of segments `(sensor, segment, time)`, up to so many bins from one to the next."""
    length = segments.shape[-1]
    turned = segments.new_zeros(*segments.shape[:-1], _FINER * length, dtype=torch.complex64)
    bins = torch.empty_like(turned)  # (sensor, segment, fine bin); kept, as memory costs as much as the transform
    centred = ((torch.arange(length) - (length - 1) / 2) / length).square()
    # Tracks kept for the fit: one in 2^15 of all, since so few of noise have more power than a weak chirp.
    most, least = min(max(moves * segments.shape[1] * length // 2**15, 64), 256), 0.0
    found: list[Candidates] = []
    for undone in range(_EVERY // 2, moves + _EVERY // 2, _EVERY):
        turn = torch.polar(torch.full((length,), length**-0.5), -math.pi * undone * centred)
        torch.mul(segments, turn, out=turned[..., :length])
        torch.fft.fft(turned, out=bins)
        powers = squared_modulus(bins).clamp_(max=_CUT).sum(0)
        each = torch.arange(max(undone - _EVERY // 2, 1) * _FINER, min(undone + _EVERY // 2, moves) * _FINER)
        power, which, along = _most_power(bins, powers, each, signs, most, least)
        found.append(_candidates(power, signs[which], along, bins, undone))
        found = [Candidates(*map(torch.cat, zip(*found, strict=True))).strongest(most)]
        least = float(found[0].power.min()) if len(found[0].power) == most else 0.0
    return found[0]


def _signs(p: int) -> Tensor:
    """Combinations of `p` sensors, each left out, or of either sign against the first one that takes part."""
    if p > 7:  # 1093 combinations
        return sets_of(p)[0].to(torch.float32)
    every = torch.tensor(list(itertools.product((0.0, 1.0, -1.0), repeat=p)))
    first = every.gather(-1, (every != 0).to(torch.int64).argmax(-1, keepdim=True))[:, 0]
    return every[first > 0]


def _most_power(
    bins: Tensor, powers: Tensor, moves: Tensor, signs: Tensor, most: int, least: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Tracks on which all sensors have most power: that of their likeliest combination, which, and their bins.

    Args:
        bins: Transforms, `(sensor, segment, bin)`.
        powers: Of all sensors together, `(segment, bin)`.
        moves: Bins from segment to segment, at least, `(move,)`.
        signs: The combinations, `(combination, sensor)`.
        most: Tracks of each move.
        least: Power that a track has to be above.

    Returns:
        `(track,)`, `(track,)` and `(track, segment)`.
    """
    along = _likely(powers, moves, most)
    count, length = powers.shape
    values = bins[:, torch.arange(count), along % length]  # (sensor, track, segment)
    values = values * (math.sqrt(_CUT) / values.abs().clamp(min=math.sqrt(_CUT)))
    parts = torch.view_as_real(values).movedim(0, 1).flatten(2)  # real and imaginary, of each track
    products = parts @ parts.mT  # of two sensors
    # No combination has more power than the largest eigenvalue, whose square is no more than the norm of the square.
    possible = (products @ products).flatten(1).norm(dim=-1) > least**2
    power = products[possible].flatten(1) @ (signs[:, :, None] * signs[:, None]).flatten(1).mT / signs.abs().sum(-1)
    power, which = power.max(-1)
    above = power > least
    return power[above], which[above], along[possible][above]


def _candidates(power: Tensor, signs: Tensor, along: Tensor, bins: Tensor, undone: int) -> Candidates:
    """Tracks and what is around them.

    Args:
        power: Of the likeliest combination of sensors, `(track,)`.
        signs: That combination, `(track, sensor)`.
        along: Fine bins, `(track, segment)`.
        bins: Transforms, `(sensor, segment, fine bin)`.
        undone: Bins that a frequency moves within a segment, which were undone before.
    """
    along, bins = along // _FINER, bins[..., ::_FINER]
    around = (along[..., None] + torch.arange(-AROUND, AROUND)) % bins.shape[2]
    near = bins[:, torch.arange(bins.shape[1])[:, None], around].movedim(0, 1)
    return Candidates(power, signs, along, torch.full_like(along[:, 0], undone), near)


def _likely(powers: Tensor, moves: Tensor, most: int) -> Tensor:
    """Bins of the strongest tracks of each move from segment to segment, `(track, segment)`.

    Tracks that begin in one bin are neighbours, of which one is enough.
    """
    count, length = powers.shape
    sums = _tracks(powers, moves)
    first = sums.amax(1).topk(min(most, length)).indices  # (move, track)
    more = sums.gather(2, first[:, None].expand(-1, sums.shape[1], -1)).argmax(1)
    along = first[..., None] + moves[:, None, None] * torch.arange(count)
    return along.flatten(0, 1) + _drift(more.flatten(), count)


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


def _tracks(powers: Tensor, moves: Tensor) -> Tensor:
    """Sums along tracks that begin at each bin and move by so many bins a segment, and some more, `(move, more, bin)`.

    Args:
        powers: `(segment, bin)`, as many segments as a power of two.
        moves: At least, `(move,)`; by the record's end a track has moved up to as many bins more as there are segments,
            less one.
    """
    length = powers.shape[-1]
    each = moves.tolist()
    sums = torch.stack([torch.stack([row.roll(-move * k) for move in each]) for k, row in enumerate(powers)])
    sums = sums[:, :, None]  # (group, move, more, bin)
    while len(sums) > 1:
        early, late = sums[::2], sums[1::2]
        sums = powers.new_empty(len(early), len(moves), 2 * early.shape[2], length)
        for d in range(sums.shape[2]):
            first, then, by = early[:, :, d // 2], late[:, :, d // 2], (d + 1) // 2
            torch.add(first[..., : length - by], then[..., by:], out=sums[:, :, d, : length - by])
            torch.add(first[..., length - by :], then[..., :by], out=sums[:, :, d, length - by :])
    return sums[0]
