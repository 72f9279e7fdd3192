"""A running median, as drivers have against outliers: a filter that is not linear."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.median_windows import came_back, median_windows
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.spectra.low_pass import LowPassFilter
from gyrofuse.mismatch.mechanisms.values.stuck_samples import repeat_scores
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import held_out_blocks
from gyrofuse.mismatch.stats.multiplicity import sidak


@dataclass(frozen=True, eq=False)
class MedianFilter(Mechanism):
    """`y_t` is the median of `window` samples around `x_t`: what is put out is one of them, and again a little later.

    Attributes:
        window: Samples, odd, `(sensor,)`; 1 in those without.
        share: Of the samples that come back, `(sensor,)`.
        by_chance: The same in the simulation, `(sensor,)`.
    """

    name: ClassVar[str] = LowPassFilter.name
    likelihood: ClassVar[str] = "values"
    separated_by: ClassVar[str] = "the values as the converter gives them, before filters and averages"
    stage: ClassVar[int] = 1
    window: OfSensors
    share: OfSensors
    by_chance: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found, info = median_windows(comparison), comparison.info
        p_values = [sidak(float(p), comparison.n_sensors) for p in found.p_values]
        sensors = found.within(level)
        if not sensors:
            return None
        concerned = torch.zeros(comparison.n_sensors, dtype=torch.bool)
        concerned[list(sensors)] = True
        window = torch.where(concerned, found.samples, 1).to(torch.float64)
        share, chance = (
            torch.stack([_share(side.signal[:, i], int(w)) for i, w in enumerate(window)])
            for side in (comparison.observed, comparison.reference)
        )
        effect = cls(window, share, chance)
        sizes = sorted({int(window[i]) for i in sensors})
        return effect.found(
            f"a running median of {' and '.join(map(str, sizes))} samples in {info.named(sensors, 'all sensors')}: "
            f"{100 * float(share.max()):.3g} % of the values come back within its window",
            min(p_values),
            sensors,
            {f"window[{i}]": Parameter.exact(float(window[i]), "") for i in sensors},
            levels=tuple(range(1, 1 + math.ceil(math.log2(max(sizes))))),
            gain=float(effect._scores(comparison).sum()),
        )

    def fit_without(self, comparison: Comparison, fold: int) -> MedianFilter:
        """Its window is a whole number, and known from whatever part of the record."""
        return self

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.samples(ax, comparison, sensor, 0, 60)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        filtered = signal.clone()
        for i, window in enumerate(self.window.int().tolist()):
            if window > 1:
                half, row = window // 2, signal[..., i, :]
                ends = row[..., :1].expand(*row.shape[:-1], half), row[..., -1:].expand(*row.shape[:-1], half)
                filtered[..., i, :] = torch.cat([ends[0], row, ends[1]], -1).unfold(-1, window, 1).median(-1).values
        return filtered

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison), fold).sum((0, -1))

    def _scores(self, comparison: Comparison) -> Tensor:
        """Log likelihood ratio of each sample's coming back or not, `(sensor, time)`."""
        least = 0.5 / comparison.reference.signal[:, 0].numel()
        chance, share = (x.clamp(min=least, max=1 - 1e-9)[:, None] for x in (self.by_chance, self.share))
        again = torch.stack([came_back(row, int(w)) for row, w in zip(comparison.recording, self.window, strict=True)])
        return torch.where(self.window[:, None] > 1, repeat_scores(again, share, chance), 0.0)


def _share(records: Tensor, window: int) -> Tensor:
    """Of the samples of `(record, time)` that come back."""
    return came_back(records, window).to(torch.float64).mean()
