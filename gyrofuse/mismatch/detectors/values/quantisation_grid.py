"""The lattice that rounded values sit on.

A lattice `offset + k step` is exact where values recur, and read off them. Hidden under noise that was added after the
rounding it still shows in the empirical characteristic function `phi(u) = mean exp(i u x)` at `u = 2 pi/step`: beyond
`5.5/s`, with `s` the sd of the middle of what is left of a sample given its past and the other sensors, `n |phi|^2` is
standard exponential without a lattice, and independent from sensor to sensor. A lattice of size `k` gives it the
likelihood ratio `exp(-k) I0(2 sqrt(k n |phi|^2))`; the mean of that over steps, sizes and shares of the sensors, which
may have the same converter, has expectation one without a lattice.

Noise that is a mixture of normal laws of several widths reaches further, but its characteristic function falls all the
way: at `u` it is not above the least that it is before, where a lattice has a trough. With `b^2` the `n |phi|^2` there,
`(sqrt(n) |phi| - b)^2` is at most standard exponential, by the triangle inequality.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.multiplicity import e_value_of_some, p_value_beyond_reference, p_value_from_e_value, sidak

_FINEST, _FINEST_HIDDEN = 1 / 50, 1 / 20  # steps that matter, of the sd of a sample given its past
_EXACT = 0.01  # distance from the lattice, steps, that arithmetic explains
_ON_LATTICE = 0.999  # of the samples; converters also have end stops
_ENDS = 5.5  # u s, beyond which noise has no characteristic function left, whatever its tails
_RIDGE = 1e-9  # of correlations of sensors that are copies of each other
_LOWEST = 3.5  # u s, where a peak found by its flank or its harmonics may still lie
_DOUBTFUL = 0.05  # p value of a lattice that is not looked at more closely
_AS_OTHERS, _AS_LARGE = 0.02, 1 / 16  # p value of one that other sensors have, and its size over their mean
_PER_STEP = 6  # histogram bins a step, at the finest
_MOST_BINS = 2**21
_SAME_STEP, _ALIKE = 1e-3, 0.04  # of steps that are exact, and hidden
_SIMULATED = 0.005  # p value of a hidden lattice that the simulation has as well
# Up to what share of `u` the least power before it is looked for, within what share it is averaged, and what counts as
# power there: values so near each other are one, which chance alone makes larger in one of 150.
_BEFORE, _AROUND, _SEEN = 0.8, 0.1, 5.0
_FROM, _LOOKED_AT = 0.3, 26  # share of a single `u` from which on, and places at which, it is looked for
_SIZES = (4.0, 8.0, 16.0, 32.0)  # of a hidden lattice that several sensors have


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


def innovation_sd(side: Records) -> Tensor:
    """Sd of a sample given its past, `exp(integral log S)^(1/2)` (Kolmogorov), `(sensor,)`."""
    width = torch.tensor(side.bands.edges, dtype=torch.float64).diff()
    return ((side.power.log() * width).sum(-1) / width.sum() / 2).exp()


@derived
def core_sd(side: Records) -> Tensor:
    """Sd of the middle of what the past and the other sensors leave of a sample, `(sensor,)`.

    The quiet part of a record, and what is no outlier, have a characteristic function that reaches further than that
    of a Gaussian of the same variance.
    """
    white = left_out(side).white[0]  # of robust sd one
    rms = white.square().mean(-1).sqrt()
    correlation = (white @ white.mT) / white.shape[-1] / (rms[:, None] * rms)
    own = torch.linalg.inv(correlation + _RIDGE * torch.eye(len(white), dtype=white.dtype)).diagonal().rsqrt()
    return innovation_sd(side) / rms.clamp(min=1.0) * own.clamp(max=1.0)


@derived
def _distinct(side: Records) -> tuple[tuple[Tensor, Tensor], ...]:
    """Values of each sensor in the first record, sorted, and how often each is there."""
    return tuple(torch.unique(row, return_counts=True) for row in side.signal[0])


@derived
def exact_lattices(side: Records) -> tuple[Lattice | None, ...]:
    """The lattice of each sensor's values in the first record that needs no statistics, `None` without."""
    return tuple(
        _exact_lattice(*values, float(sd)) for values, sd in zip(_distinct(side), innovation_sd(side), strict=True)
    )


