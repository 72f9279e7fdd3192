"""A ramp: a bias that drifts in a straight line from a time on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.estimates import estimate, log_factors, only
from gyrofuse.mismatch.detectors.slow.scans import Scan
from gyrofuse.mismatch.likelihoods.slow_noise import ordinates
from gyrofuse.mismatch.likelihoods.slow_templates import Family
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect, in_seconds, slow_finding, strong_scan
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo


@dataclass(frozen=True, eq=False)
class Ramp(SlowEffect):
    """`x_i(t) = size_i (t - t0)` from `t0` on, in every sensor `i`: a rate ramp (IEEE Std 952-2020, annex C).

    A random walk has no direction to keep. A warm-up that takes longer than the recording is a line as well.

    Attributes:
        size: Slopes, `(sensor,)`, unit of the signal per s.
        onset_s: `t0`, s after the first sample; 0 where it drifts all the time.
    """

    name: ClassVar[str] = "ramp"
    rivals: ClassVar[tuple[str, ...]] = ("step", "warm_up_transient", "temperature_drift")
    separated_by: ClassVar[str] = "a recording that goes on"
    happened_once: ClassVar[bool] = True
    onset_s: float

    @classmethod
    def families(cls, comparison: Comparison) -> Iterable[Family]:
        rate = comparison.info.rate
        block, latest = comparison.block, 3 * N_BLOCKS // 4  # block: a line that begins later is like a step
        onsets = block * torch.arange(latest, dtype=torch.float64)[:, None]

        def design_at(points: Tensor) -> Tensor:
            sums = _sum_until(block * torch.arange(N_BLOCKS + 1, dtype=torch.float64) - points)
            return ordinates(sums.diff() / block / rate)[:, None]

        words = "the bias drifts in a line from about {:.4g} s on"
        return (Family(cls.name, onsets, design_at(onsets), words, design_at=design_at, timed=True),)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None:
            return None
        scan, rate, unit = strong.scan, comparison.info.rate, comparison.info.measure
        found = estimate(strong.analysis, scan)
        onset = in_seconds(found.points[0], rate)
        effect = cls(only(found.size[:, 0], scan.sensors), strong.log_factors, onset.value)
        since = f"from {onset.value:.4g} s on" if onset.low > 0 else "from the start"
        return slow_finding(
            comparison,
            strong,
            effect,
            found,
            f"drifts in a line {since}",
            {"onset": onset},
            sizes=[("slope", f"{unit}/s")],
            time_s=onset.value,
        )

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> Ramp:
        """The best of a scan, in its sensors or in others."""
        size = only(scan.fit.size, scan.sensors if which is None else which)
        return cls(size[:, 0], log_factors(scan), scan.point[0] / rate)

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        return (info.seconds(n_samples) - self.onset_s).clamp(min=0)[None]


def _sum_until(ends: Tensor) -> Tensor:
    """Sums of `k - t0` over the samples `k` from an onset `t0` until ends, at `ends - t0` samples."""
    ends = ends.clamp(min=0)
    return ends * (ends - 1) / 2
