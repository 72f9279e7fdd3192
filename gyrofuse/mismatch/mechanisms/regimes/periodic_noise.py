"""Noise that is louder and quieter with a period: what turns, a heater that switches, a supply that pulses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse._base.axes import DASHED, INK, finish
from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.decisions import NATS_AS_GOOD, NATS_PER_NUMBER
from gyrofuse.mismatch.detectors.variance.noise_level import (
    clipped_squares,
    modulation,
    own_spread,
    whitened_recording,
)
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.regimes.changing_variance import (
    MOSTLY,
    LevelCourse,
    as_it_goes,
    factor_limits,
    level_along,
    lines_of,
    of_the_fast_noise,
    over_the_simulation,
)
from gyrofuse.mismatch.mechanisms.regimes.channel_noise import score_of_episodes
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims, OfSensors
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.signals.variance_course import VarianceCourse
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.segments import course_scores
from gyrofuse.mismatch.stats.variance_courses import Course, course_score


@dataclass(frozen=True, eq=False)
class PeriodicNoise(LevelCourse):
    """`S_t(f) = (1 + (base factor^c(t) - 1) f^2/(f^2 + f_c^2)) S(f)` with a course `c` of one period: cyclostationary.

    Of sensors that are louder at the same times. The course is that of a few harmonics.

    Attributes:
        frequency_hz: Of the period.
        profile: The course at phases evenly over the period from that of the first sample on, `(phase,)`, 0 to 1.
        base: Of the variance where the course is 0, over the simulation's, `(sensor,)`.
        factor: Of the variance where it is 1 over that, `(sensor,)`; 1 where a sensor does not change.
        corner_hz: `f_c`; 0 where all noise but the mean is louder.
    """

    happened_once: ClassVar[bool] = False
    frequency_hz: float
    profile: Annotated[Tensor, Dims(("phase",))]
    base: OfSensors
    factor: OfSensors
    corner_hz: float
    lines_hz: tuple[float, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        seen, info = modulation(comparison), comparison.info
        line = _line(comparison, list(seen.sensors)) if seen.p_value <= level else None
        if line is None:
            return None
        f, power = line
        parts = _harmonics(comparison, f, list(seen.sensors))
        white, weight = whitened_recording(comparison), own_spread(comparison).weight
        tried = list[tuple[float, Tensor, Course]]()
        for harmonics in (1, 2, 4, len(parts)):
            profile = _profile(parts[:harmonics])
            course = level_along(white, _at(profile, f, comparison.n_samples))
            if course is not None:
                cost = 2 * NATS_PER_NUMBER * (harmonics - 1)
                tried.append((course_score(white, course, weight) - cost, profile, course))
        if not tried:
            return None
        score, profile, course = max(tried, key=lambda one: one[0])
        if score < score_of_episodes(comparison) + NATS_AS_GOOD:
            return None
        known = as_it_goes(of_the_fast_noise(comparison, course, course.share > MOSTLY), course)
        base = over_the_simulation(comparison, known)
        effect = cls(f * info.rate, profile, base, known.factor, known.corner * info.rate, lines_of(comparison))
        reach = Z * math.sqrt(6 / power) / (2 * math.pi * comparison.n_samples) * info.rate
        frequency = Parameter.around(f * info.rate, reach, "Hz", least=0.0)
        sensors = tuple((known.factor != 1).nonzero()[:, 0].tolist())
        largest = max(sensors, key=lambda i: abs(math.log(float(known.factor[i]))))
        return effect.found(
            f"the noise's variance goes up and down at {f * info.rate:.5g} Hz in "
            f"{info.named(sensors, 'all sensors')}, by a factor of up to {float(known.factor[largest]):.3g} "
            f"(sensor {info.sensors[largest]})",
            seen.p_value,
            sensors,
            {"frequency": frequency, **factor_limits(known.factor, course)},
            levels=(1,),
            frequency_hz=f * info.rate,
            gain=float(weight @ course_scores(white, course.variance).sum(-1)),
        )

    def course(self, n_samples: int, info: RecordingInfo) -> VarianceCourse:
        share = _at(self.profile, self.frequency_hz / info.rate, n_samples)
        return VarianceCourse(share, self.factor, self.corner_hz / info.rate, self.base)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        """From another phase on."""
        turned = int(torch.randint(len(self.profile), (), generator=generator))
        return super(PeriodicNoise, replace(self, profile=self.profile.roll(turned))).apply(signal, info, generator)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        """Variance over the phase of the period."""
        phases, n = 64, comparison.n_samples
        turns = torch.remainder(torch.arange(n, dtype=torch.float64) * self.frequency_hz / comparison.info.rate, 1.0)
        bins, at = (turns * phases).long() % phases, (torch.arange(phases) + 0.5) / phases

        def folded(values: Tensor) -> Tensor:
            count = torch.bincount(bins, minlength=phases).clamp(min=1)
            return torch.zeros(phases, dtype=values.dtype).index_add(0, bins, values) / count

        white = whitened(comparison.observed.steady[0], comparison.base)
        level = folded(white[sensor].square())
        handles = ax.plot(at.numpy(), level.numpy(), color=INK, marker="o", markersize=3, linestyle="none")
        if fitted:
            course = folded(self.course(n, comparison.info).variance[sensor])
            handles += ax.plot(at.numpy(), (course * level.mean() / course.mean()).numpy(), **DASHED)
        ax.set_xlabel(f"phase of the period of {self.frequency_hz:.4g} Hz")
        ax.set_ylabel("variance over the simulation's")
        finish(ax, handles, ["recording", "fitted"][: len(handles)])


def _at(profile: Tensor, f: float, n_samples: int) -> Tensor:
    """A periodic course `(time,)` of a frequency of cycles per sample, on straight lines between its phases."""
    place = torch.remainder(torch.arange(n_samples, dtype=torch.float64) * f, 1.0) * len(profile)
    before = place.long() % len(profile)
    rest = place - place.floor()
    return (1 - rest) * profile[before] + rest * profile[(before + 1) % len(profile)]


def _line(comparison: Comparison, sensors: list[int]) -> tuple[float, float] | None:
    """Frequency of the strongest line of the squares of sensors, and its power over that of their noise.

    None where it does not stand out of what is next to it, as where a level wanders, or has a few cycles.
    """
    fewest, plain, beside = 4, 12.0, torch.arange(3, 15)  # cycles; times the mean power of bins on either side
    n, squares = comparison.n_samples, _together(comparison, sensors)
    power = squared_modulus(torch.fft.rfft(squares))
    power[:fewest] = 0.0
    at = int(power.argmax())
    around = torch.cat([at - beside, at + beside])
    around = around[(around > 0) & (around < len(power))]
    if float(power[at]) < plain * float(power[around].mean()):
        return None
    f, t = at / n, torch.arange(n, dtype=torch.float64)
    for step in (0.1, 0.01, 0.001):  # bins
        tried = f + torch.arange(-10, 11, dtype=torch.float64) * step / n
        sizes = torch.stack([squared_modulus(torch.polar(squares, -2 * math.pi * one * t).sum()) for one in tried])
        f = float(tried[sizes.argmax()])
    return f, float(sizes.max()) / float(squares.square().sum())


def _together(comparison: Comparison, sensors: list[int]) -> Tensor:
    """Squares of the whitened samples of sensors, each over its mean, less one, `(time,)`."""
    squares = clipped_squares(comparison)[sensors]
    return (squares / squares.mean(-1, keepdim=True)).mean(0) - 1


def _harmonics(comparison: Comparison, f: float, sensors: list[int]) -> list[Tensor]:
    """Complex amplitudes of the first harmonics of a frequency in the squares of sensors."""
    most, t = 16, torch.arange(comparison.n_samples, dtype=torch.float64)
    squares = _together(comparison, sensors)
    return [torch.polar(squares, -2 * math.pi * k * f * t).mean() for k in range(1, most + 1)]


def _profile(parts: list[Tensor]) -> Tensor:
    """The logarithm of the level over a period by its first harmonics, from 0 to 1, `(phase,)`."""
    phases, least = 64, 0.05  # of the mean level
    at = torch.arange(phases, dtype=torch.float64) / phases
    level = torch.ones(phases, dtype=torch.float64)
    for k, part in enumerate(parts, 1):
        level = level + 2 * (part * torch.polar(torch.ones_like(at), 2 * math.pi * k * at)).real
    logs = level.clamp(min=least).log()
    return (logs - logs.min()) / (logs.max() - logs.min()).clamp(min=1e-300)
