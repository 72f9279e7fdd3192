"""A value that recurs where values do not: a dead band sets all that is near zero to zero.

Statistic: number of returns to the value that recurs most often. Null law: Poisson's, with the rate of its neighbours:
as many samples in as wide a gap, over the finest difference between them; over all values.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.decisions import CERTAIN
from gyrofuse.mismatch.detectors.values.lattices import distinct_values
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak

_FEWEST = 4  # returns to a value that is not known from another sensor
_NEIGHBOURS = 64  # values on either side, from which the density is known to a tenth


class Recurring(NamedTuple):
    """The value of a sensor that recurs most often beyond chance, though not next to itself.

    Attributes:
        sensor: Position of the sensor.
        value: Recurring value, unit of the signal.
        times: Number of returns to it.
        samples: Number of samples that have it, those included whose predecessor has it as well where others do not
            repeat; else as many fewer as these are.
        expected: Number of returns by chance.
        density: Samples around it per unit of the signal.
        effective_samples: Number of samples from which the density is known.
        middle, spread: Mean and standard deviation of all values.
        below, above: Values next to it.
        n_values: Number of values that could have recurred.
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
    n_values: int

    @property
    def p_value(self) -> float:
        """p value of as many returns, over every value of the sensor."""
        return sidak(float(stats.poisson.sf(self.times - 1, self.expected)), self.n_values)

    @property
    def reach(self) -> float:
        """Distance to the nearest other value."""
        return min(self.value - self.below, self.above - self.value)


@derived
def _recurring_values(side: Records) -> tuple[Recurring | None, ...]:
    """Recurring value of each sensor, over the first record; `None` where values recur by their resolution, or none."""
    counts = (int(counts.max()) for _, counts in distinct_values(side))
    rows = enumerate(zip(side.signal[0], counts, strict=True))
    return tuple(recurring(i, values) if most >= _FEWEST else None for i, (values, most) in rows)


def recurring(sensor: int, values: Tensor, value: float | None = None) -> Recurring | None:
    """The value of a sensor that recurs most often, four times at least, or the one given, where it occurs at all.

    Args:
        sensor: Position of the sensor.
        values: Samples, `(time,)`.
        value: Value known from another sensor.
    """
    new = torch.ones(len(values), dtype=torch.bool)
    new[1:] = values[1:] != values[:-1]  # what is held is no return
    unique, counts = torch.unique(values[new], return_counts=True)
    if len(unique) < 4 * _NEIGHBOURS:
        return None
    at = int(counts.argmax())
    if at in (0, len(unique) - 1) and not stands_alone(
        values[values != unique[at]], float(unique[at]), int(counts[at])
    ):
        at = int(counts[1:-1].argmax()) + 1  # ends are a matter of limits
    # However wide a band is, half of the values beside it are their own; else they recur by their resolution.
    if len(unique) < 0.5 * int(counts.sum() - counts[at]):
        return None
    if value is not None:
        at = min(int(torch.searchsorted(unique, value)), len(unique) - 1)
    if float(unique[at]) != value if value is not None else int(counts[at]) < _FEWEST:
        return None
    low, high = max(at - _NEIGHBOURS, 0), min(at + _NEIGHBOURS, len(unique) - 1)
    finest = float(unique[max(at - 4096, 0) : at + 4097].diff().min())
    below = float(unique[at - 1]) if at else -math.inf
    above = float(unique[at + 1]) if at + 1 < len(unique) else math.inf
    gap = above - below if math.isfinite(above - below) else 0.0
    around = torch.cat([counts[low:at], counts[at + 1 : high + 1]]).to(torch.float64)
    density = float(around.sum()) / max(float(unique[high] - unique[low]) - gap, 1e-300)
    other = values != unique[at]
    fresh = float(new[other].to(torch.float64).mean())  # share of the other samples that repeat none
    return Recurring(
        sensor=sensor,
        value=float(unique[at]),
        times=int(counts[at]),
        samples=max(int(counts[at]), round(int((~other).sum()) * fresh)),
        # Values near a grid finer than the noise, such as that of rounded floats, recur as their neighbours do.
        expected=max(density * finest, float((around * (around - 1)).sum() / around.sum())),
        density=density,
        effective_samples=int(around.sum()),
        middle=float(values.mean()),
        spread=float(values.std()),
        below=below,
        above=above,
        n_values=len(unique) if value is None else 1,
    )


def stands_alone(others: Tensor, value: float, times: int) -> bool:
    """Whether a value at the end of all others `(time,)` occurs more often than any that was cut there would.

    Tails fall: half a standard deviation before an end stop, and at the next value on a lattice, there are more values
    than beyond it.
    """
    distance, fewest = (others - value).abs(), 1 / 4 if times < len(others) / 2 else 1 / 8
    return float((distance <= max(float(others.std()) / 2, 1.5 * float(distance.min()))).sum()) < fewest * times


def missing_recurrences(comparison: Comparison) -> dict[int, tuple[Recurring, float]]:
    """Values that recur in the recording but not as often in the simulation, by sensor, with p values."""
    missing = {}
    n, other_n = comparison.n_samples, comparison.reference.signal.shape[-1]
    others = _recurring_values(comparison.reference)
    reference = any(other is not None and other.p_value < CERTAIN for other in others)
    for own, other in zip(_recurring_values(comparison.observed), others, strict=True):
        if own is None:
            continue
        p = own.p_value
        if reference:  # in other sensors of the simulation too few to be significant by themselves
            both = own.times + (0 if other is None else other.times)
            p = max(p, float(stats.binom.sf(own.times - 1, both, n / (n + other_n))))
        missing[own.sensor] = (own, sidak(p, comparison.n_sensors))
    return missing


