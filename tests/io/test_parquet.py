"""Parquet files: columns, metadata, dates, and files that are none."""

import sys

import numpy as np
import pytest
from logs import made_up, read_with, regular_stamps, seconds, write_parquet

from gyrofuse.io.formats import parquet
from gyrofuse.io.streams import RecordingError


def columns_of(gyro):
    return {f"imu{d}_gyro_{a}": gyro[d, i] for d in range(len(gyro)) for i, a in enumerate("xyz")}


def test_columns_by_device(tmp_path):
    gyro, time = made_up(), np.arange(60) / 100
    content = {"time_s": time, **columns_of(gyro), "temperature": gyro[0, 0]}
    path = write_parquet(tmp_path / "a.parquet", content, {"fs": "100", "unit": "deg/s"})
    streams = read_with(parquet.read, path)
    assert [stream.name for stream in streams] == ["imu0", "imu1"]
    for device, stream in enumerate(streams):
        np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], gyro[device])
        np.testing.assert_allclose(stream.time, time, rtol=0, atol=1e-12)
        assert (stream.rate, stream.unit) == (100.0, "deg/s")
    np.testing.assert_array_equal(streams[0].channels["temperature"], gyro[0, 0])


def test_names_with_dots_and_no_metadata(tmp_path):
    gyro = made_up()[0]
    path = write_parquet(tmp_path / "a.parquet", {f"gyro.{a}": row for a, row in zip("xyz", gyro, strict=True)})
    (stream,) = read_with(parquet.read, path)
    np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], gyro)
    assert (stream.name, stream.unit, stream.rate, stream.time) == ("a", "unknown", None, None)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_dates_become_seconds_exactly(tmp_path, unit):
    import pyarrow as pa

    stamps = regular_stamps(rate=1.0, start=1_700_000_000 * 10**9)
    ticks = stamps // {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}[unit]
    dates = pa.array(ticks).cast(pa.timestamp(unit, tz="UTC"))
    (stream,) = read_with(parquet.read, write_parquet(tmp_path / "a.parquet", {"when": dates, "gx": made_up()[0, 0]}))
    np.testing.assert_array_equal(stream.time, seconds(stamps))


def test_a_null_is_nan_and_repeats_stay(tmp_path):
    content = {"gx": [1.0, None, 3.0, 3.0], "gy": [1, None, 3, 3], "t": [0.0, 0.01, 0.01, 0.03]}
    (stream,) = read_with(parquet.read, write_parquet(tmp_path / "a.parquet", content))
    np.testing.assert_array_equal(stream.signal["x"], [1, np.nan, 3, 3])
    np.testing.assert_array_equal(stream.signal["y"], [1, np.nan, 3, 3])
    np.testing.assert_array_equal(stream.time, content["t"])


def test_only_what_is_needed_is_read(tmp_path, monkeypatch):
    from pyarrow import parquet as library

    path = write_parquet(tmp_path / "a.parquet", {"gx": np.zeros(9), "note": ["text"] * 9, "voltage": np.zeros(9)})
    asked = []
    original = library.ParquetFile.read
    monkeypatch.setattr(
        library.ParquetFile, "read", lambda self, columns: asked.extend(columns) or original(self, columns)
    )
    read_with(parquet.read, path)
    assert asked == ["gx"]


def test_key_names_the_column(tmp_path):
    path = write_parquet(tmp_path / "a.parquet", {"gx": np.zeros(9), "voltage": np.arange(9.0)})
    (stream,) = read_with(parquet.read, path, key="voltage")
    np.testing.assert_array_equal(stream.signal[""], np.arange(9.0))
    assert list(read_with(parquet.read, path, key="gx")[0].signal) == ["x"]


def test_a_key_that_is_no_column(tmp_path):
    path = write_parquet(tmp_path / "a.parquet", {"gx": np.zeros(9), "note": ["text"] * 9})
    with pytest.raises(
        RecordingError, match=r"expected a column 'note' \(`key`\) of numbers, found 9 rows of gx, note"
    ):
        read_with(parquet.read, path, key="note")


def test_no_gyro_inside(tmp_path):
    path = write_parquet(tmp_path / "a.parquet", {"voltage": np.zeros(9), "note": ["text"] * 9})
    with pytest.raises(RecordingError, match=r"a\.parquet: expected a column .* found 9 rows of voltage, note"):
        read_with(parquet.read, path)


def test_no_rows(tmp_path):
    with pytest.raises(RecordingError, match=r"found 0 rows of gx"):
        read_with(parquet.read, write_parquet(tmp_path / "a.parquet", {"gx": np.zeros(0)}))


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.99])
def test_a_truncated_file(tmp_path, keep):
    path = write_parquet(tmp_path / "a.parquet", columns_of(made_up()))
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(RecordingError, match=r"a\.parquet: expected a Parquet file, found .*again"):
        read_with(parquet.read, path)


def test_damaged_pages(tmp_path):
    path = write_parquet(tmp_path / "a.parquet", columns_of(made_up(n_samples=2000)))
    content = bytearray(path.read_bytes())
    content[4:400] = bytes(396)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.parquet: expected a Parquet file"):
        read_with(parquet.read, path)


def test_the_right_name_with_the_wrong_content(tmp_path):
    path = tmp_path / "a.parquet"
    path.write_bytes(b"time,gx,gy,gz\n0,1,2,3\n" * 50)
    with pytest.raises(RecordingError, match=r"a\.parquet: expected a Parquet file"):
        read_with(parquet.read, path)


def test_the_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match=r'needs (\w+); pip install \1, or .* pip install "\.\[logs\]"'):
        read_with(parquet.read, tmp_path / "a.parquet")


def test_channels_may_be_written_to(tmp_path):
    path = write_parquet(tmp_path / "a.parquet", {"gx": made_up()[0, 0], "temperature": made_up()[0, 1]})
    (stream,) = read_with(parquet.read, path)
    assert stream.channels["temperature"].flags.writeable
