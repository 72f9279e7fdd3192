"""How many values of a recording lie beyond a level, given the tail that a simulation shows.

Statistic: exceedances of levels of `|z|`. Null law: predictive. Beyond the simulation's 200th largest value the excess
of `z^2/2` has a Gaussian's tail, or a generalised Pareto one (Pickands, Ann. Statist. 3 (1975), 119), as likely
beforehand, its shape uniform and its scale uniform in the logarithm; the count is then negative binomial, since the
rate beyond the threshold is known from 200 events. A sum of Gaussian noise and outliers has neither tail: up to
half as far again as the simulation's largest value, p is at least that of two counts of the same rate, whose prior is
Jeffreys' with the mean of the simulation's sensors for one half.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

Array = NDArray[np.float64]

LEVELS = (3.5, 4.0, 4.5, 5.0, 6.0, 8.0, 11.0, 16.0, 23.0, 32.0)  # sd; further ones tell no more of any outlier
_EVENTS = 200  # that tell a tail: its shape to 0.1
_HIGHER = 1.5  # outliers may be so many times as large as the largest of as many: they have no common height
_TINY = 1e-12  # half squares that values on few steps of a converter have in place of 0
_BLOCKS = 64  # of a record, in which events are counted: long against clumps of some tens of samples
_CLUMPED = 0.05  # p value of counts that vary by more than Poisson's
_SHAPES = np.linspace(-0.35, 1.0, 28)  # of `z^2/2`: lighter than a uniform's ... heavier than Cauchy's
_SCALES = np.geomspace(0.03, 3.0, 40)  # over the mean excess: the scale of the heaviest and the lightest tail there


def tail_p_values(observed: Array, reference: Array) -> Array:
    """p values of the recording's exceedances in each sensor, `(sensor,)`, for all the levels looked at.

    Args:
        observed: Values in sd of the noise, `(sensor, time)`.
        reference: The same of the simulation, `(sensor, record, time)`.
    """
    n, m = observed.shape[-1], reference[0].size
    levels = np.array(LEVELS)
    clumps = np.array([dispersion(np.abs(z) > LEVELS[0]) for z in reference])[:, None]
    own = (np.abs(observed)[:, None] > levels[:, None]).sum(-1) / clumps
    other = (np.abs(reference)[:, None] > levels[:, None, None]).sum((-1, -2))
    shape = (other + other.mean(0)) / 2 / clumps + 0.5
    compared = _many_p_value(own, shape, shape * n / m)
    expected = np.stack([_predicted(z.ravel(), own[i], clumps[i, 0], n) for i, z in enumerate(reference)])
    p = np.where(levels < _HIGHER * np.abs(reference).max(), np.maximum(expected, compared), expected)
    return np.asarray(-np.expm1(len(levels) * np.log1p(-np.minimum(p.min(-1), 1 - 1e-16))))


def equal_rates_p_value(own: Array, other: Array, length: float) -> Array:
    """p value of so many events beside others of the same rate, in a record so many times as long (binomial)."""
    p = special.betainc(np.maximum(own, 1e-9), other + 1.0, length / (1 + length))
    return np.asarray(np.where(own > 0, p, 1.0))


def dispersion(events: NDArray[np.bool_]) -> float:
    """Variance over mean of counts of events `(record, time)` in blocks, 1 where it is not significantly larger.

    Events that come in clumps of `D` are as uncertain as a `D`-th of their number by themselves.
    """
    size = events.shape[-1] // _BLOCKS
    counts = events[..., : size * _BLOCKS].reshape(-1, size).sum(-1)
    mean = max(counts.mean(), 1e-12)
    index = float(counts.var(ddof=1) / mean)
    clumped = stats.chi2.sf(index * (len(counts) - 1), len(counts) - 1) < _CLUMPED
    return max(index, 1.0) if clumped else 1.0


def _many_p_value(counts: Array, shape: Array | float, mean: Array) -> Array:
    """Of so many events or more under the negative binomial law; counts need not be whole."""
    p = special.betainc(np.maximum(counts, 1e-9), shape, mean / (mean + shape))
    return np.asarray(np.where(counts > 0, p, 1.0))


def _predicted(z: Array, counts: Array, clumps: float, n: int) -> Array:
    """Probabilities of so many clumps beyond the levels, `(level,)`, or more in `n` values after `z` `(time,)`."""
    half_squares = np.sort(z**2 / 2)[::-1]
    n_events = min(_EVENTS, len(z) // 8)
    threshold, excess = half_squares[n_events], half_squares[:n_events] - half_squares[n_events]
    beyond = np.maximum(np.square(LEVELS) / 2 - threshold, 0.0)
    # The Gaussian's: z^2/2 has the density exp(-y)/sqrt(pi y).
    at = _log_erfc(threshold)
    y = np.maximum(excess + threshold, _TINY)
    gaussian = -y - np.log(math.pi * y) / 2 - at
    survival = [np.exp(_log_erfc(beyond + threshold) - at)]
    xi, scale = (v.ravel()[:, None] for v in np.meshgrid(_SHAPES, _SCALES * max(excess.mean(), _TINY), indexing="ij"))
    log_pareto = _log_survival(excess, xi, scale)
    density = log_pareto * (1 + xi) - np.log(scale)
    log_weight = np.concatenate([[gaussian.sum()], density.sum(-1) - math.log(len(xi))])
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    every = np.concatenate([survival, np.exp(_log_survival(beyond, xi, scale))])
    mean = n * n_events / len(z) * every
    return np.asarray(weight @ _many_p_value(counts, n_events / clumps, np.maximum(mean / clumps, 1e-300)))


def _log_erfc(y: Array | float) -> Array:
    """`log P(z^2/2 > y)` of a standard normal `z`."""
    return np.asarray(math.log(2) + special.log_ndtr(-np.sqrt(2 * np.asarray(y))))


def _log_survival(excess: Array, xi: Array, scale: Array) -> Array:
    """Of the generalised Pareto law, `-log(1 + xi x / scale) / xi`; the exponential where `xi` is small."""
    x = excess / scale
    small = np.abs(xi) < 1e-6
    safe = np.where(small, 1.0, xi)
    inside = 1 + safe * x
    with np.errstate(divide="ignore", invalid="ignore"):
        power = np.where(inside > 0, -np.log(np.maximum(inside, 1e-300)) / safe, -np.inf)
    return np.asarray(np.where(small, -x, power))
