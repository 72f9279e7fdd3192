"""Read logs of any format as a recording."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from gyrofuse._base.checks import check_positive, first_twice
from gyrofuse._base.units import check_quantity, quantity_of
from gyrofuse.io.assemble import assemble
from gyrofuse.io.formats.columns import check_columns
from gyrofuse.io.formats.request import Request
from gyrofuse.io.limits import is_rate
from gyrofuse.io.quantities import QUANTITY
from gyrofuse.io.recording import Recording
from gyrofuse.io.streams import RecordingError


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
    found and noted. Missing samples are NaN; samples are never interpolated.

    Args:
        path: One file, a ROS 2 folder, or several files of one array.
        axis: Axis of every device to keep, "x", "y" or "z"; all by default.
        sensors: Sensors to keep: names, or positions from 0.
        rate: Sampling rate in Hz; needed where a log states none, and then it comes before the log's own.
        unit: Unit to convert to; where the log states none, the unit that its numbers have.
        scale: Factor that turns the log's numbers (counts) into `unit`.
        key: Name of the recording inside the file, where it holds several.
        quantity: Quantity to read: `"rate"` for the gyros of the log, `"acceleration"` for its accelerometers.
        columns: Columns or arrays of the log by the names that they should have, `{"gyro_x": "u3", "time": "t"}`, for
            logs whose own names do not say what they hold. All others are left out.
        mounting: Rotation of each device, `{device: 3 x 3 matrix}` or the path of a JSON file of that, which maps its
            axes to those of the array: `v_array = M v_device`.
        max_bytes: Memory in bytes that the numbers of each log may take; by default a quarter of the physical memory.
            The numbers that a log declares are counted before any memory is allocated. A longer log: `open_recording`.

    Returns:
        The recording, float64, with notes on all findings.

    Raises:
        FileNotFoundError: No such file.
        RecordingError: The file cannot be read as a recording: says what was expected, what was found, what to do.
        ValueError: An option that does not fit the log, or a file that is named twice.
        ImportError: A format whose library is not installed (the extra `logs`); the message names it.
    """
    if not isinstance(path, str | os.PathLike | Iterable):
        raise TypeError(f"`path`: expected the path of a file, or of several, got {path!r}")
    paths = [Path(path)] if isinstance(path, str | Path) else [Path(p) for p in path]
    if not paths:
        raise ValueError("`path`: expected at least one file, got none")
    twice = first_twice([os.path.abspath(p) for p in paths])
    if twice is not None:
        raise ValueError(f"`path`: expected each file once, got {twice} twice; name it once")
    check_reading(rate=rate, scale=scale, quantity=quantity, columns=columns)
    if max_bytes is not None:
        check_positive("max_bytes", max_bytes)
    requests = [Request(p, key, QUANTITY[quantity], columns, max_bytes) for p in paths]
    whole = assemble(requests, axis=axis, rate=rate, unit=unit, scale=scale, mounting=mounting)
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
    if sensors is None:
        return recording
    try:
        return recording.select(sensors=sensors)
    except ValueError as error:
        raise RecordingError(f"{', '.join(map(str, paths))}: {error}") from None


def check_reading(
    *,
    rate: float | None = None,
    scale: float | None = None,
    quantity: str = "rate",
    columns: Mapping[str, str] | None = None,
) -> None:
    """Check options of `read_recording` before a log is opened; the arguments are those of `read_recording`.

    Raises:
        ValueError: An option that is wrong for any log.
    """
    check_quantity(quantity)
    if columns is not None:
        check_columns(columns)
    if rate is not None and not is_rate(check_positive("rate", rate)):
        raise ValueError(f"`rate`: expected a sampling rate of 1e-6 to 1e12 Hz, got {rate!r}")
    if scale is not None and not (math.isfinite(scale) and scale != 0):
        raise ValueError(f"`scale`: expected a finite number other than 0, got {scale!r}")
