"""Grids of the recording that the simulation lacks: exact ones, and those hidden under noise that was added later.

A hidden grid `offset + k step` shows in the empirical
characteristic function `phi(u) = mean exp(i u x)` at `u = 2 pi/step`. That of noise, normal or a mixture of normal laws
of several widths, falls all the way: at `u` it is not above the least that it is before, where a grid has a trough.
With `b^2` the `n |phi|^2` there, `P = (sqrt(n) |phi| - b)^2` is at most standard exponential without a grid, by the
triangle inequality, and independent from sensor to sensor. A grid of size `k` gives it the likelihood ratio
`exp(-k) I0(2 sqrt(k P))`; the mean of that over steps, sizes and shares of the sensors, which may have the same
converter, has expectation one at most (`stats.multiplicity`).

References:
    Widrow and Kollar, Quantization Noise, 2008, chapter 4: the characteristic function of rounded values.
    Epps and Pulley, A test for normality based on the empirical characteristic function, Biometrika 70 (1983), 723.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.decisions import CERTAIN, CHANCE
from gyrofuse.mismatch.detectors.values.lattices import (
    Lattice,
    distinct_values,
    exact_lattices,
    grid_offset,
    innovation_sd,
    share_on_grid,
    simulated_lattices,
)
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.multiplicity import e_value_of_some, p_value_from_e_value, sidak

_FINEST_HIDDEN = 1 / 20  # smallest step, sd of a sample given its past: a finer one adds 1/4800 of the noise's variance
_LOWEST = 3.5  # `u s`, from which on grids are searched: normal noise has n exp(-12) there, one in 10^5 samples
_BEFORE = 0.8  # share of `u` up to which the least power before it is searched: nearer, a peak has its own flank
_OF_OTHERS = 0.02  # p value of a grid at a step that another sensor is known to have


class HiddenStep(NamedTuple):
    """The hidden step that one or several sensors are likeliest to have.

    Attributes:
        log_ratio: Logarithm of the mean likelihood ratio over steps, sizes and shares of the sensors, nats.
        step: Unit of the signal.
        peak: Frequency of the peak of the characteristic functions.
    """

    log_ratio: float
    step: float
    peak: float

    @property
    def p_value(self) -> float:
        """p value of no grid."""
        return p_value_from_e_value(self.log_ratio)


@derived
def core_sd(side: Records) -> Tensor:
    """Standard deviation of the middle of what the past and the other sensors leave of a sample, `(sensor,)`.

    The quiet part of a record, and what is no outlier, have a characteristic function that reaches further than that
    of a Gaussian of the same variance.
    """
    white = left_out(side).white[0]  # of robust sd one
    rms = white.square().mean(-1).sqrt()
    correlation = (white @ white.mT) / white.shape[-1] / (rms[:, None] * rms)
    ridge = 1e-9 * torch.eye(len(white), dtype=white.dtype)  # of sensors that are copies of each other
    own = torch.linalg.inv(correlation + ridge).diagonal().rsqrt()
    return innovation_sd(side) / rms.clamp(min=1.0) * own.clamp(max=1.0)


def _hidden_step(rows: list[Tensor], sd: Tensor) -> HiddenStep:
    """The likeliest hidden step of one or several sensors.

    Args:
        rows: Sorted values of each.
        sd: Standard deviations of the middle of their innovations, `(row,)`.
    """
    u, raw = _characteristic(rows, float(sd.min()))
    power, usable = beyond_smooth(raw), u > _LOWEST / sd[:, None]
    ratios = []
    for size in (4.0, 8.0, 16.0, 32.0):  # nats: the largest one finds any larger as well
        x = 2 * (size * power).sqrt()
        ratios.append(e_value_of_some(torch.where(usable, x + torch.special.i0e(x).log() - size, 0.0)))
    # Steps of any magnitude are as likely.
    prior = torch.where(usable.any(0), -u.clamp(min=1e-300).log(), -math.inf).log_softmax(0)
    log_ratio = torch.stack(ratios).logsumexp(0) - math.log(len(ratios)) + prior
    best = int(log_ratio.argmax())
    found = HiddenStep(float(log_ratio.logsumexp(0)), 2 * math.pi / float(u[best]), float(u[best]))
    if found.p_value > CHANCE:
        return found
    shown = usable[:, best] & (power[:, best] > -math.log(_OF_OTHERS))
    have = shown.nonzero()[:, 0].tolist() or usable[:, best].nonzero()[:, 0].tolist()
    lowest = _LOWEST / float(sd[have].min())
    rows = [rows[i] for i in have]
    peak = _peak(rows, float(u[best]), float(u[1]))
    height = _power_beyond(rows, peak)
    for part in (4, 3, 2):  # of a coarse grid a harmonic is all that lies beyond the noise
        if peak / part > lowest and _power_beyond(rows, peak / part) > max(0.3 * height, 10.0):
            peak /= part
            break
    return found._replace(step=sum(_step_at(row, peak) for row in rows) / len(rows), peak=peak)


def _characteristic(rows: list[Tensor], sd: float) -> tuple[Tensor, Tensor]:
    """`u` and `n |phi(u)|^2`, `(row, u)`, of rows of sorted values, up to the finest step for an sd.

    By the transform of a histogram with six bins in the finest step, four times as long as the values reach.
    """
    finest = _FINEST_HIDDEN * sd
    bin_width = finest / 6
    reach = max(float(row[-1] - row[0]) for row in rows)
    n_bins = min(1 << math.ceil(math.log2(max(4 * reach / bin_width, 64))), 2**21)
    counts = torch.stack(
        [torch.bincount(((row - row[0]) / bin_width).long() % n_bins, minlength=n_bins) for row in rows]
    )
    n = torch.tensor([len(row) for row in rows], dtype=torch.float64)
    power = squared_modulus(torch.fft.rfft(counts.to(torch.float64))) / n[:, None]
    u = 2 * math.pi * torch.arange(power.shape[-1], dtype=torch.float64) / (n_bins * bin_width)
    last = int(torch.searchsorted(u, 2 * math.pi / finest))
    return u[:last], power[:, :last]


def beyond_smooth(power: Tensor) -> Tensor:
    """`n |phi(u)|^2` `(row, u)` at even steps from 0 beyond that of noise, which falls from one `u` to the next.

    The least power before is that of means over a tenth on either side.
    """
    k = torch.arange(power.shape[-1])
    low, high = (0.9 * k).long(), (1.1 * k).long().clamp(max=len(k) - 1) + 1
    total = torch.nn.functional.pad(power.cumsum(-1), (1, 0))
    least = ((total[:, high] - total[:, low]) / (high - low)).cummin(-1).values
    return _beyond(power, least[:, (_BEFORE * k).long()])


def _beyond(power: Tensor, least: Tensor) -> Tensor:
    """Power that the least power before it does not explain; chance alone is above 5 in one of 150 cases."""
    noise = torch.where(least > 5.0, least - 1, 0.0)
    return (power.sqrt() - noise.sqrt()).clamp(min=0).square()


def _power(values: Tensor, u: Tensor) -> Tensor:
    """`n |phi(u)|^2`, `(u,)`; one `u` after the other for the sake of memory."""
    means = (torch.stack([(one * values).cos().mean(), (one * values).sin().mean()]) for one in u)
    return torch.stack([mean.square().sum() for mean in means]) * len(values)


def _power_beyond(rows: list[Tensor], u: float) -> float:
    """Sum over rows of `n |phi(u)|^2` beyond that of noise, from 26 values between 0.3 and 0.8 of `u`."""
    grid = u * torch.cat([torch.ones(1, dtype=torch.float64), torch.linspace(0.3, _BEFORE, 26, dtype=torch.float64)])
    powers = (_power(row - row.mean(), grid) for row in rows)
    return sum(float(_beyond(power[0], power[1:].unfold(0, 5, 1).mean(-1).min())) for power in powers)


def _peak(rows: list[Tensor], u: float, spacing: float) -> float:
    """Maximum of the characteristic functions of rows of values, together, within a bin of `u`, by thirds."""
    rows = [row - row.mean() for row in rows]
    for number in range(8):
        grid = u + spacing / 3**number * torch.linspace(-1, 1, 7, dtype=torch.float64)
        u = float(grid[torch.stack([_power(row, grid) for row in rows]).sum(0).argmax()])
    return u


def _step_at(unique: Tensor, peak: float) -> float:
    """The step behind a peak of the characteristic function, which lies lower the more it is blurred."""
    found = _lattice_at(unique, peak, 2 * math.pi / peak)
    return found.step / (1 + (found.step * found.blur) ** 2 / float(unique.var()))


def _lattice_at(unique: Tensor, peak: float, step: float) -> Lattice:
    """A hidden grid of a step and a peak that are known, with its p value."""
    n = len(unique)
    power = float(_power(unique, torch.tensor([peak], dtype=torch.float64)))
    resultant = math.sqrt(max((power - 1) / (n - 1), 1e-12)) if n > 1 else 1e-6
    blur = math.sqrt(-2 * math.log(min(resultant, 1 - 1e-12))) / (2 * math.pi)
    return Lattice(step, grid_offset(unique, step), blur, math.exp(-_power_beyond([unique], peak)), peak)


class Missing(NamedTuple):
    """Grids of the recording that are not the simulation's.

    Attributes:
        p_value: p value of no such grid.
        lattices: Grids by position of the sensor.
        coarser: Exact grids of the simulation that are coarser than the recording's, or have none beside them.
    """

    p_value: float
    lattices: dict[int, Lattice]
    coarser: dict[int, Lattice]


def missing_lattices(comparison: Comparison, level: float) -> Missing:
    """Grids of the recording: exact ones, and hidden steps one after the other, each in the sensors that have it.

    Args:
        comparison: Recording and simulation.
        level: p value above which a hidden step is none.
    """
    observed, reference = exact_lattices(comparison.as_came), simulated_lattices(comparison)
    coarser = {
        i: other
        for i, other in enumerate(reference)
        if other is not None and (_too_coarse(comparison, i, observed[i], other) or _cut_otherwise(observed[i], other))
    }
    missing = {
        i: own
        for i, (own, other) in enumerate(zip(observed, reference, strict=True))
        if own is not None and (i in coarser or other is None or other.step <= own.step * (1 - 1e-3))
    }
    p_value = 0.0 if missing or coarser else 1.0
    values = distinct_values(comparison.as_came)
    smooth = [i for i, own in enumerate(observed) if own is None and i not in comparison.straightened]
    hidden = [i for i in smooth if not _is_cut(values[i][1])]
    while hidden:
        p, here = _hidden_in(comparison, hidden, level)
        p_value = min(p_value, p)
        if not here:
            break
        missing |= here
        hidden = [i for i in hidden if i not in here]
    return Missing(p_value, dict(sorted(missing.items())), coarser)


def _cut_otherwise(own: Lattice | None, other: Lattice) -> bool:
    """Whether values of one step are cut off towards zero in one of them, and rounded in the other."""
    return own is not None and {own.cut_off, other.cut_off} == {True, False} and abs(own.step / other.step - 1) < 1e-3


def _too_coarse(comparison: Comparison, sensor: int, own: Lattice | None, other: Lattice) -> bool:
    """Whether a grid of the simulation is one that the recording's values are not on, nor on one like it that hides."""
    # Step over the sd of a sample given its past: a finer one adds less than 1/190 of its variance. Share of samples on
    # a grid, above which values have it but for what filled gaps: half of those with half its step are on it.
    coarse, on = 0.25, 0.75
    if other.step < coarse * float(innovation_sd(comparison.reference)[sensor]):
        return False
    values = comparison.as_came.signal[0, sensor]
    if share_on_grid(values, other.step) > on:
        return False
    if own is not None:
        return own.step < other.step * (1 - 1e-3)
    unique = distinct_values(comparison.as_came)[sensor][0]
    return _lattice_at(unique, 2 * math.pi / other.step, other.step).p_value > CERTAIN


