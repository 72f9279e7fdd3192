"""Text files: CSV and its relatives, with and without a header.

The delimiter is a comma, or a tab, a semicolon or white space, with which numbers may have a decimal comma. Lines that
begin with `#`, `%` or `//` are comments, and what stands above the header is skipped; in both, `fs = 100` and
`unit: deg/s` are understood. A header names the columns as `gyrofuse.io.columns` says, and may be a comment. Without
one the columns are sensors `"1"`, `"2"`, ..., after a clock where the first alone advances in nearly constant steps.
An empty cell is NaN. Only columns of numbers with a known name are parsed.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from gyrofuse.io.arrays import settings_by_group, stated_rate, stated_unit
from gyrofuse.io.columns import Column, classify_columns, streams_from_columns, time_in_seconds
from gyrofuse.io.stream import Array, RecordingError, Stream

_HEAD = 200  # lines in which the layout is sought: preambles are shorter
_PROBE = 20  # of these, the last tell the delimiter and which columns hold numbers
_COMMENT = ("#", "%", "//")
_SETTING = re.compile(r"([A-Za-z][\w ]*?)\s*[=:][\s,;]*([^\s,;=:][^,;=:]*)")


def read(path: Path, *, key: str | None = None) -> list[Stream]:
    """Read the gyros of a text file.

    Args:
        path: The file.
        key: The only column to read as a gyro, whatever its name, or the only device.

    Raises:
        RecordingError: Not text, no rows of numbers, no gyro, or a line that does not fit the others.
    """
    try:
        layout = _layout(path)
        columns, time, notes = (_named if layout.names else _unnamed)(path, layout, key)
    except (OSError, csv.Error) as error:
        raise RecordingError(
            f"{path}: expected text, found a file that cannot be read ({error}); export it again"
        ) from error
    settings = settings_by_group(layout.settings)
    streams = streams_from_columns(
        columns,
        name=path.stem if key is None else key,
        unit=stated_unit(settings, ""),
        rate=stated_rate(settings, ""),
        time=time,
        notes=notes,
    )
    if streams[0].n_samples < 2:
        raise RecordingError(f"{path}: expected at least 2 rows of numbers, found 1; record longer")
    return streams


@dataclass(frozen=True)
class _Layout:
    """How the lines of a file are to be read.

    Attributes:
        encoding: Of the file.
        delimiter: Between cells; `None` is white space.
        names: Of the columns, empty without a header.
        numeric: Of each column, whether it holds numbers.
        begin: Lines before the first row of numbers.
        settings: What comments and the preamble state, by name.
    """

    encoding: str
    delimiter: str | None
    names: tuple[str, ...]
    numeric: tuple[bool, ...]
    begin: int
    settings: dict[str, str]


def _named(path: Path, layout: _Layout, key: str | None) -> tuple[dict[str, Array], None, list[str]]:
    """Columns that the header names, and notes."""
    notes: list[str] = []
    chosen: dict[str, int] = {}
    gyros: set[str] = set()
    for position, column in enumerate(classify_columns(layout.names)):
        if column.name in chosen:
            notes.append(f"column '{column.name}' stands there twice; the first is read")
        elif column.name == key or (column.kind == "gyro" and key in (None, column.device)):
            chosen[column.name] = position
            gyros.add(column.kind)
        elif column.kind not in ("", "gyro"):
            if layout.numeric[position]:
                chosen[column.name] = position
            elif column.kind == "time":
                notes.append(f"column '{column.name}' holds no numbers and is left out")
    if not gyros:
        wanted = "with the name of a gyro (gyro_x, gx)" if key is None else f"or device {key!r} (`key`)"
        raise RecordingError(
            f"{path}: expected a column {wanted}, found {', '.join(layout.names)}; "
            "say with `key` which column is the gyro"
        )
    columns = _numbers(path, layout, chosen)
    if "gyro" not in gyros and key is not None:
        columns["gyro"] = columns.pop(key)
    return columns, None, notes


def _unnamed(path: Path, layout: _Layout, key: str | None) -> tuple[dict[str, Array], Array | None, list[str]]:
    """Sensors by their number, the clock where there is one, and notes."""
    columns = _numbers(path, layout, {f"{i + 1}": i for i, numeric in enumerate(layout.numeric) if numeric})
    values = list(columns.values())
    notes: list[str] = []
    time = None
    if [_advances(column) for column in values] == [True, *[False] * (len(values) - 1)] and len(values) > 1:
        ticks = values.pop(0)
        said = "there is no header; the first column alone advances in nearly constant steps and is"
        if np.all(np.diff(ticks) == 1):
            notes.append(f"{said} taken as a count of the rows")
        else:
            time, _, guess = time_in_seconds(Column("1", "time"), ticks)
            notes += [f"{said} read as time", *([guess] if guess else [])]
    sensors = {str(number): row for number, row in enumerate(values, 1)}
    if key is not None and key not in sensors:
        raise RecordingError(
            f"{path}: expected a sensor {key!r} (`key`), found no header and the sensors {', '.join(sensors)}; "
            "name one of these"
        )
    if key is not None:
        return {"gyro": sensors[key]}, time, notes
    return (sensors if len(sensors) > 1 else {"gyro": values[0]}), time, notes


def _advances(values: Array) -> bool:
    """Whether values rise strictly and nine of ten steps are nearly the same."""
    steps = np.diff(values)
    if steps.size < 2 or not np.all(steps > 0):
        return False
    typical = float(np.median(steps))
    return bool(np.mean(np.abs(steps - typical) < 0.5 * typical) > 0.9)


def _layout(path: Path) -> _Layout:
    """Find out from the first lines how the file is written."""
    with path.open("rb") as raw:
        start = raw.read(4096)
    encoding = "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    if encoding == "utf-8-sig" and b"\0" in start:
        raise RecordingError(f"{path}: expected text, found binary data; check the name or export it again")
    with path.open(encoding=encoding, errors="replace") as file:
        head = [line.rstrip("\n") for line in islice(file, _HEAD)]

    rows = [line for line in head if line.strip() and not line.startswith(_COMMENT)][-_PROBE:]
    delimiter = max((",", "\t", ";", None), key=lambda delimiter: sum(_fitness(row, delimiter) for row in rows))
    numbers_by_width: Counter[int] = Counter()
    for row in rows:
        cells = _cells(row, delimiter)
        numbers_by_width[len(cells)] += sum(_is_number(cell, delimiter) for cell in cells)
    if not any(numbers_by_width.values()):
        raise RecordingError(f"{path}: expected rows of numbers, found none; export the samples as CSV")
    width = max(numbers_by_width, key=lambda width: numbers_by_width[width])

    table = [
        (number, cells)
        for number, line in enumerate(head)
        if not line.startswith(_COMMENT)
        and len(cells := _cells(line, delimiter)) in (width, width - 1)  # the last cell may be empty
    ]
    while len(table[0][1]) < width or table[0][1][0].endswith(":"):  # preamble
        del table[0]
    sample = [cells for _, cells in table[1:][-_PROBE:]] or [table[0][1]]
    numeric = tuple(_holds_numbers([cells[i] for cells in sample if i < len(cells)], delimiter) for i in range(width))
    begin, first = table[0]
    above = head[:begin]
    if any(number and cell and not _is_number(cell, delimiter) for number, cell in zip(numeric, first, strict=True)):
        names, begin = first, begin + 1
        if values := [cell for cell in first if _is_number(cell, delimiter) and not cell.isdigit()]:
            raise RecordingError(
                f"{path}, line {begin}: expected names or numbers, found both ({', '.join(first)}); correct the "
                f"line, {values[0]!r} if it is a header"
            )
    else:
        names = _header_above(path, above, delimiter, width)
    comments = [line for line in head[begin:] if line.startswith(_COMMENT)]
    settings = {
        name: re.sub(r"(?i)\s*hz\W*$", "", value).strip()
        for line in (*above, *comments)
        for name, value in _SETTING.findall(line)
    }
    return _Layout(encoding, delimiter, tuple(names), numeric, begin, settings)


def _header_above(path: Path, above: Sequence[str], delimiter: str | None, width: int) -> list[str]:
    """The header of a table that begins with numbers: a comment, as np.savetxt writes it, or none."""
    for line in reversed(above):
        text = line.lstrip("#%/ ")
        for cells in (_cells(text, delimiter), text.split()):
            if len(cells) == width and _names_gyro(cells):
                return cells
    text = next((line for line in reversed(above) if line.strip()), "")
    cells = _cells(text, delimiter)
    if not text.startswith(_COMMENT) and _names_gyro(cells):
        raise RecordingError(
            f"{path}: expected a header of {width} names, one for each cell of a row, found {len(cells)}: "
            f"{text.strip()}; correct the header"
        )
    return []


def _names_gyro(names: Iterable[str]) -> bool:
    return any(column.kind == "gyro" for column in classify_columns(list(names)) if not column.name.isdigit())


def _cells(line: str, delimiter: str | None) -> list[str]:
    """Cells of a line without the empty one that a trailing delimiter makes."""
    if delimiter is None:
        return line.split()
    quoted = '"' in line
    cells = [
        cell.strip() for cell in (next(csv.reader([line], delimiter=delimiter)) if quoted else line.split(delimiter))
    ]
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _is_number(cell: str, delimiter: str | None) -> bool:
    try:
        float(cell if delimiter == "," else cell.replace(",", "."))
    except ValueError:
        return False
    return "_" not in cell


def _fitness(line: str, delimiter: str | None) -> float:
    """How well a delimiter cuts a line into numbers: many of them, and little else."""
    filled = [_is_number(cell, delimiter) for cell in _cells(line, delimiter) if cell]
    return sum(filled) ** 2 / max(len(filled), 1)


def _holds_numbers(cells: Sequence[str], delimiter: str | None) -> bool:
    """Whether at least half of the cells that are not empty are numbers; one that is none is an error then."""
    filled = [_is_number(cell, delimiter) for cell in cells if cell]
    return 2 * sum(filled) >= len(filled) > 0


def _numbers(path: Path, layout: _Layout, chosen: Mapping[str, int]) -> dict[str, Array]:
    """Parse the chosen columns, by name and position."""
    with path.open(encoding=layout.encoding, errors="replace") as file:
        rows = _Rows(path, layout, file)
        try:
            table = np.loadtxt(
                iter(rows), delimiter=layout.delimiter, comments=None, usecols=[*chosen.values()], ndmin=2
            )
        except RecordingError:
            raise
        except ValueError as error:
            found = re.search(r"could not convert string (.*) to float", str(error))
            raise RecordingError(
                f"{path}, line {rows.number}: expected numbers in the columns {', '.join(chosen)}, found "
                f"{found[1] if found else error}; correct the line, or leave the cell empty for a missing sample"
            ) from error
    return dict(zip(chosen, np.ascontiguousarray(table.T), strict=True))


class _Rows:
    """Lines of numbers as np.loadtxt takes them: cells alone, a decimal point, NaN for an empty cell.

    Attributes:
        number: Of the line that was last handed out, from 1.
    """

    def __init__(self, path: Path, layout: _Layout, file: TextIO) -> None:
        self.number = layout.begin
        self._path = path
        self._layout = layout
        self._lines = islice(file, layout.begin, None)

    def __iter__(self) -> Iterator[str]:
        delimiter, width = self._layout.delimiter, len(self._layout.numeric)
        for line in self._lines:
            self.number += 1
            line = line.rstrip("\n ")
            if not line or line.startswith(_COMMENT):
                continue
            if delimiter is None:
                n_cells = len(line.split())
                line = line.replace(",", ".")
            else:
                if '"' in line:
                    cells = next(csv.reader([line], delimiter=delimiter))
                    line = delimiter.join(cell.replace(delimiter, " ") for cell in cells)
                n_cells = line.count(delimiter) + 1
                if n_cells == width + 1 and line[-1] == delimiter:
                    n_cells, line = width, line[:-1]
                if delimiter != ",":
                    line = line.replace(",", ".")
                line = _fill(line, delimiter)
            if n_cells != width:
                raise RecordingError(
                    f"{self._path}, line {self.number}: expected {width} cells as in the other lines, found {n_cells}; "
                    "complete or delete the line"
                )
            yield line


def _fill(line: str, delimiter: str) -> str:
    """Write NaN into empty cells."""
    while f"{delimiter} " in line:
        line = line.replace(f"{delimiter} ", delimiter)
    while f" {delimiter}" in line:
        line = line.replace(f" {delimiter}", delimiter)
    if delimiter * 2 in line or line[0] == delimiter or line[-1] == delimiter:
        line = delimiter.join(cell or "nan" for cell in line.split(delimiter))
    return line
