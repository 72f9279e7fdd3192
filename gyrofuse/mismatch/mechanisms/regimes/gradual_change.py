"""Noise that grows louder, or quieter, bit by bit: a change of variance of another form."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.noise_level import (
    compared_levels,
    modulation_of,
    own_spread,
    variance_p_value,
    whitened_recording,
)
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Parameter
from gyrofuse.mismatch.mechanisms.regimes.changing_variance import ChangingVariance
from gyrofuse.mismatch.mechanisms.regimes.variance_change import (
    goes_up_and_down,
    likeliest_episodes,
    worth_of_modulation,
)
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import Dims, OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.variance_course import (
    VarianceCourse,
    corner_of,
    fast_factor,
    fast_share,
    whitened_factor,
)
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.segments import course_scores, stretch_of
from gyrofuse.mismatch.stats.variance_courses import (
    Course,
    course_at_once,
    course_of,
    course_score,
    fitted_levels,
)

_NATS = 5.0  # by which it has to be likelier than episodes with a start and a stop
_FACTOR = 1.25  # by which, and by `_NATS`, a level that goes up and down all the time has to be likelier
_LEFT, _SHARE = 1e-3, 0.05  # p value of what still goes up and down beside the course, and its share of all that does
_KINK = 1e-12  # of a share from sample to sample, above rounding
_MOSTLY = 0.5  # of its way
_BEGUN = 0.05  # share of its way from which a course is said to have left its lower end, and not to have come back


@dataclass(frozen=True, eq=False)
class GradualChange(ChangingVariance):
    """`S_t(f) = (1 + (base factor^c(t) - 1) f^2/(f^2 + f_c^2)) S(f)`: what is fast is louder by a course `c`.

    The course rises to one peak and falls from it, either of which may be missing. A level that goes up and down more
    often has no name here.

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
        if score < once + _NATS or _goes_up_and_down(comparison, course, score):
            return None
        peak = course.share > _MOSTLY
        if bool(peak.all()) or not bool(peak.any()):
            return None
        known = _of_the_fast_noise(comparison, course, peak)
        share, factor, corner, base = known.course, known.factor, known.corner, _over_the_simulation(comparison, known)
        knots = torch.tensor([0, *(share.diff().diff().abs() > _KINK).nonzero()[:, 0] + 1, comparison.n_samples - 1])
        effect = cls(knots / rate, share[knots], base, factor, corner * rate)
        sensors = tuple((factor != 1).nonzero()[:, 0].tolist())
        reach = Z * course.log_factor_sd
        rises = float(share[peak].mean()) > float(share[~peak].mean())
        parameters, way = {}, _Way.of(course.share if rises else 1 - course.share, rate)
        for i in sensors:
            value, spread = float(factor[i]), math.exp(float(reach[i]))
            parameters[f"factor[{i}]"] = Parameter(value, value / spread, value * spread, "")
        return Finding(
            cls.name,
            effect,
            _sentence(comparison, way, factor, sensors),
            p_value,
            sensors,
            parameters,
            levels=(1,),
            time_s=(way.up or way.down or (0.0,))[0],
            gain=gain,
        )

    def fit_without(self, comparison: Comparison, fold: int) -> GradualChange:
        keep = estimation_samples(comparison.n_samples, fold)
        share = self._share(comparison.n_samples, comparison.info.rate)[keep]
        if float(share.max()) == float(share.min()):
            return self
        squares, concerned = whitened_recording(comparison).square()[:, keep], self.factor != 1
        _, log_factor, _ = fitted_levels(squares, share, concerned)
        corner = self.corner_hz / comparison.info.rate
        upper = fast_factor(whitened_factor(self.base, corner) * log_factor.exp(), corner)
        return replace(self, factor=torch.where(concerned, upper / self.base, 1.0))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        white = whitened_recording(comparison)
        scores = course_scores(white, self.course(comparison.n_samples, comparison.info.rate).variance)
        scores = torch.where((self.factor != 1)[:, None], own_spread(comparison).weight[:, None] * scores, 0.0)
        return held_out_blocks(scores, fold).sum((0, -1))

    def _share(self, n_samples: int, rate: float) -> Tensor:
        return torch.from_numpy(np.interp(np.arange(n_samples) / rate, self.time_s.numpy(), self.share.numpy()))

    def course(self, n_samples: int, rate: float) -> VarianceCourse:
        return VarianceCourse(self._share(n_samples, rate), self.factor, self.corner_hz / rate, self.base)


