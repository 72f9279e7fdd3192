"""ROS bags of both generations: topics, stamps, channels, and files that are none."""

import sys

import numpy as np
import pytest
from logs import made_up, read_with, regular_stamps, seconds, write_ros1, write_ros2, write_topics

from gyrofuse.io.formats.robots import rosbag
from gyrofuse.io.streams import RecordingError


def ros1(path, *arguments, **options):
    return write_ros1(path / "a.bag", *arguments, **options)


def ros2(path, *arguments, **options):
    return write_ros2(path / "bag", *arguments, **options)


def sqlite_alone(path, *arguments, **options):
    return next(write_ros2(path / "bag", *arguments, **options).glob("*.db3"))


def mcap(path, *arguments, **options):
    return write_ros2(path / "bag", *arguments, mcap=True, **options)


def mcap_alone(path, *arguments, **options):
    return next(write_ros2(path / "bag", *arguments, mcap=True, **options).glob("*.mcap"))


every_format = pytest.mark.parametrize("write", [ros1, ros2, sqlite_alone, mcap, mcap_alone])
every_file = pytest.mark.parametrize("write", [ros1, sqlite_alone, mcap_alone])


@every_format
def test_each_imu_topic_is_a_device(tmp_path, write):
    gyro, acceleration, stamps = made_up(), made_up(seed=1), regular_stamps()
    streams = read_with(rosbag.read, write(tmp_path, gyro, stamps, acceleration=acceleration))
    assert [stream.name for stream in streams] == ["/imu0/data", "/imu1/data"]
    for device, stream in enumerate(streams):
        np.testing.assert_allclose([stream.signal[a] for a in "xyz"], gyro[device], rtol=0, atol=1e-12)
        np.testing.assert_allclose(stream.channels["acceleration"], acceleration[device], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(stream.time, seconds(stamps))
        assert stream.unit == "rad/s"
        assert stream.channel_units == {"acceleration": "m/s^2"}
        assert stream.notes == (f"frame_id 'imu{device}_link'",)


@every_format
def test_arrival_stands_in_for_headers_without_stamps(tmp_path, write):
    stamps = regular_stamps()
    stream, _ = read_with(rosbag.read, write(tmp_path, made_up(), stamps, stamped=False))
    np.testing.assert_array_equal(stream.time, seconds(stamps))
    assert any("arrival" in note for note in stream.notes)


def test_repeated_and_missing_stamps_stay(tmp_path):
    stamps = np.delete(regular_stamps(61), 30)
    stamps[10] = stamps[9]
    stream, _ = read_with(rosbag.read, ros1(tmp_path, made_up(), stamps))
    np.testing.assert_array_equal(stream.time, seconds(stamps))


def test_a_quantity_marked_as_not_measured_is_no_channel(tmp_path):
    stream, _ = read_with(rosbag.read, ros1(tmp_path, made_up(), regular_stamps()))
    assert stream.channels == {}


@pytest.mark.parametrize("key", ["/imu1/data", "imu1", "/imu1"])
def test_key_is_a_topic_or_its_beginning(tmp_path, key):
    (stream,) = read_with(rosbag.read, ros2(tmp_path, made_up(), regular_stamps()), key=key)
    assert stream.name == "/imu1/data"


def test_a_key_that_is_no_topic(tmp_path):
    with pytest.raises(RecordingError, match=r"named by `key` '/gps', found /imu0/data \(sensor_msgs/msg/Imu\)"):
        read_with(rosbag.read, ros1(tmp_path, made_up(), regular_stamps()), key="/gps")


@every_format
def test_a_bag_without_an_imu_says_what_it_holds(tmp_path, write):
    path = write(tmp_path, made_up(1), regular_stamps(), msgtype="std_msgs/msg/Header")
    with pytest.raises(RecordingError, match=r"sensor_msgs/msg/Imu, found /imu0/data \(std_msgs/msg/Header\)"):
        read_with(rosbag.read, path)


def test_rates_that_are_marked_as_not_measured(tmp_path):
    with pytest.raises(RecordingError, match=r"expected angular velocities in /imu0/data, found none"):
        read_with(rosbag.read, ros1(tmp_path, made_up(1), regular_stamps(), measured=False))


def test_topics_without_messages(tmp_path):
    with pytest.raises(RecordingError, match=r"expected angular velocities in /imu0/data, /imu1/data, found none"):
        read_with(rosbag.read, mcap(tmp_path, made_up(n_samples=0), regular_stamps(0)))


@every_file
@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_a_truncated_bag(tmp_path, write, keep):
    path = write(tmp_path, made_up(n_samples=600), regular_stamps(600))
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(RecordingError, match=f"{path.name}: expected .*found .*(reindex|IMU data)"):
        read_with(rosbag.read, path)


@every_file
def test_the_right_name_with_the_wrong_content(tmp_path, write):
    path = write(tmp_path, made_up(), regular_stamps())
    path.write_bytes(b"time,gx,gy,gz\n0,1,2,3\n" * 50)
    with pytest.raises(RecordingError, match=f"{path.name}: expected an indexed ROS 1 or ROS 2 bag"):
        read_with(rosbag.read, path)


def test_a_ros1_bag_whose_recorder_died_before_the_index(tmp_path):
    path = ros1(tmp_path, made_up(), regular_stamps())
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    with pytest.raises(RecordingError, match=r"not indexed.*rosbag reindex"):
        read_with(rosbag.read, path)


def test_a_directory_without_metadata(tmp_path):
    with pytest.raises(RecordingError, match=r"metadata"):
        read_with(rosbag.read, tmp_path)


IMU, VECTOR = "sensor_msgs/msg/Imu", "geometry_msgs/msg/Vector3Stamped"
MAGNETIC, WARM, PRESSURE = (f"sensor_msgs/msg/{name}" for name in ("MagneticField", "Temperature", "FluidPressure"))
every_suffix = pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])


