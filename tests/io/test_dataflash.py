"""ArduPilot logs: which messages are the gyros, instances, batches, damage, and files that are none."""

import contextlib
import struct

import numpy as np
import pytest
from logs import batches, read_with, write_dataflash

from gyrofuse.io.formats.robots import dataflash
from gyrofuse.io.formats.robots.dataflash_messages import read_binary
from gyrofuse.io.limits import Allowance
from gyrofuse.io.streams import RecordingError

BOOT = 5_000_000  # microseconds


def imu(n=40, instances=(0, 1), step=2500):
    """Messages IMU of several instances, one after the other."""
    return [
        ("IMU", BOOT + step * k + i, i, 0.1 * k, i, -0.5, 1.0, 2.0, -9.75, 0, 0, 30.0 + k, 1, 1, 1000, 1000)
        for k in range(n)
        for i in instances
    ]


def raw(n=160, step=500):
    """Messages GYR every step of microseconds and ACC half as often, instance 0."""
    messages = []
    for k in range(n):
        at = BOOT + step * k
        messages.append(("GYR", at + 300, 0, at, 0.25 * k, 1.0, -1.0))
        if k % 2 == 0:
            messages.append(("ACC", at + 300, 0, at, 1.0 * k, 0.0, -9.75))
    return messages


def test_each_instance_is_a_device(tmp_path):
    streams = read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", imu()))
    assert [stream.name for stream in streams] == ["IMU[0]", "IMU[1]"]
    for instance, stream in enumerate(streams):
        np.testing.assert_array_equal(stream.time, (BOOT + 2500 * np.arange(40) + instance) * 1e-6)
        np.testing.assert_array_equal(stream.signal["x"], np.float32(0.1 * np.arange(40)))
        np.testing.assert_array_equal(stream.signal["y"], np.full(40, instance))
        np.testing.assert_array_equal(stream.channels["acceleration"], np.outer([1, 2, -9.75], np.ones(40)))
        np.testing.assert_array_equal(stream.channels["temperature"], 30.0 + np.arange(40))
        assert stream.unit == "rad/s"
        assert stream.channel_units == {"acceleration": "m/s^2", "temperature": "degC"}
        assert stream.notes == ()


def test_text_holds_what_the_binary_does(tmp_path):
    messages = [("MSG", 1, "ArduCopter, V4"), *imu()]
    binary = read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", messages))
    text = read_with(dataflash.read, write_dataflash(tmp_path / "a.log", messages))
    for one, other in zip(binary, text, strict=True):
        np.testing.assert_allclose(one.time, other.time, rtol=0, atol=1e-9)
        np.testing.assert_allclose([one.signal[a] for a in "xyz"], [other.signal[a] for a in "xyz"], rtol=1e-6)


def test_the_content_says_which_of_the_two_it_is(tmp_path):
    path = write_dataflash(tmp_path / "a.bin", imu())
    assert len(read_with(dataflash.read, path.rename(tmp_path / "b.log"))) == 2


def test_older_logs_have_a_message_for_each_sensor(tmp_path):
    messages = [("IMU2", BOOT + 20_000 * k, 0.5, k, 0.0, 0.0, 0.0, -9.75, 0, 0, 41.5, 1, 1) for k in range(30)]
    (stream,) = read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", messages))
    assert stream.name == "IMU[1]"
    np.testing.assert_array_equal(stream.signal["y"], np.arange(30.0))
    np.testing.assert_array_equal(stream.channels["temperature"], np.full(30, 41.5))


def test_raw_samples_come_before_those_of_the_main_loop(tmp_path):
    path = write_dataflash(tmp_path / "a.bin", [*raw(), *imu()])
    (stream,) = read_with(dataflash.read, path)
    assert stream.name == "GYR[0]"
    np.testing.assert_allclose(np.diff(stream.time), 500e-6, atol=1e-9)
    np.testing.assert_array_equal(stream.signal["x"], 0.25 * np.arange(160))
    # Accelerations at half the rate: between two of them lies their mean, after the last one nothing.
    np.testing.assert_allclose(stream.channels["acceleration"][0, :-1], np.arange(159.0), atol=1e-6)
    assert np.isnan(stream.channels["acceleration"][0, -1])
    assert any("acceleration has its own clock (1000 Hz)" in note for note in stream.notes)
    assert any("IMU of the same log not read; choose with key=" in note for note in stream.notes)
    assert [s.name for s in read_with(dataflash.read, path, key="IMU")] == ["IMU[0]", "IMU[1]"]
    assert [s.name for s in read_with(dataflash.read, path, key="IMU[1]")] == ["IMU[1]"]


