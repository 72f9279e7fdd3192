"""Named arrays, as .mat, .h5 and .npz files hold them: sensors, clocks and channels by their names and shapes.

`streams_from_arrays` takes `{"name": array, "group/name": array}` and understands

- `gyro` or `acceleration` (sensor, time) with `sensors`, `fs`, `unit`, `time`: the names of an .npz recording;
- arrays whose names `gyrofuse.io.formats.columns` recognises (`imu_gyr`, `imu1/gyro`, `gx`), in either orientation: the
  longer dimension is time. Three rows are x, y, z; four rows of which the first or the last never decreases are a clock
  and x, y, z; any other number of rows are sensors. `sensors` names the rows whatever their number;
- sampling rate and unit beside an array or in the groups around it, the nearest first. An attribute is passed as a
  member of the array or group that it describes: `imu1/fs`, `imu1/gyro/unit`;
- every other array of the same length as a channel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gyrofuse._base.units import SECONDS_PER, canonical_unit
from gyrofuse.io.formats.column_streams import time_in_seconds
from gyrofuse.io.formats.columns import AXES, CHANNELS, Column, classify_columns, renamed
from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.settings import (
    Settings,
    nearest_names,
    own_unit,
    settings_by_group,
    stated_rate,
    stated_unit,
)
from gyrofuse.io.limits import LONGEST_NAME, MOST_DEVICES, enumerated
from gyrofuse.io.quantities import Quantity
from gyrofuse.io.streams import Array, RecordingError, Stream


def streams_from_arrays(content: Mapping[str, Any], request: Request) -> list[Stream]:
    """Build the streams of a file of named arrays.

    Args:
        content: Arrays, numbers and text by name. An array is anything with `shape` and `dtype` that NumPy converts; it
            is read only when needed.
        request: The file, whose stem names a device that the arrays do not name, and the part of it to read. Its `key`
            is the array that holds the sensors, whatever its name, or the group to look in.

    Raises:
        RecordingError: No array of the quantity, nothing of the name `key`, or too many sets of sensors.
    """
    path, key, quantity = request.path, request.key, request.quantity
    content = {name: value for name, value in content.items() if len(name) <= LONGEST_NAME}
    arrays = {name: value for name, value in content.items() if _length(value) > 1}
    settings = settings_by_group({name: value for name, value in content.items() if name not in arrays})
    if request.columns is not None:
        called = renamed(path, list(arrays), request.columns)
        arrays = {called[name]: value for name, value in arrays.items() if name in called}
    classified = {column.name: column for column in classify_columns(list(arrays), quantity)}
    if key is not None:
        classified = _select(classified, key.strip("/"), quantity)

    kinds = {column.kind for column in classified.values()}
    # Sensors of one length and one stated rate and unit share a clock and channels.
    alike: dict[tuple[int, float | None, str], list[str]] = {}
    for name, column in classified.items():
        if column.kind == quantity.name:
            unit = column.unit or stated_unit(settings, name, quantity, kinds)
            alike.setdefault((_length(arrays[name]), stated_rate(settings, name), unit), []).append(name)
    if not alike:
        shapes = {name: getattr(value, "shape", ()) for name, value in content.items()}
        found = enumerated(f"{name} {shape}" for name, shape in shapes.items() if set(shape) - {1}) or "no array"
        wanted = f"an array (sensor, time) with the name of {quantity.named}" + (f" in {key!r}" if key else "")
        advice = quantity.advice(kinds, "say with `key` which array holds the sensors")
        raise RecordingError(f"{path}: expected {wanted}, found {found}; {advice}")
    if len(alike) > MOST_DEVICES:
        raise RecordingError(
            f"{path}: expected sensors of a few rates and lengths, found {len(alike)} different ones; say with `key` "
            "which array holds the sensors"
        )
    beside: dict[int, list[str]] = {}
    for name, column in classified.items():
        if column.kind != quantity.name:
            beside.setdefault(_length(arrays[name]), []).append(name)
    streams: list[Stream] = []
    for (length, rate, unit), sensors in alike.items():
        rows = {name: _rows(arrays[name], length) for name in (*sensors, *beside.get(length, ()))}
        streams += _group(rows, classified, settings, path.stem, rate, unit, quantity)
    return streams


def _group(
    rows: Mapping[str, Array],
    columns: Mapping[str, Column],
    settings: Settings,
    stem: str,
    rate: float | None,
    unit: str,
    quantity: Quantity,
) -> list[Stream]:
    """Streams of arrays `(row, time)` of one length."""
    axes_of: dict[tuple[str, str], dict[str, Array]] = {}  # by device and sensor, then by axis
    clocks: dict[str, tuple[Array, float | None, str]] = {}
    beside: dict[str, Array] = {}
    notes: list[str] = []
    sensor_names = nearest_names(settings)
    for name, values in rows.items():
        column = columns[name]
        if column.kind == "time" and len(values) == 1:
            clocks.setdefault(column.device, clock_in_seconds(column, values[0], rate, settings))
            continue
        if column.kind != quantity.name:
            beside[name] = values
            continue
        sensors = sensor_names(name)
        if len(values) == 4 and len(sensors) != 4 and (row := _clock_row(values)) is not None:
            notes.append(f"row {row} of '{name}' never decreases and is read as its time")
            clocks[column.device] = clock_in_seconds(column, values[row], rate, settings)
            values = np.delete(values, row, axis=0)
        found: dict[tuple[str, str], dict[str, Array]]
        if len(values) == len(sensors):
            found = {(column.device, sensor): {"": row} for sensor, row in zip(sensors, values, strict=True)}
        elif len(values) in (1, 3):
            axes = AXES if len(values) == 3 else (column.axis,)
            found = {(column.device, ""): dict(zip(axes, values, strict=True))}
        else:
            label = column.device or stem
            found = {(column.device, f"{label}[{i}]"): {"": row} for i, row in enumerate(values)}
        if sensors and len(values) != len(sensors):
            notes.append(f"{len(sensors)} sensor names do not fit the {len(values)} rows of '{name}'")
        if any(not axes_of.get(owner, {}).keys().isdisjoint(signal) for owner, signal in found.items()):
            notes.append(f"'{name}' repeats an axis of the same device and is left out")
            continue
        for owner, signal in found.items():
            axes_of.setdefault(owner, {}).update(signal)

    channels = _channels(beside, columns, settings, [device for device, _ in axes_of])
    no_clock: tuple[Array | None, float | None, str] = (None, None, "")
    shared = clocks.get("") or (next(iter(clocks.values())) if len(clocks) == 1 else no_clock)
    streams = []
    for (device, sensor), signal in axes_of.items():
        time, period, guess = clocks.get(device) or shared
        # A channel goes with the first sensor of its device.
        of_device, units = channels.pop(device, ({}, {}))
        streams.append(
            Stream(
                name=sensor or device or stem,
                signal=signal,
                unit=unit,
                time=time,
                rate=rate,
                clock_period=period,
                channels=of_device,
                channel_units=units,
                notes=(*notes, *([guess] if guess else [])),
            )
        )
    return streams


def _channels(
    beside: Mapping[str, Array], columns: Mapping[str, Column], settings: Settings, devices: Sequence[str]
) -> dict[str, tuple[dict[str, Array], dict[str, str]]]:
    """Channels and their units by device; channels of no device with a sensor go with the first device."""
    axes: dict[tuple[str, str], dict[str, str]] = {}
    for name, values in beside.items():
        if columns[name].axis and len(values) == 1:
            axes.setdefault((columns[name].kind, columns[name].device), {})[columns[name].axis] = name
    triads = {found["x"]: found for found in axes.values() if found.keys() >= set(AXES)}
    merged = {found[axis] for found in triads.values() for axis in "yz"}

    known_devices = {*devices}
    channels: dict[str, tuple[dict[str, Array], dict[str, str]]] = {}
    for name, values in beside.items():
        if name in merged:
            continue
        column = columns[name]
        values = np.concatenate([beside[triads[name][axis]] for axis in AXES]) if name in triads else values
        known = column.kind in CHANNELS and len(values) == (1 if column.kind == "temperature" else 3)
        label = CHANNELS[column.kind] if known else name.rpartition("/")[2]
        owned, units = channels.setdefault(column.device if column.device in known_devices else devices[0], ({}, {}))
        if label in owned:
            label = name
        owned[label] = values[0] if len(values) == 1 else values
        if unit := column.unit or canonical_unit(own_unit(settings, name)):
            units[label] = unit
    return channels


def _select(columns: Mapping[str, Column], key: str, quantity: Quantity) -> dict[str, Column]:
    """Keep `key` as the only sensor, or the arrays in the group `key` and all clocks."""
    if key in columns:
        kept = {name: column for name, column in columns.items() if name == key or column.kind != quantity.name}
        return kept | {key: replace(columns[key], kind=quantity.name)}
    return {n: column for n, column in columns.items() if n.startswith(f"{key}/") or column.kind == "time"}


def _dimensions(value: Any) -> tuple[int, ...]:
    """Dimensions above one of a numeric array, none of anything else."""
    if getattr(getattr(value, "dtype", None), "kind", "O") not in "biuf":
        return ()
    return tuple(size for size in value.shape if size != 1)


def _length(value: Any) -> int:
    """Number of samples of an array of one or two dimensions, 0 of anything else."""
    dimensions = _dimensions(value)
    return max(dimensions) if len(dimensions) in (1, 2) and 0 not in dimensions else 0


def _rows(value: Any, length: int) -> Array:
    """The array as `(row, time)`; of a square one the last dimension is time."""
    values = np.asarray(value, dtype=np.float64).squeeze()
    values = values[None] if values.ndim == 1 else values
    return np.ascontiguousarray(values if values.shape[-1] == length else values.T)


def _clock_row(rows: Array) -> int | None:
    """First or last row when it advances and never decreases."""
    return next((i for i in (0, 3) if rows[i, -1] > rows[i, 0] and np.all(rows[i, 1:] >= rows[i, :-1])), None)


def clock_in_seconds(
    column: Column, ticks: Array, rate: float | None, settings: Settings
) -> tuple[Array, float | None, str]:
    """Convert a clock to seconds, with its unit from its name, its attribute or the sampling rate.

    Args:
        column: Meaning of the clock's name.
        ticks: Readings `(time,)`.
        rate: Sampling rate in Hz that the file states.
        settings: Numbers and text of the file, as `settings_by_group` arranges them.

    Returns:
        Seconds `(time,)`, the period after which the clock wraps (or `None`), and a sentence on the guess, if any.
    """
    unit = column.unit or own_unit(settings, column.name)
    return time_in_seconds(replace(column, unit=unit if unit in SECONDS_PER else ""), ticks, rate)
