"""Which sensors of an array have an effect, given that some have.

A sensor without it has a chi-square statistic, one with it a noncentral one of about the noncentrality that the others
have, since sensors of one array are built alike. It is included where the noncentral density is the larger one: beside
large effects a small statistic is chance, beside small ones it is an effect.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import optimize, special
from torch import Tensor

_SIZES = (0.7, 1.0, 1.4)  # sizes of an effect in a sensor over the mean size: within a factor of two in one array


class Inclusion(NamedTuple):
    """Sensors that have an effect.

    Attributes:
        which: `(sensor,)`; at least the one with the largest statistic.
        least: Statistic from which on a sensor is included.
    """

    which: Tensor
    least: float

    @property
    def positions(self) -> tuple[int, ...]:
        """Positions of these sensors."""
        return tuple(self.which.nonzero()[:, 0].tolist())


def included_sensors(statistic: Tensor, dof: int, chance: float = 0.04, sure: float = 1e-6) -> Inclusion:
    """Sensors whose statistic is likelier with the effect of the others than with none.

    Args:
        statistic: Squares of estimates in standard deviations, `(sensor,)`.
        dof: Degrees of freedom of each.
        chance: False-alarm rate of all sensors together, of those that are included to begin with.
        sure: False-alarm rate of all sensors together, of those that are included whatever the others have.
    """
    x = statistic.to(torch.float64).nan_to_num(nan=0.0).clamp(max=1e6)  # larger ones overflow Bessel functions
    largest = torch.arange(len(x)) == x.argmax()
    least, most = (float(special.chdtri(dof, p / len(x))) for p in (chance, sure))
    for _ in range(4):  # the set and the size of its effect in turn
        size = float((x[(x > least) | largest] - dof).mean().clamp(min=1.0))
        least = min(_least(dof, size), most)
    return Inclusion((x > least) | largest, least)


def _least(dof: int, size: float) -> float:
    """Statistic that is as likely with an effect of about a size, the noncentrality, as without."""

    def log_odds(x: float) -> float:
        return float(special.logsumexp([_log_ratio(x, dof, s**2 * size) for s in _SIZES])) - math.log(len(_SIZES))

    return float(optimize.brentq(log_odds, 1e-12, dof + 2 * size + 20.0, xtol=1e-8))


def _log_ratio(x: float, dof: int, size: float) -> float:
    """Logarithm of the density of a noncentral chi-square variable over that of a central one."""
    root, order = math.sqrt(size * x), dof / 2 - 1
    bessel = math.log(special.ive(order, root)) + root
    return float(bessel - order * math.log(root / 2) + math.lgamma(dof / 2) - size / 2)
