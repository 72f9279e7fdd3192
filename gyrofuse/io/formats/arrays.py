"""Named arrays, as .mat, .h5 and .npz files hold them: which are the sensors, where time runs, what belongs to them.

`streams_from_arrays` takes `{"name": array, "group/name": array}` and understands

- `gyro` or `acceleration` (sensor, time) with `sensors`, `fs`, `unit`, `time`: the names of an .npz recording;
- arrays whose names `gyrofuse.io.formats.columns` recognises (`imu_gyr`, `imu1/gyro`, `gx`), in either orientation: the
  longer dimension is time. Three rows are x, y, z; four of which the first or the last never decreases are a
  clock and x, y, z; any other number are sensors. `sensors` names the rows whatever their number;
- sampling rate and unit beside an array or in the groups around it, the nearest first. An attribute is handed
  over as a member of what it describes: `imu1/fs`, `imu1/gyro/unit`;
- every other array of the same length as a channel.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse._base.units import canonical_unit, quantity_of
from gyrofuse.io.formats.column_streams import time_in_seconds
from gyrofuse.io.formats.columns import AXES, CHANNELS, NAMES_OF, TICK, Column, classify_columns, or_else, renamed
from gyrofuse.io.limits import LONGEST_NAME, decoded, enumerated, is_rate
from gyrofuse.io.streams import Array, RecordingError, Stream

_RATE = (
    "fs",
    "rate",
    "samplingrate",
    "samplerate",
    "samplingfrequency",
    "samplefrequency",
    "samplefreq",
    "outputrate",
    "updaterate",
)
_UNIT = ("unit", "units")
_SENSORS = ("sensors", "sensornames")
# Sets of arrays of one length, rate and unit in one file; each set is read with all arrays of its length.
_MOST_SETS = 256
# By the group that holds it ("" is the file) and its name in lower case letters.
_Settings = Mapping[tuple[str, str], Any]


def streams_from_arrays(
    content: Mapping[str, Any],
    path: Path,
    *,
    key: str | None = None,
    quantity: str = "rate",
    columns: Mapping[str, str] | None = None,
) -> list[Stream]:
    """Build the streams of a file of named arrays.

    Args:
        content: Arrays, numbers and text by name. An array is anything with `shape` and `dtype` that NumPy
            converts; it is read only when needed.
        path: The file; its stem names a device that the arrays do not name.
        key: The array that holds the sensors, whatever its name, or the group to look in.
        quantity: `"rate"` or `"acceleration"`: the sensors to read.
        columns: What arrays are, where their names do not say: these by the names that they should have; the others are
            left out.

    Raises:
        RecordingError: None of the quantity among the arrays, or nothing of the name `key`.
    """
    content = {name: value for name, value in content.items() if len(name) <= LONGEST_NAME}
    arrays = {name: value for name, value in content.items() if _length(value) > 1}
    settings = settings_by_group({name: value for name, value in content.items() if name not in arrays})
    if columns is not None:
        called = renamed(path, list(arrays), columns)
        arrays = {called[name]: value for name, value in arrays.items() if name in called}
    classified = {column.name: column for column in classify_columns(list(arrays), quantity)}
    if key is not None:
        classified = _select(classified, key.strip("/"), quantity)

    kinds = {column.kind for column in classified.values()}
    # Sensors of one length and one stated rate and unit share a clock and channels.
    alike: dict[tuple[int, float | None, str], list[str]] = {}
    for name, column in classified.items():
        if column.kind == quantity:
            unit = column.unit or stated_unit(settings, name, quantity, kinds)
            alike.setdefault((_length(arrays[name]), stated_rate(settings, name), unit), []).append(name)
    if not alike:
        shapes = {name: getattr(value, "shape", ()) for name, value in content.items()}
        found = enumerated(f"{name} {shape}" for name, shape in shapes.items() if set(shape) - {1}) or "no array"
        wanted = f"an array (sensor, time) with the name of {NAMES_OF[quantity]}" + (f" in {key!r}" if key else "")
        advice = or_else(kinds, quantity, "say with `key` which array holds the sensors")
        raise RecordingError(f"{path}: expected {wanted}, found {found}; {advice}")
    if len(alike) > _MOST_SETS:
        raise RecordingError(
            f"{path}: expected sensors of a few rates and lengths, found {len(alike)} different ones; say with `key` "
            "which array holds the sensors"
        )
    beside: dict[int, list[str]] = {}
    for name, column in classified.items():
        if column.kind != quantity:
            beside.setdefault(_length(arrays[name]), []).append(name)
    streams: list[Stream] = []
    for (length, rate, unit), sensors in alike.items():
        rows = {name: _rows(arrays[name], length) for name in (*sensors, *beside.get(length, ()))}
        streams += _group(rows, classified, settings, path.stem, rate, unit, quantity)
    return streams


def _group(
    rows: Mapping[str, Array],
    columns: Mapping[str, Column],
    settings: _Settings,
    stem: str,
    rate: float | None,
    unit: str,
    quantity: str,
) -> list[Stream]:
    """Streams of arrays `(row, time)` of one length."""
    axes_of: dict[tuple[str, str], dict[str, Array]] = {}  # by device and sensor, then by axis
    clocks: dict[str, tuple[Array, float | None, str]] = {}
    beside: dict[str, Array] = {}
    notes: list[str] = []
    names_in: dict[int, list[str]] = {}  # by the identity of the setting, which many arrays share
    for name, values in rows.items():
        column = columns[name]
        if column.kind == "time" and len(values) == 1:
            clocks.setdefault(column.device, clock_in_seconds(column, values[0], rate, settings))
            continue
        if column.kind != quantity:
            beside[name] = values
            continue
        setting = _nearest(settings, name, _SENSORS)
        if id(setting) not in names_in:
            names_in[id(setting)] = list(dict.fromkeys(_texts(setting)))
        sensors = names_in[id(setting)]
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
    beside: Mapping[str, Array], columns: Mapping[str, Column], settings: _Settings, devices: Sequence[str]
) -> dict[str, tuple[dict[str, Array], dict[str, str]]]:
    """Channels and their units by device; what belongs to no device with a sensor goes with the first."""
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
        if unit := column.unit or canonical_unit(_own_unit(settings, name)):
            units[label] = unit
    return channels


def settings_by_group(values: Mapping[str, Any]) -> _Settings:
    """Arrange numbers and text by the group that holds them and their name in lower case letters."""
    settings = {}
    for path, value in values.items():
        group, _, name = path.rpartition("/")
        letters = "".join(letter for letter in name.lower() if "a" <= letter <= "z")
        settings[group, letters.removesuffix("hz")] = value
    return settings


def stated_rate(settings: _Settings, name: str) -> float | None:
    """Return the sampling rate in Hz that is stated nearest to the array `name`, `None` where there is none."""
    value = _nearest(settings, name, _RATE)
    if np.iscomplexobj(value):
        return None
    try:
        rate = float(_text(value) or np.asarray(value, dtype=np.float64).item())
    except (TypeError, ValueError):
        return None
    return rate if is_rate(rate) else None


def stated_unit(settings: _Settings, name: str, quantity: str, kinds: Collection[str]) -> str:
    """Return the unit that is stated nearest to the array `name`, `"unknown"` where there is none.

    A unit of the other quantity that stands in a group around the array is that of other arrays, if there are any.

    Args:
        settings: What the file states.
        name: Of the array, or of the group that holds it.
        quantity: `"rate"` or `"acceleration"`: what the array is.
        kinds: What the arrays of the file are.
    """
    if own := canonical_unit(_own_unit(settings, name)) if name else "":
        return own
    unit = canonical_unit(_text(_nearest(settings, name, _UNIT)))
    measured = quantity_of(unit)
    return "unknown" if not unit or (measured != quantity and measured in kinds) else unit


def _own_unit(settings: _Settings, name: str) -> str:
    return next((_text(settings[name, s]) for s in _UNIT if (name, s) in settings), "")


def _nearest(settings: _Settings, name: str, spellings: Sequence[str]) -> Any:
    """The setting of the array itself, else of the groups around it, the innermost first."""
    parts = name.split("/")
    around = ["/".join(parts[:i]) for i in range(len(parts), 0, -1)] + [""]
    return next((settings[group, s] for group in around for s in spellings if (group, s) in settings), None)


def _texts(value: Any) -> list[str]:
    flat = np.asarray(value).ravel()
    if flat.dtype.kind not in "USO":
        return []
    words = [decoded(item) if isinstance(item, bytes) else item for item in flat.tolist()]
    return [word[:LONGEST_NAME].strip() for word in words if isinstance(word, str)]


def _text(value: Any) -> str:
    return (*_texts(np.asarray(value).ravel()[:1]), "")[0]


def _select(columns: Mapping[str, Column], key: str, quantity: str) -> dict[str, Column]:
    """Keep `key` as the only sensor, or what is in the group `key` and the clocks."""
    if key in columns:
        kept = {name: column for name, column in columns.items() if name == key or column.kind != quantity}
        return kept | {key: replace(columns[key], kind=quantity)}
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
    column: Column, ticks: Array, rate: float | None, settings: _Settings
) -> tuple[Array, float | None, str]:
    """Seconds, wrapping period and guess of a clock, whose unit its attribute or the sampling rate may tell."""
    unit = column.unit or _own_unit(settings, column.name)
    return time_in_seconds(replace(column, unit=unit if unit in TICK else ""), ticks, rate)
