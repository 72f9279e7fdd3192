"""A warm-up: a bias that decays after power-on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.estimates import estimate, log_factors, only
from gyrofuse.mismatch.detectors.slow.scans import Scan
from gyrofuse.mismatch.likelihoods.slow_templates import Family, warm_ups
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect, in_seconds, slow_finding, strong_scan
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors


@dataclass(frozen=True, eq=False)
class Decay:
    """A further decay, of what a part that warms up stands in.

    Attributes:
        size: At the first sample, `(sensor,)`, unit of the signal.
        time_constant_s: s.
    """

    size: OfSensors
    time_constant_s: float


@dataclass(frozen=True, eq=False)
class WarmUpTransient(SlowEffect):
    """`x_i(t) = size_i exp(-t / tau)` in every sensor `i`, `t` from the first sample; or a sum of two such decays.

    A curve at the beginning that no channel follows, the same in all sensors but for its size. A random walk goes
    anywhere at any time. Temperature that rises after power-on does the same: the channel decides, where there is one.

    Attributes:
        size: At the first sample, `(sensor,)`, unit of the signal.
        time_constant_s: `tau`, s.
        slower: A second decay; none by default.
    """

    name: ClassVar[str] = "warm_up_transient"
    rivals: ClassVar[tuple[str, ...]] = ("step", "temperature_drift")
    separated_by: ClassVar[str] = "a second recording from power-on, and one of the warm device"
    time_constant_s: float
    slower: tuple[Decay, ...] = ()

    @classmethod
    def owns(cls, scan: Scan) -> bool:
        return not scan.family.timed

    @classmethod
    def families(cls, comparison: Comparison) -> Iterable[Family]:
        return (warm_ups(comparison, decays) for decays in (1, 2))

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None or not cls.owns(strong.scan):
            return None
        analysis, scan = strong.analysis, strong.scan
        found, rate = estimate(analysis, scan), comparison.info.rate
        effect, (tau, *others) = cls.of(scan, rate), (in_seconds(limits, rate) for limits in found.points)
        numbers, unit = {"time_constant": tau}, comparison.info.measure
        words = f"decays after the start with a time constant of {tau.value:.3g} s"
        if effect.slower:
            first, second = effect.time_constant_s, effect.slower[0].time_constant_s
            numbers = {
                "time_constant": tau._replace(value=first),
                "second_time_constant": others[0]._replace(value=second),
            }
            words = f"decays after the start with time constants of {first:.3g} and {second:.3g} s"
        else:
            effect = replace(effect, size=only(found.size[:, 0], scan.sensors), time_constant_s=tau.value)
        sizes = [("size", unit), ("second_size", unit)]
        return slow_finding(comparison, strong, effect, found, words, numbers, sizes=sizes, time_s=0.0)

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> WarmUpTransient:
        """The best of a scan, in its sensors or in others."""
        size, *further = only(scan.fit.size, scan.sensors if which is None else which).unbind(-1)
        tau, *others = (number / rate for number in scan.point)
        slower = tuple(Decay(own, other) for own, other in zip(further, others, strict=True))
        return cls(size, log_factors(scan), tau, slower)

    @property
    def sizes(self) -> Tensor:
        return torch.stack([self.size, *(decay.size for decay in self.slower)], -1)

    def with_sizes(self, sizes: Tensor) -> WarmUpTransient:
        size, *further = sizes.unbind(-1)
        slower = tuple(replace(decay, size=own) for decay, own in zip(self.slower, further, strict=True))
        return replace(self, size=size, slower=slower)

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        constants = (self.time_constant_s, *(decay.time_constant_s for decay in self.slower))
        return torch.stack([(-info.seconds(n_samples) / tau).exp() for tau in constants])