def gyro_topic(name="/camera/gyro/sample", n=80, rate=200.0, acceleration=0.0):
    """Rates 1, 2, 3, ... about x, and accelerations that are all the same."""
    values = np.column_stack([np.arange(1.0, n + 1), *[np.full(n, 0.5)] * 2, *[np.full(n, acceleration)] * 3])
    return name, IMU, regular_stamps(n, rate), values


def accel_topic(name="/camera/accel/sample", n=26, rate=62.5):
    """Accelerations 0, 16, 32, ... m/s^2 along x, a ramp of 1 m/s^2 a millisecond; rates are zero."""
    values = np.zeros((n, 6))
    values[:, 3], values[:, 5] = 16.0 * np.arange(n), 9.75
    return name, IMU, regular_stamps(n, rate), values


class TestChannelsOfOtherTopics:
    @every_suffix
    def test_accelerations_of_a_topic_without_rates(self, tmp_path, suffix):
        (stream,) = read_with(rosbag.read, write_topics(tmp_path / f"a{suffix}", [gyro_topic(), accel_topic()]))
        assert stream.name == "/camera/gyro/sample"
        np.testing.assert_array_equal(stream.signal["x"], np.arange(1.0, 81))
        # 5 ms apart, and the ramp ends after 400 ms
        np.testing.assert_allclose(stream.channels["acceleration"][0], 5.0 * np.arange(80), atol=1e-3)
        assert stream.channel_units == {"acceleration": "m/s^2"}
        assert "angular velocities exactly zero throughout in /camera/accel/sample: no gyro" in stream.notes
        assert "linear accelerations exactly zero throughout: none measured" in stream.notes
        assert any(
            "acceleration is that of /camera/accel/sample; acceleration has its own clock (62.5 Hz)" in note
            for note in stream.notes
        )

    def test_nothing_is_made_up_outside_of_their_time(self, tmp_path):
        topics = [gyro_topic(), accel_topic(n=11)]
        (stream,) = read_with(rosbag.read, write_topics(tmp_path / "a.bag", topics))
        np.testing.assert_array_equal(np.isnan(stream.channels["acceleration"][0]), np.arange(80) > 32)

    def test_a_gap_is_not_bridged(self, tmp_path):
        name, kind, stamps, values = accel_topic()
        lacking = np.delete(np.arange(26), [10, 11])
        (stream,) = read_with(
            rosbag.read,
            write_topics(tmp_path / "a.bag", [gyro_topic(), (name, kind, stamps[lacking], values[lacking])]),
        )
        missing = np.flatnonzero(np.isnan(stream.channels["acceleration"][0]))
        np.testing.assert_array_equal(missing, np.arange(29, 39))  # 144 to 192 ms

    def test_a_key_brings_the_accelerations_along(self, tmp_path):
        path = write_topics(tmp_path / "a.bag", [gyro_topic(), accel_topic(), gyro_topic("/other/imu")])
        (stream,) = read_with(rosbag.read, path, key="/camera/gyro/sample")
        assert "acceleration" in stream.channels
        with pytest.raises(RecordingError, match=r"/camera/accel/sample, found none .* exactly zero throughout"):
            read_with(rosbag.read, path, key="/camera/accel/sample")

    @every_suffix
    def test_field_temperature_and_pressure(self, tmp_path, suffix):
        stamps = regular_stamps(80, 200.0)
        topics = [
            gyro_topic("/imu/data", acceleration=9.5),
            ("/imu/mag", MAGNETIC, stamps, np.outer(np.arange(80), [1e-6, 2e-6, 3e-6])),
            ("/imu/temperature", WARM, stamps[::20], np.full((4, 1), 36.5)),
            ("/imu/pressure", PRESSURE, stamps[::2], np.full((40, 1), 101325.0)),
        ]
        (stream,) = read_with(rosbag.read, write_topics(tmp_path / f"a{suffix}", topics))
        assert stream.channels["magnetic_field"].shape == (3, 80)
        np.testing.assert_allclose(stream.channels["magnetic_field"][2], 3e-6 * np.arange(80))
        np.testing.assert_array_equal(stream.channels["temperature"][:61], 36.5)
        assert np.isnan(stream.channels["temperature"][61:]).all()
        np.testing.assert_array_equal(stream.channels["pressure"][:79], 101325.0)
        units = {"acceleration": "m/s^2", "magnetic_field": "T", "temperature": "degC", "pressure": "Pa"}
        assert stream.channel_units == units
        assert "magnetic_field is that of /imu/mag" in stream.notes

    def test_a_channel_goes_with_the_gyro_whose_name_begins_alike(self, tmp_path):
        topics = [gyro_topic("/left/imu"), gyro_topic("/right/imu"), accel_topic("/right/accel")]
        topics.append(("/weather", WARM, regular_stamps(80), np.full((80, 1), 21.0)))
        left, right = read_with(rosbag.read, write_topics(tmp_path / "a.bag", topics))
        assert (list(left.channels), list(right.channels)) == (["temperature"], ["acceleration"])

    def test_clocks_without_a_common_time_are_compared_by_arrival(self, tmp_path):
        path = write_topics(tmp_path / "a.bag", [gyro_topic()])
        other = write_topics(tmp_path / "b.bag", [accel_topic()], clock_offset=10**15)
        whole = merged(tmp_path / "c.bag", path, other)
        (stream,) = read_with(rosbag.read, whole)
        np.testing.assert_allclose(stream.channels["acceleration"][0], 5.0 * np.arange(80), atol=1e-3)
        assert any("by arrival at the recorder" in note for note in stream.notes)


