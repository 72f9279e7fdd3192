"""A step: a bias that changes at once and stays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.estimates import estimate, log_factors, only, onset_samples
from gyrofuse.mismatch.detectors.slow.scans import Scan
from gyrofuse.mismatch.likelihoods.slow_templates import Family, steps
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect, in_seconds, slow_finding, strong_scan
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo


@dataclass(frozen=True, eq=False)
class Step(SlowEffect):
    """`x_i(t) = size_i` from `t0` on, in every sensor `i`.

    Where a random walk gets there by many small steps, this takes one. A sensor that jumps to and fro between two
    levels has random telegraph noise, and is left alone.

    Attributes:
        size: `(sensor,)`, unit of the signal.
        onset_s: `t0`, s after the first sample.
    """

    name: ClassVar[str] = "step"
    rivals: ClassVar[tuple[str, ...]] = ("warm_up_transient", "temperature_drift")
    separated_by: ClassVar[str] = "a longer recording on either side"
    happened_once: ClassVar[bool] = True
    onset_s: float

    @classmethod
    def families(cls, comparison: Comparison) -> Iterable[Family]:
        return (steps(comparison),)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None:
            return None
        analysis, scan = strong.analysis, strong.scan
        found = estimate(analysis, scan)
        size = found.size[:, 0]
        onset = in_seconds(onset_samples(comparison, analysis, scan, size), comparison.info.rate)
        effect = cls(only(size, scan.sensors), strong.log_factors, onset.value)
        words = f"steps at {onset.value:.6g} s"
        return slow_finding(comparison, strong, effect, found, words, {"onset": onset}, time_s=onset.value)

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> Step:
        """The best of a scan, in its sensors or in others."""
        size = only(scan.fit.size, scan.sensors if which is None else which)
        return cls(size[:, 0], log_factors(scan), scan.point[0] / rate)

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        # Times of samples are exact multiples only to rounding.
        return (torch.arange(n_samples) >= round(self.onset_s * info.rate)).to(torch.float64)[None]