def _goes_up_and_down(comparison: Comparison, course: Course, score: float) -> bool:
    """Whether a level that is modulated all the time says more, or still says something beside the course."""
    always = worth_of_modulation(comparison)
    rest = modulation_of(whitened_recording(comparison) / course.variance.sqrt())
    return always > _FACTOR * score + _NATS or (rest.p_value < _LEFT and rest.log_ratio > _SHARE * always)


def _of_the_fast_noise(comparison: Comparison, course: Course, peak: Tensor) -> VarianceCourse:
    """What the fast noise does where whitened samples have a course, over its own mean.

    Whitened samples have slow noise as well, of which there is the more the quieter the fast one is.
    """
    level = course.variance / course.variance.mean(-1, keepdim=True)
    inside, outside = level[:, peak].mean(-1), level[:, ~peak].mean(-1)
    concerned = course.factor != 1
    # Where the fast noise is quieter than on average it sinks below the slow one at a higher frequency.
    corner = corner_of(comparison.observed.noise[0], peak, inside / outside) * float(outside[concerned].mean().sqrt())
    log_level = fast_factor(level, corner).log()
    base, log_factor = log_level[:, course.share.argmin()], log_level[:, course.share.argmax()]
    log_factor = torch.where(concerned, log_factor - base, 0.0)
    share = (log_factor @ (log_level - base[:, None]) / log_factor.square().sum()).clamp(0, 1)
    if float(share[0]) > _MOSTLY and float(share[-1]) < 1 - _MOSTLY:  # it goes one way: from what was to what came
        share, base, log_factor = 1 - share, base + log_factor, -log_factor
    return VarianceCourse(share, log_factor.exp(), corner, torch.where(concerned, base.exp(), 1.0))


def _over_the_simulation(comparison: Comparison, known: VarianceCourse) -> Tensor:
    """Variance of the fast noise where a course is 0, over that of the simulation if it has a level of its own."""
    if compared_levels(comparison) is None:
        return torch.as_tensor(known.base)
    observed, reference = replace(comparison.observed, loud=(*comparison.observed.loud, known)), comparison.reference
    fast = fast_share(comparison.bands.frequency, known.corner)
    weight = observed.dof * reference.dof / (observed.dof + reference.dof).clamp(min=1e-300) * fast
    over = ((observed.power / reference.power.clamp(min=1e-300)).clamp(min=1e-300).log() @ weight / weight.sum()).exp()
    return torch.where(known.factor != 1, known.base * over, 1.0)


class _Way(NamedTuple):
    """When a course goes up and down again, s; None where it does not."""

    up: tuple[float, float] | None
    down: tuple[float, float] | None

    @classmethod
    def of(cls, share: Tensor, rate: float) -> _Way:
        near = ((share > 1 - _BEGUN).nonzero()[:, 0] / rate).tolist()
        away = ((share > _BEGUN).nonzero()[:, 0] / rate).tolist()
        up, down = float(share[0]) < _MOSTLY, float(share[-1]) < _MOSTLY
        return cls((away[0], near[0]) if up else None, (near[-1], away[-1]) if down else None)


def _sentence(comparison: Comparison, way: _Way, factor: Tensor, sensors: tuple[int, ...]) -> str:
    largest = max(sensors, key=lambda i: abs(math.log(float(factor[i]))))
    words: list[str] = []
    value = float(factor[largest])
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
