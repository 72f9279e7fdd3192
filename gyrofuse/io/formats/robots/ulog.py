"""PX4 ULog files: each instance of `sensor_gyro_fifo` or `sensor_gyro` is a device, or `sensor_combined` is.

A message `sensor_gyro_fifo` holds what a sensor gathered since the one before, up to 32 samples (msg/SensorGyroFifo.msg
of PX4); `sensor_gyro` has their means, `sensor_combined` those of the one gyro that flies. Accelerometers have the same
topics: `sensor_accel_fifo`, `sensor_accel`, and fields of `sensor_combined`.
"""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse.io.formats.columns import AXES, CHANNELS, or_else
from gyrofuse.io.formats.robots.ulog_fifo import (
    COVERED,
    FIFO_FIELDS,
    MOST_SAMPLES,
    SENSORS,
    Sensor,
    device_of,
    doubt,
    fifo_stream,
)
from gyrofuse.io.limits import Allowance, enumerated
from gyrofuse.io.resample import at_samples
from gyrofuse.io.streams import Array, RecordingError, Stream, cause

_COMBINED = "sensor_combined"
_AXES = ("x", "y", "z")  # fields of a topic of one kind of sensor
_KEY = re.compile(r"([a-z_]{1,32})(?:\[(\d{1,3})\])?")
# Of sensor_combined: microseconds from `timestamp` to when the accelerations were measured, where they are valid.
_RELATIVE, _INVALID = "accelerometer_timestamp_relative", 2**31 - 1
# By default the logger thins topics of one sensor to about 1 Hz while `sensor_combined` runs at the full rate:
# a topic this many times slower was logged to look at, not to analyse.
_THINNED = 10.0
# pyulog may go back further than it came, and goes through a damaged stretch a byte at a time, reading up to 64 kB for
# each. It may read this many times the length of the file, or, of a short one, this many bytes, in as many calls as
# this many times its length: a message takes two for at least three bytes, a damaged byte three.
_MOST_READINGS, _FEW_BYTES = 10, 2**26
# Fields of all messages of a log together, nested ones included; PX4 logs have some 10,000.
_MOST_FIELDS = 2**17