def test_batches_are_unrolled_and_divided_by_their_multiplier(tmp_path):
    (stream,) = read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", batches()))
    assert (stream.name, stream.rate) == ("ISBH[0]", 2000.0)
    np.testing.assert_array_equal(stream.signal["y"], np.arange(64) / 1000)
    np.testing.assert_allclose(stream.time, BOOT * 1e-6 + np.arange(64) / 2000, atol=1e-12)
    assert any("apart in time (2 of gyro 0): read is the longest run" in note for note in stream.notes)


def test_a_lost_message_parts_a_batch(tmp_path):
    messages = batches(kinds=[(1, 0)], count=160)
    del messages[2]  # the second of five
    (stream,) = read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", messages))
    np.testing.assert_array_equal(stream.signal["x"], np.arange(64, 160) / 1000)


def test_batches_that_follow_without_a_gap_are_one_run(tmp_path):
    (stream,) = read_with(
        dataflash.read, write_dataflash(tmp_path / "a.bin", batches([(1, 0)] * 2, count=64, rate=64.0))
    )
    assert stream.n_samples == 128


def test_the_gyro_of_the_batches_is_chosen(tmp_path):
    path = write_dataflash(tmp_path / "a.bin", [*batches([(1, 0), (1, 1)], number=65535), *imu()])
    assert [s.name for s in read_with(dataflash.read, path)] == ["IMU[0]", "IMU[1]"]
    (stream,) = read_with(dataflash.read, path, key="ISBH[1]")
    np.testing.assert_array_equal(stream.signal["z"], (100 + np.arange(64)) / 1000)


@pytest.mark.parametrize("wrong", [{"mul": 0}, {"rate": float("nan")}, {"rate": 0.0}, {"count": 0}])
def test_a_senseless_batch_is_left_out(tmp_path, wrong):
    path = write_dataflash(tmp_path / "a.bin", [*batches([(1, 0)], **wrong), *batches([(1, 0)], number=7)])
    (stream,) = read_with(dataflash.read, path)
    assert stream.n_samples == 64
    assert any("1 batches of gyros have senseless headers" in note for note in stream.notes)


def test_batches_with_other_than_32_samples_a_message_are_left_out(tmp_path):
    messages = batches([(1, 0)], count=64)
    messages += [("ISBD", BOOT, 0, s, [0] * 32, [0] * 32, [0] * 32) for s in (2, 3)]
    with pytest.raises(RecordingError, match=r"a\.bin: expected at least two messages of a gyro.*found 1 of ISBH"):
        read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", messages))


def test_batches_of_a_text_log_are_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"not read from a text log, .* give the \.bin"):
        read_with(dataflash.read, write_dataflash(tmp_path / "a.log", batches()))


