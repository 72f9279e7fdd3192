"""Tables with named rows in an .npz file: the devices of a recording, with their clocks and channels.

Where `channels` names the rows (`gx`, `ay`, `temp`), tables are arrays (channel, time), (device, channel, time), or
time first. `units` and `scale` hold one value for all rows or one for each, and integers times `scale` are in `units`.
A clock or channel of a table `a1` is named after it: a clock `a1_t_us` or, by its number, `ts1`, with its ticks per
second in `ts_hz`; a channel `a1_movement`. Arrays without a table in their name serve every table of their length.

Several tables are the devices of one recording where each holds one device and their clocks show that they ran
together: the clocks are equal, or they count from an instant before the recording and the time that all of them cover
is more than half of the time that any of them covers. Clocks that start at zero or are set back cannot show it.
Otherwise the tables are recordings on their own, and `key` must name one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrofuse._base.units import canonical_unit
from gyrofuse.io.formats.arrays import clock_in_seconds
from gyrofuse.io.formats.column_streams import streams_from_columns
from gyrofuse.io.formats.columns import Column, classify_columns
from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.settings import settings_by_group, stated_rate
from gyrofuse.io.limits import LONGEST_NAME, MOST_DEVICES, enumerated, is_rate
from gyrofuse.io.quantities import Quantity
from gyrofuse.io.streams import Array, RecordingError, Stream
from gyrofuse.io.timestamps import COUNTER_32_BIT

_Content = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class _Table:
    """One array with named rows, its clock and its channels."""

    name: str
    values: NDArray[Any]  # (device, channel, time), as stored
    clock: Array | None
    clock_period: float | None
    channels: dict[str, Array]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Beside:
    """An array that is no table: its name, the table in its name (or ""), the rest of the name, its meaning."""

    name: str
    owner: str
    label: str
    column: Column


def streams_from_tables(content: _Content, request: Request) -> list[Stream]:
    """Streams of the tables of a file.

    Args:
        content: Arrays by name.
        request: The file and the part of it to read. Its `key` is the name of a table, with or without the words with
            which the names of all tables begin.

    Raises:
        RecordingError: No table of the quantity, or several recordings of which `key` names none.
    """
    path, key, quantity = request.path, request.key, request.quantity
    channels = [str(name) for name in content["channels"].ravel()]
    units = [canonical_unit(str(unit)) for unit in _per_channel(content, ("units", "unit"), "", channels, path)]
    scale = [float(factor) for factor in _per_channel(content, ("scale",), 1.0, channels, path)]
    values = {name: rows for name, value in content.items() if (rows := _by_device(value, len(channels))) is not None}
    kinds = {column.kind for column in classify_columns(channels, quantity)}
    if not values or len({*channels}) < len(channels) or quantity.name not in kinds:
        found = enumerated(f"{name} {value.shape}" for name, value in content.items() if value.ndim)
        raise RecordingError(
            f"{path}: expected arrays (channel, time) with the rows {enumerated(channels)} and {quantity.named} "
            f"among them, found {found}; name each row once in `channels`"
        )
    labels = _short(values)
    wanted = [name for name in values if key is None or key in (name, labels[name])]
    if key is not None and len(wanted) != 1:
        raise RecordingError(f"{path}: expected an array {key!r} (`key`), found {enumerated(values)}; name one")
    beside = _beside(content, values)
    settings = settings_by_group(content)
    only = len(values) == 1
    tables = [_table(name, values[name], content, beside, settings, path, only=only) for name in wanted[:MOST_DEVICES]]
    if len(wanted) > MOST_DEVICES or (len(tables) > 1 and not _ran_together(tables)):
        raise RecordingError(
            f"{path}: expected one recording, found several recordings inside ({enumerated(values)}); name one with "
            "key= (--key NAME)"
        )
    rate = stated_rate(settings, "")
    return [
        stream
        for table in tables
        for stream in _streams(table, path.stem if only else labels[table.name], channels, units, scale, rate, quantity)
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


def _short(names: Mapping[str, Any]) -> dict[str, str]:
    """Names of tables without the words that all of them begin with."""
    words = zip(*(name.split("_") for name in names), strict=False)
    n_common = len([*takewhile(lambda word: len({*word}) == 1, words)]) if len(names) > 1 else 0
    return {name: "_".join(name.split("_")[n_common:]) or name for name in names}


def _owner(name: str, tables: Mapping[str, Any]) -> str:
    """The longest name of a table that a name begins with, `a1` of `a1_movement`; `""` where there is none."""
    while (end := name.rfind("_")) >= 0:
        name = name[:end]
        if name in tables:
            return name
    return ""


def _beside(content: _Content, tables: Mapping[str, Any]) -> list[_Beside]:
    """Arrays that are no tables."""
    names = [name for name in content if name not in tables]
    owners = [_owner(name, tables) for name in names]
    labels = [name.removeprefix(f"{owner}_") if owner else name for name, owner in zip(names, owners, strict=True)]
    columns = [classify_columns([label])[0] for label in labels]
    return [_Beside(*found) for found in zip(names, owners, labels, columns, strict=True)]


def _table(
    name: str,
    values: NDArray[Any],
    content: _Content,
    beside: Sequence[_Beside],
    settings: Mapping[tuple[str, str], Any],
    path: Path,
    *,
    only: bool,
) -> _Table:
    """A table with the clock and the channels that bear its name, or no table's name and have its length."""
    length = values.shape[-1]
    number = name[len(name.rstrip("0123456789")) :]
    clocks: list[tuple[int, _Beside]] = []  # its own first
    channels: dict[str, Array] = {}
    notes: list[str] = []
    for other in beside:
        if other.owner not in ("", name):
            continue
        value = content[other.name]
        if value.ndim == 0 and other.owner and value.dtype.kind == "U":
            notes.append(f"{other.name}: {str(value)[:LONGEST_NAME]}")
        elif value.dtype.kind not in "biuf" or value.ndim not in (1, 2):
            continue
        elif value.ndim == 1 and other.column.kind == "time":
            numbered = bool(number) and other.column.device == number
            alone = other.column.device == "" and (value.size == length or only)
            if other.owner or numbered or alone:
                clocks.append((0 if other.owner else 1 if numbered else 2, other))
        elif value.shape[-1] == length:
            channels[other.label] = value.astype(np.float64)
    if not clocks:
        return _Table(name, values, None, None, channels, tuple(notes))
    _, clock = min(clocks, key=lambda found: found[0])
    ticks = content[clock.name]
    if ticks.size != length:
        raise RecordingError(
            f"{path}: expected `{clock.name}` of the length of `{name}`, {length}, found {ticks.size}; "
            "save both of one length"
        )
    name_of_rate = f"{clock.name.rstrip('0123456789')}_hz"
    per_second = content.get(name_of_rate)
    if per_second is None:
        rate = stated_rate(settings, "")
        seconds, period, guess = clock_in_seconds(clock.column, ticks.astype(np.float64), rate, settings)
        notes += [guess] if guess else []
    else:
        if per_second.size != 1 or per_second.dtype.kind not in "iuf" or not is_rate(float(per_second.item())):
            raise RecordingError(
                f"{path}: expected `{name_of_rate}` to be the ticks of `{clock.name}` in a second, one number, found "
                f"{str(per_second)[:LONGEST_NAME]}; correct it or leave it out"
            )
        hertz = float(per_second.item())
        seconds = ticks / hertz
        in_32_bit = ticks.dtype.kind in "iu" and ticks.min() >= 0 and ticks.max() < COUNTER_32_BIT
        period = COUNTER_32_BIT / hertz if in_32_bit else None
    return _Table(name, values, seconds, period, channels, tuple(notes))


def _ran_together(tables: Sequence[_Table]) -> bool:
    """Whether the tables are the devices of one recording, by the rule of the module's docstring."""
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
    quantity: Quantity,
) -> list[Stream]:
    columns = classify_columns(channels, quantity)
    unit = next(unit for unit, column in zip(units, columns, strict=True) if column.kind == quantity.name)
    # Names with their units, as in text files; the name of a sensor may be a bare axis and stays one.
    stated = [
        f"{column.name} [{unit}]" if unit and column.kind not in ("", quantity.name) else column.name
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
            values,
            name=name,
            unit=unit or "unknown",
            rate=rate,
            time=table.clock,
            notes=table.notes,
            quantity=quantity,
        )
        other = {column.name: values[column.name] for column in columns if not column.kind}
        if first == 0:
            other |= table.channels
        streams[first] = replace(streams[first], channels=streams[first].channels | other)
    return [replace(stream, clock_period=table.clock_period) for stream in streams] if table.clock_period else streams
