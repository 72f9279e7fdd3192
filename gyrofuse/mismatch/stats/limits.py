"""Confidence limits."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy import stats
from torch import Tensor

Z = 1.959963984540054  # standard deviations of a normal estimate from its 95 % limits: the 0.975 quantile


def variance_of(low: float, high: float) -> float:
    """Variance of a normal estimate with those 95 % limits."""
    return ((high - low) / (2 * Z)) ** 2


def weighted_mean(values: Sequence[float], variances: Sequence[float]) -> tuple[float, float]:
    """Mean weighted by inverse variances, and the sum of the weights: one over its variance."""
    weights = [1 / variance for variance in variances]
    return sum(w * v for w, v in zip(weights, values, strict=True)) / sum(weights), sum(weights)


def amplitude_limits(snr: Tensor, seen: float) -> Tensor:
    """Lower limits, estimates and upper limits of amplitudes `(3, sensor)`, all in standard deviations.

    For amplitudes that were estimated because they are above `seen` (those that are not for having been the largest):
    the square is noncentral chi-square of two degrees of freedom, of which only the tail beyond `seen` comes here.
    Weak ones are there because noise has made them larger; equal tails of that law cover them as often as strong ones.
    Of the weakest both limits would be zero: none is below what the square less that of the noise says.
    """
    value = (snr.square() - 1).clamp(min=0.0).sqrt()
    limits = value + Z * torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
    strong = 12.0  # standard deviations, from which the law is normal
    weak = snr < strong
    if bool(weak.any()):
        low, high = _tail_limits(snr[weak], seen if float(snr.min()) > seen else 0.0)
        limits[:, weak] = torch.stack([low, high.maximum(value[weak])])
    return torch.stack([limits[0], value.clamp(limits[0], limits[1]), limits[1]])


def _tail_limits(snr: Tensor, seen: float) -> Tensor:
    """Amplitudes at which what comes beyond `seen` is beyond `snr` with 2.5 and 97.5 %, `(2, sensor)`, halved in on."""
    tail, far, halvings = 0.025, 6.0, 40  # beyond either limit; standard deviations beyond which no amplitude is
    wanted = torch.tensor([[tail], [1 - tail]], dtype=torch.float64)
    low, high = torch.zeros(2, len(snr), dtype=torch.float64), (snr + far).repeat(2, 1)
    for _ in range(halvings):
        middle = (low + high) / 2
        law = stats.ncx2(2, middle.square().numpy())
        share = torch.from_numpy(law.sf(snr.square().numpy()) / law.sf(seen**2))
        low, high = torch.where(share < wanted, middle, low), torch.where(share < wanted, high, middle)
    return torch.where(low > 0, high, 0.0)
