"""Noise that grows louder, or quieter, bit by bit: a change of variance of another form."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.axes import Axes, OfSensors
from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.courses import (
    Course,
    course_at_once,
    course_of,
    course_scores,
    fitted_levels,
    interpolated,
    worth_of_course,
)
from gyrofuse.mismatch.episodes import stretch_of
from gyrofuse.mismatch.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.loudness import Loudness, corner_of, fast_factor, fast_share, whitened_factor
from gyrofuse.mismatch.mechanism import Finding, Mechanism, Parameter, Z
from gyrofuse.mismatch.mechanisms.variance_change import goes_up_and_down, likeliest_episodes, worth_of_modulation
from gyrofuse.mismatch.noise_level import compared_levels, levelled, modulation_of, own_spread, variance_p_value

_NATS = 5.0  # by which it has to be likelier than episodes with a start and a stop
_FACTOR = 1.25  # by which, and by `_NATS`, a level that goes up and down all the time has to be likelier
_LEFT, _SHARE = 1e-3, 0.05  # p value of what still goes up and down beside the course, and its share of all that does
_KINK = 1e-12  # of a share from sample to sample, above rounding
_MOSTLY = 0.5  # of its way
_BEGUN = 0.05  # share of its way from which a course is told to have left its lower end, and not to have come back


@dataclass(frozen=True, eq=False)
class GradualChange(Mechanism):
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

    name: ClassVar[str] = "variance_change"
    happened_once: ClassVar[bool] = True
    changes_noise: ClassVar[bool] = True
    time_s: Annotated[Tensor, Axes(("knot",))]
    share: Annotated[Tensor, Axes(("knot",))]
    base: OfSensors
    factor: OfSensors
    corner_hz: float

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        p_value = variance_p_value(case)
        if p_value > level:
            return None
        white, rate = levelled(case), case.scene.rate
        episodes = likeliest_episodes(case)
        start = stretch_of(white) if episodes is None else episodes
        course = course_of(white, start.factor.log())
        if course is None:
            return None
        weight = own_spread(case).weight
        gain = float(weight @ course_scores(white, course.variance).sum(-1))
        worth = worth_of_course(white, course, weight)
        once = 0.0
        if episodes is not None:
            at_once = course_at_once(white, episodes.inside(case.n_samples), episodes.factor != 1)
            once = worth_of_course(white, at_once, weight, len(episodes.episodes))
            if not goes_up_and_down(case, episodes):
                # A single one is a course as well: another that may be it has to gain more than orders do by chance.
                once += 2 * math.log(case.n_samples)
        if worth < once + _NATS or _goes_up_and_down(case, course, worth):
            return None
        peak = course.share > _MOSTLY
        if bool(peak.all()) or not bool(peak.any()):
            return None
        known = _of_the_fast_noise(case, course, peak)
        share, factor, corner, base = known.course, known.factor, known.corner, _over_the_simulation(case, known)
        knots = torch.tensor([0, *(share.diff().diff().abs() > _KINK).nonzero()[:, 0] + 1, case.n_samples - 1])
        effect = cls(knots / rate, share[knots], base, factor, corner * rate)
        sensors = tuple((factor != 1).nonzero()[:, 0].tolist())
        reach = Z * course.log_factor_sd
        parameters, way = {}, _Way.of(course.share, rate)
        for i in sensors:
            value, spread = float(factor[i]), math.exp(float(reach[i]))
            parameters[f"factor[{i}]"] = Parameter(value, value / spread, value * spread, "")
        return Finding(
            cls.name,
            effect,
            _sentence(case, way, factor, sensors),
            p_value,
            sensors,
            parameters,
            levels=(1,),
            time_s=(way.up or way.down or (0.0,))[0],
            gain=gain,
        )

    def refitted(self, case: Case, fold: int) -> GradualChange:
        keep = estimation_samples(case.n_samples, fold)
        share = self._share(case.n_samples, case.scene.rate)[keep]
        if float(share.max()) == float(share.min()):
            return self
        squares, concerned = levelled(case).square()[:, keep], self.factor != 1
        _, log_factor, _ = fitted_levels(squares, share, concerned)
        corner = self.corner_hz / case.scene.rate
        upper = fast_factor(whitened_factor(self.base, corner) * log_factor.exp(), corner)
        return replace(self, factor=torch.where(concerned, upper / self.base, 1.0))

    def simulated(self, signal: Tensor, scene: Scene, generator: torch.Generator) -> Tensor:
        return self._loudness(signal.shape[-1], scene.rate).added(signal)

    def explained(self, case: Case, generator: torch.Generator) -> Case:
        """At the same share of records that are longer or shorter."""
        return case.made_louder(self._loudness(case.n_samples, case.scene.rate))

    def gains(self, case: Case, fold: int) -> Tensor:
        white = levelled(case)
        scores = course_scores(white, self._loudness(case.n_samples, case.scene.rate).variance)
        scores = torch.where((self.factor != 1)[:, None], own_spread(case).weight[:, None] * scores, 0.0)
        return held_out_blocks(scores, fold).sum((0, -1))

    def _share(self, n_samples: int, rate: float) -> Tensor:
        at = torch.arange(n_samples, dtype=torch.float64) / rate
        return interpolated(at, self.time_s.tolist(), self.share.tolist())

    def _loudness(self, n_samples: int, rate: float) -> Loudness:
        return Loudness(self._share(n_samples, rate), self.factor, self.corner_hz / rate, self.base)


def _goes_up_and_down(case: Case, course: Course, worth: float) -> bool:
    """Whether a level that is modulated all the time says more, or still says something beside the course."""
    always = worth_of_modulation(case)
    rest = modulation_of(levelled(case) / course.variance.sqrt())
    return always > _FACTOR * worth + _NATS or (rest.p_value < _LEFT and rest.log_ratio > _SHARE * always)


def _of_the_fast_noise(case: Case, course: Course, peak: Tensor) -> Loudness:
    """What the fast noise does where whitened samples have a course, over its own mean.

    Whitened samples have slow noise as well, of which there is the more the quieter the fast one is.
    """
    level = course.variance / course.variance.mean(-1, keepdim=True)
    inside, outside = level[:, peak].mean(-1), level[:, ~peak].mean(-1)
    concerned = course.factor != 1
    # Where the fast noise is quieter than on average it sinks below the slow one at a higher frequency.
    corner = corner_of(case.recorded.noise[0], peak, inside / outside) * float(outside[concerned].mean().sqrt())
    log_level = fast_factor(level, corner).log()
    base, log_factor = log_level[:, course.share.argmin()], log_level[:, course.share.argmax()]
    log_factor = torch.where(concerned, log_factor - base, 0.0)
    share = (log_factor @ (log_level - base[:, None]) / log_factor.square().sum()).clamp(0, 1)
    return Loudness(share, log_factor.exp(), corner, torch.where(concerned, base.exp(), 1.0))


def _over_the_simulation(case: Case, known: Loudness) -> Tensor:
    """Variance of the fast noise where a course is 0, over that of the simulation if it has a level of its own."""
    if compared_levels(case) is None:
        return torch.as_tensor(known.base)
    recorded, simulated = replace(case.recorded, loud=(*case.recorded.loud, known)), case.simulated
    fast = fast_share(case.bands.frequency, known.corner)
    worth = recorded.dof * simulated.dof / (recorded.dof + simulated.dof).clamp(min=1e-300) * fast
    over = ((recorded.power / simulated.power.clamp(min=1e-300)).clamp(min=1e-300).log() @ worth / worth.sum()).exp()
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


def _sentence(case: Case, way: _Way, factor: Tensor, sensors: tuple[int, ...]) -> str:
    largest = max(sensors, key=lambda i: abs(math.log(float(factor[i]))))
    words: list[str] = []
    value = float(factor[largest])
    for stretch, other in ((way.up, value), (way.down, 1 / value)):
        if stretch is not None:
            after = "back" if words else f"to {other:.3g} times what it was"
            words.append(f"from {stretch[0]:.6g} s to {stretch[1]:.6g} s {after}")
    return (
        f"the noise's variance changes bit by bit {', and '.join(words)} (sensor {case.scene.sensors[largest]}) in "
        f"{case.scene.named(sensors, 'all sensors')}: its form is not quite one of the catalogue, where it does so at "
        "once"
    )
