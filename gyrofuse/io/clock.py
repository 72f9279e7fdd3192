"""From timestamps to a uniform grid: the rate, and which slot of the grid each sample belongs to.

Samples are never interpolated. Three ways to give each sample a slot are tried, and the first that leaves the fewest
slots empty or taken twice is used:

1. *grid*: the slot nearest to the timestamp, on a straight line through all timestamps; right for good clocks;
2. *steps*: as many slots on from the sample before as the time between them says, rounded; right when the true rate
   wanders, so that a straight line would slip;
3. *order*: one slot a sample, when most timestamps say nothing (arrival times that come in bursts).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.notes import Note, Notebook
from gyrofuse.io.stream import Array, RecordingError

Slots = NDArray[np.int64]

# A clock is not trusted to tell where samples are missing when more of its steps than this are zero or long, or more of
# its samples than this find no slot of their own in spite of it.
_MOST_IRREGULAR = 0.1
_MOST_MISPLACED = 0.02
# A grid with more slots a sample than this is a clock that jumps, not a recording.
_SPARSEST = 20
_TICKS = {"microsecond": 1e-6, "millisecond": 1e-3, "nanosecond": 1e-9}


@dataclass(frozen=True, eq=False)
class Grid:
    """Where the samples of one device lie on a uniform grid of its own.

    Attributes:
        start: Clock reading at slot 0, seconds.
        rate: Slots per second.
        slots: Slot of each kept sample, increasing from 0.
        kept: Index of each kept sample in the log.
        trusted: Whether the slots come from the timestamps.
        notes: What was found on the way.
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
    time: Array, *, name: str, source: str, clock_period: float | None = None, rate: float | None = None
) -> Grid:
    """Find the uniform grid behind timestamps.

    Args:
        time: Clock reading of each sample, seconds; may wrap, repeat, jump or be NaN.
        name: The device, for the notes.
        source: The file, for errors.
        clock_period: Seconds after which the clock wraps, when known.
        rate: Sampling rate in Hz that overrides the clock's.

    Raises:
        RecordingError: Fewer than two usable timestamps, or none that advances.
    """
    book = Notebook(name)
    kept = np.flatnonzero(np.isfinite(time))
    if kept.size < time.size:
        lost = time.size - kept.size
        book.add("clock", f"{lost} samples without a timestamp were left out", samples=lost)
    t, n_wraps, period = _unwrap(time[kept], clock_period)
    if n_wraps:
        book.add("wraps", f"the clock wrapped {n_wraps} times, every {period:.6g} s; unwrapped", wraps=n_wraps)
    ahead = t >= np.maximum.accumulate(t)
    if not ahead.all():
        lost = int((~ahead).sum())
        book.add("clock", f"the clock stepped back: {lost} samples until it caught up were left out", samples=lost)
        t, kept = t[ahead], kept[ahead]
    steps = np.diff(t)
    if not (steps > 0).any():
        raise RecordingError(
            f"{source}: expected timestamps that advance, found {t.size} usable ones of {time.size} that do not; "
            "give the rate with rate= (--rate HZ) and a file without timestamps"
        )
    step = float(np.median(steps[steps > 0])) if rate is None else 1 / rate
    repeats = int((steps == 0).sum())

    candidates = [_on_line(t, step, fixed=rate is not None), _by_steps(t, step)]
    slots, line = min(candidates, key=lambda candidate: _flaws(candidate[0]))
    long = steps[steps > 1.5 * step]  # these explain empty slots
    unexplained = _flaws(slots) - int(np.rint(long / step - 1).sum()) - repeats
    trusted = repeats + long.size <= _MOST_IRREGULAR * t.size and unexplained <= max(_MOST_MISPLACED * t.size, 1)
    if not trusted:
        slots, line = np.arange(t.size), (float(t[0]), (t[-1] - t[0]) / (t.size - 1))
        if not line[1] > 0:
            raise RecordingError(
                f"{source}: expected timestamps that advance from the first ({t[0]:.6g} s) to the last "
                f"({t[-1]:.6g} s); give the rate with rate= (--rate HZ) and a file without timestamps"
            )
        book.add(
            "jitter",
            f"the timestamps are too irregular to place samples ({repeats} repeats, steps from {steps.min():.3g} to "
            f"{steps.max():.3g} s, median {step:.3g} s): samples are taken in order, at the long-run rate",
            repeats=repeats,
        )
    start, step = line
    if rate is not None:
        seen = 1 / step
        if abs(seen / rate - 1) > 1e-3:
            book.add("clock", f"the clock says {seen:.6g} Hz, {rate:.6g} Hz was asked for", clock_hz=seen, rate_hz=rate)
        step = 1 / rate

    # The first of several samples in one slot stays.
    first = np.concatenate([[True], np.diff(slots) > 0])
    if trusted:
        if repeats:
            book.add("repeats", f"{repeats} timestamps repeat the one before; the first sample stays", samples=repeats)
        twice = int((~first).sum()) - repeats
        if twice > 0:
            book.add("repeats", f"{twice} samples fell on a taken place of the grid and were left out", samples=twice)
        _note_jitter(book, t - (start + step * slots), steps, step)
    slots, kept = slots[first], kept[first]
    start += step * float(slots[0])
    slots = slots - slots[0]
    if slots[-1] > _SPARSEST * slots.size + 1000:
        raise RecordingError(
            f"{source}: expected a recording without long pauses, found {slots.size} samples of {name} in "
            f"{slots[-1] * step:.6g} s at {1 / step:.6g} Hz; cut the log where the clock jumps"
        )
    _note_gaps(book, slots, step)
    return Grid(start, 1 / step, slots, kept, trusted, tuple(book.notes))


