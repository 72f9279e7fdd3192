"""Which sensors of a log are its signal: gyros, or accelerometers with `quantity="acceleration"`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from logs import read_with, write_hdf5, write_mat5, write_parquet

import gyrofuse as gf
from gyrofuse.io.formats import read_streams

N = 50
RATES = np.round(np.random.default_rng(0).standard_normal((3, N)), 6)
ACCELERATIONS = np.round(np.random.default_rng(1).standard_normal((3, N)) + np.array([[0], [0], [9.75]]), 6)
SUFFIXES = (".csv", ".npz", ".mat", ".h5", ".parquet")
UNITS = {"rate": "deg/s", "acceleration": "m/s^2"}
SPELLED = {"rate": "dps", "acceleration": "mps2"}  # in names of arrays


def write(path: Path, *quantities: str, units: bool = True) -> Path:
    """Write a log of one device at 100 Hz with these quantities; without `units` it says `unit: deg/s` of the whole."""
    values = {"rate": RATES, "acceleration": ACCELERATIONS}
    words = {"rate": "gyro", "acceleration": "acc"}
    whole = {} if units else {"unit": "deg/s"}
    if path.suffix in (".csv", ".parquet"):
        columns = {"time [s]": np.arange(N) / 100}
        for quantity in quantities:
            said = f" [{UNITS[quantity]}]" if units else ""
            columns |= {f"{words[quantity]}_{axis}{said}": values[quantity][i] for i, axis in enumerate("xyz")}
        if path.suffix == ".parquet":
            return write_parquet(path, columns, whole)
        head = [f"# {name}: {value}" for name, value in whole.items()] + [",".join(columns)]
        rows = [",".join(map(repr, row)) for row in np.column_stack(list(columns.values())).tolist()]
        path.write_text("\n".join([*head, *rows, ""]))
        return path
    if path.suffix == ".h5":
        stated = {
            words[quantity]: (values[quantity], {"unit": UNITS[quantity]} if units else {}) for quantity in quantities
        }
        return write_hdf5(path, stated, fs=100.0, **whole)
    # An array `gyro` of an .npz is sensors, not the axes of one.
    arrays = {
        f"imu_{words[quantity]}{f'_{SPELLED[quantity]}' if units else ''}": values[quantity] for quantity in quantities
    }
    if path.suffix == ".mat":
        return write_mat5(path, {**arrays, **whole, "fs": 100.0})
    np.savez(path, fs=100.0, **arrays, **whole)
    return path


every_format = pytest.mark.parametrize("suffix", SUFFIXES)


@every_format
def test_accelerometers_of_a_log_of_both(tmp_path: Path, suffix: str):
    recording = gf.read_recording(write(tmp_path / f"a{suffix}", "rate", "acceleration"), quantity="acceleration")
    assert (recording.quantity, recording.unit, recording.axes) == ("acceleration", "m/s^2", ("x", "y", "z"))
    assert recording.rate == pytest.approx(100)
    np.testing.assert_array_equal(recording.signal[:, 0], ACCELERATIONS)
    assert list(recording.channels) == ["angular_rate"]
    np.testing.assert_array_equal(recording.channels["angular_rate"], RATES)


@every_format
def test_gyros_of_a_log_of_both(tmp_path: Path, suffix: str):
    recording = gf.read_recording(write(tmp_path / f"a{suffix}", "rate", "acceleration"))
    assert (recording.quantity, recording.unit, recording.axes) == ("rate", "deg/s", ("x", "y", "z"))
    np.testing.assert_array_equal(recording.signal[:, 0], RATES)
    np.testing.assert_array_equal(recording.channels["acceleration"], ACCELERATIONS)


@every_format
def test_a_unit_of_the_other_quantity_says_nothing_of_this_one(tmp_path: Path, suffix: str):
    path = write(tmp_path / f"a{suffix}", "rate", "acceleration", units=False)
    (gyro,), (accelerometer,) = read_with(read_streams, path), read_with(read_streams, path, quantity="acceleration")
    assert (gyro.unit, accelerometer.unit) == ("deg/s", "unknown")


@every_format
@pytest.mark.parametrize(("quantity", "other"), [("rate", "acceleration"), ("acceleration", "rate")])
def test_a_log_of_one_alone(tmp_path: Path, suffix: str, quantity: str, other: str):
    path = write(tmp_path / f"a{suffix}", quantity)
    recording = gf.read_recording(path, quantity=quantity)
    assert (recording.quantity, recording.unit, recording.channels) == (quantity, UNITS[quantity], {})
    np.testing.assert_array_equal(recording.signal[:, 0], RATES if quantity == "rate" else ACCELERATIONS)
    with pytest.raises(
        gf.RecordingError, match=rf'{re.escape(path.name)}: expected .*quantity="{quantity}" \(--quantity'
    ):
        gf.read_recording(path, quantity=other)


def test_a_device_that_starts_from_zero_does_so_in_both(tmp_path: Path):
    path = tmp_path / "a.npz"
    rates, accelerations = RATES.copy(), ACCELERATIONS.copy()
    accelerations[:, 0] = 0
    np.savez(path, imu_gyr_dps=rates, imu_acc_mps2=accelerations, fs=100.0)
    assert not gf.read_recording(path, quantity="acceleration").signal.isnan().any()
    rates[:, 0] = 0
    np.savez(path, imu_gyr_dps=rates, imu_acc_mps2=accelerations, fs=100.0)
    recording = gf.read_recording(path, quantity="acceleration")
    assert recording.signal.isnan().sum() == 3
    assert any("the first sample is zero on every axis" in str(note) for note in recording.notes)
