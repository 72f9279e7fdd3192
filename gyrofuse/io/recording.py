"""A recording of a gyro array on a uniform grid, and how log files become one."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.checks import check_positive, check_signal
from gyrofuse._base.files import Outputs, write_npz
from gyrofuse._base.results import listed, numbered
from gyrofuse._base.units import QUANTITIES, canonical_unit, check_quantity, quantity_of, unit_factor
from gyrofuse.io.assemble import assemble
from gyrofuse.io.formats.columns import WORD_OF, check_columns
from gyrofuse.io.limits import is_rate
from gyrofuse.io.notes import Note


@dataclass(frozen=True, eq=False)
class Recording:
    """An array of gyros, or of accelerometers, on a uniform grid of time; NaN is a missing sample.

    Easy to make by hand: `Recording(signal, rate=100.0, unit="deg/s")`.

    Attributes:
        signal: `(sensor, time)`, or `(axis, sensor, time)` when every device has the same axes; float32 or float64.
        rate: Sampling rate in Hz.
        unit: Unit of the signal: "deg/s", "rad/s", "m/s^2", "g", "counts", "unknown".
        sensors: Name of each sensor; "1", "2", ... by default.
        time: `(time,)`, seconds from the first slot of the grid; from the rate by default.
        channels: Auxiliary channels on the same grid, time last: `temperature` (time,), `acceleration` (3, time). A
            channel that several devices have carries the device's name: `temperature[imu2]`.
        axes: Names along the leading dimension, `("x", "y", "z")`; empty when the signal is `(sensor, time)`.
        source: Files it was read from.
        notes: What was found on reading: gaps, repeats, jitter, offsets, cuts, units.
        quantity: `"rate"` or `"acceleration"`; by default what the unit says, and rate where it says nothing.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: A rate that is not positive, or names and channels that do not fit the signal.
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
        if self.axes and self.signal.shape[:-2] != (len(self.axes),):
            raise ValueError(
                f"`axes`: expected one name for each entry of the leading dimension of {tuple(self.signal.shape)}, "
                f"got {self.axes}"
            )
        if self.time is None:
            fill(self, "time", torch.arange(n_samples, dtype=torch.float64) / self.rate)
        if self.time.shape != (n_samples,):
            raise ValueError(f"`time`: expected shape ({n_samples},), got {tuple(self.time.shape)}")
        for name, values in self.channels.items():
            if values.shape[-1:] != (n_samples,):
                raise ValueError(
                    f"`channels`: expected time ({n_samples}) last in {name!r}, got shape {tuple(values.shape)}"
                )

    @property
    def n_samples(self) -> int:
        """Slots of the grid, missing ones included."""
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
        """Fraction of samples that each sensor lacks, `(..., sensor)`."""
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
            twice = next((names[i] for k, i in enumerate(which) if i in which[:k]), None)
            if twice is not None:
                raise ValueError(f"`sensors`: expected each sensor once, got {twice!r} twice; name it once")
            signal, names = signal[..., which, :], tuple(names[i] for i in which)
        return replace(self, signal=signal, axes=axes, sensors=names)

    def axes_as_sensors(self) -> Recording:
        """The axes of a single device as sensors `(axis, time)` of one array; any other recording as it is.

        Each axis is judged by itself then; no virtual gyro can be made of them.
        """
        if not self.axes or self.n_sensors > 1:
            return self
        return replace(self, signal=self.signal[:, 0], sensors=self.axes, axes=())

    def between(self, start: float, stop: float) -> Recording:
        """Keep the stretch from `start` to `stop` seconds after the first sample: the part at rest, say.

        `time` goes on counting from where it did before.

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
        """Keep the longest stretch in which no sensor misses a sample; sensors without any are passed over.

        `time` goes on counting from where it did before.

        Raises:
            ValueError: There is no time at which all of them have a sample.
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
        """Convert to another unit of rate, or of acceleration.

        Raises:
            ValueError: Either unit is not a known unit, or they are of different quantities.
        """
        return replace(self, signal=self.signal * unit_factor(self.unit, unit), unit=canonical_unit(unit))

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write an .npz that `read_recording` reads back: `gyro`, `fs`, `unit`, `sensors`, `time` and the channels.

        Accelerations are written as `acceleration`, and read back with `quantity="acceleration"`. The file appears
        whole or not at all.

        Raises:
            ValueError: The name does not end in .npz.
            FileExistsError: The file exists and `force` is not set.
            FileNotFoundError: The folder does not exist.
        """
        path = Path(path)
        if path.suffix.lower() != ".npz":
            raise ValueError(f"`path`: expected a name that ends in .npz, got {path.name!r}")
        main = WORD_OF[self.quantity]
        taken = {main, "gyro", "fs", "unit", "sensors", "time", "axes"} & {*self.channels}
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
        """What the recording holds, as fixed-width text."""
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
        """What is known about the recording, without its samples, ready for JSON."""
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


def read_recording(
    path: str | Path | Sequence[str | Path],
    *,
    axis: str | None = None,
    sensors: Sequence[str | int] | None = None,
    rate: float | None = None,
    unit: str | None = None,
    scale: float | None = None,
    key: str | None = None,
    quantity: str = "rate",
    columns: Mapping[str, str] | None = None,
    mounting: Mapping[str, Any] | str | Path | None = None,
    max_bytes: float | None = None,
) -> Recording:
    """Read a log, or several logs of one array, onto a uniform grid.

    Devices with the same axes give `(axis, sensor, time)`, or `(sensor, time)` of one `axis`. The rate comes from the
    timestamps where there are any. Gaps, repeats, jitter, wraps, offsets between devices and non-finite samples are
    found and noted; what is missing is NaN, nothing is interpolated.

    Args:
        path: One file, a ROS 2 folder, or several files of one array.
        axis: "x", "y" or "z": this axis of every device alone.
        sensors: Sensors to keep: names, or positions from 0.
        rate: Sampling rate in Hz; needed where a log states none, and then it comes before the log's own.
        unit: Unit to convert to; where the log states none, the unit that its numbers have.
        scale: Factor that turns the log's numbers (counts) into `unit`.
        key: Which recording inside the file, where it holds several.
        quantity: `"rate"` for the gyros of the log, `"acceleration"` for its accelerometers.
        columns: What columns or arrays of the log are, where their names do not say: these by the names that they
            should have, `{"gyro_x": "u3", "time": "t"}`. Others are left out.
        mounting: Rotation of each device, `{device: 3 x 3 matrix}` or the path of a JSON file of that, which maps its
            axes to those of the array: `v_array = M v_device`.
        max_bytes: Memory in bytes that the numbers of each log may take, as the log declares them, which is compared
            before any is allocated; by default a quarter of the physical memory. A longer log: `open_long`.

    Returns:
        The recording, float64, with notes on everything that was found.

    Raises:
        FileNotFoundError: No such file.
        RecordingError: The file cannot be read as a recording: says what was expected, what was found, what to do.
        ValueError: An option that does not fit the log, or a file that is named twice.
        ImportError: A format whose library is not installed (`pip install "gyrofuse[logs]"`).
    """
    paths = [Path(path)] if isinstance(path, str | Path) else [Path(p) for p in path]
    if not paths:
        raise ValueError("`path`: expected at least one file, got none")
    places = [os.path.abspath(p) for p in paths]
    twice = next((p for i, p in enumerate(places) if p in places[:i]), None)
    if twice is not None:
        raise ValueError(f"`path`: expected each file once, got {twice} twice; name it once")
    check_reading(rate=rate, scale=scale, quantity=quantity, columns=columns)
    if max_bytes is not None:
        check_positive("max_bytes", max_bytes)
    whole = assemble(
        paths,
        axis=axis,
        rate=rate,
        unit=unit,
        scale=scale,
        key=key,
        quantity=quantity,
        columns=columns,
        mounting=mounting,
        max_bytes=max_bytes,
    )
    recording = Recording(
        torch.from_numpy(whole.signal),
        rate=whole.rate,
        unit=whole.unit,
        sensors=whole.sensors,
        channels={name: torch.from_numpy(values) for name, values in whole.channels.items()},
        axes=whole.axes,
        source=tuple(p.name for p in paths),
        notes=whole.notes,
        quantity=quantity_of(whole.unit) or quantity,
    )
    return recording if sensors is None else recording.select(sensors=sensors)


def check_reading(
    *,
    rate: float | None = None,
    scale: float | None = None,
    quantity: str = "rate",
    columns: Mapping[str, str] | None = None,
) -> None:
    """Raise `ValueError` where an option of `read_recording` is wrong for any log."""
    check_quantity(quantity)
    if columns is not None:
        check_columns(columns)
    if rate is not None and not is_rate(check_positive("rate", rate)):
        raise ValueError(f"`rate`: expected a sampling rate of 1e-6 to 1e12 Hz, got {rate!r}")
    if scale is not None and not (math.isfinite(scale) and scale != 0):
        raise ValueError(f"`scale`: expected a finite number other than 0, got {scale!r}")


def _position(names: Sequence[str], sensor: str | int) -> int:
    if isinstance(sensor, str) and sensor in names:
        return names.index(sensor)
    if not isinstance(sensor, str) and 0 <= sensor < len(names):
        return sensor
    raise ValueError(f"`sensors`: expected some of {_named(names)}, got {sensor!r}")


def _named(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names)) or "none (this recording has none)"
