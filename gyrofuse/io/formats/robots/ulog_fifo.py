"""PX4 messages of many samples: what a sensor gathered since the one before (`SensorGyroFifo`, `SensorAccelFifo`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gyrofuse.io.formats.columns import AXES, CHANNELS
from gyrofuse.io.limits import Allowance
from gyrofuse.io.resample import at_samples
from gyrofuse.io.streams import Array, Stream


@dataclass(frozen=True)
class Sensor:
    """What differs between gyros and accelerometers.

    Attributes:
        word: What one is called.
        topic_of: What a topic of one is called.
        fifo: Topic of all samples.
        topic: Topic of their means.
        combined: Fields of `sensor_combined` along x, y, z.
        unit: Of all of these.
    """

    word: str
    topic_of: str
    fifo: str
    topic: str
    combined: tuple[str, str, str]
    unit: str


SENSORS = {
    "rate": Sensor(
        "gyro",
        "a gyro topic",
        "sensor_gyro_fifo",
        "sensor_gyro",
        ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]"),
        "rad/s",
    ),
    "acceleration": Sensor(
        "accelerometer",
        "an accelerometer topic",
        "sensor_accel_fifo",
        "sensor_accel",
        ("accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]"),
        "m/s^2",
    ),
}
MOST_SAMPLES = 32  # of a message of these
FIFO_FIELDS = {"timestamp", "dt", "scale", "samples", *(f"{a}[{i}]" for a in "xyz" for i in range(MOST_SAMPLES))}
_SLOWEST = 1e6  # microseconds between two of its samples: no sensor waits a second to fill one
# Part of the time that the messages of a fifo have to cover: of one that was logged now and then, little is left.
COVERED = 0.5
# Steps by which a message may come late and still be taken to follow the one before without a gap. Interrupts are
# stamped to some microseconds, a step is 100 of them or more, and a message that is lost takes several samples along.
_LATE = 1.5


def fifo_stream(data: Any, log: Any, sensor: Sensor, allowance: Allowance) -> tuple[Stream | None, float]:
    """An instance of a sensor's fifo sample by sample, if any is sound, and the part of the time that it covers."""
    time, values, covered, notes = _unrolled(data, allowance)
    if time.size < 2:
        return None, 0.0
    channels, units = {}, {}
    own = {device_of(data)} - {None}
    beside = {other.fifo: quantity for quantity, other in SENSORS.items() if other is not sensor}
    for other in log.data_list:
        if other.name in beside and other.multi_id == data.multi_id and other.data.keys() >= FIFO_FIELDS:
            name = CHANNELS[beside[other.name]]
            own_time, own_values, _, said = _unrolled(other, allowance)
            channels[name], note = at_samples(time, own_time, own_values, name)
            units[name] = SENSORS[beside[other.name]].unit
            notes += [*said, *([note] if note else [])]
        if other.name == sensor.topic and "temperature" in other.data and device_of(other) in own:
            own_time, warmth = seconds(other.data), other.data["temperature"].astype(np.float64)
            channels["temperature"], note = at_samples(time, own_time, warmth, "temperature")
            units["temperature"] = "degC"
            notes += [note] if note else []
    device = [f"device_id {device_of(data)}"] if device_of(data) is not None else []
    stream = Stream(
        name=f"{data.name}[{data.multi_id}]",
        signal=dict(zip(AXES, values, strict=True)),
        unit=sensor.unit,
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


def doubt(stream: Stream | None, covered: float, sensor: Sensor) -> str:
    """Why an instance of a fifo is not read."""
    return (
        "no two sound samples"
        if stream is None
        else f"messages that cover {100 * covered:.2g} % of the time, which are read with key={sensor.fifo}"
    )


def seconds(fields: Any) -> Array:
    """When each message was measured, or else when its driver published it; in the log in microseconds."""
    return np.asarray(fields.get("timestamp_sample", fields["timestamp"]) / 1e6, dtype=np.float64)


def device_of(data: Any) -> int | None:
    return int(data.data["device_id"][0]) if "device_id" in data.data else None
