"""Facts about single values: the lattice they sit on, repeats, pile-ups at the extremes.

A lattice `offset + k step` is exact where values recur, and read off them. Hidden under noise that was added after the
rounding it still shows in the empirical characteristic function `phi(u) = mean exp(i u x)` at `u = 2 pi/step`: beyond
`5.5/s`, with `s` the sd of a sample given its past, `n |phi|^2` is standard exponential without a lattice.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import special, stats
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence, corrected
from gyrofuse.mismatch.impulses import left_out
from gyrofuse.mismatch.recurring import missing_recurrences
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.side import Side

_FINEST, _FINEST_HIDDEN = 1 / 50, 1 / 20  # steps that matter, of the sd of a sample given its past
_EXACT = 0.01  # distance from the lattice, steps, that arithmetic explains
_ON_LATTICE = 0.999  # of the samples; converters also have end stops
_GAUSSIAN_ENDS = 5.5  # u s, beyond which a Gaussian has no characteristic function left
_LOWEST = 3.5  # u s, where a peak found by its flank or its harmonics may still lie
_DOUBTFUL = 0.05  # p value of a lattice that is not looked at more closely
_AS_OTHERS = 0.02  # of one that other sensors have
_PER_STEP = 6  # histogram bins a step, at the finest
_MOST_BINS = 2**21
_SAME_STEP, _ALIKE = 1e-3, 0.04  # of steps that are exact, and hidden
_SIMULATED = 0.005  # p value of a hidden lattice that the simulation has as well
_BLOCKS = 32  # whose spread tells how far repeats vary by themselves
_QUARTERS = 4
_BY_CHANCE = 3.0  # times the variance expected of quarters
_COUNTED = 20.0  # repeats that are expected, below which they are counted one by one
_COARSE, _AT_LAST_STEP = 0.05, 4.0  # of the noise; samples that may lie on a lattice's last step by chance
_FEWEST_AT_END = 3  # samples at an end stop


class Lattice(NamedTuple):
    """Values `offset + k step`, blurred by `blur` steps, sd.

    Attributes:
        p_value: Of continuous values that look like it, for having looked at every step.
        peak: Where the characteristic function tells most of it, 0 where it is exact. Of few steps' width that is
            below `2 pi/step`, since what blurs the lattice damps high frequencies more.
    """

    step: float
    offset: float
    blur: float
    p_value: float
    peak: float = 0.0


def innovation_sd(side: Side) -> Tensor:
    """Sd of a sample given its past, `exp(integral log S)^(1/2)` (Kolmogorov), `(sensor,)`."""
    width = torch.tensor(side.bands.edges, dtype=torch.float64).diff()
    return ((side.power.log() * width).sum(-1) / width.sum() / 2).exp()


@remembered
def exact_lattices(side: Side) -> tuple[Lattice | None, ...]:
    """The lattice of each sensor's values in the first record that needs no statistics, `None` without."""
    return tuple(
        _exact_lattice(values, float(sd)) for values, sd in zip(side.signal[0], innovation_sd(side), strict=True)
    )


@remembered
def lattices(side: Side) -> tuple[Lattice | None, ...]:
    """The lattice of each sensor's values in the first record, `None` where nothing looks like one."""
    every = zip(exact_lattices(side), side.signal[0], innovation_sd(side), strict=True)
    return tuple(exact or _hidden_lattice(values.unique(), float(sd)) for exact, values, sd in every)


def _exact_lattice(values: Tensor, sd: float) -> Lattice | None:
    """From the gaps between values that recur."""
    unique, counts = torch.unique(values, return_counts=True)
    gaps = unique.diff()
    # A gap far below what matters is the noise of arithmetic.
    for step in (float(gaps.median()), float(gaps.min())) if len(gaps) > 1 else ():
        if step < _FINEST * sd:
            continue
        k = torch.cat([torch.zeros(1, dtype=torch.float64), (gaps / step).round().cumsum(0)])
        middle = (counts * k).sum() / counts.sum()
        mean = (counts * unique).sum() / counts.sum()
        step = float((counts * (k - middle) * (unique - mean)).sum() / (counts * (k - middle).square()).sum())
        off = (unique - mean) / step - (k - middle)
        if float(counts[off.abs() < _EXACT].sum() / counts.sum()) >= _ON_LATTICE:
            offset = math.remainder(float(mean - middle * step), step)
            return Lattice(step, offset, 0.0, 0.0)
    return None