def read(path: Path, *, key: str | None = None, quantity: str = "rate", max_bytes: float | None = None) -> list[Stream]:
    """Read the gyros or accelerometers of a PX4 ULog file in rad/s or m/s^2, one stream per instance of the topic.

    `sensor_gyro_fifo` (`sensor_accel_fifo`) is preferred, which has every sample. Of the others it is `sensor_gyro`
    (`sensor_accel`), except where `sensor_combined` was logged more than ten times as fast. A log that was cut off
    (power lost in flight) is read up to the cut.

    Args:
        path: The file.
        key: One of these topics, or an instance of one, `"sensor_gyro[1]"`; `None` chooses.
        quantity: `"rate"` or `"acceleration"`: the sensors to read.
        max_bytes: Memory that the log may take; by default a quarter of what there is.

    Raises:
        RecordingError: Not a ULog file, damaged, without the quantity asked for, or too large.
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

    sensor = SENSORS[quantity]
    topics = _topics(log, sensor)
    asked = _KEY.fullmatch(key) if key is not None else None
    chosen = _named(topics, asked) if asked else []
    if not any(topics.values()) or (key is not None and not chosen):
        wanted = f"{sensor.topic_of} ({' or '.join(topics)})" + ("" if key is None else f" named by `key`, got {key!r}")
        found = enumerated(sorted({data.name for data in log.data_list})) or "no data"
        others = {kind: _topics(log, other) for kind, other in SENSORS.items() if other is not sensor}
        there = [
            kind for kind, of in others.items() if (_named(of, asked) if asked else key is None and any(of.values()))
        ]
        advice = or_else(there, quantity, f"choose another topic, or log the {sensor.word}s")
        raise RecordingError(f"{path}: expected {wanted}, found {found}; {advice}")
    notes = _logger_notes(log, sensor)
    if key is None or chosen[0].name == sensor.fifo:
        fifos = [fifo_stream(data, log, sensor, allowance) for data in (topics[sensor.fifo] if key is None else chosen)]
        sound = [stream for stream, covered in fifos if stream is not None and (key or covered >= COVERED)]
        if sound:
            return [_with_notes(stream, notes + _left_out(topics, sensor, sound)) for stream in sound]
        damage = [doubt(stream, covered, sensor) for stream, covered in fifos]
        if key is not None or (fifos and not any(topics[name] for name in (sensor.topic, _COMBINED))):
            raise RecordingError(
                f"{path}: expected messages {sensor.fifo} of 1 to {MOST_SAMPLES} samples with a time between them, "
                f"found {enumerated(dict.fromkeys(damage))}; choose another topic with `key`, or download the log again"
            )
        notes += [f"{sensor.fifo} has {said}; not read" for said in dict.fromkeys(damage)]
    elif topics[sensor.fifo]:
        notes.append(f"{sensor.fifo} ({len(topics[sensor.fifo])} instances) ignored")
    if key is None:
        slow, fast = (max(map(_rate, topics[name]), default=0.0) for name in (sensor.topic, _COMBINED))
        name = _COMBINED if fast > _THINNED * slow else sensor.topic
        if name == _COMBINED and topics[sensor.topic]:
            notes.append(
                f"{sensor.topic} ({len(topics[sensor.topic])} instances) was logged at {slow:.3g} Hz only; "
                f"{_COMBINED} at {fast:.4g} Hz is read instead"
            )
        chosen = topics[name]
    return [_stream(data, quantity, notes) for data in chosen]


def _topics(log: Any, sensor: Sensor) -> dict[str, list[Any]]:
    """Instances of each topic of a kind of sensor that hold a time and values on each axis."""
    needed = {
        sensor.fifo: FIFO_FIELDS,
        sensor.topic: {"timestamp", *_AXES},
        _COMBINED: {"timestamp", *sensor.combined},
    }
    return {
        name: [data for data in log.data_list if data.name == name and fields <= data.data.keys()]
        for name, fields in needed.items()
    }


def _named(topics: dict[str, list[Any]], asked: re.Match[str]) -> list[Any]:
    """The instances that `key` names."""
    return [data for data in topics.get(asked[1], []) if asked[2] is None or data.multi_id == int(asked[2])]


def _with_notes(stream: Stream, notes: list[str]) -> Stream:
    return replace(stream, notes=(*stream.notes, *notes))


def _left_out(topics: dict[str, list[Any]], sensor: Sensor, read: list[Stream]) -> list[str]:
    """What is in the log beside the samples of the fifos."""
    notes = []
    for name in (sensor.topic, _COMBINED):
        if topics[name]:
            rate = max(map(_rate, topics[name]))
            notes.append(
                f"{name} ({len(topics[name])} instances, {rate:.4g} Hz) is not read: {sensor.fifo} has every sample"
            )
    own = {note for stream in read for note in stream.notes if note.startswith("device_id")}
    others = [f"device_id {device_of(data)}" for data in topics[sensor.topic] if device_of(data) is not None]
    others = [device for device in others if device not in own]
    if others:
        notes.append(
            f"{sensor.topic} has {sensor.word}s that {sensor.fifo} lacks ({enumerated(others)}); read them with "
            f"key={sensor.topic}"
        )
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


def _stream(data: Any, quantity: str, notes: list[str]) -> Stream:
    """One instance of a topic, with what it holds on the same clock."""
    with np.errstate(invalid="ignore"):  # damaged numbers may be any
        fields = {name: values.astype(np.float64) for name, values in data.data.items()}
    combined = data.name == _COMBINED
    time = _time(fields, combined, quantity)
    channels, units, said = {}, {}, []
    # Magnetometer and barometer in `sensor_combined` repeat the values of slower clocks and are left out.
    for other, sensor in SENSORS.items():
        if combined and other != quantity and fields.keys() >= set(sensor.combined):
            name, values = CHANNELS[other], np.stack([fields[field] for field in sensor.combined])
            channels[name], note = at_samples(time, _time(fields, combined, other), values, name)
            units[name] = sensor.unit
            said += [note] if note else []
    if "temperature" in fields:
        channels["temperature"], units["temperature"] = fields["temperature"], "degC"
    device = [f"device_id {data.data['device_id'][0]}"] if "device_id" in fields else []
    names = SENSORS[quantity].combined if combined else _AXES
    return Stream(
        name=f"{data.name}[{data.multi_id}]",
        signal={axis: fields[name] for axis, name in zip(AXES, names, strict=True)},
        unit=SENSORS[quantity].unit,
        time=time,
        channels=channels,
        channel_units=units,
        notes=(*device, *said, *notes),
    )


def _time(fields: dict[str, Array], combined: bool, quantity: str) -> Array:
    """When the sensor measured, or else when its driver published it, in seconds; NaN where the values are invalid."""
    stamp = fields.get("timestamp_sample", fields["timestamp"])
    if combined and quantity == "acceleration" and _RELATIVE in fields:
        stamp = stamp + np.where(fields[_RELATIVE] == _INVALID, np.nan, fields[_RELATIVE])
    return stamp / 1e6


def _rate(data: Any) -> float:
    """Typical rate in Hz: the inverse of the median step between stamps in microseconds, 0 when unknown."""
    steps = np.diff(data.data["timestamp"].astype(np.int64))
    step = float(np.median(steps)) if steps.size else 0.0
    return 1e6 / step if step > 0 else 0.0


def _logger_notes(log: Any, sensor: Sensor) -> list[str]:
    """What the logger itself reports: dropouts, damage, data in a form that is not read."""
    notes = []
    if log.dropouts:
        total = sum(dropout.duration for dropout in log.dropouts)
        notes.append(f"the logger reports {len(log.dropouts)} dropouts, {total} ms in total")
    if log.file_corruption:
        notes.append("part of the file is damaged and was skipped")
    lacking = sum(data.name == sensor.fifo and not data.data.keys() >= FIFO_FIELDS for data in log.data_list)
    if lacking:
        notes.append(f"{sensor.fifo} ({lacking} instances) ignored")
    return notes