class TestAccelerations:
    """What is said above of rates holds of accelerations."""

    @pytest.mark.parametrize("suffix", [".bin", ".log"])
    def test_each_instance_is_a_device(self, tmp_path, suffix):
        streams = read_with(dataflash.read, write_dataflash(tmp_path / f"a{suffix}", imu()), quantity="acceleration")
        assert [(stream.name, stream.unit) for stream in streams] == [("IMU[0]", "m/s^2"), ("IMU[1]", "m/s^2")]
        for instance, stream in enumerate(streams):
            np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], np.outer([1, 2, -9.75], np.ones(40)))
            np.testing.assert_array_equal(stream.channels["angular_rate"][1], np.full(40, instance))
            np.testing.assert_array_equal(stream.channels["temperature"], 30.0 + np.arange(40))
            assert stream.channel_units == {"angular_rate": "rad/s", "temperature": "degC"}

    def test_raw_samples_come_before_those_of_the_main_loop(self, tmp_path):
        path = write_dataflash(tmp_path / "a.bin", [*raw(161), *imu()])
        (stream,) = read_with(dataflash.read, path, quantity="acceleration")
        assert (stream.name, stream.unit, stream.n_samples) == ("ACC[0]", "m/s^2", 81)
        np.testing.assert_allclose(np.diff(stream.time), 1e-3, atol=1e-9)
        np.testing.assert_array_equal(stream.signal["x"], 2.0 * np.arange(81))
        np.testing.assert_allclose(stream.channels["angular_rate"][0], 0.5 * np.arange(81), atol=1e-6)
        assert stream.channel_units["angular_rate"] == "rad/s"
        assert any("IMU of the same log not read; choose with key=" in note for note in stream.notes)
        assert [s.name for s in read_with(dataflash.read, path, quantity="acceleration", key="IMU[1]")] == ["IMU[1]"]

    def test_batches_of_them(self, tmp_path):
        path = write_dataflash(tmp_path / "a.bin", batches())
        (stream,) = read_with(dataflash.read, path, quantity="acceleration")
        assert (stream.name, stream.unit, stream.rate) == ("ISBH[0]", "m/s^2", 2000.0)
        np.testing.assert_array_equal(stream.signal["y"], (100 + np.arange(64)) / 1000)
        assert any("(1 of accelerometer 0): read is the longest run of this accelerometer" in n for n in stream.notes)

    @pytest.mark.parametrize(
        ("quantity", "other", "messages"),
        [
            ("rate", "acceleration", [message for message in raw() if message[0] == "ACC"]),
            ("acceleration", "rate", [message for message in raw() if message[0] == "GYR"]),
            ("rate", "acceleration", batches([(0, 0)])),
            ("acceleration", "rate", batches([(1, 0)])),
        ],
    )
    def test_a_log_of_the_other_sensor_says_what_reads_it(self, tmp_path, quantity, other, messages):
        path = write_dataflash(tmp_path / "a.bin", messages)
        with pytest.raises(RecordingError, match=rf'two messages of an? (gyro|acc).*quantity="{other}"'):
            read_with(dataflash.read, path, quantity=quantity)
        (stream,) = read_with(dataflash.read, path, quantity=other)
        assert stream.channels == {}

    @pytest.mark.parametrize(("quantity", "key"), [("rate", "ACC"), ("acceleration", "GYR[0]")])
    def test_a_key_of_the_other_sensor(self, tmp_path, quantity, key):
        path = write_dataflash(tmp_path / "a.bin", raw())
        with pytest.raises(RecordingError, match=r"expected `key` \w+, IMU or ISBH.*which are read with quantity="):
            read_with(dataflash.read, path, quantity=quantity, key=key)


class TestDamage:
    def test_bytes_between_are_skipped_and_told(self, tmp_path):
        path = write_dataflash(tmp_path / "a.bin", imu())
        content = path.read_bytes()
        at = content.index(b"\xa3\x95\x0a", 1000)
        path.write_bytes(content[:at] + bytes(700) + content[at:])
        streams = read_with(dataflash.read, path)
        assert [stream.n_samples for stream in streams] == [40, 40]
        assert "700 bytes between messages are none and were skipped: damage" in streams[0].notes

    def test_a_log_that_was_cut_off_is_read_up_to_there(self, tmp_path):
        path = write_dataflash(tmp_path / "a.bin", imu())
        path.write_bytes(path.read_bytes()[:-10])
        streams = read_with(dataflash.read, path)
        assert [stream.n_samples for stream in streams] == [40, 39]
        assert streams[0].notes == ()

    def test_a_zero_filled_end_is_told(self, tmp_path):
        path = write_dataflash(tmp_path / "a.bin", imu())
        path.write_bytes(path.read_bytes() + bytes(5000))
        assert any("the last 5000 bytes are no message" in note for note in read_with(dataflash.read, path)[0].notes)

    def test_an_impossible_time_is_left_out(self, tmp_path):
        messages = imu(instances=[0])
        messages[7] = (messages[7][0], 2**60, *messages[7][2:])
        (stream,) = read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", messages))
        assert stream.n_samples == 39
        assert any("1 messages IMU with an impossible time" in note for note in stream.notes)

    @pytest.mark.parametrize("length", [0, 2, 50, 255])
    def test_a_declared_length_that_is_not_that_of_its_fields(self, tmp_path, length):
        path = write_dataflash(tmp_path / "a.bin", imu())
        content = bytearray(path.read_bytes())
        content[89 + 4] = length
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=r"a\.bin: expected at least two messages of a gyro"):
            read_with(dataflash.read, path)

    def test_lines_of_another_length_are_left_out(self, tmp_path):
        path = write_dataflash(tmp_path / "a.log", imu())
        path.write_bytes(path.read_bytes() + b"IMU, 12, 0\r\n\xff\xfe\r\n" + b"x" * 10_000)
        streams = read_with(dataflash.read, path)
        assert [stream.n_samples for stream in streams] == [40, 40]
        assert any("1 lines have more or fewer fields" in note for note in streams[0].notes)

    def test_nothing_is_printed(self, tmp_path, capfd):
        path = write_dataflash(tmp_path / "a.bin", imu())
        path.write_bytes(path.read_bytes() + bytes(5000) + b"\xa3\x95\xff" * 50)
        read_with(dataflash.read, path)
        assert capfd.readouterr() == ("", "")