@derived
def lattices(side: Records) -> tuple[Lattice, ...]:
    """The likeliest lattice of each sensor's values in the first record."""
    every = zip(exact_lattices(side), _distinct(side), core_sd(side), strict=True)
    return tuple(exact or _hidden_lattice(unique, float(sd)) for exact, (unique, _), sd in every)


def _exact_lattice(unique: Tensor, counts: Tensor, sd: float) -> Lattice | None:
    """From the gaps between values that recur."""
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
    u, every = _characteristic([unique], sd)
    wanted = (u > _ENDS / sd) & (u < 2 * math.pi / (_FINEST_HIDDEN * sd))
    told, frequency = 0.0, float(u[wanted.nonzero()[0, 0]])
    # The largest may be on a flank, of a peak that lies lower or of noise; the largest beyond noise is no noise.
    for power in (every[0], beyond_smooth(every)[0]):
        best = int(torch.where(wanted, power, 0.0).argmax())
        if sidak(math.exp(-float(power[best])), int(wanted.sum())) > _DOUBTFUL:
            continue
        peak = _peak([unique], _climbed(u, every[0], best, _LOWEST / sd), float(u[1]))
        beyond = max(_told_at(unique, peak), float(beyond_smooth(every)[0, best]))
        if beyond > told:
            told, frequency = beyond, peak
    p_value = sidak(math.exp(-told), int(wanted.sum()))
    if p_value > _DOUBTFUL:
        return Lattice(2 * math.pi / frequency, 0.0, 1.0, p_value, frequency)
    for part in (4, 3, 2):  # a harmonic may have come out largest
        lower = _told_at(unique, frequency / part)
        if frequency / part > _LOWEST / sd and lower > max(0.3 * told, 10.0):
            frequency /= part
            break
    return _seen_at(unique, frequency, _step_at(unique, frequency))._replace(p_value=p_value)


def _climbed(u: Tensor, power: Tensor, at: int, lowest: float) -> float:
    """The peak below, where `at` is on its flank."""
    while u[at] > lowest and power[at - 1] > power[at]:
        at -= 1
    return float(u[at])


def _characteristic(rows: list[Tensor], sd: float) -> tuple[Tensor, Tensor]:
    """`u` and `n |phi(u)|^2`, `(row, u)`, of rows of sorted values, for steps that matter to an sd."""
    bin_width = sd * _FINEST_HIDDEN / _PER_STEP
    reach = max(float(row[-1] - row[0]) for row in rows)
    n_bins = min(1 << math.ceil(math.log2(max(4 * reach / bin_width, 64))), _MOST_BINS)
    places = [((row - row[0]) / bin_width).long() % n_bins for row in rows]
    counts = torch.stack([torch.bincount(place, minlength=n_bins) for place in places]).to(torch.float64)
    n = torch.tensor([len(row) for row in rows], dtype=torch.float64)
    power = squared_modulus(torch.fft.rfft(counts)) / n[:, None]
    return 2 * math.pi * torch.arange(power.shape[-1], dtype=torch.float64) / (n_bins * bin_width), power


def beyond_smooth(power: Tensor) -> Tensor:
    """`n |phi(u)|^2` `(row, u)` at even steps from 0 beyond that of noise, which falls from one `u` to the next."""
    places = torch.arange(power.shape[-1])
    low, high = ((share * places).long() for share in (1 - _AROUND, 1 + _AROUND))
    high = high.clamp(max=len(places) - 1) + 1
    total = torch.nn.functional.pad(power.cumsum(-1), (1, 0))
    least = ((total[:, high] - total[:, low]) / (high - low)).cummin(-1).values
    return _beyond(power, least[:, (_BEFORE * places).long()])


def _beyond(power: Tensor, least: Tensor) -> Tensor:
    """Of a power what the least power before it does not explain."""
    noise = torch.where(least > _SEEN, least - 1, 0.0)
    return (power.sqrt() - noise.sqrt()).clamp(min=0).square()


def _step_at(unique: Tensor, peak: float) -> float:
    """The step behind a peak of the characteristic function, which lies lower the more it is blurred."""
    found = _seen_at(unique, peak, 2 * math.pi / peak)
    return found.step / (1 + (found.step * found.blur) ** 2 / float(unique.var()))


