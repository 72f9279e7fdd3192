"""What segments and courses of a changing variance have in common."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.noise_level import compared_levels, own_spread, whitened_recording
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.signals.variance_course import (
    VarianceCourse,
    fast_factor,
    fast_share,
    likely_corners,
    mean_fast_share,
)
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.segments import course_scores
from gyrofuse.mismatch.stats.variance_courses import Course, fitted_levels, levels_above

MOSTLY = 0.5  # of the way of a course


class ChangingVariance(Mechanism):
    """Fast noise whose variance takes a course over the time of this recording.

    Attributes:
        lines_hz: Lines of the simulation, which are no noise and stay as they are.
    """

    name: ClassVar[str] = "variance_change"
    likelihood: ClassVar[str] = "regimes"
    rivals: ClassVar[tuple[str, ...]] = ("spikes",)
    separated_by: ClassVar[str] = "a longer recording with more than one change"
    happened_once: ClassVar[bool] = True
    changes_noise: ClassVar[bool] = True
    lines_hz: tuple[float, ...]

    def course(self, n_samples: int, info: RecordingInfo) -> VarianceCourse:
        """The course of the variance in a record of `n_samples`."""
        raise NotImplementedError

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        course = self.course(comparison.n_samples, comparison.info).variance if fitted else None
        pictures.variance_over_time(ax, comparison, sensor, course)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        lines = tuple(f / info.rate for f in self.lines_hz)
        return self.course(signal.shape[-1], info).added(signal, lines)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """At the same share of records that are longer or shorter, so that these have as much of the course."""
        return comparison.made_louder(self.course(comparison.n_samples, comparison.info))


def lines_of(comparison: Comparison) -> tuple[float, ...]:
    """Lines of the simulation that stand still, Hz."""
    return tuple(f * comparison.info.rate for f in comparison.reference.lines)


class LevelCourse(ChangingVariance):
    """One whose variance is `base factor^c(t)` times that of the simulation, with a course `c` from 0 to 1."""

    base: Tensor
    factor: Tensor
    corner_hz: float

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        keep = estimation_samples(comparison.n_samples, fold)
        share = self.course(comparison.n_samples, comparison.info).course[keep]
        if float(share.max()) == float(share.min()):
            return self
        white, concerned = whitened_recording(comparison)[:, keep], self.factor != 1
        _, log_factor = fast_levels(white, share, concerned, self.corner_hz / comparison.info.rate)
        return replace(self, factor=torch.where(concerned, log_factor.exp(), 1.0))  # type: ignore[type-var]

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        course = self.course(comparison.n_samples, comparison.info)
        scores = course_scores(whitened_recording(comparison), course.variance)
        scores = torch.where((self.factor != 1)[:, None], own_spread(comparison).weight[:, None] * scores, 0.0)
        return held_out_blocks(scores, fold).sum((0, -1))


def of_the_fast_noise(comparison: Comparison, course: Course, peak: Tensor) -> VarianceCourse:
    """What the fast noise does where whitened samples have a course, over its own mean.

    Whitened samples have slow noise as well, of which there is the more the quieter the fast one is.

    Args:
        comparison: Recording and simulation.
        course: Course of the level of the whitened recording.
        peak: Samples that are nearer to its peak, `(time,)`.
    """
    level = course.variance / course.variance.mean(-1, keepdim=True)
    inside, outside = level[:, peak].mean(-1), level[:, ~peak].mean(-1)
    concerned = course.factor != 1
    # Where the fast noise is quieter than on average it sinks below the slow one at a higher frequency.
    deeper = float(outside[concerned].mean().sqrt())
    corner = deeper * _corner_of(comparison, peak, inside / outside, concerned)
    log_level = fast_factor(level, corner).log()
    base, log_factor = log_level[:, course.share.argmin()], log_level[:, course.share.argmax()]
    log_factor = torch.where(concerned, log_factor - base, 0.0)
    share = (log_factor @ (log_level - base[:, None]) / log_factor.square().sum()).clamp(0, 1)
    base, log_factor = fast_levels(whitened_recording(comparison), share, concerned, corner)
    if float(share[0]) > MOSTLY and float(share[-1]) < 1 - MOSTLY:  # it goes one way: from what was to what came
        share, base, log_factor = 1 - share, base + log_factor, -log_factor
    return VarianceCourse(share, log_factor.exp(), corner, torch.where(concerned, base.exp(), 1.0))


def fast_levels(white: Tensor, share: Tensor, concerned: Tensor, corner: float) -> tuple[Tensor, Tensor]:
    """Log variance of the fast noise over its mean where a course is 0, and its change to where it is 1, `(sensor,)`.

    Args:
        white: Samples that are whitened as they are on average, `(sensor, time)`: slow noise is a part that is steady.
        share: Course, `(time,)`.
        concerned: Sensors that change, `(sensor,)`.
        corner: Where slow noise is as strong as fast noise is on average, cycles per sample.
    """
    squares, fast = white.square(), mean_fast_share(corner)
    mean = squares.mean(-1)
    base, change = levels_above(squares, share, concerned, (1 - fast) * mean)
    return base - (fast * mean).log(), change


def _corner_of(comparison: Comparison, peak: Tensor, ratio: Tensor, concerned: Tensor) -> float:
    """The likely corner with which slow noise is as strong as the simulation's, where that has a level of its own."""
    corners = likely_corners(comparison.observed.noise[0], peak, ratio)
    if compared_levels(comparison) is None:
        return corners[0]
    observed, reference, frequency = comparison.observed, comparison.reference, comparison.bands.frequency
    weight = observed.dof * reference.dof / (observed.dof + reference.dof).clamp(min=1e-300)
    apart = (observed.log_power - reference.log_power)[concerned].nan_to_num(0.0, 0.0, 0.0)

    def misfit(corner: float) -> float:
        fast = fast_share(frequency, corner)
        louder = (apart @ (weight * fast) / (weight @ fast)).exp() - 1
        return float((apart - torch.log1p(louder[:, None] * fast)).square().sum(0) @ weight)

    return min(corners, key=misfit)


