"""Weights from a recording that is larger than memory, by one process or by many that each take a stretch of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_n_levels, largest_level
from gyrofuse._base.distributed import all_or_none, place
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse._base.results import listed
from gyrofuse.fusion.result import fuse
from gyrofuse.fusion.virtual_gyro import VirtualGyro
from gyrofuse.fusion.weights.svo import (
    ScaleWeights,
    combine,
    counting,
    normalised,
    optimal_weights,
    resolve_scale_weights,
)
from gyrofuse.io.chunked import ChunkedRecording, Progress, check_chunked_recording, shard_bounds, silent
from gyrofuse.wavelets.metric import WaveletCrossCovariance

if TYPE_CHECKING:
    from lightning.fabric import Fabric
    from matplotlib.axes import Axes

# Numbers of the past that the longest wavelet looks back on, unless more levels are asked for: 128 MiB.
_PAST = 2**24


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
            `2**J <= n_samples` whose past fits into 128 MiB, and for which there are complete windows.
        chunk_samples: Samples of each sensor that are read at a time; by default 16 MiB.
        fabric: The processes, `lightning.fabric.Fabric(...)` after its `launch()`; all of them call this function
            with the same recording, and all get the result. By default this process alone.
        progress: Is told what is done and the share that is, of this process's stretch.

    Returns:
        The weights and the wavelet cross-covariance that they rest on.

    Raises:
        TypeError: `recording` is not a `ChunkedRecording`.
        ValueError: Fewer than two sensors, too few samples, no window that all sensors have, or bad options.
        RuntimeError: `fabric` has several processes and was not launched, or another process failed.
        SingularCovarianceError: A dead, duplicated or linearly dependent sensor.

    References:
        [Z] equations (5) to (7).

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
    resolve_scale_weights(scale_weights, n_levels)  # what is wrong with them is told now, not after hours
    rank, world_size = place(fabric)
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
    omega = resolve_scale_weights(scale_weights, n_levels)
    combined = combine(counting(wccv, omega), omega)
    check_positive_definite("the wavelet cross-covariance combined over scales", combined, recording.sensors)
    return StreamedSVOResult(
        weights=optimal_weights(combined),
        wavelet_cross_covariance=wccv,
        scale_weights=omega,
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
        stop: Where the next one begins.
        chunk_samples: Samples of each sensor that are read at a time; by default 16 MiB.
        device: Where the arithmetic is done; the CPU by default.
        progress: Is told what is done and the share that is.

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

    def virtual(self, signal: Tensor) -> Tensor:
        """Fuse a chunk `(..., sensor, time)` into `(..., time)`; a sample that any sensor lacks is NaN."""
        return fuse(self.weights.to(signal), signal)

    def summary(self) -> str:
        """The weights and the gain over equal weights per level, as fixed-width text."""
        width = max(6, *(len(sensor) for sensor in self.sensors))
        lines = [
            self._headline("SVO, streamed"),
            "",
            f"{'sensor':<{width}}  {'weight':>10}",
            *(f"{s:<{width}}  {w:>+10.5f}" for s, w in zip(self.sensors, self.weights.tolist(), strict=True)),
            "",
            *self._deviation_table(),
        ]
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the Allan deviation of every sensor, the plain mean and the virtual gyro.

        Args:
            ax: Where to draw; new axes by default.

        Returns:
            The axes.
        """
        from gyrofuse.fusion import plots as plotting

        return plotting.plot_allan_deviation(
            self.tau,
            self.wavelet_variance,
            names=self.sensors,
            virtual=self.virtual_wavelet_variance,
            equal=self.equal_wavelet_variance,
            unit=self.unit,
            in_seconds=self.rate is not None,
            ax=ax,
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN as None)."""
        return {
            "method": "svo",
            "sensors": list(self.sensors),
            "rate": self.rate,
            "unit": self.unit,
            "n_samples": self.n_samples,
            "weights": listed(self.weights),
            "scale_weights": listed(self.scale_weights),
            "tau": listed(self.tau),
            "wavelet_cross_covariance": listed(self.wavelet_cross_covariance),
            "wavelet_variance": listed(self.wavelet_variance),
            "virtual_wavelet_variance": listed(self.virtual_wavelet_variance),
            "equal_wavelet_variance": listed(self.equal_wavelet_variance),
        }


def _most_levels(recording: ChunkedRecording) -> int:
    return max(1, min(largest_level(recording.n_samples), largest_level(_PAST // recording.n_sensors)))
