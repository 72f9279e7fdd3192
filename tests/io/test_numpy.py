"""NumPy files: recordings, tables with named rows, bare arrays, and files that are none."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from logs import made_up, read_with

import gyrofuse as gf
from gyrofuse.io.formats import read_streams
from gyrofuse.io.formats.numpy import recordings as numpy_log
from gyrofuse.io.streams import RecordingError

N = 60
ROWS = np.array(["gx", "gy", "gz", "ax", "ay", "az"])


def save(folder: Path, **arrays) -> Path:
    path = folder / "log.npz"
    np.savez(path, **arrays)
    return path


def table(seed: int = 0, n_samples: int = N) -> np.ndarray:
    return made_up(2, n_samples, seed).reshape(6, n_samples)


class TestRecording:
    def test_sensors_by_time(self, tmp_path: Path):
        gyro, time = table()[:4], np.arange(N) / 50
        path = save(
            tmp_path,
            gyro=gyro.astype(np.float32),
            fs=50,
            unit="rad/s",
            sensors=["a", "b", "c", "d"],
            time=time,
            temperature=time,
            acceleration=table()[:3],
        )
        streams = read_with(numpy_log.read, path)
        assert [stream.name for stream in streams] == ["a", "b", "c", "d"]
        for stream, row in zip(streams, gyro.astype(np.float32), strict=True):
            assert stream.signal[""].dtype == np.float64
            np.testing.assert_array_equal(stream.signal[""], row)
            np.testing.assert_array_equal(stream.time, time)
            assert (stream.unit, stream.rate) == ("rad/s", 50.0)
        np.testing.assert_array_equal(streams[0].channels["temperature"], time)
        np.testing.assert_array_equal(streams[0].channels["acceleration"], table()[:3])
        assert all(stream.channels == {} for stream in streams[1:])

    def test_another_rate_than_the_stated_one_is_told(self, tmp_path: Path):
        path = save(tmp_path, gyro=table()[:3], fs=50.0)
        (note,) = [n for n in gf.read_recording(path, rate=40.0).notes if n.kind == "clock"]
        assert note.sentence == "the log states 50 Hz, 40 Hz was asked for"
        assert gf.read_recording(path, rate=40.0).rate == 40.0
        assert not [n for n in gf.read_recording(path, rate=50.0).notes if n.kind == "clock"]

    @pytest.mark.parametrize("orient", [np.asarray, np.transpose], ids=["time_last", "time_first"])
    def test_sensors_without_names_are_numbered(self, tmp_path: Path, orient):
        streams = read_with(numpy_log.read, save(tmp_path, gyro=orient(table()[:3])))
        assert [(stream.name, list(stream.signal)) for stream in streams] == [("1", [""]), ("2", [""]), ("3", [""])]
        np.testing.assert_array_equal([stream.signal[""] for stream in streams], table()[:3])
        assert {(stream.unit, stream.rate, stream.time) for stream in streams} == {("unknown", None, None)}

    @pytest.mark.parametrize("shape", [(N,), (1, N)])
    def test_a_single_sensor_has_the_name_of_the_file(self, tmp_path: Path, shape):
        (stream,) = read_with(numpy_log.read, save(tmp_path, gyro=table()[0].reshape(shape)))
        assert stream.name == "log"
        np.testing.assert_array_equal(stream.signal[""], table()[0])

    def test_names_settle_the_orientation_of_a_short_recording(self, tmp_path: Path):
        gyro = table()[:, :4]
        streams = read_with(numpy_log.read, save(tmp_path, gyro=gyro, sensors=list("abcdef")))
        np.testing.assert_array_equal([stream.signal[""] for stream in streams], gyro)

    def test_axes_by_sensors_by_time(self, tmp_path: Path):
        gyro = made_up(4).swapaxes(0, 1)[:2]  # (axis, sensor, time)
        streams = read_with(
            numpy_log.read, save(tmp_path, gyro=gyro, fs=9.5, axes=["y", "z"], sensors=["p", "q", "r", "gyro_1"])
        )
        assert [stream.name for stream in streams] == ["p", "q", "r", "gyro_1"]
        for i, stream in enumerate(streams):
            assert list(stream.signal) == ["y", "z"]
            np.testing.assert_array_equal([stream.signal["y"], stream.signal["z"]], gyro[:, i])

    def test_three_axes_need_no_names(self, tmp_path: Path):
        streams = read_with(numpy_log.read, save(tmp_path, gyro=made_up(2).swapaxes(0, 1)))
        assert [(stream.name, list(stream.signal)) for stream in streams] == [("1", list("xyz")), ("2", list("xyz"))]

    def test_channels_of_one_among_several_sensors(self, tmp_path: Path):
        path = save(
            tmp_path, **{"gyro": table()[:2], "sensors": ["a", "b[0]"], "heat[b[0]]": table()[2], "note[a]": "warm"}
        )
        streams = read_with(numpy_log.read, path)
        assert [list(stream.channels) for stream in streams] == [[], ["heat"]]
        np.testing.assert_array_equal(streams[1].channels["heat"], table()[2])

    def test_another_gyro_is_a_channel(self, tmp_path: Path):
        (stream,) = read_with(numpy_log.read, save(tmp_path, gyro=table()[0], raw_gyro=table()[1]))
        np.testing.assert_array_equal(stream.channels["raw_gyro"], table()[1])

    def test_sensor_names_that_do_not_fit_are_noted(self, tmp_path: Path):
        streams = read_with(numpy_log.read, save(tmp_path, gyro=table()[:3], sensors=["a", "b"]))
        assert [stream.name for stream in streams] == ["1", "2", "3"]
        assert streams[0].notes == ("2 sensor names do not fit 3 sensors",)

    def test_what_a_recording_saves_comes_back(self, tmp_path: Path):
        before = gf.Recording(
            torch.from_numpy(made_up(2).swapaxes(0, 1).copy()),
            rate=37.5,
            unit="deg/s",
            sensors=("left", "right"),
            axes=("x", "y", "z"),
            channels={
                "temperature[left]": torch.from_numpy(table()[0]),
                "temperature[right]": torch.from_numpy(table()[1]),
                "supply": torch.from_numpy(table()[2]),
            },
        )
        before.save(tmp_path / "log.npz")
        after = gf.read_recording(tmp_path / "log.npz")
        assert torch.equal(after.signal, before.signal)
        assert (after.rate, after.unit, after.sensors, after.axes) == (37.5, "deg/s", ("left", "right"), before.axes)
        assert after.channels.keys() == before.channels.keys()
        assert all(torch.equal(after.channels[name], values) for name, values in before.channels.items())

    def test_other_names_and_a_key(self, tmp_path: Path):
        path = save(tmp_path, imu_gyr=table()[:3], fs=10.0, drift=table()[0])
        (stream,) = read_with(numpy_log.read, path)
        assert (list(stream.signal), stream.rate) == (["x", "y", "z"], 10.0)
        (stream,) = read_with(numpy_log.read, path, key="drift")
        np.testing.assert_array_equal(stream.signal[""], table()[0])

    @pytest.mark.parametrize("shape", [(3, 0), (3, 1), (0, 9), (2, 3, 1), (1, 1), (1,), (), (2, 2, 2, 9)])
    def test_too_few_samples_or_odd_dimensions(self, tmp_path: Path, shape):
        with pytest.raises(RecordingError, match=r"log\.npz: expected `gyro` to be numbers .* found float64 \("):
            read_with(numpy_log.read, save(tmp_path, gyro=np.zeros(shape)))

    @pytest.mark.parametrize("values", [np.full((2, 9), "a"), np.zeros((2, 9), complex)], ids=["text", "complex"])
    def test_no_real_numbers(self, tmp_path: Path, values):
        with pytest.raises(RecordingError, match="expected `gyro` to be numbers"):
            read_with(numpy_log.read, save(tmp_path, gyro=values))

    @pytest.mark.parametrize(("axes", "n_axes"), [(["x", "x"], 2), (["x", "up"], 2), (["x"], 3), (list("xyz"), 4)])
    def test_axes_that_do_not_fit(self, tmp_path: Path, axes, n_axes):
        with pytest.raises(RecordingError, match=r"and in `axes` which of x, y, z its axes are, found \(., 2, 60\)"):
            read_with(numpy_log.read, save(tmp_path, gyro=np.zeros((n_axes, 2, N)), axes=axes))

    def test_time_of_another_length(self, tmp_path: Path):
        with pytest.raises(RecordingError, match=r"expected `time` of the length of `gyro` \(6, 60\), found \(59,\)"):
            read_with(numpy_log.read, save(tmp_path, gyro=table(), time=np.arange(59.0)))

    @pytest.mark.parametrize("fs", [0.0, -1.0, np.nan, np.inf, "fast", [1.0, 2.0]])
    def test_a_rate_that_is_none(self, tmp_path: Path, fs):
        with pytest.raises(RecordingError, match="expected `fs` to be one sampling rate in Hz"):
            read_with(numpy_log.read, save(tmp_path, gyro=table(), fs=fs))

    def test_no_gyro(self, tmp_path: Path):
        with pytest.raises(RecordingError, match=r"found voltage \(6, 60\)"):
            read_with(numpy_log.read, save(tmp_path, voltage=table()))


class TestTables:
    def test_integer_counts_times_scale(self, tmp_path: Path):
        counts = np.random.default_rng(0).integers(-30000, 30000, (6, N), dtype=np.int16)
        scale, units = np.repeat([0.05, 0.003], 3), np.repeat(["deg/s", "g"], 3)
        path = save(tmp_path, counts=counts, channels=ROWS, scale=scale, units=units, fs=100.0)
        (stream,) = read_with(numpy_log.read, path)
        assert (stream.name, stream.unit, stream.rate) == ("log", "deg/s", 100.0)
        np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], counts[:3] * 0.05)
        np.testing.assert_array_equal(stream.channels["acceleration"], counts[3:] * 0.003)
        assert stream.channel_units == {"acceleration": "g"}

    def test_bare_axes_one_unit_and_a_shared_clock(self, tmp_path: Path):
        path = save(
            tmp_path, data=table()[:3], channels=list("xyz"), units="rad/s", t_us=np.arange(N) * 4000, extra=table()
        )
        (stream,) = read_with(numpy_log.read, path)
        assert (list(stream.signal), stream.unit) == (["x", "y", "z"], "rad/s")
        np.testing.assert_allclose(stream.time, np.arange(N) * 0.004, rtol=1e-15)
        np.testing.assert_array_equal(stream.channels["extra"], table())

    def test_unknown_rows_and_no_units(self, tmp_path: Path):
        (stream,) = read_with(numpy_log.read, save(tmp_path, data=table()[:2], channels=["gz", "pressure"]))
        assert (stream.unit, list(stream.signal), list(stream.channels)) == ("unknown", ["z"], ["pressure"])
        np.testing.assert_array_equal(stream.channels["pressure"], table()[1])

    @pytest.mark.parametrize("time_axis", [-1, 0])
    def test_several_devices_in_one_array(self, tmp_path: Path, time_axis):
        data = np.stack([table(seed) for seed in range(3)])
        path = save(tmp_path, data=np.moveaxis(data, -1, time_axis), channels=ROWS, movement=np.ones(N, np.uint8))
        streams = read_with(numpy_log.read, path)
        assert [stream.name for stream in streams] == ["1", "2", "3"]
        np.testing.assert_array_equal([[s.signal[a] for a in "xyz"] for s in streams], data[:, :3])
        assert [list(s.channels) for s in streams] == [["acceleration", "movement"], ["acceleration"], ["acceleration"]]

    @pytest.mark.parametrize(
        ("first", "second", "together"),
        [
            (100 + np.arange(N) / 50, 100.2 + np.arange(N) / 50, True),
            (100 + np.arange(N) / 50, 100.9 + np.arange(N) / 50, False),
            (np.arange(N) / 50, np.arange(N) / 50, True),
            (np.arange(N) / 50, 0.001 + np.arange(N) / 50, False),
            (100 + np.arange(N) / 50, (100 + np.arange(N) / 50)[::-1], False),
            (None, None, False),
        ],
        ids=["overlap", "hardly", "same", "from zero", "set back", "none"],
    )
    def test_devices_are_told_from_experiments(self, tmp_path: Path, first, second, together):
        clocks = {} if first is None else {"log_a_t_s": first, "log_b_t_s": second}
        path = save(tmp_path, log_a=table(), log_b=table(1), channels=ROWS, **clocks)
        if together:
            streams = read_with(numpy_log.read, path)
            assert [stream.name for stream in streams] == ["a", "b"]
            np.testing.assert_array_equal(streams[1].time, second)
        else:
            message = r"several recordings inside \(log_a, log_b\); name one with key= \(--key NAME\)"
            with pytest.raises(RecordingError, match=message):
                read_with(numpy_log.read, path)
        for key in ("log_b", "b"):
            (stream,) = read_with(numpy_log.read, path, key=key)
            np.testing.assert_array_equal(stream.signal["x"], table(1)[0])

    def test_what_is_named_after_a_table_belongs_to_it(self, tmp_path: Path):
        path = save(
            tmp_path,
            rot=table(),
            rot_x=table(1),
            channels=ROWS,
            rot_mark=np.ones(N),
            rot_x_mark=np.zeros(N),
            rot_x_name="about x",
            rot_x_t_ms=np.arange(N) * 10,
        )
        plain, about_x = read_with(numpy_log.read, path, key="rot")[0], read_with(numpy_log.read, path, key="rot_x")[0]
        assert (plain.channels["mark"].max(), about_x.channels["mark"].max()) == (1, 0)
        assert plain.time is None
        assert about_x.time[-1] == pytest.approx(0.59)
        assert about_x.notes == ("rot_x_name: about x",)

    def test_ticks_of_a_stated_frequency_wrap_at_32_bit(self, tmp_path: Path):
        ticks = (2**32 - 5000 + np.arange(N) * 1000) % 2**32
        (stream,) = read_with(numpy_log.read, save(tmp_path, exp7=table(), ts7=ticks, ts_hz=1e6, channels=ROWS))
        np.testing.assert_array_equal(stream.time, ticks / 1e6)
        assert stream.clock_period == 2**32 / 1e6

    @pytest.mark.parametrize(
        ("arrays", "message"),
        [
            ({"channels": ["a", "b"]}, r"rows a, b and a gyro"),
            ({"channels": ["gx", "gx"]}, "name each row once"),
            ({"channels": ["gx", "gy", "gz"]}, r"expected arrays \(channel, time\) .* found data \(2, 60\)"),
            (
                {"channels": ["gx", "gy"], "units": ["a", "b", "c"]},
                "expected `units` to hold one value or one for each",
            ),
            ({"channels": ["gx", "gy"], "scale": "large"}, "expected `scale` to hold one value"),
            (
                {"channels": ["gx", "gy"], "t_us": np.arange(59)},
                "expected `t_us` of the length of `data`, 60, found 59",
            ),
        ],
    )
    def test_tables_that_do_not_fit(self, tmp_path: Path, arrays, message):
        with pytest.raises(RecordingError, match=message):
            read_with(numpy_log.read, save(tmp_path, data=table()[:2], **arrays))

    def test_a_key_that_is_not_there(self, tmp_path: Path):
        with pytest.raises(RecordingError, match=r"expected an array 'nine' \(`key`\), found data; name one"):
            read_with(numpy_log.read, save(tmp_path, data=table(), channels=ROWS), key="nine")


class TestBareArray:
    @pytest.mark.parametrize("orient", [np.asarray, np.transpose], ids=["time_last", "time_first"])
    def test_the_longer_dimension_is_time(self, tmp_path: Path, orient):
        np.save(tmp_path / "a.npy", orient(table().astype(np.float32)))
        streams = read_with(numpy_log.read, tmp_path / "a.npy")
        assert [stream.name for stream in streams] == list("123456")
        np.testing.assert_array_equal([stream.signal[""] for stream in streams], table().astype(np.float32))
        assert {type(stream.signal[""]) for stream in streams} == {np.ndarray}  # the file is not kept open
        assert (streams[0].unit, streams[0].rate, streams[0].time) == ("unknown", None, None)

    def test_one_dimension(self, tmp_path: Path):
        np.save(tmp_path / "a.npy", np.array([1, 2, 3], np.int16))
        (stream,) = read_with(numpy_log.read, tmp_path / "a.npy")
        assert (stream.name, stream.signal[""].tolist()) == ("a", [1, 2, 3])

    @pytest.mark.parametrize(
        "array",
        [np.zeros(1), np.zeros((1, 1)), np.zeros((0, 3)), np.zeros((2, 3, 9)), np.full(9, "a"), np.zeros(9, complex)],
    )
    def test_arrays_that_are_no_gyros(self, tmp_path: Path, array):
        np.save(tmp_path / "a.npy", array)
        message = re.escape(f"a.npy: expected numbers (sensor, time) with at least 2 samples, found {array.dtype} ")
        with pytest.raises(RecordingError, match=message):
            read_with(numpy_log.read, tmp_path / "a.npy")

    def test_a_key_means_nothing(self, tmp_path: Path):
        np.save(tmp_path / "a.npy", table())
        with pytest.raises(RecordingError, match=r"expected no `key` for an \.npy file"):
            read_with(numpy_log.read, tmp_path / "a.npy", key="gyro")


class _Touch:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


class TestDamaged:
    def test_objects_are_never_unpickled(self, tmp_path: Path):
        path = save(tmp_path, gyro=table(), meta=np.array([_Touch(tmp_path / "hit")], dtype=object))
        np.save(tmp_path / "a.npy", np.array([_Touch(tmp_path / "hit")], dtype=object))
        for file in (path, tmp_path / "a.npy"):
            with pytest.raises(RecordingError, match=r"expected a NumPy file of numbers and text.*without objects"):
                read_with(numpy_log.read, file)
        assert not (tmp_path / "hit").exists()

    @pytest.mark.parametrize("fraction", [0.3, 0.9, 0.999])
    def test_truncated(self, tmp_path: Path, fraction):
        path = save(tmp_path, gyro=table())
        np.save(tmp_path / "a.npy", table())
        for file in (path, tmp_path / "a.npy"):
            content = file.read_bytes()
            file.write_bytes(content[: int(fraction * len(content))])
            with pytest.raises(RecordingError, match=r"found one that cannot be read \(.*save it again"):
                read_with(numpy_log.read, file)

    def test_corrupt_member(self, tmp_path: Path):
        path = save(tmp_path, gyro=table())
        content = bytearray(path.read_bytes())
        content[500:600] = bytes(100)
        path.write_bytes(content)
        with pytest.raises(RecordingError, match="cannot be read"):
            read_with(numpy_log.read, path)

    @pytest.mark.parametrize("content", [b"junk", b"\x93NUMPY\x01\x00", b"PK\x03\x04" + bytes(50), b"\x80\x04K\x01."])
    def test_junk(self, tmp_path: Path, content):
        path = tmp_path / "log.npz"
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=r"log\.npz: expected a NumPy file"):
            read_with(numpy_log.read, path)


class TestRealFiles:
    """Recordings of other people; the numbers are those of the arrays in the files."""

    @pytest.mark.parametrize("number", [1, 2, 3])
    def test_adis16405(self, shared: Path, number):
        path = shared / "data" / f"adis16405_rec{number}.npz"
        (stream,) = read_with(read_streams, path)
        with np.load(path) as file:
            counts = file["counts"]
        assert (stream.name, stream.unit, stream.rate) == (path.stem, "deg/s", 100.0)
        for a, row in zip("xyz", counts, strict=False):
            np.testing.assert_array_equal(stream.signal[a], row * 0.05)
        np.testing.assert_allclose(stream.channels["acceleration"], counts[3:] * 0.00333, rtol=1e-12)

    def test_xsensdot10(self, shared: Path):
        path = shared / "data" / "xsensdot10_static.npz"
        streams = read_with(read_streams, path)
        with np.load(path) as file:
            data = file["data"]
        assert [stream.name for stream in streams] == [str(number) for number in range(1, 11)]
        np.testing.assert_array_equal([[s.signal[a] for a in "xyz"] for s in streams], data[:, :3])
        assert not np.isfinite(streams[0].signal["x"]).all()

    def test_xsensdot4(self, shared: Path):
        path = shared / "data" / "xsensdot4_quadrotor.npz"
        streams = read_with(read_streams, path)
        assert [(s.name, s.n_samples) for s in streams] == [
            ("DOT1", 22903),
            ("DOT2", 22864),
            ("DOT4", 22860),
            ("DOT7", 22870),
        ]
        assert streams[3].time[0] == pytest.approx(677.533002, abs=1e-9)
        assert np.diff(streams[3].time).min() == 0
        np.testing.assert_array_equal(read_with(read_streams, path, key="DOT7")[0].signal["z"], streams[3].signal["z"])

    def test_px4(self, shared: Path):
        (stream,) = read_with(read_streams, shared / "data" / "px4_auav_x21_flight.npz")
        assert (stream.unit, stream.rate, stream.n_samples) == ("rad/s", 250.0, 17070)
        assert stream.time[-1] - stream.time[0] == pytest.approx(68.879199, abs=1e-9)
        assert stream.channels["gyro_integral_dt"].shape == (17070,)

    def test_broad(self, shared: Path):
        path = shared / "data" / "broad_trials.npz"
        with pytest.raises(RecordingError, match=r"several recordings inside \(t01, t06, t24, t26\); name one"):
            read_with(read_streams, path)
        (stream,) = read_with(read_streams, path, key="t24")
        assert (stream.name, stream.unit, stream.n_samples) == ("t24", "rad/s", 57746)
        assert set(np.unique(stream.channels["movement"])) == {0, 1}
        assert stream.notes == ("t24_name: 24_disturbed_tapping_A",)

    def test_mpu6050(self, shared: Path):
        path = shared / "data" / "mpu6050_static10min_rotations_temp.npz"
        with pytest.raises(RecordingError, match=r"several recordings inside \(static10min, rot_x, "):
            read_with(read_streams, path)
        (stream,) = read_with(read_streams, path, key="static10min")
        assert (stream.unit, stream.channel_units["temperature"], stream.n_samples) == ("deg/s", "degC", 65067)
        assert 0 < stream.channels["temperature"].mean() < 60
        assert stream.time[-1] == pytest.approx(655.142, abs=1e-3)
        assert read_with(read_streams, path, key="rot_x")[0].time[-1] == pytest.approx(24.086, abs=1e-3)

    def test_mimu4444(self, shared: Path):
        path = shared / "data" / "mimu4444_8imu.npz"
        with pytest.raises(RecordingError, match=r"several recordings inside \(exp1, exp2, exp3, exp4, exp5\)"):
            read_with(read_streams, path)
        streams = read_with(read_streams, path, key="exp2")
        with np.load(path) as file:
            counts, scale, ticks = file["exp2"], file["scale"], file["ts2"]
        assert [stream.name for stream in streams] == list("12345678")
        np.testing.assert_array_equal(streams[6].signal["y"], counts[:, 6, 4] * scale[4])
        np.testing.assert_array_equal(streams[6].time, ticks / 64e6)
        assert streams[6].clock_period == pytest.approx(67.108864)
        assert (streams[6].unit, streams[6].rate) == ("deg/s", 62.5)

    def test_mtig(self, shared: Path):
        (stream,) = read_with(read_streams, shared / "data" / "mtig_contaminated_gx.npz")
        assert (list(stream.signal), stream.unit, stream.rate, stream.n_samples) == (["x"], "rad/s", 100.0, 500_000)

    def test_clocks_are_no_gyros(self, shared: Path):
        path = shared / "data" / "clocks_stable32.npz"
        with pytest.raises(RecordingError, match=r"found cs5071a_phase_s \(556990,\)"):
            read_with(read_streams, path)
        assert read_with(read_streams, path, key="ocxo_frequency_hz")[0].n_samples == 19982


class TestDispatch:
    def test_no_such_file(self, tmp_path: Path):
        with pytest.raises(FileNotFoundError, match=r"none\.csv: no such file; check the name"):
            read_with(read_streams, tmp_path / "none.csv")

    def test_a_directory_that_is_no_bag(self, tmp_path: Path):
        with pytest.raises(RecordingError, match=r"metadata\.yaml"):
            read_with(read_streams, tmp_path)

    @pytest.mark.parametrize("name", ["log.xyz", "log"])
    def test_unknown_suffix(self, tmp_path: Path, name):
        (tmp_path / name).write_text("1,2")
        with pytest.raises(RecordingError, match=r"expected a log \(\.npz .*\.mcap\)"):
            read_with(read_streams, tmp_path / name)

    @pytest.mark.parametrize("suffix", [".npz", ".npy", ".csv", ".parquet", ".mat", ".h5", ".ulg", ".bag", ".mcap"])
    def test_empty_file(self, tmp_path: Path, suffix):
        path = tmp_path / f"log{suffix}"
        path.touch()
        with pytest.raises(RecordingError, match=f"log{suffix}: expected a log, found an empty file"):
            read_with(read_streams, path)

    def test_capital_suffix(self, tmp_path: Path):
        path = save(tmp_path, gyro=table())
        assert len(read_with(read_streams, path.rename(tmp_path / "LOG.NPZ"))) == 6


def test_time_beside_gyro_is_in_seconds(tmp_path: Path):
    """A clock of whole seconds is one sample a second, not a thousand."""
    np.savez(tmp_path / "a.npz", gyro=np.random.default_rng(0).normal(size=(2, 50)), time=np.arange(50.0))
    streams = read_with(read_streams, tmp_path / "a.npz")
    assert streams[0].time is not None
    np.testing.assert_array_equal(streams[0].time, np.arange(50.0))
