"""How many values lie beyond a level: against a normal law, against another record, against another record's tail.

The predictive law: beyond the simulation's 200th largest value the excess of `z^2/2` has a Gaussian's tail, or a
generalised Pareto one, as likely beforehand, its shape uniform and its scale uniform in the logarithm; the count is
then negative binomial, since the rate beyond the threshold is known from 200 events. A sum of Gaussian noise and
outliers has neither tail: up to half as far again as the simulation's largest value, p is at least that of two counts
of the same rate, whose prior is Jeffreys' with the mean of the simulation's sensors for one half.

References:
    Pickands, Statistical inference using extreme order statistics, Ann. Statist. 3 (1975), 119.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import special, stats
from torch import Tensor

from gyrofuse.mismatch.decisions import CHANCE

Array = NDArray[np.float64]

# Levels, sd: close where counts are large, and no further than any outlier needs. Beyond the sixth normal noise of any
# length has no value, so that the first six are enough against it.
LEVELS = (3.5, 4.0, 4.5, 5.0, 6.0, 8.0, 11.0, 16.0, 23.0, 32.0)
GAUSSIAN_LEVELS = LEVELS[:6]


def counts_beyond(sizes: Tensor, levels: Tensor | None = None) -> Array:
    """Numbers of values beyond each level, `(..., level)`, one level after the other for the sake of memory.

    Args:
        sizes: Moduli of values in sd, `(..., time)`.
        levels: Levels, `(level,)`; those for Gaussian noise by default.
    """
    every = GAUSSIAN_LEVELS if levels is None else levels.tolist()
    return torch.stack([(sizes > level).sum(-1) for level in every], -1).numpy()


def chi_levels(n_sensors: int) -> Tensor:
    """Levels of the norm of so many normal values that are exceeded as often as the modulus of one exceeds its own."""
    return torch.from_numpy(stats.chi2.isf(2 * stats.norm.sf(GAUSSIAN_LEVELS), n_sensors)).sqrt()


def gaussian_tail_p_values(counts: Array, n: int) -> Array:
    """p values of so many of `n` moduli or more beyond the levels for Gaussian noise, Poisson's law, `(..., level)`."""
    return np.asarray(stats.poisson.sf(counts - 1, 2 * n * stats.norm.sf(GAUSSIAN_LEVELS)))


def of_all_levels(p_values: Array) -> Tensor:
    """p values `(...)` of the smallest over all levels `(..., level)` (Sidak)."""
    smallest = np.minimum(p_values.min(-1), 1 - 1e-16)
    return torch.from_numpy(np.asarray(-np.expm1(p_values.shape[-1] * np.log1p(-smallest))))


def tail_p_values(observed: Array, reference: Array) -> Tensor:
    """p values of the recording's exceedances in each sensor, `(sensor,)`, over all the levels.

    Args:
        observed: Values in sd of the noise, `(sensor, time)`.
        reference: Values of the simulation, likewise, `(sensor, record, time)`.
    """
    n, m = observed.shape[-1], reference[0].size
    levels = np.array(LEVELS)
    clumps = np.array([dispersion(torch.from_numpy(np.abs(z) > LEVELS[0])) for z in reference])[:, None]
    own, other = (counts_beyond(torch.from_numpy(np.abs(z)), torch.from_numpy(levels)) for z in (observed, reference))
    own, other = own / clumps, other.sum(1)
    shape = (other + other.mean(0)) / 2 / clumps + 0.5
    compared = _many_p_value(own, shape, shape * n / m)
    expected = np.stack([_predicted(z.ravel(), own[i], clumps[i, 0], n) for i, z in enumerate(reference)])
    # Outliers have no common height: they may be half as large again as the largest of as many.
    p = np.where(levels < 1.5 * np.abs(reference).max(), np.maximum(expected, compared), expected)
    return of_all_levels(p)