def _is_cut(counts: Tensor) -> bool:
    """Whether values, by how often each is there, pile up at both ends: what is between has a law with side lobes."""
    piled = 0.005  # of the samples
    return min(int(counts[0]), int(counts[-1])) > piled * int(counts.sum())


def _hidden_in(comparison: Comparison, sensors: list[int], level: float) -> tuple[float, dict[int, Lattice]]:
    """The likeliest hidden step of some sensors, and the grids of those that have it; none above the level.

    That the simulation shows it in some of them as well is no mismatch unless one of the recording's is clearer.
    """
    values = [distinct_values(comparison.observed)[i][0] for i in sensors]  # each counts once, whatever repeats
    found = _hidden_step(values, core_sd(comparison.observed)[sensors])
    if found.p_value > level:
        return found.p_value, {}
    grids = {i: _lattice_at(v, found.peak, found.step) for i, v in zip(sensors, values, strict=True)}
    beside = {i: _beside_simulation(comparison, i, own) for i, own in grids.items()}
    p_value = found.p_value
    if any(beside[i] > own.p_value for i, own in grids.items()):
        p_value = max(p_value, sidak(min(beside.values()), len(sensors)))
    have = {i: own._replace(p_value=beside[i]) for i, own in grids.items() if beside[i] < _OF_OTHERS}
    return p_value, _as_large(have) if p_value <= level else {}


