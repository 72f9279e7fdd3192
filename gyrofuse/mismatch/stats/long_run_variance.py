"""Long-run variance of a stationary series: how uncertain its mean is.

The mean of `n` values has the variance `L/n`, with `L` the spectral density at frequency zero. The mean of the lowest
`M` ordinates of the periodogram estimates `L`; `2 M` times it over `L` is chi-square with `2 M` degrees of freedom as
far as the spectrum is flat up to the `M`-th (Brillinger, Time Series, 1981, theorem 5.4.3). `M` is the largest of a few
whose lowest part is not higher than the rest: where the density has fallen off a mean would be too small.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

# Ordinates, each number a quarter of the one before. With the last one `t` has 12 degrees of freedom: with fewer a
# test at 1e-4 would want differences twice as large.
ORDINATES = (1024, 256, 64, 16, 6)
_SHARE = 40  # samples of the series for each ordinate: its spectrum is not flat over more than a twentieth of the band
_HIGHER = 0.1  # p value at which the lowest ordinates are higher: rather fewer ordinates than too small a variance
# Tail probabilities between which chi-square is averaged over: p values down to the smallest are told.
_TAILS = np.concatenate([[0.0], 10.0 ** np.arange(-12, -1), np.arange(0.1, 1.05, 0.1)])


class LongRunVariance(NamedTuple):
    """An estimate and how sure it is.

    Attributes:
        value: `L`, of the series' unit squared.
        dof: Degrees of freedom of its chi-square law.
    """

    value: float
    dof: float


def long_run_variance(series: Tensor) -> LongRunVariance:
    """Estimate from one series or several alike.

    Args:
        series: Records `(record, time)` of the same process; their means are taken off.
    """
    n_records, n = series.shape
    centred = series - series.mean(-1, keepdim=True)
    most = max(min(ORDINATES[0], n // _SHARE), 1)
    transform = torch.fft.rfft(centred)[..., 1 : most + 1]
    power = (transform.real.square() + transform.imag.square()).mean(0) / n
    tried = [m for m in ORDINATES if m <= most] or [most]
    for m in tried:
        if not any(_higher(power[:low], power[low:m], n_records) for low in tried if low < m):
            break
    return LongRunVariance(float(power[:m].mean()), 2.0 * m * n_records)


def equal_means_score(own: Tensor, other: Tensor, least: float) -> tuple[float, float]:
    """Difference of the means of two series `(record, time)` over its sd, and the degrees of freedom of its `t`.

    Each has the long-run variance of its own (Welch, Biometrika 34 (1947), 28): of rare events a series that holds few
    by chance also looks surer of its mean. That of the first is not taken below that of the second.

    Args:
        own: Series, or influences of its values plus a statistic of it, which is their mean.
        other: The same of the other one.
        least: Below which neither long-run variance is.
    """
    spreads = [long_run_variance(series) for series in (own, other)]
    floor = max(spreads[1].value, least)
    parts = max(spreads[0].value, floor) / own.numel(), floor / other.numel()
    dof = sum(parts) ** 2 / sum(part**2 / spread.dof for part, spread in zip(parts, spreads, strict=True))
    return float(own.mean() - other.mean()) / math.sqrt(sum(parts)), dof


def _higher(low: Tensor, rest: Tensor, n_records: int) -> bool:
    ratio = float(low.mean() / rest.mean().clamp(min=1e-300))
    return float(stats.f.sf(ratio, 2 * len(low) * n_records, 2 * len(rest) * n_records)) < _HIGHER


def chi_square_nodes(dof: float) -> tuple[Tensor, Tensor]:
    """Values `(node,)` of a chi-square variable over its degrees of freedom, and weights, to average p values over.

    The lower tail, where an estimate is far too small, is resolved down to 1e-12.
    """
    middle = np.concatenate([[_TAILS[1] / 2], np.sqrt(_TAILS[1:-1] * _TAILS[2:])])
    values = stats.chi2.ppf(np.clip(middle, 0, 1 - 1e-12), dof) / dof
    return torch.from_numpy(values), torch.from_numpy(np.diff(_TAILS))
