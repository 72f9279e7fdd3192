"""Weak outliers that only many together tell: at times of their own in each sensor, or in several at once.

With standard normal values `z_i` of sensor `i` at a sample, outliers of `+-a` have the likelihood ratio
`l_i = cosh(a z_i) exp(-a^2/2)`. A fraction `p` of samples is hit, each sensor by itself or those of a set at once:

    E_i = prod_t (1 + p (l_i - 1)),   E_set = prod_t (1 + p (prod_{i in set} l_i - 1))

Means over sizes, fractions and sets of sensors have expectation one where there are no outliers, so that they exceed
`x` with probability `1/x` at most (Ville, 1939), and with less than `1/70x` by what importance sampling from the same
mixture gives for 1 to 6 sensors: `1/20x` is held to.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.outlier_law import Outliers
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import p_value_from_e_value

_SIZES = (1.5, 2.0, 2.7, 3.6, 5.0, 8.0)
_EVENTS = (4.0, 16.0, 64.0)  # in the record
_NOTABLE = 0.03  # p l, below which two terms of a series do
_CHUNK = 2**14
_MOST_AT_ONCE = 7  # sensors of which every set is looked at
_LEAST_SPREAD = 0.05


class WeakOutliers(NamedTuple):
    """Log of the mean likelihood ratios, nats.

    Attributes:
        apart: Of outliers that hit each sensor by itself.
        together: Of outliers that hit several at once; -inf for a single sensor.
        size, rate: Those of the largest ratio.
        sensors: Likewise: probability of being hit, `(sensor,)`, or who is in the set.
    """

    apart: float
    together: float
    size: float
    rate: float
    sensors: Tensor

    @property
    def log_ratio(self) -> float:
        """Of both together."""
        return float(_log_mean(torch.tensor([self.apart, self.together], dtype=torch.float64)))

    @property
    def shock(self) -> bool:
        """Whether several sensors are hit at once."""
        return self.together > self.apart

    @property
    def p_value(self) -> float:
        """Of no outliers at all."""
        return p_value_from_e_value(self.log_ratio)


def weak_outliers(z: Tensor) -> WeakOutliers:
    """Evidence of weak outliers in errors `(sensor, time)` that are standard normal without."""
    z = _standardised(z)
    n_sensors, n = z.shape
    rates = torch.tensor(_EVENTS, dtype=torch.float64) / n
    groups = torch.arange(n_sensors).split(_MOST_AT_ONCE)
    logs = [torch.stack([_log_ratios(z[group], size, rates) for size in _SIZES]) for group in groups]
    alone = [[1 << i for i in range(len(group))] for group in groups]
    single = torch.cat([log[..., own] for log, own in zip(logs, alone, strict=True)], -1)  # (size, rate, sensor)
    apart = _log_half(single).sum(-1)
    size, rate = divmod(int(apart.argmax()), len(rates))
    sensors, total, together = torch.sigmoid(single[size, rate]), float(_log_mean(apart.flatten())), -math.inf
    several = [[s for s in range(log.shape[-1]) if s.bit_count() > 1] for log in logs]
    joint = torch.cat([log[..., sets] for log, sets in zip(logs, several, strict=True)], -1)
    if joint.numel():
        together = float(_log_mean(joint.flatten()))
    if together > total:
        size, rate, which = (int(k) for k in torch.unravel_index(joint.argmax(), joint.shape))
        group, members = [(g, s) for g, sets in zip(groups, several, strict=True) for s in sets][which]
        sensors = torch.zeros(n_sensors, dtype=torch.float64)
        sensors[group] = torch.tensor([float(members >> i & 1) for i in range(len(group))], dtype=torch.float64)
    return WeakOutliers(total, together, _SIZES[size], float(rates[rate]), sensors)


def _standardised(z: Tensor) -> Tensor:
    """Independent sensors of mean square one: by the symmetric root of the correlation of signs."""
    sign = z.sign()
    r = torch.sin(math.pi / 2 * (sign @ sign.mT) / z.shape[-1])
    values, vectors = torch.linalg.eigh(r)
    z = vectors / values.clamp(min=1e-6).sqrt() @ vectors.mT @ z
    return z / z.square().mean(-1, keepdim=True).sqrt()


def _log_ratios(z: Tensor, size: float, rates: Tensor) -> Tensor:
    """`log E` of outliers of one size, `(rate, set)`; the bits of a set's position are its sensors."""
    rate, half = rates[:, None, None], len(z) // 2
    total = torch.zeros(len(rates), 1 << len(z), dtype=torch.float64)
    for part in z.split(_CHUNK, -1):
        ratio = torch.cosh((size * part).clamp(-600, 600)) * math.exp(-(size**2) / 2)
        notable = ratio.clamp(min=1.0).log().sum(0) > math.log(_NOTABLE / float(rates.max()))
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


