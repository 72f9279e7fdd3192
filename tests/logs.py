"""Writers of small logs in every format, from made-up arrays of gyros, and their readers with some options.

Every writer takes `gyro (device, 3, time)` in rad/s and, where the format has a clock, `stamps (time,)` in integer
nanoseconds; device `i` is named `imu{i}` where the format can say so.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.formats.request import Request
from gyrofuse.io.quantities import QUANTITY
from gyrofuse.io.streams import Stream

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

MAT73_HEADER = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan  1 00:00:00 2024 HDF5 schema 1.00 ."
IMU = "sensor_msgs/msg/Imu"


def request(path: Path, quantity: str = "rate", **options: Any) -> Request:
    """Return the request for a log, with the quantity by its name."""
    return Request(path, quantity=QUANTITY[quantity], **options)


def read_with(reader: Callable[[Request], list[Stream]], path: Path, **options: Any) -> list[Stream]:
    """Return the streams that a reader finds in a log; options as `request`."""
    return reader(request(path, **options))


def made_up(n_devices: int = 2, n_samples: int = 60, seed: int = 0) -> Array:
    """Return rates `(device, 3, time)` in rad/s."""
    return 0.1 * np.random.default_rng(seed).standard_normal((n_devices, 3, n_samples))


def regular_stamps(n_samples: int = 60, rate: float = 100.0, start: int = 1_700_000_000_123_456_789) -> Stamps:
    """Return nanoseconds `(time,)` of a regular clock that counts since 1970."""
    return start + np.rint(np.arange(n_samples) * (1e9 / rate)).astype(np.int64)


def seconds(stamps: Stamps) -> Array:
    """Return stamps as float64 seconds."""
    return stamps // 10**9 + (stamps % 10**9) * 1e-9


def write_ros1(path: Path, gyro: Array, stamps: Stamps, **options: Any) -> Path:
    """Write a ROS 1 bag with topics `/imu{i}/data`; options as `_write_messages`."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(path) as bag:
        _write_messages(bag, store, store.serialize_ros1, gyro, stamps, {"seq": 0}, **options)
    return path


