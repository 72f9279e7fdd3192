"""Kurtosis of correlated values: its law for normal ones, and whether two series of any law have the same.

The fourth Hermite polynomials of two normal values correlated by `rho` are correlated by `rho^4`, so that `n` values
are as good as `n / (1 + 2 sum rho^4)` independent ones. A sample kurtosis of these is normal after a transformation.

For other laws, with `u = w/s` cut at 4.5 and `s` the scale at which `u^2` has the mean of normal values, the statistic
is the difference of `q = mean u^4` between two series: bounded, it has a variance whatever the tails are. Null law:
Student's `t` with the degrees of freedom of the long-run variance of the influence of a value,

    u^4 - q - k (u^2 - mean u^2),   k = mean(4 u^4 [inside]) / mean(2 u^2 [inside]),

whose second term is the error of `s`; it is not taken below what normal values of the same correlation have.

References:
    Anscombe and Glynn, Distribution of the kurtosis statistic b2 for normal samples, Biometrika 70 (1983), 227.
    Hampel et al., Robust Statistics, 1986, section 4.2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.stats.long_run_variance import equal_means_score

_CUT = 4.5  # sd, beyond which values are cut: one in 150,000 of normal ones


class BoundedKurtosis(NamedTuple):
    """Bounded kurtosis of one series, or of several alike.

    Attributes:
        value: `q`.
        influence: Influence of each value, `(record, time)`.
        independent: Number of independent normal values with a fourth moment as uncertain, in all records.
    """

    value: float
    influence: Tensor
    independent: float


def independent_values(w: Tensor) -> Tensor:
    """Number `(...)` of independent normal values whose kurtosis is as certain as that of `(..., time)`.

    Args:
        w: Values without their means, of which eight neighbours are correlated, as thinned Haar coefficients are.
    """
    energy = w.square().sum(-1)
    rho = [(w[..., lag:] * w[..., :-lag]).sum(-1) / energy for lag in range(1, min(8, w.shape[-1] - 1) + 1)]
    return w.shape[-1] / (1 + 2 * torch.stack(rho).pow(4).sum(0))


def normal_kurtosis(b2: Tensor, n: Tensor) -> Tensor:
    """Standard normal score of a sample kurtosis of `n` independent normal values (Anscombe and Glynn)."""
    mean = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1).square() * (n + 3) * (n + 5))
    x = (b2 - mean) / variance.sqrt()
    tail = (6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3))).sqrt()
    skew = 6 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9)) * tail
    a = 6 + 8 / skew * (2 / skew + (1 + 4 / skew.square()).sqrt())
    ratio = (1 - 2 / a) / (1 + x * (2 / (a - 4)).sqrt())
    return (1 - 2 / (9 * a) - ratio.sign() * ratio.abs().pow(1 / 3)) / (2 / (9 * a)).sqrt()


def kurtosis_score(values: Tensor) -> Tensor:
    """Kurtosis of `(..., time)` as a standard normal variable, `(...)`, if the values are normal."""
    centred = values - values.mean(-1, keepdim=True)
    kurtosis = centred.pow(4).mean(-1) / centred.square().mean(-1).square()
    return normal_kurtosis(kurtosis, independent_values(centred))


def clipped_sd(values: Tensor) -> Tensor:
    """Robust sd `s` of `(..., time)`, `(...)`: `mean min((w/s)^2, 4.5^2)` is that of normal values (an M-estimate)."""
    squares = values.square()
    outside = math.erfc(_CUT / math.sqrt(2))
    wanted = 1 - outside - 2 * _CUT * math.exp(-(_CUT**2) / 2) / math.sqrt(2 * math.pi) + _CUT**2 * outside
    variance = squares.mean(-1, keepdim=True).clamp(min=1e-300)
    for _ in range(20):  # each leaves of the error the share of the squares that is cut
        variance = variance * (squares / variance).clamp(max=_CUT**2).mean(-1, keepdim=True) / wanted
    return variance[..., 0].sqrt()


def bounded_kurtosis(values: Tensor) -> BoundedKurtosis:
    """Bounded kurtosis of series `(record, time)` without their means."""
    u = values / clipped_sd(values.flatten())
    inside = (u.abs() < _CUT).to(u.dtype)
    u = u.clamp(-_CUT, _CUT)
    fourth, second = u.pow(4), u.square()
    q = fourth.mean()
    carried = (4 * fourth * inside).mean() / (2 * second * inside).mean().clamp(min=1e-300)
    influence = fourth - q - carried * (second - second.mean())
    return BoundedKurtosis(float(q), influence, len(values) / float((1 / independent_values(u)).mean()))


def kurtosis_p_value(observed: Tensor, reference: Tensor) -> float:
    """Two-sided p value that two series `(record, time)` have the same bounded kurtosis."""
    own, other = bounded_kurtosis(observed), bounded_kurtosis(reference)
    # The influence of normal values is their fourth Hermite polynomial, of variance 4!.
    least = math.factorial(4) * reference.numel() / other.independent
    score, dof = equal_means_score(own.value + own.influence, other.value + other.influence, least)
    return float(2 * stats.t.sf(abs(score), dof))
