"""From the streams of one or several logs to the array of a recording."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse._base.checks import same_rate
from gyrofuse._base.units import KNOWN_UNITS, known_unit, unit_factor
from gyrofuse.io.align import Placed, align
from gyrofuse.io.clock import Grid, grid_of, regular_grid
from gyrofuse.io.formats import read_streams
from gyrofuse.io.formats.columns import AXES, CHANNELS
from gyrofuse.io.formats.request import Request
from gyrofuse.io.limits import printable
from gyrofuse.io.quantities import QUANTITY
from gyrofuse.io.streams import Array, Note, RecordingError, Stream, unexpected

_UNKNOWN = "unknown"  # the unit of a log that states none


@dataclass(frozen=True, eq=False)
class Assembled:
    """An array on a uniform grid: `signal` is `(sensor, time)`, or `(axis, sensor, time)` with named `axes`."""

    signal: Array
    rate: float
    unit: str
    sensors: tuple[str, ...]
    axes: tuple[str, ...]
    channels: dict[str, Array]
    notes: tuple[Note, ...]


def assemble(
    requests: Sequence[Request],
    *,
    axis: str | None,
    rate: float | None,
    unit: str | None,
    scale: float | None,
    mounting: Mapping[str, Any] | str | Path | None,
) -> Assembled:
    """Read the logs and put their devices on one grid; arguments and errors as `gyrofuse.read_recording`."""
    source = ", ".join(str(request.path) for request in requests)
    read = [(request.path, read_streams(request)) for request in requests]
    streams = _named(read)
    streams = _mount([_printable(stream) for stream in streams], mounting, source)
    try:
        return _on_one_grid(streams, source, axis=axis, rate=rate, unit=unit, scale=scale)
    except RecordingError:
        raise
    except Exception as error:  # the effects of damaged numbers are not all foreseen
        raise unexpected(source, error) from error


def _printable(stream: Stream) -> Stream:
    """The stream with names that can be written in any encoding, however the log wrote them."""
    return replace(
        stream,
        name=printable(stream.name),
        unit=printable(stream.unit),
        channels={printable(name): values for name, values in stream.channels.items()},
        channel_units={printable(name): printable(unit) for name, unit in stream.channel_units.items()},
        notes=tuple(map(printable, stream.notes)),
    )


def _on_one_grid(
    streams: list[Stream],
    source: str,
    *,
    axis: str | None,
    rate: float | None,
    unit: str | None,
    scale: float | None,
) -> Assembled:
    notes = [Note("reader", stream.name, sentence) for stream in streams for sentence in stream.notes]
    streams, axes = _choose_axes(streams, axis, source)
    grids = _grids(streams, rate, source)
    for grid in dict.fromkeys(grids):
        notes += grid.notes
    notes += _overruled(streams, rate)
    placed, common_rate, align_notes = align(grids, [stream.name for stream in streams], source)
    notes += align_notes

    units, factors, unit_notes = _units(streams, unit, scale, source)
    notes += unit_notes
    notes += [note for stream in streams for note in _flaws(stream)]
    devices = list(zip(streams, placed, factors, strict=True))
    if axes:
        signal = np.stack([np.stack([_clean(s, axis, p, f) for s, p, f in devices]) for axis in axes])
    else:
        signal = np.stack([_clean(s, axis, p, f) for s, p, f in devices for axis in s.signal])
    sensors = tuple(stream.name for stream in streams)
    return Assembled(signal, common_rate, units, sensors, axes, _channels(streams, placed), tuple(notes))


def _named(read: Sequence[tuple[Path, list[Stream]]]) -> list[Stream]:
    """Streams of all files, with the file's stem in front of names that appear in several."""
    names = Counter(stream.name for _, streams in read for stream in streams)
    stems = Counter(path.stem for path, _ in read)
    named = []
    for position, (path, streams) in enumerate(read, 1):
        stem = path.stem if stems[path.stem] == 1 else f"{path.stem}#{position}"
        for stream in streams:
            if names[stream.name] == 1:
                named.append(stream)
            else:
                named.append(replace(stream, name=stem if len(streams) == 1 else f"{stem}/{stream.name}"))
    return named


