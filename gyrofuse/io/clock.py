"""From timestamps to a uniform grid: the rate, and the slot of the grid to which each sample belongs.

Samples keep the order of the log and are never interpolated. With `u_n = t_n / step - n`, a missing sample raises `u`
for good, while `u` returns after the jitter of a stamp or a burst of late ones. The number of samples that are missing
at a long step is therefore the rise of the lower envelope of `u` after the step above its slowly followed level before
the step. Where most stamps carry no information (arrival times that come in bursts), samples take one slot each, at the
long-run rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.streams import Array, Note, Notebook, RecordingError
from gyrofuse.io.timestamps import Slots, advancing_readings

# Largest difference of a step from the typical one that jitter explains, in typical steps: above 1/2, which stamps a
# quarter of a step early and late make together, and well below 1, which a missing sample makes.
_IRREGULAR = 0.55
# Samples after a step over which the lower envelope is taken: a burst of late stamps that is shorter is not taken for
# missing samples.
_WINDOW = 64
# Samples over which the level of the envelope follows a wandering rate: 16 windows, so that it hardly follows a burst.
_MEMORY = 1024


@dataclass(frozen=True, eq=False)
class Grid:
    """Positions of the samples of one device on a uniform grid of its own.

    Attributes:
        start: Clock reading at slot 0, seconds.
        rate: Slots per second.
        slots: Slot of each kept sample, increasing from 0.
        kept: Index of each kept sample in the log.
        trusted: Whether the slots come from the timestamps.
        notes: Findings about the clock.
    """

    start: float
    rate: float
    slots: Slots
    kept: Slots
    trusted: bool
    notes: tuple[Note, ...]

    @property
    def n_slots(self) -> int:
        """Length of the grid."""
        return int(self.slots[-1]) + 1

    @property
    def end(self) -> float:
        """Clock reading at the last slot, seconds."""
        return self.start + (self.n_slots - 1) / self.rate


def grid_of(
    time: Array,
    *,
    name: str,
    source: str,
    clock_period: float | None = None,
    rate: float | None = None,
    nominal: float | None = None,
) -> Grid:
    """Find the uniform grid behind timestamps.

    Args:
        time: Clock reading of each sample, seconds; may wrap, repeat, jump or be NaN.
        name: The device, for the notes.
        source: The file, for errors.
        clock_period: Seconds after which the clock wraps, when known.
        rate: Sampling rate in Hz that overrides the clock's.
        nominal: Sampling rate in Hz that the log states beside the clock.

    Raises:
        RecordingError: Fewer than two usable timestamps, none that advances, or long pauses.
    """
    book = Notebook(name)
    t, kept = advancing_readings(time, clock_period, source, book)
    steps = np.diff(t)
    repeats = int((steps == 0).sum())
    step, regular = _typical_step(t)
    trusted = not _in_bursts(t, step, regular, nominal or rate)
    if trusted:
        slots = _find_slots(t, step)
        start, step = _fit_line(slots, t)
    else:
        slots, start, step = np.arange(t.size), float(t[0]), float((t[-1] - t[0]) / (t.size - 1))
        book.add(
            "jitter",
            f"the timestamps come in bursts ({repeats} repeats, steps from {steps.min():.3g} to {steps.max():.3g} s, "
            f"{step:.3g} s in the long run): samples are taken in order, at the long-run rate",
            repeats=repeats,
        )
    residual = t - (start + step * slots)
    if nominal is not None and rate is None and abs(step * nominal - 1) > 0.01:
        book.add(
            "clock",
            f"the log states {nominal:.6g} Hz, the timestamps give {1 / step:.6g} Hz, which is used",
            clock_hz=1 / step,
            stated_hz=nominal,
        )
    if rate is not None:
        seen = 1 / step
        if abs(seen / rate - 1) > 1e-3:  # crystals of clocks are right to 0.01 %
            book.add("clock", f"the clock says {seen:.6g} Hz, {rate:.6g} Hz was asked for", clock_hz=seen, rate_hz=rate)
        step = 1 / rate

    # Of several samples in one slot the first is kept.
    first = np.concatenate([[True], slots[1:] > np.maximum.accumulate(slots)[:-1]])
    if trusted:
        if repeats:
            book.add("repeats", f"{repeats} timestamps repeat the one before; the first sample stays", samples=repeats)
        twice = int((~first).sum()) - repeats
        if twice > 0:
            book.add("repeats", f"{twice} samples fell into an occupied slot and were left out", samples=twice)
        _note_jitter(book, residual, step)
    slots, kept = slots[first], kept[first]
    start += step * float(slots[0])
    slots = slots - slots[0]
    # A grid of more than 20 slots a sample, 95 % of it empty, is a clock that jumps; the limit also keeps the memory of
    # the grid within 20 times that of the log. 1000 slots more let short logs have a pause.
    if slots[-1] > 20 * slots.size + 1000:
        raise RecordingError(
            f"{source}: expected a recording without long pauses, found {slots.size} samples of {name} in "
            f"{slots[-1] * step:.6g} s at {1 / step:.6g} Hz; cut the log where the clock jumps"
        )
    _note_gaps(book, slots, step)
    return Grid(start, 1 / step, slots, kept, trusted, tuple(book.notes))


def regular_grid(n_samples: int, rate: float) -> Grid:
    """The grid of samples without timestamps.

    Args:
        n_samples: Number of samples.
        rate: Sampling rate in Hz.
    """
    every = np.arange(n_samples)
    return Grid(0.0, rate, every, every, False, ())


def _typical_step(t: Array) -> tuple[float, NDArray[np.bool_]]:
    """Step between samples, by least squares pooled over runs of regular steps, and which steps are regular."""
    steps = np.diff(t)
    step = float(np.median(steps[steps > 0]))
    regular = np.abs(steps - step) <= _IRREGULAR * step
    begin = np.concatenate([[0], np.flatnonzero(~regular) + 1])
    length = np.diff(np.append(begin, t.size))
    number = np.arange(t.size) - np.repeat(begin + (length - 1) / 2, length)
    power = float(number @ number)
    if not power > 0:
        return step, regular
    ahead = (t - t[0]) / step - np.arange(t.size)
    ahead -= np.repeat(np.add.reduceat(ahead, begin) / length, length)
    return step * (1 + float(number @ ahead) / power), regular


def _in_bursts(t: Array, step: float, regular: NDArray[np.bool_], nominal: float | None) -> bool:
    """Whether the long-run rate differs from the rate of the typical steps for another reason than missing samples.

    Missing samples make steps of whole multiples of the typical one; stamps in bursts make fractions of it.
    """
    long_run = (t[-1] - t[0]) / (t.size - 1)
    # Steps within a tenth of the long-run one are those of the sensor, with less than a tenth of the samples missing.
    if abs(long_run / step - 1) < 0.1:
        return False
    # Half of that tenth: the stated rate is nearer to the long-run rate than to that of the typical steps.
    if nominal is not None and abs(long_run * nominal - 1) < 0.05:
        return True
    odd = np.diff(t)[~regular] / step
    # A quarter of a step is halfway between whole multiples and the fractions farthest from them. Steps below a half,
    # within a burst, are near the multiple 0, which missing samples never make.
    fractional = (np.abs(odd - np.rint(odd)) > 0.25) | (odd < 0.5)
    # Of multiples without a pattern half are fractional; a quarter is halfway between that and none. Fewer irregular
    # steps than one in twenty are pauses rather than bursts.
    return bool(odd.size > 0.05 * t.size and fractional.mean() > 0.25)


def _find_slots(t: Array, step: float) -> Slots:
    """Slot of each sample by the lower envelope of the module's `u`."""
    order = np.arange(t.size)
    ahead = (t - t[0]) / step - order
    doubtful = np.flatnonzero(np.abs(np.diff(ahead)) > 1 - _IRREGULAR) + 1
    if doubtful.size == 0:
        return order
    envelope = _lowest_ahead(ahead)
    jumps: list[tuple[int, int]] = []  # from which sample on, and how many are missing before it
    shift, begin, level = 0, 0, float(envelope[0])
    for here in doubtful.tolist():
        ahead[begin:here] -= shift
        before = float(ahead[max(here - _WINDOW, 0) : here].min())
        level += min((here - begin) / _MEMORY, 1.0) * (before - level)
        begin = here
        jump = round(float(envelope[here]) - shift - level)
        if not jump:
            continue
        shift += jump
        if jump < 0 and jumps and jumps[-1][1] == -jump and here - jumps[-1][0] < _WINDOW:
            jumps.pop()  # the stamps were late: `u` came back
        else:
            jumps.append((here, jump))
    missing = np.zeros(t.size, dtype=np.int64)
    for here, jump in jumps:
        missing[here] += jump
    return order + np.cumsum(missing)