class Band(NamedTuple):
    """A dead band around a value that recurs.

    Attributes:
        half_width: Half-width, and 95 % limits `low` and `high`, unit of the signal.
        centre: Mean of the values without the band.
        subtracts: Whether what lies beyond is put out less the half-width: the band leaves no gap then.
    """

    half_width: float
    low: float
    high: float
    centre: float
    subtracts: bool


def band_of(found: Recurring, values: Tensor, sd: float) -> Band | None:
    """The dead band that makes a value recur; None of a value that was filled in.

    Args:
        found: The value.
        values: Samples, `(time,)`.
        sd: Standard deviation of the simulation's values.
    """
    if not math.isfinite(found.above - found.below):  # a band has values on either side
        return None
    laws = [(found.middle, found.spread), (found.middle, sd)]
    if (beyond := _law_beyond(found, values, sd)) is not None:
        laws.insert(0, beyond)
    # What is put out in a wide band has nearly all of the values, and their scatter is not that of what it took.
    if any(_leaves_gap(found, *law) for law in laws):
        return Band(*_limits(found), laws[0][0], False)
    return _subtracted(found, values, sd)


def _subtracted(found: Recurring, values: Tensor, sd: float) -> Band | None:
    """A band that pulls what lies beyond it in: beside the value it is as dense as at the ends of the band.

    The shares below and above the value tell band and mean of a normal law of the simulation's standard deviation. What
    is pulled in scatters less than what is left where a value was filled in.
    """
    n, law, as_dense, nearer = len(values), stats.norm(), 1.25, 3.0
    below, above = float((values < found.value).sum()) / n, float((values > found.value).sum()) / n
    if min(below, above) < 10 / n or sd <= 0:
        return None
    z = law.ppf(below), law.isf(above)
    at_ends = (law.pdf(z[0]) + law.pdf(z[1])) / 2 / sd * n
    x = torch.from_numpy(law.ppf((np.arange(1000) + 0.5) / 1000))
    pulled = float(((x - z[1]).clamp(min=0) + (x - z[0]).clamp(max=0)).std()) * sd
    share = found.samples / n
    filled = math.sqrt(1 - share) * math.hypot(sd, math.sqrt(share) * (found.value - found.middle))
    spread = float(values.std())
    off, otherwise = abs(math.log(spread / pulled)), abs(math.log(spread / filled))
    if abs(math.log(found.density / at_ends)) > math.log(as_dense) or nearer * off + 4 / math.sqrt(n) > otherwise:
        return None
    half_width = sd * float(z[1] - z[0]) / 2
    reach = Z * math.hypot(math.sqrt(share * (1 - share) / n) * sd / float(law.pdf(z).sum()), half_width / math.sqrt(n))
    centre = found.value - sd * float(z[0] + z[1]) / 2
    return Band(half_width, max(half_width - reach, 0.0), half_width + reach, centre, True)


def _limits(found: Recurring) -> tuple[float, float, float]:
    """Half-width of a dead band, and 95 % limits.

    The nearest value that was left lies beyond it by an exponential variable: `reach/b - 1` is F distributed over the
    count.
    """
    middle, high, low = (
        found.reach / (1 + float(stats.f.ppf(q, 2, 2 * found.times)) / found.times) for q in (0.5, 0.025, 0.975)
    )
    return middle, low, high


def _law_beyond(found: Recurring, values: Tensor, sd: float) -> tuple[float, float] | None:
    """Mean and sd of the normal law that has as many values on either side of a band.

    None of a narrow band, or where they scatter by far less or more than the simulation's.
    """
    n, reach, narrow, alike = len(values), found.reach, 0.2, 2.0  # sd; factor
    below, above = (int((sign * (values - found.value) >= reach).sum()) for sign in (-1, 1))
    z = float(stats.norm.ppf(below / n)), float(stats.norm.isf(above / n))
    if not narrow < z[1] - z[0] < math.inf:
        return None
    own = 2 * reach / (z[1] - z[0])
    return (found.value - own * (z[0] + z[1]) / 2, own) if sd / alike < own < alike * sd else None


def _leaves_gap(found: Recurring, middle: float, sd: float) -> bool:
    """Whether as many samples are missing around the value as have it: it is not one that was filled in.

    Samples that hold the value are missing as well, and say no more than the returns to it.

    The number missing follows from the density beside the band, as a normal law has it within; other laws are within a
    factor of 1.5. The nearest value that is left lies beyond the band by one on average.
    """
    if sd <= 0:
        return False
    law, reach = stats.norm(middle, sd), found.reach
    ends = found.value - reach, found.value + reach
    each = [max(float(law.pdf(end)), 1e-300) for end in ends]
    beside = 2 / (1 / each[0] + 1 / each[1])  # as many values on either side lie in stretches as long as they are rare
    wide = float(law.cdf(ends[1]) - law.cdf(ends[0])) / beside
    missing = max(wide, 2 * reach) * found.density
    least = found.samples * stats.f.ppf(CERTAIN, 2 * found.effective_samples, 2 * found.times)
    most = found.samples * stats.f.isf(CERTAIN, 2 * found.effective_samples, 2 * found.samples)
    return bool(least / 1.5 < missing < 1.5 * most - math.log(CERTAIN))
