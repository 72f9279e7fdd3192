"""PX4 messages of all samples that a sensor took since the message before (`SensorGyroFifo`, `SensorAccelFifo`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gyrofuse.io.align import at_samples
from gyrofuse.io.formats.columns import AXES
from gyrofuse.io.limits import Allowance
from gyrofuse.io.quantities import ACCELERATION, RATE, Quantity
from gyrofuse.io.streams import Array, Stream


@dataclass(frozen=True)
class Topics:
    """The topics of a quantity.

    Attributes:
        quantity: The quantity.
        fifo: Topic of all samples.
        single: Topic of the means of some samples.
        combined: Fields of `sensor_combined` along x, y, z.
    """

    quantity: Quantity
    fifo: str
    single: str
    combined: tuple[str, str, str]


TOPICS = {
    RATE: Topics(RATE, "sensor_gyro_fifo", "sensor_gyro", ("gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]")),
    ACCELERATION: Topics(
        ACCELERATION,
        "sensor_accel_fifo",
        "sensor_accel",
        ("accelerometer_m_s2[0]", "accelerometer_m_s2[1]", "accelerometer_m_s2[2]"),
    ),
}
MOST_SAMPLES = 32  # samples of a message of a fifo, by its definition in PX4
FIFO_FIELDS = {"timestamp", "dt", "scale", "samples", *(f"{a}[{i}]" for a in AXES for i in range(MOST_SAMPLES))}
# Fraction of the time that the messages of a fifo have to cover: of a fifo that was logged now and then, most is gone,
# and the topic of means is the longer recording.
COVERED = 0.5


def fifo_stream(data: Any, log: Any, topics: Topics, allowance: Allowance) -> tuple[Stream | None, float]:
    """Read an instance of a fifo sample by sample.

    Args:
        data: The instance.
        log: The log, with the other topics of the same sensor.
        topics: Topics of the quantity.
        allowance: Memory that the samples may take.

    Returns:
        The stream, `None` with fewer than two sound samples, and the fraction of the time that its messages cover.
    """
    time, values, covered, notes = _unrolled(data, allowance)
    if time.size < 2:
        return None, 0.0
    channels, units = {}, {}
    own = {device_of(data)} - {None}
    beside, channel = TOPICS[topics.quantity.other], topics.quantity.other.channel
    for other in log.data_list:
        if other.name == beside.fifo and other.multi_id == data.multi_id and other.data.keys() >= FIFO_FIELDS:
            own_time, own_values, _, said = _unrolled(other, allowance)
            channels[channel], note = at_samples(time, own_time, own_values, channel)
            units[channel] = beside.quantity.unit
            notes += [*said, *([note] if note else [])]
        if other.name == topics.single and "temperature" in other.data and device_of(other) in own:
            own_time, degrees = seconds(other.data), other.data["temperature"].astype(np.float64)
            channels["temperature"], note = at_samples(time, own_time, degrees, "temperature")
            units["temperature"] = "degC"
            notes += [note] if note else []
    device = [f"device_id {device_of(data)}"] if device_of(data) is not None else []
    stream = Stream(
        name=f"{data.name}[{data.multi_id}]",
        signal=dict(zip(AXES, values, strict=True)),
        unit=topics.quantity.unit,
        time=time,
        channels=channels,
        channel_units=units,
        notes=(*device, *notes),
    )
    return stream, covered


def _unrolled(data: Any, allowance: Allowance) -> tuple[Array, Array, float, list[str]]:
    """Times in seconds and values `(3, time)` of all samples, the fraction of the time that they cover, and notes."""
    fields = data.data
    slowest = 1e6  # microseconds between two samples: no sensor samples at less than 1 Hz
    # Steps by which a message may come late and still follow the message before without a gap: interrupts are stamped
    # to some microseconds, a step is 100 of them or more, and a message that is lost takes several samples along.
    late = 1.5
    samples, dt = fields["samples"].astype(np.int64), fields["dt"].astype(np.float64)
    scale, stamp = fields["scale"].astype(np.float64), seconds(fields) * 1e6
    with np.errstate(invalid="ignore"):
        sound = (samples >= 1) & (samples <= MOST_SAMPLES) & (dt > 0) & (dt <= slowest)
        sound &= np.isfinite(scale) & (scale != 0)
    lost = int((~sound).sum())
    notes = [
        f"{lost} of {sound.size} messages {data.name} have no or more than {MOST_SAMPLES} samples, or no time between "
        "them, and were left out: damage"
    ] * bool(lost)
    samples, dt, scale, stamp = samples[sound], dt[sound], scale[sound], stamp[sound]
    allowance.take(f"samples of {data.name}", (samples.size, MOST_SAMPLES, 5))
    # A message is stamped when its last sample is taken. Where it follows the message before without a gap, its samples
    # divide the time since then evenly, because a step is never quite `dt`; elsewhere they are `dt` apart.
    since = np.diff(stamp, prepend=np.inf)
    step = np.where((since > 0) & (since <= (samples + late) * dt), since / np.maximum(samples, 1), dt)
    number = np.arange(MOST_SAMPLES)
    inside = number < samples[:, None]
    time = (stamp[:, None] - (samples[:, None] - 1 - number) * step[:, None])[inside] * 1e-6
    counts = (np.stack([fields[f"{axis}[{i}]"][sound] for i in range(MOST_SAMPLES)], axis=1) for axis in AXES)
    values = np.stack([(count * scale[:, None])[inside] for count in counts])
    span = float(stamp[-1] - stamp[0]) if stamp.size else 0.0
    covered = float((samples[1:] * dt[1:]).sum()) / span if span > 0 else 1.0
    return time, values, covered, notes


def doubt(stream: Stream | None, covered: float, topics: Topics) -> str:
    """Reason for which an instance of a fifo is not read.

    Args:
        stream: Stream of the instance, as `fifo_stream` returns it.
        covered: Fraction of the time that its messages cover.
        topics: Topics of the quantity.
    """
    return (
        "no two sound samples"
        if stream is None
        else f"messages that cover {100 * covered:.2g} % of the time, which are read with key={topics.fifo}"
    )


def seconds(fields: Any) -> Array:
    """Time in seconds at which each message was measured, or else at which its driver published it.

    Args:
        fields: Fields of a topic, with times in microseconds.
    """
    return np.asarray(fields.get("timestamp_sample", fields["timestamp"]) / 1e6, dtype=np.float64)


def device_of(data: Any) -> int | None:
    """PX4 `device_id` of a topic instance; None if the message has no such field.

    Args:
        data: Instance of a topic, as `pyulog` reads it.
    """
    return int(data.data["device_id"][0]) if "device_id" in data.data else None
