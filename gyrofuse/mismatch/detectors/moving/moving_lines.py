"""Test of a tone whose frequency moves: a motor that runs up, down, or from one speed to another.

Whitened records are cut into segments. Powers `q` of segments and bins, over the medians of their bin and of their
segment, are standard exponential by noise, and `1 + s` times as large on a tone, whose frequency moves by a few bins at
most from one segment to the next, and which starts and stops.

Statistic: mean likelihood ratio over all paths (forward algorithm of a hidden Markov model), tones' powers `s`, sets of
sensors, and lengths of segments. Null law: that of an e-value (`p_value_from_e_value`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.detectors.moving.chirps import chirp_test, decorrelated_record, strongest_chirp
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.psd import light_taper
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_reference, p_value_from_e_value, sidak
from gyrofuse.mismatch.stats.segments import runs_of

_MOVES = 4  # bins from one segment to the next, at most
_LOWEST = 3  # bin: the taper's main lobe around zero


class MovingLine(NamedTuple):
    """The likeliest path of a tone.

    Attributes:
        log_ratio: Logarithm of the mean likelihood ratio over all paths, nats.
        length: Samples of a segment.
        path: Frequency in each segment, cycles per sample, `(segment,)`; NaN where there is no tone.
    """

    log_ratio: float
    length: int
    path: Tensor

    @property
    def p_value(self) -> float:
        return p_value_from_e_value(self.log_ratio)

    @property
    def n_rests(self) -> int:
        """Number of frequencies, some bins apart, at each of which it stays for many segments, to a bin."""
        many, near, apart = 16, 2.0, 4.0
        if len(self.path) < many:
            return 0
        bins = (self.path * self.length).unfold(0, many, 1)  # (segment, many)
        rests = bins.amax(-1) - bins.amin(-1) <= near  # not so beside NaN
        middles = bins[rests].mean(-1).sort().values
        return int((middles.diff() > apart).sum()) + 1 if len(middles) else 0

    def passes(self, sample: int, frequency: float) -> bool:
        """Whether it is there at a sample and a frequency, to three bins, and for many segments around."""
        at, many, near = sample // self.length, 16, 3.0
        there = ((self.path - frequency).abs() < near / self.length)[max(at - 1, 0) : at + 2]
        lasts = any(a <= at < b and b - a >= many for a, b in runs_of(~self.path.isnan()).tolist())
        return bool(there.any()) and lasts


def moving_line_test(comparison: Comparison) -> TestResult:
    """A line whose frequency moves, straight on or on any path, that the simulation does not have."""
    straight, p_value = chirp_test(comparison), moving_line_p_value(comparison)
    both = sidak(min(straight.p_value, p_value), 2)
    if p_value >= straight.p_value:
        return replace(straight, p_value=both)
    path, rate = moving_line(comparison.observed).path, comparison.info.rate
    there = path[path.isfinite()]
    if not len(there):
        return replace(straight, p_value=both)
    low, high = float(there.min()), float(there.max())
    moves = f"that moves between {low * rate:.4g} Hz and {high * rate:.4g} Hz"
    return TestResult(
        "sweep",
        both,
        f"a line {moves if low < high else f'near {low * rate:.4g} Hz that comes and goes'} in some of the sensors",
        sensors=straight.sensors,
        levels=tuple(sorted({level_of(max(f, 1 / comparison.n_samples)) for f in (low, high)})),
    )


def moving_line_p_value(comparison: Comparison) -> float:
    """p value of the recording's, beyond what the simulation has itself."""
    return p_value_beyond_reference(moving_line(comparison.observed).p_value, moving_line(comparison.reference).p_value)


