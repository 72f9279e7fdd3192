"""Recordings larger than memory: their weights, and their virtual gyro as a file, by one process or by many."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.checks import check_floating, check_n_levels, largest_level
from gyrofuse._base.distributed import all_or_none, broadcast_from_first, rank_and_size
from gyrofuse._base.files import Outputs
from gyrofuse.fusion.result import fuse
from gyrofuse.fusion.virtual_gyro import VirtualGyro
from gyrofuse.fusion.weights.svo import (
    ScaleWeights,
    checked_combination,
    normalised,
    optimal_weights,
    resolve_scale_weights,
)
from gyrofuse.io.chunked import ChunkedRecording, Progress, check_chunked_recording, shard_bounds, silent
from gyrofuse.wavelets.metric import WaveletCrossCovariance

if TYPE_CHECKING:
    from lightning.fabric import Fabric


# Samples of all sensors that the longest wavelet may reach back over, unless more levels are asked for (2**24): 128
# MiB.
_PAST = 16_777_216


def stream_svo(
    recording: ChunkedRecording,
    scale_weights: ScaleWeights = "flat",
    n_levels: int | None = None,
    *,
    chunk_samples: int | None = None,
    fabric: Fabric | None = None,
    progress: Progress = silent,
) -> StreamedSVOResult:
    """Fuse a long recording into one virtual gyro of the smallest wavelet variance, chunk by chunk.

    The weights are those of `fit_svo` without intervals, up to rounding, however many processes share the work: each
    streams its stretch of time, and looks back on the `2**n_levels - 1` samples before it. Memory holds a chunk and
    `2**n_levels` samples of every sensor, and does not grow with the recording.

    Args:
        recording: What is read.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        n_levels: Number of levels J. By default as many as there are scale weights, else the largest with
            `2**J <= n_samples` whose `2**J` samples of every sensor fit into 128 MiB, and which has complete windows.
        chunk_samples: Samples of each sensor that are read at a time; by default 16 MiB.
        fabric: The processes, `lightning.fabric.Fabric(...)` after its `launch()`; all of them call this function
            with the same recording, and all get the result. By default this process alone.
        progress: Called with a word for the work and the fraction of this process's stretch that is done.

    Returns:
        The weights and the wavelet cross-covariance that they rest on.

    Raises:
        TypeError: `recording` is not a `ChunkedRecording`.
        ValueError: Fewer than two sensors, too few samples, no window that all sensors have, or bad options.
        RuntimeError: `fabric` has several processes and was not launched, or another process failed.
        SingularCovarianceError: A dead, duplicated or linearly dependent sensor.

    References:
        [Z] equations (4) to (7).

    Example:
        >>> result = stream_svo(open_recording("week.npy", rate=200.0), "long")
        >>> write_virtual(recording, result.weights, "virtual.npy")
    """
    check_chunked_recording(recording)
    if recording.n_sensors < 2:
        raise ValueError(f"`recording`: expected at least 2 sensors to fuse, got {recording.n_sensors}")
    asked = n_levels
    if asked is None and not isinstance(scale_weights, str):
        asked = len(normalised(scale_weights))
    n_levels = check_n_levels(asked if asked is not None else _most_levels(recording), recording.n_samples)
    resolve_scale_weights(scale_weights, n_levels)  # wrong scale weights are an error now, not after hours
    rank, world_size = rank_and_size(fabric)
    with all_or_none("`recording`: was not read to its end", world_size):
        metric = measure_stretch(
            recording,
            n_levels,
            *shard_bounds(recording.n_samples, rank, world_size),
            chunk_samples=chunk_samples,
            device=None if fabric is None else fabric.device,
            progress=progress,
        )
    metric.sync(should_sync=world_size > 1)
    sums, counts = metric.sums.cpu(), metric.counts.cpu()
    windows = counts.amin((-1, -2))
    if asked is None:
        n_levels = int((windows > 0).sum())  # a window of one level holds windows of all shorter ones
    if windows[:n_levels].sum() < recording.n_sensors:
        raise ValueError(
            f"`recording`: expected at least as many windows that all sensors have as sensors ({recording.n_sensors}), "
            f"got {int(windows[:n_levels].sum())}; record longer or leave sensors out"
        )
    wccv = sums[:n_levels] / counts[:n_levels]
    return StreamedSVOResult(
        weights=optimal_weights(checked_combination(wccv, scale_weights, recording.sensors)),
        wavelet_cross_covariance=wccv,
        scale_weights=resolve_scale_weights(scale_weights, n_levels),
        n_samples=recording.n_samples,
        sensors=recording.sensors,
        rate=recording.rate,
        unit=None if recording.unit == "unknown" else recording.unit,
    )


def measure_stretch(
    recording: ChunkedRecording,
    n_levels: int,
    start: int,
    stop: int,
    *,
    chunk_samples: int | None = None,
    device: torch.device | None = None,
    progress: Progress = silent,
) -> WaveletCrossCovariance:
    """Wavelet products of the windows that end in one stretch of a recording.

    Metrics of stretches that make up the recording add up with `merge_state` to that of the whole.

    Args:
        recording: What is read.
        n_levels: Number of levels J.
        start: First sample of the stretch.
        stop: First sample after the stretch.
        chunk_samples: Samples of each sensor that are read at a time; by default 16 MiB.
        device: Where the arithmetic is done; the CPU by default.
        progress: Called with a word for the work and the fraction that is done.

    Raises:
        ValueError: `chunk_samples` is not a whole number of at least 1.
    """
    metric = WaveletCrossCovariance(recording.n_sensors, n_levels).to(device or torch.device("cpu"))
    first = max(0, start - 2**n_levels + 1)
    for end, chunk in recording.chunks(first, start, chunk_samples):
        metric.prime(chunk.to(metric.device))
        progress("looking back", (end - first) / (stop - first))
    for end, chunk in recording.chunks(start, stop, chunk_samples):
        metric.update(chunk.to(metric.device))
        progress("streaming", (end - first) / (stop - first))
    return metric


@dataclass(frozen=True, eq=False)
class StreamedSVOResult(VirtualGyro):
    """Weights of a recording that was streamed.

    Attributes:
        weights: `(sensor,)`, sum 1, may be negative.
        wavelet_cross_covariance: `(level, sensor, sensor)`, signal^2.
        scale_weights: `(level,)`, sum 1.
        n_samples: Length of the recording.
        sensors: Name of each sensor.
        rate: Sampling rate in Hz, when known.
        unit: Unit of the signal, when known.
    """

    weights: Tensor
    wavelet_cross_covariance: Tensor
    scale_weights: Tensor
    n_samples: int
    sensors: tuple[str, ...]
    rate: float | None = None
    unit: str | None = None

    _contents = tuple(
        (
            "method sensors rate unit n_samples weights scale_weights tau wavelet_cross_covariance wavelet_variance "
            "virtual_wavelet_variance equal_wavelet_variance"
        ).split()
    )

    @property
    def method(self) -> str:
        """How the weights were chosen, `"svo"`."""
        return "svo"

    def virtual(self, signal: Tensor) -> Tensor:
        """Fuse a chunk into `(..., time)`; a sample that any sensor lacks is NaN.

        Args:
            signal: `(..., sensor, time)`.
        """
        return fuse(self.weights.to(signal), signal)

    def _summary_of_one(self) -> str:
        width = max(6, *(len(sensor) for sensor in self.sensors))
        lines = [
            self._headline("Virtual gyro (SVO, streamed)"),
            "",
            f"{'sensor':<{width}}  {'weight':>10}",
            *(f"{s:<{width}}  {w:>+10.5f}" for s, w in zip(self.sensors, self.weights.tolist(), strict=True)),
            "",
            *self._plain_table("this recording"),
        ]
        return "\n".join(lines)


def write_virtual(
    recording: ChunkedRecording,
    weights: Tensor,
    path: str | Path,
    *,
    chunk_samples: int | None = None,
    fabric: Fabric | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> None:
    """Fuse a long recording with given weights into a `.npy` file `(time,)`, float64, chunk by chunk.

    Each process writes its stretch of time. The file appears whole or not at all; a sample that any sensor lacks is
    NaN.

    Args:
        recording: Recording that is fused.
        weights: `(sensor,)`.
        path: Name of the file, on a file system that all processes share.
        chunk_samples: Samples of each sensor that are read at a time; by default 16 MiB.
        fabric: The processes, as for `stream_svo`.
        force: Whether an existing file may be replaced.
        progress: Called with a word for the work and the fraction of this process's stretch that is done.

    Raises:
        TypeError: `recording` is not a `ChunkedRecording`, or `weights` no floating point tensor.
        ValueError: The name does not end in .npy or is that of the recording, or there is not one weight for each
            sensor.
        FileExistsError: The file exists and `force` is not set.
        FileNotFoundError: The folder does not exist.
        RuntimeError: `fabric` was not launched, or another process failed.
    """
    check_chunked_recording(recording)
    path = Path(path)
    if path.suffix.lower() != ".npy":
        raise ValueError(f"`path`: expected a name that ends in .npy, got {path.name!r}")
    if recording.path is not None and path.resolve() == recording.path:
        raise ValueError(f"`path`: expected another file than the log that is read, got {path}; choose another name")
    check_floating("weights", weights)
    if weights.shape != (recording.n_sensors,):
        raise ValueError(
            f"`weights`: expected one for each of {recording.n_sensors} sensors, got shape {tuple(weights.shape)}"
        )
    start, stop = shard_bounds(recording.n_samples, *rank_and_size(fabric))
    values = weights.detach().to("cpu", torch.float64)
    with _draft_for_all(path, recording.n_samples, fabric, force=force) as (draft, offset), draft.open("r+b") as file:
        file.seek(offset + 8 * start)
        for end, chunk in recording.chunks(start, stop, chunk_samples):
            file.write(fuse(values, chunk).numpy().astype("<f8", copy=False).data)
            progress("writing", (end - start) / (stop - start))


@contextmanager
def _draft_for_all(path: Path, n_samples: int, fabric: Fabric | None, *, force: bool) -> Iterator[tuple[Path, int]]:
    """A `.npy` file (time,) that all processes write to, and where its numbers begin.

    It takes its name when all of them are done, and vanishes when one fails.
    """
    rank, world_size = rank_and_size(fabric)
    with ExitStack() as stack:
        found: tuple[Path, int] | Exception | None = None
        if rank == 0:
            try:
                draft = stack.enter_context(Outputs([path], force=force))[path]
                found = draft, _make_npy(draft, n_samples)
            except (OSError, ValueError) as error:
                found = error  # sent to the other processes, which would wait for ever
        found = broadcast_from_first(found, world_size)
        if isinstance(found, Exception):
            raise found
        with all_or_none(f"{path}: was not written", world_size):
            yield found
    if fabric is not None:
        fabric.barrier()  # the file has its name before anyone goes on


def _make_npy(draft: Path, n_samples: int) -> int:
    """Make a file of the final size, and return where its numbers begin."""
    with draft.open("wb") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (n_samples,)}
        np.lib.format.write_array_header_1_0(file, header)
        offset = file.tell()
        file.truncate(offset + 8 * n_samples)
    return offset


def _most_levels(recording: ChunkedRecording) -> int:
    """The largest number of levels whose `2**J` samples of every sensor fit into 128 MiB."""
    return max(1, min(largest_level(recording.n_samples), largest_level(_PAST // recording.n_sensors)))
