"""Whatever the input: what is written is read back, and what cannot be read is refused by name (Hypothesis)."""

from __future__ import annotations

import string
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from logs import read_with

import gyrofuse as gf
from gyrofuse.io.formats.text import text
from gyrofuse.io.streams import RecordingError

# The same examples in every run, and no limit in time: an example that fails here fails everywhere.
fixed = settings(derandomize=True, deadline=None, max_examples=200, database=None)


def outcome(read: Callable[[Any], Any], source: object, refusal: type[Exception]) -> tuple[Any, str]:
    """What was read, or nothing and the message of the refusal; any other exception is a failure."""
    try:
        return read(source), ""
    except refusal as error:
        return None, str(error)


positive = st.floats(1e-300, 1e300)
unit = st.floats(-1, 1, exclude_min=True, exclude_max=True)
once = st.fixed_dictionaries(
    {
        gf.WhiteNoise: st.none() | positive,
        gf.QuantizationNoise: st.none() | positive,
        gf.RandomWalk: st.none() | positive,
        gf.Drift: st.none() | st.floats(-1e300, 1e300),
    }
)


@st.composite
def models(draw: st.DrawFn) -> gf.Model:
    """Models of any processes, each parameter known or to be estimated."""
    maybe = lambda values: draw(st.none() | values)  # noqa: E731
    processes = [kind(value) for kind, value in draw(once).items() if draw(st.booleans())]
    processes += [gf.AR1(phi=maybe(unit), variance=maybe(positive)) for _ in range(draw(st.integers(0, 4)))]
    angle = st.floats(1e-9, 3.1)
    processes += [gf.Sinusoid(amplitude=maybe(positive), beta=maybe(angle)) for _ in range(draw(st.integers(0, 3)))]
    return gf.Model(draw(st.permutations(processes))) if processes else gf.Model([gf.WhiteNoise()])


@fixed
@given(models())
def test_a_model_is_read_back_from_what_it_prints_and_from_its_dictionary(model: gf.Model):
    assert gf.parse_model(str(model)).to_dict() == model.to_dict()
    assert gf.model_from_dict(model.to_dict()).to_dict() == model.to_dict()


tokens = st.sampled_from(
    [*"+-*/()=,.[]{}:'\"#\\\n", "WN", "AR1", "rw", "SIN", "2", "1e999", "0x1f", "phi", "variance", "=", "lambda", "**"]
)


@fixed
@given(st.text(max_size=60) | st.lists(tokens, max_size=30).map("".join))
def test_any_other_formula_is_refused_by_name(formula: str):
    model, refusal = outcome(gf.parse_model, formula, ValueError)
    if model is None:
        assert any(words in refusal for words in ("`formula`", "` of ", "appears more than once"))
    else:
        assert isinstance(model, gf.Model)


numbers = st.floats(-1e6, 1e6).map(lambda value: value + 0.0)  # -0.0 is 0.0


@st.composite
def tables(draw: st.DrawFn) -> tuple[str, np.ndarray]:
    """Text of a log of one to three axes in some dialect, and the numbers in it: time, then axes."""
    delimiter, decimal = draw(st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")]))
    end, trailing = draw(st.sampled_from(["\n", "\r\n", "\r"])), draw(st.booleans())
    names = ["t", "gx", "gy", "gz"][: draw(st.integers(2, 4))]
    n_rows = draw(st.integers(3, 12))
    steps = draw(st.lists(st.integers(1, 9), min_size=n_rows, max_size=n_rows))
    time = np.cumsum(steps) / 128
    signal = draw(st.lists(st.tuples(*[numbers] * (len(names) - 1)), min_size=n_rows, max_size=n_rows))
    values = np.column_stack([time, np.array(signal)])
    lines = [delimiter.join(names)] + [
        delimiter.join(repr(cell).replace(".", decimal) for cell in row) for row in values.tolist()
    ]
    return end.join(line + delimiter * trailing for line in lines) + end, values.T


@fixed
@given(tables())
def test_a_table_is_read_back_in_every_dialect(table: tuple[str, np.ndarray]):
    content, (time, *signal) = table
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        path.write_bytes(content.encode())
        (stream,) = read_with(text.read, path)
    np.testing.assert_array_equal(list(stream.signal.values()), signal)
    np.testing.assert_array_equal(stream.time, time)


words = st.sampled_from(["t", "gx", "gyro_x", "nan", "inf", "1e999", "1_000", "٣", "12:00:01", "0x1p3", "9" * 400, ""])
cells = words | st.text(string.printable, max_size=5) | st.floats().map(repr)
lines = st.lists(st.lists(cells, max_size=5).map(",".join), max_size=12).map("\n".join)


@fixed
@given(st.binary(max_size=200) | lines.map(str.encode) | st.text(max_size=100).map(str.encode))
def test_any_other_file_is_read_or_refused_with_its_name(content: bytes):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        path.write_bytes(content)
        recording, refusal = outcome(gf.read_recording, path, RecordingError)
    if recording is None:
        assert "log.csv" in refusal
    else:
        assert recording.n_samples > 0
        assert recording.summary()
