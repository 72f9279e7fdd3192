"""Facts about single values: the lattice they sit on, repeats, pile-ups at the extremes."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import special, stats
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.values.quantisation_grid import missing_lattices
from gyrofuse.mismatch.detectors.values.ties import missing_recurrences
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.multiplicity import sidak

END_STOPS = 1  # place of a converter's in the chain from sensor to numbers
_BLOCKS = 32  # whose spread tells how far repeats vary by themselves
_QUARTERS = 4
_BY_CHANCE = 3.0  # times the variance expected of quarters
_COUNTED = 20.0  # repeats that are expected, below which they are counted one by one
_COARSE, _AT_LAST_STEP = 0.05, 4.0  # of the noise; samples that may lie on a lattice's last step by chance
_CELLS = 10.0  # of the resolution in the noise's sd: how far the two largest values are apart on average, with margin
_SAME_END = 0.01  # sd of a sample given all others
_BY_CHANCE_AT_END = 0.005  # p value of so many more at the end than the simulation has


class Repeats(NamedTuple):
    """How often a sample equals the one before, and what is expected, each `(sensor,)`.

    Attributes:
        share: In the recording.
        expected: From the simulation and the recording's own resolution.
        sd: Of the difference, by chance.
        wanders: Whether it varies slowly over a record, more than by chance.
        events, simulated: How often samples began to repeat, in the recording and the simulation.
        by_resolution: Share of repeats that the recording's own resolution makes.
        n: Samples.
        m: Those of the simulation, as many as would repeat as often with the recording's noise.
    """

    share: Tensor
    expected: Tensor
    sd: Tensor
    wanders: Tensor
    events: Tensor
    reference: Tensor
    by_resolution: Tensor
    n: int
    m: Tensor

    @property
    def p_values(self) -> Tensor:
        """Of as many repeats or more, `(sensor,)`."""
        z = (self.share - self.expected - 0.5 / self.n) / self.sd
        # A wandering share is known from a few stretches of the record only.
        wandering = torch.from_numpy(stats.t.sf(z.numpy(), _QUARTERS - 1))
        many = torch.where(self.wanders, wandering, torch.special.ndtr(-z))
        # Few are a matter of counting: against the simulation's, and against what the resolution makes.
        few, beyond = self.n * self.expected.maximum(self.by_resolution), (self.events - 1).numpy()
        share = (self.n / (self.n + self.m)).numpy()
        compared = torch.from_numpy(stats.binom.sf(beyond, (self.events + self.reference).numpy(), share))
        counted = compared.maximum(torch.from_numpy(stats.poisson.sf(beyond, few.numpy())))
        return torch.where((few < _COUNTED) & ~self.wanders, counted, many)


def repeated(signal: Tensor) -> Tensor:
    """Which samples `(..., time)` equal the one before; the first one does not."""
    same = torch.zeros(signal.shape, dtype=torch.bool)
    same[..., 1:] = signal[..., 1:] == signal[..., :-1]
    return same


def repeats(comparison: Comparison) -> Repeats:
    """Repeats of the recording against those of the simulation, block by block."""
    same, other_same = (repeated(side.signal).movedim(1, 0) for side in (comparison.observed, comparison.reference))
    share, n_recorded, fast, slow = _repeat_shares(same)
    other, n_simulated, other_fast, other_slow = _repeat_shares(other_same)
    # A resolution finer than any lattice that matters, such as that of float32, makes a few.
    differences = comparison.recording.diff(dim=-1)
    density = 1 / (math.sqrt(2 * math.pi) * differences.square().mean(-1).sqrt())
    # Rounded values repeat by chance the more often the less there is of other noise.
    quieter = comparison.reference.signal.diff().abs().mean((0, -1)) / differences.abs().mean(-1).clamp(min=1e-300)
    quieter, by_resolution = quieter.clamp(min=1.0), _resolution(comparison) * density
    other = (other * quieter).clamp(max=1.0)
    expected = other + torch.where(other == 0, by_resolution, 0.0)
    binomial = expected * (1 - expected).clamp(min=0) + 1 / n_recorded
    variance = torch.maximum(binomial / n_recorded + binomial / n_simulated, fast + other_fast)
    # Of two paths that differ; what happens by chance varies by no more than about itself.
    wander = 2 * torch.minimum(slow + other_slow, expected.square())
    return Repeats(
        share,
        expected,
        (variance + wander).sqrt(),
        wander > variance,
        _events(same),
        _events(other_same),
        by_resolution,
        n_recorded,
        n_simulated / quieter,
    )


def _events(same: Tensor) -> Tensor:
    """How many runs of repeats `(sensor, record, time)` has, `(sensor,)`."""
    return (same[..., 1:] & ~same[..., :-1]).sum((1, 2))


def _repeat_shares(same: Tensor) -> tuple[Tensor, int, Tensor, Tensor]:
    """Share of repeats `(sensor,)`, of how many samples, and its variances from blocks and from quarters.

    Args:
        same: Which samples are repeats, `(sensor, record, time)`.
    """
    n = same.shape[-1] // _BLOCKS
    blocks = same[..., : n * _BLOCKS].unflatten(-1, (_BLOCKS, n)).to(torch.float64).mean(-1)
    quarters = blocks.unflatten(-1, (_QUARTERS, -1)).mean(-1).flatten(1)
    fast = blocks.flatten(1).var(-1)
    # On a coarse lattice repeats follow the slow bias between its points, which wanders over the whole record.
    slow = (quarters.var(-1) - _BY_CHANCE * fast * _QUARTERS / _BLOCKS).clamp(min=0)
    return blocks.mean((1, 2)), same[0].numel(), fast / blocks[0].numel(), slow


@derived
def _resolutions(side: Records) -> Tensor:
    return torch.stack([_finest_gap(values) for values in side.signal[0]])


def _finest_gap(values: Tensor) -> Tensor:
    gaps = values.sort().values.diff()
    gaps = gaps[gaps > 0]
    return gaps.min() if len(gaps) else torch.zeros((), dtype=torch.float64)


def _resolution(comparison: Comparison) -> Tensor:
    """Smallest difference between two values of the recording, `(sensor,)`: its step where it is rounded."""
    return _resolutions(comparison.observed)


class EndStop(NamedTuple):
    """Where a sensor's values end.

    Attributes:
        sensor: Position.
        sign: 1 at the top, -1 at the bottom.
        limit: Its value.
        p_value: Of a Gaussian that never went beyond.
    """

    sensor: int
    sign: int
    limit: float
    p_value: float


def end_stops(comparison: Comparison) -> tuple[EndStop, ...]:
    """The ends of every sensor's values, with what says that they were cut.

    Given all other samples, `x_t` is normal with mean `m_t` and sd `s`: were nothing cut, the expected number `E` of
    samples beyond the largest one, `sum_t Q((max - m_t)/s)`, would be standard exponential or less. And continuous
    values do not meet their maximum twice.
    """
    expected = left_out(comparison.observed)
    found = []
    for i in range(comparison.n_sensors):
        x, mean, sd = comparison.recording[i], comparison.recording[i] - expected.error[0, i], float(expected.sd[0, i])
        resolution = float(_resolution(comparison)[i])
        rounded = resolution > _COARSE * sd
        mean, sd = _regressed(x, mean, resolution)
        for sign in (1, -1):
            limit = float((sign * x).max())
            at = sign * x == limit
            runs = int((at[1:] & ~at[:-1]).sum()) + int(at[0])
            if runs < 2 or _simulation_ends(comparison, i, sign):
                found.append(EndStop(i, sign, sign * limit, 1.0))
                continue
            beyond = float(torch.special.ndtr((sign * mean - limit - resolution / 2) / sd).sum())
            by_chance = min(_CELLS * max(_resolution_near(x, limit), resolution) / sd, 1.0) ** (runs - 1)
            p = min(math.exp(-beyond), by_chance)
            if rounded:  # tails of rounded noise are not normal: the number at the end has to tell too
                p = max(p, float(special.pdtrc(runs - 1, _AT_LAST_STEP)))
            found.append(EndStop(i, sign, sign * limit, sidak(p, 4 * comparison.n_sensors)))
    return tuple(found)


def _resolution_near(values: Tensor, end: float) -> float:
    """Smallest difference between two values that are as large: those of few digits are finer near zero."""
    return float(_finest_gap(values[values.abs() > abs(end) / 2]))


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
    cell = 0.99 * float(_resolution(comparison)[sensor])
    own, other = (_at_end(sign * side.signal[:, sensor], cell) for side in (comparison.observed, comparison.reference))
    if other.again / other.n >= 0.5 * own.again / own.n:
        return True
    chance = float(stats.binom.sf(own.again - 1, own.again + other.again, own.n / (own.n + other.n)))
    within = other.reach < own.reach + _SAME_END * float(left_out(comparison.observed).sd[0, sensor])
    given = any(place == END_STOPS for place, _ in comparison.converter)
    return (other.again > 0 or (given and within)) and chance > _BY_CHANCE_AT_END


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
    rounded = missing_lattices(comparison, 1.0)
    if rounded.lattices:
        at, found = min(rounded.lattices.items(), key=lambda item: item[1].p_value)
        candidates.append((rounded.p_value, at, f"values on a lattice of {found.step:.4g} {comparison.info.measure}"))
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
    p, sensor, words = min(candidates)
    return TestResult(
        "marginal",
        sidak(p, 4),
        f"{words} in sensor {comparison.info.sensors[sensor]}",
        sensors=(sensor,),
        levels=(1,),
    )