def straight_line(comparison: Comparison) -> tuple[float, MovingLine | None]:
    """p value and path of the best straight track, which a faint tone shows on; None where it is folded back."""
    p_value, track = strongest_chirp(comparison)
    n = comparison.n_samples
    length = n // 16 // 2 * 2  # few numbers: it is faint
    middles = (torch.arange(n // length, dtype=torch.float64) + 0.5) * length / n
    path = track.first + (track.last - track.first) * middles
    return p_value, None if track.turns else MovingLine(track.nats, length, path)


@derived
def moving_line(side: Records) -> MovingLine:
    """The likeliest of the first record."""
    white = decorrelated_record(side)
    n = white.shape[-1]
    scales = []
    for root in (1, 2, 4):
        length = max(root * math.isqrt(n) // 2 * 2, 32)
        if n // length < 32:
            continue
        power = _powers(white, length)
        gains, ratios = _cell_ratios(power)
        log_ratios = over_paths(ratios)
        scales.append((log_ratios, length, gains))
    if not scales:
        return MovingLine(-math.inf, n, torch.full((1,), math.nan, dtype=torch.float64))
    values = torch.stack([log_ratios for log_ratios, _, _ in scales])
    mean = float(values.flatten().logsumexp(0)) - math.log(values.numel())
    best, which = divmod(int(values.argmax()), values[0].numel())
    _, length, gains = scales[best]
    return MovingLine(mean, length, _likeliest_path(gains, which, length))


def lines_that_rest(comparison: Comparison) -> list[MovingLine]:
    """Likeliest paths of a tone that rests at several frequencies, at each for so long that it is a line there.

    One for each length of segments: the shorter, the faster it may move from one rest to the next. Of the recording in
    units of the simulation's noise: its own smooth spectrum has no lines, and no such rests. A tone that rests at one
    frequency alone is none of them: that is a line by itself.
    """
    n, found = comparison.n_samples, list[MovingLine]()
    for parts in (2, 1):
        length = math.isqrt(n) // (2 * parts) * 2
        if length < 32 or n // length < 32:
            continue
        power = _powers(comparison.white, length, dims=(-1,))
        gains, ratios = _cell_ratios(power)
        log_ratios = over_paths(ratios)
        best, which = log_ratios.max(0)
        found.append(MovingLine(float(best), length, _likeliest_path(gains, int(which), length)))
    return [line for line in found if line.n_rests > 1]


def _likeliest_path(gains: Tensor, which: int, length: int) -> Tensor:
    """Frequencies `(segment,)` of one set and power of log likelihood ratios `(set, power, segment, bin)`."""
    path = _likeliest(gains.flatten(0, 1)[which])
    return torch.where(path >= 0, (path + _LOWEST) / length, math.nan)


def _powers(white: Tensor, length: int, dims: tuple[int, ...] = (-2, -1)) -> Tensor:
    """Of segments and bins of whitened samples `(sensor, time)`, over medians along `dims`, `(sensor, segment, bin)`.

    By default along segments, of a bin, and then along bins, of a segment.
    """
    count = white.shape[-1] // length
    segments = white[:, : count * length].unflatten(-1, (count, length))
    power = squared_modulus(torch.fft.rfft(segments * light_taper(length)))[..., _LOWEST:-1]
    for dim in dims:
        power = power / (power.median(dim, keepdim=True).values / math.log(2)).clamp(min=1e-300)
    there = (segments != 0).to(power.dtype).mean(-1, keepdim=True)  # of segments at the ends little is left
    return torch.where(there > 0.5, power, 0.0)


def _cell_ratios(power: Tensor) -> tuple[Tensor, Tensor]:
    """Log likelihood ratios of tones in cells of powers `(sensor, segment, bin)`, `(set, power, segment, bin)`.

    Of all sensors together, and of each alone. The same in units of probability, for sums.
    """
    _, count, bins = power.shape
    # Exponential variables whose mean is as well known as these medians.
    gains = tone_gains(power, 0.48 / (1 / count + 1 / bins))
    return gains, gains.clamp(max=600.0).exp()


def tone_gains(power: Tensor, m: float) -> Tensor:
    """Log likelihood ratios of tones in cells of powers `(sensor, segment, bin)`, `(set, power, segment, bin)`.

    Of all sensors together, and of each alone.

    Args:
        power: Over a noise that is known as from `m` exponential variables.
        m: Their number.
    """
    s = torch.tensor([2.0, 8.0, 32.0], dtype=power.dtype).view(-1, 1, 1)  # of a tone over the noise of a segment
    # Of powers over an estimate, which are F distributed: they are as large by chance more often.
    own = (m + 1) * (torch.log1p(power / m)[:, None] - torch.log1p(power[:, None] / (m * (1 + s)))) - s.log1p()
    return torch.cat([own.sum(0, keepdim=True), own]) if len(power) > 1 else own


def over_paths(ratios: Tensor) -> Tensor:
    """Logarithm of the mean over all paths, `(set * power,)`, of likelihood ratios `(set, power, segment, bin)`."""
    cells = ratios.flatten(0, 1).movedim(1, 0)  # (segment, set, bin)
    count, rows, bins = cells.shape
    turn = 2 / count  # probability of a start or stop in a segment
    on = torch.full((rows, bins), 0.5 / bins, dtype=cells.dtype)
    off = torch.full((rows,), 0.5, dtype=cells.dtype)
    log_sum = torch.zeros(rows, dtype=cells.dtype)
    width = 2 * _MOVES + 1
    for cell in cells:
        moved = torch.nn.functional.avg_pool1d(on[:, None], width, 1, _MOVES)[:, 0]
        begun = off * turn / bins
        off = off * (1 - turn) + on.sum(-1) * turn
        on = (moved * (1 - turn) + begun[:, None]) * cell
        total = on.sum(-1) + off
        on, off = on / total[:, None], off / total
        log_sum += total.log()
    return log_sum


def _likeliest(gains: Tensor) -> Tensor:
    """The likeliest path (Viterbi) through log likelihood ratios `(segment, bin)`: bins, -1 without a tone."""
    count, bins = gains.shape
    stay, turn, move = math.log1p(-2 / count), math.log(2 / count), -math.log(2 * _MOVES + 1)
    width = 2 * _MOVES + 1
    on, off = gains.new_full((bins,), math.log(0.5 / bins)), gains.new_tensor(math.log(0.5))
    came, from_on = [], []
    for cell in gains:
        moved, index = torch.nn.functional.max_pool1d(on[None, None], width, 1, _MOVES, return_indices=True)
        moved, begun = moved[0, 0] + stay + move, off + turn - math.log(bins)
        came.append(torch.where(moved >= begun, index[0, 0], -1))
        best, at = on.max(0)
        from_on.append(int(at) if float(best + turn) > float(off + stay) else -1)
        off = torch.maximum(off + stay, best + turn)
        on = torch.maximum(moved, begun) + cell
    state = int(on.argmax()) if float(on.max()) > float(off) else -1
    path = []
    for k in reversed(range(count)):
        path.append(state)
        state = int(came[k][state]) if state >= 0 else from_on[k]
    return torch.tensor(path[::-1], dtype=torch.float64)