def merged(path, *bags):
    """One ROS 1 bag of the messages of several."""
    from rosbags.rosbag1 import Reader, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(path) as out:
        for bag in bags:
            with Reader(bag) as source:
                ways = {c.id: out.add_connection(c.topic, c.msgtype, typestore=store) for c in source.connections}
                for connection, arrival, raw in source.messages():
                    out.write(ways[connection.id], arrival, raw)
    return path


class TestVectors:
    @every_suffix
    @pytest.mark.parametrize(
        ("topic", "unit"), [("/imu/angular_velocity", "rad/s"), ("/multisense/imu/gyroscope_vector", "deg/s")]
    )
    def test_rates_by_the_name_of_the_topic(self, tmp_path, suffix, topic, unit):
        rates = made_up(1)[0].T
        (stream,) = read_with(
            rosbag.read, write_topics(tmp_path / f"a{suffix}", [(topic, VECTOR, regular_stamps(), rates)])
        )
        assert (stream.name, stream.unit) == (topic, unit)
        assert any("as multisense_ros publishes it" in note for note in stream.notes) == (unit == "deg/s")
        np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], rates.T)

    def test_rates_by_the_frame(self, tmp_path):
        topics = [("/vector", VECTOR, regular_stamps(), made_up(1)[0].T)]
        (stream,) = read_with(rosbag.read, write_topics(tmp_path / "a.bag", topics, frame="gyro_link"))
        assert stream.name == "/vector"
        with pytest.raises(RecordingError, match=r"expected angular velocities in /vector, found none"):
            read_with(rosbag.read, write_topics(tmp_path / "b.bag", topics, frame="arm"))

    def test_they_are_no_second_device_beside_an_imu(self, tmp_path):
        topics = [gyro_topic("/imu/data"), ("/imu/angular_velocity", VECTOR, regular_stamps(), made_up(1)[0].T)]
        path = write_topics(tmp_path / "a.bag", topics)
        (stream,) = read_with(rosbag.read, path)
        assert stream.name == "/imu/data"
        assert any("rates in /imu/angular_velocity are not read beside" in note for note in stream.notes)
        assert [s.name for s in read_with(rosbag.read, path, key="/imu/angular_velocity")] == ["/imu/angular_velocity"]


