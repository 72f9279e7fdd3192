"""One sample of each dialect of text: what is read from it, and what is said."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pytest
from logs import read_with

import gyrofuse as gf
from gyrofuse.io.clock import grid_of
from gyrofuse.io.formats import read_streams

SAMPLES = Path(__file__).parent / "samples" / "text"
ACCELERATION, TEMPERATURE = "acceleration", "temperature"
FIRST = {"x": 0.004802, "y": -0.008522, "z": -0.001602}
TENFOLD = {"x": 0.048017, "y": -0.085219, "z": -0.01602}
IMU = "the columns are a sensor_msgs/Imu, whose rates are rad/s and accelerations m/s^2"


class Sample(NamedTuple):
    """What a file is read as: the first rate of each axis, units of the channels, and a part of each note in order."""

    file: str
    rate: float | None
    unit: str
    first: dict[str, float]
    channels: Mapping[str, str | None] = MappingProxyType({})
    notes: tuple[str, ...] = ()


READ = [
    Sample(
        "xsens_mti.txt",
        100.0,
        "rad/s",
        FIRST,
        {ACCELERATION: "m/s^2"},
        (
            "comments are those of MT Manager of Xsens, whose rates are rad/s unless its settings were changed",
            "'SampleTimeFine' is read as ticks of 10 kHz, as an Xsens MTi counts them: a step of 100 is nearest to the "
            "stated 100 Hz",
            "the clock wrapped 1 times, every 86400 s",
        ),
    ),
    Sample(
        "xsens_mtw.txt",
        100.0,
        "rad/s",
        FIRST,
        {ACCELERATION: "m/s^2"},
        (
            "those of MT Manager",
            "there is no clock: samples are placed by PacketCounter at the stated 100 Hz",
            "'SampleTimeFine' holds no reading and is left out",
        ),
    ),
    Sample(
        "xsens_dot.csv",
        1e6 / 16667,
        "deg/s",
        {"x": 0.240085, "y": -0.426096, "z": -0.0801},
        {ACCELERATION: "m/s^2"},
        (
            "comments are those of an Xsens DOT, whose rates are deg/s",
            "is read as microseconds, as an Xsens DOT counts them",
            "wrapped 1 times, every 4294.97 s",
        ),
    ),
    Sample(
        "rostopic_echo.csv",
        200.0,
        "rad/s",
        FIRST,
        {ACCELERATION: "m/s^2"},
        (IMU, "'field.header.stamp' states no unit: read as ns in which its readings are dates"),
    ),
    Sample(
        "bagpy_imu.csv",
        200.0,
        "rad/s",
        FIRST,
        {ACCELERATION: "m/s^2"},
        (IMU, "'header.stamp.secs' and 'header.stamp.nsecs' are read as one clock: seconds and ns"),
    ),
    Sample(
        "ros2_topic_echo.csv",
        200.0,
        "rad/s",
        FIRST,
        {ACCELERATION: "m/s^2"},
        (
            "there is no header; the 40 cells of a line are read as those of a sensor_msgs/Imu",
            IMU,
            "'header.stamp.sec' and 'header.stamp.nanosec' are read as one clock: seconds and ns",
        ),
    ),
    Sample(
        "ros2_topic_echo_no_header.csv",
        None,
        "rad/s",
        FIRST,
        {ACCELERATION: "m/s^2"},
        ("there is no header; the 37 cells", IMU),
    ),
    Sample("openimu.csv", 100.0, "deg/s", TENFOLD, {ACCELERATION: "m/s^2", "magnetic_field": "G"}),
    Sample("rate_x.csv", 50.0, "mrad/s", {"x": 0.7203, "y": -1.2783, "z": -0.2403}),
    Sample(
        "p_q_r.csv",
        50.0,
        "unknown",
        FIRST,
        {ACCELERATION: None},
        ("columns p, q, r are read as the rates about x, y, z", "time column 't' states no unit: read as s from"),
    ),
    Sample("gps_seconds.txt", 200.0, "deg/h", {"x": 9.603, "y": -17.044, "z": -3.204}, {ACCELERATION: "ug"}),
    Sample("zeit.csv", 100.0, "deg/s", TENFOLD, {TEMPERATURE: "degC"}, ("is read as Windows-1252",)),
    Sample("iso_8601.csv", 100.0, "rad/s", FIRST, {}, ("'timestamp' holds dates and is read as time",)),
    Sample(
        "time_of_day.csv",
        100.0,
        "deg/s",
        TENFOLD,
        {},
        ("'Time' holds times of day, which begin again at midnight", "the clock wrapped 1 times, every 86400 s"),
    ),
    Sample("dates_between_blanks.txt", 200.0, "unknown", FIRST, {}, ("'time' holds times of day",)),
    Sample(
        "matlab_timetable.csv",
        100.0,
        "unknown",
        FIRST,
        {},
        ("'Timestamp' holds dates", "columns X, Y, Z name no sensor and are read as a gyro's"),
    ),
    Sample(
        "witmotion.txt",
        100.0,
        "deg/s",
        {"x": 0.12, "y": -0.213, "z": -0.04},
        {ACCELERATION: "g", TEMPERATURE: "degC"},
        ("'ChipTime()' holds no numbers and is left out", "'time' holds dates"),
    ),
    Sample("euroc.csv", 200.0, "rad/s", FIRST, {ACCELERATION: "m/s^2"}),
    Sample("row_of_units.csv", 100.0, "deg/s", TENFOLD, {TEMPERATURE: "degC"}, ("line 2 holds the units",)),
    Sample("sec_nsec.csv", 200.0, "unknown", FIRST, {}, ("'sec' and 'nsec' are read as one clock: seconds and ns",)),
    Sample(
        "adis_evaluation.csv",
        None,
        "counts",
        {"x": 1 * 65536 + 30497, "y": -3 * 65536 + 26170, "z": -1 * 65536 + 33497},
        {ACCELERATION: "counts", TEMPERATURE: "counts"},
        ("X_GYRO_OUT to Z_ACCL_OUT and their LOW words are read as one number of 32 bits each",),
    ),
    Sample(
        "blackbox_explorer.csv",
        2000.0,
        "deg/s",
        {"x": 0.0, "y": -2.0, "z": 0.0},
        {ACCELERATION: "g"},
        ("gyroUnfilt, the gyro before the filters of the flight controller, is taken and gyroADC",),
    ),
    Sample(
        "blackbox_decode.csv",
        2000.0,
        "deg/s",
        {"x": 2.0, "y": -4.0, "z": -1.0},
        {ACCELERATION: "counts"},
        ("gyroADC is the gyro behind the filters", "rates are read as deg/s, in which Betaflight and INAV log"),
    ),
    Sample("st_datalog.txt", 100.0, "mdeg/s", {"x": 216.0, "y": -383.0, "z": -72.0}, {ACCELERATION: "mg"}),
    Sample(
        "st_hsdatalog.csv",
        104.0,
        "mdeg/s",
        {"x": 216.08, "y": -383.49, "z": -72.09},
        {},
        ("'Time' states no unit: read as s from its median step",),
    ),
    Sample("phyphox.csv", 400.0, "rad/s", FIRST),
    Sample(
        "sensor_logger_gyroscope.csv",
        100.0,
        "unknown",
        FIRST,
        {},
        ("columns z, y, x name no sensor", "'time' states no unit: read as ns in which its readings are dates"),
    ),
    Sample("vectornav.csv", 200.0, "unknown", FIRST, {ACCELERATION: None, TEMPERATURE: "degC"}),
    Sample(
        "vectornav_instinct.csv",
        200.0,
        "unknown",
        FIRST,
        {ACCELERATION: None, TEMPERATURE: None},
        (
            "named UnComp, without the corrections of the filter on board, are taken",
            "'TimeStartup' states no unit: read as ns from its median step",
        ),
    ),
    Sample(
        "microcontroller.csv",
        200.0,
        "deg/s",
        {"x": 0.120042, "y": -0.213048, "z": -0.04005},
        {ACCELERATION: "g", TEMPERATURE: "degC"},
    ),
]


@pytest.mark.parametrize("sample", READ, ids=lambda sample: sample.file)
def test_a_sample(sample: Sample):
    path = SAMPLES / sample.file
    (stream,) = read_with(read_streams, path)
    notes, rate = list(stream.notes), stream.rate
    if stream.time is not None:
        grid = grid_of(
            stream.time, name=stream.name, source=path.name, clock_period=stream.clock_period, nominal=stream.rate
        )
        np.testing.assert_array_equal(grid.slots, np.arange(20))
        notes, rate = [*notes, *map(str, grid.notes)], grid.rate
    assert rate == (sample.rate and pytest.approx(sample.rate, rel=3e-6))
    assert (stream.name, stream.unit, stream.n_samples) == (path.stem, sample.unit, 20)
    assert {axis: values[0] for axis, values in stream.signal.items()} == pytest.approx(sample.first, abs=1e-12)
    assert {name: stream.channel_units.get(name) for name in stream.channels} == dict(sample.channels)
    assert {name: values.shape for name, values in stream.channels.items()} == {
        name: (20,) if name == TEMPERATURE else (3, 20) for name in sample.channels
    }
    assert len(notes) == len(sample.notes), notes
    for note, part in zip(notes, sample.notes, strict=True):
        assert part in note
    recording = gf.read_recording(path, rate=None if sample.rate else 100.0)
    assert recording.n_samples == 20
    assert {part for part in sample.notes if not any(part in str(note) for note in recording.notes)} == set()


def test_every_sample_is_read_and_told_of():
    files = {path.name for path in SAMPLES.iterdir()} - {"README.md"}
    assert files == {sample.file for sample in READ}
    told = (SAMPLES / "README.md").read_text(encoding="utf-8")
    assert {name for name in files if f"`{name}`" not in told} == set()


def test_the_acceleration_of_a_register_is_32_bits():
    (stream,) = read_with(read_streams, SAMPLES / "adis_evaluation.csv")
    assert stream.channels[ACCELERATION][:, 0].tolist() == [
        1 * 65536 + 64627,
        -3 * 65536 + 58893,
        801 * 65536 + 60792,
    ]


def test_counts_of_a_flight_controller_are_g():
    (stream,) = read_with(read_streams, SAMPLES / "blackbox_explorer.csv")
    assert stream.channels[ACCELERATION][2].mean() == pytest.approx(1, abs=0.02)


def test_the_filtered_gyro_is_read_by_its_name():
    (stream,) = read_with(read_streams, SAMPLES / "blackbox_explorer.csv", key="ADC")
    assert [values[0] for values in stream.signal.values()] == [2, -4, -1]
    assert stream.unit == "deg/s"
