"""Text files: CSV and its relatives, with and without a header.

The delimiter is a comma, or a tab, a semicolon or white space, with which numbers may have a decimal comma. Lines that
begin with `#`, `%` or `//` are comments, and what stands above the header is skipped; in both, `fs = 100` and `unit:
deg/s` are understood. A header names the columns as `gyrofuse.io.formats.columns` says, and may be a comment; the line
below it may hold their units. Without one the columns are sensors `"1"`, `"2"`, ..., after a clock where the first
alone advances in nearly constant steps. A column of dates or times of day (`gyrofuse.io.formats.text.dates`) is a
clock. An empty cell is NaN. Only columns of numbers with a known name are parsed. Files of known loggers are read as
`gyrofuse.io.formats.text.dialects` says.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gyrofuse._base.results import numbered
from gyrofuse.io.formats.column_streams import streams_from_columns, time_in_seconds
from gyrofuse.io.formats.columns import Column, classify_columns, renamed
from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.settings import settings_by_group, stated_rate, stated_unit
from gyrofuse.io.formats.text.dialects import NEEDED, translate
from gyrofuse.io.formats.text.layout import Layout, advances, find_layout, without_numbers
from gyrofuse.io.formats.text.numbers import numbers_of
from gyrofuse.io.limits import Allowance, enumerated
from gyrofuse.io.streams import Array, RecordingError, Stream, cause
from gyrofuse.io.timestamps import DAY


def read(request: Request) -> list[Stream]:
    """Read the gyros or accelerometers of a text file.

    Args:
        request: The file and the part of it to read. Its `key` is the only column to read, whatever its name, or the
            only device.

    Raises:
        RecordingError: Not text, no rows of numbers, none of the quantity, a line that does not fit the others, or too
            large.
    """
    path, key, quantity, columns = request.path, request.key, request.quantity, request.columns
    allowance = request.allowance()
    try:
        layout = find_layout(path)
        settings = settings_by_group(layout.settings)
        rate = stated_rate(settings, "")
        if columns is not None:
            layout = _renamed(path, layout, columns)
        table = _named(request, layout, allowance) if layout.names else _unnamed(request, layout, rate, allowance)
    except (OSError, csv.Error) as error:
        raise RecordingError(
            f"{path}: expected text, found a file that cannot be read ({cause(error)}); export it again"
        ) from error
    streams = streams_from_columns(
        table.columns,
        name=path.stem if key is None else key,
        unit=stated_unit(
            settings, "", quantity, {column.kind for column in classify_columns(list(table.columns), quantity)}
        ),
        rate=rate,
        time=table.time,
        clock_period=table.clock_period,
        notes=[*layout.notes, *table.notes],
        quantity=quantity,
    )
    if streams[0].n_samples < 2:
        raise RecordingError(f"{path}: expected at least 2 rows of numbers, found 1; record longer")
    return streams


@dataclass(frozen=True, eq=False)
class _Table:
    """Columns of numbers by name, the clock where it is none of the columns, and notes."""

    columns: dict[str, Array]
    time: Array | None
    clock_period: float | None
    notes: list[str]


def _renamed(path: Path, layout: Layout, columns: Mapping[str, str]) -> Layout:
    """The layout with the names that columns should have, empty for those without any."""
    names = layout.names or numbered(len(layout.numeric))
    called = renamed(path, names, columns)
    return replace(layout, names=tuple(called.get(name, "") for name in names), rising=False)


def _named(request: Request, layout: Layout, allowance: Allowance) -> _Table:
    """Columns that the header names."""
    path, key, quantity = request.path, request.key, request.quantity
    notes: list[str] = []
    chosen: dict[str, int] = {}
    wanted: set[str] = set()
    columns_there = classify_columns(layout.names, quantity)
    clock = _clock_of_dates(layout, columns_there)
    for position, column in enumerate(columns_there):
        if column.name in chosen:
            notes.append(f"column '{column.name}' stands there twice; the first is read")
        elif column.name == key or (column.kind == quantity.name and key in (None, column.device)):
            chosen[column.name] = position
            wanted.add(column.kind)
        elif column.kind not in ("", quantity.name) or column.name.lower() in NEEDED:
            if layout.numeric[position]:
                chosen[column.name] = position
            elif column.kind == "time" and position != clock:
                beside = "dates beside another clock" if layout.times[position] else "no numbers"
                notes.append(f"column '{column.name}' holds {beside} and is left out")
    if not wanted:
        what = f"with the name of {quantity.named}" if key is None else f"or device {key!r} (`key`)"
        advice = "say with `columns` (--map) what the columns are"
        raise RecordingError(
            f"{path}: expected a column {what}, found {enumerated(layout.names)}; "
            f"{quantity.advice({column.kind for column in columns_there}, advice)}"
        )
    if layout.rising and layout.names[0] not in chosen and not any(c.kind == "time" for c in columns_there):
        notes.append(
            f"column '{layout.names[0]}' rises in equal steps but has no name of a clock; if it is one, call it 'time'"
        )
    columns, time, period, said = _with_dates(path, layout, chosen, clock, allowance)
    if quantity.name not in wanted and key is not None:
        columns[quantity.array] = columns.pop(key)
    columns, meaning = translate(columns, layout.names, layout.settings)
    return _Table(columns, time, period, [*notes, *said, *meaning])


def _clock_of_dates(layout: Layout, columns: Sequence[Column]) -> int | None:
    """Position of the column of dates or times of day that is the clock, where no clock counts in numbers."""
    kinds = [column.kind for column in columns] or [""] * len(layout.times)
    if any(kind == "time" and number for kind, number in zip(kinds, layout.numeric, strict=True)):
        return None
    dated = [position for position, times in enumerate(layout.times) if times and kinds[position] in ("time", "")]
    return next((position for position in dated if kinds[position] == "time"), dated[0] if dated else None)


def _with_dates(
    path: Path, layout: Layout, chosen: Mapping[str, int], clock: int | None, allowance: Allowance
) -> tuple[dict[str, Array], Array | None, float | None, list[str]]:
    """Chosen columns, the clock of the column of dates in seconds, the period after which it wraps, and notes."""
    name = "" if clock is None else layout.names[clock] if layout.names else str(clock + 1)
    if clock is None or name in chosen:
        return numbers_of(path, layout, chosen, allowance), None, None, []
    columns = numbers_of(path, layout, {**chosen, name: clock}, allowance)
    seconds = columns.pop(name)
    if layout.times[clock] == "date":
        return columns, seconds, None, [f"column '{name}' holds dates and is read as time; without an offset as UTC"]
    note = f"column '{name}' holds times of day, which begin again at midnight, and is read as time"
    return columns, seconds, DAY, [note]


def _unnamed(request: Request, layout: Layout, rate: float | None, allowance: Allowance) -> _Table:
    """Sensors by their number, and the clock where there is one."""
    path, key = request.path, request.key
    wanted = {f"{i + 1}": i for i, numeric in enumerate(layout.numeric) if numeric}
    if not wanted:
        raise without_numbers(path)
    columns, time, period, notes = _with_dates(path, layout, wanted, _clock_of_dates(layout, ()), allowance)
    values = list(columns.values())
    if time is None and len(values) > 1 and [advances(v) for v in values] == [True, *[False] * (len(values) - 1)]:
        ticks = values.pop(0)
        said = "there is no header; the first column alone advances in nearly constant steps and is"
        if np.all(np.diff(ticks) == 1):
            notes.append(f"{said} taken as a count of the rows")
        else:
            time, _, guess = time_in_seconds(Column("1", "time"), ticks, rate)
            notes += [f"{said} read as time", *([guess] if guess else [])]
    sensors = {str(number): row for number, row in enumerate(values, 1)}
    if key is not None and key not in sensors:
        raise RecordingError(
            f"{path}: expected a sensor {key!r} (`key`), found no header and the sensors {enumerated(sensors)}; "
            "name one of these"
        )
    if key is not None:
        sensors = {key: sensors[key]}
    if len(sensors) == 1:
        sensors = {request.quantity.array: next(iter(sensors.values()))}
    return _Table(sensors, time, period, notes)
