"""Harmonics of a line: what turns, hits or switches periodically has lines at multiples of one frequency.

Transforms under a Hann taper, folded at half the rate. The power `r` of a sensor where a multiple lies, over the mean
of the bins beside it, has for noise over `m` bins the tail `(1 + r / m)^-m`. The bins next to it are few, so that a
narrow peak of noise is no line; where several multiples stand out over these, the others are asked for over the bins of
a wider surrounding, in all sensors together (complex Hotelling's, see `signals.lines`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from scipy import special
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.decisions import CHANCE
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.lines import GUARD, log_hotelling, sets_of, simulated_lines
from gyrofuse.mismatch.signals.psd import hann_transform
from gyrofuse.mismatch.signals.records import Records


class Harmonics(NamedTuple):
    """Multiples of a fundamental frequency at which a recording has lines.

    Attributes:
        multiple: Which one the line is that they were sought from.
        others: Of all others.
    """

    multiple: int
    others: tuple[int, ...]


def folded(f: Tensor) -> Tensor:
    """Where frequencies of cycles per sample are seen, from 0 to 1/2."""
    return (f - f.round()).abs()


def harmonics_of(comparison: Comparison, f: float, sd: float) -> Harmonics:
    """Lines of a recording at multiples of the frequency of one of them, or of a part of that, down to an eighth.

    Args:
        comparison: Recording and simulation.
        f: Frequency of the line, cycles per sample.
        sd: Its standard deviation: a multiple counts as far as its place is known to a quarter of a bin.
    """
    most, parts = 128, 8  # of pulses that come again and again the strongest line is one of the first
    found = []
    for multiple in range(1, parts + 1):
        reach = 0.25 / comparison.n_samples / max(sd / multiple, 1e-12)
        others = [k for k in range(1, min(most, int(reach)) + 1) if k != multiple]
        found.append(Harmonics(multiple, _seen(comparison, f, [(k, k * f / multiple) for k in others], parts)))
    # A fundamental is divided only where that tells of more lines.
    return max(found, key=lambda one: (len(one.others), -one.multiple))


def _seen(comparison: Comparison, line: float, wanted: Sequence[tuple[int, float]], tried: int = 1) -> tuple[int, ...]:
    """Those numbers at whose frequencies the recording has a line, beside one and those of the simulation.

    Args:
        comparison: Recording and simulation.
        line: Frequency of that one, cycles per sample.
        wanted: Numbers and frequencies.
        tried: How many such sets are asked for.
    """
    n, certain = comparison.n_samples, 1e-4
    taken, places = [line, *simulated_lines(comparison.reference)], list[tuple[int, float]]()
    for k, f in wanted:
        place = float(folded(torch.tensor(f, dtype=torch.float64)))
        inside = 10 / n < place < 0.5 - (GUARD + 1) / n
        if inside and all(abs(place - other) > 2 * GUARD / n for other in taken):
            places.append((k, place))
            taken.append(place)
    if not places:
        return ()
    at = torch.tensor([place for _, place in places], dtype=torch.float64)
    each = CHANCE / (tried * len(places))
    lines = torch.tensor(taken, dtype=torch.float64)
    sure = _beside_few(comparison, at, lines) < certain * each
    seen = (sure | (_beside_many(comparison, at, lines) < each)) if int(sure.sum()) > 1 else sure
    return tuple(k for (k, _), yes in zip(places, seen.tolist(), strict=True) if yes)


class Sidebands(NamedTuple):
    """Lines evenly beside one.

    Attributes:
        spacing: Cycles per sample.
        orders: Of the lines, by how many spacings they are off: all but zero.
    """

    spacing: float
    orders: tuple[int, ...]


def sidebands_of(comparison: Comparison, f: float) -> Sidebands | None:
    """Lines evenly beside a line, as of a tone whose size or frequency goes up and down; None without any.

    Of all distances of the lines nearby, and their halves and thirds, the one at whose multiples the most unlikely
    number of lines is found: one of chance is near a multiple with twice the tolerance over the spacing.
    """
    least, tolerance = 2 * GUARD + 2, 0.3  # bins
    off = _lines_near(comparison, f) * comparison.n_samples
    tried = torch.cat([off.abs() / k for k in (1, 2, 3)])
    tried = tried[tried > least]
    if len(off) < 2 or not len(tried):
        return None
    orders = (off / tried[:, None]).round()
    on = ((off - orders * tried[:, None]).abs() < tolerance) & (orders != 0)
    # The line that a spacing was taken from says nothing for it.
    surprise = (on.sum(-1) - 1) * (tried / (2 * tolerance)).log() - math.log(len(tried))
    best = int(surprise.argmax())
    if float(surprise[best]) < -math.log(CHANCE):
        return None
    order, place = orders[best][on[best]], off[on[best]]
    spacing = float((order @ place) / (order @ order)) / comparison.n_samples
    most = 2 * int(order.abs().max())
    wanted = [(k, f + k * spacing) for k in sorted(range(-most, most + 1), key=abs) if k]
    found = _seen(comparison, f, wanted)
    return Sidebands(spacing, found) if len(found) > 1 else None


def _lines_near(comparison: Comparison, f: float) -> Tensor:
    """How far other lines are from one, cycles per sample: local maxima far above the noise, a few at most."""
    reach, level, rare, most = 4096, 129, 1e-6, 24  # bins, and lines
    transform, length = tapered(comparison.observed)
    finer, n, p = length / comparison.n_samples, comparison.n_samples, comparison.n_sensors
    first = max(round(f * length) - int(reach * finer), int(10 * finer))
    last = min(round(f * length) + int(reach * finer), length // 2 - int(4 * finer))
    place = torch.arange(first, last + 1, dtype=torch.float64) / length
    power = (squared_modulus(transform[:, first : last + 1]) / comparison.base.spectrum(place)).sum(0)
    if len(power) < 2 * level:
        return torch.zeros(0, dtype=torch.float64)
    padded = torch.nn.functional.pad(power[None], (level // 2, level // 2), mode="reflect")[0]
    noise = padded.unfold(0, level, 1).median(-1).values / float(special.gammaincinv(p, 0.5))
    chance = torch.special.gammaincc(torch.tensor(float(p), dtype=torch.float64), power / noise)
    guard = 2 * int(GUARD * finer) + 1
    highest = torch.nn.functional.max_pool1d(power[None], guard, 1, guard // 2)[0] == power
    peaks = (highest & (chance < rare) & ((place - f).abs() > 2 * GUARD / n)).nonzero()[:, 0]
    peaks = peaks[power[peaks].argsort(descending=True)[:most]]
    # Between bins: the vertex of a parabola through the logarithms.
    inner = peaks.clamp(1, len(power) - 2)
    low, middle, high = (power[inner + k].log() for k in (-1, 0, 1))
    vertex = ((low - high) / (2 * (low - 2 * middle + high)).clamp(max=-1e-9)).clamp(-0.5, 0.5)
    known = torch.tensor(simulated_lines(comparison.reference), dtype=torch.float64)
    at = place[inner] + vertex / length
    ours = ((at[:, None] - known).abs() > 2 * GUARD / n).all(-1)
    return (at - f)[ours]


def _beside_few(comparison: Comparison, places: Tensor, lines: Tensor) -> Tensor:
    """p value of the power of the sensor that has most at places, over the bins next to it, `(place,)`."""
    here, beside, m = _without_lines(comparison, places, lines, reach=12)
    level = squared_modulus(beside).sum(-1) / m.clamp(min=1)
    ratio = (squared_modulus(here) / level.clamp(min=1e-300)).amax(0)
    return torch.where(m > 0, comparison.n_sensors * (1 + ratio / m.clamp(min=1)) ** -m, 1.0)


def _beside_many(comparison: Comparison, places: Tensor, lines: Tensor) -> Tensor:
    """p value of what any sensors have at places, over the noise in many bins beside it, `(place,)`."""
    here, beside, m = _without_lines(comparison, places, lines, reach=64)
    sets, log_chance = sets_of(comparison.n_sensors)
    beside = beside.movedim(0, 1)  # (place, sensor, bin)
    matrices = beside @ beside.mH / m.clamp(min=1)[:, None, None]
    log_p = (log_hotelling(here.mT, matrices, sets, m[:, None]) - log_chance).amin(-1)
    return torch.where(m > 2 * comparison.n_sensors, log_p.clamp(max=0).exp(), 1.0)


def _without_lines(comparison: Comparison, places: Tensor, lines: Tensor, reach: int) -> tuple[Tensor, Tensor, Tensor]:
    """Transform at places, beside them but for lines, where it is zero, and the number of bins that are left."""
    transform, length = tapered(comparison.observed)
    beside, f = surroundings(comparison, places, reach)
    lines = ((f[..., None] - lines).abs() < (GUARD + 1) / comparison.n_samples).any(-1)
    left = beside[0].isfinite() & ~lines
    here = transform[:, (places * length).round().long()]
    return here, torch.where(left, beside, 0.0), left.sum(-1).to(torch.float64)


def surroundings(comparison: Comparison, places: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Transform beside places, as noise of the simulation's spectrum would have it there, and at which frequencies.

    Those are `(sensor, place, bin)` and `(place, bin)`; bins beyond either end of the spectrum are NaN.
    """
    transform, length = tapered(comparison.observed)
    n = comparison.n_samples
    apart = torch.cat([torch.arange(-reach, -GUARD), torch.arange(GUARD + 1, reach + 1)])
    f = places[:, None] + apart / n
    usable = (f > 2.5 / n) & (f < 0.5 - 0.5 / n)
    inside = f.clamp(2.5 / n, 0.5 - 0.5 / n)
    base = comparison.base.spectrum(inside.flatten()).unflatten(-1, inside.shape)
    here = comparison.base.spectrum(places)[..., None]
    seen = transform[:, (inside * length).round().long()] * (here / base).sqrt()
    return seen.masked_fill(~usable, complex(math.nan, math.nan)), f


@derived
def tapered(side: Records) -> tuple[Tensor, int]:
    """Transform `(sensor, bin)` of a recording under a Hann taper, and the length it was padded to."""
    return hann_transform(side.signal[0])
