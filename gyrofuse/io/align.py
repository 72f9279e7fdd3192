"""Several devices on one grid: clocks are aligned to the nearest sample, never resampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gyrofuse.io.clock import Grid, Slots
from gyrofuse.io.notes import Note, Notebook
from gyrofuse.io.streams import Array, RecordingError

_RATE_TOLERANCE = 5e-3


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

    def spread(self, values: Array) -> Array:
        """Put `(..., time)` of the log on the grid, `(..., slot)`, NaN where no sample is."""
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
        Each device on the common grid, the common rate in Hz, and notes on offsets and cuts.

    Raises:
        RecordingError: Rates differ by more than half a per cent, or the devices were not recorded together.
    """
    reference = grids[0]
    rate = reference.rate
    for grid, name in zip(grids, names, strict=True):
        if abs(grid.rate / rate - 1) > _RATE_TOLERANCE:
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
        if clocked and grid is not reference:
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
        # Where a clock slips, two samples may meet in one slot: the first stays.
        alone = np.concatenate([[True], np.diff(own) > 0])
        placed.append(Placed(own[alone], kept[alone], last - first + 1))
    return placed, rate, notes


def _no_clock(grids: Sequence[Grid], names: Sequence[str]) -> Note:
    which = ", ".join(name for grid, name in zip(grids, names, strict=True) if not grid.trusted)
    return Note("offset", "", f"no usable timestamps in {which}: all devices are taken to start at their first samples")
