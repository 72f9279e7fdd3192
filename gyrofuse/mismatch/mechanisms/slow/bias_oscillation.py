"""A bias that swings with one period, slowly: a room's thermostat, an orbit, a duty cycle nearby."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.estimates import estimate, log_factors, only
from gyrofuse.mismatch.detectors.slow.scans import Scan
from gyrofuse.mismatch.likelihoods.slow_noise import ordinates
from gyrofuse.mismatch.likelihoods.slow_templates import Family
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect, in_seconds, slow_finding, strong_scan
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class BiasOscillation(SlowEffect):
    """`x_i(t) = size_i cos(2 pi t / P) + sine_i sin(2 pi t / P)` in every sensor `i`, 1.25 to eleven times in a record.

    Slower than a vibration tone, which is found beside its neighbours in the spectrum: here slow noise is as strong as
    the simulation says, or stronger.

    Attributes:
        size, sine: `(sensor,)`, unit of the signal; `t` counts from the first sample.
        period_s: `P`, s.
    """

    name: ClassVar[str] = "bias_oscillation"
    rivals: ClassVar[tuple[str, ...]] = ("step", "temperature_drift", "resonance")
    separated_by: ClassVar[str] = "a recording of more periods, with temperature"
    sine: OfSensors
    period_s: float

    @classmethod
    def families(cls, comparison: Comparison) -> Iterable[Family]:
        fewest, most, a_cycle = 1.25, 11, 4  # cycles in the record, and templates from one to the next
        cycles = torch.linspace(fewest, most, round((most - fewest) * a_cycle) + 1, dtype=torch.float64)
        ends = comparison.block * torch.arange(N_BLOCKS + 1, dtype=torch.float64)

        def design_at(points: Tensor) -> Tensor:
            omega = 2 * math.pi / points  # (template, 1)
            # Sums of a block are differences of geometric series.
            turned = torch.polar(torch.ones_like(omega * ends), omega * ends)
            means = turned.diff() / (torch.polar(torch.ones_like(omega), omega) - 1) / comparison.block
            return ordinates(torch.view_as_real(means).movedim(-1, -2).contiguous())

        points = (comparison.n_samples / cycles).flip(0)[:, None]
        return (Family(cls.name, points, design_at(points), "the bias swings, in {:.4g} s", design_at=design_at),)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None:
            return None
        scan, info = strong.scan, comparison.info
        found = estimate(strong.analysis, scan)
        period, effect = in_seconds(found.points[0], info.rate), cls.of(scan, info.rate)
        words, sizes = f"swings with a period of {period.value:.4g} s", [("amplitude", info.measure)]
        finding = slow_finding(comparison, strong, effect, found, words, {}, sizes=sizes)
        amplitude, sd = effect.amplitude, (effect.sizes * found.sd).square().sum(-1).sqrt() / effect.amplitude
        limits = {
            f"amplitude[{i}]": Parameter.around(a, Z * s, info.measure, least=0.0)
            for i, a, s in zip(range(len(sd)), amplitude.tolist(), sd.tolist(), strict=True)
            if i in scan.sensors
        }
        return replace(finding, parameters={"period": period, **limits})

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> BiasOscillation:
        """The best of a scan, in its sensors or in others."""
        size, sine = only(scan.fit.size, scan.sensors if which is None else which).unbind(-1)
        return cls(size, log_factors(scan), sine, scan.point[0] / rate)

    @property
    def amplitude(self) -> Tensor:
        """`(sensor,)`, unit of the signal."""
        return torch.hypot(self.size, self.sine)

    @property
    def sizes(self) -> Tensor:
        return torch.stack([self.size, self.sine], -1)

    def with_sizes(self, sizes: Tensor) -> BiasOscillation:
        return replace(self, size=sizes[:, 0], sine=sizes[:, 1])

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        angle = 2 * math.pi / self.period_s * info.seconds(n_samples)
        return torch.stack([angle.cos(), angle.sin()])
