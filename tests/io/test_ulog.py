"""PX4 ULog files: which topic is the array, its clock, what the logger says, and files that are none."""

import sys
from pathlib import Path

import numpy as np
import pytest
from logs import made_up, read_with, regular_stamps, seconds, write_ulog

import gyrofuse as gf
from gyrofuse.io.formats.robots import ulog
from gyrofuse.io.streams import RecordingError

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="real recordings (../shared/data) are not here")

MICROSECONDS = 10_000_000  # a boot clock, as PX4 has


def single(values):
    return values.astype(np.float32).astype(np.float64)


def test_each_instance_of_sensor_gyro_is_a_device(tmp_path):
    gyro, stamps = made_up(3), regular_stamps(start=MICROSECONDS)
    temperature = 30 + made_up(3, seed=1)[:, 0]
    streams = read_with(ulog.read, write_ulog(tmp_path / "a.ulg", gyro, stamps, temperature=temperature))
    assert [stream.name for stream in streams] == ["sensor_gyro[0]", "sensor_gyro[1]", "sensor_gyro[2]"]
    for device, stream in enumerate(streams):
        np.testing.assert_allclose([stream.signal[a] for a in "xyz"], single(gyro[device]), rtol=0, atol=1e-12)
        np.testing.assert_allclose(stream.time, seconds(stamps), rtol=0, atol=1e-12)
        np.testing.assert_allclose(stream.channels["temperature"], single(temperature[device]), rtol=0, atol=1e-12)
        assert stream.unit == "rad/s"
        assert stream.channel_units == {"temperature": "degC"}
        assert f"device_id {1000 + device}" in stream.notes
        assert stream.signal["x"].dtype == stream.time.dtype == np.float64


def test_a_not_a_number_is_kept(tmp_path):
    gyro = made_up(1)
    gyro[0, 1, 7] = np.nan
    (stream,) = read_with(ulog.read, write_ulog(tmp_path / "a.ulg", gyro, regular_stamps()))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(stream.signal["y"])), [7])


