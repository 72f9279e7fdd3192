"""Noise that is louder, or quieter, for a while."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.noise_level import (
    clipped_squares,
    compared_levels,
    level_between,
    modulation,
    modulation_of,
    own_spread,
    variance_p_value,
    whitened_recording,
)
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.regimes.changing_variance import ChangingVariance, lines_of
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.signals.variance_course import VarianceCourse, corner_of, fast_factor, whitened_factor
from gyrofuse.mismatch.stats.level_scan import Reference, scanned_levels
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.segments import (
    Episodes,
    Limits,
    SegmentPosterior,
    episodes_of,
    first_segment_posterior,
    log_factors,
    stretch_of,
    two_level_scores,
)

_FACTOR = 1.25  # by which, and by `_NATS`, a level that goes up and down all the time has to be likelier
_NATS = 5.0
_A_LOT = 100.0  # nats from which a level that goes up and down shows beside the episodes that stand for it
_LEFT, _SHARE = 1e-3, 0.05  # p value of that, and its share of all that is said
_ONE_MORE, _MORE = 0.4, 3  # share of that which a further episode says, if there is one, and how many may be
_KNOWN = 1.0  # standard deviations of a factor's logarithm from 0, wherever the episode is
_SHORT = 8  # samples


@dataclass(frozen=True, eq=False)
class VarianceChange(ChangingVariance):
    """`S_t(f) = (1 + (factor - 1) f^2/(f^2 + f_c^2)) S(f)` within episodes: what is fast is louder.

    Looks like heavy tails; its loud samples lie together. A level that wanders or oscillates all the time has no start
    and no stop: where that is likelier by far it has no name here.

    Attributes:
        episodes: Starts and stops, s after the first sample.
        factor: `(sensor,)`, of the variance within; 1 where a sensor does not change.
        corner_hz: `f_c`; 0 where all noise but the mean is louder.
    """

    episodes: tuple[tuple[float, float], ...]
    factor: OfSensors
    corner_hz: float = 0.0
    lines_hz: tuple[float, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = variance_p_value(comparison)
        if p_value > level:
            return None
        white, found = whitened_recording(comparison), likeliest_episodes(comparison)
        if found is None or goes_up_and_down(comparison, found) or _left_over(comparison, found):
            return None
        held = _held(comparison, found) or _held(comparison, stretch_of(white))
        if held is None:
            return None  # some segment has another level, but which and what level is not known
        found, reference, posterior = held
        rate = comparison.info.rate
        corner = corner_of(comparison.observed.noise[0], found.inside(comparison.n_samples), found.factor)
        episodes = tuple((e.start / rate, e.stop / rate) for e in found.episodes)
        factor = torch.where(found.factor != 1, fast_factor(found.factor, corner), 1.0)
        effect = cls(episodes, factor, corner * rate, lines_of(comparison))
        sensors = tuple((found.factor != 1).nonzero()[:, 0].tolist())
        parameters = {
            name: _time(limits, rate) for name, limits in (("start", posterior.start), ("stop", posterior.stop))
        }
        for i, value, sd in zip(sensors, posterior.log_factor.tolist(), posterior.log_factor_sd.tolist(), strict=True):
            limits = torch.tensor([value, value - Z * sd, value + Z * sd], dtype=torch.float64).exp()
            middle, low, high = fast_factor(limits, corner).tolist()
            parameters[f"factor[{i}]"] = Parameter(middle, low, high, "")
        scores = two_level_scores(white, found.factor, found.inside(comparison.n_samples), reference)
        gain = float(own_spread(comparison).weight @ scores.sum(-1))
        largest = max(sensors, key=lambda i: abs(math.log(parameters[f"factor[{i}]"].value)))
        where = comparison.info.named(sensors, "all sensors")
        more = f" and {len(found.episodes) - 1} more times" if len(found.episodes) > 1 else ""
        return effect.found(
            f"the noise's variance is {parameters[f'factor[{largest}]'].value:.3g} times the rest (sensor "
            f"{comparison.info.sensors[largest]}) from {parameters['start'].value:.6g} s "
            f"to {parameters['stop'].value:.6g} s{more} in {where}",
            p_value,
            sensors,
            parameters,
            levels=(1,),
            alternatives=_alternatives(comparison, found),
            time_s=parameters["start"].value,
            gain=gain,
        )

    def fit_without(self, comparison: Comparison, fold: int) -> VarianceChange:
        keep = estimation_samples(comparison.n_samples, fold)
        inside = self._inside(comparison.n_samples, comparison.info.rate)
        if not bool(inside[keep].any()) or bool(inside[keep].all()):
            return self
        log_factor, _ = log_factors(
            whitened_recording(comparison)[:, keep].square(), inside[keep], level_between(comparison, inside)
        )
        fast = fast_factor(log_factor.exp(), self.corner_hz / comparison.info.rate)
        return replace(self, factor=torch.where(self.factor != 1, fast, 1.0))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        inside = self._inside(comparison.n_samples, comparison.info.rate)
        factor = whitened_factor(self.factor, self.corner_hz / comparison.info.rate)
        scores = two_level_scores(whitened_recording(comparison), factor, inside, level_between(comparison, inside))
        scores = own_spread(comparison).weight[:, None] * scores
        return held_out_blocks(scores, fold).sum((0, -1))

    def course(self, n_samples: int, info: RecordingInfo) -> VarianceCourse:
        return VarianceCourse(self._inside(n_samples, info.rate), self.factor, self.corner_hz / info.rate)

    def _inside(self, n_samples: int, rate: float) -> Tensor:
        within = torch.zeros(n_samples, dtype=torch.bool)
        for start, stop in self.episodes:
            within[round(start * rate) : round(stop * rate)] = True
        return within


def _held(comparison: Comparison, found: Episodes) -> tuple[Episodes, Reference | None, SegmentPosterior] | None:
    """Episodes whose level is known, with what is known of it and of that between them.

    A few wild samples may be likelier than any other stretch, and yet not likelier than all others together: then
    which segment has another level is not known.
    """
    found, white = _from_the_simulated_level(comparison, found), whitened_recording(comparison)
    sensors = (found.factor != 1).nonzero()[:, 0].tolist()
    if not sensors:
        return None
    reference = level_between(comparison, found.inside(comparison.n_samples))
    posterior = first_segment_posterior(
        white[sensors], found.episodes, None if reference is None else reference.of(sensors)
    )
    known = float((posterior.log_factor.abs() / posterior.log_factor_sd).max()) > _KNOWN
    return (found, reference, posterior) if known else None


def _left_over(comparison: Comparison, found: Episodes) -> bool:
    """Whether it is left of something so much louder that was taken off, whose form was not quite the one assumed."""
    if comparison.observed is comparison.as_came:
        return False
    much = 30.0  # times the energy of what is there
    taken = whitened(comparison.taken_off, comparison.base)
    inside, has = found.inside(comparison.n_samples), found.factor > 1
    return bool(has.any()) and float(taken[has][:, inside].square().sum()) > much * float(
        comparison.white[has][:, inside].square().sum()
    )


@derived
def likeliest_episodes(comparison: Comparison) -> Episodes | None:
    """Segments beside the level of the simulation, if any, or of the recording by itself."""
    return _against_the_simulation(comparison) or episodes_of(whitened_recording(comparison))


def worth_of_modulation(comparison: Comparison) -> float:
    """Log likelihood ratio of a level that goes up and down all the time, nats."""
    wave = modulation(comparison)
    return max(-math.log(max(wave.p_value, 1e-300)), wave.log_ratio)


def _against_the_simulation(comparison: Comparison) -> Episodes | None:
    """Segments beside the level of the simulation, where the recording has that level between them."""
    compared = compared_levels(comparison)
    if compared is None or compared.p_value == 1:
        return None
    found = episodes_of(whitened_recording(comparison), compared.reference)
    return None if found is None or level_between(comparison, found.inside(comparison.n_samples)) is None else found


def _alternatives(comparison: Comparison, found: Episodes) -> tuple[str, ...]:
    """What else it could be: outliers, where it is short, and another level throughout, where little else speaks."""
    compared, alone = (
        compared_levels(comparison),
        scanned_levels(clipped_squares(comparison)).log_ratio,
    )
    shifted = compared is not None and compared.scan.log_ratio < compared.throughout + _NATS and alone < _NATS
    short = max(e.stop - e.start for e in found.episodes) < _SHORT
    return (*(("spikes",) if short else ()), *(("parameter_shift",) if shifted else ()))


def _from_the_simulated_level(comparison: Comparison, found: Episodes) -> Episodes:
    """Segments with both levels exchanged, where the simulation has the level that was taken for the changed one.

    In the sensors that change: another one may differ from the simulation throughout.
    """
    inside = found.inside(comparison.n_samples)
    squares, reference = comparison.white[found.factor != 1].square(), comparison.reference.signal
    share = comparison.n_samples / (reference.shape[0] * reference.shape[-1])

    def off(part: Tensor) -> float:
        """Nats by which the level differs from the simulation's."""
        return float(squares[:, part].mean(-1).log().square().sum() * part.sum() / 4 / (1 + share))

    return found.other_way_round(comparison.n_samples) if off(~inside) > off(inside) + _NATS else found