def _mount(streams: list[Stream], mounting: Mapping[str, Any] | str | Path | None, source: str) -> list[Stream]:
    """Rotate the axes of each device to those of the array."""
    if mounting is None:
        return streams
    if isinstance(mounting, str | Path):
        try:
            mounting = json.loads(Path(mounting).read_text())
        except (OSError, ValueError) as error:
            raise ValueError(
                f"`mounting`: expected a JSON file of {{device: 3 x 3 matrix}}, got {mounting}: {error}"
            ) from error
    if not isinstance(mounting, Mapping):
        raise ValueError(f"`mounting`: expected {{device: 3 x 3 matrix}}, got {type(mounting).__name__}")
    unknown = sorted(map(str, set(mounting) - {stream.name for stream in streams}))
    if unknown:
        known = ", ".join(stream.name for stream in streams)
        raise ValueError(f"`mounting`: no device {', '.join(unknown)} in {source}; there are {known}")
    turned = []
    for stream in streams:
        if stream.name not in mounting:
            turned.append(stream)
            continue
        try:
            matrix = np.asarray(mounting[stream.name], dtype=np.float64)
        except (TypeError, ValueError):
            matrix = np.empty(0)
        if matrix.shape != (3, 3) or not _is_rotation(matrix):
            raise ValueError(
                f"`mounting`: expected a 3 x 3 rotation matrix for {stream.name}, got {mounting[stream.name]}"
            )
        if set(stream.signal) != set(AXES):
            raise ValueError(
                f"`mounting`: expected axes x, y, z in {stream.name}, found {', '.join(stream.signal) or 'none'}"
            )
        rotated = matrix @ np.stack([stream.signal[a] for a in AXES])
        channels = {
            name: matrix @ values if name in CHANNELS.values() and values.ndim == 2 else values
            for name, values in stream.channels.items()
        }
        turned.append(replace(stream, signal=dict(zip(AXES, rotated, strict=True)), channels=channels))
    return turned


def _is_rotation(matrix: Array) -> bool:
    """Whether a matrix is orthogonal and no reflection, which would change the sign of rates."""
    return np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6) and bool(np.linalg.det(matrix) > 0)


def _choose_axes(streams: list[Stream], axis: str | None, source: str) -> tuple[list[Stream], tuple[str, ...]]:
    """Streams with the chosen axis alone, or with all axes, and the names of the leading dimension."""
    if axis is not None:
        lacking = [stream for stream in streams if axis not in stream.signal]
        if lacking:
            found = ", ".join(name for name in lacking[0].signal if name) or "axes without names"
            raise RecordingError(
                f"{source}: expected axis {axis!r} in every device, found {found} in {lacking[0].name}; "
                "choose one of those, or none"
            )
        return [replace(stream, signal={axis: stream.signal[axis]}) for stream in streams], ()
    sets = {tuple(sorted(stream.signal)) for stream in streams}
    if len(sets) > 1:
        found = "; ".join(f"{stream.name}: {', '.join(stream.signal)}" for stream in streams[:4])
        raise RecordingError(
            f"{source}: expected the same axes in every device, found {found}; choose one with axis= (--axis z)"
        )
    (axes,) = sets
    return streams, axes if len(axes) > 1 else ()


def _grids(streams: Sequence[Stream], rate: float | None, source: str) -> list[Grid]:
    """The grid of each device; devices that share a clock share one."""
    known: dict[tuple[float, ...], Grid] = {}
    grids = []
    for stream in streams:
        if stream.n_samples < 2:
            raise RecordingError(f"{source}: expected at least 2 samples of {stream.name}, found {stream.n_samples}")
        stated = stream.rate if rate is None else rate
        if stream.time is None and (stated is None or not stated > 0):
            found = "neither" if stated is None else f"a rate of {stated!r}"
            found += f" ({'; '.join(stream.notes)})" if stream.notes else ""
            raise RecordingError(
                f"{source}: expected timestamps or a sampling rate, found {found}; give the rate with rate= (--rate HZ)"
            )
        if stream.time is None and stated is not None:
            identity = (stream.n_samples, stated)
            grid = known.get(identity) or regular_grid(stream.n_samples, stated)
        else:
            identity = (id(stream.time), -1.0)
            grid = known.get(identity) or grid_of(
                np.asarray(stream.time, dtype=np.float64),
                name=stream.name,
                source=source,
                clock_period=stream.clock_period,
                rate=rate,
                nominal=stream.rate,
            )
        known[identity] = grid
        grids.append(grid)
    return grids


