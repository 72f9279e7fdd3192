"""PX4 ULog files: each instance of `sensor_gyro_fifo` or `sensor_gyro` is a device, or `sensor_combined` is.

A message `sensor_gyro_fifo` holds up to 32 samples, all that a sensor took since the message before
(msg/SensorGyroFifo.msg of PX4); `sensor_gyro` holds means of samples, `sensor_combined` means of the gyro that the
autopilot uses. Accelerometers have the same topics: `sensor_accel_fifo`, `sensor_accel`, and fields of
`sensor_combined`.
"""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import replace
from typing import Any

import numpy as np

from gyrofuse.io.align import at_samples
from gyrofuse.io.formats.columns import AXES
from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.robots.ulog_fifo import (
    COVERED,
    FIFO_FIELDS,
    MOST_SAMPLES,
    TOPICS,
    Topics,
    device_of,
    doubt,
    fifo_stream,
)
from gyrofuse.io.limits import enumerated
from gyrofuse.io.quantities import ACCELERATION, Quantity
from gyrofuse.io.streams import Array, RecordingError, Stream, needed, reading

_COMBINED = "sensor_combined"
_KEY = re.compile(r"([a-z_]{1,32})(?:\[(\d{1,3})\])?")
# Field of `sensor_combined`: microseconds from `timestamp` to the measurement of the accelerations, or an invalid time.
_RELATIVE, _INVALID = "accelerometer_timestamp_relative", np.iinfo(np.int32).max
# Ratio of the rate of `sensor_combined` to the rate of `sensor_gyro` above which `sensor_combined` is read. By default
# the logger thins topics of one sensor to about 1 Hz, for inspection, while `sensor_combined` runs at the full rate.
_THINNED = 10.0
# Bytes and calls that pyulog may spend on a log, in lengths of the file: pyulog may go back further than it came, and
# goes through a damaged part byte by byte. A sound message takes two calls for at least three bytes, a damaged byte
# three calls.
_MOST_READINGS = 10
# Bytes that pyulog may read of a short log: for each damaged byte it reads up to 64 kB.
_FEW_BYTES = 64 * 1024**2
# Fields of all messages of a log together, nested ones included; PX4 logs have some 10,000.
_MOST_FIELDS = 131_072


