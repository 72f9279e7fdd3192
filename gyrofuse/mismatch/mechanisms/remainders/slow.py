"""What is left of a slow course once everything with a name is explained: taken off without physics.

A bias may follow what the catalogue does not have. As the filter that stands for what is left of the spectra, the
course is no finding: tests that asked for it stay in the report as unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.scans import slow_analysis
from gyrofuse.mismatch.likelihoods.slow_noise import best_fit
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold

_COSINES = 32  # half cycles in the record: as many as there are blocks, each of which is predicted by those beside it
_SHARES = N_JUDGED // N_FOLDS
_PLAIN = 9.0  # square of a size over its variance: what is less may be noise, and stays


@dataclass(frozen=True, eq=False)
class SlowRemainder(SlowEffect):
    """`x_i(t) = sum_k size_ik cos(pi k (t + 1/2) / T)`, a course that happened once.

    Attributes:
        size: Of the first cosine, `(sensor,)`, unit of the signal.
        further: Of the others, `(sensor, cosine)`.
        n_samples: `T`.
    """

    name: ClassVar[str] = "slow_remainder"
    identified: ClassVar[bool] = False
    remark: ClassVar[str] = "A slow course that is left in this recording is taken off it; it stands for no physics."
    asked_for_by: ClassVar[tuple[str, ...]] = ("slow", "hysteresis")  # names of tests
    happened_once: ClassVar[bool] = True
    changes_noise: ClassVar[bool] = True  # of the lowest frequencies, where it follows what is none
    known_path: ClassVar[bool] = False
    further: Annotated[Tensor, Dims(("sensor", "cosine"))]
    n_samples: int

    @classmethod
    def left_over(cls, comparison: Comparison) -> SlowRemainder:
        """What is plainly more than the simulation's slow noise."""
        analysis = slow_analysis(comparison)
        slowest = torch.eye(_COSINES, analysis.y.shape[-1], dtype=analysis.y.dtype)
        fit = best_fit(analysis.noise, analysis.y, slowest, analysis.null.log_factors)
        plain = fit.size.square() > _PLAIN * fit.variance[:, :_COSINES]
        sizes = torch.where(plain, fit.size, 0.0) * math.sqrt(2 / N_BLOCKS)
        return cls(sizes[:, 0], fit.log_factors, sizes[:, 1:], comparison.block * N_BLOCKS)

    def but_for(self, sensors: Sequence[int]) -> SlowRemainder:
        """The same, with some sensors left as they are."""
        sizes = self.sizes.clone()
        sizes[list(sensors)] = 0.0
        return self.with_sizes(sizes)

    @property
    def sizes(self) -> Tensor:
        return torch.cat([self.size[:, None], self.further], -1)

    def with_sizes(self, sizes: Tensor) -> SlowRemainder:
        return replace(self, size=sizes[:, 0], further=sizes[:, 1:])

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        k = torch.arange(1, self.sizes.shape[-1] + 1, dtype=torch.float64)[:, None]
        return (math.pi * k * (torch.arange(n_samples) + 0.5) / self.n_samples).cos()

    def fit_without(self, comparison: Comparison, fold: int) -> SlowRemainder:
        """Only those that are plain: further ones would follow the noise where nothing holds them."""
        y, paths, _ = self._whitened(comparison)
        kept = ~in_fold(y.shape[-1], fold)
        design = paths * kept[:, None] * (self.sizes != 0)[:, None, :]
        return self.with_sizes((torch.linalg.pinv(design) @ (y * kept)[..., None])[..., 0])

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        """Log score of the whitened differences held out, in as many shares as the fold has blocks."""
        y, paths, _ = self._whitened(comparison)
        judged = in_fold(y.shape[-1], fold)
        effect = (paths @ self.sizes[..., None])[..., 0]
        gain = (effect * y - effect.square() / 2)[:, judged].sum(0)
        return torch.stack([part.sum() for part in gain.tensor_split(_SHARES)])
