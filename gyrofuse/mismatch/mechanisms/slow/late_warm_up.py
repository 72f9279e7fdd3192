"""A warm-up that starts while the device is on: a heater, a radio, a motor nearby that is switched on or off."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.detectors.slow.estimates import estimate, log_factors, only
from gyrofuse.mismatch.detectors.slow.scans import Scan
from gyrofuse.mismatch.likelihoods.slow_noise import ordinates
from gyrofuse.mismatch.likelihoods.slow_templates import Family
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect, in_seconds, slow_finding, strong_scan
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo


@dataclass(frozen=True, eq=False)
class LateWarmUp(SlowEffect):
    """`x_i(t) = size_i (1 - exp(-(t - t0) / tau))` from `t0` on, in every sensor `i`.

    A step that takes its time. What begins before the first sample is a `WarmUpTransient`, what has no end a `Ramp`.

    Attributes:
        size: Where it settles, `(sensor,)`, unit of the signal.
        onset_s: `t0`, s after the first sample.
        time_constant_s: `tau`, s.
    """

    name: ClassVar[str] = "warm_up_transient"
    rivals: ClassVar[tuple[str, ...]] = ("step", "ramp", "temperature_drift")
    separated_by: ClassVar[str] = "a longer recording on either side, with temperature"
    happened_once: ClassVar[bool] = True
    onset_s: float
    time_constant_s: float

    @classmethod
    def owns(cls, scan: Scan) -> bool:
        return scan.family.timed

    @classmethod
    def families(cls, comparison: Comparison) -> Iterable[Family]:
        block, n_constants = comparison.block, 9
        earliest, latest = 4, N_BLOCKS - 16  # blocks: before, it is there from the start, and after it a step
        onsets = block * torch.arange(earliest, latest, 2, dtype=torch.float64)
        shortest, longest = 2 * block, comparison.n_samples / 4  # shorter ones are steps, longer ones lines
        constants = torch.logspace(math.log10(shortest), math.log10(longest), n_constants, dtype=torch.float64)
        ends = block * torch.arange(N_BLOCKS + 1, dtype=torch.float64)

        def design_at(points: Tensor) -> Tensor:
            onset, tau = points.mT[..., None]
            since = (ends - onset).clamp(min=0)
            # The integral from the onset to the ends of blocks.
            return ordinates((since + tau * torch.expm1(-since / tau)).diff() / block)[:, None]

        points, words = torch.cartesian_prod(onsets, constants), "the bias moves and settles after some {:.4g} s"
        return (Family(cls.name, points, design_at(points), words, design_at=design_at, timed=True, becomes="step"),)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None or not cls.owns(strong.scan):
            return None
        step = strong.analysis.scan("step")
        if step is not None and step.gain > strong.scan.gain - NATS_AS_GOOD:  # which takes no time
            return None
        scan, rate = strong.scan, comparison.info.rate
        found = estimate(strong.analysis, scan)
        onset, tau = (in_seconds(limits, rate) for limits in found.points)
        effect = replace(cls.of(scan, rate), size=only(found.size[:, 0], scan.sensors))
        onset, tau = onset._replace(value=effect.onset_s), tau._replace(value=effect.time_constant_s)
        return slow_finding(
            comparison,
            strong,
            effect,
            found,
            f"moves from {onset.value:.4g} s on and settles with a time constant of {tau.value:.3g} s",
            {"onset": onset, "time_constant": tau},
            time_s=onset.value,
        )

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> LateWarmUp:
        """The best of a scan, in its sensors or in others."""
        size = only(scan.fit.size, scan.sensors if which is None else which)
        onset, tau = (number / rate for number in scan.point)
        return cls(size[:, 0], log_factors(scan), onset, tau)

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        since = (info.seconds(n_samples) - self.onset_s).clamp(min=0)
        return -torch.expm1(-since / self.time_constant_s)[None]
