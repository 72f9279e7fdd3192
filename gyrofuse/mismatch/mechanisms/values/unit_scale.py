"""Other units: the numbers of recording and simulation differ by a factor that units have."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse._base.units import GRAVITY
from gyrofuse.mismatch.detectors.spectra.band_tests import power_tails
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

_UNITS = {
    180 / math.pi: "deg/s against rad/s",
    1000.0: "mdeg/s against deg/s",
    3600.0: "deg/h against deg/s",
    3600 * 180 / math.pi: "deg/h against rad/s",
    GRAVITY: "m/s^2 against g",
}
_ALIKE, _MOST = 0.5, 0.8  # logarithm by which a band may be off, where something else is missing, and share of bands
_NEAR = 0.25  # of the logarithm: noise levels of sensors of one kind differ by as much


@dataclass(frozen=True, eq=False)
class UnitScale(Mechanism):
    """`x = factor * simulated`, the factor one between two units, for all sensors.

    Attributes:
        factor: Recording over simulation.
    """

    name: ClassVar[str] = "parameter_shift"
    separated_by: ClassVar[str] = "a longer recording, or one of the same device under other conditions"
    rescales: ClassVar[bool] = True
    factor: float

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        known = comparison.reference.dof > 0
        ratios = (comparison.observed.power / comparison.reference.power)[:, known].log() / 2  # (sensor, band)
        middle = ratios.median(-1).values
        # A unit is one factor at all frequencies; other numbers of white noise move most bands, too.
        alike = ((ratios - middle[:, None]).abs() < _ALIKE).double().mean(-1) > _MOST
        if not bool(alike.all()):
            return None
        if not _at_all_times(comparison, middle):
            return None
        for size, words in _UNITS.items():
            for sign in (1, -1):
                if bool(((middle - sign * math.log(size)).abs() < _NEAR).all()):
                    return cls._found(
                        comparison, size**sign, words if sign == 1 else " against ".join(words.split(" against ")[::-1])
                    )
        return None

    @classmethod
    def _found(cls, comparison: Comparison, factor: float, words: str) -> Finding:
        tails = power_tails(comparison)
        return cls(factor).found(
            f"every sensor of the recording is {factor:.4g} times the simulation, as {words} would be: "
            "give both in the same unit",
            min(float(tails.nan_to_num(nan=1.0).amin()) * tails.numel(), 1.0),
            tuple(range(comparison.n_sensors)),
            {"factor": Parameter.exact(factor, "")},
            gain=math.inf,
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        return None  # stands for no other noise

    def left_of(self, own: Sequence[Mechanism]) -> tuple[Mechanism, ...]:
        return tuple(effect.in_unit(self.factor) for effect in own)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.ratio_of_spectra(ax, comparison, sensor, None)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return self.factor * signal

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        return comparison.in_unit(self.factor)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        return self.factor**2 * matrices

    def fit_without(self, comparison: Comparison, fold: int) -> UnitScale:
        return self


def _at_all_times(comparison: Comparison, factor: Tensor) -> bool:
    """Whether most stretches are as much larger as the whole is: noise that is loud for a while is no unit.

    Args:
        comparison: Recording and simulation.
        factor: Logarithms of the factors of all, `(sensor,)`.
    """

    def level(signal: Tensor) -> Tensor:
        stretches = signal.tensor_split(32, -1)
        return torch.stack([part.diff().square().mean(-1).log() for part in stretches]).median(0).values

    over = (level(comparison.recording) - level(comparison.reference.signal).mean(0)) / 2
    return bool(((over - factor).abs() < _ALIKE).all())
