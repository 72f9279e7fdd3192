"""Rows of a text file parsed at once: the same numbers as line by line, and as little when a line is odd."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from logs import read_with

from gyrofuse.io.formats.text import numbers as text_numbers
from gyrofuse.io.formats.text import text
from gyrofuse.io.streams import RecordingError

pytest.importorskip("pyarrow")
STYLES = list(itertools.product((",", ";", "\t"), (".", ","), ("\n", "\r\n"), ("%.6g", "%+.3e", "%r"), (False, True)))


def written(path: Path, delimiter: str, decimal: str, end: str, style: str, trailing: bool) -> Path:
    generator = np.random.default_rng(5)
    values = generator.standard_normal((50, 2)) * 10.0 ** generator.integers(-8, 8, (50, 2))
    lines = [delimiter.join(("time [s]", "gx", "gy"))]
    for number, (x, y) in enumerate(values.tolist()):
        cells = [f"{number / 100:.2f}", "" if number == 7 else style % x, style % y]
        lines.append(delimiter.join(cell.replace(".", decimal) for cell in cells))
    path.write_bytes((end.join(line + delimiter * trailing for line in lines) + end).encode())
    return path


@pytest.mark.parametrize("style", [s for s in STYLES if s[0] != s[1]])
def test_at_once_as_line_by_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, style: tuple[str, ...]):
    path = written(tmp_path / "log.csv", *style)
    (at_once,) = read_with(text.read, path)
    monkeypatch.setattr(text_numbers, "_at_once", lambda *given: None)
    (by_line,) = read_with(text.read, path)
    for axis in "xy":
        np.testing.assert_array_equal(at_once.signal[axis], by_line.signal[axis])
    np.testing.assert_array_equal(at_once.time, by_line.time)
    assert at_once.notes == by_line.notes


def test_plain_tables_are_parsed_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(text_numbers, "_row_by_row", lambda *given: pytest.fail("line by line"))
    for style in ((",", ".", "\n", "%.6g", False), (";", ",", "\r\n", "%r", True)):
        assert len(read_with(text.read, written(tmp_path / "log.csv", *style))[0].signal["x"]) == 50


@pytest.mark.parametrize(
    ("row", "found"),
    [("0.5,oops,1", "line 52: expected numbers"), ("0.5,1", "line 52: expected 3 cells"), ("0.5,NULL,1", "line 52")],
)
def test_an_odd_line_is_named(tmp_path: Path, row: str, found: str):
    path = written(tmp_path / "log.csv", ",", ".", "\n", "%.6g", False)
    path.write_text(path.read_text() + row + "\n")
    with pytest.raises(RecordingError, match=found):
        read_with(text.read, path)


def test_a_comment_between_rows_is_passed_over(tmp_path: Path):
    path = written(tmp_path / "log.csv", ",", ".", "\n", "%.6g", False)
    path.write_text(path.read_text() + "# stopped\n0.50,1.5,2.5\n")
    (stream,) = read_with(text.read, path)
    assert (len(stream.signal["x"]), stream.signal["x"][-1]) == (51, 1.5)
