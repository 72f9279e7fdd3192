"""The door for signals: a tensor or a `Recording`, with what is known of it."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from gyrofuse._base.checks import check_signal
from gyrofuse._base.results import numbered
from gyrofuse.io.recording import Recording


class KnownSignal(NamedTuple):
    """A signal, and what its recording says of it.

    Attributes:
        values: `(..., sensor, time)`.
        sensors: Name of each sensor, `"1"`, `"2"`, ... where there are none.
        axes: Names along the leading dimension, where the recording has axes.
        rate: Sampling rate, Hz; None for a tensor.
        unit: Unit of the values; None for a tensor, and for a recording that does not know it.
    """

    values: Tensor
    sensors: tuple[str, ...]
    axes: tuple[str, ...] = ()
    rate: float | None = None
    unit: str | None = None


def as_recording(signal: Tensor | Recording, name: str = "signal") -> KnownSignal:
    """A signal with what is known of it, checked.

    Args:
        signal: `(..., sensor, time)`, or a recording.
        name: Name of the argument, for messages.

    Raises:
        TypeError: Neither a floating point tensor nor a `Recording`.
        ValueError: Fewer than two dimensions, no sensor or no sample.
    """
    if isinstance(signal, Recording):
        unit = signal.unit if signal.unit != "unknown" else None
        return KnownSignal(signal.signal, signal.sensors, signal.axes, signal.rate, unit)
    check_signal(name, signal)
    return KnownSignal(signal, numbered(signal.shape[-2]))