def write_ros2(path: Path, gyro: Array, stamps: Stamps, *, mcap: bool = False, **options: Any) -> Path:
    """Write a ROS 2 bag directory (sqlite3, or MCAP) with topics `/imu{i}/data`; options as `_write_messages`."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as bag:
        _write_messages(bag, store, store.serialize_cdr, gyro, stamps, {}, **options)
    return path


def _write_messages(
    bag: Any,
    store: Any,
    serialize: Any,
    gyro: Array,
    stamps: Stamps,
    header: dict[str, int],
    *,
    acceleration: Array | None = None,
    stamped: bool = True,
    measured: bool = True,
    msgtype: str = IMU,
) -> None:
    """Write one message per device and sample; not `stamped`: headers of zero; not `measured`: covariance -1."""
    types = store.types
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    absent = np.array([-1.0] + 8 * [0.0])
    connections = [bag.add_connection(f"/imu{device}/data", msgtype, typestore=store) for device in range(len(gyro))]
    for t, stamp in enumerate(stamps.tolist()):
        sec, nanosec = divmod(stamp, 10**9) if stamped else (0, 0)
        for device, connection in enumerate(connections):
            accelerated = np.zeros(3) if acceleration is None else acceleration[device, :, t]
            time = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
            message: Any = types["std_msgs/msg/Header"](stamp=time, frame_id=f"imu{device}_link", **header)
            if msgtype == IMU:
                message = types[IMU](
                    header=message,
                    orientation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
                    orientation_covariance=absent,
                    angular_velocity=vector(*gyro[device, :, t].tolist()),
                    angular_velocity_covariance=np.zeros(9) if measured else absent,
                    linear_acceleration=vector(*accelerated.tolist()),
                    linear_acceleration_covariance=absent if acceleration is None else np.zeros(9),
                )
            bag.write(connection, stamp, serialize(message, msgtype))


def write_topics(
    path: Path, topics: Sequence[tuple[str, str, Stamps, Array]], *, frame: str = "link", clock_offset: int = 0
) -> Path:
    """Write a bag of topics `(name, type, stamps, values (time, number))`: ROS 1 `.bag`, or a ROS 2 `.db3` or `.mcap`.

    An Imu has six values, rates and accelerations; headers are stamped `clock_offset` nanoseconds after arrival.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    serialize: Any = store.serialize_ros1 if ros1 else store.serialize_cdr
    plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    folder = path.with_suffix(".folder")
    bag: Any = rosbag1.Writer(path) if ros1 else rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    types = store.types
    vector, zeros = types["geometry_msgs/msg/Vector3"], np.zeros(9)
    with bag:
        connections = [bag.add_connection(name, kind, typestore=store) for name, kind, _, _ in topics]
        rows = [
            (stamp, n, row)
            for n, (_, _, stamps, values) in enumerate(topics)
            for stamp, row in zip(stamps.tolist(), np.asarray(values, np.float64).tolist(), strict=True)
        ]
        for stamp, n, row in sorted(rows):
            kind = topics[n][1]
            sec, nanosec = divmod(stamp + clock_offset, 10**9)
            header = types["std_msgs/msg/Header"](
                stamp=types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec),
                frame_id=frame,
                **({"seq": 0} if ros1 else {}),
            )
            name = kind.rpartition("/")[2]
            content: dict[str, Any] = {
                "Imu": lambda row: {
                    "orientation": types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=0.0),
                    "orientation_covariance": np.array([-1.0, *zeros[1:]]),
                    "angular_velocity": vector(*row[:3]),
                    "angular_velocity_covariance": zeros,
                    "linear_acceleration": vector(*row[3:]),
                    "linear_acceleration_covariance": zeros,
                },
                "Vector3Stamped": lambda row: {"vector": vector(*row)},
                "MagneticField": lambda row: {"magnetic_field": vector(*row), "magnetic_field_covariance": zeros},
                "Temperature": lambda row: {"temperature": row[0], "variance": 0.0},
                "FluidPressure": lambda row: {"fluid_pressure": row[0], "variance": 0.0},
            }[name](row)
            bag.write(connections[n], stamp, serialize(types[kind](header=header, **content), kind))
    if not ros1:
        next(folder.glob(f"*{path.suffix}")).replace(path)
        shutil.rmtree(folder)
    return path


_FIFO = (
    "uint64_t timestamp_sample;uint32_t device_id;float dt;float scale;uint8_t samples;"
    "int16_t[32] x;int16_t[32] y;int16_t[32] z;"
)