def test_sensor_combined_replaces_a_thinned_sensor_gyro(tmp_path):
    combined, stamps = made_up(1)[0], regular_stamps(rate=200)
    path = write_ulog(tmp_path / "a.ulg", made_up(2, 5), regular_stamps(5, rate=1), combined=(combined, stamps))
    (stream,) = read_with(ulog.read, path)
    assert stream.name == "sensor_combined[0]"
    np.testing.assert_allclose([stream.signal[a] for a in "xyz"], single(combined), rtol=0, atol=1e-12)
    np.testing.assert_allclose(stream.time, stamps // 1000 / 1e6, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(stream.channels["acceleration"], np.outer([0, 0, -9.75], np.ones(60)))
    assert any("sensor_gyro (2 instances) was logged at 1 Hz only" in note for note in stream.notes)
    assert [stream.name for stream in read_with(ulog.read, path, key="sensor_gyro")] == [
        "sensor_gyro[0]",
        "sensor_gyro[1]",
    ]


def test_sensor_gyro_is_the_array_at_a_comparable_rate(tmp_path):
    combined = (made_up(1)[0], regular_stamps(rate=400))
    path = write_ulog(tmp_path / "a.ulg", made_up(2), regular_stamps(rate=100), combined=combined)
    assert [stream.name for stream in read_with(ulog.read, path)] == ["sensor_gyro[0]", "sensor_gyro[1]"]
    assert [stream.name for stream in read_with(ulog.read, path, key="sensor_combined")] == ["sensor_combined[0]"]


def test_dropouts_and_ignored_topics_are_noted(tmp_path):
    path = write_ulog(
        tmp_path / "a.ulg", made_up(1), regular_stamps(), dropouts_ms=(20, 35), other_topics=("sensor_gyro_fifo",)
    )
    (stream,) = read_with(ulog.read, path)
    assert "the logger reports 2 dropouts, 55 ms in total" in stream.notes
    assert "sensor_gyro_fifo (1 instances) ignored" in stream.notes


def test_a_log_cut_off_in_flight_is_read_up_to_the_cut(tmp_path):
    gyro = made_up(1)
    path = write_ulog(tmp_path / "a.ulg", gyro, regular_stamps())
    path.write_bytes(path.read_bytes()[:-500])
    (stream,) = read_with(ulog.read, path)
    assert 0 < stream.n_samples < 60
    np.testing.assert_array_equal(stream.signal["z"], single(gyro[0, 2, : stream.n_samples]))


def test_damage_in_the_middle_is_noted_and_nothing_is_printed(tmp_path, capsys):
    path = write_ulog(tmp_path / "a.ulg", made_up(2), regular_stamps())
    content = bytearray(path.read_bytes())
    content[len(content) // 2 : len(content) // 2 + 300] = bytes(300)
    path.write_bytes(content)
    assert "part of the file is damaged and was skipped" in read_with(ulog.read, path)[0].notes
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("content", [b"", b"\x55\x4c\x6f\x67", b"not a log at all" * 20], ids=["empty", "cut", "junk"])
def test_a_file_that_is_no_ulog(tmp_path, content):
    path = tmp_path / "bad.ulg"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"bad\.ulg: expected a PX4 ULog file, found .*again"):
        read_with(ulog.read, path)


def test_a_missing_file(tmp_path):
    with pytest.raises(RecordingError, match=r"none\.ulg"):
        read_with(ulog.read, tmp_path / "none.ulg")


def test_a_log_without_gyro_says_what_it_holds(tmp_path):
    path = write_ulog(tmp_path / "a.ulg", made_up(0), regular_stamps(), other_topics=("battery", "gps"))
    with pytest.raises(RecordingError, match=r"a\.ulg: expected a gyro topic .*found battery, gps"):
        read_with(ulog.read, path)


def test_a_key_that_is_not_in_the_log(tmp_path):
    path = write_ulog(tmp_path / "a.ulg", made_up(1), regular_stamps())
    with pytest.raises(RecordingError, match=r"named by `key`, got 'sensor_combined', found sensor_gyro"):
        read_with(ulog.read, path, key="sensor_combined")


def test_the_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(ImportError, match=r'needs (\w+); pip install \1, or .* pip install "\.\[logs\]"'):
        read_with(ulog.read, tmp_path / "a.ulg")


def counted(n_messages=20, samples=10, dt=125.0, start=MICROSECONDS // 1000, first=0):
    """Messages of a fifo: sample `i` of all has `i`, `-i` and 7 counts."""
    messages = []
    for m in range(n_messages):
        x = first + m * samples + np.arange(32)
        stamp = start + round(dt * (samples - 1 + m * samples))
        messages.append((stamp, samples, [x, -x, np.full(32, 7)]))
    return messages


SCALE = 2.0**-10


def fifo_log(path, *topics, n_slow=1, **options):
    return write_ulog(path / "a.ulg", made_up(n_slow), regular_stamps(start=MICROSECONDS), fifo=topics, **options)


class TestFifo:
    """Messages of up to 32 samples (`sensor_gyro_fifo`) become samples at their true rate."""

    def test_every_sample_has_its_time(self, tmp_path):
        path = fifo_log(tmp_path, ("sensor_gyro_fifo", 0, 1000, 125.0, SCALE, counted()))
        (stream,) = read_with(ulog.read, path)
        assert (stream.name, stream.unit, stream.n_samples) == ("sensor_gyro_fifo[0]", "rad/s", 200)
        np.testing.assert_array_equal(stream.signal["x"], SCALE * np.arange(200))
        np.testing.assert_array_equal(stream.signal["y"], -SCALE * np.arange(200))
        np.testing.assert_array_equal(stream.signal["z"], np.full(200, SCALE * 7))
        np.testing.assert_allclose(stream.time, (MICROSECONDS // 1000 + 125 * np.arange(200)) * 1e-6, rtol=0, atol=1e-6)
        assert "device_id 1000" in stream.notes
        assert any("sensor_gyro (1 instances, 100 Hz) is not read" in note for note in stream.notes)
        assert "temperature" in stream.channels
        assert [stream.name for stream in read_with(ulog.read, path, key="sensor_gyro")] == ["sensor_gyro[0]"]

    def test_a_step_that_is_not_quite_what_is_stated(self, tmp_path):
        messages = counted(dt=124.0, n_messages=60)
        (stream,) = read_with(ulog.read, fifo_log(tmp_path, ("sensor_gyro_fifo", 0, 1000, 125.0, SCALE, messages)))
        assert (np.diff(stream.time) > 0).all()
        assert 1 / np.diff(stream.time)[10:].mean() == pytest.approx(1e6 / 124, rel=1e-3)

    def test_a_lost_message_is_a_gap(self, tmp_path):
        messages = counted()
        del messages[5]
        recording = gf.read_recording(fifo_log(tmp_path, ("sensor_gyro_fifo", 0, 1000, 125.0, SCALE, messages)))
        assert recording.rate == pytest.approx(8000, rel=1e-3)
        np.testing.assert_array_equal(np.flatnonzero(recording.signal[0].isnan().numpy()), np.arange(50, 60))

    def test_accelerations_become_a_channel(self, tmp_path):
        path = fifo_log(
            tmp_path,
            ("sensor_gyro_fifo", 0, 1000, 125.0, SCALE, counted()),
            ("sensor_accel_fifo", 0, 2000, 250.0, 1.0, counted(dt=250.0, n_messages=10)),
            ("sensor_accel_fifo", 1, 2001, 250.0, 1.0, counted(dt=250.0, n_messages=10, first=1000)),
        )
        (stream,) = read_with(ulog.read, path)
        np.testing.assert_allclose(stream.channels["acceleration"][0, :199], np.arange(199) / 2, atol=5e-3)
        assert np.isnan(stream.channels["acceleration"][0, 199])
        assert any("acceleration has its own clock (4000 Hz)" in note for note in stream.notes)
        assert stream.channel_units["acceleration"] == "m/s^2"

    @pytest.mark.parametrize("samples", [0, 33, 255])
    def test_a_message_of_impossibly_many_samples_is_left_out(self, tmp_path, samples):
        messages = counted()
        messages[3] = (messages[3][0], samples, messages[3][2])
        (stream,) = read_with(ulog.read, fifo_log(tmp_path, ("sensor_gyro_fifo", 0, 1000, 125.0, SCALE, messages)))
        assert stream.n_samples == 190
        assert any("1 of 20 messages sensor_gyro_fifo have no or more than 32 samples" in n for n in stream.notes)

    @pytest.mark.parametrize("dt", [0.0, -1.0, float("nan"), float("inf")])
    def test_without_a_time_between_samples_another_topic_is_read(self, tmp_path, dt):
        topic = ("sensor_gyro_fifo", 0, 1000, dt, SCALE, counted())
        (stream,) = read_with(ulog.read, fifo_log(tmp_path, topic))
        assert stream.name == "sensor_gyro[0]"
        assert "sensor_gyro_fifo has no two sound samples; not read" in stream.notes
        with pytest.raises(
            RecordingError, match=r"a\.ulg: expected messages sensor_gyro_fifo of 1 to 32 samples with a"
        ):
            read_with(ulog.read, fifo_log(tmp_path, topic, n_slow=0))

    def test_one_that_was_logged_now_and_then_is_not_read(self, tmp_path):
        (stream,) = read_with(
            ulog.read, fifo_log(tmp_path, ("sensor_gyro_fifo", 0, 1000, 125.0, SCALE, counted()[::5]))
        )
        assert stream.name == "sensor_gyro[0]"
        assert any(
            "sensor_gyro_fifo has messages that cover 20 % of the time, which are read with key" in n
            for n in stream.notes
        )

    def test_gyros_without_one_are_named(self, tmp_path):
        path = fifo_log(tmp_path, ("sensor_gyro_fifo", 1, 1001, 125.0, SCALE, counted()), n_slow=2)
        (stream,) = read_with(ulog.read, path)
        assert any("gyros that sensor_gyro_fifo lacks (device_id 1000)" in note for note in stream.notes)
        assert [stream.name for stream in read_with(ulog.read, path, key="sensor_gyro[1]")] == ["sensor_gyro[1]"]

    def test_more_than_the_memory_allowed(self, tmp_path):
        path = fifo_log(tmp_path, ("sensor_gyro_fifo", 0, 1000, 125.0, SCALE, counted()))
        with pytest.raises(RecordingError, match=r"samples of sensor_gyro_fifo of 20 x 32 x 5 numbers"):
            read_with(ulog.read, path, max_bytes=path.stat().st_size + 5000)


class TestAccelerations:
    """The topics of accelerometers are read as those of gyros are."""

    def test_each_instance_of_sensor_accel_is_a_device(self, tmp_path):
        values, stamps = made_up(2), regular_stamps(start=MICROSECONDS)
        streams = read_with(
            ulog.read, write_ulog(tmp_path / "a.ulg", values, stamps, topic="sensor_accel"), quantity="acceleration"
        )
        assert [(stream.name, stream.unit) for stream in streams] == [(f"sensor_accel[{i}]", "m/s^2") for i in (0, 1)]
        for device, stream in enumerate(streams):
            np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], single(values[device]))
            np.testing.assert_allclose(stream.time, seconds(stamps), rtol=0, atol=1e-12)
            assert (list(stream.channels), stream.notes) == (["temperature"], (f"device_id {1000 + device}",))

    def test_sensor_combined_has_the_rates_as_a_channel(self, tmp_path):
        combined = made_up(1)[0], regular_stamps(rate=200)
        few = regular_stamps(5, rate=1)
        path = write_ulog(tmp_path / "a.ulg", made_up(2, 5), few, topic="sensor_accel", combined=combined)
        (stream,) = read_with(ulog.read, path, quantity="acceleration")
        assert (stream.name, stream.unit) == ("sensor_combined[0]", "m/s^2")
        np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], np.outer([0, 0, -9.75], np.ones(60)))
        np.testing.assert_array_equal(stream.channels["angular_rate"], single(combined[0]))
        assert stream.channel_units == {"angular_rate": "rad/s"}
        assert any("sensor_accel (2 instances) was logged at 1 Hz only" in note for note in stream.notes)
        assert len(read_with(ulog.read, path, quantity="acceleration", key="sensor_accel")) == 2
        assert [s.name for s in read_with(ulog.read, path, quantity="acceleration", key="sensor_accel[1]")] == [
            "sensor_accel[1]"
        ]

    def test_accelerations_of_sensor_combined_have_times_of_their_own(self, tmp_path):
        stamps, late = regular_stamps(rate=200), [-1000] * 60
        late[7] = 2**31 - 1  # marked as invalid
        ramp = np.outer([1, 2, 3], np.arange(60.0))
        path = write_ulog(tmp_path / "a.ulg", made_up(0), stamps, combined=(ramp, stamps), relative=late)
        (stream,) = read_with(ulog.read, path, quantity="acceleration")
        assert np.flatnonzero(np.isnan(stream.time)).tolist() == [7]
        others = np.arange(60) != 7
        np.testing.assert_allclose(stream.time[others], (stamps[others] // 1000 - 1000) / 1e6, rtol=0, atol=1e-6)
        # a fifth of a step before the rates
        np.testing.assert_allclose(stream.channels["angular_rate"][0, 1:7], np.arange(1, 7) - 0.2, atol=1e-3)
        (gyro,) = read_with(ulog.read, path)
        np.testing.assert_array_equal(gyro.channels["acceleration"][2, :59], [-9.75] * 59)
        assert np.isnan(gyro.channels["acceleration"][2, 59])
        recording = gf.read_recording(path, quantity="acceleration")
        assert recording.rate == pytest.approx(200, rel=1e-3)
        assert recording.missing.max() == pytest.approx(1 / 60)

    def test_every_sample_of_a_fifo(self, tmp_path):
        path = fifo_log(
            tmp_path,
            ("sensor_gyro_fifo", 0, 1000, 125.0, SCALE, counted()),
            ("sensor_accel_fifo", 0, 1000, 250.0, 1.0, counted(dt=250.0, n_messages=10)),
            topic="sensor_accel",
        )
        (stream,) = read_with(ulog.read, path, quantity="acceleration")
        assert (stream.name, stream.unit, stream.n_samples) == ("sensor_accel_fifo[0]", "m/s^2", 100)
        np.testing.assert_array_equal(stream.signal["x"], np.arange(100.0))
        np.testing.assert_allclose(np.diff(stream.time), 250e-6, atol=1e-6)
        np.testing.assert_allclose(stream.channels["angular_rate"][0, :-1], SCALE * 2 * np.arange(99), atol=1e-5)
        assert "temperature" in stream.channels
        assert any("sensor_accel (1 instances, 100 Hz) is not read: sensor_accel_fifo" in n for n in stream.notes)

    @pytest.mark.parametrize(
        ("quantity", "there", "advice"),
        [
            ("acceleration", "sensor_gyro", r'an accelerometer topic \(sensor_accel_fifo or .*gyros.*quantity="rate"'),
            ("rate", "sensor_accel", r'a gyro topic \(sensor_gyro_fifo or .*accelerations.*quantity="acceleration"'),
        ],
    )
    def test_a_log_of_the_other_sensor_says_what_reads_it(self, tmp_path, quantity, there, advice):
        path = write_ulog(tmp_path / "a.ulg", made_up(1), regular_stamps(), topic=there)
        for key in (None, there):
            with pytest.raises(RecordingError, match=rf"a\.ulg: expected {advice}"):
                read_with(ulog.read, path, quantity=quantity, key=key)


@needs_shared
def test_a_flight_with_one_gyro():
    from pyulog import ULog

    path = SHARED / "raw" / "px4_sample.ulg"
    (stream,) = read_with(ulog.read, path)
    fields = ULog(str(path)).get_dataset("sensor_combined").data
    assert stream.n_samples == 17070
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(stream.signal[axis], fields[f"gyro_rad[{i}]"])
    np.testing.assert_allclose(stream.time * 1e6, fields["timestamp"], rtol=0, atol=1e-6)
    assert "the logger reports 4 dropouts, 119 ms in total" in stream.notes


@needs_shared
def test_a_flight_whose_sensor_gyro_is_thinned():
    path = SHARED / "raw" / "px4_sample_log_small.ulg"
    (stream,) = read_with(ulog.read, path)
    assert (stream.name, stream.n_samples) == ("sensor_combined[0]", 1298)
    assert 1 / np.median(np.diff(stream.time)) == pytest.approx(204.6, abs=0.1)
    assert [stream.n_samples for stream in read_with(ulog.read, path, key="sensor_gyro")] == [6, 6, 6]
