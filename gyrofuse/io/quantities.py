"""The two quantities that inertial sensors measure, and what each is called in logs and in messages."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """Angular rate or acceleration, with its names in logs and in messages.

    Attributes:
        name: `"rate"` or `"acceleration"`, as arguments and the kinds of columns have it.
        array: Name of an array of it in an .npz recording.
        channel: Name of an auxiliary channel of it.
        sensor: The instrument that measures it.
        a_sensor: The instrument with its article.
        named: The instrument with examples of the names of its columns, for messages.
        unit: SI unit, in which robots log it.
        in_words: Its name in the definition of sensor_msgs/Imu, plural.
        instead: Advice for a log that holds this quantity and not the requested one.
    """

    name: str
    array: str
    channel: str
    sensor: str
    a_sensor: str
    named: str
    unit: str
    in_words: str
    instead: str

    @property
    def other(self) -> Quantity:
        """The quantity that is an auxiliary channel where this one is the signal."""
        return ACCELERATION if self is RATE else RATE

    def advice(self, kinds: Collection[str], otherwise: str) -> str:
        """Remedy for a log in which this quantity was not found.

        Args:
            kinds: Kinds of the columns of the log.
            otherwise: Advice where the log does not hold the other quantity either.
        """
        return self.other.instead if self.other.name in kinds and self.name not in kinds else otherwise


RATE = Quantity(
    name="rate",
    array="gyro",
    channel="angular_rate",
    sensor="gyro",
    a_sensor="a gyro",
    named="a gyro (gyro_x, gx)",
    unit="rad/s",
    in_words="angular velocities",
    instead='it has gyros, which are read with quantity="rate" (--quantity rate)',
)
ACCELERATION = Quantity(
    name="acceleration",
    array="acceleration",
    channel="acceleration",
    sensor="accelerometer",
    a_sensor="an accelerometer",
    named="an accelerometer (acc_x, ax)",
    unit="m/s^2",
    in_words="linear accelerations",
    instead='it has accelerations, which are read with quantity="acceleration" (--quantity acceleration)',
)
QUANTITY = {quantity.name: quantity for quantity in (RATE, ACCELERATION)}
