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
            "acceleration has its own clock (4000 Hz): interpolated linearly to the gyro's samples",
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
            "acceleration has its own clock (62.5 Hz): interpolated linearly to the gyro's samples",
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
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_sample_of_each_dialect(name: str):
    recording, expected = gf.read_recording(SAMPLES / name), EXPECTED[name]
    assert recording.rate == pytest.approx(expected.rate, rel=1e-3)
    assert (recording.unit, recording.sensors, recording.axes) == (expected.unit, expected.sensors, expected.axes)
    assert tuple(recording.channels) == expected.channels
    assert recording.n_samples == expected.n_samples
    np.testing.assert_allclose(recording.signal[..., 0], expected.first, rtol=1e-6)
    for note in expected.notes:
        assert any(note in str(said) for said in recording.notes), [str(said) for said in recording.notes]


def test_every_sample_is_expected():
    assert {path.name for path in SAMPLES.iterdir() if path.is_file()} == {"README.md", *EXPECTED}
