"""One tone of every record of a batch: weighted least squares on the cosine ordinates around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.transforms import tone_in_cosines


@dataclass(frozen=True, eq=False)
class Line:
    """A tone `cosine * cos(beta u) + sine * sin(beta u)` of every item, and the data around it.

    Attributes:
        k: Bins of the DCT-II, `(item, bin)`.
        values: Its coefficients there, `(item, bin)`.
        inside: Which bins there are, `(item, bin)`: not the mean.
        beta: `(item,)`, rad per sample.
        cosine: `(item,)`.
        sine: `(item,)`.
    """

    k: Tensor
    values: Tensor
    inside: Tensor
    beta: Tensor
    cosine: Tensor
    sine: Tensor

    def at(self, k: Tensor, n: int) -> Tensor:
        """DCT-II of the tone, `(item, bin)`."""
        even, odd, _ = tone_in_cosines(self.beta[:, None], k, n)
        return self.cosine[:, None] * even + self.sine[:, None] * odd

    def polar(self) -> tuple[Tensor, Tensor, Tensor]:
        """Frequency, amplitude, and phase as a sine on the centred clock."""
        return self.beta, torch.hypot(self.cosine, self.sine), torch.atan2(self.cosine, self.sine)

    def fitted(self, values: Tensor, weights: Tensor, n: int, search: bool, n_steps: int = 6) -> Line:
        """Weighted least squares: Gauss-Newton in `beta`, the two amplitudes solved for.

        Args:
            values: Coefficients of the DCT-II, `(item, bin)`.
            weights: Reciprocal variances, `(item, bin)`.
            n: Length of the record.
            search: Whether to search around `beta` first.
            n_steps: Number of Gauss-Newton steps: they converge quadratically from a sixteenth of a cycle.
        """
        cycle = 2 * math.pi / n
        lowest = cycle / 2
        beta = self.beta
        if search:
            # A sixteenth of a cycle apart, to one and a half cycles on either side of the peak.
            offsets = torch.arange(-24, 25, dtype=torch.float64, device=beta.device) / 16
            grid = (beta[:, None] + cycle * offsets).clamp(lowest, math.pi - lowest)
            explained = _project(grid, self.k, values, weights, n).explained
            beta = grid.gather(-1, explained.argmax(-1, keepdim=True))[:, 0]
        best = _project(beta[:, None], self.k, values, weights, n)
        for _ in range(n_steps):
            moved = beta + best.step[:, 0].clamp(-cycle / 8, cycle / 8)
            moved = moved.clamp(lowest, math.pi - lowest)
            trial = _project(moved[:, None], self.k, values, weights, n)
            # Rounding may lower what is explained at the top.
            better = (trial.explained >= best.explained * (1 - 1e-13))[:, 0]
            beta = torch.where(better, moved, (beta + moved) / 2)
            best = _project(beta[:, None], self.k, values, weights, n)
        return Line(self.k, self.values, self.inside, beta, best.cosine[:, 0], best.sine[:, 0])

    def standard_deviations(self, weights: Tensor, n: int) -> tuple[Tensor, Tensor]:
        """Of `beta` and of the amplitude, from the Fisher information of the bins fitted, both `(item,)`."""
        even, odd, slopes = tone_in_cosines(self.beta[:, None], self.k, n)
        slope = self.cosine[:, None] * slopes[0] + self.sine[:, None] * slopes[1]
        columns = torch.stack([even, odd, slope / n], -1)  # amplitude per cycle: entries of one size
        size = torch.hypot(self.cosine, self.sine)
        columns = columns / torch.stack([torch.ones_like(size), torch.ones_like(size), size], -1)[:, None]
        information = columns.mT @ (weights[..., None] * columns)
        covariance, info = torch.linalg.inv_ex(information)
        covariance = torch.where((info == 0)[:, None, None], covariance, torch.nan)
        direction = torch.stack([self.cosine, self.sine], -1) / size[:, None]
        variance = torch.einsum("na,nab,nb->n", direction, covariance[:, :2, :2], direction)
        return covariance[:, 2, 2].sqrt() / (n * size), variance.sqrt()


@dataclass(frozen=True, eq=False)
class _Projection:
    """Least squares at given frequencies, all `(item, frequency)`; `step` is the Gauss-Newton step of `beta`."""

    explained: Tensor
    cosine: Tensor
    sine: Tensor
    step: Tensor


def _project(beta: Tensor, k: Tensor, values: Tensor, weights: Tensor, n: int) -> _Projection:
    even, odd, slopes = tone_in_cosines(beta[..., None], k[:, None], n)  # (item, frequency, bin)
    values, weights = values[:, None], weights[:, None]

    def share(template: Tensor, of: Tensor) -> Tensor:
        return (weights * template * of).sum(-1)

    # Odd and even bins share nothing, so that the normal equations are diagonal.
    norms = share(even, even), share(odd, odd)
    cosine, sine = share(even, values) / norms[0], share(odd, values) / norms[1]
    slope = cosine[..., None] * slopes[0] + sine[..., None] * slopes[1]
    slope = slope - even * (share(even, slope) / norms[0])[..., None] - odd * (share(odd, slope) / norms[1])[..., None]
    residual = values - cosine[..., None] * even - sine[..., None] * odd
    information = share(slope, slope)
    step = torch.where(information > 0, share(slope, residual) / information, 0.0)
    return _Projection(cosine.square() * norms[0] + sine.square() * norms[1], cosine, sine, step)