def over_the_simulation(comparison: Comparison, known: VarianceCourse) -> Tensor:
    """Variance of the fast noise where a course is 0, over that of the simulation if it has a level of its own."""
    if compared_levels(comparison) is None:
        return torch.as_tensor(known.base)
    observed = replace(comparison.observed, loud=(*comparison.observed.loud, known))
    over = fast_power_over(observed, comparison.reference, known.corner)
    return torch.where(known.factor != 1, known.base * over, 1.0)


def fast_power_over(observed: Records, reference: Records, corner: float) -> Tensor:
    """Power of the fast noise over that of other records, a mean over bands of the logarithm, `(sensor,)`."""
    fast = fast_share(observed.bands.frequency, corner)
    weight = observed.dof * reference.dof / (observed.dof + reference.dof).clamp(min=1e-300) * fast
    log_ratio = (observed.power / reference.power.clamp(min=1e-300)).clamp(min=1e-300).log()
    return (log_ratio @ weight / weight.sum()).exp()


def level_along(white: Tensor, share: Tensor) -> Course | None:
    """The level that whitened samples have along a course `(time,)`; None where it does not change."""
    squares = white.square()
    every = torch.ones(len(white), dtype=torch.bool)
    _, change, sd = fitted_levels(squares, share, every)
    known = 3.0  # standard deviations
    concerned = change.abs() > known * sd
    if not bool(concerned.any()):
        return None
    base, change, sd = fitted_levels(squares, share, concerned)
    return Course(share, base.exp(), change.exp(), sd)


def as_it_goes(known: VarianceCourse, course: Course) -> VarianceCourse:
    """A course that was turned round, so that it ends where it began, the other way again."""
    if float(known.course[course.share.argmax()]) >= float(known.course[course.share.argmin()]):
        return known
    base = torch.as_tensor(known.base) * known.factor
    return replace(known, course=1 - known.course, factor=1 / known.factor, base=base)


def factor_limits(factor: Tensor, course: Course) -> dict[str, Parameter]:
    """Factors `(sensor,)` of the sensors that change, with the limits that those of a course have."""
    changing = (factor != 1).nonzero()[:, 0].tolist()
    reach = Z * course.log_factor_sd
    return {f"factor[{i}]": Parameter.within(float(factor[i]), math.exp(float(reach[i])), "") for i in changing}
