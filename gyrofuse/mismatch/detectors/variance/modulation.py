"""Noise whose power goes up and down: with a period, slowly, or in bursts.

The squares of whitened noise are white. With `S_i(k)` the transforms of squares, cut at nine, of decorrelated sensors,
`|sum_(i in set) S_i|^2` over the size of the set is exponential at every frequency, and `sum_i |S_i|^2` is Gamma
distributed. A line is a period (cyclostationary noise), an excess over an octave or below a frequency is a level that
wanders, or bursts.

References:
    Gardner, Introduction to Random Processes, 1986, chapter 12: cyclostationary noise. McLeod and Li, Diagnostic
    checking ARMA time series models using squared-residual autocorrelations, JTSA 4 (1983), 269.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import fast_length, squared_modulus
from gyrofuse.mismatch.signals.lines import sets_of
from gyrofuse.mismatch.stats.decorrelation import decorrelated
from gyrofuse.mismatch.stats.multiplicity import sidak


class Modulation(NamedTuple):
    """The most conspicuous modulation of the noise's power.

    Attributes:
        p_value: p value over all frequencies and sets of sensors.
        period: Whether it is a line.
        low, high: Band in which it was found, cycles per sample.
        sensors: Positions of the sensors of the set in which it was found.
        log_ratio: Log likelihood ratio of powers that are raised in every octave by a factor of its own, less what the
            factors and the choice of the set cost, nats.
    """

    p_value: float
    period: bool
    low: float
    high: float
    sensors: tuple[int, ...]
    log_ratio: float


def strongest_modulation(squares: Tensor, correlations: Tensor | None = None) -> Modulation:
    """The most conspicuous modulation of squares of whitened noise, as a line or as a band.

    Args:
        squares: Squares, `(sensor, time)`.
        correlations: Autocorrelations that they have though nothing is modulated, `(lag, sensor)` from lag one.
    """
    rows = squares - squares.mean(-1, keepdim=True)
    rows = rows / rows.square().mean(-1, keepdim=True).sqrt()
    rows = decorrelated(rows, rows @ rows.mT / rows.shape[-1])
    p, n = rows.shape
    length = fast_length(2 * n)  # half a bin apart: a line between two would be lost
    fine = length / n
    transform = torch.fft.rfft(rows, n=length) / math.sqrt(n)
    if correlations is not None and bool(correlations.any()):
        lags = torch.arange(1, len(correlations) + 1, dtype=squares.dtype)
        waves = torch.cos(2 * math.pi * torch.arange(transform.shape[-1])[:, None] / length * lags)
        transform = transform / (1 + 2 * waves @ correlations).clamp(min=1e-6).sqrt().mT
    sets, log_chance = sets_of(p)
    scaled = (sets / sets.sum(-1, keepdim=True).sqrt()).to(transform.dtype)
    # Half of the error for the sets, half for all sensors whatever their phases.
    log_chance = torch.cat([log_chance, torch.zeros(1, dtype=torch.float64)]) - math.log(2)
    shape = torch.ones(len(log_chance), dtype=torch.float64)
    shape[-1] = p
    peak, at, sums = [], [], []
    edges = [0, *(2**j for j in range(int(math.log2(n // 2 - 1)) + 1))]  # bins below which there is an octave
    for low, high in itertools.pairwise(edges):
        total = torch.zeros(len(shape), dtype=torch.float64)
        for first in range(low + 1, high + 1, 2**14):
            last = min(first + 2**14, high + 1)
            bins = torch.arange(round(first * fine), round(last * fine))
            part = transform[:, bins]
            power = torch.cat([squared_modulus(scaled @ part), squared_modulus(part).sum(0, keepdim=True)])
            total += power[:, (torch.arange(first, last) * fine).round().long() - bins[0]].sum(-1)
            if first > 3:  # below, a line is a drift
                best, where = power.max(-1)
                peak.append(best)
                at.append(bins[where])
        sums.append(total)
    octaves = torch.stack(sums)
    count = shape * torch.tensor(edges).diff()[:, None]
    more = (octaves / count).clamp(min=1.0)
    gain = ((octaves - count * (1 + more.log()) - 1) * (more > 1)).clamp(min=0).sum(0)
    line, at_line = _most_extreme(torch.stack(peak), shape.expand(len(peak), -1), log_chance)
    # Of fine bins, which share noise with their neighbours, eight in ten are independent.
    p_line = sidak(math.exp(line), 2 * 0.8 * length / 2)
    totals = torch.cat([octaves, octaves.cumsum(0)])  # of one octave, or of all that are slower
    counts = torch.tensor([*(b - a for a, b in itertools.pairwise(edges)), *edges[1:]])[:, None]
    band, at_band = _most_extreme(totals, shape * counts, log_chance)
    p_band = sidak(math.exp(band), 2 * len(totals))
    log_ratio = float((gain + log_chance).max())
    if p_line <= p_band:
        frequency = int(torch.stack(at)[at_line]) / length
        return Modulation(p_line, True, frequency, frequency, _sensors(at_line[1], sets), log_ratio)
    octave, slower = at_band[0] % len(octaves), at_band[0] >= len(octaves)
    ends = (1 if slower else edges[octave] + 1) / n, edges[octave + 1] / n
    return Modulation(p_band, False, *ends, _sensors(at_band[1], sets), log_ratio)


def _most_extreme(power: Tensor, shape: Tensor, log_chance: Tensor) -> tuple[float, tuple[int, int]]:
    """Log p value of the least likely of Gamma variables `(row, set)` for the choice of the set, and its position."""
    log_p = torch.special.gammaincc(shape, power).clamp(min=1e-300).log() - log_chance
    row, which = divmod(int(log_p.argmin()), log_p.shape[-1])
    return min(float(log_p[row, which]), 0.0), (row, which)


def _sensors(which: int, sets: Tensor) -> tuple[int, ...]:
    """Sensors of one of the sets `(set, sensor)`; after the last comes the sum over all sensors, in any phases."""
    if which == len(sets):
        return tuple(range(sets.shape[-1]))
    return tuple(sets[which].nonzero()[:, 0].tolist())
