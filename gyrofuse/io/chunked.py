"""A recording that is read by stretches of time and never held whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_n_samples, check_positive, check_positive_integer, largest_level
from gyrofuse._base.results import counted, numbered
from gyrofuse._base.units import check_quantity
from gyrofuse.io.slices import open_slices

Progress = Callable[[str, float], None]

_CHUNK = 2**21  # numbers of a chunk: 16 MiB


def silent(what: str, share: float) -> None:
    """Progress that nobody is told."""


@dataclass(frozen=True, eq=False)
class LongRecording:
    """Gyros or accelerometers on a uniform grid of time whose samples are read when needed; NaN is a missing one.

    `open_long` makes one from a file. Any function that gives the samples of a stretch makes one as well, as long as
    it gives the same samples whenever it is asked, in whatever process:
    `LongRecording(lambda start, stop: samples[:, start:stop], n_sensors=6, n_samples=10**9)`.

    Attributes:
        source: Maps `(start, stop)` to the samples `(sensor, stop - start)`, a tensor or an array of numbers.
        n_sensors: Number of sensors.
        n_samples: Samples of each sensor.
        rate: Sampling rate in Hz, when known.
        unit: Unit of the signal: "deg/s", "rad/s", "m/s^2", "counts", "unknown".
        sensors: Name of each sensor; "1", "2", ... by default.
        path: File that is read, where there is one.

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
                "open a file with open_long(path)"
            )
        fill(self, "n_sensors", check_positive_integer("n_sensors", self.n_sensors))
        fill(self, "n_samples", check_positive_integer("n_samples", self.n_samples))
        if self.rate is not None:
            fill(self, "rate", check_positive("rate", self.rate))
        fill(self, "sensors", tuple(self.sensors) or numbered(self.n_sensors))
        if len(self.sensors) != self.n_sensors:
            raise ValueError(f"`sensors`: expected {counted(self.n_sensors, 'name')}, got {len(self.sensors)}")

    def read(self, start: int, stop: int) -> Tensor:
        """Samples `start` to `stop`, the latter excluded: `(sensor, stop - start)`, float64.

        Raises:
            ValueError: Not a stretch of the recording, or the source gives samples of another shape.
            TypeError: The source does not give real numbers.
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
        """Read samples `start` to `stop` one chunk after the other.

        Args:
            start: First sample.
            stop: Where to end, excluded.
            chunk_samples: Samples of each sensor in a chunk, the last one excepted; by default about 16 MiB.

        Yields:
            Where the chunk ends, and its samples `(sensor, time)`, float64.

        Raises:
            ValueError: `chunk_samples` is not a whole number of at least 1.
        """
        if chunk_samples is None:
            chunk_samples = 1 << largest_level(max(_CHUNK // self.n_sensors, 1))
        length = check_positive_integer("chunk_samples", chunk_samples)
        for first in range(start, stop, length):
            last = min(first + length, stop)
            yield last, self.read(first, last)

    def summary(self) -> str:
        """What is known without reading it, as one line."""
        at = f" at {self.rate:.6g} Hz ({self.n_samples / self.rate:.6g} s)" if self.rate else ""
        return f"Recording of {counted(self.n_sensors, 'sensor')}: {self.n_samples} samples{at}, {self.unit}"

    def __str__(self) -> str:
        return self.summary()


def open_long(
    path: str | Path,
    *,
    rate: float | None = None,
    unit: str | None = None,
    key: str | Sequence[str] | None = None,
    quantity: str = "rate",
) -> LongRecording:
    """Open a log that is larger than memory.

    The samples are taken as they stand, on a uniform grid: missing ones have to be there as NaN. `read_recording`
    finds gaps, jitter and repeats in timestamps, and reads the whole log for that. The longer dimension of an array is
    time; chunks along time are read fastest from an array with time last, or from row groups of a Parquet file that
    are not much longer than the chunks.

    Args:
        path: A `.npy` file, an `.npz` file that is not compressed, an `.h5` or `.hdf5`, or a `.parquet` file.
        rate: Sampling rate in Hz; by default what the log states, if anything.
        unit: Unit that the numbers have; by default what the log states, if anything.
        key: The array of an `.npz` or HDF5 file: `gyro` (`acceleration`), or the only one of two dimensions that may be
            it, by default. The columns of a `.parquet` file, one for each sensor: those with the name of a gyro (an
            accelerometer) by default.
        quantity: `"rate"` for the gyros of the log, `"acceleration"` for its accelerometers.

    Returns:
        The recording.

    Raises:
        FileNotFoundError: No such file.
        RecordingError: The file cannot be read by stretches: says what was expected, what was found, what to do.
        ValueError: A rate that is not positive, or no such quantity.
        ImportError: A format whose library is not installed (`pip install "gyrofuse[logs]"`).
    """
    check_quantity(quantity)
    found = open_slices(Path(path), key, quantity)
    return LongRecording(
        found.read,
        n_sensors=len(found.sensors),
        n_samples=found.n_samples,
        rate=found.rate if rate is None else rate,
        unit=unit or found.unit,
        sensors=found.sensors,
        path=Path(path).resolve(),
    )


def stretch_of(n_samples: int, rank: int, world_size: int) -> tuple[int, int]:
    """Samples `(start, stop)` of a recording that one of several processes takes.

    The stretches follow each other without gap or overlap, and their lengths differ by one sample at most.

    Args:
        n_samples: Samples of the recording.
        rank: Which process, from 0.
        world_size: Number of processes.

    Raises:
        ValueError: Not whole numbers, or no such process.
    """
    n_samples = check_n_samples("n_samples", n_samples)
    world_size = check_positive_integer("world_size", world_size)
    if isinstance(rank, bool) or not isinstance(rank, Integral) or not 0 <= rank < world_size:
        raise ValueError(f"`rank`: expected a whole number from 0 to {world_size - 1}, got {rank!r}")
    return n_samples * int(rank) // world_size, n_samples * (int(rank) + 1) // world_size


def check_long_recording(recording: LongRecording) -> None:
    """Raise `TypeError` when `recording` is anything else."""
    if not isinstance(recording, LongRecording):
        raise TypeError(
            f"`recording`: expected a LongRecording, got {type(recording).__name__}; open a file with open_long(path), "
            "or fit a signal in memory with fit_svo"
        )
