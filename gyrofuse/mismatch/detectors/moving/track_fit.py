"""A straight track through time and frequency, fitted from the segments that it was found in to the whole record.

The search knows a track to a bin or so at either end, and adds up powers of segments. Here both ends move until the
segments hold most, and then, closer and closer, until longer segments do, in which those add up in phase, up to the
whole record: a line whose frequency moves exactly so stands out far more in that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

AROUND = 16  # bins of a segment on either side of a track, of which its blocks are made


class Candidates(NamedTuple):
    """Tracks as the search has them.

    Attributes:
        power: Of their segments, of sensors added with their signs, `(track,)`.
        signs: Of the sensors, `(track, sensor)`: 0, 1 or -1.
        along: Bins at the centres of their segments, `(track, segment)`, not folded back.
        undone: Bins that a frequency moves within a segment, which were undone before the transform, `(track,)`.
        bins: Transforms around them, `(track, sensor, segment, 2 * AROUND)`, in which noise has power one.
    """

    power: Tensor
    signs: Tensor
    along: Tensor
    undone: Tensor
    bins: Tensor

    def strongest(self, most: int) -> Candidates:
        """So many of them, or all."""
        return self.at(self.power.topk(min(most, len(self.power))).indices)

    def at(self, which: Tensor) -> Candidates:
        """Those."""
        return Candidates(*(of_tracks[which] for of_tracks in self))


class Track(NamedTuple):
    """A fitted track.

    Attributes:
        log_tail: Logarithm of the tail probability of its power on a track given beforehand, times the tracks tried for
            each track of the search.
        ends: Frequencies at the record's ends, cycles per sample, not folded back.
        signs: Of the sensors.
        powers: Of the search's segments, `(segment,)`.
    """

    log_tail: float
    ends: tuple[float, float]
    signs: Tensor
    powers: Tensor


def fitted_track(found: Candidates, combinations: Tensor, length: int, cut: float) -> Track:
    """The least probable of the best straight tracks next to those that the search has found.

    Args:
        found: The search's tracks.
        combinations: Signs of sensors to choose from, `(combination, sensor)`.
        length: Samples of a segment of the search.
        cut: Largest power of a sensor in a segment of the search that counts; more counts as so much.
    """
    tracks, p, count, width = found.bins.shape
    ends = _straight(found.along)  # (track, end)
    blocks = _blocks(found, ends, length)  # (track, sensor, segment, block)
    signs, tails, powers = found.signs.to(blocks.dtype), [], torch.zeros(0)
    for joined in sorted({max(count // 4**k, 1) for k in range(count)}, reverse=True):  # four segments become one
        reach = 8 if joined < count else 6  # steps of a quarter of a bin either way
        moved = torch.arange(-reach, reach + 1, dtype=torch.float64) * (joined / count / 4)
        turns = [torch.polar(torch.ones_like(c), -2 * math.pi * c) for c in _cycles(moved, count, width)]
        added = torch.einsum("cp,cpt->ct", signs, blocks.flatten(2)).view(tracks, joined, -1)
        of_start, of_stop = (t.view(len(moved), joined, -1) for t in turns)
        summed = torch.einsum("cst,ast,bst->csab", added, of_start, of_stop)
        best = summed.abs().square().sum(1).flatten(1).argmax(-1)
        start, stop = best // len(moved), best % len(moved)
        ends = ends + torch.stack([moved[start], moved[stop]], -1)
        blocks = blocks * (turns[0][start] * turns[1][stop]).view(tracks, 1, count, width)
        together = math.sqrt(count * width / joined)
        parts = blocks.view(tracks, p, joined, -1).sum(-1) / together  # (track, sensor, segment)
        if joined == count:  # a steady line that is crossed is no track
            powers = torch.einsum("cp,cps->cs", signs, parts).abs().square() / signs.abs().sum(-1, keepdim=True)
            held = _held(parts, cut)
            parts, blocks = parts * held, blocks * held[..., None]
        of_each = (combinations.to(parts.dtype) @ parts).abs().square().sum(-1) / combinations.abs().sum(-1)
        power, which = of_each.max(-1)
        signs = combinations[which].to(blocks.dtype)
        tried = 4.0 * (count / joined) ** 2  # independent tracks for each bin at both ends
        tails.append(_log_tail(joined, power) + math.log(tried))
    log_tail, at = (torch.stack(tails).amin(0) + math.log(len(tails))).min(0)
    best = at[None]
    first, last = (_in_phase(found.at(best), ends[best], signs[best], length, cut)[0] / length).tolist()
    return Track(float(log_tail), (first, last), signs[at].real, powers[at])


def _in_phase(found: Candidates, ends: Tensor, signs: Tensor, length: int, cut: float) -> Tensor:
    """Ends of tracks `(track, end)`, next to those given, between which most of the record is in phase.

    Powers are cut on the track as it is in the end: those cut where the search had the track are smaller on the other
    side of the true one.
    """
    count, width = found.bins.shape[-2:]
    blocks = _blocks(found, ends, length)
    blocks = blocks * _held(blocks.sum(-1) / math.sqrt(width), cut)[..., None]
    moved = torch.arange(-12, 13, dtype=torch.float64) * (0.05 / count)  # steps of a twentieth of a cycle
    of_start, of_stop = (torch.polar(torch.ones_like(c), -2 * math.pi * c) for c in _cycles(moved, count, width))
    added = torch.einsum("cp,cpt->ct", signs, blocks.flatten(2))
    best = torch.einsum("ct,at,bt->cab", added, of_start, of_stop).abs().flatten(1).argmax(-1)
    return ends + torch.stack([moved[best // len(moved)], moved[best % len(moved)]], -1)


def _held(parts: Tensor, cut: float) -> Tensor:
    """Factors with which amplitudes of segments are no larger than those of power `cut`."""
    return math.sqrt(cut) / parts.abs().clamp(min=math.sqrt(cut))


def _straight(along: Tensor) -> Tensor:
    """Bins at the record's ends `(track, end)`, of the line through the middles of the first and the last segment."""
    first, last = along[:, 0].to(torch.float64), along[:, -1].to(torch.float64)
    half = (last - first) / (2 * max(along.shape[1] - 1, 1))
    return torch.stack([first - half, last + half], -1)


