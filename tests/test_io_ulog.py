"""PX4 ULog files: which topic is the array, its clock, what the logger says, and files that are none."""

import sys
from pathlib import Path

import numpy as np
import pytest
from logs import made_up, regular_stamps, seconds, write_ulog

from gyrofuse.io import ulog
from gyrofuse.io.stream import RecordingError

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="real recordings (../shared/data) are not here")

MICROSECONDS = 10_000_000  # a boot clock, as PX4 has


def single(values):
    return values.astype(np.float32).astype(np.float64)


def test_each_instance_of_sensor_gyro_is_a_device(tmp_path):
    gyro, stamps = made_up(3), regular_stamps(start=MICROSECONDS)
    temperature = 30 + made_up(3, seed=1)[:, 0]
    streams = ulog.read(write_ulog(tmp_path / "a.ulg", gyro, stamps, temperature=temperature))
    assert [stream.name for stream in streams] == ["sensor_gyro[0]", "sensor_gyro[1]", "sensor_gyro[2]"]
    for device, stream in enumerate(streams):
        np.testing.assert_allclose([stream.gyro[a] for a in "xyz"], single(gyro[device]), rtol=0, atol=1e-12)
        np.testing.assert_allclose(stream.time, seconds(stamps), rtol=0, atol=1e-12)
        np.testing.assert_allclose(stream.channels["temperature"], single(temperature[device]), rtol=0, atol=1e-12)
        assert stream.unit == "rad/s"
        assert stream.channel_units == {"temperature": "degC"}
        assert f"device_id {1000 + device}" in stream.notes
        assert stream.gyro["x"].dtype == stream.time.dtype == np.float64


def test_a_not_a_number_is_kept(tmp_path):
    gyro = made_up(1)
    gyro[0, 1, 7] = np.nan
    (stream,) = ulog.read(write_ulog(tmp_path / "a.ulg", gyro, regular_stamps()))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(stream.gyro["y"])), [7])


def test_sensor_combined_replaces_a_thinned_sensor_gyro(tmp_path):
    combined, stamps = made_up(1)[0], regular_stamps(rate=200)
    path = write_ulog(tmp_path / "a.ulg", made_up(2, 5), regular_stamps(5, rate=1), combined=(combined, stamps))
    (stream,) = ulog.read(path)
    assert stream.name == "sensor_combined[0]"
    np.testing.assert_allclose([stream.gyro[a] for a in "xyz"], single(combined), rtol=0, atol=1e-12)
    np.testing.assert_allclose(stream.time, stamps // 1000 / 1e6, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(stream.channels["acceleration"], np.outer([0, 0, -9.75], np.ones(60)))
    assert any("sensor_gyro (2 instances) was logged at 1 Hz only" in note for note in stream.notes)
    assert [stream.name for stream in ulog.read(path, key="sensor_gyro")] == ["sensor_gyro[0]", "sensor_gyro[1]"]


def test_sensor_gyro_is_the_array_at_a_comparable_rate(tmp_path):
    combined = (made_up(1)[0], regular_stamps(rate=400))
    path = write_ulog(tmp_path / "a.ulg", made_up(2), regular_stamps(rate=100), combined=combined)
    assert [stream.name for stream in ulog.read(path)] == ["sensor_gyro[0]", "sensor_gyro[1]"]
    assert [stream.name for stream in ulog.read(path, key="sensor_combined")] == ["sensor_combined[0]"]


def test_dropouts_and_ignored_topics_are_noted(tmp_path):
    path = write_ulog(
        tmp_path / "a.ulg", made_up(1), regular_stamps(), dropouts_ms=(20, 35), other_topics=("sensor_gyro_fifo",)
    )
    (stream,) = ulog.read(path)
    assert "the logger reports 2 dropouts, 55 ms in total" in stream.notes
    assert "sensor_gyro_fifo (1 instances) ignored" in stream.notes


def test_a_log_cut_off_in_flight_is_read_up_to_the_cut(tmp_path):
    gyro = made_up(1)
    path = write_ulog(tmp_path / "a.ulg", gyro, regular_stamps())
    path.write_bytes(path.read_bytes()[:-500])
    (stream,) = ulog.read(path)
    assert 0 < stream.n_samples < 60
    np.testing.assert_array_equal(stream.gyro["z"], single(gyro[0, 2, : stream.n_samples]))


def test_damage_in_the_middle_is_noted_and_nothing_is_printed(tmp_path, capsys):
    path = write_ulog(tmp_path / "a.ulg", made_up(2), regular_stamps())
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 300] = bytes(300)
    path.write_bytes(content)
    assert "part of the file is damaged and was skipped" in ulog.read(path)[0].notes
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("content", [b"", b"\x55\x4c\x6f\x67", b"not a log at all" * 20], ids=["empty", "cut", "junk"])
def test_a_file_that_is_no_ulog(tmp_path, content):
    path = tmp_path / "bad.ulg"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"bad\.ulg: expected a PX4 ULog file, found .*again"):
        ulog.read(path)


def test_a_missing_file(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.ulg"):
        ulog.read(tmp_path / "none.ulg")


def test_a_log_without_gyro_says_what_it_holds(tmp_path):
    path = write_ulog(tmp_path / "a.ulg", made_up(0), regular_stamps(), other_topics=("battery", "gps"))
    with pytest.raises(RecordingError, match=r"a\.ulg: expected a gyro topic .*found battery, gps"):
        ulog.read(path)


def test_a_key_that_is_not_in_the_log(tmp_path):
    path = write_ulog(tmp_path / "a.ulg", made_up(1), regular_stamps())
    with pytest.raises(RecordingError, match=r"named by `key`, got 'sensor_combined', found sensor_gyro"):
        ulog.read(path, key="sensor_combined")


def test_the_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(ImportError, match=r'pip install "gyrofuse\[logs\]"'):
        ulog.read(tmp_path / "a.ulg")


@needs_shared
def test_a_flight_with_one_gyro():
    from pyulog import ULog

    path = SHARED / "raw" / "px4_sample.ulg"
    (stream,) = ulog.read(path)
    fields = ULog(str(path)).get_dataset("sensor_combined").data
    assert stream.n_samples == 17070
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(stream.gyro[axis], fields[f"gyro_rad[{i}]"])
    np.testing.assert_allclose(stream.time * 1e6, fields["timestamp"], rtol=0, atol=1e-6)
    assert "the logger reports 4 dropouts, 119 ms in total" in stream.notes


@needs_shared
def test_a_flight_whose_sensor_gyro_is_thinned():
    path = SHARED / "raw" / "px4_sample_log_small.ulg"
    (stream,) = ulog.read(path)
    assert (stream.name, stream.n_samples) == ("sensor_combined[0]", 1298)
    assert 1 / np.median(np.diff(stream.time)) == pytest.approx(204.6, abs=0.1)
    assert [stream.n_samples for stream in ulog.read(path, key="sensor_gyro")] == [6, 6, 6]