def regular_grid(n_samples: int, rate: float) -> Grid:
    """The grid of samples without timestamps."""
    every = np.arange(n_samples)
    return Grid(0.0, rate, every, every, False, ())


def _unwrap(t: Array, period: float | None) -> tuple[Array, int, float]:
    steps = np.diff(t)
    down = steps < 0
    if not down.any():
        return t, 0, 0.0
    step = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    periods = [period] if period else [2**32 * tick for tick in _TICKS.values()]
    for candidate in periods:
        wrapped = down & (np.abs(steps + candidate - step) < (candidate / 2 if period else 100 * step))
        if wrapped.any():
            return t + candidate * np.concatenate([[0], np.cumsum(wrapped)]), int(wrapped.sum()), candidate
    return t, 0, 0.0


def _on_line(t: Array, step: float, *, fixed: bool) -> tuple[Slots, tuple[float, float]]:
    """Nearest slot on one straight line, refined from the median step; line as (start, step)."""
    start = float(t[0])
    slots = np.rint(_count(t, step)).astype(np.int64)
    if not fixed:
        for _ in range(3):
            start, step = _fit_line(slots, t)
            slots = np.rint((t - start) / step).astype(np.int64)
    return slots, (start, step)


def _by_steps(t: Array, step: float) -> tuple[Slots, tuple[float, float]]:
    """As many slots on as each step holds, rounded."""
    slots = np.concatenate([[0], np.cumsum(np.rint(np.diff(t) / step))]).astype(np.int64)
    return slots, _fit_line(slots, t)


def _count(t: Array, step: float) -> Array:
    """Slots since the first sample; the mean of near-median steps keeps the count right over a long recording."""
    steps = np.diff(t)
    usual = steps[np.abs(steps - step) < 0.1 * step]
    return (t - t[0]) / (usual.mean() if usual.size else step)


def _fit_line(slots: Slots, t: Array) -> tuple[float, float]:
    """Least-squares line `t = start + step * slot`."""
    centred = slots - slots.mean()
    spread = float(centred @ centred)
    step = float(centred @ (t - t.mean())) / spread if spread else 0.0
    if not step > 0:
        return float(t[0]), float(np.median(np.diff(t)[np.diff(t) > 0]))
    return float(t.mean() - step * slots.mean()), step


def _flaws(slots: Slots) -> int:
    """Slots left empty plus samples without a slot of their own."""
    used = np.unique(slots)
    return int(slots.size - used.size) + int(used[-1] - used[0] + 1 - used.size)


def _note_jitter(book, residual: Array, steps: Array, step: float) -> None:  # type: ignore[no-untyped-def]
    usual = steps[(steps > 0.5 * step) & (steps < 1.5 * step)]
    if usual.size:
        rms, largest = float(usual.std()), float(np.abs(usual - step).max())
        if rms > 1e-3 * step:
            book.add(
                "jitter",
                f"steps between timestamps scatter by {1e3 * rms:.3g} ms rms ({100 * rms / step:.2g} % of a step), "
                f"at most {1e3 * largest:.3g} ms",
                rms_s=rms,
                largest_s=largest,
            )
    wander = float(np.abs(residual).max())
    if wander > 0.5 * step:
        book.add(
            "drift",
            f"the rate wanders: timestamps leave a straight line by up to {1e3 * wander:.3g} ms "
            f"({wander / step:.3g} steps)",
            largest_s=wander,
        )


def _note_gaps(book, slots: Slots, step: float) -> None:  # type: ignore[no-untyped-def]
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
