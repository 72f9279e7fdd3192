"""PX4 ULog files: each instance of `sensor_gyro` is a device, or `sensor_combined` is, where it is faster."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse.io.limits import Allowance, enumerated
from gyrofuse.io.stream import RecordingError, Stream, cause

# Topics with gyro data in rad/s, and their fields along x, y, z.
_AXES = {
    "sensor_gyro": ("x", "y", "z"),
    "sensor_combined": ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"),
}
_ACCELERATION = ("accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]")
# By default the logger thins `sensor_gyro` to about 1 Hz while `sensor_combined` runs at the full rate:
# a topic this many times slower was logged to look at, not to analyse.
_THINNED = 10.0
# pyulog may go back further than it came, and goes through a damaged stretch a byte at a time, reading up to 64 kB for
# each. It may read this many times the length of the file, or, of a short one, this many bytes, in as many calls as
# this many times its length: a message takes two for at least three bytes, a damaged byte three.
_MOST_READINGS, _FEW_BYTES = 10, 2**26
# Fields of all messages of a log together, nested ones included; PX4 logs have some 10,000.
_MOST_FIELDS = 2**17


def read(path: Path, *, key: str | None = None, max_bytes: float | None = None) -> list[Stream]:
    """Read the gyros of a PX4 ULog file in rad/s, one stream per instance of the topic.

    `sensor_gyro` is preferred, except where `sensor_combined` was logged more than ten times as fast. A log
    that was cut off (power lost in flight) is read up to the cut.

    Args:
        path: The file.
        key: `"sensor_gyro"` or `"sensor_combined"`; `None` chooses by rate.
        max_bytes: Memory that the log may take; by default a quarter of what there is.

    Raises:
        RecordingError: Not a ULog file, damaged, without gyro data, or too large.
        ImportError: pyulog is not installed.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise ImportError(f'{path}: reading ULog needs pyulog; pip install "gyrofuse[logs]"') from error
    try:
        # pyulog reports damage with print(); what it found is kept in `file_corruption`
        with path.open("rb", buffering=0) as raw, contextlib.redirect_stdout(io.StringIO()):
            size = path.stat().st_size
            Allowance(path, max_bytes).take("messages", (-(-size // 8),))
            log = _bounded(ULog)(_Counted(raw, size))
    except RecordingError:
        raise
    except Exception as error:  # a damaged file may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected a PX4 ULog file, found one that cannot be parsed ({cause(error)}); "
            "download the log from the vehicle again"
        ) from error

    topics = {name: _instances(log, name) for name in _AXES}
    if not any(topics.values()) or (key is not None and not topics.get(key)):
        wanted = f"a gyro topic ({' or '.join(_AXES)})" + ("" if key is None else f" named by `key`, got {key!r}")
        found = enumerated(sorted({data.name for data in log.data_list})) or "no data"
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


class _Counted(io.BufferedReader):
    """A file of `size` bytes that may be read a number of times and no more."""

    def __init__(self, raw: io.FileIO, size: int) -> None:
        super().__init__(raw)
        self._calls, self._bytes = _MOST_READINGS * size, max(_MOST_READINGS * size, _FEW_BYTES)

    def read(self, size: int | None = -1, /) -> bytes:
        content = super().read(size)
        self._calls, self._bytes = self._calls - 1, self._bytes - len(content)
        if min(self._calls, self._bytes) < 0:
            raise EOFError("the reader goes round in circles: a damaged or zero-filled tail")
        return content


def _bounded(base: Any) -> Any:
    """pyulog's class, for a log whose messages have a number of fields and no more."""
    left = [_MOST_FIELDS]

    class Fields(base._MessageAddLogged):
        def _parse_nested_type(self, prefix: str, name: str, formats: Any) -> None:
            left[0] -= sum(max(count, 1) for _, count, _ in formats[name].fields) + 1
            if left[0] < 0:
                raise EOFError(f"more than {_MOST_FIELDS} fields in its messages")
            super()._parse_nested_type(prefix, name, formats)

    return type("Bounded", (base,), {"_MessageAddLogged": Fields})


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