def _hidden_lattice(unique: Tensor, sd: float) -> Lattice:
    """The most conspicuous step in the characteristic function; each value counts once, whatever repeats."""
    n, low = len(unique), unique[0]
    bin_width = sd * _FINEST_HIDDEN / _PER_STEP
    n_bins = min(1 << math.ceil(math.log2(max(4 * float(unique[-1] - low) / bin_width, 64))), _MOST_BINS)
    place = ((unique - low) / bin_width).long() % n_bins
    phi = torch.fft.rfft(torch.bincount(place, minlength=n_bins).to(torch.float64)) / n
    u = 2 * math.pi * torch.arange(len(phi), dtype=torch.float64) / (n_bins * bin_width)
    wanted = (u > _GAUSSIAN_ENDS / sd) & (u < 2 * math.pi / (_FINEST_HIDDEN * sd))
    power = n * phi.abs().square()
    best = int(torch.where(wanted, power, 0.0).argmax())
    p_value = corrected(math.exp(-float(power[best])), int(wanted.sum()))
    if p_value > _DOUBTFUL:
        return Lattice(2 * math.pi / float(u[best]), 0.0, 1.0, p_value, float(u[best]))
    while u[best] > _LOWEST / sd and power[best - 1] > power[best]:  # the flank of a peak below
        best -= 1
    frequency = _peak(unique, float(u[best]), float(u[1]))
    for part in (4, 3, 2):  # a harmonic may have come out largest
        lower = _power(unique, torch.tensor([frequency / part], dtype=torch.float64))
        if frequency / part > _LOWEST / sd and float(lower) > max(0.3 * float(power[best]), 10.0):
            frequency /= part
            break
    found = _seen_at(unique, frequency, 2 * math.pi / frequency)
    step = found.step / (1 + (found.step * found.blur) ** 2 / float(unique.var()))
    return _seen_at(unique, frequency, step)._replace(p_value=p_value)


def _seen_at(unique: Tensor, peak: float, step: float) -> Lattice:
    """A hidden lattice of a step and a peak that are known, with its p value."""
    n = len(unique)
    power = float(_power(unique, torch.tensor([peak], dtype=torch.float64)))
    resultant = math.sqrt(max((power - 1) / (n - 1), 1e-12)) if n > 1 else 1e-6
    blur = math.sqrt(-2 * math.log(min(resultant, 1 - 1e-12))) / (2 * math.pi)
    turn = torch.exp(2j * math.pi / step * unique).mean().angle()
    return Lattice(step, float(turn) / (2 * math.pi) * step, blur, math.exp(-power), peak)


def _power(values: Tensor, u: Tensor) -> Tensor:
    """`n |phi(u)|^2`, `(u,)`."""
    angle = u[:, None] * values
    return (angle.cos().mean(-1).square() + angle.sin().mean(-1).square()) * len(values)


def _peak(values: Tensor, u: float, spacing: float) -> float:
    """Maximum of the characteristic function within a bin of `u`, by thirds."""
    reach, values = spacing, values - values.mean()
    for _ in range(8):
        grid = u + reach * torch.linspace(-1, 1, 7, dtype=torch.float64)
        u = float(grid[_power(values, grid).argmax()])
        reach /= 3
    return u


def off_lattice(values: Tensor, step: float | Tensor, offset: float | Tensor) -> Tensor:
    """Distances of values from the nearest point of a lattice, steps."""
    place = (values - offset) / step
    return place - place.round()


def missing_lattices(case: Case, level: float) -> dict[int, Lattice]:
    """Lattices of the recording, by sensor, that the simulation does not have and could be rounded to."""
    missing = {}
    for i, own in enumerate(lattices(case.recorded)):
        if own is None or corrected(own.p_value, case.n_sensors) > level:
            continue
        left = _not_simulated(case, i, own)
        if left is not None and corrected(left.p_value, case.n_sensors) <= level:
            missing[i] = left
    if not missing:
        return missing
    clearest = min(missing.values(), key=lambda found: found.p_value)
    for i, own in enumerate(lattices(case.recorded)):  # a step that is known elsewhere needs less to be believed
        if i in missing or own is None:
            continue
        if own.blur > 0 and clearest.blur > 0:
            own = _seen_at(case.recording[i].unique(), clearest.peak, clearest.step)
        elif not any(abs(own.step / found.step - 1) < _ALIKE for found in missing.values()):
            continue
        left = _not_simulated(case, i, own) if own.p_value < _AS_OTHERS else None
        if left is not None and left.p_value < _AS_OTHERS:
            missing[i] = left
    return dict(sorted(missing.items()))