def _overruled(streams: Sequence[Stream], rate: float | None) -> list[Note]:
    """Notes on rates that logs without timestamps state, where another rate was requested."""
    stated = dict.fromkeys(s.rate for s in streams if rate and s.rate and s.time is None)
    return [
        Note("clock", "", f"the log states {other:.6g} Hz, {rate:.6g} Hz was asked for")
        for other in stated
        if other and rate and not same_rate(other, rate)
    ]


def _units(
    streams: Sequence[Stream], unit: str | None, scale: float | None, source: str
) -> tuple[str, list[float], list[Note]]:
    """The common unit, the factor that converts each device to it, and notes on assumptions."""
    if unit is not None:
        unit = known_unit("unit", unit)
    if scale is not None:
        name = unit or _UNKNOWN
        return name, [scale] * len(streams), [Note("unit", "", f"numbers of the log times {scale:g} are {name}")]
    stated = [stream.unit for stream in streams]
    strange = next((stream for stream in streams if stream.unit not in (*KNOWN_UNITS, _UNKNOWN)), None)
    if strange is not None:
        raise RecordingError(
            f"{source}: expected one of the units {', '.join(KNOWN_UNITS)}, found {strange.unit[:80]!r} "
            f"in {strange.name}; give one with unit= (--unit), and with scale= (--scale) the factor that "
            "brings the numbers of the log to it"
        )
    target = unit or next((u for u in stated if u != _UNKNOWN), _UNKNOWN)
    factors, notes = [], []
    for stream in streams:
        if stream.unit in (_UNKNOWN, target):
            factors.append(1.0)
            if stream.unit != target:
                notes.append(Note("unit", stream.name, f"the log states no unit; its numbers are taken as {target}"))
            continue
        try:
            factors.append(unit_factor(stream.unit, target))
        except ValueError as error:
            raise RecordingError(
                f"{source}: expected one unit, found {stream.unit} in {stream.name}, which is no {target}; "
                "give the factor with scale= (--scale) and the unit with unit= (--unit)"
            ) from error
        notes.append(Note("unit", stream.name, f"converted from {stream.unit} to {target}"))
    return target, factors, notes


def _flaws(stream: Stream) -> list[Note]:
    """Notes on samples of a device that are not measured values."""
    notes = []
    missing = {axis: int((~np.isfinite(values)).sum()) for axis, values in stream.signal.items()}
    if any(missing.values()):
        which = ", ".join(f"{count} on {axis}" if axis else str(count) for axis, count in missing.items() if count)
        total = float(sum(missing.values()))
        notes.append(Note("non_finite", stream.name, f"samples that are not finite: {which}; NaN", {"samples": total}))
    if _starts_from_zero(stream):
        notes.append(Note("startup", stream.name, "the first sample is zero on every axis, as on starting up; NaN"))
    return notes


def _clean(stream: Stream, axis: str, place: Placed, factor: float) -> Array:
    """One axis of a device on the common grid in the common unit, samples that are not measured values as NaN."""
    values = np.asarray(stream.signal[axis], dtype=np.float64)
    startup = _starts_from_zero(stream)
    if startup or not np.isfinite(values).all():
        values = np.where(np.isfinite(values), values, np.nan)
    if startup:
        values[0] = np.nan
    placed = place.on_grid(values)
    return placed * factor if factor != 1.0 else placed


def _starts_from_zero(stream: Stream) -> bool:
    """Whether a device that has measured something else reports a first row of zeros."""
    rows = [values[:2] for values in stream.signal.values()]
    for quantity in QUANTITY.values():
        if quantity.channel in stream.channels:
            rows += list(stream.channels[quantity.channel][:, :2])
    return len(rows) > 1 and all(row[0] == 0 for row in rows) and all(row[1] != 0 for row in rows)


def _channels(streams: Sequence[Stream], placed: Sequence[Placed]) -> dict[str, Array]:
    """Auxiliary channels on the common grid; a channel of several devices carries the device's name."""
    carriers = Counter(name for stream in streams for name in stream.channels)
    return {
        name if carriers[name] == 1 else f"{name}[{stream.name}]": place.on_grid(np.asarray(values, dtype=np.float64))
        for stream, place in zip(streams, placed, strict=True)
        for name, values in stream.channels.items()
    }
