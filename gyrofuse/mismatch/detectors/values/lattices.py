"""Grids that values lie on exactly: read off the values, which recur.

A grid is `offset + k step`. Converters of many bits have one far below the noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.truncation import is_cut_off, step_counts
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.records import Records


class Lattice(NamedTuple):
    """Values `offset + k step`, blurred by `blur` steps, sd.

    Attributes:
        step, offset: Unit of the signal.
        blur: Standard deviation of what was added after the rounding, steps; 0 of an exact grid.
        p_value: p value of continuous values, over every step.
        peak: Frequency of the peak of the characteristic function, 0 where the grid is exact. Below `2 pi/step` if the
            values spread over few steps, since what blurs the grid damps high frequencies more.
        cut_off: Whether values are cut off towards zero, and not rounded; None where that cannot be told.
    """

    step: float
    offset: float
    blur: float
    p_value: float
    peak: float = 0.0
    cut_off: bool | None = None

    @property
    def has_zero(self) -> bool:
        """Whether zero is one of its points."""
        return abs(self.offset) < 0.01 * self.step

    @classmethod
    def none(cls) -> Lattice:
        """That of values without a grid."""
        return cls(0.0, 0.0, 0.0, 1.0)


def innovation_sd(side: Records) -> Tensor:
    """Standard deviation of a sample given its past, `exp(integral log S)^(1/2)` (Kolmogorov), `(sensor,)`."""
    width = torch.tensor(side.bands.edges, dtype=torch.float64).diff()
    return ((side.power.log() * width).sum(-1) / width.sum() / 2).exp()


@derived
def distinct_values(side: Records) -> tuple[tuple[Tensor, Tensor], ...]:
    """Distinct values of each sensor in the first record, sorted, and how often each is there."""
    return tuple(torch.unique(row, return_counts=True) for row in side.signal[0])


@derived
def exact_lattices(side: Records) -> tuple[Lattice | None, ...]:
    """The exact grid of each sensor's values in the first record, `None` without.

    Sensors of one step have one kind of converter: what is told of one of them holds for those of which it is not.
    """
    found = _exact_in(side, 1 / 50)
    told = [own for own in found if own is not None and own.cut_off is not None]
    for i, own in enumerate(found):
        if own is not None and own.cut_off is None and own.has_zero:
            alike = {other.cut_off for other in told if abs(other.step / own.step - 1) < 1e-3}
            found[i] = own._replace(cut_off=alike.pop()) if len(alike) == 1 else own
    return tuple(found)


@derived
def simulated_lattices(comparison: Comparison) -> tuple[Lattice | None, ...]:
    """The exact grids of the simulation, with those of the recording that are too fine to be seen in its own noise."""
    side = comparison.reference
    found = list(exact_lattices(side))
    for i, own in enumerate(exact_lattices(comparison.as_came)):
        if own is not None and found[i] is None:
            values = side.signal[0, i]
            if share_on_grid(values, own.step) >= 0.999:
                found[i] = own._replace(offset=grid_offset(values, own.step))
    return tuple(found)


@derived
def code_lattices(side: Records) -> tuple[Lattice | None, ...]:
    """The same down to steps that change nothing in the noise, as of converters of many bits, or of arithmetic."""
    return tuple(_exact_in(side, 1 / 2000))


def _exact_in(side: Records, finest: float) -> list[Lattice | None]:
    """Exact grids of steps from so many sd of a sample given its past."""
    each = zip(distinct_values(side), innovation_sd(side), strict=True)
    return [_exact_lattice(*values, float(sd), finest) for values, sd in each]


def _exact_lattice(unique: Tensor, counts: Tensor, sd: float, finest: float) -> Lattice | None:
    """Grid on which 999 of 1000 samples lie to a hundredth of a step: converters also have end stops.

    Its step is the usual or the smallest gap between values, but for finer ones: those are noise of arithmetic.
    """
    gaps = unique.diff()
    wide = gaps[gaps >= finest * sd]
    for step in (float(wide.median()), float(wide.min())) if len(wide) > 1 else ():
        k = torch.cat([torch.zeros(1, dtype=torch.float64), (gaps / step).round().cumsum(0)])
        middle, mean = ((counts * v).sum() / counts.sum() for v in (k, unique))
        step = float((counts * (k - middle) * (unique - mean)).sum() / (counts * (k - middle).square()).sum())
        off = (unique - mean) / step - (k - middle)
        if float(counts[off.abs() < 0.01].sum() / counts.sum()) >= 0.999:
            offset = math.remainder(float(mean - middle * step), step)
            found = Lattice(step, offset, 0.0, 0.0)
            told = found.has_zero and step < 3 * sd  # coarser ones are met by a bias that stays there
            return found._replace(cut_off=is_cut_off(step_counts(unique, counts, step))) if told else found
    return None


def grid_offset(values: Tensor, step: float) -> float:
    """Where a grid of a known step lies."""
    return float(torch.exp(2j * math.pi / step * values).mean().angle()) / (2 * math.pi) * step


def share_on_grid(values: Tensor, step: float) -> float:
    """Share of values that lie on a grid of a known step, wherever it lies, to a hundredth of the step."""
    off = off_lattice(values, step, grid_offset(values, step))
    return float((off.abs() < 0.01).to(torch.float64).mean())


def off_lattice(values: Tensor, step: float | Tensor, offset: float | Tensor) -> Tensor:
    """Distances of values from the nearest point of a grid, steps."""
    place = (values - offset) / step
    return place - place.round()
