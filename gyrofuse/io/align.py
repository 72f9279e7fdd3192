"""Several devices on one grid: clocks are aligned to the nearest sample, only auxiliary channels are interpolated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gyrofuse.io.clock import Grid
from gyrofuse.io.streams import Array, Note, Notebook, RecordingError
from gyrofuse.io.timestamps import Slots


@dataclass(frozen=True, eq=False)
class Placed:
    """The samples of one device on the common grid.

    Attributes:
        slots: Slot of each kept sample on the common grid.
        kept: Index of each kept sample in the log.
        n_slots: Length of the common grid.
    """

    slots: Slots
    kept: Slots
    n_slots: int

    def on_grid(self, values: Array) -> Array:
        """Values on the common grid, `(..., slot)`, NaN in slots without a sample.

        Args:
            values: Values of the log, `(..., time)`.
        """
        if self.n_slots == values.shape[-1] == self.kept.size:
            return values
        placed = np.full((*values.shape[:-1], self.n_slots), np.nan)
        placed[..., self.slots] = values[..., self.kept]
        return placed


def align(grids: Sequence[Grid], names: Sequence[str], source: str) -> tuple[list[Placed], float, list[Note]]:
    """Bring devices to the grid of the first, cut to the time that all cover.

    Args:
        grids: The devices' own grids. Clocks are taken to share an epoch; devices without trusted timestamps start
            together.
        names: The devices.
        source: The files, for errors.

    Returns:
        Position of each device on the common grid, the common rate in Hz, and notes on offsets and cuts.

    Raises:
        RecordingError: Rates differ by more than half a per cent, or the devices were not recorded together.
    """
    reference = grids[0]
    rate = reference.rate
    # Clocks differ by 0.01 %, nominal rates of devices by more than this: 100 and 102.4 Hz, say.
    tolerance = 5e-3
    for grid, name in zip(grids, names, strict=True):
        if abs(grid.rate / rate - 1) > tolerance:
            raise RecordingError(
                f"{source}: expected one sampling rate, found {rate:.6g} Hz in {names[0]} and {grid.rate:.6g} Hz in "
                f"{name}; resample them to one rate, or fuse devices of one rate"
            )
    if all(grid is reference for grid in grids):
        return [Placed(reference.slots, reference.kept, reference.n_slots)] * len(grids), rate, []
    clocked = all(grid.trusted for grid in grids)
    notes = [] if clocked else [_no_clock(grids, names)]
    slots = []
    for grid, name in zip(grids, names, strict=True):
        book = Notebook(name)
        offset = (grid.start - reference.start) * rate if clocked else 0.0
        slip = (grid.n_slots - 1) * (rate / grid.rate - 1) if clocked else 0.0
        if abs(slip) < 0.5:
            # Half the slip on either side of the middle of the recording.
            shift = round(offset + slip / 2)
            slots.append(grid.slots + shift)
        else:
            slots.append(np.rint(offset + grid.slots * (rate / grid.rate)).astype(np.int64))
            book.add(
                "drift",
                f"its clock slips {abs(slip):.3g} samples against that of {names[0]}: samples are repeated in place or "
                "left out where it slips",
                samples=slip,
            )
        seen = 0.005  # of a step: what is printed of it
        if clocked and grid is not reference and max(abs(offset), abs(slip)) >= seen:
            rest = offset + slip / 2 - round(offset + slip / 2)
            book.add(
                "offset",
                f"starts {1e3 * offset / rate:+.6g} ms from {names[0]}; placed to the nearest sample, "
                f"{1e3 * rest / rate:+.3g} ms ({rest:+.2f} of a step) off",
                offset_s=offset / rate,
                residual_s=rest / rate,
            )
        notes += book.notes
    first = max(int(s[0]) for s in slots)
    last = min(int(s[-1]) for s in slots)
    if last - first < 1:
        spans = "; ".join(
            f"{name} {grid.start:.6g} to {grid.end:.6g} s" for name, grid in zip(names[:6], grids, strict=False)
        )
        raise RecordingError(
            f"{source}: expected devices recorded at the same time, found clocks that do not overlap ({spans}); "
            "give files of one recording, or leave the timestamps out to align them at their first samples"
        )
    placed = []
    for grid, name, own in zip(grids, names, slots, strict=True):
        inside = (own >= first) & (own <= last)
        before, after = int((own < first).sum()), int((own > last).sum())
        if before or after:
            notes.append(
                Note(
                    "cut",
                    name,
                    f"{before} samples ({before / rate:.4g} s) at the start and {after} ({after / rate:.4g} s) at the "
                    "end lie outside the time that all devices cover and were cut",
                    {"start_samples": float(before), "end_samples": float(after)},
                )
            )
        own, kept = own[inside] - first, grid.kept[inside]
        # Where a clock slips, two samples may fall into one slot: the first is kept.
        alone = np.concatenate([[True], np.diff(own) > 0])
        placed.append(Placed(own[alone], kept[alone], last - first + 1))
    return placed, rate, notes


def _no_clock(grids: Sequence[Grid], names: Sequence[str]) -> Note:
    which = ", ".join(name for grid, name in zip(grids, names, strict=True) if not grid.trusted)
    return Note("offset", "", f"no usable timestamps in {which}: all devices are taken to start at their first samples")


def at_samples(time: Array, own_time: Array, values: Array, name: str) -> tuple[Array, str]:
    """Interpolate a channel linearly to the samples of a device's signal.

    Args:
        time: Clock reading of each sample of the signal, seconds.
        own_time: Clock reading of each sample of the channel `(n,)`, seconds, by the same clock.
        values: The channel, `(..., n)`.
        name: The channel, for the note.

    Returns:
        The channel `(..., time)`, NaN outside its own samples and in gaps of more than 2.5 of its typical steps, and a
        note that says so; an empty note where the clocks are the same.
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
    widest = 2.5  # typical steps of the channel: a single missing sample, with jitter, is bridged, two are not
    with np.errstate(invalid="ignore", over="ignore"):  # damaged times and values may be any number
        part = (time - ordered[after - 1]) / steps[after - 1]
        within = (part >= 0) & (part <= 1) & ((steps[after - 1] <= widest * step) | (part == 0) | (part == 1))
        after, part = after[within], part[within]
        between = ordered_values[..., after - 1] * (1 - part) + ordered_values[..., after] * part
    # At a sample of its own a channel is that sample, whatever its neighbour is.
    between = np.where(part == 0, ordered_values[..., after - 1], between)
    resampled[..., within] = np.where(part == 1, ordered_values[..., after], between)
    return resampled, (
        f"{name} has its own clock ({1 / step:.4g} Hz): interpolated linearly to the signal's samples, NaN outside "
        "its own and in their gaps"
    )
