"""ROS 1 and ROS 2 bags: every topic of type sensor_msgs/Imu with rates is a device, other topics are its channels.

Drivers that sample gyro and accelerometer apart (realsense2_camera: `/camera/gyro/sample`, `/camera/accel/sample`)
publish two topics of that type, each with zeros for what it does not measure. Others (xsens_mti_driver:
`/imu/angular_velocity`, multisense_ros: `imu/gyroscope_vector`) publish rates as geometry_msgs/Vector3Stamped.
"""

from __future__ import annotations

import contextlib
import re
import sqlite3
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from gyrofuse.io.limits import LONGEST_NAME, Allowance, enumerated, is_regular
from gyrofuse.io.resample import at_samples
from gyrofuse.io.stream import Array, RecordingError, Stream, cause

_IMU = "sensor_msgs/msg/Imu"
_VECTOR = "geometry_msgs/msg/Vector3Stamped"
_TIMES = 3  # numbers of a message that are kept beside its values
# What is kept of a message of each type.
_VALUES: dict[str, Callable[[Any], tuple[float, ...]]] = {
    _IMU: lambda m: (*_xyz(m.angular_velocity), *_xyz(m.linear_acceleration)),
    _VECTOR: lambda m: _xyz(m.vector),
    "sensor_msgs/msg/MagneticField": lambda m: _xyz(m.magnetic_field),
    "sensor_msgs/msg/Temperature": lambda m: (m.temperature,),
    "sensor_msgs/msg/FluidPressure": lambda m: (m.fluid_pressure,),
}
# Names and units of the channels, by the definitions of the messages.
_CHANNELS = {
    "sensor_msgs/msg/MagneticField": ("magnetic_field", "T"),
    "sensor_msgs/msg/Temperature": ("temperature", "degC"),
    "sensor_msgs/msg/FluidPressure": ("pressure", "Pa"),
}
_ACCELERATION = ("acceleration", "m/s^2")
# A topic or frame that says of a vector that it is a rate.
_RATE = re.compile(r"gyr|angular_?(?:vel|rate)|(?:^|[/_])omega", re.IGNORECASE)


