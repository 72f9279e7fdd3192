"""Delays between sensors: a bus that is read in turns, a filter of another order, a stamp from elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.delays import fitted_delays, phases_of, sensor_delays
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.filters import filtered
from gyrofuse.mismatch.signals.folds import N_JUDGED, in_fold
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak


@dataclass(frozen=True, eq=False)
class SensorDelay(Mechanism):
    """`x_i(t) = y_i(t - tau_i)`: what sensors share comes later in some of them than the simulation says.

    Of noise of their own, which has no time in common, it changes nothing. Where they share all they have, only what
    lies between their delays is known: most of them are taken for right. A filter delays as well, and turns the power
    down: it is found by that.

    Attributes:
        delay: `tau`, samples, `(sensor,)`; 0 in those that are right.
    """

    name: ClassVar[str] = "sensor_delay"
    separated_by: ClassVar[str] = "timestamps of each sensor, or a known motion that all of them feel"
    of_spectra: ClassVar[bool] = True
    delay: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found, info = sensor_delays(comparison), comparison.info
        if found is None:
            return None
        sure, searched = 4.0, 130  # standard deviations; delays that were tried
        p_value = sidak(math.exp(-max(found.gain, 0.0)), searched * (comparison.n_sensors - 1))
        late = found.delay.abs() > sure * found.sd
        if p_value > level or not bool(late.any()):
            return None
        sensors, ms = tuple(late.nonzero()[:, 0].tolist()), 1e3 / info.rate
        parameters = {}
        for i in sensors:
            value, reach = ms * float(found.delay[i]), ms * Z * float(found.sd[i])
            parameters[f"delay[{i}]"] = Parameter.around(value, reach, "ms")
        largest = max(sensors, key=lambda i: abs(parameters[f"delay[{i}]"].value))
        by = parameters[f"delay[{largest}]"].value
        return cls(torch.where(late, found.delay, 0.0)).found(
            f"what sensors share comes {'later' if by > 0 else 'earlier'} in {info.named(sensors, 'all sensors')} than "
            f"in the others, by up to {abs(by):.3g} ms (sensor {info.sensors[largest]})",
            p_value,
            sensors,
            parameters,
            levels=(level_of(0.1),),
            gain=found.gain,
        )

    def fit_without(self, comparison: Comparison, fold: int) -> SensorDelay:
        phases = phases_of(comparison, ~in_fold(N_JUDGED, fold))
        return self if phases is None else replace(self, delay=self._of_those(fitted_delays(phases).delay))

    def _of_those(self, delay: Tensor) -> Tensor:
        """Delays of the sensors that have one."""
        return torch.where(self.delay != 0, delay, 0.0)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        scores = []
        for block in in_fold(N_JUDGED, fold).nonzero()[:, 0].tolist():
            phases = phases_of(comparison, torch.arange(N_JUDGED) == block)
            if phases is None:
                return torch.zeros(int(in_fold(N_JUDGED, fold).sum()), dtype=torch.float64)
            scores.append(phases.likelihood(self.delay) - phases.likelihood(torch.zeros_like(self.delay)))
        return torch.stack(scores)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        shared = comparison.reference.coherence.abs().sum(0)[sensor]
        right = torch.where(self.delay == 0, shared, 0.0)  # against those that are right
        pictures.coherence(ax, comparison, sensor, right if bool(right.any()) else shared, in_phase=True)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        moved = filtered(signal, self._turn)
        return torch.where((self.delay != 0)[:, None], moved, signal)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        turn = self._turn(f).mT.to(matrices.dtype)  # (frequency, sensor)
        return turn[:, :, None] * matrices * turn[:, None, :].conj()

    def _turn(self, f: Tensor) -> Tensor:
        """Complex gains `(sensor, frequency)` at `f` cycles per sample."""
        angle = -2 * math.pi * self.delay[:, None] * f
        return torch.polar(torch.ones_like(angle), angle)
