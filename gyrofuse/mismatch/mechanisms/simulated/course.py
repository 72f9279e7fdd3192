"""A course of the bias that only the simulation has: its own step, drift or warm-up, which the recording is without."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.exchanged import exchanged
from gyrofuse.mismatch.detectors.slow.simulated_course import may_have_a_course
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.slow.ramp import Ramp
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect
from gyrofuse.mismatch.mechanisms.slow.step import Step
from gyrofuse.mismatch.mechanisms.slow.warm_up import WarmUpTransient
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo


@dataclass(frozen=True, eq=False)
class SimulatedCourse(Mechanism):
    """`x_i(t) = y_i(t) - c_i(t)`: the simulation without the course `c` of its bias.

    Attributes:
        added: The course.
    """

    likelihood: ClassVar[str] = SlowEffect.likelihood
    happened_once: ClassVar[bool] = True
    of_samples: ClassVar[bool] = True
    kind: ClassVar[type[SlowEffect]]
    added: SlowEffect

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        if not may_have_a_course(comparison):
            return None
        found = cls.kind.detect_and_fit(exchanged(comparison), level)
        if found is None or not isinstance(found.effect, cls.kind) or not found.identified:
            return None
        return replace(found, effect=cls(found.effect), sentence=f"only in the simulation {found.sentence}")

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return self.added.remove(signal, info)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return self.added.held_out_scores(exchanged(comparison), fold)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        return replace(self, added=self.added.fit_without(exchanged(comparison), fold))

    def is_seen(self, comparison: Comparison) -> bool:
        return self.added.is_seen(exchanged(comparison))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        self.added.plot(exchanged(comparison), ax, sensor=sensor, fitted=fitted)
        legend = ax.get_legend()
        if legend is not None:  # the simulation is in the place of the recording
            legend.get_texts()[0].set_text("simulation")


@dataclass(frozen=True, eq=False)
class SimulatedStep(SimulatedCourse):
    """A step that only the simulation has."""

    name: ClassVar[str] = Step.name
    separated_by: ClassVar[str] = Step.separated_by
    kind: ClassVar[type[SlowEffect]] = Step
    added: Step


@dataclass(frozen=True, eq=False)
class SimulatedRamp(SimulatedCourse):
    """A drift in a line that only the simulation has."""

    name: ClassVar[str] = Ramp.name
    separated_by: ClassVar[str] = Ramp.separated_by
    kind: ClassVar[type[SlowEffect]] = Ramp
    added: Ramp


@dataclass(frozen=True, eq=False)
class SimulatedWarmUp(SimulatedCourse):
    """A warm-up that only the simulation has."""

    name: ClassVar[str] = WarmUpTransient.name
    separated_by: ClassVar[str] = WarmUpTransient.separated_by
    kind: ClassVar[type[SlowEffect]] = WarmUpTransient
    added: WarmUpTransient
