"""Stretches of a recording in which the device is handled: its sensors move together, smoothly, and come to rest again.

In cells of 32 to 256 samples the mean square of whitened samples is compared with the median over all cells, of single
samples and of means over 16 of them. Handling is smooth, so that means show more of it; it is no course of the bias,
which a cubic follows; no vibration or ringing, which has many cycles of one frequency; no shock, which is over at once;
and it is over after a part of the record.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.stats.segments import CHI2_MEDIAN

_MEAN_OF = 16  # samples, whose means show what is smooth


class Stretch(NamedTuple):
    """One stretch.

    Attributes:
        first, end: First sample, and the one after the last.
        cell: Samples to which both are known.
        log_ratio: Log likelihood ratio of another variance of the means, nats.
        which: Sensors that move, `(sensor,)`.
    """

    first: int
    end: int
    cell: int
    log_ratio: float
    which: Tensor


@derived
def handled(comparison: Comparison) -> tuple[Stretch, ...]:
    """Stretches in which the recording's device is handled, in the order of time; none where the simulation has any.

    Nor where slow noise of the simulation is by chance nearly as loud for as long.
    """
    found = _stretches(comparison.white, comparison.recording)
    simulated = (
        [(whitened(record, comparison.base), record) for record in comparison.reference.signal[:2]] if found else []
    )
    if any(_stretches(*one) for one in simulated):
        return ()
    beyond = 1.5  # times as loud
    return tuple(
        one
        for one in found
        if all(
            float(_loudness(comparison.white[:, one.first : one.end], one, comparison.white))
            > beyond * float(_loudness(white, one, white))
            for white, _ in simulated
        )
    )


def _loudness(white: Tensor, stretch: Stretch, whole: Tensor) -> Tensor:
    """Power of the means of the loudest part that is as long as a stretch, over the median, in the sensors that move.

    Args:
        white: Whitened signals `(sensor, time)`, in which it is looked for.
        stretch: The stretch.
        whole: Signals that say what is usual.
    """
    power, usual = (_means(x)[stretch.which].square() for x in (white, whole))
    level = usual.median(-1, keepdim=True).values.clamp(min=1e-300) / CHI2_MEDIAN
    length = min((stretch.end - stretch.first) // _MEAN_OF, power.shape[-1])
    return (power / level).mean(0).unfold(-1, length, max(length // 8, 1)).mean(-1).max()


def _means(white: Tensor) -> Tensor:
    """Means of samples `(sensor, mean)`, which show what is smooth; of white noise they have its variance."""
    return white[:, : white.shape[-1] // _MEAN_OF * _MEAN_OF].unflatten(-1, (-1, _MEAN_OF)).mean(-1) * math.sqrt(
        _MEAN_OF
    )


def _stretches(white: Tensor, signal: Tensor) -> list[Stretch]:
    louder, fewest_cells, most = 2.5, 4, 0.3  # times the usual variance; cells in a row; share of the record
    n, mean_of = white.shape[-1], _MEAN_OF
    cell = min(max(n // 512 // mean_of * mean_of, 2 * mean_of), 256)
    n_cells = n // cell
    if n_cells < 16 * fewest_cells:
        return []
    means = _means(white)
    of_cells = means[:, : n_cells * (cell // mean_of)].unflatten(-1, (n_cells, -1)).square().mean(-1)
    power = torch.nn.functional.avg_pool1d(of_cells, 3, 1, 1, count_include_pad=False)  # (sensor, cell)
    level = power.median(-1, keepdim=True).values.clamp(min=1e-300)
    # One sensor alone may be louder for many reasons; of many each need not be as loud.
    least = louder**2 if len(white) == 1 else 1 + (louder - 1) * min(math.sqrt(4 / len(white)), 1.0)
    moves = (power / level > least).sum(0) >= max(len(white) / 2, min(2, len(white)))
    usual = white.square().median(-1).values.clamp(min=1e-300) / CHI2_MEDIAN
    found = []
    for first, end in _as_far_as_seen((power / level).mean(0), _runs(moves, fewest_cells)):
        start, stop = max(first - 1, 0) * cell, min((end + 1) * cell, means.shape[-1] * mean_of)
        part = means[:, start // mean_of : stop // mean_of]
        slow = _without_cubic(part).square().mean(-1) / level[:, 0]
        fast = white[:, start:stop].square().mean(-1) / usual
        which = _that_move(slow, fast, least)
        if bool(which.any()) and not _at_once(part.square() / level) and not _rings(signal[which, start:stop]):
            log_ratio = float((slow - 1 - slow.log())[which].sum()) * (stop - start) / mean_of / 2
            found.append(Stretch(start, stop, cell, log_ratio, which))
    return found if sum(one.end - one.first for one in found) < most * n else []


def _runs(moves: Tensor, fewest: int) -> list[tuple[int, int]]:
    """First and end of runs of cells that move, with a few quiet ones between, and more than half of them moving."""
    gap, runs = 5, list[tuple[int, int]]()
    for k in moves.nonzero()[:, 0].tolist():
        if runs and k - runs[-1][1] < gap:
            runs[-1] = runs[-1][0], k + 1
        else:
            runs.append((k, k + 1))
    return [(a, b) for a, b in runs if int(moves[a:b].sum()) >= max(fewest, (b - a) / 2)]


def _as_far_as_seen(power: Tensor, runs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Runs of cells with what is less conspicuous before and after them, by the power over the usual, `(cell,)`."""
    window, louder, found = 8, 1.6, list[tuple[int, int]]()
    for first, end in runs:
        while first > 0 and float(power[max(first - window, 0) : first].mean()) > louder:
            first = max(first - window // 2, 0)
        while end < len(power) and float(power[end : end + window].mean()) > louder:
            end = min(end + window // 2, len(power))
        if found and first <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((first, end))
    return found


def _that_move(slow: Tensor, fast: Tensor, least: float) -> Tensor:
    """Sensors `(sensor,)` that move smoothly, from the power of means and of samples; none where they are few."""
    smoother = 3.0  # times the power of means over that of single samples: of white noise 1
    which = slow > least
    enough = int(which.sum()) >= max(len(slow) / 2, min(2, len(slow)))
    ratio = (slow - 1) / (fast - 1).clamp(min=1e-12)
    if not enough or float(ratio[which].median()) < smoother:
        return torch.zeros_like(which)
    return which


def _at_once(power: Tensor) -> bool:
    """Whether nearly all power `(sensor, mean)` is in four means, as that of a shock."""
    mostly, few = 0.8, 4
    total = power.sum(0)
    return bool(total.topk(min(few, len(total))).values.sum() > mostly * total.sum())


def _rings(signal: Tensor) -> bool:
    """Whether signals `(sensor, time)` are many cycles of one frequency at a time."""
    mostly, many, few = 0.7, 6, 3  # share of the power; cycles of the whole, and of an eighth of it
    signal = _without_cubic(signal)
    return any(
        float(share) > mostly and cycles >= least
        for length, least in ((signal.shape[-1], many), (signal.shape[-1] // 8, few))
        for share, cycles in [_strongest_line(signal, length)]
    )


def _strongest_line(signal: Tensor, length: int) -> tuple[float, float]:
    """Share of the power within a bin of the strongest in windows of a length, and its cycles in one: medians."""
    windows = signal.unfold(-1, length, max(length // 2, 1))
    windows = (windows - windows.mean(-1, keepdim=True)) * torch.hann_window(length, dtype=signal.dtype)
    power = squared_modulus(torch.fft.rfft(windows)).sum(0)  # (window, bin)
    power = power * (power.sum(-1, keepdim=True) > 0.1 * power.sum(-1).amax())
    near = torch.nn.functional.avg_pool1d(power[:, None], 3, 1, 1)[:, 0] * 3
    share, at = near.max(-1)
    loud = power.sum(-1) > 0
    return float((share / power.sum(-1).clamp(min=1e-300))[loud].median()), float(at[loud].double().median())


def _without_cubic(values: Tensor) -> Tensor:
    """Values `(..., time)` without the cubic that fits best."""
    x = torch.linspace(-1, 1, values.shape[-1], dtype=torch.float64)
    basis = torch.linalg.qr(torch.stack([x**k for k in range(4)], -1)).Q
    return values - (values @ basis) @ basis.mT
