"""Surrogate test of a channel: whether a bias follows its shape, or only something as smooth.

A smooth channel fits a random walk by chance. Surrogates have the spectrum of the channel's share of the bias and
random phases; the channel has to fit better than nearly all of them.

References: Theiler et al., Testing for nonlinearity in time series: the method of surrogate data, Physica D 58 (1992),
77.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.scans import Scan, SlowAnalysis
from gyrofuse.mismatch.likelihoods.slow_noise import cosines, ordinates
from gyrofuse.mismatch.signals.comparison import N_BLOCKS

_SURROGATES, _AS_GOOD = 200, 2  # surrogates, of which so many may fit as well: 1 %
_RECORDS, _USUAL = 100, 0.9  # drawn records that follow the channel, and how many of them are no less like it


def beats_surrogates(analysis: SlowAnalysis, scan: Scan, generator: torch.Generator) -> bool:
    """Whether a channel's shape beyond its trend fits better than nearly all such shapes with random phases.

    The trend itself, which any drift has, is left out of both; where the shape gains little nothing can be said. A
    shape that is nearly one wave has many surrogates that hardly differ from it, and in many sensors any shape has many
    sizes to fit noise with: some surrogates do as well by chance where all sensors follow the channel. Where they do no
    better, all together, than they would then, they are no reason against it.

    Args:
        analysis: Ordinates of the scan.
        scan: Scan of temperatures.
        generator: Source of the phases and of the records.
    """
    which = list(scan.sensors)
    y, variance = analysis.y[which], scan.fit.variance[which]
    t = torch.linspace(-1, 1, N_BLOCKS, dtype=torch.float64)
    # What several paths do together, as in the sensor that shows it best.
    best = max(which, key=lambda i: float(scan.z[i].norm()))
    course = scan.fit.size[best] @ scan.design @ cosines()
    course = course - (course @ t) / (t @ t) * t
    transform = torch.fft.rfft(course)
    turn = 2 * math.pi * torch.rand(_SURROGATES, len(transform), generator=generator, dtype=torch.float64)
    surrogates = torch.fft.irfft(transform * torch.polar(torch.ones_like(turn), turn), n=len(course))
    shapes, trend = ordinates(torch.cat([course[None], surrogates])), ordinates(t)
    z, axes = _without_trend(y, variance, shapes, trend)
    gain = z.square().sum(0) / 2
    if float(gain[0]) < 8.0 or int((gain[1:] >= gain[0]).sum()) <= _AS_GOOD:  # nats that surrogates can tell apart
        return True
    # Sizes of all sensors together are overestimated by their own scatter.
    followed = z[:, 0] * math.sqrt(max(1 - len(which) / (2 * float(gain[0])), 0.0))
    noise = torch.randn(_RECORDS, *y.shape, generator=generator, dtype=torch.float64)
    records = followed[:, None] * axes[:, 0] + noise  # (record, sensor, ordinate), in standard deviations
    if_followed = (records.movedim(0, 1) @ axes.mT).square().sum(0) / 2  # (record, shape)
    # Likelihood of any surrogate over that of the channel, logarithm.
    ratio, usual = (g[..., 1:].logsumexp(-1) - g[..., 0] for g in (gain, if_followed))
    return float(ratio) <= float(usual.quantile(_USUAL))


def _without_trend(y: Tensor, variance: Tensor, shapes: Tensor, trend: Tensor) -> tuple[Tensor, Tensor]:
    """Sizes of shapes `(shape, ordinate)` beside a trend, in standard deviations, and their whitened unit vectors.

    Returns:
        `(sensor, shape)` and `(sensor, shape, ordinate)`.
    """
    sd = variance.sqrt()
    white = shapes / sd[:, None]
    line = torch.nn.functional.normalize(trend / sd, dim=-1)[:, :, None]  # (sensor, ordinate, 1)
    axes = torch.nn.functional.normalize(white - (white @ line) * line.mT, dim=-1)
    return (axes @ (y / sd)[..., None])[..., 0], axes
