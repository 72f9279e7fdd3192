"""Auxiliary channels that were recorded by a clock of their own."""

from __future__ import annotations

import numpy as np

from gyrofuse.io.streams import Array

# Steps of a channel, in its usual ones, from which on what lies between its samples is missing, not interpolated.
_WIDEST = 2.5


def at_samples(time: Array, own_time: Array, values: Array, name: str) -> tuple[Array, str]:
    """Interpolate a channel linearly to the samples of a device's signal.

    Args:
        time: Clock reading of each sample of the signal, seconds.
        own_time: Clock reading of each sample of the channel `(n,)`, seconds, by the same clock.
        values: The channel, `(..., n)`.
        name: The channel, for the note.

    Returns:
        The channel `(..., time)`, NaN outside its own samples and in their gaps, and the sentence that says so; an
        empty sentence where the clocks are the same.
    """
    if np.array_equal(time, own_time):
        return values, ""
    kept = np.flatnonzero(np.isfinite(own_time))
    ordered, first = np.unique(own_time[kept], return_index=True)
    ordered_values = values[..., kept[first]]
    resampled = np.full((*values.shape[:-1], time.size), np.nan)
    if ordered.size < 2:
        return resampled, f"{name} has fewer than two samples with a time of its own and is NaN"
    steps = np.diff(ordered)
    step = float(np.median(steps))
    after = np.clip(np.searchsorted(ordered, time), 1, ordered.size - 1)
    with np.errstate(invalid="ignore", over="ignore"):  # damaged times and values may be any number
        part = (time - ordered[after - 1]) / steps[after - 1]
        within = (part >= 0) & (part <= 1) & ((steps[after - 1] <= _WIDEST * step) | (part == 0) | (part == 1))
        after, part = after[within], part[within]
        between = ordered_values[..., after - 1] * (1 - part) + ordered_values[..., after] * part
    # At a sample of its own a channel is that sample, whatever its neighbour is.
    between = np.where(part == 0, ordered_values[..., after - 1], between)
    resampled[..., within] = np.where(part == 1, ordered_values[..., after], between)
    return resampled, (
        f"{name} has its own clock ({1 / step:.4g} Hz): interpolated linearly to the signal's samples, NaN outside "
        "its own and in their gaps"
    )
