"""Noise whose level follows an auxiliary channel: a motor's command, a rate of turn, a temperature, a vibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse._base.results import readable
from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.detectors.variance.noise_level import (
    modulation,
    modulation_of,
    own_spread,
    variance_p_value,
    whitened_recording,
)
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.regimes.changing_variance import (
    MOSTLY,
    LevelCourse,
    factor_limits,
    fast_levels,
    level_along,
    lines_of,
    of_the_fast_noise,
    over_the_simulation,
)
from gyrofuse.mismatch.mechanisms.regimes.variance_change import likeliest_episodes, worth_of_modulation
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims, OfSensors
from gyrofuse.mismatch.signals.variance_course import VarianceCourse
from gyrofuse.mismatch.stats.multiplicity import sidak
from gyrofuse.mismatch.stats.segments import course_scores
from gyrofuse.mismatch.stats.variance_courses import Course, course_at_once, course_score

_WORDS = {"level": "", "size": "the size of ", "vibration": "the vibration in "}


@dataclass(frozen=True, eq=False)
class ChannelNoise(LevelCourse):
    """`S_t(f) = (1 + (base factor^c(t) - 1) f^2/(f^2 + f_c^2)) S(f)`: what is fast is louder as a channel says.

    The course is `c = log(1 + k a)/log(1 + k)`, with `a` a channel's level, its size, or the root mean square of what
    it does faster, from 0 to 1; `c = a` for `k = 0`.

    Attributes:
        channel: Name of the channel.
        row: Position of its row.
        kind: `level`, `size` or `vibration`.
        ends: Values of the channel where the course is 0 and 1, its unit.
        bend: `k`.
        base: Of the variance where the course is 0, over the simulation's, `(sensor,)`.
        factor: Of the variance where it is 1 over that, `(sensor,)`; 1 where a sensor does not change.
        corner_hz: `f_c`; 0 where all noise but the mean is louder.
    """

    happened_once: ClassVar[bool] = False
    separated_by: ClassVar[str] = "a recording in which the channel has another course"
    channel: str
    row: int
    kind: str
    ends: Annotated[Tensor, Dims(("end",))]
    bend: float
    base: OfSensors
    factor: OfSensors
    corner_hz: float
    lines_hz: tuple[float, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        info = comparison.info
        if not info.channels:
            return None
        p_value = sidak(min(variance_p_value(comparison), modulation(comparison).p_value), 2)
        if p_value > level:
            return None
        white, weight = whitened_recording(comparison), own_spread(comparison).weight
        bends = (0.0, 1.0, 3.0, 10.0)  # with 1 a sd that grows in a line to twice what it was has a factor of 4
        tried = [
            (name, row, kind, values)
            for name in info.channels
            for row, values in enumerate(info.channel_rows(name))
            for kind, values in _courses(values).items()
        ]
        fitted = [
            (entry, level_along(white, _share(entry[-1], _ends(entry[-1]), 0.0)))
            for entry in tried
            if _moves(entry[-1])
        ]
        changing = [(course_score(white, course, weight), *entry) for entry, course in fitted if course is not None]
        if not changing:
            return None
        _, name, row, kind, values = max(changing, key=lambda one: one[0])
        ways = [(ends, bend) for ends in (_ends(values), _ends(values).flip(0)) for bend in bends]
        bent = [
            (course_score(white, course, weight), course)
            for ends, bend in ways
            if (course := level_along(white, _share(values, ends, bend))) is not None
        ]
        score, course = max(bent, key=lambda one: one[0])
        score -= math.log(len(tried) * len(bends))
        if score < score_of_episodes(comparison) + NATS_AS_GOOD or _still_goes_up_and_down(comparison, course):
            return None
        known = of_the_fast_noise(comparison, course, course.share > MOSTLY)
        known, (ends, bend) = _along(white, weight, known, values, ways)
        base = over_the_simulation(comparison, known)
        effect = cls(name, row, kind, ends, bend, base, known.factor, known.corner * info.rate, lines_of(comparison))
        sensors = tuple((known.factor != 1).nonzero()[:, 0].tolist())
        largest = max(sensors, key=lambda i: abs(math.log(float(known.factor[i]))))
        return effect.found(
            f"the noise's variance in {info.named(sensors, 'all sensors')} follows {_WORDS[kind]}{readable(name)}"
            f"{f' (row {row + 1})' if len(info.channel_rows(name)) > 1 else ''}: it changes by a factor of "
            f"{float(known.factor[largest]):.3g} (sensor {info.sensors[largest]}) from {float(ends[0]):.4g} to "
            f"{float(ends[1]):.4g} of it",
            p_value,
            sensors,
            factor_limits(known.factor, course),
            levels=(1,),
            channel=name,
            gain=float(weight @ course_scores(white, course.variance).sum(-1)),
        )

    @property
    def follows(self) -> tuple[str, ...]:
        return (self.channel,)

    def course(self, n_samples: int, info: RecordingInfo) -> VarianceCourse:
        known = VarianceCourse(self._share(info), self.factor, self.corner_hz / info.rate, self.base)
        return known.of_length(n_samples)

    def _share(self, info: RecordingInfo) -> Tensor:
        return _share(_courses(info.channel_rows(self.channel)[self.row])[self.kind], self.ends, self.bend)


def _courses(values: Tensor) -> Mapping[str, Tensor]:
    """What noise may follow of a row `(time,)` of a channel, by kind."""
    window, longer = 33, 129  # samples, for the channel itself and for its own noise
    level = _smooth(values, window)
    courses = {"level": level, "size": level.abs(), "vibration": _smooth((values - level).square(), longer).sqrt()}
    if float(level.min()) * float(level.max()) >= 0:  # its size is its level, up to a sign
        del courses["size"]
    return courses


def _smooth(values: Tensor, window: int) -> Tensor:
    """Means over a window about each sample, of those that it has."""
    reach = window // 2
    total = torch.nn.functional.pad(values.cumsum(0), (1, 0))
    at = torch.arange(len(values))
    low, high = (at - reach).clamp(min=0), (at + reach + 1).clamp(max=len(values))
    return (total[high] - total[low]) / (high - low)


def _moves(values: Tensor) -> bool:
    return bool(values.isfinite().all()) and float(values.max()) > float(values.min())


def _ends(values: Tensor) -> Tensor:
    return torch.stack([values.min(), values.max()])


def _share(values: Tensor, ends: Tensor, bend: float) -> Tensor:
    """The course of values `(time,)` from one end to the other."""
    straight = ((values - ends[0]) / (ends[1] - ends[0])).clamp(0, 1)
    return torch.log1p(bend * straight) / math.log1p(bend) if bend else straight


def _along(
    white: Tensor, weight: Tensor, known: VarianceCourse, values: Tensor, ways: Sequence[tuple[Tensor, float]]
) -> tuple[VarianceCourse, tuple[Tensor, float]]:
    """The course along a channel's values `(time,)` of the fast noise alone, with the likeliest of its ends and bends.

    What whitened samples have of the slow noise bends a straight course where the fast one is quiet.
    """
    concerned, found = known.factor != 1, list[tuple[float, VarianceCourse, tuple[Tensor, float]]]()
    mean = white.square().mean(-1, keepdim=True)
    for way in ways:
        share = _share(values, *way)
        base, log_factor = fast_levels(white, share, concerned, known.corner)
        one = replace(known, course=share, factor=log_factor.exp(), base=torch.where(concerned, base.exp(), 1.0))
        score = float(weight[concerned] @ course_scores(white, mean * one.variance).sum(-1)[concerned])
        found.append((score, one, way))
    return max(found, key=lambda entry: entry[0])[1:]


def score_of_episodes(comparison: Comparison) -> float:
    """Score of episodes with starts and stops, where there are any."""
    found = likeliest_episodes(comparison)
    if found is None:
        return 0.0
    white = whitened_recording(comparison)
    at_once = course_at_once(white, found.inside(comparison.n_samples), found.factor != 1)
    return course_score(white, at_once, own_spread(comparison).weight, len(found.episodes))


def _still_goes_up_and_down(comparison: Comparison, course: Course) -> bool:
    """Whether the level still goes up and down beside the course."""
    left, share = 1e-3, 0.1  # p value, and of what goes up and down without the course
    rest = modulation_of(whitened_recording(comparison) / course.variance.sqrt())
    return rest.p_value < left and rest.log_ratio > share * worth_of_modulation(comparison)
