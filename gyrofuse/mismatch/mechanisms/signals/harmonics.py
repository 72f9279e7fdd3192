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
    """Lines of a recording at multiples of the frequency of one of them, or of a half or a third of that.

    Args:
        comparison: Recording and simulation.
        f: Frequency of the line, cycles per sample.
        sd: Its standard deviation: a multiple counts as far as its place is known to a quarter of a bin.
    """
    most, multiples_of_it = 128, (1, 2, 3)
    found = []
    for multiple in multiples_of_it:
        reach = 0.25 / comparison.n_samples / max(sd / multiple, 1e-12)
        others = [k for k in range(1, min(most, int(reach)) + 1) if k != multiple]
        found.append(Harmonics(multiple, _seen(comparison, f / multiple, f, others)))
    # A fundamental is divided only where that tells of more lines.
    return max(found, key=lambda one: (len(one.others), -one.multiple))


def _seen(comparison: Comparison, fundamental: float, line: float, multiples: Sequence[int]) -> tuple[int, ...]:
    """Those of some multiples at which the recording has a line of its own."""
    n, certain = comparison.n_samples, 1e-4
    known = [line, *simulated_lines(comparison.reference)]
    taken, places = list(known), list[tuple[int, float]]()
    for k in multiples:
        place = float(folded(torch.tensor(k * fundamental, dtype=torch.float64)))
        inside = 10 / n < place < 0.5 - (GUARD + 1) / n
        if inside and all(abs(place - other) > 2 * GUARD / n for other in taken):
            places.append((k, place))
            taken.append(place)
    if not places:
        return ()
    at = torch.tensor([place for _, place in places], dtype=torch.float64)
    each = CHANCE / (3 * len(places))
    lines = torch.tensor(taken, dtype=torch.float64)
    lines = torch.tensor(taken, dtype=torch.float64)
    sure = _beside_few(comparison, at, lines) < certain * each
    seen = (sure | (_beside_many(comparison, at, lines) < each)) if int(sure.sum()) > 1 else sure
    return tuple(k for (k, _), yes in zip(places, seen.tolist(), strict=True) if yes)


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
