"""Weak outliers that only many together show: at times of their own in each sensor, or in several at once.

With standard normal values `z_i` of sensor `i` at a sample, outliers of `+-a` have the likelihood ratio
`l_i = cosh(a z_i) exp(-a^2/2)`. A fraction `p` of samples is hit, each sensor by itself or those of a set at once:

    E_i = prod_t (1 + p (l_i - 1)),   E_set = prod_t (1 + p (prod_{i in set} l_i - 1))

Means over sizes, fractions and sets of sensors have expectation one where there are no outliers (`stats.multiplicity`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.stats.decorrelation import decorrelated, sign_correlation
from gyrofuse.mismatch.stats.multiplicity import log_mean, p_value_from_e_value

_SIZES = (1.5, 2.0, 2.7, 3.6, 5.0, 8.0)  # sd, about a third larger each
_EVENTS = (4.0, 16.0, 64.0)  # outliers in the record


class WeakOutliers(NamedTuple):
    """Logarithms of the mean likelihood ratios, nats.

    Attributes:
        apart: Log ratio of outliers that hit each sensor by itself.
        together: Log ratio of outliers that hit several sensors at once; -inf for a single sensor.
        size, rate: Size, sd, and fraction of samples of the largest ratio.
        sensors: Probability of being hit, `(sensor,)`, or 1 for those of the likeliest set.
    """

    apart: float
    together: float
    size: float
    rate: float
    sensors: Tensor

    @property
    def shock(self) -> bool:
        """Whether several sensors are hit at once."""
        return self.together > self.apart

    @property
    def p_value(self) -> float:
        """p value of no outliers at all."""
        return p_value_from_e_value(log_mean(torch.tensor([self.apart, self.together], dtype=torch.float64)))


def weak_outliers(z: Tensor) -> WeakOutliers:
    """Evidence of weak outliers in errors `(sensor, time)` that are standard normal without.

    Of at most seven sensors every set is tried; more are split into groups of seven.
    """
    z = decorrelated(z, sign_correlation(z))
    z = z / z.square().mean(-1, keepdim=True).sqrt()
    n_sensors, n = z.shape
    rates = torch.tensor(_EVENTS, dtype=torch.float64) / n
    groups = torch.arange(n_sensors).split(7)
    logs = [torch.stack([_log_ratios(z[group], size, rates) for size in _SIZES]) for group in groups]
    alone = [[1 << i for i in range(len(group))] for group in groups]
    single = torch.cat([log[..., own] for log, own in zip(logs, alone, strict=True)], -1)  # (size, rate, sensor)
    apart = (torch.logaddexp(single, torch.zeros_like(single)) - math.log(2)).sum(-1)  # half of the sensors are hit
    size, rate = divmod(int(apart.argmax()), len(rates))
    sensors, total, together = torch.sigmoid(single[size, rate]), log_mean(apart), -math.inf
    several = [[s for s in range(log.shape[-1]) if s.bit_count() > 1] for log in logs]
    joint = torch.cat([log[..., sets] for log, sets in zip(logs, several, strict=True)], -1)
    if joint.numel():
        together = log_mean(joint)
    if together > total:
        size, rate, which = (int(k) for k in np.unravel_index(int(joint.argmax()), joint.shape))
        group, members = [(g, s) for g, sets in zip(groups, several, strict=True) for s in sets][which]
        sensors = torch.zeros(n_sensors, dtype=torch.float64)
        sensors[group] = torch.tensor([float(members >> i & 1) for i in range(len(group))], dtype=torch.float64)
    return WeakOutliers(total, together, _SIZES[size], float(rates[rate]), sensors)


def _log_ratios(z: Tensor, size: float, rates: Tensor) -> Tensor:
    """`log E` of outliers of one size, `(rate, set)`; the bits of a set's position are its sensors.

    Where `p l` is below 0.03 even for all sensors at once, two terms of a series stand for the logarithm. Their sums
    over time factorise into those of either half of the sensors: one matrix product for all sets.
    """
    rate, half = rates[:, None, None], len(z) // 2
    total = torch.zeros(len(rates), 1 << len(z), dtype=torch.float64)
    for part in z.split(2**14, -1):
        ratio = torch.cosh((size * part).clamp(-600, 600)) * math.exp(-(size**2) / 2)
        notable = ratio.clamp(min=1.0).log().sum(0) > math.log(0.03 / float(rates.max()))
        exact = _products(ratio[:, notable])
        total += torch.log1p(rate * (exact - 1)).sum(-1)
        low, high = _products(ratio[:half, ~notable]), _products(ratio[half:, ~notable])
        first, second = ((high**k @ (low**k).mT).flatten() for k in (1, 2))
        n = int((~notable).sum())
        total += rate[..., 0] * (first - n) - rate[..., 0].square() * (second - 2 * first + n) / 2
    return total


def _products(rows: Tensor) -> Tensor:
    """Products over every set of rows `(row, time)`, `(set, time)`."""
    products = torch.ones(1, rows.shape[-1], dtype=rows.dtype)
    for row in rows:
        products = torch.cat([products, products * row])
    return products
