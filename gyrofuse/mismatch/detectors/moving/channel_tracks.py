"""A tone whose frequency a channel says: a motor's command, its speed, a supply voltage.

Its frequency is `f = a + b u(t)`, with `u` a row of a channel. Turned back by `b` times the integral of the row, which
moves nothing but the phase, it stays at `a`. Whitened records that were turned back are cut into segments; powers `q`
of segments and bins, over the medians of 32 bins beside each other, are standard exponential by noise and `1 + s` times
as large on the tone. What stays where it is in the recording is spread out by that.

Statistic: mean likelihood ratio over slopes `b`, frequencies `a`, tones' powers `s`, sets of sensors, rows as they came
and late, and lengths of segments. Null law: that of an e-value (`p_value_from_e_value`), whatever the channel's course
is.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.results import readable
from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.detectors.moving.chirps import decorrelated_record
from gyrofuse.mismatch.detectors.moving.moving_lines import moving_line_test, over_paths, tone_gains
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.slow.channels import auxiliary
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.filters import late
from gyrofuse.mismatch.signals.psd import light_taper
from gyrofuse.mismatch.stats.multiplicity import p_value_from_e_value, sidak


class ChannelTrack(NamedTuple):
    """The likeliest line along the row of a channel.

    Attributes:
        log_ratio: Logarithm of the mean likelihood ratio over all lines, nats.
        channel: Name.
        row: Position.
        offset: Frequency where the channel is zero, cycles per sample.
        slope: Rise of it for each unit of the channel.
        length: Samples of a segment.
    """

    log_ratio: float
    channel: str
    row: int
    offset: float
    slope: float
    length: int

    @classmethod
    def of(cls, channel: str, row: int, at: float, slope: float, middle: float, length: int) -> ChannelTrack:
        """A line that is at a frequency from 0 to 1 where its row has the value `middle`."""
        folded, rise = (at, slope) if at <= 0.5 else (1 - at, -slope)
        return cls(0.0, channel, row, folded - rise * middle, rise, length)

    def values(self, comparison: Comparison) -> Tensor:
        """Of its row, `(time,)`."""
        return comparison.info.channel_rows(self.channel)[self.row]

    @property
    def p_value(self) -> float:
        return p_value_from_e_value(self.log_ratio)


def moving_test(comparison: Comparison) -> TestResult:
    """A line that moves as a channel says, straight on, or on any path, and that the simulation does not have."""
    found, track = moving_line_test(comparison), channel_track(comparison)
    if track is None:
        return found
    both = sidak(min(found.p_value, track.p_value), 2)
    if found.p_value <= track.p_value:
        return replace(found, p_value=both)
    row = track.values(comparison)
    ends = [abs(track.offset + track.slope * float(end)) for end in (row.min(), row.max())]
    return TestResult(
        "sweep",
        both,
        f"a line whose frequency follows {readable(track.channel)}",
        sensors=tuple(range(comparison.n_sensors)),
        levels=tuple(sorted({level_of(min(max(f, 1 / comparison.n_samples), 0.5)) for f in ends})),
        channel=track.channel,
    )


@derived
def channel_track(comparison: Comparison) -> ChannelTrack | None:
    """The likeliest line along a channel; None without one, or where any path explains more than a channel's."""
    names = auxiliary(comparison)
    given = [(name, k, u) for name in names for k, u in enumerate(comparison.info.channel_rows(name))]
    rows = given + [(name, k, moved) for name, k, u in given if (moved := as_it_moves(u)) is not u]
    if not rows:
        return None
    white, many = decorrelated_record(comparison.observed).to(torch.float32), 5e6  # samples of all rows and sensors
    part = busiest([u for *_, u in rows], max(int(many / (len(white) * len(rows))), 2**15))
    white, rows = white[:, part], [(name, k, u[part]) for name, k, u in rows]
    n, affordable = white.shape[-1], 10 * many / (white.numel() * len(rows))
    lengths = [length for length in (64, 128, 256, 512) if length == 64 or length < affordable]
    tried = [(length, *row) for length in lengths for row in rows]
    # What turns comes to its speed late: roughly, in segments that are not longer than it is known to.
    tried += [
        (length, name, k, late(u, seconds * comparison.info.rate))
        for length in lengths[:2]
        for name, k, u in rows
        for seconds in (0.03, 0.1)
    ]
    scanned = [(_scanned(white, name, k, u, length), u) for length, name, k, u in tried if n // length >= 16]
    if not scanned:
        return None
    log_ratio = float(torch.tensor([one.log_ratio for one, _ in scanned]).logsumexp(0)) - math.log(len(scanned))
    best, u = max(scanned, key=lambda one: one[0].log_ratio)
    plain = 0.01  # p value from which on other paths are asked for
    if p_value_from_e_value(log_ratio) < plain and not _tells(white, best, u):
        return None
    return best._replace(log_ratio=log_ratio)


def busiest(rows: list[Tensor], most: int) -> slice:
    """All of a record, or of a long one the stretch of so many samples in which rows `(time,)` move most."""
    n = len(rows[0])
    if n <= most:
        return slice(0, n)
    starts = range(0, n - most + 1, max((n - most) // 8, 1))
    moves = [sum(float(u[a : a + most].std() / u.std().clamp(min=1e-300)) for u in rows) for a in starts]
    start = starts[moves.index(max(moves))]
    return slice(start, start + most)


def _scanned(white: Tensor, channel: str, row: int, u: Tensor, length: int) -> ChannelTrack:
    """The likeliest line along values `(time,)`, with the mean likelihood ratio over all of that length of segments."""
    middle, reach = _middle(u)
    turned = (u - middle).cumsum(0)
    logs, best = list[float](), (-math.inf, 0.0, 0.0)
    apart = 6  # half bins, at least: what moves by less is a line that stays, or any other one that wanders
    for moves in range(apart, length):  # half bins at the ends of a row
        inside, slope = _inside(moves, length), moves / (2 * length * reach)
        if not len(inside):
            continue
        ratios = _of_bins(white, turned * slope, length)[:, inside]
        logs.append(float(ratios.logsumexp((0, 1))) - math.log(ratios.numel()))
        largest, at = ratios.amax(0).max(0)
        best = max(best, (float(largest), int(inside[at]) / length, slope))
    log_ratio = float(torch.tensor(logs).logsumexp(0)) - math.log(len(logs))
    return ChannelTrack.of(channel, row, best[1], best[2], middle, length)._replace(log_ratio=log_ratio)


def _tells(white: Tensor, track: ChannelTrack, u: Tensor) -> bool:
    """Whether its channel tells the frequency, and not any path that a tone takes by itself.

    It explains more than all paths do, or, where there are tones beside it, than twice what other times of the channel
    explain.
    """
    bins = _inside(0, track.length)
    still = _cells(white, torch.zeros_like(white[0]), track.length)[..., bins[: len(bins) // 2]]
    paths = over_paths(still.to(torch.float64).clamp(max=600.0).exp())
    if track.log_ratio > float(paths.logsumexp(0)) - math.log(len(paths)):
        return True
    shifts = [len(u) * k // 4 for k in (1, 2, 3)]
    return all(track.log_ratio > 2 * _scanned(white, "", 0, u.roll(k), track.length).log_ratio for k in shifts)


def as_it_moves(row: Tensor) -> Tensor:
    """A row `(time,)` on straight lines between samples that a slower source sent and the log repeats until the next.

    Runs of it are alike in length; those of a command that someone sets are not, and stay.
    """
    starts = torch.nn.functional.pad((row.diff() != 0).nonzero()[:, 0] + 1, (1, 0))
    runs, fewest, most_alike = starts.diff().double(), 16, 0.7
    middle = float(runs.median()) if len(runs) else 0.0
    alike = ((runs - middle).abs() <= max(1.0, 0.1 * middle)).double()
    if len(runs) < fewest or middle < 2 or float(alike.mean()) < most_alike:
        return row
    at = np.interp(np.arange(len(row)), starts.numpy(), row[starts].numpy())
    return torch.from_numpy(at)


def _middle(row: Tensor) -> tuple[float, float]:
    """The middle of a row, and the width of what nine tenths of it lie in, or all."""
    low, middle, high = torch.quantile(row, torch.tensor([0.05, 0.5, 0.95], dtype=row.dtype)).tolist()
    return middle, high - low if high > low else float(row.max() - row.min())


def _inside(moves: int, length: int) -> Tensor:
    """Bins of lines that stay off zero where they move by so many half bins; beyond a half they are folded back.

    A line is the same as the one of the opposite frequency and slope.
    """
    bins, lobe = torch.arange(length), 3  # the taper's main lobe around zero
    return bins[torch.minimum(bins, length - bins) > moves / 4 + lobe]


def _of_bins(white: Tensor, cycles: Tensor, length: int) -> Tensor:
    """Log likelihood ratios of lines that stay, of samples turned back by so many cycles, `(set and power, bin)`."""
    return _cells(white, cycles, length).sum(-2, dtype=torch.float64).flatten(0, 1)


def _cells(white: Tensor, cycles: Tensor, length: int) -> Tensor:
    """Log likelihood ratios of tones in cells of samples turned back by so many cycles, `(set, power, segment, bin)`.

    Of all sensors together, and of each alone.
    """
    count, angle, beside = white.shape[-1] // length, -2 * math.pi * cycles, 32  # bins whose median is their noise
    turn = torch.polar(torch.ones_like(angle), angle).to(torch.complex64)
    segments = (white * turn)[:, : count * length].unflatten(-1, (count, length))
    power = squared_modulus(torch.fft.fft(segments * light_taper(length).to(torch.float32)))
    blocks = power.unflatten(-1, (-1, beside))
    power = (blocks / (blocks.median(-1, keepdim=True).values / math.log(2)).clamp(min=1e-30)).flatten(-2)
    return tone_gains(power, 0.48 * beside)  # exponential variables whose mean is as well known as these medians