def _cycles(ends: Tensor, count: int, width: int) -> tuple[Tensor, Tensor]:
    """Cycles up to each block, `(end, block)`, that a track has for its bins at the record's start and at its end."""
    share = torch.arange(count * width, dtype=torch.float64) / (count * width)
    whole = count * ends[:, None]
    return whole * (share - share**2 / 2), whole * share**2 / 2


def _blocks(found: Candidates, ends: Tensor, length: int) -> Tensor:
    """Samples of the bands around tracks, whose phase stands still along them, `(track, sensor, segment, block)`."""
    count, width = found.bins.shape[-2:]
    blocks = torch.fft.ifft(torch.fft.ifftshift(found.bins.to(torch.complex128), -1), norm="ortho")
    within = torch.arange(width, dtype=torch.float64) / width
    of_bins = found.along[..., None] * (torch.arange(count)[:, None] + within)
    of_bins = of_bins + found.undone[:, None, None] * (within - (length - 1) / (2 * length)).square() / 2
    of_start, of_stop = _cycles(ends[:, 0], count, width)[0], _cycles(ends[:, 1], count, width)[1]
    left = (of_start + of_stop).view(-1, count, width) - of_bins
    return blocks * torch.polar(torch.ones_like(left), -2 * math.pi * left)[:, None]


def _log_tail(shape: int, power: Tensor) -> Tensor:
    """Logarithm of the upper tail of a Gamma law of whole shape and scale one, at each of `(track,)` powers."""
    k = torch.arange(shape, dtype=torch.float64)
    log_power = power.clamp(min=torch.finfo(power.dtype).tiny).log()[:, None]
    return (torch.logsumexp(k * log_power - torch.lgamma(k + 1), -1) - power).clamp(max=0.0)
