"""Facts about single values: the lattice they sit on, repeats, pile-ups at the extremes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import special, stats
from torch import Tensor

from gyrofuse.mismatch.decisions import CERTAIN, CHANCE
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.values.lattices import distinct_values, exact_lattices
from gyrofuse.mismatch.detectors.values.missing_codes import missing_codes
from gyrofuse.mismatch.detectors.values.quantisation_grid import missing_lattices
from gyrofuse.mismatch.detectors.values.straight_lines import straight_lines
from gyrofuse.mismatch.detectors.values.ties import missing_recurrences, stands_alone
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.long_run_variance import long_run_variance
from gyrofuse.mismatch.stats.multiplicity import sidak

END_STOPS = 1  # position of a converter's end stops in the chain from sensor to numbers


class Repeats(NamedTuple):
    """How often a sample equals the one before, and what is expected, `(sensor,)` but for the first.

    Attributes:
        same: Which samples of the recording repeat the one before, `(sensor, time)`; none where values end, which is
            what makes them the same.
        share: Share of repeats in the recording.
        expected: Share expected from the simulation and the recording's own resolution.
        sd: Standard deviation of the difference by chance.
        p_values: p values of as many repeats or more.
        n: Number of samples.
    """

    same: Tensor
    share: Tensor
    expected: Tensor
    sd: Tensor
    p_values: Tensor
    n: int


def repeated(signal: Tensor) -> Tensor:
    """Which samples `(..., time)` equal the one before; the first one does not."""
    same = torch.zeros(signal.shape, dtype=torch.bool)
    same[..., 1:] = signal[..., 1:] == signal[..., :-1]
    return same


@derived
def repeats(comparison: Comparison) -> Repeats:
    """Repeats of the recording against those of the simulation.

    Null law: Student's `t` with the long-run variance of the simulation's repeats, since on a coarse grid these follow
    the slow bias between its points; fewer than 20 are counted one by one, against those of the simulation (binomial)
    and those that the resolution makes (Poisson).
    """
    same, other_same = (repeated(side.signal).movedim(1, 0) for side in (comparison.observed, comparison.reference))
    for end in end_stops(comparison):
        if end.p_value < CERTAIN:
            same[end.sensor] &= comparison.recording[end.sensor] != end.limit
    n, m = same[0].numel(), other_same[0].numel()
    share, other = (side.to(torch.float64).mean((1, 2)) for side in (same, other_same))
    # A resolution finer than any grid that matters, such as that of float32, makes a few.
    differences = comparison.recording.diff(dim=-1)
    density = 1 / (math.sqrt(2 * math.pi) * differences.square().mean(-1).sqrt())
    by_resolution = _resolutions(comparison.observed) * density
    # Rounded values repeat by chance the more often the less there is of other noise.
    quieter = comparison.reference.signal.diff().abs().mean((0, -1)) / differences.abs().mean(-1).clamp(min=1e-300)
    quieter = quieter.clamp(min=1.0)
    expected = (other * quieter).clamp(max=1.0) + torch.where(other == 0, by_resolution, 0.0)
    spreads = [long_run_variance(rows.to(torch.float64)) for rows in other_same]
    wander = quieter.square() * torch.tensor([spread.value for spread in spreads], dtype=torch.float64)
    binomial = expected * (1 - expected).clamp(min=0) + 1 / n
    sd = (wander.maximum(binomial) * (1 / n + 1 / m)).sqrt()
    dof = np.where(wander > binomial, [spread.dof for spread in spreads], np.inf)
    many = stats.t.sf(((share - expected - 0.5 / n) / sd).numpy(), dof)
    few, events, other_events = n * expected.maximum(by_resolution), _events(same), _events(other_same)
    portion = (n / (n + m / quieter)).numpy()  # of a simulation as long as would repeat as often with this noise
    compared = stats.binom.sf((events - 1).numpy(), (events + other_events).numpy(), portion)
    by_resolution_alone = stats.poisson.sf((events - 1).numpy(), few.numpy())
    # A sensor that hangs is no matter of how often values meet.
    longest = repeats_so_far(same).amax((1, 2))
    hangs = (longest >= 8) & (other_events == 0)
    row = n * by_resolution.clamp(min=1 / n).pow(longest)  # expected number of rows as long, each value by chance
    hanging = np.minimum(by_resolution_alone, row.numpy())
    counted = np.where(hangs.numpy(), hanging, np.maximum(compared, by_resolution_alone))
    p_values = torch.from_numpy(np.where(few.numpy() < 20.0, counted, many))
    coarser = _met_as_often_later(comparison.observed.signal.movedim(1, 0), share, expected, longest)
    p_values = torch.where(coarser, 1.0, p_values).minimum(_in_a_row(longest, other_same, quieter, n))
    return Repeats(same[:, 0], share, expected, sd, p_values, n)


def _in_a_row(longest: Tensor, other: Tensor, quieter: Tensor, n: int) -> Tensor:
    """p values of as many repeats in a row beside those of a simulation that repeats as well, `(sensor,)`.

    One more follows there with a share that is known; rows less than twice as long as its own say nothing.

    Args:
        longest: Repeats in a row, `(sensor,)`.
        other: The simulation's repeats, `(sensor, record, time)`.
        quieter: By how much more often the recording's values meet, `(sensor,)`.
        n: Samples of the recording.
    """
    total, events, own = other.sum((1, 2)), _events(other), repeats_so_far(other).amax((1, 2))
    follows = ((total - events + 1) / (total + 2) * quieter).clamp(max=1.0)
    rows = (n * follows.pow(longest)).clamp(max=1.0)  # expected number, each repeat by chance
    return torch.where((longest >= 8) & (longest > 2 * own) & (events > 0), rows, 1.0)


def _met_as_often_later(signal: Tensor, share: Tensor, expected: Tensor, longest: Tensor) -> Tensor:
    """Whether samples `(sensor, record, time)` equal later ones about as often as the next one, `(sensor,)`.

    Values are coarser then, by whatever lattice; a sample that is read twice is no more like the one after next. Rows
    far longer than those of chance are those of a sensor that hangs: within a row as many count as chance has there.
    """
    lags, beyond_chance = torch.arange(3, 7), 4.0
    so_far, found = repeats_so_far(repeated(signal)), []
    for lag in lags.tolist():
        meets, row = signal[..., lag:] == signal[..., :-lag], so_far[..., lag:] >= lag
        across, within = ((meets & part).to(torch.float64).mean((1, 2)) for part in (~row, row))
        found.append(across + within.minimum(share**lag))
    later = torch.stack(found).mean(0)
    excess = (share - expected).clamp(min=0)
    twice = excess.pow(lags[:, None]).mean(0)  # of samples that repeat one by one
    by_chance = math.log(1e3 * signal[0].numel()) / -share.clamp(1e-12, 1 - 1e-12).log()
    return (later - expected > (excess + twice) / 2) & (longest < beyond_chance * by_chance)


def _events(same: Tensor) -> Tensor:
    """How many runs of repeats `(sensor, record, time)` has, `(sensor,)`."""
    return (same[..., 1:] & ~same[..., :-1]).sum((1, 2))


def repeats_so_far(same: Tensor) -> Tensor:
    """How many repeats one after the other each sample ends, `(..., time)`."""
    place = torch.arange(1, same.shape[-1] + 1)
    return place - torch.where(same, 0, place).cummax(-1).values


@derived
def _resolutions(side: Records) -> Tensor:
    """Smallest difference between two values of the first record, `(sensor,)`: its step where it is rounded.

    Values on a grid may differ from each other by what arithmetic left of it as well.
    """
    gaps = [_finest_gap(unique) for unique, _ in distinct_values(side)]
    steps = (0.0 if own is None else own.step for own in exact_lattices(side))
    return torch.stack([gap.clamp(min=0.99 * step) for gap, step in zip(gaps, steps, strict=True)])


def _finest_gap(unique: Tensor) -> Tensor:
    """Smallest difference between two distinct values; 0 of a single value."""
    return unique.diff().min() if len(unique) > 1 else unique.new_zeros(())


class EndStop(NamedTuple):
    """Where a sensor's values end.

    Attributes:
        sensor: Position of the sensor.
        sign: 1 at the top, -1 at the bottom.
        limit: Largest or smallest value, unit of the signal.
        p_value: p value of values that are not cut.
    """

    sensor: int
    sign: int
    limit: float
    p_value: float


@derived
def end_stops(comparison: Comparison) -> tuple[EndStop, ...]:
    """The ends of every sensor's values, with p values of values that are not cut.

    Given all other samples, `x_t` is normal with mean `m_t` and sd `s`: were nothing cut, the expected number of
    samples beyond the largest one, `sum_t Q((max - m_t)/s)`, would be standard exponential or less. Continuous values
    do not meet their maximum twice either: the two largest are 10 cells of the resolution in the noise's sd apart, with
    margin. A stretch that was recorded twice does, after the same sample.
    """
    expected = left_out(comparison.observed)
    found = []
    for i in range(comparison.n_sensors):
        x, mean, sd = comparison.recording[i], comparison.recording[i] - expected.error[0, i], float(expected.sd[0, i])
        resolution = float(_resolutions(comparison.observed)[i])
        rounded = resolution > 0.05 * sd
        mean, sd = _regressed(x, mean, resolution)
        for sign in (1, -1):
            limit = float((sign * x).max())
            at = sign * x == limit
            begins = (at[1:] & ~at[:-1]).nonzero()[:, 0]  # samples before the limit is reached
            runs = int(at[0]) + (len(begins) if rounded else len(x[begins].unique()))
            if (
                runs < 2
                or _filled_in(comparison, i, at, max(3 * resolution, sd))
                or _simulation_ends(comparison, i, sign)
            ):
                found.append(EndStop(i, sign, sign * limit, 1.0))
                continue
            beyond = float(torch.special.ndtr((sign * mean - limit - resolution / 2) / sd).sum())
            # Values of few digits are coarser where they are large.
            near = float(_finest_gap(x[x.abs() > abs(limit) / 2].unique()))
            p = min(math.exp(-beyond), min(10.0 * max(near, resolution) / sd, 1.0) ** (runs - 1))
            if rounded:  # tails of rounded noise are not normal: chance has up to four at the end
                p = max(p, float(special.pdtrc(runs - 1, 4.0)))
            p = max(p, _as_next_to_it(sign * x, limit, resolution, sd))
            found.append(EndStop(i, sign, sign * limit, sidak(p, 4 * comparison.n_sensors)))
    return tuple(found)


def _as_next_to_it(x: Tensor, limit: float, step: float, sd: float) -> float:
    """p value of as many samples at the largest value as there are at those next to it, where values end at an edge.

    Of steps so small that the noise's density is about the same at all of these.
    """
    most, near = 8, 0.3  # steps; sd of the noise
    cells = min(most, int(near * sd / step)) if step > 0 else 0
    if not cells:
        return 0.0
    beside = int(((x < limit) & (x > limit - (cells + 0.5) * step)).sum())
    return float(special.pdtrc(int((x == limit).sum()) - 1, beside / cells)) if beside else 0.0


def _filled_in(comparison: Comparison, sensor: int, at: Tensor, far: float) -> bool:
    """Whether the largest or smallest value stands in the place of samples that are not there.

    Next to an end stop there are values, more than beyond it (`stands_alone`); and where it holds for long, others do
    not hang.

    Args:
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        at: Samples that have the value, `(time,)`.
        far: Distance to the next value that no end stop leaves.
    """
    x = comparison.recording
    same, ends = repeated(x), (x == x.amax(-1, keepdim=True)) | (x == x.amin(-1, keepdim=True))
    held = same[sensor] & at
    others = (same & ~ends).any(0)
    elsewhere = x[sensor, ~at]
    gap = float((elsewhere - x[sensor, at][0]).abs().min()) if len(elsewhere) else 0.0
    if gap > far or (len(elsewhere) and stands_alone(elsewhere, float(x[sensor, at][0]), int(at.sum()))):
        return True
    return int(held.sum()) > 8 and int((held & others).sum()) > 0.9 * int(held.sum())


def _regressed(x: Tensor, mean: Tensor, step: float) -> tuple[Tensor, float]:
    """Means `(time,)` that values have by regression on their predictions, and sd of what was rounded to a step.

    A prediction from noise has noise of its own, in which it goes beyond where any value would.
    """
    middle, about = x.mean(), mean - mean.mean()
    mean = middle + about * float((about * (x - middle)).mean() / about.square().mean().clamp(min=1e-300))
    variance = float((x - mean).square().mean())
    return mean, math.sqrt(max(variance - step**2 / 12, variance / 4))


def _simulation_ends(comparison: Comparison, sensor: int, sign: int) -> bool:
    """Whether the simulation has an end stop there: half as many samples at its limit.

    Or as many as chance allows, if it has any, or was given one and stays within.
    """
    cell = 0.99 * float(_resolutions(comparison.observed)[sensor])
    own, other = (_at_end(sign * side.signal[:, sensor], cell) for side in (comparison.observed, comparison.reference))
    if other.again / other.n >= 0.5 * own.again / own.n:
        return True
    chance = float(stats.binom.sf(own.again - 1, own.again + other.again, own.n / (own.n + other.n)))
    within = other.reach < own.reach + 0.01 * float(left_out(comparison.observed).sd[0, sensor])
    given = any(place == END_STOPS for place, _ in comparison.converter)
    return (other.again > 0 or (given and within)) and chance > CERTAIN


class _End(NamedTuple):
    """How many samples are less than a cell from each record's largest one beside it, of how many, and how high."""

    again: int
    n: int
    reach: float