class TestAccelerations:
    """What is said above of rates holds of accelerations, and the other way round."""

    @every_format
    def test_each_imu_topic_is_a_device(self, tmp_path, write):
        gyro, acceleration, stamps = made_up(), made_up(seed=1), regular_stamps()
        path = write(tmp_path, gyro, stamps, acceleration=acceleration)
        for device, stream in enumerate(read_with(rosbag.read, path, quantity="acceleration")):
            assert (stream.name, stream.unit) == (f"/imu{device}/data", "m/s^2")
            np.testing.assert_allclose([stream.signal[a] for a in "xyz"], acceleration[device], rtol=0, atol=1e-12)
            np.testing.assert_allclose(stream.channels["angular_rate"], gyro[device], rtol=0, atol=1e-12)
            assert stream.channel_units == {"angular_rate": "rad/s"}

    @every_suffix
    def test_they_keep_their_own_clock(self, tmp_path, suffix):
        path = write_topics(tmp_path / f"a{suffix}", [gyro_topic(n=81), accel_topic()])
        (stream,) = read_with(rosbag.read, path, quantity="acceleration")
        assert (stream.name, stream.unit, stream.n_samples) == ("/camera/accel/sample", "m/s^2", 26)
        np.testing.assert_allclose(np.diff(stream.time), 16e-3, atol=1e-6)
        np.testing.assert_array_equal(stream.signal["x"], 16.0 * np.arange(26))
        # rates 1, 2, 3, ... every 5 ms
        np.testing.assert_allclose(stream.channels["angular_rate"][0], 1 + 3.2 * np.arange(26), atol=1e-3)
        assert stream.channel_units == {"angular_rate": "rad/s"}
        assert "linear accelerations exactly zero throughout in /camera/gyro/sample: no accelerometer" in stream.notes
        assert any("angular_rate is that of /camera/gyro/sample" in note for note in stream.notes)

    @pytest.mark.parametrize(
        ("topic", "unit"),
        [("/imu/acceleration", "m/s^2"), ("/multisense/imu/accelerometer_vector", "g"), ("/imu/acc", "m/s^2")],
    )
    def test_vectors_by_the_name_of_the_topic(self, tmp_path, topic, unit):
        values = made_up(1)[0].T
        path = write_topics(tmp_path / "a.mcap", [(topic, VECTOR, regular_stamps(), values)])
        (stream,) = read_with(rosbag.read, path, quantity="acceleration")
        assert (stream.name, stream.unit) == (topic, unit)
        np.testing.assert_array_equal([stream.signal[a] for a in "xyz"], values.T)
        with pytest.raises(
            RecordingError, match=r'expected angular velocities .*, found none.*quantity="acceleration"'
        ):
            read_with(rosbag.read, path)

    def test_an_estimate_without_gravity_is_none(self, tmp_path):
        topics = [("/filter/free_acceleration", VECTOR, regular_stamps(), made_up(1)[0].T)]
        with pytest.raises(RecordingError, match=r"expected linear accelerations .*, found none.*`key`"):
            read_with(rosbag.read, write_topics(tmp_path / "a.bag", topics), quantity="acceleration")

    @pytest.mark.parametrize(
        ("quantity", "name", "channel"),
        [
            ("rate", "/imu/angular_velocity", "acceleration"),
            ("acceleration", "/imu/acceleration", "angular_rate"),
        ],
    )
    def test_vectors_of_both(self, tmp_path, quantity, name, channel):
        rates, accelerations = made_up(2)
        topics = [
            ("/imu/angular_velocity", VECTOR, regular_stamps(), rates.T),
            ("/imu/acceleration", VECTOR, regular_stamps(), accelerations.T),
        ]
        path = write_topics(tmp_path / "a.bag", topics)
        for key in (None, name):
            (stream,) = read_with(rosbag.read, path, quantity=quantity, key=key)
            assert (stream.name, list(stream.channels)) == (name, [channel])
            np.testing.assert_array_equal(stream.channels[channel], accelerations if quantity == "rate" else rates)

    def test_units_of_vectors_that_multisense_publishes(self, tmp_path):
        rates, accelerations = made_up(2)
        topics = [
            ("/multisense/imu/gyroscope_vector", VECTOR, regular_stamps(), rates.T),
            ("/multisense/imu/accelerometer_vector", VECTOR, regular_stamps(), accelerations.T),
        ]
        (stream,) = read_with(rosbag.read, write_topics(tmp_path / "a.bag", topics), quantity="acceleration")
        assert (stream.unit, stream.channel_units) == ("g", {"angular_rate": "deg/s"})
        assert "/multisense/imu/accelerometer_vector is read in g, as multisense_ros publishes it" in stream.notes
        assert "/multisense/imu/gyroscope_vector is read in deg/s, as multisense_ros publishes it" in stream.notes

    def test_a_bag_of_gyros_says_what_reads_them(self, tmp_path):
        path = write_topics(tmp_path / "a.bag", [gyro_topic()])
        with pytest.raises(RecordingError, match=r'expected linear accelerations in .*it has gyros.*quantity="rate"'):
            read_with(rosbag.read, path, quantity="acceleration")
        path = write_topics(tmp_path / "b.bag", [accel_topic()])
        with pytest.raises(RecordingError, match=r'expected angular velocities in .*quantity="acceleration"'):
            read_with(rosbag.read, path)
        assert read_with(rosbag.read, path, quantity="acceleration")[0].n_samples == 26


def test_the_missing_library_is_named(tmp_path, monkeypatch):
    for module in ("rosbags", "rosbags.rosbag1"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r'needs (\w+); pip install \1, or .* pip install "\.\[logs\]"'):
        read_with(rosbag.read, tmp_path / "a.bag")