class SharedLattice(NamedTuple):
    """The hidden step that several sensors are likeliest to have.

    Attributes:
        log_ratio: Of the mean over steps, sizes and shares of the sensors, nats.
        step: Unit of the signal; 0 where nothing was looked at.
        peak: Where the characteristic functions tell most of it.
    """

    log_ratio: float
    step: float
    peak: float

    @property
    def p_value(self) -> float:
        """Of no lattice."""
        return p_value_from_e_value(self.log_ratio)


@derived
def shared_lattice(side: Records) -> SharedLattice:
    """Of all sensors whose values have no exact lattice, over the first record."""
    open_ones = [i for i, exact in enumerate(exact_lattices(side)) if exact is None]
    if len(open_ones) < 2:
        return SharedLattice(-math.inf, 0.0, 0.0)
    rows, sd = [_distinct(side)[i][0] for i in open_ones], core_sd(side)[open_ones]
    finest = float(sd.min())
    u, power = _characteristic(rows, finest)
    last = int(torch.searchsorted(u, 2 * math.pi / (_FINEST_HIDDEN * finest)))
    u, power = u[:last], beyond_smooth(power[:, :last])
    usable = u > _ENDS / sd[:, None]
    ratios = torch.full_like(u, -math.inf)
    for size in _SIZES:
        x = 2 * (size * power).sqrt()
        own = torch.where(usable, x + torch.special.i0e(x).log() - size, 0.0)
        ratios = torch.logaddexp(ratios, e_value_of_some(own) - math.log(len(_SIZES)))
    # Steps of any magnitude are as likely.
    log_ratio = ratios + torch.where(usable.any(0), -u.clamp(min=1e-300).log(), -math.inf).log_softmax(0)
    best = int(log_ratio.argmax())
    shown = usable[:, best] & (power[:, best] > -math.log(_AS_OTHERS))
    have = shown.nonzero()[:, 0].tolist() or usable[:, best].nonzero()[:, 0].tolist()
    top = _climbed(u, power[have].sum(0), best, _LOWEST / float(sd[have].min()))
    own_rows = [rows[i] for i in have]
    peak = _peak(own_rows, top, float(u[1]))
    step = sum(_step_at(row, peak) for row in own_rows) / len(own_rows)
    return SharedLattice(float(log_ratio.logsumexp(0)), step, peak)


def _seen_at(unique: Tensor, peak: float, step: float) -> Lattice:
    """A hidden lattice of a step and a peak that are known, with its p value."""
    n = len(unique)
    power = float(_power(unique, torch.tensor([peak], dtype=torch.float64)))
    resultant = math.sqrt(max((power - 1) / (n - 1), 1e-12)) if n > 1 else 1e-6
    blur = math.sqrt(-2 * math.log(min(resultant, 1 - 1e-12))) / (2 * math.pi)
    turn = torch.exp(2j * math.pi / step * unique).mean().angle()
    return Lattice(step, float(turn) / (2 * math.pi) * step, blur, math.exp(-_told_at(unique, peak)), peak)


def _power(values: Tensor, u: Tensor) -> Tensor:
    """`n |phi(u)|^2`, `(u,)`."""
    angle = u[:, None] * values
    return (angle.cos().mean(-1).square() + angle.sin().mean(-1).square()) * len(values)


def _told_at(values: Tensor, u: float) -> float:
    """`n |phi(u)|^2` beyond that of noise, which falls from one `u` to the next."""
    places = u * torch.linspace(_FROM, _BEFORE, _LOOKED_AT, dtype=torch.float64)
    power = _power(values - values.mean(), torch.cat([torch.tensor([u], dtype=torch.float64), places]))
    return float(_beyond(power[0], power[1:].unfold(0, 5, 1).mean(-1).min()))


def _peak(rows: list[Tensor], u: float, spacing: float) -> float:
    """Maximum of the characteristic functions of rows of values, together, within a bin of `u`, by thirds."""
    reach, rows = spacing, [row - row.mean() for row in rows]
    for _ in range(8):
        grid = u + reach * torch.linspace(-1, 1, 7, dtype=torch.float64)
        u = float(grid[torch.stack([_power(row, grid) for row in rows]).sum(0).argmax()])
        reach /= 3
    return u


