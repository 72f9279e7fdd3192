"""Whether a simulation is known to be, or looks, Gaussian: decided once for each sensor.

A Gaussian model is. Samples are taken for Gaussian noise of a steady level where nothing that they show is against it:
neither their kurtosis nor their tails, nor squares that are larger together, in the sensor by itself or in all sensors
together. Exact Gaussian laws then hold for the recording; else all that is known is what the simulation shows.

What that costs in size: where both sides depart by `d` sd of a kurtosis, the simulation passes with `Phi(2 - d)`, and
the recording is beyond the 4.3 sd that one place of 36 needs at 1 %/15 with `Phi(d - 4.3)`. The product is 1.4 % at
worst, for `d = 3.1`; 0.8 % for jumps, whose scale has to show less than 1.6 sd besides. In return nine of ten Gaussian
simulations keep the exact law.
"""

from __future__ import annotations

import math

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out, pooled_squares
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.long_run_variance import ORDINATES

NOTHING_SHOWN = 0.1  # p value above which a simulation shows no departure: power against size, see above
SQUARE_CUT = 9.0  # squares: an outlier is no change of level
TAILS = (3.5, 4.0, 4.5, 5.0, 6.0, 8.0)  # sd: one sample beyond the last is certain whatever else there is


@derived
def gaussian_sensors(side: Records) -> Tensor:
    """Which sensors of a simulation are Gaussian noise of a steady level, `(sensor,)`."""
    if side.gaussian:
        return torch.ones(side.signal.shape[1], dtype=torch.bool)
    expected = left_out(side)
    kurtosis = _kurtosis_scores(expected.white)
    together = kurtosis.sum() / math.sqrt(len(kurtosis))
    levels = torch.tensor([stats.chi2.isf(2 * stats.norm.sf(level), len(kurtosis)) for level in TAILS])
    shown = (
        torch.special.ndtr(-torch.maximum(kurtosis, together)),
        _tails(expected.z.abs()),
        _tails(pooled_squares(expected.z).sqrt()[:, None], levels.sqrt()),
        _steadiness(expected.white),
    )
    return torch.stack([p.expand(len(kurtosis)) for p in shown]).amin(0) > NOTHING_SHOWN / len(shown)


def _kurtosis_scores(white: Tensor) -> Tensor:
    """Of white records `(record, sensor, time)`, standard normal if they are Gaussian, `(sensor,)`."""
    n = white.shape[0] * white.shape[-1]
    centred = white - white.mean(-1, keepdim=True)
    kurtosis = (centred.pow(4).mean(-1) / centred.square().mean(-1).square()).mean(0)
    return (kurtosis - 3) * math.sqrt(n / 24)


def _tails(size: Tensor, levels: Tensor | None = None) -> Tensor:
    """p values of so many moduli `(record, sensor, time)` beyond the levels, `(sensor,)`, for having looked at all."""
    levels = torch.tensor(TAILS, dtype=size.dtype) if levels is None else levels
    counts = (size[..., None, :] > levels[:, None]).sum((0, -1)).numpy()  # (sensor, level)
    expected = size.shape[0] * size.shape[-1] * 2 * stats.norm.sf(TAILS)
    p = torch.from_numpy(stats.poisson.sf(counts - 1, expected)).amin(-1)
    return -torch.expm1(len(TAILS) * torch.log1p(-p.clamp(max=1 - 1e-16)))


def _steadiness(white: Tensor) -> Tensor:
    """p values of a level that changes no more than chance has it in `(record, sensor, time)`, `(sensor,)`.

    The lowest ordinates of the squares' periodogram are higher than their mean: chi-square, for every number of them
    that a long-run variance is estimated from.
    """
    squares = white.square().clamp(max=SQUARE_CUT)
    squares = torch.cat([squares, squares.sum(1, keepdim=True)], 1)
    squares = squares - squares.mean(-1, keepdim=True)
    squares = squares / squares.square().mean(-1, keepdim=True).sqrt()
    transform = torch.fft.rfft(squares)[..., 1 : ORDINATES[0] + 1]
    power = (transform.real.square() + transform.imag.square()).sum(0) / squares.shape[-1]  # (sensor + 1, ordinate)
    p = torch.stack(
        [
            torch.special.gammaincc(torch.tensor(float(m * len(white)), dtype=power.dtype), power[:, :m].sum(-1))
            for m in ORDINATES
        ]
    )
    p = -torch.expm1(len(ORDINATES) * torch.log1p(-p.amin(0).clamp(max=1 - 1e-16)))
    return torch.minimum(p[:-1], p[-1])
