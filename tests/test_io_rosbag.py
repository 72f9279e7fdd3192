"""ROS bags of both generations: topics, stamps, channels, and files that are none."""

import sys

import numpy as np
import pytest
from logs import made_up, regular_stamps, seconds, write_ros1, write_ros2

from gyrofuse.io import rosbag
from gyrofuse.io.stream import RecordingError


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
    streams = rosbag.read(write(tmp_path, gyro, stamps, acceleration=acceleration))
    assert [stream.name for stream in streams] == ["/imu0/data", "/imu1/data"]
    for device, stream in enumerate(streams):
        np.testing.assert_allclose([stream.gyro[a] for a in "xyz"], gyro[device], rtol=0, atol=1e-12)
        np.testing.assert_allclose(stream.channels["acceleration"], acceleration[device], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(stream.time, seconds(stamps))
        assert stream.unit == "rad/s"
        assert stream.channel_units == {"acceleration": "m/s^2"}
        assert stream.notes == (f"frame_id 'imu{device}_link'",)


@every_format
def test_arrival_stands_in_for_headers_without_stamps(tmp_path, write):
    stamps = regular_stamps()
    stream, _ = rosbag.read(write(tmp_path, made_up(), stamps, stamped=False))
    np.testing.assert_array_equal(stream.time, seconds(stamps))
    assert any("arrival" in note for note in stream.notes)


def test_repeated_and_missing_stamps_stay(tmp_path):
    stamps = np.delete(regular_stamps(61), 30)
    stamps[10] = stamps[9]
    stream, _ = rosbag.read(ros1(tmp_path, made_up(), stamps))
    np.testing.assert_array_equal(stream.time, seconds(stamps))


def test_a_quantity_marked_as_not_measured_is_no_channel(tmp_path):
    stream, _ = rosbag.read(ros1(tmp_path, made_up(), regular_stamps()))
    assert stream.channels == {}


@pytest.mark.parametrize("key", ["/imu1/data", "imu1", "/imu1"])
def test_key_is_a_topic_or_its_beginning(tmp_path, key):
    (stream,) = rosbag.read(ros2(tmp_path, made_up(), regular_stamps()), key=key)
    assert stream.name == "/imu1/data"


def test_a_key_that_is_no_topic(tmp_path):
    with pytest.raises(RecordingError, match=r"named by `key` '/gps', found /imu0/data \(sensor_msgs/msg/Imu\)"):
        rosbag.read(ros1(tmp_path, made_up(), regular_stamps()), key="/gps")


@every_format
def test_a_bag_without_an_imu_says_what_it_holds(tmp_path, write):
    path = write(tmp_path, made_up(1), regular_stamps(), msgtype="std_msgs/msg/Header")
    with pytest.raises(RecordingError, match=r"sensor_msgs/msg/Imu, found /imu0/data \(std_msgs/msg/Header\)"):
        rosbag.read(path)


def test_rates_that_are_marked_as_not_measured(tmp_path):
    with pytest.raises(RecordingError, match=r"expected angular velocities in /imu0/data, found none"):
        rosbag.read(ros1(tmp_path, made_up(1), regular_stamps(), measured=False))


def test_topics_without_messages(tmp_path):
    with pytest.raises(RecordingError, match=r"expected angular velocities in /imu0/data, /imu1/data, found none"):
        rosbag.read(mcap(tmp_path, made_up(n_samples=0), regular_stamps(0)))


@every_file
@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_a_truncated_bag(tmp_path, write, keep):
    path = write(tmp_path, made_up(n_samples=600), regular_stamps(600))
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(RecordingError, match=f"{path.name}: expected .*found .*(reindex|IMU data)"):
        rosbag.read(path)


@every_file
def test_the_right_name_with_the_wrong_content(tmp_path, write):
    path = write(tmp_path, made_up(), regular_stamps())
    path.write_bytes(b"time,gx,gy,gz\n0,1,2,3\n" * 50)
    with pytest.raises(RecordingError, match=f"{path.name}: expected an indexed ROS 1 or ROS 2 bag"):
        rosbag.read(path)


def test_a_ros1_bag_whose_recorder_died_before_the_index(tmp_path):
    path = ros1(tmp_path, made_up(), regular_stamps())
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    with pytest.raises(RecordingError, match=r"not indexed.*rosbag reindex"):
        rosbag.read(path)


def test_a_directory_without_metadata(tmp_path):
    with pytest.raises(RecordingError, match=r"metadata"):
        rosbag.read(tmp_path)


def test_the_missing_library_is_named(tmp_path, monkeypatch):
    for module in ("rosbags", "rosbags.rosbag1"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r'pip install "gyrofuse\[logs\]"'):
        rosbag.read(tmp_path / "a.bag")
