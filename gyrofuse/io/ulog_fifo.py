"""PX4 messages of many samples: what a sensor gathered since the message before (msg/SensorGyroFifo.msg of PX4)."""

from __future__ import annotations

from typing import Any

import numpy as np

from gyrofuse.io.limits import Allowance
from gyrofuse.io.resample import at_samples
from gyrofuse.io.stream import Array, Stream

FIFO, _ACCELERATION_FIFO = "sensor_gyro_fifo", "sensor_accel_fifo"
MOST_SAMPLES = 32  # of a message of these
FIFO_FIELDS = {"timestamp", "dt", "scale", "samples", *(f"{a}[{i}]" for a in "xyz" for i in range(MOST_SAMPLES))}
_SLOWEST = 1e6  # microseconds between two of its samples: no sensor waits a second to fill one
# Part of the time that the messages of a fifo have to cover: of one that was logged now and then, little is left.
COVERED = 0.5
# Steps by which a message may come late and still be taken to follow the one before without a gap. Interrupts are
# stamped to some microseconds, a step is 100 of them or more, and a message that is lost takes several samples along.
_LATE = 1.5


def fifo_stream(data: Any, log: Any, allowance: Allowance) -> tuple[Stream | None, float]:
    """An instance of `sensor_gyro_fifo` sample by sample, if any is sound, and the part of the time that it covers."""
    time, rates, covered, notes = _unrolled(data, allowance)
    if time.size < 2:
        return None, 0.0
    channels, units = {}, {}
    own = {device_of(data)} - {None}
    for other in log.data_list:
        if other.name == _ACCELERATION_FIFO and other.multi_id == data.multi_id and other.data.keys() >= FIFO_FIELDS:
            own_time, values, _, said = _unrolled(other, allowance)
            channels["acceleration"], note = at_samples(time, own_time, values, "acceleration")
            units["acceleration"] = "m/s^2"
            notes += [*said, *([note] if note else [])]
        if other.name == "sensor_gyro" and "temperature" in other.data and device_of(other) in own:
            own_time, values = seconds(other.data), other.data["temperature"].astype(np.float64)
            channels["temperature"], note = at_samples(time, own_time, values, "temperature")
            units["temperature"] = "degC"
            notes += [note] if note else []
    device = [f"device_id {device_of(data)}"] if device_of(data) is not None else []
    stream = Stream(
        name=f"{data.name}[{data.multi_id}]",
        gyro=dict(zip("xyz", rates, strict=True)),
        unit="rad/s",
        time=time,
        channels=channels,
        channel_units=units,
        notes=(*device, *notes),
    )
    return stream, covered


def _unrolled(data: Any, allowance: Allowance) -> tuple[Array, Array, float, list[str]]:
    """Times in seconds and values `(3, time)` of all samples, the part of the time that they cover, and what is odd."""
    fields = data.data
    samples, dt = fields["samples"].astype(np.int64), fields["dt"].astype(np.float64)
    scale, stamp = fields["scale"].astype(np.float64), seconds(fields) * 1e6
    with np.errstate(invalid="ignore"):
        sound = (samples >= 1) & (samples <= MOST_SAMPLES) & (dt > 0) & (dt <= _SLOWEST)
        sound &= np.isfinite(scale) & (scale != 0)
    lost = int((~sound).sum())
    notes = [
        f"{lost} of {sound.size} messages {data.name} have no or more than {MOST_SAMPLES} samples, or no time between "
        "them, and were left out: damage"
    ] * bool(lost)
    samples, dt, scale, stamp = samples[sound], dt[sound], scale[sound], stamp[sound]
    allowance.take(f"samples of {data.name}", (samples.size, MOST_SAMPLES, 5))
    # A message is stamped when its last sample is taken. The times of the others divide the time since the message
    # before evenly where it follows without a gap, because a step is never quite what `dt` says; else they are `dt`
    # apart.
    since = np.diff(stamp, prepend=np.inf)
    step = np.where((since > 0) & (since <= (samples + _LATE) * dt), since / np.maximum(samples, 1), dt)
    number = np.arange(MOST_SAMPLES)
    inside = number < samples[:, None]
    time = (stamp[:, None] - (samples[:, None] - 1 - number) * step[:, None])[inside] * 1e-6
    counts = (np.stack([fields[f"{axis}[{i}]"][sound] for i in range(MOST_SAMPLES)], axis=1) for axis in "xyz")
    values = np.stack([(count * scale[:, None])[inside] for count in counts])
    span = float(stamp[-1] - stamp[0]) if stamp.size else 0.0
    covered = float((samples[1:] * dt[1:]).sum()) / span if span > 0 else 1.0
    return time, values, covered, notes


def doubt(stream: Stream | None, covered: float) -> str:
    """Why an instance of a fifo is not read."""
    return (
        "no two sound samples"
        if stream is None
        else f"messages that cover {100 * covered:.2g} % of the time, which are read with key={FIFO}"
    )


def seconds(fields: Any) -> Array:
    """When each message was measured, or else when its driver published it; in the log in microseconds."""
    return np.asarray(fields.get("timestamp_sample", fields["timestamp"]) / 1e6, dtype=np.float64)


def device_of(data: Any) -> int | None:
    return int(data.data["device_id"][0]) if "device_id" in data.data else None