def read(request: Request) -> list[Stream]:
    """Read the gyros or accelerometers of a PX4 ULog file in rad/s or m/s^2, one stream per instance of the topic.

    `sensor_gyro_fifo` (`sensor_accel_fifo`) is preferred, which has every sample. Of the others it is `sensor_gyro`
    (`sensor_accel`), except where `sensor_combined` was logged more than ten times as fast. A log that was cut off
    (power lost in flight) is read up to the cut.

    Args:
        request: The file and the part of it to read. Its `key` is one of these topics, or an instance of one,
            `"sensor_gyro[1]"`; `None` chooses.

    Raises:
        RecordingError: Not a ULog file, damaged, without the quantity asked for, or too large.
        ImportError: pyulog is not installed.
    """
    path, key = request.path, request.key
    with needed(path, "ULog", "pyulog"):
        from pyulog import ULog
    with (
        reading(path, "a PX4 ULog file", "download the log from the vehicle again"),
        path.open("rb", buffering=0) as raw,
        contextlib.redirect_stdout(io.StringIO()),  # pyulog prints damage, which is in `file_corruption` as well
    ):
        size = path.stat().st_size
        allowance = request.allowance()
        allowance.take("messages", (-(-size // 8),))
        log = _bounded(ULog)(_Counted(raw, size))

    topics = TOPICS[request.quantity]
    instances = _instances(log, topics)
    asked = _KEY.fullmatch(key) if key is not None else None
    chosen = _named(instances, asked) if asked else []
    if not any(instances.values()) or (key is not None and not chosen):
        raise _without(request, log, asked)
    notes = _logger_notes(log, topics)
    if key is None or chosen[0].name == topics.fifo:
        wanted = instances[topics.fifo] if key is None else chosen
        fifos = [fifo_stream(data, log, topics, allowance) for data in wanted]
        sound = [stream for stream, covered in fifos if stream is not None and (key or covered >= COVERED)]
        if sound:
            left_out = _left_out(instances, topics, sound)
            return [replace(stream, notes=(*stream.notes, *notes, *left_out)) for stream in sound]
        damage = [doubt(stream, covered, topics) for stream, covered in fifos]
        if key is not None or (fifos and not any(instances[name] for name in (topics.single, _COMBINED))):
            raise RecordingError(
                f"{path}: expected messages {topics.fifo} of 1 to {MOST_SAMPLES} samples with a time between them, "
                f"found {enumerated(dict.fromkeys(damage))}; choose another topic with `key`, or download the log again"
            )
        notes += [f"{topics.fifo} has {said}; not read" for said in dict.fromkeys(damage)]
    elif instances[topics.fifo]:
        notes.append(f"{topics.fifo} ({len(instances[topics.fifo])} instances) ignored")
    if key is None:
        slow, fast = (max(map(_rate, instances[name]), default=0.0) for name in (topics.single, _COMBINED))
        name = _COMBINED if fast > _THINNED * slow else topics.single
        if name == _COMBINED and instances[topics.single]:
            notes.append(
                f"{topics.single} ({len(instances[topics.single])} instances) was logged at {slow:.3g} Hz only; "
                f"{_COMBINED} at {fast:.4g} Hz is read instead"
            )
        chosen = instances[name]
    return [_stream(data, topics, notes) for data in chosen]


def _without(request: Request, log: Any, asked: re.Match[str] | None) -> RecordingError:
    """The error of a log without the topic asked for."""
    quantity, key = request.quantity, request.key
    wanted = f"{quantity.a_sensor} topic ({' or '.join(_instances(log, TOPICS[quantity]))})"
    wanted += "" if key is None else f" named by `key`, got {key!r}"
    found = enumerated(sorted({data.name for data in log.data_list})) or "no data"
    others = _instances(log, TOPICS[quantity.other])
    has_other = _named(others, asked) if asked else key is None and any(others.values())
    advice = quantity.advice(
        {quantity.other.name} if has_other else (), f"choose another topic, or log the {quantity.sensor}s"
    )
    return RecordingError(f"{request.path}: expected {wanted}, found {found}; {advice}")


def _instances(log: Any, topics: Topics) -> dict[str, list[Any]]:
    """Instances of each topic of a quantity that hold a time and values on each axis."""
    needed = {
        topics.fifo: FIFO_FIELDS,
        topics.single: {"timestamp", *AXES},
        _COMBINED: {"timestamp", *topics.combined},
    }
    return {
        name: [data for data in log.data_list if data.name == name and fields <= data.data.keys()]
        for name, fields in needed.items()
    }


def _named(instances: dict[str, list[Any]], asked: re.Match[str]) -> list[Any]:
    """The instances that `key` names."""
    return [data for data in instances.get(asked[1], []) if asked[2] is None or data.multi_id == int(asked[2])]


def _left_out(instances: dict[str, list[Any]], topics: Topics, read: list[Stream]) -> list[str]:
    """Notes on topics of the log that are not read beside the fifos."""
    notes = []
    for name in (topics.single, _COMBINED):
        if instances[name]:
            rate = max(map(_rate, instances[name]))
            notes.append(
                f"{name} ({len(instances[name])} instances, {rate:.4g} Hz) is not read: {topics.fifo} has every sample"
            )
    own = {note for stream in read for note in stream.notes if note.startswith("device_id")}
    devices = [f"device_id {device_of(data)}" for data in instances[topics.single] if device_of(data) is not None]
    others = [device for device in devices if device not in own]
    if others:
        notes.append(
            f"{topics.single} has {topics.quantity.sensor}s that {topics.fifo} lacks ({enumerated(others)}); read them "
            f"with key={topics.single}"
        )
    return notes


class _Counted(io.BufferedReader):
    """A file of `size` bytes with a limit on the number of calls and bytes that are read."""

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
    """pyulog's class with a limit on the number of fields of all messages."""
    left = [_MOST_FIELDS]

    class Fields(base._MessageAddLogged):
        def _parse_nested_type(self, prefix: str, name: str, formats: Any) -> None:
            left[0] -= sum(max(count, 1) for _, count, _ in formats[name].fields) + 1
            if left[0] < 0:
                raise EOFError(f"more than {_MOST_FIELDS} fields in its messages")
            super()._parse_nested_type(prefix, name, formats)

    return type("Bounded", (base,), {"_MessageAddLogged": Fields})


def _stream(data: Any, topics: Topics, notes: list[str]) -> Stream:
    """One instance of a topic, with the other values that it holds as channels."""
    quantity, beside = topics.quantity, TOPICS[topics.quantity.other]
    with np.errstate(invalid="ignore"):  # damaged numbers may be any
        fields = {name: values.astype(np.float64) for name, values in data.data.items()}
    combined = data.name == _COMBINED
    time = _time(fields, combined, quantity)
    channels, units, said = {}, {}, []
    # Magnetometer and barometer in `sensor_combined` repeat the values of slower clocks and are left out.
    if combined and fields.keys() >= set(beside.combined):
        name, values = beside.quantity.channel, np.stack([fields[field] for field in beside.combined])
        channels[name], note = at_samples(time, _time(fields, combined, beside.quantity), values, name)
        units[name] = beside.quantity.unit
        said += [note] if note else []
    if "temperature" in fields:
        channels["temperature"], units["temperature"] = fields["temperature"], "degC"
    device = [f"device_id {data.data['device_id'][0]}"] if "device_id" in fields else []
    names = topics.combined if combined else AXES
    return Stream(
        name=f"{data.name}[{data.multi_id}]",
        signal={axis: fields[name] for axis, name in zip(AXES, names, strict=True)},
        unit=quantity.unit,
        time=time,
        channels=channels,
        channel_units=units,
        notes=(*device, *said, *notes),
    )


def _time(fields: dict[str, Array], combined: bool, quantity: Quantity) -> Array:
    """Time in seconds of measurement, or else of publication by the driver; NaN where the values are invalid."""
    stamp = fields.get("timestamp_sample", fields["timestamp"])
    if combined and quantity is ACCELERATION and _RELATIVE in fields:
        stamp = stamp + np.where(fields[_RELATIVE] == _INVALID, np.nan, fields[_RELATIVE])
    return stamp / 1e6


def _rate(data: Any) -> float:
    """Typical rate in Hz: the inverse of the median step between stamps in microseconds, 0 when unknown."""
    steps = np.diff(data.data["timestamp"].astype(np.int64))
    step = float(np.median(steps)) if steps.size else 0.0
    return 1e6 / step if step > 0 else 0.0


def _logger_notes(log: Any, topics: Topics) -> list[str]:
    """Notes on dropouts that the logger reports, on damage, and on fifos of another form."""
    notes = []
    if log.dropouts:
        total = sum(dropout.duration for dropout in log.dropouts)
        notes.append(f"the logger reports {len(log.dropouts)} dropouts, {total} ms in total")
    if log.file_corruption:
        notes.append("part of the file is damaged and was skipped")
    lacking = sum(data.name == topics.fifo and not data.data.keys() >= FIFO_FIELDS for data in log.data_list)
    if lacking:
        notes.append(f"{topics.fifo} ({lacking} instances) ignored")
    return notes