def _not_simulated(case: Case, sensor: int, own: Lattice) -> Lattice | None:
    """A lattice of the recording, with the p value of its being no clearer than the simulation's; `None` if exact."""
    values = case.simulated.signal[:, sensor].flatten()
    if own.blur == 0:
        other = exact_lattices(case.simulated)[sensor]
        return None if other is not None and other.step > own.step * (1 - _SAME_STEP) else own
    u, n, m = torch.tensor([own.peak], dtype=torch.float64), case.n_samples, len(values)
    power, other_power = (float(_power(v - v.mean(), u)) for v in (case.recording[sensor], values))
    if other_power < -math.log(_SIMULATED):
        return own
    clearer = max(math.sqrt(power / n) - math.sqrt(other_power / m), 0.0)
    return own._replace(p_value=max(own.p_value, math.exp(-(clearer**2) / (1 / n + 1 / m))))


class Repeats(NamedTuple):
    """How often a sample equals the one before, and what is expected, each `(sensor,)`.

    Attributes:
        share: In the recording.
        expected: From the simulation and the recording's own resolution.
        sd: Of the difference, by chance.
        wanders: Whether it varies slowly over a record, more than by chance.
        events, simulated: How often samples began to repeat, in the recording and the simulation.
        n, m: Samples of both.
    """

    share: Tensor
    expected: Tensor
    sd: Tensor
    wanders: Tensor
    events: Tensor
    simulated: Tensor
    n: int
    m: int

    @property
    def p_values(self) -> Tensor:
        """Of as many repeats or more, `(sensor,)`."""
        z = (self.share - self.expected - 0.5 / self.n) / self.sd
        # A wandering share is known from a few stretches of the record only.
        wandering = torch.from_numpy(stats.t.sf(z.numpy(), _QUARTERS - 1))
        many = torch.where(self.wanders, wandering, torch.special.ndtr(-z))
        # Few are a matter of counting: against the simulation's, and against what the resolution makes.
        few, own = self.n * self.expected, (self.events - 1).numpy()
        compared = stats.binom.sf(own, (self.events + self.simulated).numpy(), self.n / (self.n + self.m))
        resolved = torch.from_numpy(stats.poisson.sf(own, few.numpy()))
        counted = torch.where(self.simulated == 0, resolved, 0.0).maximum(torch.from_numpy(compared))
        return torch.where(few < _COUNTED, counted, many)


def repeated(signal: Tensor) -> Tensor:
    """Which samples `(..., time)` equal the one before; the first one does not."""
    same = torch.zeros(signal.shape, dtype=torch.bool)
    same[..., 1:] = signal[..., 1:] == signal[..., :-1]
    return same


def repeats(case: Case) -> Repeats:
    """Repeats of the recording against those of the simulation, block by block."""
    same, other_same = (repeated(side.signal).movedim(1, 0) for side in (case.recorded, case.simulated))
    share, n_recorded, fast, slow = _repeat_shares(same)
    other, n_simulated, other_fast, other_slow = _repeat_shares(other_same)
    # A resolution finer than any lattice that matters, such as that of float32, makes a few.
    differences = case.recording.diff(dim=-1)
    density = 1 / (math.sqrt(2 * math.pi) * differences.square().mean(-1).sqrt())
    # Rounded values repeat by chance the more often the less there is of other noise.
    quieter = case.simulated.signal.diff().abs().mean((0, -1)) / differences.abs().mean(-1).clamp(min=1e-300)
    other = (other * quieter.clamp(min=1.0)).clamp(max=1.0)
    expected = other + torch.where(other == 0, _resolution(case) * density, 0.0)
    binomial = expected * (1 - expected).clamp(min=0) + 1 / n_recorded
    variance = torch.maximum(binomial / n_recorded + binomial / n_simulated, fast + other_fast)
    # Of two paths that differ; what happens by chance varies by no more than about itself.
    wander = 2 * torch.minimum(slow + other_slow, expected.square())
    events = (_events(same), _events(other_same))
    return Repeats(share, expected, (variance + wander).sqrt(), wander > variance, *events, n_recorded, n_simulated)


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


@remembered
def _resolutions(side: Side) -> Tensor:
    return torch.stack([_finest_gap(values) for values in side.signal[0]])


