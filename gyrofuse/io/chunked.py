"""A recording that is read chunk by chunk and never held in memory as a whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_n_samples, check_positive, check_positive_integer, largest_level
from gyrofuse._base.deprecation import moved_names
from gyrofuse._base.results import counted, numbered
from gyrofuse._base.units import check_quantity, known_unit
from gyrofuse.io.formats.slices import open_slices
from gyrofuse.io.quantities import QUANTITY

_MOVED = {"LongRecording": "ChunkedRecording", "open_long": "open_recording", "stretch_of": "shard_bounds"}
__getattr__ = moved_names(__name__, {old: f"{__name__}.{new}" for old, new in _MOVED.items()})

Progress = Callable[[str, float], None]


def silent(what: str, share: float) -> None:
    """Progress that is not shown."""


@dataclass(frozen=True, eq=False)
class ChunkedRecording:
    """Gyros or accelerometers on a uniform grid of time whose samples are read when needed; NaN is a missing sample.

    `open_recording` makes one from a file. Any function of `(start, stop)` makes one as well, if it returns the same
    samples in each call and in each process:
    `ChunkedRecording(lambda start, stop: samples[:, start:stop], n_sensors=6, n_samples=10**9)`.

    Attributes:
        source: Maps `(start, stop)` to the samples `(sensor, stop - start)`, a tensor or an array of numbers.
        n_sensors: Number of sensors.
        n_samples: Samples of each sensor.
        rate: Sampling rate in Hz, when known.
        unit: Unit of the signal: "deg/s", "rad/s", "m/s^2", "counts", "unknown".
        sensors: Name of each sensor; "1", "2", ... by default.
        path: File that is read, if any.

    Raises:
        TypeError: `source` cannot be called.
        ValueError: A number of sensors or samples below 1, a rate that is not positive, or names that do not fit.
    """

    source: Callable[[int, int], Any]
    n_sensors: int
    n_samples: int
    rate: float | None = None
    unit: str = "unknown"
    sensors: tuple[str, ...] = ()
    path: Path | None = None

    def __post_init__(self) -> None:
        fill = object.__setattr__
        if not callable(self.source):
            raise TypeError(
                f"`source`: expected a function of (start, stop), got {type(self.source).__name__}; "
                "open a file with open_recording(path)"
            )
        fill(self, "n_sensors", check_positive_integer("n_sensors", self.n_sensors))
        fill(self, "n_samples", check_positive_integer("n_samples", self.n_samples))
        if self.rate is not None:
            fill(self, "rate", check_positive("rate", self.rate))
        fill(self, "sensors", tuple(self.sensors) or numbered(self.n_sensors))
        if len(self.sensors) != self.n_sensors:
            raise ValueError(f"`sensors`: expected {counted(self.n_sensors, 'name')}, got {len(self.sensors)}")

    def read(self, start: int, stop: int) -> Tensor:
        """Read samples `start` to `stop - 1`: `(sensor, stop - start)`, float64.

        Args:
            start: Position of the first sample.
            stop: Position after the last sample.

        Raises:
            ValueError: Positions outside the recording, or a source that returns samples of another shape.
            TypeError: A source that does not return real numbers.
        """
        start, stop = check_n_samples("start", start), check_n_samples("stop", stop)
        if not start <= stop <= self.n_samples:
            raise ValueError(
                f"`stop`: expected start <= stop <= {self.n_samples}, the samples there are, got {start} to {stop}"
            )
        values = torch.as_tensor(self.source(start, stop)).detach()
        if values.is_complex() or values.dtype == torch.bool:
            raise TypeError(f"`source`: expected real numbers, got {values.dtype}")
        if values.shape != (self.n_sensors, stop - start):
            raise ValueError(
                f"`source`: expected (sensor, time) of shape {(self.n_sensors, stop - start)} for samples {start} to "
                f"{stop}, got {tuple(values.shape)}; give one row for each sensor and all samples of the stretch"
            )
        return values.to(torch.float64)

    def chunks(self, start: int, stop: int, chunk_samples: int | None = None) -> Iterator[tuple[int, Tensor]]:
        """Read samples `start` to `stop - 1` one chunk after the other.

        Args:
            start: Position of the first sample.
            stop: Position after the last sample.
            chunk_samples: Samples of each sensor in a chunk, except in the last chunk; by default about 16 MiB.

        Yields:
            Position after the last sample of the chunk, and its samples `(sensor, time)`, float64.

        Raises:
            ValueError: `chunk_samples` is not a whole number of at least 1.
        """
        if chunk_samples is None:
            n_numbers = 2**21  # 16 MiB in float64, small beside the memory of any computer and slow to no format
            chunk_samples = 1 << largest_level(max(n_numbers // self.n_sensors, 1))
        length = check_positive_integer("chunk_samples", chunk_samples)
        for first in range(start, stop, length):
            last = min(first + length, stop)
            yield last, self.read(first, last)

    def summary(self) -> str:
        """Sensors, samples, rate and unit in one line."""
        at = f" at {self.rate:.6g} Hz ({self.n_samples / self.rate:.6g} s)" if self.rate else ""
        return f"Recording of {counted(self.n_sensors, 'sensor')}: {self.n_samples} samples{at}, {self.unit}"

    def __str__(self) -> str:
        return self.summary()


def open_recording(
    path: str | Path,
    *,
    rate: float | None = None,
    unit: str | None = None,
    key: str | Sequence[str] | None = None,
    quantity: str = "rate",
) -> ChunkedRecording:
    """Open a log that is larger than memory.

    The samples of the log have to be on a uniform grid, with NaN for missing samples: timestamps are not read.
    `read_recording` finds gaps, jitter and repeats in timestamps, and reads the whole log for that. The longer
    dimension of an array is time; chunks along time are read fastest from an array with time last, or from row groups
    of a Parquet file that are not much longer than the chunks.

    Args:
        path: A `.npy` file, an `.npz` file that is not compressed, an `.h5` or `.hdf5`, or a `.parquet` file.
        rate: Sampling rate in Hz; by default what the log states, if anything.
        unit: Unit that the numbers have; by default what the log states, if anything.
        key: Array of an `.npz` or HDF5 file; by default `gyro` (`acceleration`), or the only array of two dimensions
            that may hold the sensors. Columns of a `.parquet` file, one for each sensor; by default the columns with
            the name of a gyro (an accelerometer).
        quantity: Quantity to read: `"rate"` for the gyros of the log, `"acceleration"` for its accelerometers.

    Returns:
        The recording.

    Raises:
        FileNotFoundError: No such file.
        RecordingError: The file cannot be read chunk by chunk: says what was expected, what was found, what to do.
        ValueError: A rate that is not positive, or no such quantity.
        ImportError: A format whose library is not installed (the extra `logs`); the message names it.
    """
    check_quantity(quantity)
    found = open_slices(Path(path), key, QUANTITY[quantity])
    return ChunkedRecording(
        found.read,
        n_sensors=len(found.sensors),
        n_samples=found.n_samples,
        rate=found.rate if rate is None else rate,
        unit=found.unit if unit is None else known_unit("unit", unit),
        sensors=found.sensors,
        path=Path(path).resolve(),
    )


def shard_bounds(n_samples: int, rank: int, world_size: int) -> tuple[int, int]:
    """Return the positions `(start, stop)` of the samples that one of several processes takes.

    The shards follow each other without gap or overlap, and their lengths differ by one sample at most.

    Args:
        n_samples: Number of samples of the recording.
        rank: Number of the process, from 0.
        world_size: Number of processes.

    Raises:
        ValueError: Arguments that are not whole numbers, or no such process.
    """
    n_samples = check_n_samples("n_samples", n_samples)
    world_size = check_positive_integer("world_size", world_size)
    if isinstance(rank, bool) or not isinstance(rank, Integral) or not 0 <= rank < world_size:
        raise ValueError(f"`rank`: expected a whole number from 0 to {world_size - 1}, got {rank!r}")
    return n_samples * int(rank) // world_size, n_samples * (int(rank) + 1) // world_size


def check_chunked_recording(recording: ChunkedRecording) -> None:
    """Raise `TypeError` where `recording` is not a `ChunkedRecording`."""
    if not isinstance(recording, ChunkedRecording):
        raise TypeError(
            f"`recording`: expected a ChunkedRecording, got {type(recording).__name__}; open a file with "
            "open_recording(path), or fit a signal in memory with fit_svo"
        )
