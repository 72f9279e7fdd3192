"""A recording of an array of inertial sensors on a uniform grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.checks import check_positive, check_signal, first_twice
from gyrofuse._base.deprecation import moved_names
from gyrofuse._base.files import Outputs, write_npz
from gyrofuse._base.results import listed, numbered
from gyrofuse._base.units import QUANTITIES, canonical_unit, quantity_of, unit_factor
from gyrofuse.io.quantities import QUANTITY, RATE
from gyrofuse.io.streams import Note

_MOVED = {name: f"gyrofuse.io.reading.{name}" for name in ("read_recording", "check_reading")}
__getattr__ = moved_names(__name__, _MOVED)


@dataclass(frozen=True, eq=False)
class Recording:
    """An array of gyros, or of accelerometers, on a uniform grid of time; NaN is a missing sample.

    One can be made by hand: `Recording(signal, rate=100.0, unit="deg/s")`.

    Attributes:
        signal: `(sensor, time)`, or `(axis, sensor, time)` when every device has the same axes; float32 or float64.
        rate: Sampling rate in Hz.
        unit: Unit of the signal: "deg/s", "rad/s", "m/s^2", "g", "counts", "unknown".
        sensors: Name of each sensor; "1", "2", ... by default.
        time: `(time,)`, seconds from the first slot of the grid; from the rate by default.
        channels: Auxiliary channels on the same grid, time last: `temperature` (time,), `acceleration` (3, time). A
            channel that several devices have carries the device's name: `temperature[imu2]`.
        axes: Names along the leading dimension, `("x", "y", "z")`; empty when the signal is `(sensor, time)`.
        source: Files from which it was read.
        notes: Findings of the reader: gaps, repeats, jitter, offsets, cuts, units.
        quantity: Quantity that the sensors measure, `"rate"` or `"acceleration"`; by default that of the unit, and a
            rate where the unit is of neither.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: A rate that is not positive, names, times and channels that do not fit the signal, names that come
            twice, or times that do not increase.
    """

    signal: Tensor
    rate: float
    unit: str = "unknown"
    sensors: tuple[str, ...] = ()
    time: Tensor = None  # type: ignore[assignment]  # set below
    channels: Mapping[str, Tensor] = field(default_factory=dict)
    axes: tuple[str, ...] = ()
    source: tuple[str, ...] = ()
    notes: tuple[Note, ...] = ()
    quantity: str = ""

    def __post_init__(self) -> None:
        check_signal("signal", self.signal)
        n_sensors, n_samples = self.signal.shape[-2:]
        fill = object.__setattr__
        fill(self, "rate", check_positive("rate", self.rate))
        fill(self, "sensors", tuple(self.sensors) or numbered(n_sensors))
        fill(self, "axes", tuple(self.axes))
        if not isinstance(self.unit, str):
            raise ValueError(f'`unit`: expected a unit such as "deg/s", or "unknown", got {self.unit!r}')
        measured = quantity_of(self.unit)
        fill(self, "quantity", self.quantity or measured or "rate")
        if self.quantity not in QUANTITIES or measured not in (None, self.quantity):
            known = repr(measured) if measured else " or ".join(map(repr, QUANTITIES))
            raise ValueError(
                f"`quantity`: expected {known} for the unit {self.unit!r}, got {self.quantity!r}; correct one of them"
            )
        if len(self.sensors) != n_sensors:
            raise ValueError(
                f"`sensors`: expected {n_sensors} names for shape {tuple(self.signal.shape)}, got {len(self.sensors)}"
            )
        twice = first_twice(self.sensors)
        if twice is not None:
            raise ValueError(f"`sensors`: expected a name of its own for each sensor, got {twice!r} twice")
        if self.axes and self.signal.shape[:-2] != (len(self.axes),):
            raise ValueError(
                f"`axes`: expected one name for each entry of the leading dimension of {tuple(self.signal.shape)}, "
                f"got {self.axes}"
            )
        if self.time is None:
            fill(self, "time", torch.arange(n_samples, dtype=torch.float64) / self.rate)
        else:
            _check_time(self.time, n_samples)
        for name, values in self.channels.items():
            if values.shape[-1:] != (n_samples,):
                raise ValueError(
                    f"`channels`: expected time ({n_samples}) last in {name!r}, got shape {tuple(values.shape)}"
                )

    @property
    def n_samples(self) -> int:
        """Number of slots of the grid, missing samples included."""
        return self.signal.shape[-1]

    @property
    def n_sensors(self) -> int:
        """Number of sensors (of each axis)."""
        return self.signal.shape[-2]

    @property
    def duration(self) -> float:
        """Length in seconds."""
        return self.n_samples / self.rate

    @property
    def missing(self) -> Tensor:
        """Fraction of missing samples of each sensor, `(..., sensor)`."""
        return (~self.signal.isfinite()).double().mean(-1)

    def select(self, *, axis: str | None = None, sensors: Sequence[str | int] | None = None) -> Recording:
        """Keep one axis, some sensors, or both.

        Args:
            axis: One of `axes`.
            sensors: Names, or positions from 0.

        Raises:
            ValueError: No such axis or sensor, or a sensor named twice.
        """
        signal, axes, names = self.signal, self.axes, self.sensors
        if axis is not None:
            if axis not in axes:
                raise ValueError(f"`axis`: expected one of {_named(axes)}, got {axis!r}")
            signal, axes = signal[axes.index(axis)], ()
        if sensors is not None:
            which = [_position(names, sensor) for sensor in sensors]
            if not which:
                raise ValueError(f"`sensors`: expected some of {_named(names)}, got none")
            twice = first_twice(which)
            if twice is not None:
                raise ValueError(f"`sensors`: expected each sensor once, got {names[twice]!r} twice; name it once")
            signal, names = signal[..., which, :], tuple(names[i] for i in which)
        return replace(self, signal=signal, axes=axes, sensors=names)

    def axes_as_sensors(self) -> Recording:
        """The axes of a single device as sensors `(axis, time)` of one array; any other recording as it is.

        Each axis is analysed by itself; their mean is no virtual gyro.
        """
        if not self.axes or self.n_sensors > 1:
            return self
        return replace(self, signal=self.signal[:, 0], sensors=self.axes, axes=())

    def flat(self) -> Recording:
        """Every axis of every device as a sensor `(axis of a device, time)`, named like `imu1 x`, axis by axis."""
        if not self.axes:
            return self
        names = tuple(f"{sensor} {axis}" for axis in self.axes for sensor in self.sensors)
        return replace(self, signal=self.signal.flatten(0, 1), sensors=names, axes=())

    def between(self, start: float, stop: float) -> Recording:
        """Keep the samples from `start` to `stop` seconds after the first sample, with their `time`.

        Args:
            start: Begin in seconds after the first sample.
            stop: End in seconds after the first sample.

        Raises:
            ValueError: Fewer than two samples lie between.
        """
        within = start < stop and start < self.duration and stop > 0
        edges = (max(start, 0.0), min(stop, self.duration)) if within else (0.0, 0.0)
        first, last = (round(edge * self.rate) for edge in edges)
        if last - first < 2:
            raise ValueError(
                f"`start`, `stop`: expected a stretch within 0 to {self.duration:.6g} s, got {start:g} to {stop:g} s"
            )
        return self._cut(slice(first, last))

    def longest_whole(self) -> Recording:
        """Keep the longest run of samples, with their `time`, in which no sensor misses one.

        Sensors without any sample are not considered.

        Raises:
            ValueError: At no time all sensors have a sample.
        """
        known = self.signal.isfinite()
        whole = (known | ~known.any(-1, keepdim=True)).flatten(0, -2).all(0)
        turns = pad(whole.int(), (1, 1)).diff()
        starts, stops = (turns > 0).nonzero()[:, 0], (turns < 0).nonzero()[:, 0]
        if not len(starts):
            raise ValueError(
                f"`signal`: expected a time at which all of {_named(self.sensors)} have a sample, got none; select "
                "fewer sensors"
            )
        longest = int((stops - starts).argmax())
        return self._cut(slice(int(starts[longest]), int(stops[longest])))

    def _cut(self, here: slice) -> Recording:
        return replace(
            self,
            signal=self.signal[..., here],
            time=self.time[here],
            channels={name: values[..., here] for name, values in self.channels.items()},
        )

    def to(self, unit: str) -> Recording:
        """Convert to another unit of the same quantity.

        Args:
            unit: The unit of the result.

        Raises:
            ValueError: Either unit is not a known unit, or they are of different quantities.
        """
        return replace(self, signal=self.signal * unit_factor(self.unit, unit), unit=canonical_unit(unit))

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write an .npz that `read_recording` reads back: `gyro`, `fs`, `unit`, `sensors`, `time` and the channels.

        Accelerations are written as `acceleration`, and read back with `quantity="acceleration"`. A file that cannot be
        written as a whole is not written at all.

        Args:
            path: Name of the file, with the suffix .npz.
            force: Whether a file of that name is replaced.

        Raises:
            ValueError: The name does not end in .npz.
            FileExistsError: The file exists and `force` is not set.
            FileNotFoundError: The folder does not exist.
        """
        path = Path(path)
        if path.suffix.lower() != ".npz":
            raise ValueError(f"`path`: expected a name that ends in .npz, got {path.name!r}")
        main = QUANTITY[self.quantity].array
        taken = {main, RATE.array, "fs", "unit", "sensors", "time", "axes"} & {*self.channels}
        if taken:
            raise ValueError(f"`channels`: the names {', '.join(sorted(taken))} mean something else in a file; rename")
        arrays: dict[str, Any] = {name: values.numpy(force=True) for name, values in self.channels.items()}
        arrays |= {
            main: self.signal.numpy(force=True),
            "fs": np.float64(self.rate),
            "unit": np.str_(self.unit),
            "sensors": np.array(self.sensors),
            "time": self.time.numpy(force=True),
        }
        if self.axes:
            arrays["axes"] = np.array(self.axes)
        with Outputs([path], force=force) as drafts, drafts[path].open("wb") as file:
            write_npz(file, arrays)

    def summary(self) -> str:
        """Size, rate, sensors, channels, missing samples and notes as text."""
        shape = f"{self.n_sensors} sensors" + (f" on axes {', '.join(self.axes)}" if self.axes else "")
        kind = "Recording" if self.quantity == "rate" else "Recording of accelerations"
        lines = [
            f"{kind} of {shape}: {self.n_samples} samples at {self.rate:.6g} Hz ({self.duration:.6g} s), {self.unit}"
        ]
        if self.source:
            lines.append(f"from {', '.join(self.source)}")
        lines.append("sensors: " + ", ".join(self.sensors))
        if self.channels:
            lines.append("channels: " + ", ".join(f"{n} {tuple(v.shape)}" for n, v in self.channels.items()))
        worst = self.missing.max().item()
        lines.append(
            f"missing samples: {100 * worst:.3g} % of the sensor that lacks most" if worst else "missing samples: none"
        )
        return "\n".join([*lines, *(f"- {note}" for note in self.notes)])

    def __str__(self) -> str:
        return self.summary()

    def to_dict(self) -> dict[str, Any]:
        """Properties of the recording without its samples, ready for JSON."""
        mean = self.signal.nanmean(-1)
        return {
            "source": list(self.source),
            "sensors": list(self.sensors),
            "axes": list(self.axes),
            "quantity": self.quantity,
            "unit": self.unit,
            "rate": self.rate,
            "n_samples": self.n_samples,
            "duration": self.duration,
            "missing": listed(self.missing),
            "mean": listed(mean),
            "standard_deviation": listed((self.signal - mean[..., None]).square().nanmean(-1).sqrt()),
            "channels": {name: list(values.shape) for name, values in self.channels.items()},
            "notes": [note.to_dict() for note in self.notes],
        }


def _position(names: Sequence[str], sensor: str | int) -> int:
    if isinstance(sensor, str) and sensor in names:
        return names.index(sensor)
    if not isinstance(sensor, str) and 0 <= sensor < len(names):
        return sensor
    raise ValueError(f"`sensors`: expected some of {_named(names)}, got {sensor!r}")


def _check_time(time: Tensor, n_samples: int) -> None:
    """Times of a grid increase."""
    if time.shape != (n_samples,):
        raise ValueError(f"`time`: expected shape ({n_samples},), got {tuple(time.shape)}")
    later = time.diff() > 0
    if not bool(later.all()):
        at = int((~later).nonzero()[0, 0])
        raise ValueError(
            f"`time`: expected times of a grid, each later than the one before, got {float(time[at + 1]):g} s "
            f"after {float(time[at]):g} s at sample {at + 1}; order the samples by time"
        )


def _named(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names)) or "none (this recording has none)"
