"""What a log reader returns: the samples of each device as recorded, and notes on what was found."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class RecordingError(ValueError):
    """A log that cannot be read as a recording: says the file, what was expected, what was found, what to do."""


def cause(error: Exception) -> str:
    """Message of an error in at most 1000 characters, or its type where it has none."""
    return str(error)[:1000] or type(error).__name__


@contextmanager
def reading(path: object, expected: str, remedy: str) -> Iterator[None]:
    """Raise any error of the body as a `RecordingError`: a damaged log may fail anywhere in the library that reads it.

    Args:
        path: The log.
        expected: Description of a sound log.
        remedy: Advice on a log that cannot be read.
    """
    try:
        yield
    except (RecordingError, ImportError):
        raise
    except Exception as error:
        raise RecordingError(
            f"{path}: expected {expected}, found one that cannot be read ({cause(error)}); {remedy}"
        ) from error


def not_installed(path: object, doing: str, library: str) -> ImportError:
    """The error for an optional library that is not installed.

    Args:
        path: The file that needs it.
        doing: What with, such as `"reading ULog"`.
        library: Name of the library.
    """
    return ImportError(
        f"{path}: {doing} needs {library}; pip install {library}, or all readers of logs with "
        f'pip install ".[logs]" where the sources of gyrofuse are'
    )


@contextmanager
def needed(path: object, what: str, library: str) -> Iterator[None]:
    """Name the log in the error of a library that is imported in the body and not installed.

    Args:
        path: The log.
        what: Name of its format.
        library: Name of the library.
    """
    try:
        yield
    except ImportError as error:
        raise not_installed(path, f"reading {what}", library) from error


def unexpected(source: object, error: Exception) -> RecordingError:
    """The error for an exception that no reader foresaw.

    Args:
        source: The log or logs.
        error: The exception.
    """
    return RecordingError(
        f"{source}: expected a recording, found a log that cannot be made one ({type(error).__name__}: {cause(error)}"
        "); it may be damaged: record, copy or export it again"
    )


@dataclass(frozen=True, eq=False)
class Stream:
    """The gyros or accelerometers of one device that share one clock, exactly as the log holds them.

    Gaps, repeats, wraps and non-finite samples are kept: `gyrofuse.io.assemble` finds and reports them.

    Attributes:
        name: Device, topic instance, file stem or column from which the samples come.
        signal: Samples of the requested quantity along each axis, `{"x": (time,), "y": ..., "z": ...}`; the key is ""
            where the log names no axis.
        unit: `"deg/s"`, `"rad/s"`, `"m/s^2"`, `"counts"`, or `"unknown"` where the log does not say.
        time: Clock reading of each sample in seconds (may wrap, repeat or jump), or `None`.
        rate: Sampling rate that the log states in Hz, or `None`.
        clock_period: Seconds after which the clock wraps (2**32 microseconds, say), or `None` when unknown.
        channels: Auxiliary channels with time last: `temperature (time,)`, and `acceleration (3, time)` beside rates or
            `angular_rate (3, time)` beside accelerations.
        channel_units: Unit of each auxiliary channel, where known.
        notes: Remarks of the reader (dropouts that the logger reported, columns left out), one sentence each.
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


@dataclass(frozen=True)
class Note:
    """One finding about a recording.

    Attributes:
        kind: `gaps`, `repeats`, `jitter`, `drift`, `wraps`, `clock`, `non_finite`, `startup`, `offset`, `cut`,
            `unit` or `reader`.
        stream: Device or file that the finding concerns; empty when it concerns all.
        sentence: The finding in words, with numbers and units.
        numbers: The numbers of the sentence by name.
    """

    kind: str
    stream: str
    sentence: str
    numbers: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.stream}: {self.sentence}" if self.stream else self.sentence

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "kind": self.kind,
            "stream": self.stream,
            "sentence": self.sentence,
            "numbers": self.numbers,
        }


class Notebook:
    """Collects the notes about one stream."""

    def __init__(self, stream: str) -> None:
        self.stream = stream
        self.notes: list[Note] = []

    def add(self, kind: str, sentence: str, **numbers: float) -> None:
        """Note a finding with its numbers."""
        plain = {name: float(value) for name, value in numbers.items()}
        self.notes.append(Note(kind, self.stream, sentence, plain))