def _as_large(missing: dict[int, Lattice]) -> dict[int, Lattice]:
    """Without traces of a hidden grid by chance: a 16th of the mean nats of the sensors that have it, blur by blur."""
    size = {i: -math.log(max(found.p_value, 1e-300)) for i, found in missing.items() if found.blur > 0}
    least = sum(size.values()) / max(len(size), 1) / 16
    return {i: found for i, found in missing.items() if size.get(i, least) >= least}


def _beside_simulation(comparison: Comparison, sensor: int, own: Lattice) -> float:
    """p value that a hidden grid of the recording is no clearer than the simulation's."""
    other = simulated_lattices(comparison)[sensor]
    if other is not None:
        # What is taken off a recording blurs its own grid, of which harmonics may be left: peaks as wide as 1/sd.
        base = 2 * math.pi / other.step
        if abs(own.peak - base * max(round(own.peak / base), 1)) < 1 / float(comparison.recording[sensor].std()):
            return 1.0
    # Each value counts once here as well: where one of them stands for all around it, what is missing shows.
    values, u = distinct_values(comparison.observed)[sensor][0], torch.tensor([own.peak], dtype=torch.float64)
    records = [row.unique() for row in comparison.reference.signal[:, sensor]]
    n, m = len(values), sum(map(len, records))
    # Its records share one grid, or each lies about its own mean: one that was built in does.
    every = torch.cat(records)
    about = every - every.mean(), torch.cat([row - row.mean() for row in records])
    power, other_power = float(_power(values - values.mean(), u)), max(float(_power(v, u)) for v in about)
    if other_power < -math.log(CERTAIN):
        return own.p_value
    clearer = max(math.sqrt(power / n) - math.sqrt(other_power / m), 0.0)
    return max(own.p_value, math.exp(-(clearer**2) / (1 / n + 1 / m)))
