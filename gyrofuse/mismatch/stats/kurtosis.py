"""Kurtosis of correlated values, and whether two series have the same.

Statistic: with `u = w/s` cut at 4.5 and `s` the scale at which `u^2` has the mean that it has for normal values, the
difference of `q = mean u^4` between two series. Bounded, it has a variance whatever the tails are.

Null law: Student's `t` with the degrees of freedom of the long-run variance `L` of the influence of a value,

    u^4 - q - k (u^2 - mean u^2),   k = mean(4 u^4 [inside]) / mean(2 u^2 [inside]),

whose second term is the error of `s` (Hampel et al., Robust Statistics, 1986, section 4.2), of either series; it is not
taken below what normal values of the same correlation have.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.stats.long_run_variance import equal_means_score

_CUT = 4.5  # sd: of normal values one in 150,000 is cut
_LAGS = 8  # thinned Haar coefficients overlap with so many neighbours at most
_GAUSSIAN = 24.0  # variance of the fourth Hermite polynomial of a normal variable
_STEPS = 20  # of the scale's fixed point: each leaves of its error the share of the squares that is cut


class BoundedKurtosis(NamedTuple):
    """Of one or several series alike.

    Attributes:
        value: `q`.
        influence: Of each value, `(record, time)`.
        independent: Normal values with a fourth moment as uncertain, in all records.
    """

    value: float
    influence: Tensor
    independent: float


def bounded_kurtosis(values: Tensor) -> BoundedKurtosis:
    """Of series `(record, time)` without their means."""
    n_records, n = values.shape
    u = values / _scale(values)
    inside = (u.abs() < _CUT).to(u.dtype)
    u = u.clamp(-_CUT, _CUT)
    fourth, second = u.pow(4), u.square()
    q = fourth.mean()
    carried = (4 * fourth * inside).mean() / (2 * second * inside).mean().clamp(min=1e-300)
    influence = fourth - q - carried * (second - second.mean())
    energy = second.sum(-1)
    rho = [(u[:, lag:] * u[:, :-lag]).sum(-1) / energy for lag in range(1, min(_LAGS, n - 1) + 1)]
    apart = 1 + 2 * torch.stack(rho).pow(4).sum(0).mean()
    return BoundedKurtosis(float(q), influence, n_records * n / float(apart))


def kurtosis_p_value(observed: Tensor, reference: Tensor) -> float:
    """Two-sided p value that two series `(record, time)` have the same bounded kurtosis."""
    own, other = bounded_kurtosis(observed), bounded_kurtosis(reference)
    least = _GAUSSIAN * reference.numel() / other.independent
    score, dof = equal_means_score(own.value + own.influence, other.value + other.influence, least)
    return float(2 * stats.t.sf(abs(score), dof))


def _scale(values: Tensor) -> Tensor:
    """`s` with `mean min((w/s)^2, 4.5^2)` as normal values have it."""
    squares = values.square()
    outside = math.erfc(_CUT / math.sqrt(2))
    wanted = 1 - outside - 2 * _CUT * math.exp(-(_CUT**2) / 2) / math.sqrt(2 * math.pi) + _CUT**2 * outside
    variance = squares.mean().clamp(min=1e-300)
    for _ in range(_STEPS):
        variance = variance * (squares / variance).clamp(max=_CUT**2).mean() / wanted
    return variance.sqrt()
