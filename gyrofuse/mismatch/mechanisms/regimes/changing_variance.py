"""What segments and courses of a changing variance have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.variance_course import VarianceCourse

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class ChangingVariance(Mechanism):
    """Fast noise whose variance takes a course over the time of this recording."""

    name: ClassVar[str] = "variance_change"
    likelihood: ClassVar[str] = "regimes"
    rivals: ClassVar[tuple[str, ...]] = ("spikes",)
    separated_by: ClassVar[str] = "a longer recording with more than one change"
    happened_once: ClassVar[bool] = True
    changes_noise: ClassVar[bool] = True

    def course(self, n_samples: int, rate: float) -> VarianceCourse:
        """The course of the variance in a record of `n_samples` at a rate in Hz."""
        raise NotImplementedError

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        course = self.course(comparison.n_samples, comparison.info.rate).variance if fitted else None
        pictures.variance_over_time(ax, comparison, sensor, course)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return self.course(signal.shape[-1], info.rate).added(signal)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """At the same share of records that are longer or shorter, so that these have as much of the course."""
        return comparison.made_louder(self.course(comparison.n_samples, comparison.info.rate))
