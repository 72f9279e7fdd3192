"""What every log reader returns: the gyros or accelerometers of one device, as recorded."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class RecordingError(ValueError):
    """A log that cannot be read as a recording: says the file, what was expected, what was found, what to do."""


def cause(error: Exception) -> str:
    """Words of an error, its kind where it has none."""
    return str(error)[:1000] or type(error).__name__


def unexpected(source: object, error: Exception) -> RecordingError:
    """The error for what no reader foresaw: with the log, and the words of the cause."""
    return RecordingError(
        f"{source}: expected a recording, found a log that cannot be made one ({type(error).__name__}: {cause(error)}"
        "); it may be damaged: record, copy or export it again"
    )


@dataclass(frozen=True, eq=False)
class Stream:
    """The gyros or accelerometers of one device that share one clock, exactly as the log holds them.

    Nothing is repaired here: gaps, repeats, wraps and non-finite samples are kept for
    `gyrofuse.io.recording` to find and report.

    Attributes:
        name: Device, topic instance, file stem or column the data come from.
        signal: Rate or acceleration along each axis, whichever was asked for, `{"x": (time,), "y": ..., "z": ...}`; the
            key is "" where the log names no axis.
        unit: `"deg/s"`, `"rad/s"`, `"m/s^2"`, `"counts"`, or `"unknown"` where the log does not say.
        time: Clock reading of each sample in seconds (may wrap, repeat or jump), or `None`.
        rate: Sampling rate that the log states in Hz, or `None`.
        clock_period: Seconds after which the clock wraps (2**32 microseconds, say), or `None` when unknown.
        channels: Auxiliary channels with time last: `temperature (time,)`, and `acceleration (3, time)` beside rates or
            `angular_rate (3, time)` beside accelerations.
        channel_units: Unit of each auxiliary channel, where known.
        notes: What the reader noticed (dropouts the logger reported, columns ignored), one sentence each.
    """

    name: str
    signal: dict[str, Array]
    unit: str = "unknown"
    time: Array | None = None
    rate: float | None = None
    clock_period: float | None = None
    channels: dict[str, Array] = field(default_factory=dict)
    channel_units: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def n_samples(self) -> int:
        """Number of samples as recorded."""
        return next(iter(self.signal.values())).shape[0]
