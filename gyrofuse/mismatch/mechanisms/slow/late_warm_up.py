"""A transient that starts while the device is on: a heater nearby that is switched, a part that is started anew."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.detectors.slow.estimates import estimate, log_factors, only
from gyrofuse.mismatch.detectors.slow.scans import Scan
from gyrofuse.mismatch.likelihoods.slow_noise import best_fit, ordinates
from gyrofuse.mismatch.likelihoods.slow_templates import Family
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import (
    SlowEffect,
    Strong,
    in_seconds,
    slow_finding,
    strong_scan,
)
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo


@dataclass(frozen=True, eq=False)
class LateWarmUp(SlowEffect):
    """`x_i(t) = size_i (1 - exp(-(t - t0) / tau))` from `t0` on, in every sensor `i`; or `size_i exp(-(t - t0) / tau)`.

    A step that takes its time, or one that does not last. What begins before the first sample is a `WarmUpTransient`,
    what has no end a `Ramp`.

    Attributes:
        size: Where it settles, or how far it jumps, `(sensor,)`, unit of the signal.
        onset_s: `t0`, s after the first sample.
        time_constant_s: `tau`, s.
        decays: Whether it jumps and decays, as a warm-up of what is started anew.
    """

    name: ClassVar[str] = "warm_up_transient"
    rivals: ClassVar[tuple[str, ...]] = ("step", "ramp", "temperature_drift")
    separated_by: ClassVar[str] = "a longer recording on either side, with temperature"
    happened_once: ClassVar[bool] = True
    onset_s: float
    time_constant_s: float
    decays: bool = False

    @classmethod
    def owns(cls, scan: Scan) -> bool:
        return scan.family.timed

    @classmethod
    def families(cls, comparison: Comparison) -> Iterable[Family]:
        block, n_constants = comparison.block, 9
        earliest, latest = 4, N_BLOCKS - 16  # blocks: before, it is there from the start, and after it a step
        shortest, longest = comparison.shortest_transient, comparison.n_samples / 4  # else they are steps, or lines
        constants = torch.logspace(math.log10(shortest), math.log10(longest), n_constants, dtype=torch.float64)
        for decays, apart, words in (
            (False, 2.0, "the bias moves and settles after some {:.4g} s"),
            (True, 0.5, "the bias jumps and decays after some {:.4g} s"),  # as fine as steps
        ):
            onsets = block * torch.arange(earliest, latest, apart, dtype=torch.float64)
            points, designs_at = torch.cartesian_prod(onsets, constants), partial(_designs, block, decays)
            yield Family(
                cls.name,
                points,
                designs_at(points),
                words,
                design_at=designs_at,
                timed=True,
                decays=decays,
                becomes="step",
            )

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None or not cls.owns(strong.scan):
            return None
        if strong.scan.family.decays and not _stands_alone(strong):
            return None
        step = strong.analysis.scan("step")
        if step is not None and step.gain > strong.scan.gain - NATS_AS_GOOD:  # which takes no time
            return None
        scan, rate = strong.scan, comparison.info.rate
        found = estimate(strong.analysis, scan)
        onset, tau = (in_seconds(limits, rate) for limits in found.points)
        effect = replace(cls.of(scan, rate), size=only(found.size[:, 0], scan.sensors))
        onset, tau = onset._replace(value=effect.onset_s), tau._replace(value=effect.time_constant_s)
        at = f"{onset.value:.4g} s"
        words = f"jumps at {at} and decays" if effect.decays else f"moves from {at} on and settles"
        return slow_finding(
            comparison,
            strong,
            effect,
            found,
            f"{words} with a time constant of {tau.value:.3g} s",
            {"onset": onset, "time_constant": tau},
            time_s=onset.value,
        )

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> LateWarmUp:
        """The best of a scan, in its sensors or in others."""
        size = only(scan.fit.size, scan.sensors if which is None else which)
        onset, tau = (number / rate for number in scan.point)
        return cls(size[:, 0], log_factors(scan), onset, tau, scan.family.decays)

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        since = info.seconds(n_samples) - self.onset_s
        decayed = (-since.clamp(min=0) / self.time_constant_s).exp()
        return torch.where(since < 0, 0.0, decayed if self.decays else 1 - decayed)[None]


def _stands_alone(strong: Strong) -> bool:
    """Whether a jump that decays is one, and no part of a path that jumps and decays again and again.

    Where noise is louder for a while, or the device moves, something always seems to.
    """
    sure, much = 1e-5, 1 / 3  # p value; share of its gain
    analysis, scan = strong.analysis, strong.scan
    if scan.p_value > sure:
        return False
    left = analysis.y - scan.fit.size @ scan.design
    families = tuple(family for family in analysis.families if family.decays)
    again = replace(analysis, y=left, null=best_fit(analysis.noise, left), families=families).scans[0]
    return again.gain < much * scan.gain


def _designs(block: int, decays: bool, points: Tensor) -> Tensor:
    """Ordinates of the block means from onsets on, with time constants, `(template, number)`, samples."""
    onset, tau = points.mT[..., None]
    since = (block * torch.arange(N_BLOCKS + 1, dtype=torch.float64) - onset).clamp(min=0)
    decayed = -tau * torch.expm1(-since / tau)  # integrals from the onset to the ends of blocks
    return ordinates((decayed if decays else since - decayed).diff() / block)[:, None]
