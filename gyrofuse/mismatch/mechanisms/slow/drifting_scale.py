"""A scale factor that drifts with a channel: what moves the device is put out larger where it is warmer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse._base.axes import DASHED, INK, finish
from gyrofuse.mismatch.detectors.slow.line_gains import LineGains, line_gains
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.signals.scale_factor import ScaleFactor
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold
from gyrofuse.mismatch.signals.known_lines import line_parts
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class DriftingScale(Mechanism):
    """`x_i(t) = (1 + slope_i (T(t) - T0)) m_i(t)`, with `m` the motion of known lines that both sides have.

    Seen only in what moves the device; of its size in the middle of the channel nothing is said.

    Attributes:
        frequencies_hz: Of the lines.
        channel: Name of the channel `T`.
        row: Its row.
        reference: `T0`, the mean of the channel.
        slope: `(sensor,)`, per unit of the channel; 0 in sensors that do not follow it.
    """

    name: ClassVar[str] = ScaleFactor.name
    likelihood: ClassVar[str] = "known paths"
    separated_by: ClassVar[str] = "a recording on a table that turns at known rates, at several temperatures"
    additive: ClassVar[bool] = True
    frequencies_hz: tuple[float, ...]
    channel: str
    row: int
    reference: float
    slope: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        gains, info = line_gains(comparison), comparison.info
        if gains is None or float(gains.p_values.min()) * comparison.n_sensors > level:
            return None
        sensors = tuple((gains.p_values * comparison.n_sensors <= max(level, 0.01)).nonzero()[:, 0].tolist())
        concerned = torch.zeros(comparison.n_sensors, dtype=torch.bool)
        concerned[list(sensors)] = True
        reference = float(info.channel_rows(gains.channel)[gains.row].mean())
        lines = tuple(f * info.rate for f in comparison.reference.lines)
        effect = cls(lines, gains.channel, gains.row, reference, torch.where(concerned, gains.slope, 0.0))
        parameters = {}
        for i in sensors:
            value, reach = 100 * float(gains.slope[i]), 100 * Z * float(gains.slope_sd[i])
            parameters[f"slope[{i}]"] = Parameter.around(value, reach, "% per unit")
        largest = max(sensors, key=lambda i: abs(float(gains.slope[i])))
        return effect.found(
            f"the scale factor of {info.named(sensors, 'all sensors')} follows {gains.channel}: what moves them is put "
            f"out by {100 * float(gains.slope[largest]):.3g} % larger for each unit of it (sensor "
            f"{info.sensors[largest]})",
            min(float(gains.p_values.min()) * comparison.n_sensors, 1.0),
            sensors,
            parameters,
            channel=gains.channel,
            gain=float(effect._scores(gains).sum()),
        )

    @property
    def follows(self) -> tuple[str, ...]:
        return (self.channel,)

    def fit_without(self, comparison: Comparison, fold: int) -> DriftingScale:
        gains = line_gains(comparison)
        if gains is None or (gains.channel, gains.row) != (self.channel, self.row):
            return self
        kept = ~in_fold(N_JUDGED, fold).repeat_interleave(gains.sizes.shape[-1] // N_JUDGED)
        course = torch.where(kept, gains.course, 0.0)
        slope = (gains.sizes - 1) @ course / course.square().sum()
        return replace(self, slope=torch.where(self.slope != 0, slope, 0.0))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        gains = line_gains(comparison)
        if gains is None or (gains.channel, gains.row) != (self.channel, self.row):
            return torch.zeros(N_JUDGED // N_FOLDS, dtype=torch.float64)
        return self._scores(gains).sum(0).unflatten(-1, (N_JUDGED, -1)).sum(-1)[in_fold(N_JUDGED, fold)]

    def _scores(self, gains: LineGains) -> Tensor:
        """Log likelihood ratio of the sizes in blocks, `(sensor, block)`, in the scatter that is left."""
        apart = gains.sizes - 1
        left = apart - self.slope[:, None] * gains.course
        variance = (apart - gains.slope[:, None] * gains.course).square().mean(-1, keepdim=True)
        variance = variance.maximum(gains.sd[:, None].square())
        return (apart.square() - left.square()) / (2 * variance)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        gains = line_gains(comparison)
        if gains is None:
            return
        x = (self.reference + gains.course).numpy()
        handles = ax.plot(x, gains.sizes[sensor].numpy(), linestyle="none", marker="o", markersize=3, color=INK)
        if fitted:
            handles += ax.plot(x, (1 + self.slope[sensor] * gains.course).numpy(), **DASHED)
        ax.set_xlabel(self.channel, parse_math=False)
        ax.set_ylabel("size of the line, over its mean")
        finish(ax, handles, ["recording", "fitted"][: len(handles)])

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return signal + self._path(signal, info)

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        return signal - self._path(signal, info)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        return comparison.subtract(self._path(comparison.recording, comparison.info))

    def _path(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        """What signals `(..., sensor, time)` have more of their lines than at `T0`."""
        course = info.channel_rows(self.channel)[self.row] - self.reference
        n = min(signal.shape[-1], len(course))
        t, path = torch.arange(n, dtype=torch.float64), torch.zeros_like(signal)
        frequencies = tuple(f / info.rate for f in self.frequencies_hz)
        parts = line_parts(signal, frequencies)
        for k, f in enumerate(frequencies):
            angle, own = 2 * math.pi * f * t, parts[..., k, None]
            path[..., :n] += own.real * angle.cos() - own.imag * angle.sin()
        path[..., :n] *= self.slope[:, None] * course[:n]
        return path
