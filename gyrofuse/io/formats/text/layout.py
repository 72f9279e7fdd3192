"""The layout of a text file: its encoding, delimiter and header, and the settings in its comments."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from gyrofuse.io.formats.columns import classify_columns, is_unit
from gyrofuse.io.formats.text.dates import kind_of_times
from gyrofuse.io.formats.text.dialects import names_of_message
from gyrofuse.io.limits import LONGEST_NAME, enumerated
from gyrofuse.io.quantities import QUANTITY
from gyrofuse.io.streams import Array, RecordingError

COMMENT = ("#", "%", "//")
_HEAD = 600  # lines in which the layout is sought: preambles are shorter, that of Blackbox Explorer has 250
_PROBE = 20  # last lines of the head, which show the delimiter and the columns of numbers
_LONGEST_LINE = 131_072  # characters: 6500 cells of 20; a file without line ends is one line as long as the file


@dataclass(frozen=True)
class Layout:
    """The layout of the lines of a file.

    Attributes:
        encoding: Encoding of the file.
        delimiter: Character between cells; `None` is white space.
        names: Names of the columns, empty without a header.
        numeric: Whether each column holds numbers.
        times: `"date"`, `"time of day"` or `""` for each column.
        begin: Number of lines before the first row of numbers.
        settings: Settings in comments and the preamble, by name.
        rising: Whether the first column advances in nearly constant steps in the head of the file.
        notes: Remarks on the encoding and the header.
    """

    encoding: str
    delimiter: str | None
    names: tuple[str, ...]
    numeric: tuple[bool, ...]
    times: tuple[str, ...]
    begin: int
    settings: dict[str, str]
    rising: bool
    notes: tuple[str, ...]


def without_numbers(path: Path) -> RecordingError:
    """The error of a file without rows of numbers."""
    return RecordingError(f"{path}: expected rows of numbers, found none; export the samples as CSV")


def lines_of(path: Path, encoding: str, errors: str = "replace") -> Iterator[str]:
    """Lines of a file.

    Args:
        path: The file.
        encoding: Encoding of the file.
        errors: Treatment of bytes that are not of the encoding, as in `open`.

    Raises:
        RecordingError: A line that is too long to be a row of numbers.
    """
    with path.open(encoding=encoding, errors=errors) as file:
        for number, line in enumerate(iter(partial(file.readline, _LONGEST_LINE), ""), 1):
            if len(line) == _LONGEST_LINE:
                raise RecordingError(
                    f"{path}, line {number}: expected lines of numbers, found one of more than {_LONGEST_LINE} "
                    "characters; export the samples again, one row a line"
                )
            yield line


def _head(path: Path) -> tuple[str, list[str], tuple[str, ...]]:
    """Encoding, the first lines, and notes on the encoding."""
    with path.open("rb") as raw:
        start = raw.read(4096)
    encoding = "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    if encoding == "utf-8-sig" and b"\0" in start:
        raise RecordingError(f"{path}: expected text, found binary data; check the name or export it again")
    notes: tuple[str, ...] = ()
    if encoding == "utf-8-sig":
        try:
            return encoding, [line.rstrip("\n") for line in islice(lines_of(path, encoding, "strict"), _HEAD)], notes
        except UnicodeDecodeError:
            encoding, notes = "cp1252", ("the text is not UTF-8 and is read as Windows-1252 (Latin-1)",)
    return encoding, [line.rstrip("\n") for line in islice(lines_of(path, encoding), _HEAD)], notes


def find_layout(path: Path) -> Layout:
    """Find the layout of a file from its first lines.

    Args:
        path: The file.

    Raises:
        RecordingError: Not text, no rows of numbers, or a header that does not fit them.
    """
    encoding, head, notes = _head(path)
    rows = [line for line in head if line.strip() and not line.startswith(COMMENT)][-_PROBE:]
    delimiter = max((",", "\t", ";", None), key=lambda delimiter: sum(_fitness(row, delimiter) for row in rows))
    numbers_by_width: Counter[int] = Counter()
    for row in rows:
        cells = _cells(row, delimiter)
        numbers_by_width[len(cells)] += sum(is_number(cell, delimiter) for cell in cells)
    if not any(numbers_by_width.values()):
        raise without_numbers(path)
    width = max(numbers_by_width, key=lambda width: numbers_by_width[width])

    table = [
        (number, cells)
        for number, line in enumerate(head)
        if not line.startswith(COMMENT)
        and len(cells := _cells(line, delimiter)) in (width, width - 1)  # the last cell may be empty
    ]
    while table and (len(table[0][1]) < width or table[0][1][0].endswith(":")):  # preamble
        del table[0]
    if not table:
        raise without_numbers(path)
    sample = [cells for _, cells in table[1:][-_PROBE:]] or [table[0][1]]
    by_column = [[cells[i] for cells in sample if i < len(cells)] for i in range(width)]
    numeric = tuple(_holds_numbers(cells, delimiter) for cells in by_column)
    times = tuple(kind_of_times(cells) for cells in by_column)
    begin, first = table[0]
    above = head[:begin]
    if any(number and cell and not is_number(cell, delimiter) for number, cell in zip(numeric, first, strict=True)):
        names, begin = first, begin + 1
        if values := [cell for cell in first if is_number(cell, delimiter) and not cell.isdigit()]:
            raise RecordingError(
                f"{path}, line {begin}: expected names or numbers, found both ({enumerated(first)}); correct the "
                f"line, {values[0]!r} if it is a header"
            )
    else:
        names = _header_above(path, above, delimiter, width)
    if names and len(table) > 1 and _are_units(table[1][1], numeric, delimiter) and table[1][0] >= begin:
        begin = table[1][0] + 1
        names = [
            name if not unit or "[" in name or "(" in name else f"{name} [{unit}]"
            for name, unit in zip(names, (cell.strip("[]() ") for cell in table[1][1]), strict=True)
        ]
        notes = (*notes, f"line {begin} holds the units of the columns")
    if not names and (names := list(names_of_message(sample))):
        notes = (*notes, f"there is no header; the {width} cells of a line are read as those of a sensor_msgs/Imu")
    comments = [line for line in head[begin:] if line.startswith(COMMENT)]
    settings = {name: value for line in (*above, *comments) for name, value in _settings(line[:LONGEST_NAME])}
    clock = [cells[0] for number, cells in table if number >= begin]
    rising = all(is_number(cell, delimiter) for cell in clock) and advances(np.array([_number(c) for c in clock]))
    return Layout(encoding, delimiter, tuple(names), numeric, times, begin, settings, rising, notes)


def advances(values: Array) -> bool:
    """Whether values `(time,)` rise strictly and nine of ten steps are nearly the same."""
    with np.errstate(over="ignore", invalid="ignore"):  # values that are infinite or as far apart as float64 reaches
        steps = np.diff(values)
    if steps.size < 2 or not np.all(steps > 0):
        return False
    typical = float(np.median(steps))
    return bool(np.mean(np.abs(steps - typical) < 0.5 * typical) > 0.9)


def _are_units(cells: Sequence[str], numeric: Sequence[bool], delimiter: str | None) -> bool:
    """Whether the cells above columns of numbers are their units: no number, and at least half of them known."""
    above = [cell.strip("[]() ") for cell, number in zip(cells, numeric, strict=False) if number]
    filled = [cell for cell in above if cell not in ("", "-")]
    if len(cells) != len(numeric) or any(is_number(cell, delimiter) for cell in filled):
        return False
    return 2 * sum(map(is_unit, filled)) >= len(filled) > 0


def _settings(line: str) -> Iterator[tuple[str, str]]:
    """Names and values of `fs = 100 Hz, unit: deg/s`: a name may have blanks; a value ends at the next `,;=:`.

    `"name","value"` in quotes is one setting.
    """
    quoted = line.strip().split('"')
    if len(quoted) == 5 and not quoted[0] and quoted[2].strip() in (",", ";") and not quoted[4]:
        yield quoted[1].strip(), _without_hertz(quoted[3].strip())
        return
    parts = re.split("([,;=:])", line)
    position = 0  # texts are at even positions, separators at odd ones
    while position + 2 < len(parts):
        name = _last_words(parts[position]) if parts[position + 1] in "=:" else ""
        position += 2
        if not name:
            continue
        while not parts[position].strip() and parts[position + 1 : position + 2] in ([","], [";"]):
            position += 2
        if value := parts[position].strip():
            yield name, _without_hertz(value)
            position += 2


def _last_words(text: str) -> str:
    """Words at the end of a text, from a letter on: `fs` of `# fs`."""
    text = text.rstrip()
    begin = len(text)
    while begin and (text[begin - 1].isalnum() or text[begin - 1] in "_ "):
        begin -= 1
    words = text[begin:]
    return words[next((i for i, letter in enumerate(words) if letter.isascii() and letter.isalpha()), len(words)) :]


def _without_hertz(value: str) -> str:
    """A value without a unit of Hz behind it."""
    end = len(value)
    while end and not (value[end - 1].isalnum() or value[end - 1] == "_"):
        end -= 1
    return value[: end - 2].rstrip() if value[:end].lower().endswith("hz") else value


def _header_above(path: Path, above: Sequence[str], delimiter: str | None, width: int) -> list[str]:
    """The header of a table that begins with numbers: a comment, as np.savetxt writes it, or none."""
    for line in reversed(above):
        text = line.lstrip("#%/ ")
        for cells in (_cells(text, delimiter), text.split()):
            if len(cells) == width and _names_sensor(cells):
                return cells
    text = next((line for line in reversed(above) if line.strip()), "")
    cells = _cells(text, delimiter)
    if not text.startswith(COMMENT) and _names_sensor(cells):
        raise RecordingError(
            f"{path}: expected a header of {width} names, one for each cell of a row, found {len(cells)}: "
            f"{enumerated(cells)}; correct the header"
        )
    return []


def _names_sensor(names: Iterable[str]) -> bool:
    return any(column.kind in QUANTITY for column in classify_columns(list(names)) if not column.name.isdigit())


def _cells(line: str, delimiter: str | None) -> list[str]:
    """Cells of a line without the empty one that a trailing delimiter makes."""
    if delimiter is None and line.lstrip()[:1].isalpha():  # a blank before a unit is no delimiter
        line = " ".join(line.split()).replace(" [", "[").replace(" (", "(")
    cells = quoted_cells(line, delimiter) if '"' in line else [cell.strip() for cell in line.split(delimiter)]
    return cells[:-1] if delimiter and len(cells) > 1 and not cells[-1] else cells


def quoted_cells(line: str, delimiter: str | None) -> list[str]:
    """Cells of a line with quotes, within which delimiters are text.

    Args:
        line: The line.
        delimiter: Character between cells; `None` is white space.
    """
    text = line if delimiter else " ".join(line.split())
    return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter or " ", skipinitialspace=True))]


def _number(cell: str) -> float:
    return float(cell.replace(",", "."))


def is_number(cell: str, delimiter: str | None) -> bool:
    """Whether a cell is a number; a decimal comma counts where the delimiter is no comma."""
    if len(cell) > LONGEST_NAME:
        return False
    try:
        float(cell if delimiter == "," else cell.replace(",", "."))
    except ValueError:
        return False
    return "_" not in cell


def _fitness(line: str, delimiter: str | None) -> float:
    """Score of a delimiter for a line: high where it makes many cells and most of them are numbers."""
    filled = [is_number(cell, delimiter) for cell in _cells(line, delimiter) if cell]
    return sum(filled) ** 2 / max(len(filled), 1)


def _holds_numbers(cells: Sequence[str], delimiter: str | None) -> bool:
    """Whether at least half of the filled cells of a column are numbers; any other cell of it is an error then."""
    filled = [is_number(cell, delimiter) for cell in cells if cell]
    return 2 * sum(filled) >= len(filled) > 0
