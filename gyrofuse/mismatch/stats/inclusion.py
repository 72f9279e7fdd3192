"""Which sensors take part in what the array has: those likelier to have about as much of it as others than none."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import special
from torch import Tensor

_SIZES = (0.7, 1.0, 1.4)  # of an effect in a sensor over that in others of its array: built alike, they feel alike
_ROUNDS, _HALVINGS = 4, 30
_CHANCE = 0.04  # that any sensor seems to have an effect, to begin with
_SURE = 1e-6  # chance that any sensor seems to have it, of one that has it whatever the others have
_LARGEST = 1e6  # statistic


class Inclusion(NamedTuple):
    """Sensors that take part.

    Attributes:
        which: `(sensor,)`; at least the one with the largest statistic.
        least: Statistic from which a sensor does.
    """

    which: Tensor
    least: float

    @property
    def positions(self) -> tuple[int, ...]:
        return tuple(self.which.nonzero()[:, 0].tolist())


def included_sensors(statistic: Tensor, dof: int, chance: float = _CHANCE) -> Inclusion:
    """Those whose statistic is likelier with about as much of the effect as others have than with none.

    Without it is chi-square, with it noncentral: where the others have much, a little is chance; where they have
    little, it is theirs. What is beyond doubt by itself is so beside anything.

    Args:
        statistic: Squares of estimates in standard deviations, `(sensor,)`.
        dof: Of each.
        chance: That any sensor seems to have it which has not, of those that are taken for sure to begin with.
    """
    x = statistic.to(torch.float64).nan_to_num(nan=0.0).clamp(max=_LARGEST)
    largest = torch.arange(len(x)) == x.argmax()
    least, most = (float(special.chdtri(dof, p / len(x))) for p in (chance, _SURE))
    for _ in range(_ROUNDS):
        taking = (x > least) | largest
        size = float((x[taking] - dof).mean().clamp(min=1.0))
        least = min(_least(dof, size), most)
    return Inclusion((x > least) | largest, least)


def _least(dof: int, size: float) -> float:
    """Statistic that is as likely with an effect of about a size, the noncentrality, as without."""
    low, high = 0.0, dof + 2 * size + 20.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        ratios = [_log_ratio(middle, dof, s**2 * size) for s in _SIZES]
        less = special.logsumexp(ratios) < math.log(len(_SIZES))
        low, high = (middle, high) if less else (low, middle)
    return (low + high) / 2


def _log_ratio(x: float, dof: int, size: float) -> float:
    """Density of a noncentral chi-square variable over that of a central one, logarithm."""
    root, order = math.sqrt(size * x), dof / 2 - 1
    bessel = math.log(special.ive(order, root)) + root
    return float(bessel - order * math.log(root / 2) + math.lgamma(dof / 2) - size / 2)
