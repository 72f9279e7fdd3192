"""HDF5 files: datasets, groups, attributes, and files that are none."""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from logs import made_up, read_with, write_hdf5

from gyrofuse import open_recording
from gyrofuse.io.formats import hdf5
from gyrofuse.io.streams import RecordingError

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="real recordings (../shared/data) are not here")


def test_the_names_of_an_npz_recording(tmp_path):
    gyro = made_up().reshape(6, -1)
    content = {"gyro": gyro, "fs": 100.0, "unit": "deg/s", "sensors": list("abcdef"), "temperature": gyro[0]}
    streams = read_with(hdf5.read, write_hdf5(tmp_path / "a.h5", content))
    assert [stream.name for stream in streams] == list("abcdef")
    np.testing.assert_array_equal([stream.signal[""] for stream in streams], gyro)
    assert (streams[0].rate, streams[0].unit, list(streams[0].channels)) == (100.0, "deg/s", ["temperature"])


def test_groups_with_attributes(tmp_path):
    gyro = made_up()
    content = {
        "imu1": {"gyro": (gyro[0].T, {"unit": "rad/s"}), "acc": (gyro[1].T, {"units": "m/s^2"})},
        "imu2": {"gyro": gyro[1].T, "time": (np.arange(60) * 10, {"unit": "ms"})},
    }
    first, second = read_with(hdf5.read, write_hdf5(tmp_path / "a.h5", content, sampling_rate=100, unit="deg/s"))
    assert (first.name, first.rate, first.unit) == ("imu1", 100.0, "rad/s")
    assert (second.name, second.rate, second.unit) == ("imu2", 100.0, "deg/s")
    assert first.channel_units == {"acceleration": "m/s^2"}
    np.testing.assert_array_equal([first.signal[a] for a in "xyz"], gyro[0])
    np.testing.assert_array_equal([second.signal[a] for a in "xyz"], gyro[1])
    np.testing.assert_allclose(second.time, np.arange(60) / 100, rtol=0, atol=1e-12)


def test_a_table(tmp_path):
    gyro = made_up()[0]
    table = np.zeros(60, dtype=[("t", "f8"), ("gx", "f4"), ("gy", "f8"), ("gz", "f8")])
    table["t"], table["gy"], table["gz"] = np.arange(60) / 100, gyro[1], gyro[2]
    (stream,) = read_with(hdf5.read, write_hdf5(tmp_path / "a.h5", {"log": table}))
    np.testing.assert_array_equal(stream.signal["z"], gyro[2])
    np.testing.assert_array_equal(stream.time, table["t"])


def test_what_is_not_needed_is_not_read(tmp_path, monkeypatch):
    import h5py

    path = write_hdf5(tmp_path / "a.h5", {"gyro": made_up()[0], "images": np.zeros((9, 9, 9)), "events": np.zeros(7)})
    read = []
    original = h5py.Dataset.__array__
    monkeypatch.setattr(h5py.Dataset, "__array__", lambda self, *a, **k: read.append(self.name) or original(self, *a))
    read_with(hdf5.read, path)
    assert read == ["/gyro"]


def test_key_is_a_dataset_or_a_group(tmp_path):
    gyro = made_up()
    path = write_hdf5(tmp_path / "a.h5", {"one": {"gyro": gyro[0]}, "two": {"rates": gyro[1]}})
    np.testing.assert_array_equal(read_with(hdf5.read, path, key="one")[0].signal["x"], gyro[0, 0])
    np.testing.assert_array_equal(read_with(hdf5.read, path, key="/two/rates")[0].signal["x"], gyro[1, 0])


@pytest.mark.parametrize("keep", [0.0, 0.2, 0.9])
def test_a_truncated_file(tmp_path, keep):
    path = write_hdf5(tmp_path / "a.h5", {"gyro": made_up(n_samples=2000)[0]})
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(RecordingError, match=r"a\.h5: expected an HDF5 file, found .*again"):
        read_with(hdf5.read, path)


def test_the_right_name_with_the_wrong_content(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(b"time,gx,gy,gz\n0,1,2,3\n" * 50)
    with pytest.raises(RecordingError, match=r"a\.h5: expected an HDF5 file"):
        read_with(hdf5.read, path)


def test_damaged_data(tmp_path):
    import h5py

    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("gyro", data=made_up(n_samples=2000)[0], compression="gzip")
        start = file["gyro"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[start : start + 100] = bytes(100)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.h5: expected an HDF5 file, found one that cannot be read"):
        read_with(hdf5.read, path)


def test_no_gyro_inside(tmp_path):
    with pytest.raises(RecordingError, match=r"a\.h5: expected an array .* found voltage \(60,\)"):
        read_with(hdf5.read, write_hdf5(tmp_path / "a.h5", {"voltage": np.zeros(60)}))


def test_the_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r'needs (\w+); pip install \1, or .* pip install "\.\[logs\]"'):
        read_with(hdf5.read, tmp_path / "a.h5")


@needs_shared
def test_a_published_recording():
    (stream,) = read_with(hdf5.read, SHARED / "raw" / "broad_24_tapping.hdf5")
    trials = np.load(SHARED / "broad_trials.npz")
    assert (stream.n_samples, stream.rate, stream.unit) == (57746, pytest.approx(285.714, abs=1e-3), "unknown")
    assert {name: values.shape[-1] for name, values in stream.channels.items()} == dict.fromkeys(
        ("acceleration", "magnetic_field", "movement", "opt_pos", "opt_quat"), 57746
    )
    name = next(name for name in trials.files if name.startswith("t24") and not name.endswith("_movement"))
    np.testing.assert_allclose([stream.signal[a] for a in "xyz"], trials[name][:3], rtol=1e-6, atol=1e-7)


def test_a_heap_in_which_the_library_would_go_round_for_ever(tmp_path):
    path = write_hdf5(tmp_path / "a.h5", {"gyro": made_up()[0], "sensors": list("abc")})
    content = bytearray(path.read_bytes())
    at = content.index(b"GCOL") + 16
    while int.from_bytes(content[at : at + 2], "little"):  # up to the free space, whose index is 0
        at += 16 + -(-int.from_bytes(content[at + 8 : at + 16], "little") // 8) * 8
    assert read_with(hdf5.read, path)
    content[at + 8 : at + 16] = bytes(8)
    path.write_bytes(content)
    for reader in (partial(read_with, hdf5.read), open_recording):
        with pytest.raises(RecordingError, match=rf"a\.h5: expected .*free space of 0 bytes at byte {at}"):
            reader(path)


def test_numbers_that_spell_a_heap_are_no_damage(tmp_path):
    gyro = np.zeros((3, 4000))
    gyro[0, :2] = np.frombuffer(b"GCOL\x01\0\0\0" + (1 << 20).to_bytes(8, "little"))
    (stream,) = read_with(hdf5.read, write_hdf5(tmp_path / "a.h5", {"gyro": gyro}))
    np.testing.assert_array_equal(stream.signal["x"], gyro[0])
