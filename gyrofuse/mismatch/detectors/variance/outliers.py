"""Outliers of single samples, against those that the simulation has itself.

Statistic: numbers of standardised prediction errors beyond levels from 3.5 sd on, in each sensor, and of their norms in
all sensors together. Null law: Poisson's with normal probabilities where the simulation is Gaussian, or the binomial
one of two counts at levels at which it has more; elsewhere the law that the simulation's own tail predicts
(`stats.tails`). Many weak outliers are searched for by `weak_outliers`. That the simulation has outliers which the
recording has not is asked of two counts of one rate.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CHANCE
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.variance.normality import counts_of_errors, gaussian_sensors, tail_counts
from gyrofuse.mismatch.detectors.variance.weak_outliers import WeakOutliers, weak_outliers
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.decorrelation import norms
from gyrofuse.mismatch.stats.kurtosis import clipped_sd
from gyrofuse.mismatch.stats.level_scan import local_level
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_reference, sidak
from gyrofuse.mismatch.stats.tails import (
    LEVELS,
    Array,
    chi_levels,
    counts_beyond,
    dispersion,
    equal_rates_p_value,
    gaussian_tail_p_values,
    of_all_levels,
    tail_p_values,
)


def outliers_test(comparison: Comparison) -> TestResult:
    """Outliers of single samples, sensor by sensor and all together."""
    p_values, p_value = spike_p_values(comparison), spike_p_value(comparison)
    z = left_out(comparison.observed).z[0].abs()
    worst = int(p_values[:-1].argmin())
    at = int(z[worst].argmax())
    count = int((z[worst] > 5).sum())
    name = comparison.info.sensors[worst]
    what = f"{count} samples beyond 5 sd" if count else "more samples far out than the simulation has"
    words = f"{what} in sensor {name}, the largest {float(z[worst, at]):.3g} sd"
    sensors: tuple[int, ...] = (worst,)
    if sidak(float(p_values.min()), len(p_values)) > p_value and (many := likely_outliers(comparison)) is not None:
        sensors = tuple((many.sensors > 0.5).nonzero()[:, 0].tolist()) or sensors
        words = f"outliers of {many.size:g} sd {'in several sensors at once' if many.shock else 'in single sensors'}"
    fewer = _fewer_p_values(comparison)
    p_fewer = fewer_outliers_p_value(comparison)
    place: float | None = at / comparison.info.rate
    if p_fewer < p_value:
        sensors, place = (int(fewer[:-1].argmin()),), None
        words = f"fewer samples far out than the simulation has in sensor {comparison.info.sensors[sensors[0]]}"
    return TestResult("spike", sidak(min(p_fewer, p_value), 2), words, sensors=sensors, levels=(1,), time_s=place)


def fewer_outliers_p_value(comparison: Comparison) -> float:
    """p value of as few outliers in any sensor as the recording has beside the simulation's."""
    fewer = _fewer_p_values(comparison)
    return sidak(float(fewer.min()), len(fewer))


def spike_p_value(comparison: Comparison) -> float:
    """p value of outliers anywhere, by the tails or by many weak ones."""
    tails = spike_p_values(comparison)
    return sidak(min(sidak(float(tails.min()), len(tails)), _weak_p_value(comparison)), 2)


def spike_p_values(comparison: Comparison) -> Tensor:
    """p values of the tails of each sensor, and of all together, `(sensor + 1,)`, over all levels."""
    gaussian = gaussian_sensors(comparison.reference)
    p_values = _against_gaussian(comparison)
    if bool(gaussian.all()):
        return p_values
    observed, reference = map(_levelled, (comparison.observed, comparison.reference))
    predicted = tail_p_values(observed[0].numpy(), reference.movedim(1, 0).numpy())
    own, other = counts_of_errors(observed)[-1], counts_of_errors(reference)[-1]
    clumps = dispersion(norms(reference) > chi_levels(comparison.n_sensors)[0])
    length = observed[:, 0].numel() / reference[:, 0].numel()
    together = of_all_levels(equal_rates_p_value(own / clumps, other / clumps, length))
    return torch.cat([torch.where(gaussian, p_values[:-1], predicted), together[None]])


@derived
def _fewer_p_values(comparison: Comparison) -> Tensor:
    """p values of as few outliers as the recording has beside the simulation's, `(sensor + 1,)`.

    In each sensor, and counted together.
    """
    gaussian = gaussian_sensors(comparison.reference)
    if bool(gaussian.all()):
        return torch.ones(comparison.n_sensors + 1, dtype=torch.float64)
    observed, reference = (_levelled(side).abs() for side in (comparison.observed, comparison.reference))
    own, other = (counts_beyond(sizes, torch.tensor(LEVELS)).sum(0) for sizes in (observed, reference))
    far = (reference > LEVELS[0]).movedim(1, 0)  # (sensor, record, time)
    length = reference[:, 0].numel() / observed[:, 0].numel()

    def p_values(own: Array, other: Array, clumps: Array) -> Tensor:
        return of_all_levels(equal_rates_p_value(other / clumps, own / clumps, length))

    each = p_values(own, other, np.array([[dispersion(events)] for events in far]))
    together = p_values(own.sum(0), other.sum(0), np.array(dispersion(far.sum(0))))
    return torch.cat([torch.where(gaussian, 1.0, each), together[None]])


def _against_gaussian(comparison: Comparison) -> Tensor:
    """p values of the tails beside those of a Gaussian simulation, `(sensor + 1,)`."""
    own, other = tail_counts(comparison.observed), tail_counts(comparison.reference)
    n, m = (left_out(side).z[:, 0].numel() for side in (comparison.observed, comparison.reference))
    heavy = gaussian_tail_p_values(other, m) < CHANCE  # of effects that were built into a model
    return of_all_levels(np.where(heavy, equal_rates_p_value(own, other, n / m), gaussian_tail_p_values(own, n)))


def _levelled(side: Records) -> Tensor:
    """Errors `(record, sensor, time)` over the local level of the noise, in a robust sd of theirs."""
    expected = left_out(side)
    z = expected.z / local_level(expected.white).sqrt()
    return z / clipped_sd(z)[..., None]


def _weak_p_value(comparison: Comparison) -> float:
    """p value of many weak outliers in the sensors whose tails are Gaussian in the simulation."""
    own = likely_outliers(comparison)
    if own is None or own.p_value > CHANCE:
        return 1.0 if own is None else own.p_value
    reference = left_out(comparison.reference).z[0][gaussian_sensors(comparison.reference)]
    return p_value_beyond_reference(own.p_value, weak_outliers(reference).p_value)


@derived
def likely_outliers(comparison: Comparison) -> WeakOutliers | None:
    """Evidence of weak outliers in the sensors whose tails are Gaussian in the simulation; `None` if none are."""
    gaussian = gaussian_sensors(comparison.reference)
    if not bool(gaussian.any()):
        return None
    found = weak_outliers(left_out(comparison.observed).z[0][gaussian])
    sensors = torch.zeros(comparison.n_sensors, dtype=found.sensors.dtype)
    sensors[gaussian] = found.sensors
    return found._replace(sensors=sensors)
