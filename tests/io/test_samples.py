"""One small log of each dialect: which rate, unit, devices, axes, channels, samples and notes come out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import gyrofuse as gf

SAMPLES = Path(__file__).parent / "samples"


@dataclass(frozen=True)
class Expected:
    """What a sample holds: `first` is the first sample of every sensor, of each axis where there are `axes`."""

    rate: float
    unit: str
    sensors: tuple[str, ...]
    axes: tuple[str, ...]
    channels: tuple[str, ...]
    n_samples: int
    first: object
    notes: tuple[str, ...] = ()


IMU = Expected(
    rate=400.0,
    unit="rad/s",
    sensors=("IMU[0]", "IMU[1]"),
    axes=("x", "y", "z"),
    channels=("acceleration[IMU[0]]", "temperature[IMU[0]]", "acceleration[IMU[1]]", "temperature[IMU[1]]"),
    n_samples=10,
    first=[[0.01, 0.01], [-0.02, -0.04], [0.5, 0.5]],
)
EXPECTED = {
    "ardupilot_imu.bin": IMU,
    "ardupilot_imu.log": IMU,
    "ardupilot_batch.bin": Expected(
        rate=1000.0,
        unit="rad/s",
        sensors=("ISBH[1]",),
        axes=("x", "y", "z"),
        channels=(),
        n_samples=96,
        first=[[0.0], [0.0], [0.005]],
        notes=("apart in time (1 of gyro 0, 1 of gyro 1): read is the longest run of this gyro without a gap, 96 s",),
    ),
    "px4_fifo.ulg": Expected(
        rate=8000.0,
        unit="rad/s",
        sensors=("sensor_gyro_fifo[0]",),
        axes=("x", "y", "z"),
        channels=("acceleration", "temperature"),
        n_samples=32,
        first=[[1 / 1024], [-1 / 1024], [7 / 1024]],
        notes=(
            "sensor_gyro (1 instances, 400 Hz) is not read: sensor_gyro_fifo has every sample",
            "acceleration has its own clock (4000 Hz): interpolated linearly to the signal's samples",
        ),
    ),
    "ros1_realsense.bag": Expected(
        rate=200.0,
        unit="rad/s",
        sensors=("/camera/gyro/sample",),
        axes=("x", "y", "z"),
        channels=("acceleration",),
        n_samples=20,
        first=[[1 / 64], [-0.25], [-0.25]],
        notes=(
            "angular velocities exactly zero throughout in /camera/accel/sample: no gyro",
            "acceleration has its own clock (62.5 Hz): interpolated linearly to the signal's samples",
        ),
    ),
    "ros2_vector.mcap": Expected(
        rate=100.0,
        unit="rad/s",
        sensors=("/imu/angular_velocity",),
        axes=("x", "y", "z"),
        channels=("magnetic_field", "pressure", "temperature"),
        n_samples=20,
        first=[[1 / 64], [-0.25], [-0.25]],
        notes=("magnetic_field is that of /imu/mag", "temperature is that of /imu/temperature"),
    ),
    "ardupilot_raw.bin": Expected(
        rate=2000.0,
        unit="rad/s",
        sensors=("GYR[0]",),
        axes=("x", "y", "z"),
        channels=("acceleration",),
        n_samples=20,
        first=[[0.25], [-0.5], [0.125]],
        notes=("acceleration has its own clock (1000 Hz): interpolated linearly to the signal's samples",),
    ),
    "px4_combined.ulg": Expected(
        rate=250.0,
        unit="rad/s",
        sensors=("sensor_combined[0]",),
        axes=("x", "y", "z"),
        channels=("acceleration",),
        n_samples=20,
        first=[[0.0], [-0.25], [0.5]],
        notes=("acceleration has its own clock (250 Hz)",),
    ),
    "ros2_vectors.mcap": Expected(
        rate=100.0,
        unit="rad/s",
        sensors=("/imu/angular_velocity",),
        axes=("x", "y", "z"),
        channels=("acceleration",),
        n_samples=20,
        first=[[1 / 64], [-0.25], [-0.25]],
        notes=("acceleration is that of /imu/acceleration",),
    ),
}
IMU_ACCELERATIONS = Expected(
    rate=400.0,
    unit="m/s^2",
    sensors=("IMU[0]", "IMU[1]"),
    axes=("x", "y", "z"),
    channels=("angular_rate[IMU[0]]", "temperature[IMU[0]]", "angular_rate[IMU[1]]", "temperature[IMU[1]]"),
    n_samples=10,
    first=[[0.25, 0.25], [-0.5, -0.5], [-9.75, -9.75]],
)
ACCELERATIONS = {
    "ardupilot_raw.bin": Expected(
        rate=1000.0,
        unit="m/s^2",
        sensors=("ACC[0]",),
        axes=("x", "y", "z"),
        channels=("angular_rate",),
        n_samples=10,
        first=[[0.5], [-0.25], [-9.75]],
        notes=("angular_rate has its own clock (2000 Hz): interpolated linearly to the signal's samples",),
    ),
    "ardupilot_batch.bin": Expected(
        rate=1000.0,
        unit="m/s^2",
        sensors=("ISBH[0]",),
        axes=("x", "y", "z"),
        channels=(),
        n_samples=64,
        first=[[0.0], [0.0], [0.005]],
        notes=("(1 of accelerometer 0, 1 of accelerometer 1): read is the longest run of this accelerometer",),
    ),
    "px4_combined.ulg": Expected(
        rate=250.0,
        unit="m/s^2",
        sensors=("sensor_combined[0]",),
        axes=("x", "y", "z"),
        channels=("angular_rate",),
        n_samples=20,
        first=[[0.0], [0.0], [-9.75]],
        notes=("angular_rate has its own clock (250 Hz)",),
    ),
    "ros2_vectors.mcap": Expected(
        rate=100.0,
        unit="m/s^2",
        sensors=("/imu/acceleration",),
        axes=("x", "y", "z"),
        channels=("angular_rate",),
        n_samples=20,
        first=[[0.5], [0.25], [9.75]],
        notes=("angular_rate is that of /imu/angular_velocity",),
    ),
    "ardupilot_imu.bin": IMU_ACCELERATIONS,
    "ardupilot_imu.log": IMU_ACCELERATIONS,
    "px4_fifo.ulg": Expected(
        rate=4000.0,
        unit="m/s^2",
        sensors=("sensor_accel_fifo[0]",),
        axes=("x", "y", "z"),
        channels=("angular_rate",),
        n_samples=16,
        first=[[0.0], [0.0], [7 / 16]],
        notes=("angular_rate has its own clock (8000 Hz): interpolated linearly to the signal's samples",),
    ),
    "ros1_realsense.bag": Expected(
        rate=62.5,
        unit="m/s^2",
        sensors=("/camera/accel/sample",),
        axes=("x", "y", "z"),
        channels=("angular_rate",),
        n_samples=7,
        first=[[0.0], [0.25], [-9.75]],
        notes=(
            "linear accelerations exactly zero throughout in /camera/gyro/sample: no accelerometer",
            "angular_rate has its own clock (200 Hz): interpolated linearly to the signal's samples",
        ),
    ),
}
ROWS = [
    *((name, "rate", expected) for name, expected in EXPECTED.items()),
    *((name, "acceleration", expected) for name, expected in ACCELERATIONS.items()),
]


@pytest.mark.parametrize(("name", "quantity", "expected"), ROWS, ids=[f"{name}-{what}" for name, what, _ in ROWS])
def test_a_sample_of_each_dialect(name: str, quantity: str, expected: Expected):
    recording = gf.read_recording(SAMPLES / name, quantity=quantity)
    assert recording.quantity == quantity
    assert recording.rate == pytest.approx(expected.rate, rel=1e-3)
    assert (recording.unit, recording.sensors, recording.axes) == (expected.unit, expected.sensors, expected.axes)
    assert tuple(recording.channels) == expected.channels
    assert recording.n_samples == expected.n_samples
    np.testing.assert_allclose(recording.signal[..., 0], expected.first, rtol=1e-6)
    for note in expected.notes:
        assert any(note in str(said) for said in recording.notes), [str(said) for said in recording.notes]


@pytest.mark.parametrize("name", sorted(EXPECTED.keys() - ACCELERATIONS.keys()))
def test_a_sample_of_gyros_alone_says_what_reads_them(name: str):
    with pytest.raises(
        gf.RecordingError, match=rf'{name}: expected .*it has gyros, which are read with quantity="rate"'
    ):
        gf.read_recording(SAMPLES / name, quantity="acceleration")


def test_every_sample_is_expected():
    assert {path.name for path in SAMPLES.iterdir() if path.is_file()} == {"README.md", *EXPECTED}
