"""Recordings made by hand, saved, read back, and assembled from logs."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from logs import made_up, regular_stamps, write_hdf5, write_ros1, write_ros2, write_ulog

import gyrofuse as gf

MOUNTED_ON_THE_BACK = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]


def kinds(recording: gf.Recording) -> set[str]:
    return {note.kind for note in recording.notes}


def signal(n_sensors: int = 3, n_samples: int = 50) -> torch.Tensor:
    return torch.randn(n_sensors, n_samples, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


class TestByHand:
    def test_defaults(self):
        recording = gf.Recording(signal(), rate=100)
        assert recording.sensors == ("1", "2", "3")
        assert recording.unit == "unknown"
        assert recording.time[-1].item() == pytest.approx(0.49)
        assert recording.duration == pytest.approx(0.5)
        assert (recording.n_sensors, recording.n_samples) == (3, 50)

    @pytest.mark.parametrize("rate", [0, -1.0, float("nan"), float("inf")])
    def test_rate(self, rate: float):
        with pytest.raises(ValueError, match="`rate`: expected a finite number > 0"):
            gf.Recording(signal(), rate=rate)

    def test_names_have_to_fit(self):
        with pytest.raises(ValueError, match="`sensors`: expected 3 names"):
            gf.Recording(signal(), rate=1, sensors=("a", "b"))
        with pytest.raises(ValueError, match="`axes`: expected one name for each entry"):
            gf.Recording(signal(), rate=1, axes=("x", "y", "z"))
        with pytest.raises(ValueError, match="`channels`: expected time \\(50\\) last in 'temperature'"):
            gf.Recording(signal(), rate=1, channels={"temperature": torch.zeros(49)})
        with pytest.raises(ValueError, match="`time`: expected shape \\(50,\\)"):
            gf.Recording(signal(), rate=1, time=torch.zeros(3))
        with pytest.raises(ValueError, match="`sensors`: expected a name of its own for each sensor, got 'a' twice"):
            gf.Recording(signal(), rate=1, sensors=("a", "b", "a"))
        time = torch.arange(50.0)
        time[[20, 21]] = time[[21, 20]]
        with pytest.raises(ValueError, match=r"`time`: expected times of a grid.* got 20 s after 21 s at sample 21"):
            gf.Recording(signal(), rate=1, time=time)

    def test_select_and_convert(self):
        recording = gf.Recording(
            signal(6).view(2, 3, 50), rate=1, unit="deg/s", axes=("x", "y"), sensors=("a", "b", "c")
        )
        part = recording.select(axis="y", sensors=["c", 0]).to("rad/s")
        expected = torch.deg2rad(recording.signal[1, [2, 0]])
        torch.testing.assert_close(part.signal, expected)
        assert (part.sensors, part.axes, part.unit) == (("c", "a"), (), "rad/s")
        for twice in (["b", "a", "b"], [1, 1], ["b", 1]):
            with pytest.raises(ValueError, match="`sensors`: expected each sensor once, got 'b' twice; name it once"):
                recording.select(sensors=twice)
        with pytest.raises(ValueError, match="`axis`: expected one of 'x', 'y', got 'z'"):
            recording.select(axis="z")
        with pytest.raises(ValueError, match="`sensors`: expected some of 'a', 'b', 'c', got 'd'"):
            recording.select(sensors=["d"])

    def test_between(self):
        temperature = torch.arange(50.0)
        recording = gf.Recording(signal(), rate=10, channels={"temperature": temperature})
        part = recording.between(1.0, 3.05)
        torch.testing.assert_close(part.signal, recording.signal[:, 10:30])
        torch.testing.assert_close(part.channels["temperature"], temperature[10:30])
        assert part.time[0].item() == pytest.approx(1.0)
        with pytest.raises(ValueError, match="expected a stretch within 0 to 5 s, got 6 to 7 s"):
            recording.between(6, 7)

    def test_longest_whole(self):
        values = signal()
        values[0, 10], values[1, 35], values[2, 36] = torch.nan, torch.inf, torch.nan
        recording = gf.Recording(values, rate=10, channels={"temperature": torch.arange(50.0)})
        part = recording.longest_whole()
        torch.testing.assert_close(part.signal, values[:, 11:35])
        assert part.time[0].item() == pytest.approx(1.1)
        assert part.channels["temperature"][0] == 11
        values[2] = torch.nan  # passed over
        assert gf.Recording(values.expand(2, 3, 50), rate=10).longest_whole().n_samples == 24
        values[:2, ::2], values[2, 1::2] = torch.nan, 0.0
        values[1, 1::2] = torch.nan
        values[1, 0] = 1.0
        with pytest.raises(ValueError, match="`signal`: expected a time at which all of '1', '2', '3' have a sample"):
            gf.Recording(values, rate=10).longest_whole()

    def test_summary_and_dict_are_reproducible(self):
        values = signal()
        values[1, 10:20] = torch.nan
        recording = gf.Recording(values, rate=100, unit="deg/s")
        assert "20 % of the sensor that lacks most" in recording.summary()
        assert json.loads(json.dumps(recording.to_dict()))["missing"] == [0, 0.2, 0]
        assert str(recording) == recording.summary()


class TestSaved:
    def test_round_trip(self, tmp_path: Path):
        values = signal(6).view(2, 3, 50)
        values[0, 0, 3] = torch.nan
        channels = {"temperature": torch.arange(50.0, dtype=torch.float64), "acceleration": signal()}
        before = gf.Recording(
            values, rate=37.5, unit="rad/s", axes=("x", "y"), sensors=("a", "b", "c"), channels=channels
        )
        before.save(tmp_path / "r.npz")
        after = gf.read_recording(tmp_path / "r.npz")
        torch.testing.assert_close(after.signal, before.signal, equal_nan=True, rtol=0, atol=0)
        assert after.rate == pytest.approx(37.5)
        assert (after.unit, after.axes, after.sensors) == ("rad/s", ("x", "y"), ("a", "b", "c"))
        for name, expected in channels.items():
            torch.testing.assert_close(after.channels[name], expected)

    def test_existing_file_stays_without_force(self, tmp_path: Path):
        path = tmp_path / "r.npz"
        path.write_bytes(b"mine")
        recording = gf.Recording(signal(), rate=1)
        with pytest.raises(FileExistsError, match="exists already"):
            recording.save(path)
        assert path.read_bytes() == b"mine"
        recording.save(path, force=True)
        assert gf.read_recording(path).n_sensors == 3
        assert [p.name for p in tmp_path.iterdir()] == ["r.npz"]

    def test_channel_with_a_name_of_the_format(self, tmp_path: Path):
        recording = gf.Recording(signal(), rate=1, channels={"time": torch.zeros(50)})
        with pytest.raises(ValueError, match="`channels`: the names time mean something else in a file"):
            recording.save(tmp_path / "r.npz")

    def test_bad_names(self, tmp_path: Path):
        with pytest.raises(ValueError, match=r"ends in \.npz"):
            gf.Recording(signal(), rate=1).save(tmp_path / "r.csv")
        with pytest.raises(FileNotFoundError, match="does not exist"):
            gf.Recording(signal(), rate=1).save(tmp_path / "no" / "r.npz")

    @pytest.mark.parametrize("name", ["file", "allow_pickle", "args", "arr_0"])
    def test_channels_may_have_any_name(self, tmp_path: Path, name: str):
        """Names that a function which writes arrays may have for arguments of its own."""
        values = torch.arange(50, dtype=torch.float64)
        gf.Recording(signal(), rate=1.0, channels={name: values}).save(tmp_path / "r.npz")
        torch.testing.assert_close(gf.read_recording(tmp_path / "r.npz").channels[name], values)


def write_csv(path: Path, gyro: np.ndarray, start: float, rate: float = 100.0, names: str = "gx,gy,gz") -> Path:
    time = start + np.arange(gyro.shape[1]) / rate
    np.savetxt(path, np.vstack([time, gyro]).T, delimiter=",", header="time_s," + names, comments="", fmt="%.9f")
    return path


class TestAssembled:
    def test_the_axes_of_one_device_are_no_array(self, tmp_path: Path):
        gyro = signal().numpy()
        recording = gf.read_recording(write_csv(tmp_path / "a.csv", gyro, 0.0))
        assert (recording.axes, recording.sensors) == (("x", "y", "z"), ("a",))
        np.testing.assert_allclose(recording.signal[:, 0].numpy(), gyro, atol=1e-8)
        alone = recording.axes_as_sensors()
        assert (alone.axes, alone.sensors) == ((), ("x", "y", "z"))
        assert torch.equal(alone.signal, recording.signal[:, 0])
        assert alone.axes_as_sensors() is alone

    def test_several_files_are_one_array(self, tmp_path: Path):
        a, b = signal(3, 400).numpy(), signal(6, 300).numpy()[3:]
        paths = [write_csv(tmp_path / "a.csv", a, 10.0), write_csv(tmp_path / "b.csv", b, 10.5)]
        recording = gf.read_recording(paths)
        assert recording.signal.shape == (3, 2, 300)
        assert (recording.axes, recording.sensors) == (("x", "y", "z"), ("a", "b"))
        assert {"offset", "cut"} <= kinds(recording)
        np.testing.assert_allclose(recording.signal[:, 0].numpy(), a[:, 50:350], atol=1e-8)
        np.testing.assert_allclose(recording.signal[:, 1].numpy(), b, atol=1e-8)
        z = gf.read_recording(paths, axis="z", sensors=["b"])
        np.testing.assert_allclose(z.signal.numpy(), b[2:], atol=1e-8)
        assert z.axes == ()

    def test_units_are_converted_to_the_first(self, tmp_path: Path):
        gyro = signal().numpy()
        one = write_csv(tmp_path / "a.csv", gyro, 0.0, names="gx_dps,gy_dps,gz_dps")
        other = write_csv(tmp_path / "b.csv", np.deg2rad(gyro), 0.0, names="gx_rads,gy_rads,gz_rads")
        recording = gf.read_recording([one, other])
        assert recording.unit == "deg/s"
        np.testing.assert_allclose(recording.signal[:, 0].numpy(), recording.signal[:, 1].numpy(), atol=1e-6)

    def test_counts_with_a_scale(self, tmp_path: Path):
        path = tmp_path / "a.csv"
        np.savetxt(path, np.arange(20).reshape(10, 2), delimiter=",", fmt="%d")
        recording = gf.read_recording(path, rate=50, scale=0.5, unit="deg/s")
        assert recording.unit == "deg/s"
        assert recording.signal[1].tolist() == [0.5 + i for i in range(10)]

    def test_missing_and_infinite_samples_are_nan_and_noted(self, tmp_path: Path):
        values = signal().numpy()
        values[0, 4], values[1, 7] = np.nan, np.inf
        np.savez(tmp_path / "a.npz", gyro=values, fs=100.0)
        recording = gf.read_recording(tmp_path / "a.npz")
        assert recording.signal.isnan().nonzero().tolist() == [[0, 4], [1, 7]]
        assert "non_finite" in kinds(recording)

    def test_start_up_row_of_zeros(self, tmp_path: Path):
        gyro = signal().numpy()
        gyro[:, 0] = 0
        recording = gf.read_recording(write_csv(tmp_path / "a.csv", gyro, 0.0))
        assert recording.signal[..., 0].isnan().all()
        assert "startup" in kinds(recording)

    def test_mounting(self, tmp_path: Path):
        true = signal().numpy()
        back = np.array(MOUNTED_ON_THE_BACK)
        paths = [write_csv(tmp_path / "front.csv", true, 0.0), write_csv(tmp_path / "back.csv", back.T @ true, 0.0)]
        (tmp_path / "mounting.json").write_text(json.dumps({"back": MOUNTED_ON_THE_BACK}))
        recording = gf.read_recording(paths, mounting=tmp_path / "mounting.json")
        np.testing.assert_allclose(recording.signal[:, 1].numpy(), true, atol=1e-8)
        with pytest.raises(ValueError, match="`mounting`: no device side in"):
            gf.read_recording(paths, mounting={"side": MOUNTED_ON_THE_BACK})
        with pytest.raises(ValueError, match="`mounting`: expected a 3 x 3 rotation matrix for back"):
            gf.read_recording(paths, mounting={"back": [[1, 2], [3, 4]]})
        mirror = [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]
        with pytest.raises(ValueError, match="`mounting`: expected a 3 x 3 rotation matrix for back"):
            gf.read_recording(paths, mounting={"back": mirror})
        with pytest.raises(ValueError, match="`mounting`: expected a JSON file"):
            gf.read_recording(paths, mounting=tmp_path / "none.json")

    def test_rate_is_needed(self, tmp_path: Path):
        np.save(tmp_path / "a.npy", signal().numpy())
        with pytest.raises(gf.RecordingError, match=r"found neither; give the rate with rate= \(--rate HZ\)"):
            gf.read_recording(tmp_path / "a.npy")
        assert gf.read_recording(tmp_path / "a.npy", rate=20).rate == 20
        with pytest.raises(ValueError, match="`rate`"):
            gf.read_recording(tmp_path / "a.npy", rate=-20)

    def test_axis_that_is_not_there(self, tmp_path: Path):
        np.savez(tmp_path / "a.npz", gyro=signal().numpy(), fs=100.0)
        with pytest.raises(gf.RecordingError, match="expected axis 'z' in every device, found axes without names"):
            gf.read_recording(tmp_path / "a.npz", axis="z")

    def test_formats_agree(self, tmp_path: Path):
        gyro, stamps = made_up(), regular_stamps()
        logs = [
            write_ulog(tmp_path / "a.ulg", gyro, stamps),
            write_ros1(tmp_path / "a.bag", gyro, stamps),
            write_ros2(tmp_path / "ros2", gyro, stamps),
            write_ros2(tmp_path / "mcap", gyro, stamps, mcap=True),
            write_hdf5(tmp_path / "a.h5", {f"imu{i}": {"gyro": g} for i, g in enumerate(gyro)}, fs=100.0, unit="rad/s"),
        ]
        for log in logs:
            recording = gf.read_recording(log)
            assert recording.axes == ("x", "y", "z"), log
            assert recording.unit == "rad/s"
            assert recording.rate == pytest.approx(100)
            # the ULog holds float32
            np.testing.assert_allclose(recording.signal.numpy(), gyro.transpose(1, 0, 2), rtol=1e-6, atol=1e-9)

    def test_missing_file(self, tmp_path: Path):
        with pytest.raises(FileNotFoundError, match=r"a\.npz"):
            gf.read_recording(tmp_path / "a.npz")


class TestRealLogs:
    def test_two_csv_files_of_one_flight(self, shared: Path):
        paths = [shared / "data" / "raw" / f"xsens_dot{i}_flight.csv" for i in (1, 2)]
        recording = gf.read_recording(paths, axis="z")
        assert recording.signal.shape[0] == 2
        assert recording.rate == pytest.approx(120, rel=1e-3)
        assert {"offset", "cut", "startup"} <= kinds(recording)
        z = recording.signal
        known = z.isfinite().all(0)
        assert torch.corrcoef(z[:, known])[0, 1] > 0.8  # both ride on the same frame, aligned in time

    def test_eight_devices_mapped_to_the_front(self, shared: Path):
        recording = gf.read_recording(
            shared / "data" / "mimu4444_8imu.npz",
            key="exp1",
            mounting={str(i): MOUNTED_ON_THE_BACK for i in (2, 4, 6, 8)},
        )
        assert recording.signal.shape[:2] == (3, 8)
        assert recording.rate == pytest.approx(62.5, rel=0.01)
        for axis in recording.signal[..., -5000:]:  # turned by hand
            known = axis.isfinite().all(0)
            assert torch.corrcoef(axis[:, known]).min() > 0.99

    def test_array_at_rest_with_a_row_of_nan(self, shared: Path):
        recording = gf.read_recording(shared / "data" / "xsensdot10_static.npz")
        assert recording.signal.shape == (3, 10, 14442)
        assert "non_finite" in kinds(recording)
        assert recording.signal.isnan().sum() == 3

    def test_logger_dropouts_are_gaps(self, shared: Path):
        recording = gf.read_recording(shared / "data" / "raw" / "px4_sample.ulg")
        assert "gaps" in kinds(recording)
        assert recording.signal.isnan().any(0).sum() == recording.n_samples - 17070

    def test_matlab_4_rows_with_bursty_arrival_times(self, shared: Path):
        recording = gf.read_recording(shared / "data" / "raw" / "mpu6050_gyroscope_v73.mat")
        assert recording.n_samples == 65067
        assert recording.rate == pytest.approx(99.3, abs=0.1)
        assert any("in order" in str(note) for note in recording.notes)