def goes_up_and_down(comparison: Comparison, found: Episodes) -> bool:
    """Whether a level that is modulated all the time says more than episodes with a start and a stop.

    By far, but where the level is not the simulation's between episodes either. If a lot is said, where the level still
    goes up and down beside the episodes, and few further ones do not explain that: gains of modulations take squares
    for normal, and are wrong where the level changes by much.
    """
    n, inside, always = comparison.n_samples, found.inside(comparison.n_samples), worth_of_modulation(comparison)
    between = level_between(comparison, inside)
    scores = two_level_scores(whitened_recording(comparison), found.factor, inside, between)
    numbers = 2 * len(found.episodes) + int((found.factor != 1).sum()) / 2
    once = max(found.log_ratio, float(scores.sum()) - numbers * math.log(n))
    if max(always, once) < _A_LOT:
        known = between is not None or compared_levels(comparison) is None
        return always > (_FACTOR * once + _NATS if known else once)
    white, more = whitened_recording(comparison), found
    for _ in range(_MORE):
        white = white / torch.where(more.inside(n), more.factor[:, None], 1.0).sqrt()
        rest, more = modulation_of(white), stretch_of(white)
        if rest.p_value > _LEFT or rest.log_ratio < _SHARE * always:
            return False
        if more.log_ratio < _ONE_MORE * rest.log_ratio:
            return True
    return True


def _time(limits: Limits, rate: float) -> Parameter:
    return Parameter(limits.value / rate, limits.low / rate, limits.high / rate, "s")
