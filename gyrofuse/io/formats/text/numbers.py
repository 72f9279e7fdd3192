"""The rows of a text file as numbers: with pyarrow where it accepts every line, or else line by line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from gyrofuse.io.formats.text.dates import seconds_of
from gyrofuse.io.formats.text.layout import COMMENT, Layout, lines_of, quoted_cells
from gyrofuse.io.limits import LONGEST_NAME, Allowance, enumerated
from gyrofuse.io.streams import Array, RecordingError


def numbers_of(path: Path, layout: Layout, chosen: Mapping[str, int], allowance: Allowance) -> dict[str, Array]:
    """Parse the chosen columns of a text file.

    Args:
        path: The file.
        layout: Layout of its lines.
        chosen: Positions of the columns by name.
        allowance: Memory that the numbers may take.

    Returns:
        Values `(time,)` by name.

    Raises:
        RecordingError: A line that does not fit the others or holds no numbers, or more rows than memory may take.
    """
    at_once = _at_once(path, layout, list(chosen.values()), allowance)
    if at_once is None:
        return _row_by_row(path, layout, chosen, allowance)
    allowance.take("rows of numbers", (len(chosen), len(at_once[0])))
    return dict(zip(chosen, at_once, strict=True))


def _at_once(path: Path, layout: Layout, positions: list[int], allowance: Allowance) -> list[Array] | None:
    """Columns as pyarrow parses them; None where it is not installed, or does not accept every line."""
    width = len(layout.numeric)
    shortest = 2  # bytes of a cell with its delimiter, which bounds the number of rows
    most = path.stat().st_size // (shortest * width) * width * 8
    plain = layout.delimiter is not None and layout.encoding != "utf-16" and all(layout.numeric[i] for i in positions)
    if not plain or most > allowance.left:
        return None
    try:
        import pyarrow as pa
        from pyarrow import csv
    except ImportError:
        return None
    # pyarrow refuses rows with one cell more than the names; an empty cell after the last delimiter is usual in logs.
    for decimal, n_cells in [(d, n) for d in (".", ",") if d != layout.delimiter for n in (width, width + 1)]:
        names = [str(i) for i in range(n_cells)]
        try:
            table = csv.read_csv(
                path,
                read_options=csv.ReadOptions(skip_rows=layout.begin, column_names=names, use_threads=True),
                parse_options=csv.ParseOptions(delimiter=layout.delimiter),
                convert_options=csv.ConvertOptions(
                    include_columns=list(dict.fromkeys(names[i] for i in positions)),
                    column_types=dict.fromkeys(names, pa.float64()),
                    null_values=[""],
                    decimal_point=decimal,
                ),
            )
        except (pa.ArrowException, OSError, ValueError):
            continue
        # The arrays of pyarrow may not be written to, of which torch warns.
        return [np.require(table.column(names[i]).to_numpy(), np.float64, "W") for i in positions]
    return None


def _row_by_row(path: Path, layout: Layout, chosen: Mapping[str, int], allowance: Allowance) -> dict[str, Array]:
    """Columns as NumPy parses them, line by line."""
    rows = _Rows(path, layout, allowance.left // (8 * len(chosen)))
    try:
        table = np.loadtxt(
            iter(rows),
            delimiter=layout.delimiter,
            comments=None,
            usecols=[*chosen.values()],
            ndmin=2,
            converters={i: seconds_of for i in chosen.values() if layout.times[i] and not layout.numeric[i]},
            encoding=None,  # converters take text, not bytes
        )
    except RecordingError:
        raise
    except ValueError as error:
        found = str(error).partition("could not convert string ")[2].rpartition(" to float")[0] or str(error)
        hint = _units_row(layout, rows.number, found)
        raise RecordingError(
            f"{path}, line {rows.number}: expected numbers in the columns {enumerated(chosen)}, found "
            f"{found[:LONGEST_NAME]}; correct the line{hint}, or leave the cell empty for a missing sample"
        ) from error
    allowance.take("rows of numbers", table.shape)
    return dict(zip(chosen, np.ascontiguousarray(table.T), strict=True))


def _units_row(layout: Layout, number: int, found: str) -> str:
    """Advice on a second row of a header, `""` where the line is none."""
    second = layout.names and number == layout.begin + 1 and not any(letter.isdigit() for letter in found)
    return " (units belong behind the names: gx [deg/s])" if second else ""


class _Rows:
    """Lines of numbers for np.loadtxt: cells alone, a decimal point, NaN for an empty cell.

    Attributes:
        number: Number of the line that was returned last, from 1.
    """

    def __init__(self, path: Path, layout: Layout, most: int) -> None:
        self.number = layout.begin
        self._path = path
        self._layout = layout
        self._most = most

    def __iter__(self) -> Iterator[str]:
        delimiter, width = self._layout.delimiter, len(self._layout.numeric)
        for line in islice(lines_of(self._path, self._layout.encoding), self._layout.begin, None):
            self.number += 1
            line = line.rstrip("\n ")
            if not line or line.startswith(COMMENT):
                continue
            if self.number - self._layout.begin > self._most:
                raise RecordingError(
                    f"{self._path}, line {self.number}: expected a log whose numbers fit the memory that it may take, "
                    "found more rows; allow more with max_bytes=, or save it as .npy and read it with open_recording"
                )
            n_cells, line = _plain(line, delimiter, width)
            if n_cells != width:
                raise RecordingError(
                    f"{self._path}, line {self.number}: expected {width} cells as in the other lines, found {n_cells}; "
                    "complete or delete the line"
                )
            yield line


def _plain(line: str, delimiter: str | None, width: int) -> tuple[int, str]:
    """Number of cells of a line, and the line for np.loadtxt."""
    quoted = '"' in line
    between = delimiter or " "
    if delimiter and not (quoted or " " in line or between * 2 in line or between in (line[0], line[-1])):
        n_cells = line.count(between) + 1  # nothing to mend: most lines
    else:
        cells = quoted_cells(line, delimiter) if quoted else line.split(delimiter)
        if quoted:
            cells = [cell.replace(between, "_") for cell in cells]
        if delimiter and len(cells) == width + 1 and not cells[-1].strip():
            del cells[-1]
        n_cells = len(cells)
        line = between.join([cell.strip() or "nan" for cell in cells])
    return n_cells, line if delimiter == "," else line.replace(",", ".")
