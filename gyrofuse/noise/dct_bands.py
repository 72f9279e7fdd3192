"""Bands of the ordinates of a record's discrete cosine transform (DCT-II), in which noise processes have a variance."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

# Ordinates that are bands of their own, from the lowest frequency up: there spectra change most from one to the next.
SINGLE = 48


class BandVariance(NamedTuple):
    """Mean variance of the ordinates in each band of a process with `p = 1`, see `Process`.

    Attributes:
        value: `(band,)`, or `(item, band)` of a process with a nonlinear parameter.
        slope: Derivative with respect to `x`, `(item, band)`; None without.
        curvature: Second derivative, near enough for the steps of a search.
    """

    value: Tensor
    slope: Tensor | None = None
    curvature: Tensor | None = None


class DCTBands:
    """Single ordinates of the orthonormal DCT-II of a record, and bands of several.

    With `y_k = sqrt(2/T) sum_t x_t cos(pi k (t + 1/2) / T)`, `k = 1..T-1`, and `s = sin(pi k / 2T)`,
    `c = cos(pi k / 2T)` white noise has the variance 1 and a random walk `1 / (4 s^2)`, both exact and uncorrelated.

    Args:
        n_samples: Length T of the record.
        device: Device of the tensors.

    Attributes:
        edges: First ordinate of each band, and the one after the last.
        count: Number of ordinates, `(band,)`.
        sine_squared: `s^2` at two places of each band, its middle -+ the standard deviation of its places: the mean
            there is that of all to third order, `(2, band)`.
        ends: `4 c^2 / T`, `(2, band)`.
        frequency: Cycles per sample, `(2, band)`.
        sign: Mean of `(-1)^k`, `(band,)`.
    """

    def __init__(self, n_samples: int, device: torch.device) -> None:
        self.n_samples = n_samples
        self.edges = _edges(n_samples)
        edges = torch.tensor(self.edges, dtype=torch.float64, device=device)
        self.count = edges.diff()
        middle, width = (edges[:-1] + edges[1:] - 1) / 2, ((self.count.square() - 1) / 12).sqrt()
        k = torch.stack([middle - width, middle + width])
        angle = math.pi / (2 * n_samples) * k
        self.sine_squared, self.ends = angle.sin().square(), 4 / n_samples * angle.cos().square()
        self.frequency = k / (2 * n_samples)
        first_even = 1 - 2 * torch.remainder(edges[:-1], 2)
        self.sign = torch.where(torch.remainder(self.count, 2) == 1, first_even / self.count, 0.0)

    @staticmethod
    def mean_of(values: Tensor) -> Tensor:
        """Mean over the two places, `(..., 2, band)` -> `(..., band)`."""
        return (values[..., 0, :] + values[..., 1, :]) / 2


def _edges(n_samples: int) -> list[int]:
    """First ordinate of each band, and the one after the last."""
    single = min(SINGLE, n_samples - 1)
    half = n_samples // 2
    per_octave = 16  # over so narrow a band the quadrature of two places is good to third order in 4 %
    rising = math.ceil(per_octave * math.log2(max(half / (single + 1), 1)))
    places = [round((single + 1) * 2 ** (i / per_octave)) for i in range(rising)]
    # Each time the distance from the highest frequency halves, where AR1s that alternate in sign have their peak.
    per_halving, n_halvings = 8, 4
    falling = range(per_halving * n_halvings + 1)
    places += [n_samples - round(half * 2 ** (-i / per_halving)) for i in falling]
    return [*range(1, single + 1), *sorted({k for k in places if single < k < n_samples}), n_samples]
