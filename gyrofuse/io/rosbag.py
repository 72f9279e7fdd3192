"""ROS 1 and ROS 2 bags: every topic of type sensor_msgs/Imu is a device."""

from __future__ import annotations

import contextlib
import sqlite3
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from gyrofuse.io.limits import Allowance, enumerated, is_regular
from gyrofuse.io.stream import Array, RecordingError, Stream, cause

_IMU = "sensor_msgs/msg/Imu"
_NUMBERS = 9  # of a message that are kept: 3 of its times, 6 of its values


def read(path: Path, *, key: str | None = None, max_bytes: float | None = None) -> list[Stream]:
    """Read the gyros of a ROS bag in rad/s, one stream per topic of type sensor_msgs/Imu.

    A ROS 1 `.bag`, a ROS 2 directory with its `metadata.yaml`, or a `.db3` or `.mcap` file alone; no ROS
    installation is needed. Time is that of the message headers, or of arrival at the recorder where these are
    not stamped.

    Args:
        path: File or directory.
        key: A topic, or the beginning of the topics to read.
        max_bytes: Memory that the messages may take; by default a quarter of what there is.

    Raises:
        RecordingError: Not a bag, not indexed, truncated, without the topic asked for, or too large.
        ImportError: rosbags is not installed.
    """
    try:
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag2 import Reader as Ros2Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(f'{path}: reading ROS bags needs rosbags; pip install "gyrofuse[logs]"') from error

    # sensor_msgs/Imu is the same in every ROS 1 and in every ROS 2: a bag without embedded definitions, or
    # with unreadable ones of other messages, is no obstacle.
    ros1 = path.suffix == ".bag" and path.is_file()
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    deserialize = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    messages: dict[str, _Messages] = {}
    allowance = Allowance(path, max_bytes)
    odd = [file.name for file in path.iterdir() if not (is_regular(file) or file.is_dir())] if path.is_dir() else []
    if odd:
        raise RecordingError(
            f"{path}: expected the files of a bag, found {enumerated(odd)}, which is no file; remove it"
        )
    try:
        for file in sorted(path.glob("*.db3")) if path.is_dir() else [path] if path.suffix.lower() == ".db3" else []:
            _check_tables(file)
        with (Ros1Reader if ros1 else Ros2Reader)(path) as bag:
            topics = _choose(path, [(c.topic, c.msgtype) for c in bag.connections], key)
            connections = [c for c in bag.connections if c.topic in topics and c.msgtype == _IMU]
            for connection, arrival, raw in bag.messages(connections):
                message: Any = deserialize(raw, _IMU)
                allowance.take(f"messages of {connection.topic}", (_NUMBERS + len(message.header.frame_id) // 8,))
                messages.setdefault(connection.topic, _Messages()).append(message, arrival)
    except RecordingError:
        raise
    except Exception as error:  # a damaged bag may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected an indexed ROS 1 or ROS 2 bag, found one that cannot be read ({cause(error)}); "
            "repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`, or record it again"
        ) from error

    streams = [messages[topic].stream(topic) for topic in sorted(messages) if messages[topic].has_rate]
    if not streams:
        raise RecordingError(
            f"{path}: expected angular velocities in {enumerated(sorted(topics))}, found none (no message, or "
            "marked as not measured); choose other topics with `key`"
        )
    return streams


def _check_tables(path: Path) -> None:
    """Raise `ValueError` where what stands in a database is computed when it is read, which may take for ever."""
    with contextlib.closing(sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)) as database:
        for kind, name, command in database.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
            columns = database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)).fetchall()
            virtual = str(command).lower().startswith("create virtual")
            if kind == "view" or virtual or any(hidden for (hidden,) in columns):
                raise ValueError(f"a table {name!r} that is computed, not stored")


def _choose(path: Path, kinds: list[tuple[str, str]], key: str | None) -> set[str]:
    """Return the Imu topics that `key` names or begins, all of them without `key`."""
    topics = {topic for topic, kind in kinds if kind == _IMU}
    if key is not None:
        name = "/" + key.strip("/")
        topics = topics & {name} or {topic for topic in topics if topic.startswith(name)}
    if not topics:
        found = enumerated(f"{topic} ({kind})" for topic, kind in sorted(kinds)) or "no topic"
        wanted = "" if key is None else f" named by `key` {key!r}"
        raise RecordingError(
            f"{path}: expected a topic of type {_IMU}{wanted}, found {found}; choose a bag with IMU data"
        )
    return topics


@dataclass
class _Messages:
    """The messages of one topic, packed: a long bag holds millions."""

    stamp: array[int] = field(default_factory=lambda: array("q"))  # sec, nanosec
    arrival: array[int] = field(default_factory=lambda: array("q"))  # nanoseconds
    values: array[float] = field(default_factory=lambda: array("d"))  # angular velocity, linear acceleration
    frames: dict[str, None] = field(default_factory=dict)
    has_rate: bool = False
    has_acceleration: bool = False

    def append(self, message: Any, arrival: int) -> None:
        """Add one deserialised message and when it reached the recorder, in nanoseconds."""
        stamp, rate = message.header.stamp, message.angular_velocity
        acceleration = message.linear_acceleration
        self.stamp.extend((stamp.sec, stamp.nanosec))
        self.arrival.append(arrival)
        self.values.extend((rate.x, rate.y, rate.z, acceleration.x, acceleration.y, acceleration.z))
        self.frames[message.header.frame_id] = None
        # By the message's definition a covariance that begins with -1 says that the quantity is not measured.
        self.has_rate |= bool(message.angular_velocity_covariance[0] != -1)
        self.has_acceleration |= bool(message.linear_acceleration_covariance[0] != -1)

    def stream(self, topic: str) -> Stream:
        """The device of this topic."""
        gyro_x, gyro_y, gyro_z, *acceleration = np.array(self.values).reshape(-1, 6).T.copy()
        time, notes = self._time()
        frames = enumerated(repr(frame) for frame in self.frames if frame)
        return Stream(
            name=topic,
            gyro={"x": gyro_x, "y": gyro_y, "z": gyro_z},
            unit="rad/s",
            time=time,
            channels={"acceleration": np.stack(acceleration)} if self.has_acceleration else {},
            channel_units={"acceleration": "m/s^2"} if self.has_acceleration else {},
            notes=(*([f"frame_id {frames}"] if frames else []), *notes),
        )

    def _time(self) -> tuple[Array, list[str]]:
        seconds, nanoseconds = np.array(self.stamp).reshape(-1, 2).T
        stamp = seconds + nanoseconds * 1e-9
        if np.any(stamp != stamp[0]) or (stamp.size == 1 and stamp[0] != 0):
            return stamp, []
        whole, rest = np.divmod(np.array(self.arrival), 10**9)
        note = "the header stamps do not advance; time is that of arrival at the recorder"
        return whole + rest * 1e-9, [note]
