"""ROS 1 and ROS 2 bags: topics of type sensor_msgs/Imu are devices, other topics are their channels.

Drivers that sample gyro and accelerometer apart (realsense2_camera: `/camera/gyro/sample`, `/camera/accel/sample`)
publish two topics of that type, each with zeros for what it does not measure. Others (xsens_mti_driver:
`/imu/angular_velocity`, `/imu/acceleration`; multisense_ros: `imu/gyroscope_vector`, `imu/accelerometer_vector`)
publish each as geometry_msgs/Vector3Stamped.
"""

from __future__ import annotations

import contextlib
import re
import sqlite3
from pathlib import Path
from typing import Any
from urllib.parse import quote

from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.robots.rosbag_messages import CHANNEL_TYPES, IMU, VALUES, VECTOR, Messages, unit_of
from gyrofuse.io.limits import LONGEST_NAME, enumerated, is_regular
from gyrofuse.io.quantities import ACCELERATION, QUANTITY, RATE, Quantity
from gyrofuse.io.streams import RecordingError, Stream, needed, reading

# Topics or frames whose name says that a vector is of a quantity. A free acceleration is an estimate, without gravity
# (xsens_mti_driver: `/filter/free_acceleration`).
_NAMES = {
    RATE: re.compile(r"gyr|angular_?(?:vel|rate)|(?:^|[/_])omega", re.IGNORECASE),
    ACCELERATION: re.compile(r"(?<!free)(?<!free_)accel|(?:^|[/_])acc(?:[/_]|$)", re.IGNORECASE),
}


def read(request: Request) -> list[Stream]:
    """Read the gyros or accelerometers of a ROS bag, in rad/s or m/s^2, one stream per topic of type sensor_msgs/Imu.

    A ROS 1 `.bag`, a ROS 2 directory with its `metadata.yaml`, or a `.db3` or `.mcap` file alone; no ROS installation
    is needed. Time is the stamp of the message headers, or the arrival at the recorder where headers are not stamped.
    Where no such topic has the quantity, topics of type geometry_msgs/Vector3Stamped are read whose name or frame names
    the quantity. The other quantity of the same messages is a channel. A topic with the other quantity alone, and
    topics of type sensor_msgs/MagneticField, Temperature and FluidPressure, become channels of the device whose name
    has the longest beginning in common with theirs, by their own clock.

    Args:
        request: The file or folder and the part of it to read. Its `key` is a topic, or the beginning of the topics to
            read.

    Raises:
        RecordingError: Not a bag, not indexed, truncated, without the quantity or topic asked for, or too large.
        ImportError: rosbags is not installed.
    """
    path, key, quantity = request.path, request.key, request.quantity
    with needed(path, "ROS bags", "rosbags"):
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag2 import Reader as Ros2Reader
        from rosbags.typesys import Stores, get_typestore

    # The definition of sensor_msgs/Imu is the same in every ROS 1 and in every ROS 2, so that a bag is read although it
    # has no definitions of its messages, or unreadable ones.
    ros1 = path.suffix == ".bag" and path.is_file()
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    deserialize = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    messages: dict[str, Messages] = {}
    n_times = 3  # numbers beside the values of a message: seconds and nanoseconds of its stamp, its arrival
    allowance = request.allowance()
    odd = [file.name for file in path.iterdir() if not (is_regular(file) or file.is_dir())] if path.is_dir() else []
    if odd:
        raise RecordingError(
            f"{path}: expected the files of a bag, found {enumerated(odd)}, which is no file; remove it"
        )
    remedy = "repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`, or record it again"
    with reading(path, "an indexed ROS 1 or ROS 2 bag", remedy):
        for file in sorted(path.glob("*.db3")) if path.is_dir() else [path] if path.suffix.lower() == ".db3" else []:
            _check_tables(file)
        with (Ros1Reader if ros1 else Ros2Reader)(path) as bag:
            topics = _choose(path, [(c.topic, c.msgtype) for c in bag.connections], key)
            connections = [c for c in bag.connections if _is_read(c.topic, c.msgtype, topics, key)]
            passed: set[str] = set()  # vectors of something else
            for connection, arrival, raw in bag.messages(connections):
                topic, kind = connection.topic, connection.msgtype
                if topic in passed:
                    continue
                message: Any = deserialize(raw, kind)
                if topic not in messages:
                    named = _named(topic, message.header.frame_id) if kind == VECTOR else set()
                    if kind == VECTOR and not named:
                        passed.add(topic)
                        continue
                    messages[topic] = Messages(kind, measured=named)
                known = messages[topic]
                if kind != known.kind:
                    raise ValueError(f"messages of two types in {topic}: {kind} and {known.kind}")
                known.append(message, arrival)
                allowance.take(f"messages of {topic}", (known.width + n_times + len(message.header.frame_id) // 8,))

    devices, notes = _devices(messages, topics, key, quantity)
    if not devices:
        there = {q.name for q in QUANTITY.values() for topic in topics & messages.keys() if messages[topic].has(q)}
        raise RecordingError(
            f"{path}: expected {quantity.in_words} in {enumerated(sorted(topics))}, found none (no message, "
            "exactly zero throughout, or marked as not measured); "
            f"{quantity.advice(there, 'choose other topics with `key`')}"
        )
    channels = _owned(messages, devices, quantity)
    return [messages[topic].stream(topic, quantity, channels[topic], notes) for topic in devices]


def _check_tables(path: Path) -> None:
    """Raise `ValueError` where a table of a database is computed when it is read, which may take for ever."""
    with contextlib.closing(sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)) as database:
        for kind, name, command in database.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
            columns = database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)).fetchall()
            virtual = str(command).lower().startswith("create virtual")
            if kind == "view" or virtual or any(hidden for (hidden,) in columns):
                raise ValueError(f"a table {name!r} that is computed, not stored")


