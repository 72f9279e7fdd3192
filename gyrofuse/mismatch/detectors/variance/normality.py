"""Whether a simulation is known to be Gaussian, or is taken for it: decided once for each sensor.

A Gaussian model is. Samples are taken for Gaussian noise of a steady level where nothing in them is against it: neither
their kurtosis nor their tails, nor squares that are larger together, in the sensor by itself or in all sensors
together. Exact Gaussian laws then hold for the recording; else all that is known is what the simulation shows.

What that costs in size: where both sides depart by `d` sd of a kurtosis, the simulation passes with `Phi(2 - d)`, and
the recording is beyond the 4.3 sd that one of 36 statistics needs at 1 %/15 with `Phi(d - 4.3)`. The product is 1.4 %
at worst, for `d = 3.1`; 0.8 % for jumps, whose scale has to show less than 1.6 sd besides. In return nine of ten
Gaussian simulations keep the exact law.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.decorrelation import norms
from gyrofuse.mismatch.stats.kurtosis import kurtosis_score
from gyrofuse.mismatch.stats.long_run_variance import ORDINATES
from gyrofuse.mismatch.stats.tails import (
    Array,
    chi_levels,
    counts_beyond,
    gaussian_tail_p_values,
    of_all_levels,
)

NOTHING_SHOWN = 0.1  # p value above which a simulation shows no departure: power against size, see above
SQUARE_CUT = 9.0  # squares of whitened samples, beyond which they are outliers rather than signs of another level: 3 sd


@derived
def gaussian_sensors(side: Records) -> Tensor:
    """Which sensors of a simulation are Gaussian noise of a steady level, `(sensor,)`."""
    n_sensors, n = side.signal.shape[1:]
    if side.gaussian:
        return torch.ones(n_sensors, dtype=torch.bool)
    expected = left_out(side)
    kurtosis = kurtosis_score(expected.white).sum(0) / math.sqrt(len(expected.white))
    together = kurtosis.sum() / math.sqrt(n_sensors)
    tails = of_all_levels(gaussian_tail_p_values(tail_counts(side), len(expected.z) * n))
    steadiness = _steadiness(expected.white)
    shown = (torch.special.ndtr(-torch.maximum(kurtosis, together)), *_both(tails), steadiness)
    return torch.stack([p.expand(n_sensors) for p in shown]).amin(0) > NOTHING_SHOWN / len(shown)


def _both(p_values: Tensor) -> tuple[Tensor, Tensor]:
    """p values of each sensor and of all together, from `(sensor + 1,)`."""
    return p_values[:-1], p_values[-1]


@derived
def tail_counts(side: Records) -> Array:
    """Numbers of prediction errors beyond the levels for Gaussian noise, `(sensor + 1, level)`."""
    return counts_of_errors(left_out(side).z)


def counts_of_errors(z: Tensor) -> Array:
    """Numbers of errors beyond these levels in each sensor, and of their norms, `(sensor + 1, level)`.

    Args:
        z: Standardised errors, `(record, sensor, time)`.
    """
    each, together = counts_beyond(z.abs()), counts_beyond(norms(z), chi_levels(z.shape[1]))
    return np.concatenate([each.sum(0), together.sum(0)[None]])


def _steadiness(white: Tensor) -> Tensor:
    """p values of a steady level in `(record, sensor, time)`, `(sensor,)`.

    The lowest ordinates of the squares' periodogram against their mean: Gamma distributed, for every number of them
    that a long-run variance is estimated from.
    """
    squares = white.square().clamp(max=SQUARE_CUT)
    squares = torch.cat([squares, squares.sum(1, keepdim=True)], 1)
    squares = squares - squares.mean(-1, keepdim=True)
    squares = squares / squares.square().mean(-1, keepdim=True).sqrt()
    transform = torch.fft.rfft(squares)[..., 1 : ORDINATES[0] + 1]
    power = (transform.real.square() + transform.imag.square()).sum(0) / squares.shape[-1]  # (sensor + 1, ordinate)
    orders = torch.tensor(ORDINATES, dtype=power.dtype) * len(white)
    p = torch.special.gammaincc(orders, torch.stack([power[:, :m].sum(-1) for m in ORDINATES], -1))
    each, together = _both(of_all_levels(p.numpy()))
    return torch.minimum(each, together)
