"""Noise whose power goes up and down: with a period, slowly, or in bursts.

The squares of whitened noise are white. With `S_i(k)` the transforms of squares, cut at nine, of independent
combinations of the sensors, `|sum_(i in set) S_i|^2` over the size of the set is exponential at every frequency, and
`sum_i |S_i|^2` is Gamma distributed. A line is a period (cyclostationary noise), an excess over an octave or below a
frequency is a level that wanders, or bursts.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import fast_length, squared_modulus
from gyrofuse.mismatch.signals.lines import sets_of
from gyrofuse.mismatch.stats.multiplicity import sidak

_FINER = 2  # fine bins in a bin, so that a line between two is not lost
_INDEPENDENT = 0.8  # of them
_FIRST = 3  # bins: below, a line is a drift
_LEAST = 1e-6  # of a correlation matrix's eigenvalues
_CHUNK = 2**14


class Modulation(NamedTuple):
    """The most conspicuous modulation of the noise's power.

    Attributes:
        p_value: For having looked everywhere.
        period: Whether it is a line.
        low, high: Frequencies between which it was seen, cycles per sample.
        sensors: Set in which it was seen.
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
    """Of squares of whitened noise.

    Args:
        squares: `(sensor, time)`.
        correlations: Autocorrelations that they have though nothing is modulated, `(lag, sensor)` from lag one.
    """
    rows = _decorrelated(squares)
    p, n = rows.shape
    length = fast_length(_FINER * n)
    fine = length / n
    transform = torch.fft.rfft(rows, n=length) / math.sqrt(n)
    if correlations is not None and bool(correlations.any()):
        lags = torch.arange(1, len(correlations) + 1, dtype=squares.dtype)
        waves = torch.cos(2 * math.pi * torch.arange(transform.shape[-1])[:, None] / length * lags)
        transform = transform / (1 + 2 * waves @ correlations).clamp(min=_LEAST).sqrt().mT
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
        for first in range(low + 1, high + 1, _CHUNK):
            last = min(first + _CHUNK, high + 1)
            places = torch.arange(round(first * fine), round(last * fine))
            part = transform[:, places]
            power = torch.cat([squared_modulus(scaled @ part), squared_modulus(part).sum(0, keepdim=True)])
            total += power[:, (torch.arange(first, last) * fine).round().long() - places[0]].sum(-1)
            if first > _FIRST:
                best, where = power.max(-1)
                peak.append(best)
                at.append(places[where])
        sums.append(total)
    octaves = torch.stack(sums)
    count = shape * torch.tensor(edges).diff()[:, None]
    more = (octaves / count).clamp(min=1.0)
    log_ratio = float(((octaves - count * (1 + more.log()) - 1) * (more > 1)).clamp(min=0).sum(0).add(log_chance).max())
    return min(
        _line(torch.stack(peak), torch.stack(at), shape, log_chance, sets, length),
        _band(octaves, edges, shape, log_chance, sets, n),
        key=lambda found: found.p_value,
    )._replace(log_ratio=log_ratio)


def _line(peak: Tensor, at: Tensor, shape: Tensor, log_chance: Tensor, sets: Tensor, length: int) -> Modulation:
    """The strongest of peaks `(part, set)` at fine bins."""
    log_p = torch.special.gammaincc(shape.expand_as(peak), peak).clamp(min=1e-300).log() - log_chance
    part, which = divmod(int(log_p.argmin()), len(shape))
    f = int(at[part, which]) / length
    p_value = sidak(math.exp(min(float(log_p[part, which]), 0.0)), 2 * _INDEPENDENT * length / 2)
    return Modulation(p_value, True, f, f, _sensors(which, sets), 0.0)


def _band(sums: Tensor, edges: list[int], shape: Tensor, log_chance: Tensor, sets: Tensor, n: int) -> Modulation:
    """The largest excess of sums over octaves `(octave, set)`, of one or of all that are slower."""
    ends = torch.tensor(edges)
    count = torch.cat([ends.diff(), ends[1:]])[:, None]
    totals = torch.cat([sums, sums.cumsum(0)])
    log_p = torch.special.gammaincc(shape * count, totals).clamp(min=1e-300).log() - log_chance
    row, which = divmod(int(log_p.argmin()), len(shape))
    octave, slower = row % len(sums), row >= len(sums)
    p_value = sidak(math.exp(min(float(log_p[row, which]), 0.0)), 2 * len(totals))
    low, high = (1 if slower else edges[octave] + 1) / n, edges[octave + 1] / n
    return Modulation(p_value, False, low, high, _sensors(which, sets), 0.0)


def _sensors(which: int, sets: Tensor) -> tuple[int, ...]:
    """Sensors of one of the sets `(set, sensor)`; after the last comes the sum over all sensors, in any phases."""
    if which == len(sets):
        return tuple(range(sets.shape[-1]))
    return tuple(sets[which].nonzero()[:, 0].tolist())


def _decorrelated(squares: Tensor) -> Tensor:
    """Standardised rows that are independent, each as near to its sensor as can be: noise in common is one witness."""
    rows = squares - squares.mean(-1, keepdim=True)
    rows = rows / rows.square().mean(-1, keepdim=True).sqrt()
    values, vectors = torch.linalg.eigh(rows @ rows.mT / rows.shape[-1])
    return vectors / values.clamp(min=_LEAST).sqrt() @ vectors.mT @ rows