def _at_end(values: Tensor, cell: float) -> _End:
    """Of `(record, time)`, the height about each record's mean."""
    top = values.amax(-1, keepdim=True)
    again = int((values >= top - cell).sum()) - len(values)
    return _End(again, values.numel(), float((top - values.mean(-1, keepdim=True)).max()))


def values_test(comparison: Comparison) -> TestResult:
    """Lattice, repeats, end stops and returns of single values, against those of the simulation."""
    same, candidates = repeats(comparison).p_values, []
    rounded = missing_lattices(comparison, CHANCE)
    if rounded.lattices:
        at, found = min(rounded.lattices.items(), key=lambda item: item[1].p_value)
        candidates.append((rounded.p_value, at, f"values on a lattice of {found.step:.4g} {comparison.info.measure}"))
    elif rounded.coarser:
        at, found = next(iter(rounded.coarser.items()))
        words = f"values off the lattice of {found.step:.4g} {comparison.info.measure} to which the simulation rounds,"
        candidates.append((rounded.p_value, at, words))
    often = int(same.argmin())
    candidates.append(
        (sidak(float(same[often]), comparison.n_sensors), often, "samples repeated more often than there")
    )
    ends = min(end_stops(comparison), key=lambda end: end.p_value)
    candidates.append((ends.p_value, ends.sensor, f"values that end at {ends.limit:.6g} {comparison.info.measure}"))
    candidates += [
        (p, i, f"{found.times} times the value {found.value:.6g} {comparison.info.measure}, where values do not recur,")
        for i, (found, p) in missing_recurrences(comparison).items()
    ]
    lines = straight_lines(comparison).p_values
    most = int(lines.argmin())
    p = sidak(float(lines[most]), comparison.n_sensors)
    candidates.append((p, most, "samples on a straight line between others"))
    candidates += [(one.p_value, i, "codes that are never put out") for i, one in missing_codes(comparison).items()]
    p, sensor, words = min(candidates)
    return TestResult(
        "marginal",
        sidak(p, 6),
        f"{words} in sensor {comparison.info.sensors[sensor]}",
        sensors=(sensor,),
        levels=(1,),
    )
