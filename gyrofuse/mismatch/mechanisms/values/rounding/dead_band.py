"""A dead band: what is nearer to zero rate than its half-width is put out as zero."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.ties import (
    Band,
    Recurring,
    band_of,
    missing_recurrences,
    recurring,
)
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks

_SURE = math.log(50)  # largest log likelihood ratio of one sample in the band, nats


@dataclass(frozen=True, eq=False)
class DeadBand(Mechanism):
    """`y = value` where `|x - value| < half_width`, else `x`: rounding of what is small alone.

    Beyond the band either `x` is put out or what is left of it, `x -+ half_width`.

    One value recurs among values that do not, and around it none is left. A value filled in for missing samples
    recurs too, but its neighbours are as near to it as any others are.

    Attributes:
        value: Put out in the band, unit of the signal, `(sensor,)`.
        half_width: `(sensor,)`, likewise; 0 where there is no band.
        centre: `(sensor,)`, mean of the recording: a simulation's own mean stands for it.
        subtracts: Whether beyond the band what is left is put out.
    """

    name: ClassVar[str] = "quantization"
    likelihood: ClassVar[str] = "values"
    separated_by: ClassVar[str] = "the values as the converter gives them, before filters and averages"
    stage: ClassVar[int] = 2
    value: OfSensors
    half_width: OfSensors
    centre: OfSensors
    subtracts: bool = field(default=False, metadata={"plain": True})

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        missing = {i: pair for i, pair in missing_recurrences(comparison).items() if pair[1] <= level}
        found = {i: band for i, (own, _) in missing.items() if (band := _band(comparison, own)) is not None}
        if not found:
            return None
        first = min(found, key=lambda i: missing[i][1])
        value, p_value = missing[first][0].value, missing[first][1]
        for i in set(range(comparison.n_sensors)) - set(found):  # where the same value is met at all
            again = recurring(i, comparison.recording[i], value)
            band = None if again is None or again.p_value >= level else _band(comparison, again)
            if again is not None and band is not None:
                found[i], missing[i] = band, (again, again.p_value)
        found = dict(sorted(found.items()))
        numbers = torch.zeros(2, comparison.n_sensors, dtype=torch.float64)
        centre = comparison.recording.mean(-1)
        parameters, unit = {}, comparison.info.measure
        for i, band in found.items():
            numbers[:, i] = torch.tensor([missing[i][0].value, band.half_width], dtype=torch.float64)
            centre[i] = band.centre
            parameters[f"dead_band[{i}]"] = Parameter(band.half_width, band.low, band.high, unit)
        subtracts = found[first].subtracts
        effect = cls(numbers[0], numbers[1], centre, subtracts)
        sensors, beyond = tuple(found), ", and beyond that less the width," if subtracts else ""
        return effect.found(
            f"a dead band: within {float(effect.half_width.max()):.3g} {unit} of {value:.3g} {unit} the rate is "
            f"put out as {value:.3g}{beyond} in {comparison.info.named(sensors, 'all sensors')}",
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
            band = None if again is None else _band(comparison, again, keep)
            if band is not None:
                half_width[i] = band.half_width
        return replace(self, half_width=half_width)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.values(ax, comparison, sensor, float(self.value[sensor]), 4 * float(self.half_width[sensor]))

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        value = self.value[:, None] + signal.mean(-1, keepdim=True) - self.centre[:, None]
        beyond, width = signal - value, self.half_width[:, None]
        put_out = signal - beyond.sign() * width if self.subtracts else signal
        return torch.where(beyond.abs() < width, value, put_out)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison.recording), fold).sum((0, -1))

    def _scores(self, signal: Tensor) -> Tensor:
        """What samples in the band speak for it, or against it where they are not at its value, `(sensor, time)`."""
        away = (signal - self.value[:, None]).abs()
        inside = (away < self.half_width[:, None]) & (self.half_width[:, None] > 0)
        if self.subtracts:  # what was beyond the band lies next to its value now
            inside &= away == 0
        return inside * torch.where(away == 0, _SURE, -_SURE).to(signal.dtype)


def _band(comparison: Comparison, found: Recurring, keep: Tensor | None = None) -> Band | None:
    """The band around a value that recurs, in the samples to keep `(time,)`."""
    values = comparison.recording[found.sensor] if keep is None else comparison.recording[found.sensor, keep]
    return band_of(found, values, float(comparison.reference.signal[:, found.sensor].std(-1).mean()))
