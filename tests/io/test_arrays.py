"""Named arrays: which are gyros, where time runs, what goes with them."""

from pathlib import Path

import numpy as np
import pytest
from logs import made_up, request

from gyrofuse.io.formats.arrays import streams_from_arrays
from gyrofuse.io.streams import RecordingError

PATH = Path("board.npz")
GYRO = made_up(1)[0]  # (axis, time)


def read(content, key=None):
    return streams_from_arrays(content, request(PATH, key=key))


def test_the_names_of_an_npz_recording():
    array = made_up(2).reshape(6, -1)
    temperature, acceleration = made_up(seed=1)[0, 0], made_up(seed=2)[0]
    sensors = np.array(["left.x", "left.y", "left.z", "right.x", "right.y", "right.z"])
    time = np.arange(60) / 100
    streams = read(
        {
            "gyro": array,
            "fs": np.array(100),
            "unit": np.array("deg/s"),
            "sensors": sensors,
            "time": time,
            "temperature": temperature,
            "acceleration": acceleration,
            "supply": 2 * temperature,
        }
    )
    assert [stream.name for stream in streams] == sensors.tolist()
    for stream, row in zip(streams, array, strict=True):
        np.testing.assert_array_equal(stream.signal[""], row)
        np.testing.assert_array_equal(stream.time, time)
        assert (stream.unit, stream.rate) == ("deg/s", 100.0)
    assert streams[0].channels.keys() == {"temperature", "acceleration", "supply"}
    np.testing.assert_array_equal(streams[0].channels["acceleration"], acceleration)
    np.testing.assert_array_equal(streams[0].channels["supply"], 2 * temperature)
    assert all(stream.channels == {} for stream in streams[1:])


@pytest.mark.parametrize("name", ["gyro", "imu_gyr", "Gyroscope", "gyroBuffer", "angular_velocity"])
@pytest.mark.parametrize("orient", [np.asarray, np.transpose], ids=["axis_time", "time_axis"])
def test_three_rows_are_axes_in_either_orientation(name, orient):
    (stream,) = read({name: orient(GYRO)})
    assert stream.name == "board"
    assert list(stream.signal) == ["x", "y", "z"]
    np.testing.assert_array_equal(list(stream.signal.values()), GYRO)
    assert (stream.unit, stream.rate, stream.time) == ("unknown", None, None)


def test_sensors_name_three_rows_too():
    streams = read({"gyro": GYRO, "sensors": ["a", "b", "c"]})
    assert [(stream.name, list(stream.signal)) for stream in streams] == [("a", [""]), ("b", [""]), ("c", [""])]


@pytest.mark.parametrize("content", [{}, {"sensors": list("abbab")}], ids=["none", "two of them repeated"])
def test_rows_without_names_are_numbered(content):
    streams = read({"gyro": made_up(3).reshape(9, -1)[:5]} | content)
    assert [stream.name for stream in streams] == [f"board[{i}]" for i in range(5)]
    assert any("2 sensor names do not fit the 5 rows of 'gyro'" in n for n in streams[0].notes) == bool(content)


def test_one_array_per_axis():
    columns = {f"g{a}": row[:, None] for a, row in zip("xyz", GYRO, strict=True)}
    columns |= {f"a{a}": row for a, row in zip("xyz", 2 * GYRO, strict=True)}
    (stream,) = read(columns)
    np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], GYRO)
    np.testing.assert_array_equal(stream.channels["acceleration"], 2 * GYRO)


@pytest.mark.parametrize("row", [0, 3])
def test_a_row_that_never_decreases_is_the_clock(row):
    time = np.linspace(0.005, 0.6, 60)
    (stream,) = read({"gyroBuffer": np.insert(GYRO, row, time, axis=0).T})
    np.testing.assert_array_equal(stream.time, time)
    np.testing.assert_array_equal(list(stream.signal.values()), GYRO)
    assert f"row {row} of 'gyroBuffer' never decreases and is read as its time" in stream.notes


def test_four_rows_without_a_clock_are_sensors():
    assert len(read({"gyro": made_up(2).reshape(6, -1)[:4]})) == 4


