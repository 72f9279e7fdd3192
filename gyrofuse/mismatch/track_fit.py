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
_CLOSER = 4  # segments that are joined for the next look
_STEP = 0.25  # bins of a segment, by which either end of a track moves; of longer segments as many
_REACH = 6, 8  # steps either way in the first look, and in those that follow
_FINER = 4.0  # places that continuous frequencies have for each bin at both ends


class Candidate(NamedTuple):
    """A track as the search has it.

    Attributes:
        power: Of its segments, of sensors added with their signs.
        signs: Of the sensors, `(sensor,)`: 0, 1 or -1.
        along: Bins at the centres of its segments, `(segment,)`, not folded back.
        undone: Bins that a frequency moves within a segment, which were undone before the transform.
        bins: Transforms around it, `(sensor, segment, 2 * AROUND)`, in which noise has power one.
    """

    power: float
    signs: Tensor
    along: Tensor
    undone: int
    bins: Tensor


class Track(NamedTuple):
    """A fitted track.

    Attributes:
        log_tail: Logarithm of the chance of its power on a track given beforehand, times the places that were looked
            at for each of the search's.
        ends: Frequencies at the record's ends, cycles per sample, not folded back.
        signs: Of the sensors.
        powers: Of the search's segments, `(segment,)`.
    """

    log_tail: float
    ends: tuple[float, float]
    signs: Tensor
    powers: Tensor


def fitted_track(found: Candidate, combinations: Tensor, length: int, cut: float) -> Track:
    """The best straight track next to one that the search has found.

    Args:
        found: The search's track.
        combinations: Signs of sensors to choose from, `(combination, sensor)`.
        length: Samples of a segment of the search.
        cut: Power of a sensor in a segment of the search that counts as this much where it is more.
    """
    p, count, width = found.bins.shape
    ends = _straight(found.along)
    blocks = _blocks(found, ends, length)  # (sensor, segment, block)
    signs, tails, powers = found.signs.to(blocks.dtype), [], torch.zeros(0)
    for joined in sorted({max(count // _CLOSER**k, 1) for k in range(count)}, reverse=True):
        reach = _REACH[joined < count]
        moved = torch.arange(-reach, reach + 1, dtype=torch.float64) * (_STEP * joined / count)
        turns = [torch.polar(torch.ones_like(c), -2 * math.pi * c) for c in _cycles(moved, count, width)]
        summed = torch.einsum("st,ast,bst->sab", (signs @ blocks.flatten(1)).view(joined, -1), *(
            t.view(len(moved), joined, -1) for t in turns
        ))  # fmt: skip
        start, stop = divmod(int(summed.abs().square().sum(0).argmax()), len(moved))
        ends = ends + torch.stack([moved[start], moved[stop]])
        blocks = blocks * (turns[0][start] * turns[1][stop]).view(count, width)
        parts = blocks.view(p, joined, -1).sum(-1) / math.sqrt(count * width / joined)  # (sensor, segment)
        if joined == count:  # a steady line that is crossed is no track
            powers = (signs @ parts).abs().square() / signs.abs().sum()
            held = math.sqrt(cut) / parts.abs().clamp(min=math.sqrt(cut))
            parts, blocks = parts * held, blocks * held[..., None]
        combined = (combinations.to(parts.dtype) @ parts).abs().square() / combinations.abs().sum(-1, keepdim=True)
        which = int(combined.sum(-1).argmax())
        signs = combinations[which].to(blocks.dtype)
        places = _FINER * (count / joined) ** 2
        tails.append(_log_tail(joined, float(combined[which].sum())) + math.log(places))
    first, last = (float(end) / length for end in ends)
    return Track(min(tails) + math.log(len(tails)), (first, last), signs.real, powers)


def _straight(along: Tensor) -> Tensor:
    """Bins at the record's ends, of the line through the middles of the first and the last segment."""
    bins = along.to(torch.float64)
    half = (bins[-1] - bins[0]) / (2 * max(len(bins) - 1, 1))
    return torch.stack([bins[0] - half, bins[-1] + half])


def _cycles(ends: Tensor, count: int, width: int) -> tuple[Tensor, Tensor]:
    """Cycles up to each block, `(end, block)`, that a track has for its bins at the record's start and at its end."""
    share = torch.arange(count * width, dtype=torch.float64) / (count * width)
    whole = count * ends[:, None]
    return whole * (share - share**2 / 2), whole * share**2 / 2


def _blocks(found: Candidate, ends: Tensor, length: int) -> Tensor:
    """Samples of the band around a track, whose phase stands still along it, `(sensor, segment, block)`."""
    _, count, width = found.bins.shape
    blocks = torch.fft.ifft(torch.fft.ifftshift(found.bins.to(torch.complex128), -1), norm="ortho")
    within = torch.arange(width, dtype=torch.float64) / width
    of_bins = found.along[:, None] * (torch.arange(count)[:, None] + within)
    of_bins = of_bins + found.undone * (within - (length - 1) / (2 * length)).square() / 2
    start, stop = _cycles(ends, count, width)
    left = (start[0] + stop[1]).view(count, width) - of_bins
    return blocks * torch.polar(torch.ones_like(left), -2 * math.pi * left)


def _log_tail(shape: int, power: float) -> float:
    """Logarithm of the upper tail of a Gamma law of whole shape and scale one."""
    if power <= 0:
        return 0.0
    k = torch.arange(shape, dtype=torch.float64)
    return min(float(torch.logsumexp(k * math.log(power) - torch.lgamma(k + 1), 0)) - power, 0.0)