def _lowest_ahead(values: Array) -> Array:
    """Minimum over each value and the values after it in a window of `_WINDOW`."""
    lowest, span = values.copy(), 1
    while span < _WINDOW:
        np.minimum(lowest[:-span], lowest[span:], out=lowest[:-span])
        span *= 2
    return lowest


def _fit_line(slots: Slots, t: Array) -> tuple[float, float]:
    """Least-squares line `t = start + step * slot`."""
    centred = slots - slots.mean()
    spread = float(centred @ centred)
    step = float(centred @ (t - t.mean())) / spread if spread else 0.0
    if not step > 0:
        return float(t[0]), float(np.median(np.diff(t)[np.diff(t) > 0]))
    return float(t.mean() - step * slots.mean()), step


def _note_jitter(book: Notebook, residual: Array, step: float) -> None:
    scatter = np.diff(residual)
    # Differences of neighbours hold the jitter; a wandering rate, which neighbours share, drops out.
    rms, largest = float(scatter.std() / np.sqrt(2)), float(np.abs(residual).max())
    if rms > 1e-3 * step:
        book.add(
            "jitter",
            f"timestamps scatter by {1e3 * rms:.3g} ms rms ({100 * rms / step:.2g} % of a step)",
            rms_s=rms,
        )
    if largest > 0.5 * step and largest > 6 * rms:
        book.add(
            "drift",
            f"timestamps leave a straight line by up to {1e3 * largest:.3g} ms ({largest / step:.3g} steps): the rate "
            "wanders or stamps come late",
            largest_s=largest,
        )


def _note_gaps(book: Notebook, slots: Slots, step: float) -> None:
    gaps = np.diff(slots) - 1
    gaps = gaps[gaps > 0]
    if gaps.size:
        missing = int(gaps.sum())
        book.add(
            "gaps",
            f"{gaps.size} gaps, {missing} samples missing ({100 * missing / (slots[-1] + 1):.2g} %), "
            f"the longest {gaps.max() * step:.4g} s; they are NaN",
            gaps=gaps.size,
            samples=missing,
            longest_s=gaps.max() * step,
        )