class TestRefused:
    @pytest.mark.parametrize("suffix", [".bin", ".log"])
    def test_another_file(self, tmp_path, suffix):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(b"time,gx,gy,gz\n0,1,2,3\n" * 50)
        with pytest.raises(RecordingError, match=rf"a\{suffix}: expected an ArduPilot dataflash log.*found no mess"):
            read_with(dataflash.read, path)

    def test_a_log_without_gyros(self, tmp_path):
        with pytest.raises(RecordingError, match=r"expected at least two messages of a gyro .*found none of these"):
            read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", [("MSG", 1, "hello")]))

    @pytest.mark.parametrize("key", ["GPS", "IMU[", "imu", "IMU[7]", "GYR"])
    def test_a_key_that_is_not_there(self, tmp_path, key):
        with pytest.raises(RecordingError, match=r"a\.bin: expected .*`key`"):
            read_with(dataflash.read, write_dataflash(tmp_path / "a.bin", imu()), key=key)

    def test_more_than_the_memory_allowed(self, tmp_path):
        path = write_dataflash(tmp_path / "a.bin", imu())
        with pytest.raises(RecordingError, match=r"a\.bin.*max_bytes="):
            read_with(dataflash.read, path, max_bytes=10_000)


def test_values_are_those_of_another_reader(tmp_path):
    """Of every message that pymavlink finds, whose text reader and whose printing are not relied on."""
    mavlink = pytest.importorskip("pymavlink.DFReader")
    generator = np.random.default_rng(1)
    messages = [("MSG", 1, "\ud7a3 text"), *imu(200), *raw(), *batches([(1, 1), (0, 1), (1, 0)], count=96)]
    path = write_dataflash(tmp_path / "a.bin", [messages[i] for i in generator.permutation(len(messages))])
    theirs = {}
    with contextlib.closing(mavlink.DFReader_binary(str(path))) as log:
        while (message := log.recv_match(type=["IMU", "GYR", "ACC", "ISBD"])) is not None:
            theirs.setdefault(message.get_type(), []).append(message)
    tables, _ = read_binary(path.read_bytes(), Allowance(path))
    for name, found in theirs.items():
        for field in set(tables[name]) - {""}:
            values = [getattr(message, field) for message in found]
            np.testing.assert_array_equal(tables[name][field], [list(v) if field in "xyz" else v for v in values])


def test_random_bytes_take_no_longer_than_their_number(tmp_path):
    """Magic bytes at every place, declarations of every length: each byte is looked at a few times at most."""
    head = write_dataflash(tmp_path / "a.bin", imu(2)).read_bytes()
    noise = struct.pack("<3B", 0xA3, 0x95, 128) * 100_000
    (tmp_path / "b.bin").write_bytes(head + noise)
    assert [stream.n_samples for stream in read_with(dataflash.read, tmp_path / "b.bin")] == [2, 2]