def _finest_gap(values: Tensor) -> Tensor:
    gaps = values.sort().values.diff()
    gaps = gaps[gaps > 0]
    return gaps.min() if len(gaps) else torch.zeros((), dtype=torch.float64)


def _resolution(case: Case) -> Tensor:
    """Smallest difference between two values of the recording, `(sensor,)`: its step where it is rounded."""
    return _resolutions(case.recorded)


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


def end_stops(case: Case) -> tuple[EndStop, ...]:
    """The ends of every sensor's values, with what says that they were cut.

    Given all other samples, `x_t` is normal with mean `m_t` and sd `s`: were nothing cut, the expected number `E` of
    samples beyond the largest one, `sum_t Q((max - m_t)/s)`, would be standard exponential or less. And continuous
    values do not meet their maximum twice.
    """
    expected = left_out(case.recorded)
    found = []
    for i in range(case.n_sensors):
        x, mean, sd = case.recording[i], case.recording[i] - expected.error[0, i], float(expected.sd[0, i])
        resolution = float(_resolution(case)[i])
        rounded = resolution > _COARSE * sd
        if rounded:
            mean, sd = _before_rounding(x, mean, resolution)
        for sign in (1, -1):
            limit = float((sign * x).max())
            at = sign * x == limit
            runs = int((at[1:] & ~at[:-1]).sum()) + int(at[0])
            if int(at.sum()) < _FEWEST_AT_END or runs < 2 or _simulation_ends(case, i, sign):
                found.append(EndStop(i, sign, sign * limit, 1.0))
                continue
            beyond = float(torch.special.ndtr((sign * mean - limit - resolution / 2) / sd).sum())
            by_chance = min(5 * resolution / sd, 1.0) ** (runs - 1)
            p = min(math.exp(-beyond), by_chance)
            if rounded:  # tails of rounded noise are not normal: the number at the end has to tell too
                p = max(p, float(special.pdtrc(runs - 1, _AT_LAST_STEP)))
            found.append(EndStop(i, sign, sign * limit, corrected(p, 4 * case.n_sensors)))
    return tuple(found)


def _before_rounding(x: Tensor, mean: Tensor, step: float) -> tuple[Tensor, float]:
    """Means `(time,)` that rounded values have by regression on their predictions, and sd of what was rounded.

    A prediction from noise has noise of its own, in which it goes beyond where any value would.
    """
    middle, about = x.mean(), mean - mean.mean()
    mean = middle + about * float((about * (x - middle)).mean() / about.square().mean().clamp(min=1e-300))
    variance = float((x - mean).square().mean())
    return mean, math.sqrt(max(variance - step**2 / 12, variance / 4))


def _simulation_ends(case: Case, sensor: int, sign: int) -> bool:
    """Whether the simulation has an end stop there: half as many samples at its limit, or more."""
    cell = 0.99 * float(_resolution(case)[sensor])
    own, other = (_share_at_end(sign * side.signal[:, sensor], cell) for side in (case.recorded, case.simulated))
    return other >= 0.5 * own


def _share_at_end(values: Tensor, cell: float) -> float:
    """Mean share of samples less than a cell from each record's largest value."""
    return float((values >= values.amax(-1, keepdim=True) - cell).to(torch.float64).mean())


def marginal_witness(case: Case) -> Evidence:
    """Lattice, repeats, end stops and returns of single values, against those of the simulation."""
    steps = missing_lattices(case, 1.0)
    same = repeats(case).p_values
    candidates = [
        (corrected(found.p_value, case.n_sensors), i, f"values on a lattice of {found.step:.4g} {case.scene.measure}")
        for i, found in steps.items()
    ]
    often = int(same.argmin())
    candidates.append((corrected(float(same[often]), case.n_sensors), often, "samples repeated more often than there"))
    ends = min(end_stops(case), key=lambda end: end.p_value)
    candidates.append((ends.p_value, ends.sensor, f"values that end at {ends.limit:.6g} {case.scene.measure}"))
    candidates += [
        (p, i, f"{found.times} times the value {found.value:.6g} {case.scene.measure}, where values do not recur,")
        for i, (found, p) in missing_recurrences(case).items()
    ]
    p, sensor, words = min(candidates)
    return Evidence(
        "marginal",
        corrected(p, 4),
        f"{words} in sensor {case.scene.sensors[sensor]}",
        sensors=(sensor,),
        levels=(1,),
    )
