"""Variance of a mean from the series itself, without a model.

The mean of a stationary series of `M` terms has the variance `S(0) / M`. The products of the series with the first `B`
cosines of an orthonormal basis are `B` nearly independent estimates of `S(0)` (equally weighted cosines, EWC):

    Var = (1/B) sum_b L_b^2,   L_b = sqrt(2) / M sum_t cos(pi b (t - 1/2) / M) x_t

with Student's t of `B` degrees of freedom for intervals. It holds for any stationary series (heavy tails, tones,
telegraph noise) whose memory is short against `M / B`.

References:
    U. K. Mueller, Journal of Econometrics 141, 2007; E. Lazarus, D. J. Lewis, J. H. Stock, M. W. Watson, Journal of
    Business & Economic Statistics 36, 2018.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gyrofuse._base.checks import largest_level

# Number of cosines B at most: with 48 the 97.5 % quantile of Student's t is within 3 % of the normal one, so that more
# cosines gain little.
MOST_BASIS = 48
# Number of non-overlapping windows `M / tau` for each cosine: the b-th cosine has a period of `2 M / b`, so that at the
# last one half a period still holds four windows, over which products of coefficients have lost their correlation.
_WINDOWS_PER_BASIS = 4
# Number of non-overlapping windows from which on the series of squared coefficients of one sensor gives its variance:
# four cosines; with fewer the quantile of Student's t grows fast (3.2 for three cosines, 4.3 for two).
FEWEST_WINDOWS = 16
# Number of non-overlapping windows from which on the series of products of two sensors, or of the influence on weights,
# is used alone: products have heavier tails than squares, and 16 cosines are enough for these.
MANY_WINDOWS = 64


def n_basis(windows: Tensor) -> Tensor:
    """Number of cosines for a series.

    Args:
        windows: Non-overlapping windows `M / tau` in the series, any shape.

    Returns:
        `B` of the same shape.
    """
    return (windows / _WINDOWS_PER_BASIS).floor().clamp(2, MOST_BASIS)


def bin_length(n_samples: int, n_sensors: int) -> int:
    """Samples of a bin, a power of two: eight bins for each cosine, in at most twice the memory of the recording.

    Args:
        n_samples: Length T of the recording.
        n_sensors: Number of sensors.
    """
    affordable = max(2 * n_samples // (n_sensors * max(largest_level(n_samples), 1)), 1)
    n_bins = min(8 * MOST_BASIS, affordable)
    return 1 << max(math.ceil(math.log2(max(n_samples / n_bins, 1))), 0)


def mean_covariance(sums: Tensor, counts: Tensor, cosines: Tensor) -> Tensor:
    """Covariance of means of several series, from sums over bins of time.

    Args:
        sums: `(..., bin, series)`, sums over the known terms of each bin.
        counts: `(..., bin)`, number of known terms of each bin.
        cosines: `(...)`, number of cosines B.

    Returns:
        `(..., series, series)`.
    """
    total = counts.sum(-1, keepdim=True)
    # The middle of each bin on the clock that counts known terms only, so that gaps do not bend the cosines.
    middle = (counts.cumsum(-1) - counts / 2) / total  # (..., bin), from 0 to 1
    order = torch.arange(1, MOST_BASIS + 1, dtype=sums.dtype, device=sums.device)
    # The mean of a cosine over a bin: its value in the middle times a sinc.
    angle = math.pi / 2 * order[:, None] * (counts / total)[..., None, :]
    cosine = math.sqrt(2) * torch.cos(math.pi * order[:, None] * middle[..., None, :]) * torch.sinc(angle / math.pi)
    cosine = torch.where(order[:, None] <= cosines[..., None, None], cosine, 0.0)  # (..., term, bin)
    mean = sums.sum(-2, keepdim=True) / total[..., None]
    products = cosine @ (sums - mean * counts[..., None]) / total[..., None]  # L: (..., term, series)
    # The mean square of each binned cosine, so that the variance of white noise is exact.
    kept = (cosine.square() * counts[..., None, :]).sum(-1) / total
    products = products / torch.where(kept > 0, kept, 1.0).sqrt()[..., None]
    return products.mT @ products / cosines[..., None, None]