def read(path: Path, *, key: str | None = None, quantity: str = "rate", max_bytes: float | None = None) -> list[Stream]:
    """Read the gyros of a ROS bag in rad/s, one stream per topic of type sensor_msgs/Imu with rates.

    A ROS 1 `.bag`, a ROS 2 directory with its `metadata.yaml`, or a `.db3` or `.mcap` file alone; no ROS
    installation is needed. Time is that of the message headers, or of arrival at the recorder where these are
    not stamped. Where no such topic has rates, geometry_msgs/Vector3Stamped is read whose topic or frame names a gyro.
    Accelerations from a topic without rates, and topics of type sensor_msgs/MagneticField, Temperature and
    FluidPressure, become channels of the gyro whose name begins most alike, by their own clock.

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
            connections = [c for c in bag.connections if _is_read(c.topic, c.msgtype, topics, key)]
            no_rate: set[str] = set()
            for connection, arrival, raw in bag.messages(connections):
                topic, kind = connection.topic, connection.msgtype
                if topic in no_rate:
                    continue
                message: Any = deserialize(raw, kind)
                if kind == _VECTOR and topic not in messages and not _names_rate(topic, message.header.frame_id):
                    no_rate.add(topic)
                    continue
                known = messages.setdefault(topic, _Messages(kind))
                if kind != known.kind:
                    raise ValueError(f"messages of two types in {topic}: {kind} and {known.kind}")
                known.append(message, arrival)
                allowance.take(f"messages of {topic}", (_TIMES + known.width + len(message.header.frame_id) // 8,))
    except RecordingError:
        raise
    except Exception as error:  # a damaged bag may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected an indexed ROS 1 or ROS 2 bag, found one that cannot be read ({cause(error)}); "
            "repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`, or record it again"
        ) from error

    gyros, notes = _gyros(messages, topics, key)
    if not gyros:
        raise RecordingError(
            f"{path}: expected angular velocities in {enumerated(sorted(topics))}, found none (no message, exactly "
            "zero throughout, or marked as not measured); choose other topics with `key`"
        )
    channels = _owned(messages, gyros)
    return [messages[topic].stream(topic, channels[topic], notes) for topic in gyros]


def _check_tables(path: Path) -> None:
    """Raise `ValueError` where what stands in a database is computed when it is read, which may take for ever."""
    with contextlib.closing(sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)) as database:
        for kind, name, command in database.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
            columns = database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)).fetchall()
            virtual = str(command).lower().startswith("create virtual")
            if kind == "view" or virtual or any(hidden for (hidden,) in columns):
                raise ValueError(f"a table {name!r} that is computed, not stored")


def _choose(path: Path, kinds: list[tuple[str, str]], key: str | None) -> set[str]:
    """Return the topics of Imu or vectors that `key` names or begins, all of them without `key`."""
    topics = {topic for topic, kind in kinds if kind in (_IMU, _VECTOR)}
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


def _is_read(topic: str, kind: str, topics: set[str], key: str | None) -> bool:
    """Whether a topic is a gyro that was asked for or may be a channel of one."""
    if kind not in _VALUES:
        return False
    if key is None or topic in topics or kind in _CHANNELS:
        return True
    return kind == _IMU and any(_alike(topic, other) for other in topics)


def _alike(topic: str, other: str) -> int:
    """How many parts the names of two topics begin with in common."""
    pairs = list(zip(topic.strip("/").split("/"), other.strip("/").split("/"), strict=False))
    return next((n for n, (one, two) in enumerate(pairs) if one != two), len(pairs))


def _names_rate(topic: str, frame: str) -> bool:
    return any(_RATE.search(name[:LONGEST_NAME]) for name in (topic, frame))


def _gyros(messages: dict[str, _Messages], topics: set[str], key: str | None) -> tuple[list[str], list[str]]:
    """The topics with rates among those asked for, and what is said of the others."""
    notes = []
    there = sorted(topics & messages.keys())
    zero = [topic for topic in there if messages[topic].has_rate and not messages[topic].turns]
    if zero:
        notes.append(f"angular velocities exactly zero throughout in {enumerated(zero)}: no gyro")
    gyros = [topic for topic in there if messages[topic].kind == _IMU and messages[topic].turns]
    vectors = [topic for topic in there if messages[topic].kind == _VECTOR and messages[topic].turns]
    if not gyros or (key is not None and "/" + key.strip("/") in vectors):
        return vectors, notes
    if vectors:
        notes.append(f"rates in {enumerated(vectors)} are not read beside those of Imu topics; choose them with key=")
    return gyros, notes


def _owned(messages: dict[str, _Messages], gyros: list[str]) -> dict[str, list[tuple[str, str, str, _Messages]]]:
    """For each gyro the channels of other topics: name, unit, topic and messages."""
    owned: dict[str, list[tuple[str, str, str, _Messages]]] = {topic: [] for topic in gyros}
    for topic, other in sorted(messages.items()):
        if topic in owned or other.kind == _VECTOR or (other.kind == _IMU and (other.turns or not other.accelerates)):
            continue
        name, unit = _CHANNELS.get(other.kind, _ACCELERATION)
        owner = max(gyros, key=lambda gyro: _alike(gyro, topic))  # the first one, where several are as much alike
        owned[owner].append((name, unit, topic, other))
    return owned


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


@dataclass
class _Messages:
    """The messages of one topic, packed: a long bag holds millions."""

    kind: str
    stamp: array[int] = field(default_factory=lambda: array("q"))  # sec, nanosec
    arrival: array[int] = field(default_factory=lambda: array("q"))  # nanoseconds
    values: array[float] = field(default_factory=lambda: array("d"))
    frames: dict[str, None] = field(default_factory=dict)
    width: int = 0  # values of a message
    has_rate: bool = False
    has_acceleration: bool = False

    def append(self, message: Any, arrival: int) -> None:
        """Add one deserialised message and when it reached the recorder, in nanoseconds."""
        stamp, values = message.header.stamp, _VALUES[self.kind](message)
        self.stamp.extend((stamp.sec, stamp.nanosec))
        self.arrival.append(arrival)
        self.values.extend(values)
        self.width = len(values)
        self.frames[message.header.frame_id] = None
        if self.kind == _IMU:
            # By the message's definition a covariance that begins with -1 says that the quantity is not measured.
            self.has_rate |= bool(message.angular_velocity_covariance[0] != -1)
            self.has_acceleration |= bool(message.linear_acceleration_covariance[0] != -1)
        else:
            self.has_rate = self.kind == _VECTOR

    @property
    def table(self) -> Array:
        """The values `(value, message)` as they were packed, not copied."""
        return np.frombuffer(self.values, np.float64).reshape(-1, self.width).T

    @property
    def turns(self) -> bool:
        """Whether there are rates, and not zeros in their place."""
        return self.has_rate and bool(np.any(self.table[:3] != 0))

    @property
    def accelerates(self) -> bool:
        """Whether there are accelerations, and not zeros in their place."""
        return self.has_acceleration and bool(np.any(self.table[3:] != 0))

    def stream(self, topic: str, others: list[tuple[str, str, str, _Messages]], said: list[str]) -> Stream:
        """The device of this topic, with the channels that others hold."""
        table = self.table.copy()
        time, notes = self._time()
        frames = enumerated(repr(frame) for frame in self.frames if frame)
        channels, units = {}, {}
        if self.accelerates:
            channels["acceleration"], units["acceleration"] = table[3:], _ACCELERATION[1]
        elif self.has_acceleration:
            notes.append("linear accelerations exactly zero throughout: none measured")
        for name, unit, source, other in others:
            if name in channels:
                notes.append(f"{name} of {source} is left out beside that of another topic")
                continue
            times, by = self._common_clock(other)
            values = other.table[3:] if other.kind == _IMU else other.table
            channels[name], note = at_samples(*times, values if len(values) > 1 else values[0], name)
            units[name] = unit
            notes.append(f"{name} is that of {source}{by}" + (f"; {note}" if note else ""))
        return Stream(
            name=topic,
            gyro=dict(zip("xyz", table[:3], strict=True)),
            unit="rad/s",
            time=time,
            channels=channels,
            channel_units=units,
            notes=(*([f"frame_id {frames}"] if frames else []), *notes, *said),
        )

    def _common_clock(self, other: _Messages) -> tuple[tuple[Array, Array], str]:
        """Times of the messages of two topics, by the headers where these count by the same clock."""
        own, others = self._stamps(), other._stamps()
        overlap = own.max() >= others.min() and others.max() >= own.min()
        if self._is_stamped(own) and self._is_stamped(others) and overlap:
            return (own, others), ""
        return (self._arrivals(), other._arrivals()), ", by arrival at the recorder"

    def _time(self) -> tuple[Array, list[str]]:
        stamp = self._stamps()
        if self._is_stamped(stamp):
            return stamp, []
        return self._arrivals(), ["the header stamps do not advance; time is that of arrival at the recorder"]

    @staticmethod
    def _is_stamped(stamp: Array) -> bool:
        return bool(np.any(stamp != stamp[0]) or (stamp.size == 1 and stamp[0] != 0))

    def _stamps(self) -> Array:
        seconds, nanoseconds = np.array(self.stamp).reshape(-1, 2).T
        return np.asarray(seconds + nanoseconds * 1e-9)

    def _arrivals(self) -> Array:
        whole, rest = np.divmod(np.array(self.arrival), 10**9)
        return np.asarray(whole + rest * 1e-9)
