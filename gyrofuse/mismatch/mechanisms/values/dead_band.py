"""A dead band: what is nearer to zero rate than its half-width is put out as zero."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.ties import band_limits, fits_band, missing_recurrences, recurring
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Parameter
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_SURE = math.log(50)  # largest log likelihood ratio of one sample in the band, nats


@dataclass(frozen=True, eq=False)
class DeadBand(Mechanism):
    """`y = value` where `|x - value| < half_width`, else `x`: rounding of what is small alone.

    One value recurs among values that do not, and around it none is left. A value filled in for missing samples
    recurs too, but its neighbours are as near to it as any others are.

    Attributes:
        value: Put out in the band, unit of the signal, `(sensor,)`.
        half_width: `(sensor,)`, likewise; 0 where there is no band.
        centre: `(sensor,)`, mean of the recording: a simulation's own mean stands for it.
    """

    name: ClassVar[str] = "quantization"
    likelihood: ClassVar[str] = "values"
    separated_by: ClassVar[str] = "the values as the converter gives them, before filters and averages"
    stage: ClassVar[int] = 2
    value: OfSensors
    half_width: OfSensors
    centre: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        missing = {i: pair for i, pair in missing_recurrences(comparison).items() if fits_band(pair[0])}
        if not missing or min(p for _, p in missing.values()) > level:
            return None
        first, p_value = min(missing.values(), key=lambda pair: pair[1])
        found = {i: own for i, (own, p) in missing.items() if p <= level}
        for i in set(range(comparison.n_sensors)) - set(found):  # where the same value is met at all
            again = recurring(i, comparison.recording[i], first.value)
            if again is not None and again.p_value < level and fits_band(again):
                found[i] = again
        found = dict(sorted(found.items()))
        numbers = torch.zeros(2, comparison.n_sensors, dtype=torch.float64)
        parameters, unit = {}, comparison.info.measure
        for i, own in found.items():
            middle, low, high = band_limits(own)
            numbers[:, i] = torch.tensor([own.value, middle], dtype=torch.float64)
            parameters[f"dead_band[{i}]"] = Parameter(middle, low, high, unit)
        effect = cls(numbers[0], numbers[1], comparison.recording.mean(-1))
        sensors = tuple(found)
        return Finding(
            cls.name,
            effect,
            f"a dead band: within {float(effect.half_width.max()):.3g} {unit} of {first.value:.3g} {unit} the rate is "
            f"put out as {first.value:.3g} in {comparison.info.named(sensors, 'all sensors')}",
            p_value,
            sensors,
            parameters,
            levels=(1,),
            gain=float(effect._scores(comparison.recording).sum()),
        )

    def fit_without(self, comparison: Comparison, fold: int) -> DeadBand:
        keep = estimation_samples(comparison.n_samples, fold)
        half_width = self.half_width.clone()
        for i in half_width.nonzero()[:, 0].tolist():
            again = recurring(i, comparison.recording[i, keep], float(self.value[i]))
            if again is not None:
                half_width[i] = band_limits(again)[0]
        return DeadBand(self.value, half_width, self.centre)

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        pictures.values(ax, comparison, sensor, float(self.value[sensor]), 4 * float(self.half_width[sensor]))

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        value = self.value[:, None] + signal.mean(-1, keepdim=True) - self.centre[:, None]
        return torch.where((signal - value).abs() < self.half_width[:, None], value, signal)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison.recording), fold).sum((0, -1))

    def _scores(self, signal: Tensor) -> Tensor:
        """What samples in the band speak for it, or against it where they are not at its value, `(sensor, time)`."""
        away = (signal - self.value[:, None]).abs()
        inside = (away < self.half_width[:, None]) & (self.half_width[:, None] > 0)
        return inside * torch.where(away == 0, _SURE, -_SURE).to(signal.dtype)