def _log_half(log_ratio: Tensor) -> Tensor:
    """`log((1 + E)/2)`."""
    return torch.logaddexp(log_ratio, torch.zeros_like(log_ratio)) - math.log(2)


def _log_mean(values: Tensor) -> Tensor:
    return torch.logsumexp(values, 0) - math.log(len(values))


def shock_scores(z: Tensor, laws: list[Outliers]) -> Tensor:
    """Log likelihood ratio of samples `(sensor, time)`, `(time,)`: all sensors of a rate above 0 are hit at once."""
    rate = max(law.rate for law in laws)
    return torch.logaddexp(torch.tensor(math.log1p(-rate), dtype=torch.float64), math.log(rate) + _moved(z, laws))


def shock_posterior(z: Tensor, laws: list[Outliers]) -> Tensor:
    """Probability of each sample's being hit, `(time,)`."""
    return torch.exp(math.log(max(law.rate for law in laws)) + _moved(z, laws) - shock_scores(z, laws))


def _moved(z: Tensor, laws: list[Outliers]) -> Tensor:
    total = torch.zeros(z.shape[-1], dtype=torch.float64)
    for row, law in zip(z, laws, strict=True):
        if law.rate > 0:
            v, h = 1 + law.spread**2, law.height
            fold = (h * row / v).abs()
            total += row.square() / 2 - (row.square() + h**2) / (2 * v) - math.log(v) / 2
            total += fold + torch.log1p(torch.exp(-2 * fold)) - math.log(2)
    return total


def fitted_shock(z: Tensor, start: list[Outliers], rounds: int) -> list[Outliers]:
    """Maximum likelihood of outliers at common times by expectation and maximisation, with limits from the scores."""
    laws, hit = start, [i for i, law in enumerate(start) if law.rate > 0]
    for _ in range(rounds):
        weight = shock_posterior(z, laws)
        total = float(weight.sum())
        laws = list(laws)
        for i in hit:
            law, row = laws[i], z[i]
            height = float((weight * row * torch.tanh(law.height * row / (1 + law.spread**2))).sum()) / total
            excess = float((weight * row.square()).sum()) / total - height**2 - 1
            spread = math.sqrt(max(excess, _LEAST_SPREAD**2))
            laws[i] = Outliers(min(max(total / z.shape[-1], 1e-9), 0.5), height, spread)
    return _with_limits(z, laws, hit)


def _with_limits(z: Tensor, laws: list[Outliers], hit: list[int]) -> list[Outliers]:
    weight, rate = shock_posterior(z, laws), laws[hit[0]].rate
    scores = [(weight - rate) / (1 - rate)]  # with respect to log rate, heights, variances
    for i in hit:
        h, v, row = laws[i].height, 1 + laws[i].spread ** 2, z[i]
        signed = row * torch.tanh(h * row / v)
        scores += [weight * (signed - h) / v, weight * (row.square() - 2 * h * signed + h**2 - v) / (2 * v**2)]
    score = torch.stack(scores)
    covariance = torch.linalg.pinv(score @ score.mT, hermitian=True)
    result = list(laws)
    for k, i in enumerate(hit):
        law = laws[i]
        # amplitude^2 = height^2 + v - 1
        gradient = torch.tensor([law.height, 0.5], dtype=torch.float64) / law.amplitude
        own = covariance[1 + 2 * k : 3 + 2 * k, 1 + 2 * k : 3 + 2 * k]
        amplitude_sd = math.sqrt(float(gradient @ own @ gradient))
        result[i] = law._replace(
            rate_limits=_limits(rate, rate * math.sqrt(float(covariance[0, 0]))),
            amplitude_limits=_limits(law.amplitude, amplitude_sd),
        )
    return result


def _limits(value: float, sd: float) -> tuple[float, float]:
    reach = math.exp(min(Z * sd / value, 50.0))
    return value / reach, value * reach
