"""Readings of a clock put right: wraps of its counter, set-backs, readings that are none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gyrofuse._base.units import SECONDS_PER, SECONDS_PER_HOUR
from gyrofuse.io.limits import is_rate
from gyrofuse.io.streams import Array, Notebook, RecordingError

Slots = NDArray[np.int64]

DAY = (
    24 * SECONDS_PER_HOUR
)  # period in seconds of a clock of times of day; a day with a leap second is longer, and rare
COUNTER_32_BIT = 2.0**32  # period in ticks of a clock that is stored in 32 bits


def advancing_readings(time: Array, clock_period: float | None, source: str, book: Notebook) -> tuple[Array, Slots]:
    """Readings of a clock that never step back, and the indices of their samples in the log.

    Args:
        time: Clock reading of each sample in seconds; may wrap, repeat, jump or be NaN.
        clock_period: Seconds after which the clock wraps, when known.
        source: The file, for errors.
        book: Notes on the device, to which findings are added.

    Raises:
        RecordingError: Fewer than two usable timestamps, or none that advances.
    """
    farthest = 2.0**53  # seconds, and steps, beyond which float64 does not distinguish one from the next
    kept = np.flatnonzero(np.isfinite(time))
    if kept.size < time.size:
        lost = time.size - kept.size
        book.add("clock", f"{lost} samples without a timestamp were left out", samples=lost)
    if kept.size and (far := float(np.abs(time[kept]).max())) >= farthest:
        raise RecordingError(
            f"{source}: expected timestamps of a clock, found one of {far:.3g} s in {book.stream}; correct it or "
            "remove its sample"
        )
    t, n_wraps, period = _unwrap(time[kept], clock_period)
    if n_wraps:
        book.add("wraps", f"the clock wrapped {n_wraps} times, every {period:.6g} s; unwrapped", wraps=n_wraps)
    if np.count_nonzero(np.diff(t) < 0) > t.size / 2:
        raise RecordingError(
            f"{source}: expected timestamps that advance, found that they mostly run backwards in {book.stream}; sort "
            "the log"
        )
    t = _undo_set_backs(t, book)
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
    usual, span = float(np.median(steps[steps > 0])), float(t[-1] - t[0])
    if not (is_rate(1 / usual) and span / usual < farthest):
        raise RecordingError(
            f"{source}: expected timestamps of a clock, found steps of {usual:.3g} s in {span:.3g} s of {book.stream}; "
            "correct the timestamps, or give the rate with rate= (--rate HZ) and a file without them"
        )
    return t, kept


def _unwrap(t: Array, period: float | None) -> tuple[Array, int, float]:
    steps = np.diff(t)
    down = steps < 0
    if not down.any():
        return t, 0, 0.0
    step = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    periods = [period] if period else [COUNTER_32_BIT * SECONDS_PER[unit] for unit in ("us", "ms", "ns")]
    for candidate in periods:
        wrapped = down & (np.abs(steps + candidate - step) < (candidate / 2 if period else 100 * step))
        if wrapped.any():
            return t + candidate * np.concatenate([[0], np.cumsum(wrapped)]), int(wrapped.sum()), candidate
    return t, 0, 0.0


def _undo_set_backs(t: Array, book: Notebook) -> Array:
    """Close the gap of a clock that was set back, which is one that stays behind for more than 100 samples.

    A clock that steps back more than 100 times is not one that was set, and stays as it is.
    """
    n_behind, most = 100, 100
    if (np.diff(t) < 0).sum() > most:
        return t
    for here in (np.flatnonzero(np.diff(t) < 0) + 1).tolist():
        highest = t[:here].max()
        behind = t[here:] < highest
        if behind[:n_behind].all() and behind.size > n_behind:
            step = float(np.median(np.abs(np.diff(t))))
            back = t[here - 1] - t[here]
            t = np.concatenate([t[:here], t[here:] + back + step])
            book.add("clock", f"the clock was set back by {back:.6g} s; taken to go on without a gap", seconds=back)
    return t
