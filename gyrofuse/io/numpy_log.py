"""NumPy files: .npz recordings, .npz tables with named rows, .npy arrays.

An .npz file is one of two things.

- A recording: `gyro` (sensor, time), or (axis, sensor, time) with `axes`, and `fs`, `unit`, `sensors`, `time`; every
  other array of the same length is a channel, `temperature[imu2]` one of the sensor imu2. Where nothing is named
  `gyro`, `gyrofuse.io.arrays` says which names are understood.
- Tables, where `channels` names the rows (`gx`, `ay`, `temp`): arrays (channel, time), (device, channel, time), or
  time first. `units` and `scale` hold one value for all rows or one for each, and integers times `scale` are in
  `units`. What belongs to a table `a1` is named after it: a clock `a1_t_us` or, by its number, `ts1`, the ticks per
  second of which are `ts_hz`; a channel `a1_movement`. Names without an owner serve every table of their length.

Several tables are the devices of one recording where each holds one device and their clocks show that they ran
together: the clocks are the same, or they count from an instant before the recording and the time that all of
them cover is more than half of what any of them covers. Clocks that start at zero or are set back cannot show it.
Otherwise the tables are recordings on their own, and `key` must name one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.arrays import clock_in_seconds, settings_by_group, stated_rate, streams_from_arrays
from gyrofuse.io.columns import AXES, WRAP_32_BIT, canonical_unit, classify_columns, streams_from_columns
from gyrofuse.io.stream import Array, RecordingError, Stream

_Content = Mapping[str, NDArray[Any]]


def read(path: Path, *, key: str | None = None) -> list[Stream]:
    """Read the gyros of an .npz or .npy file.

    The longer dimension of an .npy array is time, the other one the sensors `"1"`, `"2"`, ...; it states no rate.
    Nothing that would have to be unpickled is read.

    Args:
        path: The file.
        key: Of an .npz file, the array that holds the gyros, whatever its name, or the table to read.

    Raises:
        RecordingError: Not a NumPy file, damaged, with objects, ambiguous, or without gyro data.
    """
    try:
        with path.open("rb") as file:  # opened here: np.load leaves a damaged archive open
            magic = file.read(6)
            if magic[:2] != b"PK" and magic != b"\x93NUMPY":
                raise RecordingError(
                    f"{path}: expected a NumPy file, found something else; save it with np.savez or np.save, or name "
                    "it by its format"
                )
            if magic[:2] != b"PK":
                return _bare_array(np.load(path, mmap_mode="r", allow_pickle=False), path, key)
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                content = {name: archive[name] for name in archive.files}
    except RecordingError:
        raise
    except Exception as error:  # a damaged file may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected a NumPy file of numbers and text, found one that cannot be read ({error}); "
            "save it again with np.savez or np.save, without objects"
        ) from error

    if "fs" in content and stated_rate(settings_by_group(content), "") is None:
        raise RecordingError(
            f"{path}: expected `fs` to be one sampling rate in Hz, found {content['fs']}; correct or leave it out"
        )
    if "gyro" not in content and content.get("channels", np.empty(0)).dtype.kind == "U":
        return _tables(content, path, key)
    return _recording(content, path, key)


def _bare_array(array: NDArray[Any], path: Path, key: str | None) -> list[Stream]:
    if array.dtype.kind not in "iuf" or array.ndim not in (1, 2) or max(array.shape) < 2 or array.size == 0:
        raise RecordingError(
            f"{path}: expected numbers (sensor, time) with at least 2 samples, found {array.dtype} {array.shape}; "
            "save real numbers in one or two dimensions"
        )
    if key is not None:
        raise RecordingError(f"{path}: expected no `key` for an .npy file, which holds one array, found {key!r}")
    rows = np.atleast_2d(array)
    rows = rows.T if rows.shape[0] > rows.shape[1] else rows
    names = [path.stem] if len(rows) == 1 else [str(number) for number in range(1, len(rows) + 1)]
    return [Stream(name, {"": np.array(row, np.float64)}) for name, row in zip(names, rows, strict=True)]


def _recording(content: _Content, path: Path, key: str | None) -> list[Stream]:
    """Streams of an .npz recording, or of arrays that only `gyrofuse.io.arrays` understands."""
    gyro = content.get("gyro")
    if gyro is None or key not in (None, "gyro"):
        return streams_from_arrays(content, path, key=key)
    if gyro.dtype.kind not in "iuf" or gyro.ndim not in (1, 2, 3) or gyro.shape[-1] < 2 or gyro.size == 0:
        raise RecordingError(
            f"{path}: expected `gyro` to be numbers (sensor, time) or (axis, sensor, time) with at least 2 samples, "
            f"found {gyro.dtype} {gyro.shape}; save it with time last"
        )
    axes = _axes(content, gyro, path) if gyro.ndim == 3 else [""]
    sensors = content.get("sensors", np.empty(0)).astype(str).ravel().tolist()
    rows = np.atleast_2d(gyro)
    # Names settle where time runs, however short the recording; without them the longer dimension is time.
    if gyro.ndim == 2 and len(sensors) != len(rows) > rows.shape[1]:
        rows = rows.T
    n_sensors, n_samples = rows.shape[-2:]
    notes = [] if len(sensors) in (0, n_sensors) else [f"{len(sensors)} sensor names do not fit {n_sensors} sensors"]
    if len({*sensors}) < len(sensors) or len(sensors) != n_sensors:
        sensors = [str(number) for number in range(1, n_sensors + 1)] if n_sensors > 1 else [path.stem]
    if (time := content.get("time")) is not None and time.size != n_samples:
        raise RecordingError(
            f"{path}: expected `time` of the length of `gyro` {gyro.shape}, found {time.shape}; save both of one length"
        )

    # A group per sensor is what several devices look like in other files.
    rates = rows.reshape(len(axes), n_sensors, n_samples)
    spread: dict[str, Any] = {f"{i}/gyro/{axis}": rates[k, i] for i in range(n_sensors) for k, axis in enumerate(axes)}
    if "fs" not in content:
        spread["time/unit"] = np.str_("s")  # with a rate beside it, the clock tells its unit itself
    own: list[dict[str, Array]] = [{} for _ in sensors]
    for name, value in content.items():
        if name in ("gyro", "sensors", "axes"):
            continue
        owner = next((sensor for sensor in sensors if name.endswith(f"[{sensor}]")), "")
        named_gyro = classify_columns(["gyro", name])[1].kind == "gyro"
        if not (named_gyro or owner):
            spread[name] = value
        elif value.dtype.kind in "biuf" and value.shape[-1:] == (n_samples,):
            # `temperature[imu2]` belongs to the sensor imu2; a second gyro is a channel.
            number, label = (sensors.index(owner), name.removesuffix(f"[{owner}]")) if owner else (0, name)
            own[number][label] = value.astype(np.float64)
    return [
        replace(stream, name=sensor, channels=stream.channels | channels, notes=(*stream.notes, *notes))
        for stream, sensor, channels in zip(streams_from_arrays(spread, path), sensors, own, strict=True)
    ]


def _axes(content: _Content, gyro: NDArray[Any], path: Path) -> list[str]:
    axes = [str(axis).strip().lower() for axis in content.get("axes", np.array(AXES[: gyro.shape[0]])).ravel()]
    if len(axes) != gyro.shape[0] or not {*axes} <= {*AXES} or len({*axes}) < len(axes):
        raise RecordingError(
            f"{path}: expected `gyro` (axis, sensor, time) and in `axes` which of x, y, z its axes are, "
            f"found {gyro.shape} and {axes}; save one name per axis"
        )
    return axes


@dataclass(frozen=True, eq=False)
class _Table:
    """One array with named rows and what belongs to it."""

    name: str
    values: NDArray[Any]  # (device, channel, time), as stored
    clock: Array | None
    clock_period: float | None
    channels: dict[str, Array]
    notes: tuple[str, ...]


def _tables(content: _Content, path: Path, key: str | None) -> list[Stream]:
    channels = [str(name) for name in content["channels"].ravel()]
    units = [canonical_unit(str(unit)) for unit in _per_channel(content, ("units", "unit"), "", channels, path)]
    scale = [float(factor) for factor in _per_channel(content, ("scale",), 1.0, channels, path)]
    values = {name: rows for name, value in content.items() if (rows := _by_device(value, len(channels))) is not None}
    if not values or len({*channels}) < len(channels) or "gyro" not in {c.kind for c in classify_columns(channels)}:
        found = ", ".join(f"{name} {value.shape}" for name, value in content.items() if value.ndim)
        raise RecordingError(
            f"{path}: expected arrays (channel, time) with the rows {', '.join(channels)} and a gyro (gx) among them, "
            f"found {found}; name each row once in `channels`"
        )
    if key is None:
        tables = [_table(name, values, content, path) for name in values]
        if len(tables) > 1 and not _ran_together(tables):
            raise RecordingError(
                f"{path}: expected one recording, found several recordings inside ({', '.join(values)}); name one "
                "with key= (--key NAME)"
            )
    else:
        names = [name for name in values if key in (name, _short(name, values))]
        if len(names) != 1:
            raise RecordingError(f"{path}: expected an array {key!r} (`key`), found {', '.join(values)}; name one")
        tables = [_table(names[0], values, content, path)]
    rate = stated_rate(settings_by_group(content), "")
    return [
        stream
        for table in tables
        for stream in _streams(
            table, path.stem if len(values) == 1 else _short(table.name, values), channels, units, scale, rate
        )
    ]


def _per_channel(
    content: _Content, names: Sequence[str], absent: Any, channels: Sequence[str], path: Path
) -> list[Any]:
    name = next((name for name in names if name in content), names[0])
    stated = content.get(name, np.array(absent)).ravel()
    if len(stated) not in (1, len(channels)) or (name == "scale" and stated.dtype.kind not in "iuf"):
        raise RecordingError(
            f"{path}: expected `{name}` to hold one value or one for each of {len(channels)} channels, "
            f"found {stated.dtype} {stated.shape}; correct it or leave it out"
        )
    return np.broadcast_to(stated, len(channels)).tolist()


def _by_device(value: NDArray[Any], n_channels: int) -> NDArray[Any] | None:
    """The array as `(device, channel, time)`, `None` when it is no table."""
    if value.dtype.kind not in "iuf" or value.ndim not in (2, 3):
        return None
    last, first = value, np.moveaxis(value, 0, -1)  # where time is
    fits = [rows for rows in (last, first) if rows.shape[-2] == n_channels and rows.shape[-1] > 1]
    rows = max(fits, key=lambda rows: rows.shape[-1], default=None)
    return rows[None] if rows is not None and rows.ndim == 2 else rows


def _short(name: str, names: Mapping[str, Any]) -> str:
    """The name of a table without the words that all tables begin with."""
    words = zip(*(other.split("_") for other in names), strict=False)
    n_common = len([*takewhile(lambda word: len({*word}) == 1, words)]) if len(names) > 1 else 0
    return "_".join(name.split("_")[n_common:]) or name


def _table(name: str, values: Mapping[str, NDArray[Any]], content: _Content, path: Path) -> _Table:
    """Gather what belongs to a table: what is named after it, and what is named after none and has its length."""
    length = values[name].shape[-1]
    number = re.search(r"\d*$", name)
    clocks: list[tuple[int, str, Any]] = []  # its own first
    channels: dict[str, Array] = {}
    notes: list[str] = []
    for other, value in content.items():
        owner = max((table for table in values if other.startswith(f"{table}_")), key=len, default="")
        if other in values or owner not in ("", name):
            continue
        label = other.removeprefix(f"{owner}_") if owner else other
        (column,) = classify_columns([label])
        if value.ndim == 0 and owner and value.dtype.kind == "U":
            notes.append(f"{other}: {value}")
        elif value.dtype.kind not in "biuf" or value.ndim not in (1, 2):
            continue
        elif value.ndim == 1 and column.kind == "time":
            numbered = bool(number and number[0] and column.device == number[0])
            if owner or numbered or (column.device == "" and (value.size == length or len(values) == 1)):
                clocks.append((0 if owner else 1 if numbered else 2, other, column))
        elif value.shape[-1] == length:
            channels[label] = value.astype(np.float64)
    if not clocks:
        return _Table(name, values[name], None, None, channels, tuple(notes))
    _, clock, column = min(clocks, key=lambda found: found[0])
    ticks = content[clock]
    if ticks.size != length:
        raise RecordingError(
            f"{path}: expected `{clock}` of the length of `{name}`, {length}, found {ticks.size}; "
            "save both of one length"
        )
    per_second = content.get(f"{clock.rstrip('0123456789')}_hz")
    if per_second is None:
        settings = settings_by_group(content)
        seconds, period, guess = clock_in_seconds(column, ticks.astype(np.float64), stated_rate(settings, ""), settings)
        notes += [guess] if guess else []
    else:
        hertz = float(per_second.item())
        seconds = ticks / hertz
        in_32_bit = ticks.dtype.kind in "iu" and ticks.min() >= 0 and ticks.max() < WRAP_32_BIT
        period = WRAP_32_BIT / hertz if in_32_bit else None
    return _Table(name, values[name], seconds, period, channels, tuple(notes))


def _ran_together(tables: Sequence[_Table]) -> bool:
    """Whether the tables are the devices of one recording; the module says when."""
    clocks = []
    for table in tables:
        if table.clock is None or len(table.values) > 1:
            return False
        clocks.append(table.clock[np.isfinite(table.clock)])
    if all(np.array_equal(clock, clocks[0]) for clock in clocks):
        return True
    if any(clock.size < 2 or np.any(np.diff(clock) < 0) for clock in clocks):
        return False
    first = np.array([clock[0] for clock in clocks])
    last = np.array([clock[-1] for clock in clocks])
    if np.all(first < 0.01 * (last - first)):  # seconds since each began
        return False
    return bool(last.min() - first.max() > 0.5 * (last.max() - first.min()))


def _streams(
    table: _Table,
    label: str,
    channels: Sequence[str],
    units: Sequence[str],
    scale: Sequence[float],
    rate: float | None,
) -> list[Stream]:
    columns = classify_columns(channels)
    unit = next(unit for unit, column in zip(units, columns, strict=True) if column.kind == "gyro")
    # A name that states a unit, as columns of text files do; that of a gyro may be a bare axis and stays so.
    stated = [
        f"{column.name} [{unit}]" if unit and column.kind not in ("", "gyro") else column.name
        for column, unit in zip(columns, units, strict=True)
    ]
    counts = table.values.dtype.kind in "iu"
    streams: list[Stream] = []
    for number, rows in enumerate(table.values, 1):
        values = {
            name: row * (factor if counts else 1.0)
            for name, row, factor in zip(stated, rows.astype(np.float64), scale, strict=True)
        }
        name = str(number) if len(table.values) > 1 else label
        first = len(streams)
        streams += streams_from_columns(
            values, name=name, unit=unit or "unknown", rate=rate, time=table.clock, notes=table.notes
        )
        other = {column.name: values[column.name] for column in columns if not column.kind}
        if first == 0:
            other |= table.channels
        streams[first] = replace(streams[first], channels=streams[first].channels | other)
    return [replace(stream, clock_period=table.clock_period) for stream in streams] if table.clock_period else streams
