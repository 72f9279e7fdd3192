"""Noise that grows louder, or quieter, bit by bit: a change of variance of another form."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.noise_level import (
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
    lines_of,
    of_the_fast_noise,
    over_the_simulation,
)
from gyrofuse.mismatch.mechanisms.regimes.variance_change import (
    goes_up_and_down,
    likeliest_episodes,
    worth_of_modulation,
)
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims, OfSensors
from gyrofuse.mismatch.signals.variance_course import (
    VarianceCourse,
)
from gyrofuse.mismatch.stats.segments import course_scores, stretch_of
from gyrofuse.mismatch.stats.variance_courses import (
    Course,
    course_at_once,
    course_of,
    course_score,
    waves_of,
)

_NATS = 5.0  # by which it has to be likelier than episodes with a start and a stop
_FACTOR = 1.25  # by which, and by `_NATS`, a level that goes up and down all the time has to be likelier
_LEFT, _SHARE = 1e-3, 0.05  # p value of what still goes up and down beside the course, and its share of all that does
_KINK = 1e-12  # of a share from sample to sample, above rounding
_BEGUN = 0.05  # share of its way from which a course is said to have left its lower end, and not to have come back


@dataclass(frozen=True, eq=False)
class GradualChange(LevelCourse):
    """`S_t(f) = (1 + (base factor^c(t) - 1) f^2/(f^2 + f_c^2)) S(f)`: what is fast is louder by a course `c`.

    The course rises to one peak and falls from it, either of which may be missing, or takes some waves. A level that
    goes up and down all the time has no name here.

    Attributes:
        time_s: Knots of the course, s after the first sample, `(knot,)`.
        share: The course there, from 0 to 1, on straight lines in between, `(knot,)`.
        base: Of the variance where the course is 0, over the simulation's, `(sensor,)`.
        factor: Of the variance where it is 1 over that, `(sensor,)`; 1 where a sensor does not change.
        corner_hz: `f_c`; 0 where all noise but the mean is louder.
    """

    time_s: Annotated[Tensor, Dims(("knot",))]
    share: Annotated[Tensor, Dims(("knot",))]
    base: OfSensors
    factor: OfSensors
    corner_hz: float
    lines_hz: tuple[float, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = variance_p_value(comparison)
        if p_value > level:
            return None
        white, rate = whitened_recording(comparison), comparison.info.rate
        episodes = likeliest_episodes(comparison)
        start = stretch_of(white) if episodes is None else episodes
        course = course_of(white, start.factor.log())
        if course is None:
            return None
        weight = own_spread(comparison).weight
        gain = float(weight @ course_scores(white, course.variance).sum(-1))
        score = course_score(white, course, weight)
        once = 0.0
        if episodes is not None:
            at_once = course_at_once(white, episodes.inside(comparison.n_samples), episodes.factor != 1)
            once = course_score(white, at_once, weight, len(episodes.episodes))
            if not goes_up_and_down(comparison, episodes):
                # A single one is a course as well: another that may be it has to gain more than orders do by chance.
                once += 2 * math.log(comparison.n_samples)
        waves = False
        if score < once + _NATS or _goes_up_and_down(comparison, course, score):
            several = waves_of(white, start.factor.log(), weight)
            if several is None or several[1] < max(once, score) + _NATS or _goes_up_and_down(comparison, *several):
                return None
            waves, (course, _) = True, several
            gain = float(weight @ course_scores(white, course.variance).sum(-1))
        peak = course.share > MOSTLY
        if bool(peak.all()) or not bool(peak.any()):
            return None
        known = of_the_fast_noise(comparison, course, peak)
        share, factor, corner, base = known.course, known.factor, known.corner, over_the_simulation(comparison, known)
        knots = torch.tensor([0, *(share.diff().diff().abs() > _KINK).nonzero()[:, 0] + 1, comparison.n_samples - 1])
        effect = cls(knots / rate, share[knots], base, factor, corner * rate, lines_of(comparison))
        sensors = tuple((factor != 1).nonzero()[:, 0].tolist())
        rises = float(share[peak].mean()) > float(share[~peak].mean())
        way = _Way.of(course.share if rises else 1 - course.share, rate)
        return effect.found(
            _sentence(comparison, None if waves else way, factor, sensors),
            p_value,
            sensors,
            factor_limits(factor, course),
            levels=(1,),
            time_s=(way.up or way.down or (0.0,))[0],
            gain=gain,
        )

    def _share(self, n_samples: int, rate: float) -> Tensor:
        return torch.from_numpy(np.interp(np.arange(n_samples) / rate, self.time_s.numpy(), self.share.numpy()))

    def course(self, n_samples: int, info: RecordingInfo) -> VarianceCourse:
        return VarianceCourse(self._share(n_samples, info.rate), self.factor, self.corner_hz / info.rate, self.base)


def _goes_up_and_down(comparison: Comparison, course: Course, score: float) -> bool:
    """Whether a level that is modulated all the time says more, or still says something beside the course."""
    always = worth_of_modulation(comparison)
    rest = modulation_of(whitened_recording(comparison) / course.variance.sqrt())
    return always > _FACTOR * score + _NATS or (rest.p_value < _LEFT and rest.log_ratio > _SHARE * always)


class _Way(NamedTuple):
    """When a course goes up and down again, s; None where it does not."""

    up: tuple[float, float] | None
    down: tuple[float, float] | None

    @classmethod
    def of(cls, share: Tensor, rate: float) -> _Way:
        near = ((share > 1 - _BEGUN).nonzero()[:, 0] / rate).tolist()
        away = ((share > _BEGUN).nonzero()[:, 0] / rate).tolist()
        up, down = float(share[0]) < MOSTLY, float(share[-1]) < MOSTLY
        return cls((away[0], near[0]) if up else None, (near[-1], away[-1]) if down else None)


def _sentence(comparison: Comparison, way: _Way | None, factor: Tensor, sensors: tuple[int, ...]) -> str:
    """Of what goes one way and perhaps back; None of what does so more often."""
    largest = max(sensors, key=lambda i: abs(math.log(float(factor[i]))))
    words: list[str] = []
    value = float(factor[largest])
    if way is None:
        words.append(f"up and down, by a factor of up to {max(value, 1 / value):.3g}")
        way = _Way(None, None)
    for stretch, other in ((way.up, value), (way.down, 1 / value)):
        if stretch is not None:
            after = "back" if words else f"to {other:.3g} times what it was"
            words.append(f"from {stretch[0]:.6g} s to {stretch[1]:.6g} s {after}")
    info = comparison.info
    return (
        f"the noise's variance changes bit by bit {', and '.join(words)} (sensor {info.sensors[largest]}) in "
        f"{info.named(sensors, 'all sensors')}: its form is not quite one of the catalogue, where it does so at "
        "once"
    )