def off_lattice(values: Tensor, step: float | Tensor, offset: float | Tensor) -> Tensor:
    """Distances of values from the nearest point of a lattice, steps."""
    place = (values - offset) / step
    return place - place.round()


class Missing(NamedTuple):
    """Lattices that the simulation does not have and could be rounded to.

    Attributes:
        p_value: Of there being none, for having looked at every sensor alone and all together.
        lattices: By sensor.
    """

    p_value: float
    lattices: dict[int, Lattice]


def missing_lattices(comparison: Comparison, level: float) -> Missing:
    """Lattices of the recording; none where their p value is not below `level`."""
    every = lattices(comparison.observed)
    alone = {i: left for i, own in enumerate(every) if (left := _not_simulated(comparison, i, own))}
    clearest = min(alone.values(), key=lambda found: found.p_value, default=None)
    p_alone = sidak(clearest.p_value, comparison.n_sensors) if clearest else 1.0
    shared = shared_lattice(comparison.observed)
    p_shared = p_value_beyond_reference(shared.p_value, shared_lattice(comparison.reference).p_value)
    p_value = sidak(min(p_alone, p_shared), min(comparison.n_sensors, 2))
    if p_value > level or not (alone or shared.step):
        return Missing(p_value, {})
    missing = {i: left for i, left in alone.items() if sidak(left.p_value, 2 * comparison.n_sensors) <= level}
    if clearest is None or p_shared < p_alone:  # those that show a step of their own keep it
        clearest = Lattice(shared.step, 0.0, 1.0, p_shared, shared.peak)
    steps = [found.step for found in missing.values()]
    for i, own in enumerate(every):  # a step that is known elsewhere needs less to be believed
        if i in missing:
            continue
        if own.blur > 0 and clearest.blur > 0:
            own = _seen_at(_distinct(comparison.observed)[i][0], clearest.peak, clearest.step)
        elif not any(abs(own.step / step - 1) < _ALIKE for step in steps):
            continue
        left = _not_simulated(comparison, i, own) if own.p_value < _AS_OTHERS else None
        if left is not None and left.p_value < _AS_OTHERS:
            missing[i] = left
    return Missing(p_value, dict(sorted(_as_large(missing).items())))


def _as_large(missing: dict[int, Lattice]) -> dict[int, Lattice]:
    """Without what has a trace of a hidden lattice by chance, beside others that have it in earnest."""
    size = {i: -math.log(max(found.p_value, 1e-300)) for i, found in missing.items() if found.blur > 0}
    least = _AS_LARGE * sum(size.values()) / max(len(size), 1)
    return {i: found for i, found in missing.items() if size.get(i, least) >= least}


def _harmonic(peak: float, step: float, sd: float) -> bool:
    """Whether a characteristic function of values of an sd that lie about a lattice has a peak there."""
    base = 2 * math.pi / step
    return abs(peak - base * max(round(peak / base), 1)) < 1 / sd


def _not_simulated(comparison: Comparison, sensor: int, own: Lattice) -> Lattice | None:
    """A lattice of the recording, with the p value of its being no clearer than the simulation's; `None` if exact."""
    other = exact_lattices(comparison.reference)[sensor]
    if own.blur == 0:
        return None if other is not None and other.step > own.step * (1 - _SAME_STEP) else own
    if other is not None and _harmonic(own.peak, other.step, float(comparison.recording[sensor].std())):
        return None  # what is taken off a recording blurs its own, of which harmonics may be left
    # Each value counts once here as well: where one of them stands for all around it, what is missing shows.
    values, u = _distinct(comparison.observed)[sensor][0], torch.tensor([own.peak], dtype=torch.float64)
    records = [row.unique() for row in comparison.reference.signal[:, sensor]]
    n, m = len(values), sum(map(len, records))
    power = float(_power(values - values.mean(), u))
    # Its records share one lattice, or each lies about its own mean: one that was built in does.
    every = torch.cat(records)
    about = every - every.mean(), torch.cat([row - row.mean() for row in records])
    other_power = max(float(_power(centred, u)) for centred in about)
    if other_power < -math.log(_SIMULATED):
        return own
    clearer = max(math.sqrt(power / n) - math.sqrt(other_power / m), 0.0)
    return own._replace(p_value=max(own.p_value, math.exp(-(clearer**2) / (1 / n + 1 / m))))
