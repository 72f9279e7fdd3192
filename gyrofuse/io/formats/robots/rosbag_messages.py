"""Messages of the topics of a ROS bag, packed, and the device that each topic is."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gyrofuse.io.align import at_samples
from gyrofuse.io.formats.columns import AXES
from gyrofuse.io.limits import enumerated
from gyrofuse.io.quantities import ACCELERATION, RATE, Quantity
from gyrofuse.io.streams import Array, Stream

IMU = "sensor_msgs/msg/Imu"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
# Units of vectors that differ from those of an Imu, by the last part of the topic: multisense_ros converts the values
# of an Imu, not those that it publishes as vectors (imu.cpp).
_VECTOR_UNITS = {"gyroscope_vector": "deg/s", "accelerometer_vector": "g"}
# Values of a message of each type.
VALUES: dict[str, Callable[[Any], tuple[float, ...]]] = {
    IMU: lambda m: (*_xyz(m.angular_velocity), *_xyz(m.linear_acceleration)),
    VECTOR: lambda m: _xyz(m.vector),
    "sensor_msgs/msg/MagneticField": lambda m: _xyz(m.magnetic_field),
    "sensor_msgs/msg/Temperature": lambda m: (m.temperature,),
    "sensor_msgs/msg/FluidPressure": lambda m: (m.fluid_pressure,),
}
# Names and units of the channels, by the definitions of the messages.
CHANNEL_TYPES = {
    "sensor_msgs/msg/MagneticField": ("magnetic_field", "T"),
    "sensor_msgs/msg/Temperature": ("temperature", "degC"),
    "sensor_msgs/msg/FluidPressure": ("pressure", "Pa"),
}


def unit_of(topic: str, kind: str, quantity: Quantity) -> tuple[str, list[str]]:
    """Unit of the rates or accelerations of a topic.

    Args:
        topic: Name of the topic.
        kind: Type of its messages.
        quantity: The quantity.

    Returns:
        The unit, and a note where it is not the SI unit.
    """
    unit = _VECTOR_UNITS.get(topic.rpartition("/")[2]) if kind == VECTOR else None
    if unit is None:
        return quantity.unit, []
    return unit, [f"{topic} is read in {unit}, as multisense_ros publishes it"]


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


@dataclass
class Messages:
    """The messages of one topic, packed: a long bag holds millions."""

    kind: str
    stamp: array[int] = field(default_factory=lambda: array("q"))  # sec, nanosec
    arrival: array[int] = field(default_factory=lambda: array("q"))  # nanoseconds
    values: array[float] = field(default_factory=lambda: array("d"))
    frames: dict[str, None] = field(default_factory=dict)
    width: int = 0  # values of a message
    measured: set[Quantity] = field(default_factory=set)  # quantities of which the values may be

    def append(self, message: Any, arrival: int) -> None:
        """Add one message.

        Args:
            message: The deserialised message.
            arrival: Time of arrival at the recorder, nanoseconds.
        """
        stamp, values = message.header.stamp, VALUES[self.kind](message)
        self.stamp.extend((stamp.sec, stamp.nanosec))
        self.arrival.append(arrival)
        self.values.extend(values)
        self.width = len(values)
        self.frames[message.header.frame_id] = None
        if self.kind == IMU:
            # By the message's definition a covariance that begins with -1 says that the quantity is not measured.
            if message.angular_velocity_covariance[0] != -1:
                self.measured.add(RATE)
            if message.linear_acceleration_covariance[0] != -1:
                self.measured.add(ACCELERATION)

    @property
    def table(self) -> Array:
        """The values `(value, message)` as they were packed, not copied."""
        return np.frombuffer(self.values, np.float64).reshape(-1, self.width).T

    def of(self, quantity: Quantity) -> Array:
        """The rates or accelerations of an Imu or a vector, `(3, message)`, not copied."""
        if self.kind != IMU:
            return self.table
        return self.table[:3] if quantity is RATE else self.table[3:]

    def has(self, quantity: Quantity) -> bool:
        """Whether there are rates or accelerations, and not zeros in their place."""
        return quantity in self.measured and bool(np.any(self.of(quantity) != 0))

    def stream(
        self, topic: str, quantity: Quantity, others: list[tuple[str, str, str, Messages]], remarks: list[str]
    ) -> Stream:
        """The device of this topic.

        Args:
            topic: Name of the topic.
            quantity: The quantity of the signal.
            others: Channels of other topics: name, unit, topic and messages.
            remarks: Notes on the bag.
        """
        time, notes = self._time()
        frames = enumerated(repr(frame) for frame in self.frames if frame)
        channels, units = {}, {}
        unit, guess = unit_of(topic, self.kind, quantity)
        notes += guess
        beside = quantity.other
        if self.has(beside):
            channels[beside.channel], units[beside.channel] = self.of(beside).copy(), beside.unit
        elif beside in self.measured:
            notes.append(f"{beside.in_words} exactly zero throughout: none measured")
        for name, own_unit, source, other in others:
            if name in channels:
                notes.append(f"{name} of {source} is left out beside that of another topic")
                continue
            times, by = self._common_clock(other)
            values = other.table if other.kind in CHANNEL_TYPES else other.of(beside)
            channels[name], note = at_samples(*times, values if len(values) > 1 else values[0], name)
            units[name] = own_unit
            notes += unit_of(source, other.kind, beside)[1]
            notes.append(f"{name} is that of {source}{by}" + (f"; {note}" if note else ""))
        return Stream(
            name=topic,
            signal=dict(zip(AXES, self.of(quantity).copy(), strict=True)),
            unit=unit,
            time=time,
            channels=channels,
            channel_units=units,
            notes=(*([f"frame_id {frames}"] if frames else []), *notes, *remarks),
        )

    def _common_clock(self, other: Messages) -> tuple[tuple[Array, Array], str]:
        """Times of the messages of two topics: of their headers where one clock stamps both, or else of arrival."""
        own, others = self._stamps(), other._stamps()
        overlap = own.max() >= others.min() and others.max() >= own.min()
        if self._is_stamped(own) and self._is_stamped(others) and overlap:
            return (own, others), ""
        return (self._arrivals(), other._arrivals()), ", by arrival at the recorder"

    def _time(self) -> tuple[Array, list[str]]:
        stamp = self._stamps()
        if self._is_stamped(stamp):
            return stamp, []
        return self._arrivals(), ["the header stamps do not advance; time is that of arrival at the recorder"]

    @staticmethod
    def _is_stamped(stamp: Array) -> bool:
        return bool(np.any(stamp != stamp[0]) or (stamp.size == 1 and stamp[0] != 0))

    def _stamps(self) -> Array:
        seconds, nanoseconds = np.array(self.stamp).reshape(-1, 2).T
        return np.asarray(seconds + nanoseconds * 1e-9)

    def _arrivals(self) -> Array:
        whole, rest = np.divmod(np.array(self.arrival), 10**9)
        return np.asarray(whole + rest * 1e-9)
