"""A sensor that is slower than its log: each value is put out until the next one is there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.values import repeats
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.values.stuck_samples import StuckSamples, repeat_scores
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import held_out_blocks
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak


@dataclass(frozen=True, eq=False)
class HeldValues(Mechanism):
    """`y_t = x` at the last of the times `phase + k period`: a new value comes at them alone, and is held between.

    Values that were not ready, or a sensor that hangs, repeat at random times.

    Attributes:
        period: Samples from one value to the next, whole or not, `(sensor,)`; 1 in those that are right.
        phase: Sample of the first new value, `(sensor,)`.
        by_chance: Probability of a repeat without the mechanism, `(sensor,)`.
    """

    name: ClassVar[str] = StuckSamples.name
    likelihood: ClassVar[str] = StuckSamples.likelihood
    separated_by: ClassVar[str] = StuckSamples.separated_by
    stage: ClassVar[int] = StuckSamples.stage
    period: OfSensors
    phase: OfSensors
    by_chance: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        seen, info = repeats(comparison), comparison.info
        p_values = [sidak(float(p), comparison.n_sensors) for p in seen.p_values]
        found = {i: clock for i, p in enumerate(p_values) if p <= level and (clock := _clock(seen.same[i])) is not None}
        if not found:
            return None
        period, phase = (torch.full((comparison.n_sensors,), x, dtype=torch.float64) for x in (1.0, 0.0))
        parameters = {}
        for i, clock in found.items():
            period[i], phase[i] = clock.period, clock.phase
            rate, reach = info.rate / clock.period, Z * info.rate / clock.period**2 * clock.sd
            parameters[f"rate[{i}]"] = Parameter.around(rate, reach, "Hz")
        effect = cls(period, phase, seen.expected.clamp(max=0.999))
        slowest = max(found, key=lambda i: found[i].period)
        return effect.found(
            f"values of {info.named(tuple(found), 'all sensors')} come at {info.rate / found[slowest].period:.6g} Hz, "
            f"slower than the samples, and are held between: each is put out {found[slowest].period:.4g} times",
            min(p_values[i] for i in found),
            tuple(found),
            parameters,
            levels=(1,),
            gain=float(effect._scores(comparison).sum()),
        )

    def _fresh(self, n: int) -> Tensor:
        """Samples that bring a new value, `(sensor, time)`."""
        at = torch.arange(-1, n, dtype=torch.float64) - self.phase[:, None]
        return (at / self.period[:, None]).floor().diff() > 0

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        n = signal.shape[-1]
        source = torch.where(self._fresh(n), torch.arange(n), 0).cummax(-1).values
        return signal.gather(-1, source.expand(signal.shape))

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        """A clock is known from whatever part of the record."""
        return self

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison), fold).sum((0, -1))

    def _scores(self, comparison: Comparison) -> Tensor:
        """Log likelihood ratio of each sample's being a repeat or not, `(sensor, time)`."""
        seldom = 1e-3  # probability that a value is not held
        same = repeats(comparison).same
        chance = self.by_chance.clamp(min=0.5 / comparison.reference.signal[:, 0].numel())
        chance = chance[:, None]
        expected = torch.where(self._fresh(same.shape[-1]), chance, chance.clamp(min=1 - seldom))
        return repeat_scores(same, expected, chance)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.samples(ax, comparison, sensor, max(int(self.phase[sensor]), 0), 60)


class _Clock(NamedTuple):
    """Times `phase + k period` of new values, samples, and the standard deviation of the period."""

    period: float
    phase: float
    sd: float


def _clock(same: Tensor) -> _Clock | None:
    """The clock of the samples `(time,)` that are no repeats; None where they keep to none."""
    fewest, jitter = 32, 1.05  # new values; samples by which they come late at most, one where the clocks are others
    at = (~same).nonzero()[:, 0].to(torch.float64)[1:]  # a record's first sample repeats none
    if len(at) < fewest:
        return None
    gaps = at.diff()
    usual = gaps[gaps <= 1.5 * gaps.median()].mean()
    if float(usual) < 1.5:  # most samples are new ones
        return None
    number = torch.cat([at.new_zeros(1), (gaps / usual).round().cumsum(0)])
    middle, n = number.mean(), len(number)
    spread = (number - middle).square().sum()
    period = float(((number - middle) * at).sum() / spread)
    off = at - period * number
    if float(off.max() - off.min()) > jitter:
        return None
    sd = float(off.std().clamp(min=1 / n) / spread.sqrt())
    return _Clock(period, float(off.max()) - 1 + 1e-6, sd)  # a value comes with the first sample after its time
