"""Long-run variance of a stationary series: how uncertain its mean is.

The mean of `n` values has the variance `L/n`, with `L` the spectral density at frequency zero. The mean of the lowest
`M` ordinates of the periodogram estimates `L`; `2 M` times it over `L` is chi-square with `2 M` degrees of freedom as
far as the spectrum is flat up to the `M`-th.

References:
    Brillinger, Time Series: Data Analysis and Theory, 1981, theorem 5.4.3.
    Welch, The generalization of Student's problem, Biometrika 34 (1947), 28.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

# Numbers of ordinates that are tried, each a quarter of the one before. With the last one `t` has 12 degrees of
# freedom: with fewer a test at 1e-4 would want differences twice as large.
ORDINATES = (1024, 256, 64, 16, 6)


class LongRunVariance(NamedTuple):
    """Estimate of a long-run variance.

    Attributes:
        value: `L`, of the series' unit squared.
        dof: Degrees of freedom of its chi-square law.
    """

    value: float
    dof: float


def long_run_variance(series: Tensor) -> LongRunVariance:
    """Estimate from the largest number of ordinates over which the spectrum is flat.

    Flat is a spectrum whose lowest ordinates are not higher than the rest by `F` at 10 %: fewer ordinates cost less
    than a variance that is too small. At most one ordinate is used for forty samples: no spectrum
    is taken for flat over more than a twentieth of the band.

    Args:
        series: Records `(record, time)` of the same process; their means are taken off.
    """
    n_records, n = series.shape
    most = max(min(ORDINATES[0], n // 40), 1)
    transform = torch.fft.rfft(series - series.mean(-1, keepdim=True))[..., 1 : most + 1]
    power = (transform.real.square() + transform.imag.square()).mean(0) / n
    tried = [m for m in ORDINATES if m <= most] or [most]

    def falls(low: int, m: int) -> bool:
        ratio = float(power[:low].mean() / power[low:m].mean().clamp(min=1e-300))
        return float(stats.f.sf(ratio, 2 * low * n_records, 2 * (m - low) * n_records)) < 0.1

    m = next((m for m in tried if not any(falls(low, m) for low in tried if low < m)), tried[-1])
    return LongRunVariance(float(power[:m].mean()), 2.0 * m * n_records)


def equal_means_score(own: Tensor, other: Tensor, least: float) -> tuple[float, float]:
    """Welch's `t` of the difference of the means of two correlated series `(record, time)`, and its dof.

    The long-run variance of the first is not taken below that of the second: a series that holds few rare events by
    chance would look too certain of its mean.

    Args:
        own: Series, or influences of its values plus a statistic of it, which is their mean.
        other: Series of the other side, likewise.
        least: Long-run variance below which neither is taken.
    """
    spreads = [long_run_variance(series) for series in (own, other)]
    floor = max(spreads[1].value, least)
    parts = max(spreads[0].value, floor) / own.numel(), floor / other.numel()
    dof = sum(parts) ** 2 / sum(part**2 / spread.dof for part, spread in zip(parts, spreads, strict=True))
    return float(own.mean() - other.mean()) / math.sqrt(sum(parts)), dof


def chi_square_nodes(dof: float) -> tuple[Tensor, Tensor]:
    """Values `(node,)` of a chi-square variable over its dof, and weights, to average p values over.

    Nodes are quantiles, a decade apart in the lower tail down to 1e-12: where an estimate is far too small p values are
    far too small as well, and few such nodes make their mean.
    """
    edges = np.concatenate([[0.0], 10.0 ** np.arange(-12, -1), np.arange(0.1, 1.05, 0.1)])
    middle = np.concatenate([[edges[1] / 2], np.sqrt(edges[1:-1] * edges[2:])])
    values = stats.chi2.ppf(np.clip(middle, 0, 1 - 1e-12), dof) / dof
    return torch.from_numpy(values), torch.from_numpy(np.diff(edges))
