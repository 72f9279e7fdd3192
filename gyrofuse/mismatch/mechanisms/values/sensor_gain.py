"""A gain of whole sensors: another scale, another unit, or mounted the other way round."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.sensor_gains import SensorGains, log_sizes, sensor_gains, sign_gain
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import N_JUDGED, estimation_samples, in_fold, signal_gains
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class SensorGain(Mechanism):
    """`x_i = g_i y_i`: all that a sensor gives is larger or smaller by one factor, or has the other sign.

    Noise, what sensors share, and lines alike. Louder noise of one kind leaves the other kinds as they are; a response
    to a known rate that is off leaves the noise (`scale_factor`).

    Attributes:
        factor: `g`, `(sensor,)`; 1 in those that are right.
    """

    name: ClassVar[str] = "sensor_gain"
    separated_by: ClassVar[str] = "a known motion that all of them feel"
    of_spectra: ClassVar[bool] = True
    factor: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found = sensor_gains(comparison)
        if found is None or found.p_value > level:
            return None
        sensors = tuple((found.factor != 1).nonzero()[:, 0].tolist())
        parameters = {}
        for i in sensors:
            value, reach = float(found.factor[i]), math.exp(Z * float(found.sd[i]))
            low, high = sorted((value / reach, value * reach))
            parameters[f"gain[{i}]"] = Parameter(value, low, high, "")
        effect = cls(found.factor)
        return effect.found(
            cls._words(found, sensors, comparison),
            found.p_value,
            sensors,
            parameters,
            levels=(1,),
            gain=-math.log(max(found.p_value, 1e-300)),
        )

    @staticmethod
    def _words(found: SensorGains, sensors: tuple[int, ...], comparison: Comparison) -> str:
        sized, turned = (found.factor.abs() != 1).nonzero()[:, 0].tolist(), (found.factor < 0).nonzero()[:, 0].tolist()
        said, info = [], comparison.info
        if sized:
            most = max(sized, key=lambda i: abs(math.log(abs(float(found.factor[i])))))
            said.append(
                f"one factor on all that comes from {info.named(sized, 'all sensors')}, noise and what sensors share "
                f"alike: {abs(float(found.factor[most])):.4g} times the simulation (sensor {info.sensors[most]})"
            )
        if turned:
            said.append(
                f"what sensors share has the other sign in {info.named(turned, 'all sensors')}, as where one is "
                "mounted the other way round"
            )
        return "; ".join(said)

    def fit_without(self, comparison: Comparison, fold: int) -> SensorGain:
        size = log_sizes(comparison, ~in_fold(N_JUDGED, fold)).exp()
        return replace(self, factor=self.factor.sign() * torch.where(self.factor.abs() != 1, size, 1.0))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        """By powers, by what sensors share as noise, and by the lines of the simulation."""
        scores, sign = super().held_out_scores(comparison, fold), self.factor.sign()
        if bool((sign > 0).all()):
            return scores
        held = [torch.arange(N_JUDGED) == block for block in in_fold(N_JUDGED, fold).nonzero()[:, 0].tolist()]
        shared = [sign_gain(comparison, one, sign) for one in held]
        path = self._lines(comparison, fold)
        lines = signal_gains(comparison, path, fold) - signal_gains(comparison, sign[:, None] * path, fold)
        return scores + torch.tensor(shared, dtype=torch.float64) + lines

    def _lines(self, comparison: Comparison, fold: int) -> Tensor:
        """The simulation's lines as the recording has them in the blocks that may be used for estimates."""
        keep = estimation_samples(comparison.n_samples, fold)
        t = torch.arange(comparison.n_samples, dtype=torch.float64)
        path = torch.zeros_like(comparison.recording)
        for line in comparison.reference.lines:
            basis = torch.stack([(2 * math.pi * line * t).cos(), (2 * math.pi * line * t).sin(), torch.ones_like(t)])
            own = basis[:, keep]
            size = torch.linalg.solve(own @ own.mT, own @ comparison.recording[:, keep].mT)
            path = path + size[:2].mT @ basis[:2]
        return path

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        power = self.factor.square()[:, None]
        pictures.ratio_of_spectra(ax, comparison, sensor, (lambda f: power * torch.ones_like(f)) if fitted else None)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return self.factor[:, None] * signal

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        return matrices * (self.factor[:, None] * self.factor)
