"""Variance of a mean from the series itself, without a model.

The mean of a stationary series of `M` terms has the variance `S(0) / M`, and the products of the series with the first
`B` cosines of an orthonormal basis are that many independent looks at `S(0)` (equally weighted cosines, EWC):

    Var = (1/B) sum_b L_b^2,   L_b = sqrt(2) / M sum_t cos(pi b (t - 1/2) / M) x_t

with Student's t of `B` degrees of freedom for intervals. It counts whatever the series does (heavy tails, tones,
telegraph noise), as long as its memory is short against `M / B`.

References:
    U. K. Mueller, Journal of Econometrics 141, 2007; E. Lazarus, D. J. Lewis, J. H. Stock, M. W. Watson, Journal of
    Business & Economic Statistics 36, 2018.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gyrofuse._base.checks import largest_level

# More cosines than this gain little: Student's t is within 3 % of normal.
MOST_TERMS = 48
# A level holds `M / tau` windows side by side; four of them for each cosine.
_WINDOWS_PER_TERM = 4
FEWEST_WINDOWS = 16


def number_of_terms(windows: Tensor) -> Tensor:
    """Cosines for series that hold so many windows `M / tau` side by side, same shape."""
    return (windows / _WINDOWS_PER_TERM).floor().clamp(2, MOST_TERMS)


def bin_length(n_samples: int, n_sensors: int) -> int:
    """Samples of a bin, a power of two: enough bins to tell the cosines apart, in at most twice the data's memory."""
    affordable = max(2 * n_samples // (n_sensors * max(largest_level(n_samples), 1)), 1)
    n_bins = min(8 * MOST_TERMS, affordable)
    return 1 << max(math.ceil(math.log2(max(n_samples / n_bins, 1))), 0)


def mean_covariance(sums: Tensor, counts: Tensor, n_terms: Tensor) -> Tensor:
    """Covariance of means of several series, from sums over bins of time.

    Args:
        sums: `(..., bin, series)`, sums over the known terms of each bin.
        counts: `(..., bin)`, how many these are.
        n_terms: `(...)`, cosines B.

    Returns:
        `(..., series, series)`.
    """
    total = counts.sum(-1, keepdim=True)
    # The middle of each bin on the clock that counts known terms only, so that gaps do not bend the cosines.
    middle = (counts.cumsum(-1) - counts / 2) / total  # (..., bin), from 0 to 1
    order = torch.arange(1, MOST_TERMS + 1, dtype=sums.dtype, device=sums.device)
    # Within a bin a cosine loses what its mean over the bin lacks.
    angle = math.pi / 2 * order[:, None] * (counts / total)[..., None, :]
    cosine = math.sqrt(2) * torch.cos(math.pi * order[:, None] * middle[..., None, :]) * torch.sinc(angle / math.pi)
    cosine = torch.where(order[:, None] <= n_terms[..., None, None], cosine, 0.0)  # (..., term, bin)
    mean = sums.sum(-2, keepdim=True) / total[..., None]
    looks = cosine @ (sums - mean * counts[..., None]) / total[..., None]  # L: (..., term, series)
    # What the bins leave of each cosine, so that white noise comes out right.
    kept = (cosine.square() * counts[..., None, :]).sum(-1) / total
    looks = looks / torch.where(kept > 0, kept, 1.0).sqrt()[..., None]
    return looks.mT @ looks / n_terms[..., None, None]
