"""What a reader of logs is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gyrofuse.io.limits import Allowance
from gyrofuse.io.quantities import RATE, Quantity


@dataclass(frozen=True)
class Request:
    """A log and the part of it that is to be read.

    Attributes:
        path: The file, or the folder of a ROS 2 bag.
        key: Name of the array, group, column, device or topic to read, where a log holds several; `None` leaves the
            choice to the reader.
        quantity: The quantity whose sensors are read; the other one becomes an auxiliary channel.
        columns: Columns or arrays of the log by the names that they should have, `{"gyro_x": "u3"}`, for logs whose own
            names do not say what they hold; all others are left out.
        max_bytes: Memory in bytes that the numbers of the log may take; by default a quarter of the physical memory.
    """

    path: Path
    key: str | None = None
    quantity: Quantity = RATE
    columns: Mapping[str, str] | None = None
    max_bytes: float | None = None

    def allowance(self) -> Allowance:
        """Memory account of the log, from which nothing has been taken."""
        return Allowance(self.path, self.max_bytes)