def _choose(path: Path, kinds: list[tuple[str, str]], key: str | None) -> set[str]:
    """Return the topics of Imu or vectors that `key` names or begins, all of them without `key`."""
    topics = {topic for topic, kind in kinds if kind in (IMU, VECTOR)}
    if key is not None:
        name = "/" + key.strip("/")
        topics = topics & {name} or {topic for topic in topics if topic.startswith(name)}
    if not topics:
        found = enumerated(f"{topic} ({kind})" for topic, kind in sorted(kinds)) or "no topic"
        wanted = "" if key is None else f" named by `key` {key!r}"
        raise RecordingError(
            f"{path}: expected a topic of type {IMU}{wanted}, found {found}; choose a bag with IMU data"
        )
    return topics


def _is_read(topic: str, kind: str, topics: set[str], key: str | None) -> bool:
    """Whether a topic is a device that was asked for or may be a channel of one."""
    if kind not in VALUES:
        return False
    if key is None or topic in topics or kind in CHANNEL_TYPES:
        return True
    return any(_alike(topic, other) for other in topics)


def _alike(topic: str, other: str) -> int:
    """Number of parts at the beginning of two topics that are equal."""
    pairs = list(zip(topic.strip("/").split("/"), other.strip("/").split("/"), strict=False))
    return next((n for n, (one, two) in enumerate(pairs) if one != two), len(pairs))


def _named(topic: str, frame: str) -> set[Quantity]:
    """The quantity that a vector's topic names, or else its frame; none where neither does."""
    for name in (topic[:LONGEST_NAME], frame[:LONGEST_NAME]):
        for quantity, pattern in _NAMES.items():
            if pattern.search(name):
                return {quantity}
    return set()


def _devices(
    messages: dict[str, Messages], topics: set[str], key: str | None, quantity: Quantity
) -> tuple[list[str], list[str]]:
    """The topics with the quantity among the topics asked for, and notes on the others."""
    notes = []
    there = sorted(topics & messages.keys())
    zero = [topic for topic in there if quantity in messages[topic].measured and not messages[topic].has(quantity)]
    if zero:
        notes.append(f"{quantity.in_words} exactly zero throughout in {enumerated(zero)}: no {quantity.sensor}")
    imus = [topic for topic in there if messages[topic].kind == IMU and messages[topic].has(quantity)]
    vectors = [topic for topic in there if messages[topic].kind == VECTOR and messages[topic].has(quantity)]
    if not imus or (key is not None and "/" + key.strip("/") in vectors):
        return vectors, notes
    if vectors:
        notes.append(
            f"{quantity.name}s in {enumerated(vectors)} are not read beside those of Imu topics; choose them with key="
        )
    return imus, notes


def _owned(
    messages: dict[str, Messages], devices: list[str], quantity: Quantity
) -> dict[str, list[tuple[str, str, str, Messages]]]:
    """For each device the channels of other topics: name, unit, topic and messages."""
    owned: dict[str, list[tuple[str, str, str, Messages]]] = {topic: [] for topic in devices}
    beside = quantity.other
    for topic, other in sorted(messages.items()):
        if topic in owned or (other.kind not in CHANNEL_TYPES and (other.has(quantity) or not other.has(beside))):
            continue
        name, unit = CHANNEL_TYPES.get(other.kind) or (beside.channel, unit_of(topic, other.kind, beside)[0])
        owner = max(devices, key=lambda device: _alike(device, topic))  # the first of several with as many
        owned[owner].append((name, unit, topic, other))
    return owned
