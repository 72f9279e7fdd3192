"""PX4 ULog files: each instance of `sensor_gyro_fifo` or `sensor_gyro` is a device, or `sensor_combined` is.

A message `sensor_gyro_fifo` holds what a sensor gathered since the one before, up to 32 samples (msg/SensorGyroFifo.msg
of PX4); `sensor_gyro` has their means, `sensor_combined` those of the one gyro that flies.
"""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse.io.limits import Allowance, enumerated
from gyrofuse.io.stream import RecordingError, Stream, cause
from gyrofuse.io.ulog_fifo import COVERED, FIFO, FIFO_FIELDS, MOST_SAMPLES, device_of, doubt, fifo_stream

# Topics with gyro data in rad/s, and their fields along x, y, z.
_AXES = {
    "sensor_gyro": ("x", "y", "z"),
    "sensor_combined": ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"),
}
_ACCELERATION = ("accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]")
_KEY = re.compile(r"(sensor_gyro_fifo|sensor_gyro|sensor_combined)(?:\[(\d{1,3})\])?")
# By default the logger thins `sensor_gyro` to about 1 Hz while `sensor_combined` runs at the full rate:
# a topic this many times slower was logged to look at, not to analyse.
_THINNED = 10.0
# pyulog may go back further than it came, and goes through a damaged stretch a byte at a time, reading up to 64 kB for
# each. It may read this many times the length of the file, or, of a short one, this many bytes, in as many calls as
# this many times its length: a message takes two for at least three bytes, a damaged byte three.
_MOST_READINGS, _FEW_BYTES = 10, 2**26
# Fields of all messages of a log together, nested ones included; PX4 logs have some 10,000.
_MOST_FIELDS = 2**17


def read(path: Path, *, key: str | None = None, quantity: str = "rate", max_bytes: float | None = None) -> list[Stream]:
    """Read the gyros of a PX4 ULog file in rad/s, one stream per instance of the topic.

    `sensor_gyro_fifo` is preferred, which has every sample. Of the others it is `sensor_gyro`, except where
    `sensor_combined` was logged more than ten times as fast. A log that was cut off (power lost in flight) is read up
    to the cut.

    Args:
        path: The file.
        key: `"sensor_gyro_fifo"`, `"sensor_gyro"` or `"sensor_combined"`, or an instance of one, `"sensor_gyro[1]"`;
            `None` chooses.
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
            allowance = Allowance(path, max_bytes)
            allowance.take("messages", (-(-size // 8),))
            log = _bounded(ULog)(_Counted(raw, size))
    except RecordingError:
        raise
    except Exception as error:  # a damaged file may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected a PX4 ULog file, found one that cannot be parsed ({cause(error)}); "
            "download the log from the vehicle again"
        ) from error

    topics = {name: _instances(log, name) for name in (FIFO, *_AXES)}
    asked = _KEY.fullmatch(key) if key is not None else None
    chosen = _named(topics, asked) if asked else []
    if not any(topics.values()) or (key is not None and not chosen):
        names = " or ".join(topics)
        wanted = f"a gyro topic ({names})" + ("" if key is None else f" named by `key`, got {key!r}")
        found = enumerated(sorted({data.name for data in log.data_list})) or "no data"
        raise RecordingError(f"{path}: expected {wanted}, found {found}; choose another topic, or log the gyros")
    notes = _logger_notes(log)
    if key is None or chosen[0].name == FIFO:
        fifos = [fifo_stream(data, log, allowance) for data in (topics[FIFO] if key is None else chosen)]
        sound = [stream for stream, covered in fifos if stream is not None and (key or covered >= COVERED)]
        if sound:
            return [_with_notes(stream, notes + _left_out(topics, sound)) for stream in sound]
        damage = [doubt(stream, covered) for stream, covered in fifos]
        if key is not None or (fifos and not any(topics[name] for name in _AXES)):
            raise RecordingError(
                f"{path}: expected messages {FIFO} of 1 to {MOST_SAMPLES} samples with a time between them, found "
                f"{enumerated(dict.fromkeys(damage))}; choose another topic with `key`, or download the log again"
            )
        notes += [f"{FIFO} has {said}; not read" for said in dict.fromkeys(damage)]
    elif topics[FIFO]:
        notes.append(f"{FIFO} ({len(topics[FIFO])} instances) ignored")
    if key is None:
        slow, fast = (max(map(_rate, topics[name]), default=0.0) for name in _AXES)
        name = "sensor_combined" if fast > _THINNED * slow else "sensor_gyro"
        if name == "sensor_combined" and topics["sensor_gyro"]:
            notes.append(
                f"sensor_gyro ({len(topics['sensor_gyro'])} instances) was logged at {slow:.3g} Hz only; "
                f"sensor_combined at {fast:.4g} Hz is read instead"
            )
        chosen = topics[name]
    return [_stream(data, notes) for data in chosen]


def _named(topics: dict[str, list[Any]], asked: re.Match[str]) -> list[Any]:
    """The instances that `key` names."""
    return [data for data in topics[asked[1]] if asked[2] is None or data.multi_id == int(asked[2])]


def _with_notes(stream: Stream, notes: list[str]) -> Stream:
    return replace(stream, notes=(*stream.notes, *notes))


def _left_out(topics: dict[str, list[Any]], read: list[Stream]) -> list[str]:
    """What is in the log beside the samples of the fifos."""
    notes = []
    for name in _AXES:
        if topics[name]:
            rate = max(map(_rate, topics[name]))
            notes.append(f"{name} ({len(topics[name])} instances, {rate:.4g} Hz) is not read: {FIFO} has every sample")
    own = {note for stream in read for note in stream.notes if note.startswith("device_id")}
    others = [f"device_id {device_of(data)}" for data in topics["sensor_gyro"] if device_of(data) is not None]
    others = [device for device in others if device not in own]
    if others:
        notes.append(f"sensor_gyro has gyros that {FIFO} lacks ({enumerated(others)}); read them with key=sensor_gyro")
    return notes


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
    needed = FIFO_FIELDS if name == FIFO else {"timestamp", *_AXES[name]}
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
    lacking = sum(data.name == FIFO and not data.data.keys() >= FIFO_FIELDS for data in log.data_list)
    if lacking:
        notes.append(f"{FIFO} ({lacking} instances) ignored")
    return notes