def write_ulog(
    path: Path,
    gyro: Array,
    stamps: Stamps,
    *,
    topic: str = "sensor_gyro",
    temperature: Array | None = None,
    combined: tuple[Array, Stamps] | None = None,
    relative: Sequence[int] | None = None,
    fifo: Sequence[tuple[str, int, int, float, float, Sequence[tuple[int, int, Any]]]] = (),
    dropouts_ms: Sequence[int] = (),
    other_topics: Sequence[str] = (),
) -> Path:
    """Write a PX4 ULog: `gyro` as instances of `topic`, `combined` (axis, time) as sensor_combined.

    Numbers are stored in single precision and stamps in whole microseconds, as PX4 does; timestamp_sample is `stamps`
    and timestamp 400 microseconds later. Accelerations of sensor_combined are -9.75 along z, measured `relative`
    microseconds after its rates. `fifo` are topics `(name, instance, device_id, dt, scale, messages)` with messages
    `(timestamp_sample, samples, counts (axis, 32))`, in microseconds.
    """
    temperature = np.full((len(gyro), gyro.shape[-1]), 25.0) if temperature is None else temperature
    plain = "uint64_t timestamp;"
    formats = {
        topic: plain + "uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;float temperature;",
        "sensor_combined": plain
        + "float[3] gyro_rad;float[3] accelerometer_m_s2;"
        + "int32_t accelerometer_timestamp_relative;",
        **dict.fromkeys(other_topics, plain),
        **dict.fromkeys((topic[0] for topic in fifo), plain + _FIFO),
    }
    log = bytearray(b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 0))
    log += _ulog_message("B", bytes(40))
    for name, fields in formats.items():
        log += _ulog_message("F", f"{name}:{fields}".encode())

    packets = []
    for device, (rates, warmth) in enumerate(zip(gyro, temperature, strict=True)):
        log += _ulog_message("A", struct.pack("<BH", device, device) + topic.encode())
        for stamp, rate, warm in zip((stamps // 1000).tolist(), rates.T.tolist(), warmth.tolist(), strict=True):
            body = struct.pack("<HQQI4f", device, stamp + 400, stamp, 1000 + device, *rate, warm)
            packets.append((stamp, body))
    number = len(gyro)
    if combined is not None:
        log += _ulog_message("A", struct.pack("<BH", 0, number) + b"sensor_combined")
        late = [0] * len(combined[1]) if relative is None else relative
        for stamp, rate, offset in zip((combined[1] // 1000).tolist(), combined[0].T.tolist(), late, strict=True):
            packets.append((stamp, struct.pack("<HQ6fi", number, stamp, *rate, 0.0, 0.0, -9.75, offset)))
        number += 1
    for identity, (name, instance, device, dt, scale, messages) in enumerate(fifo, number):
        log += _ulog_message("A", struct.pack("<BH", instance, identity) + name.encode())
        for stamp, samples, counts in messages:
            body = struct.pack("<HQQI2fB", identity, stamp + 400, stamp, device, dt, scale, samples)
            packets.append((stamp, body + np.asarray(counts, "<i2").tobytes()))
    for identity, name in enumerate(other_topics, number + len(fifo)):
        log += _ulog_message("A", struct.pack("<BH", 0, identity) + name.encode())
        packets.append((0, struct.pack("<HQ", identity, 0)))
    for _, body in sorted(packets):
        log += _ulog_message("D", body)
    for duration in dropouts_ms:
        log += _ulog_message("O", struct.pack("<H", duration))
    path.write_bytes(log)
    return path


def _ulog_message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


# Layouts of messages of ArduPilot logs: number, letters of the types, fields.
DATAFLASH = {
    "IMU": (10, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "GYR": (11, "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ"),
    "ACC": (12, "QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ"),
    "ISBH": (13, "QHBBHHQf", "TimeUS,N,type,instance,mul,smp_cnt,SampleUS,smp_rate"),
    "ISBD": (14, "QHHaaa", "TimeUS,N,seqno,x,y,z"),
    "IMU2": (15, "QffffffIIfBB", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,ErrG,ErrA,Temp,GyHlt,AcHlt"),
    "MSG": (16, "QZ", "TimeUS,Message"),
}
_PACKED = dict(zip("bBhHiIqQfdZa", "b B h H i I q Q f d 64s 64s".split(), strict=True))


def write_dataflash(path: Path, messages: Sequence[tuple[Any, ...]]) -> Path:
    """Write an ArduPilot log, binary or where the name ends in .log text, of messages `(kind, value of each field...)`.

    A field of letter `a` takes 32 whole numbers.
    """
    kinds = {"FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns")}
    kinds |= {name: DATAFLASH[name] for name in dict.fromkeys(message[0] for message in messages)}
    layouts = {name: "<" + "".join(_PACKED.get(c, "") for c in letters) for name, (_, letters, _) in kinds.items()}
    layouts["FMT"] = "<BB4s16s64s"
    log, lines = bytearray(), []
    for name, (number, letters, fields) in kinds.items():
        size = struct.calcsize(layouts[name]) + 3
        packed = struct.pack(layouts["FMT"], number, size, name.encode(), letters.encode(), fields.encode())
        log += b"\xa3\x95\x80" + packed
        lines.append(f"FMT, {number}, {size}, {name}, {letters}, {fields}")
    for name, *values in messages:
        plain = [np.array(v, "<i2").tobytes() if isinstance(v, list) else v for v in values]
        plain = [v.encode() if isinstance(v, str) else v for v in plain]
        log += b"\xa3\x95" + bytes([kinds[name][0]]) + struct.pack(layouts[name], *plain)
        cells = ["[" + " ".join(map(str, v)) + "]" if isinstance(v, list) else f"{v}" for v in values]
        lines.append(", ".join([name, *cells]))
    path.write_bytes("\r\n".join([*lines, ""]).encode() if path.suffix == ".log" else log)
    return path


def batches(
    kinds: Sequence[tuple[int, int]] = ((1, 0), (0, 0), (1, 0)),
    count: int = 64,
    mul: int = 1000,
    rate: float = 2000.0,
    number: int = 0,
) -> list[tuple[Any, ...]]:
    """Return messages of ArduPilot's batch sampler, for `write_dataflash`.

    Batches of (kind, instance), a second apart, the first 5 s after the start: sample `s` of batch `b` is `s + 100 b`
    counts on every axis.
    """
    messages: list[tuple[Any, ...]] = []
    for b, (kind, instance) in enumerate(kinds):
        start = 5_000_000 + 1_000_000 * b
        messages.append(("ISBH", start, (number + b) % 65536, kind, instance, mul, count, start, rate))
        for s in range(-(-count // 32)):
            values = [32 * s + j + 100 * b for j in range(32)]
            messages.append(("ISBD", start + s, (number + b) % 65536, s, values, values, values))
    return messages


def write_parquet(path: Path, columns: dict[str, Any], metadata: dict[str, str] | None = None) -> Path:
    """Write columns and the schema's metadata to a Parquet file."""
    import pyarrow as pa
    from pyarrow import parquet

    parquet.write_table(pa.table(columns).replace_schema_metadata(metadata), path)
    return path


def write_mat5(path: Path, content: dict[str, Any]) -> Path:
    """Write a MATLAB v5 file; a dict inside `content` becomes a struct."""
    from scipy.io import savemat

    savemat(path, content)
    return path


def write_hdf5(path: Path, content: dict[str, Any], **attributes: Any) -> Path:
    """Write an HDF5 file; a dict inside `content` becomes a group, a pair (array, dict) a dataset with attributes."""
    import h5py

    with h5py.File(path, "w") as file:
        _fill_group(file, content)
        file.attrs.update(attributes)
    return path


def write_mat73(path: Path, content: dict[str, Any]) -> Path:
    """Write what MATLAB 7.3 does: HDF5 behind a 512 byte header, dimensions reversed, text as 16 bit codes."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        _fill_group(file, _reversed(content))
    with path.open("r+b") as raw:
        raw.write(MAT73_HEADER.ljust(116, b" ") + bytes(8) + b"\x00\x02IM")
    return path


def _reversed(content: dict[str, Any]) -> dict[str, Any]:
    stored: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            stored[name] = _reversed(value)
        elif isinstance(value, str):
            codes = np.frombuffer(value.encode("utf-16-le"), dtype=np.uint16)[:, None]
            stored[name] = (codes, {"MATLAB_class": np.bytes_(b"char")})
        else:
            stored[name] = (np.atleast_2d(value).T, {"MATLAB_class": np.bytes_(b"double")})
    return stored


def _fill_group(group: Any, content: dict[str, Any]) -> None:
    for name, value in content.items():
        if isinstance(value, dict):
            _fill_group(group.create_group(name), value)
            continue
        values, attributes = value if isinstance(value, tuple) else (value, {})
        group.create_dataset(name, data=values).attrs.update(attributes)
