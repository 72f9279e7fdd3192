"""A value that recurs where values do not: a dead band sets all that is near zero to zero.

How often a value would recur by chance is told by its neighbours: so many samples in so wide a gap, over the finest
difference between them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.multiplicity import sidak

_CONTINUOUS = 0.5  # share of samples with a value of their own
_NEIGHBOURS, _MORE = 64, 4096  # on either side: that tell how dense values are, and how fine
_FEWEST = 4  # times, of a value that is not known from another sensor
_ANOTHER_LAW = 1.5  # factor by which a law may differ from a normal one across a band
_OWN = 1e-3  # p value of a value that recurs in the simulation


class Recurring(NamedTuple):
    """The value of a sensor that recurs most often beyond chance, though not next to itself.

    Attributes:
        sensor: Position.
        value: It.
        times: How often it was reached, in one or several records.
        samples: That have it, those included that the one before had it as well.
        expected: By chance.
        density: Of samples around it, per unit of the signal.
        told_by: Samples that tell it.
        middle, spread: Mean and standard deviation of all values.
        below, above: The values next to it.
        places: Values that could have recurred.
    """

    sensor: int
    value: float
    times: int
    samples: int
    expected: float
    density: float
    effective_samples: int
    middle: float
    spread: float
    below: float
    above: float
    places: int

    @property
    def p_value(self) -> float:
        """Of as many, for having looked at every value of the sensor."""
        return sidak(float(stats.poisson.sf(self.times - 1, self.expected)), self.places)


@derived
def recurring_values(side: Records) -> tuple[Recurring | None, ...]:
    """Of each sensor, over the first record; `None` where values recur by their resolution, or none does."""
    return tuple(recurring(i, values) for i, values in enumerate(side.signal[0]))


def recurring(sensor: int, values: Tensor, value: float | None = None) -> Recurring | None:
    """The value of `(time,)` that recurs most often, or the one given, where it occurs at all."""
    new = torch.ones(len(values), dtype=torch.bool)
    new[1:] = values[1:] != values[:-1]  # what is held is no return
    unique, counts = torch.unique(values[new], return_counts=True)
    if len(unique) < 4 * _NEIGHBOURS:
        return None
    at = int(counts[1:-1].argmax()) + 1  # ends are a matter of limits
    # However wide a band is, the values beside it are their own.
    if len(unique) < _CONTINUOUS * int(counts.sum() - counts[at]):
        return None
    if value is not None:
        at = min(max(int(torch.searchsorted(unique, value)), 1), len(unique) - 2)
        if float(unique[at]) != value:
            return None
    if value is None and int(counts[at]) < _FEWEST:
        return None
    low, high = max(at - _NEIGHBOURS, 0), min(at + _NEIGHBOURS, len(unique) - 1)
    finest = float(unique[max(at - _MORE, 0) : at + _MORE + 1].diff().min())
    gap = float(unique[at + 1] - unique[at - 1])
    wide = float(unique[high] - unique[low]) - gap
    effective_samples = int(counts[low : high + 1].sum() - counts[at])
    density = effective_samples / max(wide, 1e-300)
    # Values near a lattice finer than the noise, such as that of rounded floats, recur as their neighbours do.
    around = torch.cat([counts[low:at], counts[at + 1 : high + 1]]).to(torch.float64)
    expected = max(density * finest, float((around * (around - 1)).sum() / around.sum()))
    return Recurring(
        sensor,
        float(unique[at]),
        int(counts[at]),
        int((values == unique[at]).sum()),
        expected,
        density,
        effective_samples,
        float(values.mean()),
        float(values.std()),
        float(unique[at - 1]),
        float(unique[at + 1]),
        len(unique) if value is None else 1,
    )


def missing_recurrences(comparison: Comparison) -> dict[int, tuple[Recurring, float]]:
    """Values that recur in the recording but not as often in the simulation, by sensor, with p values."""
    missing = {}
    n, other_n = comparison.n_samples, comparison.reference.signal.shape[-1]
    others = recurring_values(comparison.reference)
    reference = any(other is not None and other.p_value < _OWN for other in others)
    for own, other in zip(recurring_values(comparison.observed), others, strict=True):
        if own is None:
            continue
        p = own.p_value
        if reference:  # in other sensors too few to be seen by themselves
            both = own.times + (0 if other is None else other.times)
            p = max(p, float(stats.binom.sf(own.times - 1, both, n / (n + other_n))))
        missing[own.sensor] = (own, sidak(p, comparison.n_sensors))
    return missing


def band_limits(found: Recurring) -> tuple[float, float, float]:
    """Half-width of a dead band, and 95 % limits.

    The nearest value that was left lies beyond it by an exponential variable: `reach/b - 1` is F distributed over the
    count.
    """
    reach, count = min(found.value - found.below, found.above - found.value), found.times
    middle, high, low = (reach / (1 + float(stats.f.ppf(q, 2, 2 * count)) / count) for q in (0.5, 0.025, 0.975))
    return middle, low, high


def fits_band(found: Recurring) -> bool:
    """Whether as many samples are missing around the value as returned to it: it is not one that was filled in.

    What is missing is told by the density beside the band, as a normal law has it within; other laws are not far off.
    """
    reach, law = min(found.value - found.below, found.above - found.value), stats.norm(found.middle, found.spread)
    ends = found.value - reach, found.value + reach
    beside = float(law.pdf(ends[0]) + law.pdf(ends[1])) / 2
    wide = float(law.cdf(ends[1]) - law.cdf(ends[0])) / beside if beside > 0 else 2 * reach
    missing = max(wide, 2 * reach) * found.density
    least = found.times * stats.f.ppf(_OWN, 2 * found.effective_samples, 2 * found.times)
    most = found.samples * stats.f.isf(_OWN, 2 * found.effective_samples, 2 * found.samples)
    # The nearest value that is left lies beyond the band by one on average.
    return bool(least / _ANOTHER_LAW < missing < most * _ANOTHER_LAW - math.log(_OWN))
