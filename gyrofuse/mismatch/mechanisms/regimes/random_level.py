"""Noise whose level goes up and down at random all the time: bursts, turbulence, bad contacts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.detectors.variance.noise_level import compared_levels, modulation, variance_p_value
from gyrofuse.mismatch.detectors.variance.random_levels import LevelLaws, level_laws, level_squares
from gyrofuse.mismatch.likelihoods.laws.random_level import RandomLevel, mean_over_base
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.regimes.changing_variance import fast_power_over, lines_of
from gyrofuse.mismatch.mechanisms.regimes.channel_noise import score_of_episodes
from gyrofuse.mismatch.mechanisms.values.stuck_samples import taken_rows
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import N_JUDGED, in_fold
from gyrofuse.mismatch.signals.variance_course import CORNER, VarianceCourse
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak


@dataclass(frozen=True, eq=False)
class RandomLevelNoise(Mechanism):
    """`S_t(f) = (1 + (base factor^c(t) - 1) f^2/(f^2 + f_c^2)) S(f)`, `c` the share of a few sources that are on.

    Each comes on and goes off at random, whatever the others do: one makes bursts, several a level that wanders.

    Attributes:
        sources: Number of sources, by sensor; 0 where the level is steady.
        base: Of the variance where none is on, over the simulation's, `(sensor,)`.
        factor: Of the variance where all are on over that, `(sensor,)`; 1 where a sensor does not change.
        share: Of the time that a source is on, `(sensor,)`.
        on_s: Mean time that it stays on, s, `(sensor,)`.
        together: Whether all the sensors concerned are louder at the same time.
        corner_hz: `f_c`.
        lines_hz: Lines of the simulation, which are no noise and stay as they are.
    """

    name: ClassVar[str] = "variance_change"
    likelihood: ClassVar[str] = "regimes"
    rivals: ClassVar[tuple[str, ...]] = ("spikes", "scale_mixture")
    separated_by: ClassVar[str] = "a longer recording"
    changes_noise: ClassVar[bool] = True
    sources: tuple[int, ...]
    base: OfSensors
    factor: OfSensors
    share: OfSensors
    on_s: OfSensors
    together: bool
    corner_hz: float
    lines_hz: tuple[float, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = sidak(min(variance_p_value(comparison), modulation(comparison).p_value), 2)
        if p_value > level:
            return None
        found = level_laws(comparison)
        gain, numbers = found.gain(level_squares(comparison)), 4 * len(found.laws)
        price = numbers / 2 * math.log(comparison.n_samples)
        if not found.laws or gain - price < score_of_episodes(comparison) + NATS_AS_GOOD:
            return None
        return cls._of(found, comparison)._as_finding(comparison, p_value, gain)

    @classmethod
    def _of(cls, found: LevelLaws, comparison: Comparison) -> RandomLevelNoise:
        p, rate = comparison.n_sensors, comparison.info.rate
        sources, factor = [0] * p, torch.ones(p, dtype=torch.float64)
        base, share, on = factor.clone(), torch.zeros_like(factor), torch.ones_like(factor) / rate
        over = _over_the_simulation(comparison)
        for i in found.sensors:
            law = found.of(i)
            sources[i], factor[i], share[i] = law.sources, law.factor, law.share
            base[i], on[i] = over[i] * law.base / law.mean, 1 / law.leave / rate
        corner = CORNER * rate
        return cls(tuple(sources), base, factor, share, on, found.together, corner, lines_of(comparison))

    def _as_finding(self, comparison: Comparison, p_value: float, gain: float) -> Finding:
        info, parameters = comparison.info, {}
        sensors = tuple((self.factor != 1).nonzero()[:, 0].tolist())
        for i in sensors:
            turns = max(comparison.n_samples / info.rate / float(self.on_s[i]) * float(self.share[i]), 1.0)
            reach = math.exp(min(Z * math.sqrt(2 / turns), 50.0))  # each turn says how loud it is, and how long
            parameters[f"factor[{i}]"] = Parameter.within(float(self.factor[i]), reach, "")
            parameters[f"time_on[{i}]"] = Parameter.within(float(self.on_s[i]), reach, "s")
        most = max(sensors, key=lambda i: abs(math.log(float(self.factor[i]))))
        factor, time, share = float(self.factor[most]), float(self.on_s[most]), float(self.share[most])
        where, at_once = info.named(sensors, "all sensors"), " at the same time" if self.together else ""
        said = f" (sensor {info.sensors[most]})" if len(sensors) > 1 else ""
        if self.sources[most] == 1:
            what = (
                f"the noise of {where} goes to {factor:.3g} times its variance and back at random{at_once}, "
                f"for {time:.3g} s at a time and {share:.3g} of the time{said}"
            )
        else:
            spread = abs(math.log(factor)) * math.sqrt(share * (1 - share) / self.sources[most])
            what = (
                f"the level of the noise of {where} wanders at random{at_once}, by a factor of {math.exp(spread):.3g} "
                f"(one standard deviation of the variance) over {time * (1 - share):.3g} s{said}"
            )
        return self.found(what, p_value, sensors, parameters, levels=(1,), gain=gain)

    def _laws(self, comparison: Comparison) -> LevelLaws:
        """Its laws of the whitened recording, of any mean."""
        sensors = tuple((self.factor != 1).nonzero()[:, 0].tolist())
        laws = []
        for i in sensors[:1] if self.together else sensors:
            share, leave = float(self.share[i]), 1 / max(float(self.on_s[i]) * comparison.info.rate, 1.0)
            enter = min(share / max(1 - share, 1e-9) * leave, 1 - 1e-9)
            law = RandomLevel(self.sources[i], 1.0, float(self.factor[i]), enter, leave)
            law = law._replace(base=1 / law.mean, sensors=len(sensors) if self.together else 1)
            laws.append(law)
        return LevelLaws(sensors, tuple(laws), self.together)

    def fit_without(self, comparison: Comparison, fold: int) -> RandomLevelNoise:
        squares, found = level_squares(comparison)[:, ~in_fold(N_JUDGED, fold)], self._laws(comparison)
        laws = tuple(law.improved(rows) for law, rows in zip(found.laws, found.rows(squares), strict=True))
        return self._of(found._replace(laws=laws), comparison)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        held, found = in_fold(N_JUDGED, fold), self._laws(comparison)
        rows = found.rows(level_squares(comparison)[:, held])
        return torch.stack([law.gains(row) for law, row in zip(found.laws, rows, strict=True)]).sum(0)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return self._louder(signal, self._drawn(signal, info.rate, generator), info.rate)

    def _louder(self, signal: Tensor, course: Tensor, rate: float) -> Tensor:
        """Signals with a course of the level, both `(..., sensor, time)`."""
        lines, louder = tuple(f / rate for f in self.lines_hz), signal.clone()
        for i in (self.factor != 1).nonzero()[:, 0].tolist():
            own = slice(i, i + 1)
            for record, path in zip(
                louder.view(-1, *signal.shape[-2:]), course.view(-1, *signal.shape[-2:]), strict=True
            ):
                known = VarianceCourse(path[i], self.factor[own], self.corner_hz / rate, self.base[own])
                record[own] = known.added(record[own], lines)
        return louder

    def _drawn(self, signal: Tensor, rate: float, generator: torch.Generator) -> Tensor:
        """Share of the sources that are on, `(..., sensor, time)`."""
        records = signal.reshape(-1, *signal.shape[-2:])
        on, sources = torch.zeros(records.shape, dtype=torch.float64), torch.tensor(self.sources)
        for k in range(int(sources.max())):
            share = torch.where(sources > k, self.share, 0.0)
            on += taken_rows(records, share, self.on_s * rate, self.together, generator)
        return (on / sources.clamp(min=1)[:, None]).view(signal.shape)

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """With the mean level of the recording: bursts are few, and what comes of them by chance is no other noise."""
        rate = comparison.info.rate
        expected = mean_over_base(torch.tensor(self.sources).clamp(min=1), self.factor, self.share)

        def louder(signal: Tensor) -> Tensor:
            course = self._drawn(signal, rate, generator)
            drawn = (self.factor.log()[:, None] * course).exp().flatten(0, -3).mean((0, -1))
            return replace(self, base=self.base * expected / drawn)._louder(signal, course, rate)

        built = comparison.apply(louder, self.stage)
        return replace(built, reference=replace(built.reference, gaussian=False))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.variance_over_time(ax, comparison, sensor, None)


def _over_the_simulation(comparison: Comparison) -> Tensor:
    """Mean variance of the fast noise over the simulation's, `(sensor,)`, where that has a level of its own."""
    if compared_levels(comparison) is None:
        return torch.ones(comparison.n_sensors, dtype=torch.float64)
    return fast_power_over(comparison.observed, comparison.reference, CORNER)
