"""Full scale: values beyond the limits of a converter are set to them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.values import END_STOPS, EndStop, end_stops
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims, OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.stats.multiplicity import sidak

_CELL = 0.02  # width of a cell at the limit, sd: it bounds the log likelihood ratio of a sample there


@dataclass(frozen=True, eq=False)
class Clipping(Mechanism):
    """`y = min(max(x, low), high)`: mass at the extremes, where noise would go on.

    Attributes:
        low, high: `(sensor,)`, unit of the signal; infinite where nothing is clipped.
        centre: `(sensor,)`, mean of the recording: a simulation's own mean stands for it.
    """

    name: ClassVar[str] = "clipping"
    likelihood: ClassVar[str] = "values"
    separated_by: ClassVar[str] = "the full scale of the sensor, or a recording at another level"
    stage: ClassVar[int] = END_STOPS
    low: Annotated[Tensor, Dims(("sensor",), infinite=True)]
    high: Annotated[Tensor, Dims(("sensor",), infinite=True)]
    centre: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found = [end for end in end_stops(comparison) if end.p_value <= level]
        if not found:
            return None
        effect = cls(_limits_of(found, -1, comparison), _limits_of(found, 1, comparison), comparison.recording.mean(-1))
        sensors = tuple(sorted({end.sensor for end in found}))
        parameters = {
            f"{'high' if end.sign > 0 else 'low'}[{end.sensor}]": Parameter.exact(end.limit, comparison.info.measure)
            for end in found
        }
        where = comparison.info.named(sensors, "all sensors")
        ends = sorted({"above" if end.sign > 0 else "below" for end in found})
        at = min(found, key=lambda end: end.p_value)
        share = float(effect._clipped(comparison.recording).to(torch.float64)[list(sensors)].mean())
        return effect.found(
            f"values are cut {' and '.join(ends)} in {where}, as at {at.limit:.6g} {comparison.info.measure} in sensor "
            f"{comparison.info.sensors[at.sensor]}: {100 * share:.2g} % of the samples sit at the limits",
            sidak(at.p_value, 1),
            sensors,
            parameters,
            levels=(1,),
            gain=float(effect._scores(comparison).sum()),
        )

    def fit_without(self, comparison: Comparison, fold: int) -> Clipping:
        keep = estimation_samples(comparison.n_samples, fold)
        part = comparison.recording[:, keep]
        low = torch.where(self.low.isfinite(), part.amin(-1), self.low)
        high = torch.where(self.high.isfinite(), part.amax(-1), self.high)
        return Clipping(low, high, part.mean(-1))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        low, high = float(self.low[sensor]), float(self.high[sensor])
        limit = high if math.isfinite(high) else low
        pictures.values(ax, comparison, sensor, limit, float(comparison.recording[sensor].std()))

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        shift = signal.mean(-1, keepdim=True) - self.centre[:, None]
        return signal.clamp(self.low[:, None] + shift, self.high[:, None] + shift)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison), fold).sum((0, -1))

    def _clipped(self, signal: Tensor) -> Tensor:
        return (signal <= self.low[:, None]) | (signal >= self.high[:, None])

    def _scores(self, comparison: Comparison) -> Tensor:
        """Log of the mass beyond a limit over that of a cell next to it, for the samples there, `(sensor, time)`."""
        expected = left_out(comparison.observed)
        error, sd = expected.error[0], expected.sd[0][:, None]
        # Distance of the limit from what all other samples say, outwards.
        outward = torch.where(comparison.recording >= self.high[:, None], error, -error) / sd
        mass = torch.special.log_ndtr(-outward)
        cell = -outward.square() / 2 - math.log(2 * math.pi) / 2 + math.log(_CELL)
        return torch.where(self._clipped(comparison.recording), mass - cell, 0.0)


def _limits_of(found: list[EndStop], sign: int, comparison: Comparison) -> Tensor:
    limits = torch.full((comparison.n_sensors,), sign * math.inf, dtype=torch.float64)
    for end in found:
        if end.sign == sign:
            limits[end.sensor] = end.limit
    return limits