def test_groups_are_devices_with_their_own_length_rate_and_unit():
    content = {
        "fs": 50,
        "unit": "deg/s",
        "imu1/gyro": GYRO.T,
        "imu1/temperature": GYRO[0],
        "imu2/gyro": GYRO[:, :40].T,
        "imu2/fs": np.array([[200.0]]),
        "imu2/gyro/unit": "rad/s",
        "imu2/time": np.arange(40) * 5.0,
        "imu2/time/unit": "ms",
    }
    first, second = read(content)
    assert (first.name, first.rate, first.unit, first.n_samples) == ("imu1", 50, "deg/s", 60)
    assert (second.name, second.rate, second.unit, second.n_samples) == ("imu2", 200, "rad/s", 40)
    assert first.time is None
    np.testing.assert_allclose(second.time, np.arange(40) * 0.005, rtol=0, atol=1e-15)
    assert (list(first.channels), list(second.channels)) == (["temperature"], [])
    assert [stream.name for stream in read(content, key="imu2")] == ["imu2"]


def test_axes_in_a_group_of_their_own():
    content = {f"imu3/gyro/{a}": row for a, row in zip("xyz", GYRO, strict=True)}
    content |= {f"imu3/acc/{a}": row for a, row in zip("xyz", 3 * GYRO, strict=True)}
    (stream,) = read(content)
    assert stream.name == "imu3"
    np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], GYRO)
    np.testing.assert_array_equal(stream.channels["acceleration"], 3 * GYRO)


@pytest.mark.parametrize(("tick", "rate"), [(1.0, 1.0), (1e-3, 100.0), (1e-6, 1000.0), (1e-9, 8000.0)])
def test_the_rate_tells_the_unit_of_a_clock(tick, rate):
    ticks = np.rint(np.arange(60) / rate / tick)
    (stream,) = read({"gyro": GYRO, "fs": rate, "t": ticks})
    np.testing.assert_allclose(stream.time, ticks * tick, rtol=1e-15)


def test_a_clock_with_holes_is_kept():
    time = np.arange(60) / 100
    time[[3, 9]] = np.nan, np.inf
    (stream,) = read({"gyro": GYRO, "fs": 100, "time": time})
    np.testing.assert_array_equal(stream.time, time)


@pytest.mark.parametrize("name", ["fs", "Fs", "rate", "sampling_rate", "SampleRate", "sampling_rate_Hz"])
def test_spellings_of_the_rate(name):
    assert read({"gyro": GYRO, name: 62.5})[0].rate == 62.5


@pytest.mark.parametrize("value", [0, -1.0, np.nan, "fast", np.arange(3)])
def test_a_rate_that_is_none(value):
    assert read({"gyro": GYRO, "fs": value})[0].rate is None


def test_key_names_an_array_whatever_its_name():
    content = {"gyro": GYRO, "omega_filtered": 2 * GYRO, "signal": 3 * GYRO, "temperature": GYRO[0]}
    (stream,) = read(content, key="signal")
    np.testing.assert_array_equal(list(stream.signal.values()), 3 * GYRO)
    assert list(stream.channels) == ["temperature"]


@pytest.mark.parametrize("sensors", [{}, {"sensors": list("abc")}], ids=["axes", "sensors"])
def test_a_second_array_of_the_same_device_is_left_out(sensors):
    streams = read({"gyro": GYRO, "raw_gyro": 2 * GYRO} | sensors)
    np.testing.assert_array_equal([row for stream in streams for row in stream.signal.values()], GYRO)
    assert "'raw_gyro' repeats an axis of the same device and is left out" in streams[0].notes


def test_non_finite_samples_stay():
    rates = GYRO.copy()
    rates[1, 4] = np.inf
    rates[2, 5] = np.nan
    (stream,) = read({"gyro": rates})
    np.testing.assert_array_equal(list(stream.signal.values()), rates)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ({}, "no array"),
        ({"voltage": GYRO}, r"voltage \(3, 60\)"),
        ({"gyro": np.zeros((3, 0)), "fs": np.ones((1, 1))}, r"gyro \(3, 0\)"),
        ({"gyro": np.zeros((2, 3, 60))}, r"gyro \(2, 3, 60\)"),
        ({"gyro_bias": np.zeros(3)}, r"gyro_bias \(3,\)"),
    ],
    ids=["empty", "other", "no samples", "three dimensions", "bias"],
)
def test_no_gyro_among_the_arrays(content, found):
    with pytest.raises(RecordingError, match=rf"board\.npz: expected an array .* found {found}; .*`key`"):
        read(content)


def test_a_key_that_is_not_there():
    with pytest.raises(RecordingError, match=r"in 'imu9', found gyro \(3, 60\)"):
        read({"gyro": GYRO}, key="imu9")
