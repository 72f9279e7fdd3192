"""MATLAB files of both kinds, told apart by their content, and files that are none."""

import sys
from pathlib import Path

import numpy as np
import pytest
from logs import made_up, read_with, write_hdf5, write_mat5, write_mat73

from gyrofuse.io.formats import hdf5
from gyrofuse.io.formats.matlab import matlab
from gyrofuse.io.streams import RecordingError

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="real recordings (../shared/data) are not here")

either_version = pytest.mark.parametrize("write", [write_mat5, write_mat73])


@either_version
def test_arrays_beside_each_other(tmp_path, write):
    gyro, acceleration = made_up()
    content = {"imu_gyr": gyro.T, "imu_acc": acceleration.T, "sampling_rate": 62.5, "unit": "deg/s"}
    (stream,) = read_with(matlab.read, write(tmp_path / "a.mat", content))
    assert (stream.name, stream.rate, stream.unit) == ("a", 62.5, "deg/s")
    np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], gyro)
    np.testing.assert_array_equal(stream.channels["acceleration"], acceleration)


@either_version
def test_structs_are_devices(tmp_path, write):
    gyro = made_up()
    content = {f"imu{i}": {"gyro": gyro[i].T, "fs": 50.0 * (i + 1), "time": np.arange(60) / 50} for i in range(2)}
    path = write(tmp_path / "a.mat", content)
    streams = read_with(matlab.read, path)
    assert [(stream.name, stream.rate) for stream in streams] == [("imu0", 50.0), ("imu1", 100.0)]
    for i, stream in enumerate(streams):
        np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], gyro[i])
        np.testing.assert_allclose(stream.time, np.arange(60) / 50, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(read_with(matlab.read, path, key="imu1.gyro")[0].signal["z"], gyro[1, 2])


def test_an_array_of_structs(tmp_path):
    gyro = made_up()
    array = np.zeros(2, dtype=[("gyro", object)])
    array["gyro"] = [gyro[0].T, gyro[1].T]
    streams = read_with(matlab.read, write_mat5(tmp_path / "a.mat", {"imu": array}))
    assert [stream.name for stream in streams] == ["imu1", "imu2"]
    np.testing.assert_array_equal(streams[1].signal["y"], gyro[1, 1])


def test_a_cell_array_names_the_sensors(tmp_path):
    names = np.array(["left", "right", "a longer name"], dtype=object)
    streams = read_with(matlab.read, write_mat5(tmp_path / "a.mat", {"gyro": made_up()[0], "sensors": names}))
    assert [stream.name for stream in streams] == ["left", "right", "a longer name"]


def test_a_cell_array_of_version_73(tmp_path):
    import h5py

    path = write_mat73(tmp_path / "a.mat", {"gyro": made_up()[0].T, "#refs#": {"a": "left", "b": "right", "c": "top"}})
    with h5py.File(path, "r+") as file:
        references = np.array([[file["#refs#"][name].ref] for name in "abc"], dtype=h5py.ref_dtype)
        file.create_dataset("sensors", data=references).attrs["MATLAB_class"] = np.bytes_(b"cell")
    assert [stream.name for stream in read_with(matlab.read, path)] == ["left", "right", "top"]


def test_hdf5_without_the_header_of_matlab(tmp_path):
    (stream,) = read_with(matlab.read, write_hdf5(tmp_path / "a.mat", {"gyro": made_up()[0]}))
    assert stream.n_samples == 60


def test_sparse_matrices_are_passed_over(tmp_path):
    from scipy.sparse import csc_array

    content = {"gyro": made_up()[0], "selection": csc_array(np.eye(60))}
    assert len(read_with(matlab.read, write_mat5(tmp_path / "a.mat", content))) == 1


@either_version
@pytest.mark.parametrize("keep", [0.0, 0.02, 0.5, 0.95])
def test_a_truncated_file(tmp_path, write, keep):
    path = write(tmp_path / "a.mat", {"gyro": made_up(n_samples=2000)[0]})
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(RecordingError, match=r"a\.mat: expected an? (MATLAB|HDF5) file.*found .*again"):
        read_with(matlab.read, path)


@pytest.mark.parametrize("junk", [b"time,gx,gy,gz\n0,1,2,3\n" * 50, bytes(range(256)) * 8, bytes(600)])
def test_the_right_name_with_the_wrong_content(tmp_path, junk):
    path = tmp_path / "a.mat"
    path.write_bytes(junk)
    with pytest.raises(RecordingError, match=r"a\.mat: expected a"):
        read_with(matlab.read, path)


def test_a_missing_file(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.mat"):
        read_with(matlab.read, tmp_path / "none.mat")


@either_version
def test_no_gyro_inside(tmp_path, write):
    with pytest.raises(RecordingError, match=r"a\.mat: expected an array .* found voltage"):
        read_with(matlab.read, write(tmp_path / "a.mat", {"voltage": np.zeros(60)}))


def test_the_missing_library_is_named(tmp_path, monkeypatch):
    path = write_mat73(tmp_path / "a.mat", {"gyro": made_up()[0]})
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r'needs (\w+); pip install \1, or .* pip install "\.\[logs\]"'):
        read_with(matlab.read, path)


@needs_shared
def test_a_published_recording_reads_as_its_hdf5_twin():
    (stream,) = read_with(matlab.read, SHARED / "raw" / "broad_24_tapping.mat")
    (twin,) = read_with(hdf5.read, SHARED / "raw" / "broad_24_tapping.hdf5")
    assert (stream.name, stream.rate, stream.unit) == (twin.name, twin.rate, twin.unit)
    assert stream.channels.keys() == twin.channels.keys()
    for axis in "xyz":
        np.testing.assert_array_equal(stream.signal[axis], twin.signal[axis])
    for name in stream.channels:
        np.testing.assert_array_equal(stream.channels[name], twin.channels[name])


@needs_shared
def test_a_published_recording_of_version_73():
    import h5py

    path = SHARED / "raw" / "mpu6050_gyroscope_v73.mat"
    (stream,) = read_with(matlab.read, path)
    with h5py.File(path) as file:
        time, *gyro = file["gyroBuffer"][()]
    np.testing.assert_array_equal(stream.time, time)
    np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], gyro)
    assert stream.n_samples == 65067
    assert stream.n_samples / (stream.time[-1] - stream.time[0]) == pytest.approx(99.3, abs=0.1)