def equal_rates_p_value(own: Array, other: Array, length: float) -> Array:
    """p value of so many events or more beside others of the same rate (binomial); counts need not be whole.

    Args:
        own: Counts of the recording.
        other: Counts of the simulation, likewise.
        length: Length of the recording over that of the simulation.
    """
    p = special.betainc(np.maximum(own, 1e-9), other + 1.0, length / (1 + length))
    return np.asarray(np.where(own > 0, p, 1.0))


def dispersion(events: Tensor) -> float:
    """Variance over mean of counts of events `(record, time)` in 64 blocks, 1 where it is not significantly larger.

    Events that come in clumps of `D` are as uncertain as a `D`-th of their number by themselves.
    """
    size = events.shape[-1] // 64  # long against clumps of some tens of samples
    counts = events[..., : size * 64].unflatten(-1, (64, size)).sum(-1).flatten().to(torch.float64)
    index = float(counts.var() / counts.mean().clamp(min=1e-12))
    clumped = stats.chi2.sf(index * (len(counts) - 1), len(counts) - 1) < CHANCE
    return max(index, 1.0) if clumped else 1.0


def _many_p_value(counts: Array, shape: Array | float, mean: Array) -> Array:
    """p value of so many events or more under the negative binomial law; counts need not be whole."""
    p = special.betainc(np.maximum(counts, 1e-9), shape, mean / (mean + shape))
    return np.asarray(np.where(counts > 0, p, 1.0))


def _predicted(z: Array, counts: Array, clumps: float, n: int) -> Array:
    """Probabilities of so many clumps beyond the levels, `(level,)`, or more in `n` values after `z` `(time,)`."""
    tiny = 1e-12  # half squares that values on few steps of a converter have in place of 0
    half_squares = np.sort(z**2 / 2)[::-1]
    n_events = min(200, len(z) // 8)  # their tail has a shape known to 0.1
    threshold, excess = half_squares[n_events], half_squares[:n_events] - half_squares[n_events]
    beyond = np.maximum(np.square(LEVELS) / 2 - threshold, 0.0)
    # Gaussian: z^2/2 has the density exp(-y)/sqrt(pi y).
    at = _log_erfc(threshold)
    y = np.maximum(excess + threshold, tiny)
    gaussian = -y - np.log(math.pi * y) / 2 - at
    survival = [np.exp(_log_erfc(beyond + threshold) - at)]
    # Shapes of z^2/2 from lighter than a uniform law's to that of Cauchy's; scales over the mean excess that these
    # take.
    shapes, scales = np.linspace(-0.35, 1.0, 28), np.geomspace(0.03, 3.0, 40)
    xi, scale = (v.ravel()[:, None] for v in np.meshgrid(shapes, scales * max(excess.mean(), tiny), indexing="ij"))
    log_pareto = _log_survival(excess, xi, scale)
    density = log_pareto * (1 + xi) - np.log(scale)
    weight = special.softmax(np.concatenate([[gaussian.sum()], density.sum(-1) - math.log(len(xi))]))
    every = np.concatenate([survival, np.exp(_log_survival(beyond, xi, scale))])
    mean = n * n_events / len(z) * every
    return np.asarray(weight @ _many_p_value(counts, n_events / clumps, np.maximum(mean / clumps, 1e-300)))


def _log_erfc(y: Array | float) -> Array:
    """`log P(z^2/2 > y)` of a standard normal `z`."""
    return np.asarray(math.log(2) + special.log_ndtr(-np.sqrt(2 * np.asarray(y))))


def _log_survival(excess: Array, xi: Array, scale: Array) -> Array:
    """Log survival of the generalised Pareto law, `-log(1 + xi x / scale) / xi`; the exponential's where `xi` is 0."""
    x = excess / scale
    safe = np.where(np.abs(xi) < 1e-6, 1.0, xi)
    inside = 1 + safe * x
    power = np.where(inside > 0, -np.log(np.maximum(inside, 1e-300)) / safe, -np.inf)
    return np.asarray(np.where(safe == xi, power, -x))
