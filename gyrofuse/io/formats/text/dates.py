"""Cells that are dates or times of day, in seconds.

These forms are read: `2024-01-31T23:59:59.010Z` (ISO 8601; a blank for the `T`, `/` for the `-`, up to 12 digits of a
second, an offset from UTC or none), `31.01.2024 23:59:59,010`, `31-Jan-2024 23:59:59.010` (MATLAB) and, without a date,
`23:59:59.010`. `01/02/2024` is not read, because either number may be the month.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date
from functools import lru_cache

from gyrofuse.io.timestamps import DAY

_TIME = r"(?P<hour>\d{1,2}):(?P<minute>\d\d):(?P<second>\d\d)(?:[.,:](?P<fraction>\d{1,12}))?"
_DATES = (
    r"(?P<year>\d{4})[-/](?P<month>\d{1,2})[-/](?P<day>\d{1,2})",
    r"(?P<day>\d{1,2})\.(?P<month>\d{1,2})\.(?P<year>\d{4})",
    r"(?P<day>\d{1,2})-(?P<month>[A-Za-z]{3})-(?P<year>\d{4})",
)
_WITH_DATE = tuple(re.compile(rf"{day}[T _]{_TIME} ?(?P<offset>Z|UTC|[+-]\d\d:?\d\d)?") for day in _DATES)
_OF_DAY = re.compile(_TIME)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_ABSENT = frozenset(("", "nan", "null", "none", "nat", "na"))


def kind_of_times(cells: Sequence[str]) -> str:
    """Return `"date"` or `"time of day"` where at least half of the filled cells of a column are one, else `""`.

    Args:
        cells: Some cells of the column.
    """
    filled = [cell for cell in cells if cell.lower() not in _ABSENT]
    if not filled:
        return ""
    dates = sum(_dated(cell) is not None for cell in filled)
    of_day = sum(_match(_OF_DAY, cell) is not None for cell in filled)
    return "date" if 2 * dates >= len(filled) else "time of day" if 2 * of_day >= len(filled) else ""


def seconds_of(cell: str) -> float:
    """Seconds from 1970 to a date, or from midnight to a time of day; NaN for an empty cell.

    Args:
        cell: Text of the cell.

    Raises:
        ValueError: The cell is neither a date nor a time of day.
    """
    if cell.strip().lower() in _ABSENT:
        return float("nan")
    found = _dated(cell) or _match(_OF_DAY, cell)
    if found is None:
        raise ValueError(f"could not convert string {cell!r} to float: expected a date or a time of day")
    parts = found.groupdict()
    hour, minute, second = int(parts["hour"]), int(parts["minute"]), int(parts["second"])
    if hour > 23 or minute > 59 or second > 60:
        raise ValueError(f"could not convert string {cell!r} to float: there is no such time of day")
    fraction = parts["fraction"] or "0"
    whole = 3600 * hour + 60 * minute + second
    if "year" in parts:
        whole += round(DAY) * _day_number(int(parts["year"]), parts["month"], int(parts["day"]))
        offset = (parts["offset"] or "Z").replace(":", "")
        if offset[0] in "+-":
            away = 3600 * int(offset[1:3]) + 60 * int(offset[3:5])
            whole -= away if offset[0] == "+" else -away
    return whole + int(fraction) / 10 ** len(fraction)


def _match(pattern: re.Pattern[str], cell: str) -> re.Match[str] | None:
    longest = 48  # characters, with blanks around: the longest of these dates has 40
    return pattern.fullmatch(cell.strip()) if len(cell) <= longest else None


def _dated(cell: str) -> re.Match[str] | None:
    return next((found for pattern in _WITH_DATE if (found := _match(pattern, cell))), None)


@lru_cache(maxsize=64)
def _day_number(year: int, month: str, day: int) -> int:
    """Days since 1970."""
    number = int(month) if month.isdigit() else _MONTHS.index(month.lower()) + 1
    return (date(year, number, day) - date(1970, 1, 1)).days
