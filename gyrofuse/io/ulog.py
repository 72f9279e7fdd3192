"""PX4 ULog files: each instance of `sensor_gyro` is a device, or `sensor_combined` is, where it is faster."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse.io.stream import RecordingError, Stream

# Topics with gyro data in rad/s, and their fields along x, y, z.
_AXES = {
    "sensor_gyro": ("x", "y", "z"),
    "sensor_combined": ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"),
}
_ACCELERATION = ("accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]")
# By default the logger thins `sensor_gyro` to about 1 Hz while `sensor_combined` runs at the full rate:
# a topic this many times slower was logged to look at, not to analyse.
_THINNED = 10.0


def read(path: Path, *, key: str | None = None) -> list[Stream]:
    """Read the gyros of a PX4 ULog file in rad/s, one stream per instance of the topic.

    `sensor_gyro` is preferred, except where `sensor_combined` was logged more than ten times as fast. A log
    that was cut off (power lost in flight) is read up to the cut.

    Args:
        path: The file.
        key: `"sensor_gyro"` or `"sensor_combined"`; `None` chooses by rate.

    Raises:
        RecordingError: Not a ULog file, damaged, or without gyro data.
        ImportError: pyulog is not installed.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise ImportError(f'{path}: reading ULog needs pyulog; pip install "gyrofuse[logs]"') from error
    try:
        # pyulog reports damage with print(); what it found is kept in `file_corruption`
        with path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):
            log = ULog(file)
    except Exception as error:  # a damaged file may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected a PX4 ULog file, found one that cannot be parsed ({error}); "
            "download the log from the vehicle again"
        ) from error

    topics = {name: _instances(log, name) for name in _AXES}
    if not any(topics.values()) or (key is not None and not topics.get(key)):
        wanted = f"a gyro topic ({' or '.join(_AXES)})" + ("" if key is None else f" named by `key`, got {key!r}")
        found = ", ".join(sorted({data.name for data in log.data_list})) or "no data"
        raise RecordingError(f"{path}: expected {wanted}, found {found}; choose another topic, or log the gyros")
    notes = _logger_notes(log)
    if key is None:
        slow, fast = (max(map(_rate, topics[name]), default=0.0) for name in _AXES)
        key = "sensor_combined" if fast > _THINNED * slow else "sensor_gyro"
        if key == "sensor_combined" and topics["sensor_gyro"]:
            notes.append(
                f"sensor_gyro ({len(topics['sensor_gyro'])} instances) was logged at {slow:.3g} Hz only; "
                f"sensor_combined at {fast:.4g} Hz is read instead"
            )
    return [_stream(data, notes) for data in topics[key]]


def _instances(log: Any, name: str) -> list[Any]:
    """Instances of one topic that hold a time and a rate on each axis."""
    needed = {"timestamp", *_AXES[name]}
    return [data for data in log.data_list if data.name == name and needed <= data.data.keys()]


def _stream(data: Any, notes: list[str]) -> Stream:
    """One instance of a topic, with what it holds on the same clock."""
    fields = {name: values.astype(np.float64) for name, values in data.data.items()}
    channels, units = {}, {}
    # Magnetometer and barometer in `sensor_combined` repeat the values of slower clocks and are left out.
    if fields.keys() >= set(_ACCELERATION):
        channels["acceleration"], units["acceleration"] = (
            np.stack([fields[a] for a in _ACCELERATION]),
            "m/s^2",
        )
    if "temperature" in fields:
        channels["temperature"], units["temperature"] = fields["temperature"], "degC"
    device = [f"device_id {data.data['device_id'][0]}"] if "device_id" in fields else []
    return Stream(
        name=f"{data.name}[{data.multi_id}]",
        gyro={axis: fields[name] for axis, name in zip("xyz", _AXES[data.name], strict=True)},
        unit="rad/s",
        # timestamp_sample is when the sensor measured, timestamp when its driver published; microseconds
        time=fields.get("timestamp_sample", fields["timestamp"]) / 1e6,
        channels=channels,
        channel_units=units,
        notes=(*device, *notes),
    )


def _rate(data: Any) -> float:
    """Typical rate in Hz: the inverse of the median step between stamps in microseconds, 0 when unknown."""
    steps = np.diff(data.data["timestamp"].astype(np.int64))
    step = float(np.median(steps)) if steps.size else 0.0
    return 1e6 / step if step > 0 else 0.0


def _logger_notes(log: Any) -> list[str]:
    """What the logger itself reports: dropouts, damage, gyro data in a form that is not read."""
    notes = []
    if log.dropouts:
        total = sum(dropout.duration for dropout in log.dropouts)
        notes.append(f"the logger reports {len(log.dropouts)} dropouts, {total} ms in total")
    if log.file_corruption:
        notes.append("part of the file is damaged and was skipped")
    if fifo := sum(data.name == "sensor_gyro_fifo" for data in log.data_list):
        notes.append(f"sensor_gyro_fifo ({fifo} instances) ignored")
    return notes
