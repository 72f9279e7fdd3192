"""A step: a bias that changes at once and stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.scans import PLAUSIBLE, Scan, SlowLook, concerned, explained_by
from gyrofuse.mismatch.likelihoods.slow_noise import cell_differences
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.signals.slow_effect import (
    SlowEffect,
    estimate,
    log_factors,
    only,
    place,
    quantiles,
    slow_finding,
    strong_scan,
)
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

_CELLS = 256
_MARGIN = 24  # cells on either side of the places left
_FINE = 4.0  # cells to a standard deviation
_NEGLIGIBLE = 1e-4


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
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None:
            return None
        look, scan = strong.look, strong.scan
        found = estimate(look, scan, finer=False)
        size = found.size[:, 0]
        onset = place(onset_samples(comparison, look, scan, size), comparison.info.rate)
        effect = cls(only(size, concerned(scan)), strong.log_factors, onset.value)
        words = f"steps at {onset.value:.6g} s"
        return slow_finding(comparison, strong, effect, found, words, {"onset": onset}, time_s=onset.value)

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> Step:
        """The best of a scan, in the sensors concerned or in others."""
        size = only(scan.fit.size, concerned(scan) if which is None else which)
        return cls(size[:, 0], log_factors(scan), scan.place / rate)

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        # Times of samples are exact multiples only to rounding.
        return (torch.arange(n_samples) >= round(self.onset_s * info.rate)).to(torch.float64)[None]


def onset_samples(comparison: Comparison, look: SlowLook, scan: Scan, size: Tensor) -> tuple[float, float, float]:
    """Median of the onset with 95 % limits, samples, from ever finer cells around it; the sizes are held."""
    which = list(concerned(scan))
    size = size[which, None]
    likely = explained_by(look.y, scan.fit.variance, scan.family.designs, which) / 2
    near, places = (likely > likely.max() - PLAUSIBLE).nonzero()[:, 0], scan.family.places
    low, high = float(places[max(int(near[0]) - 1, 0)]), float(places[min(int(near[-1]) + 1, len(places) - 1)])
    margin, coarser = max(high - low, 4.0 * comparison.block), comparison.n_samples
    while True:
        first, end = max(int(low - margin), 0), min(int(high + margin), comparison.n_samples)
        cell = max(-(-(end - first) // _CELLS), 1)
        n_cells = (end - first) // cell
        signal = comparison.recording[which, first : first + n_cells * cell]
        y = signal.unflatten(-1, (n_cells, cell)).mean(-1).diff()
        covariance = cell_differences(comparison.base, cell, n_cells)[which]
        inverse = torch.linalg.inv(covariance * scan.fit.log_factors[which, :1, None].exp())
        information = inverse.diagonal(dim1=-1, dim2=-2)
        gain = size * (inverse @ y[..., None])[..., 0] - size.square() * information / 2
        weight = torch.softmax(gain.sum(0), 0)
        places = first + cell * torch.arange(1, n_cells, dtype=torch.float64)
        mean = places @ weight
        sd = float(((places - mean).square() @ weight).sqrt())
        if cell == 1 or sd > _FINE * cell or cell >= coarser:  # places far apart keep cells from getting finer
            return quantiles(places, weight)
        coarser = cell
        at = (weight > _NEGLIGIBLE * weight.max()).nonzero()[:, 0]
        low, high, margin = float(places[at[0]]), float(places[at[-1]]), _MARGIN * cell
