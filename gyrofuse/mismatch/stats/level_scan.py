"""The level of noise: evidence of a stretch of another one, and its slow course.

A stretch of another level may show in several sensors together only. Of the energy of `n` normal values a stretch of
`m` holds the share `x`. If its variance is `r` times that of the rest, whatever that is, the likelihood ratio to a
steady level is

    E = r^(-m/2) (1 - x + x/r)^(-n/2)

Its mean over stretches, factors and shares of the sensors has expectation one where nothing changes (`multiplicity`).
Samples of a simulation whose level is known to be steady count with those outside the stretch. Where levels vary by
themselves, ratios are tempered: `E^w`, with `w` the weight of a sample (`level_spread`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse.mismatch.stats.multiplicity import e_value_of_some, log_mean, p_value_from_e_value

WINDOW = 257  # samples: of Gaussian noise their mean square is known to a tenth, bursts of tens of samples stay
# Factors, sd of their logarithm. Each is 1.66 times the one before: the nearer one gains 92 % of the nats between them.
_DEVIATIONS = torch.logspace(math.log10(1.2), math.log10(25.0), 7, dtype=torch.float64)


class LevelScan(NamedTuple):
    """Scan for a stretch with another level.

    Attributes:
        log_ratio: Logarithm of the mean likelihood ratio over all stretches and factors, nats.
        start, stop: Samples of the likeliest stretch.
    """

    log_ratio: float
    start: int
    stop: int

    @property
    def p_value(self) -> float:
        """p value of a steady level."""
        return p_value_from_e_value(self.log_ratio)


class Reference(NamedTuple):
    """Level of another record, which the level outside of the stretch is known to have.

    Attributes:
        level: Mean square over that of the record searched, `(sensor,)`.
        n_samples: Number of independent samples from which it is known.
    """

    level: Tensor
    n_samples: float

    def of(self, sensors: Sequence[int]) -> Reference:
        """The reference of some of the sensors."""
        return self._replace(level=self.level[list(sensors)])


def scanned_levels(squares: Tensor, reference: Reference | None = None, weight: Tensor | None = None) -> LevelScan:
    """Evidence of a stretch with another level than the rest and the reference.

    Stretches are of 1, 1.4, 2, 2.8 ... of 512 blocks, and start at every eighth of their length; `segments` finds their
    ends to the sample.

    Args:
        squares: Squares of whitened samples, `(sensor, time)`.
        reference: Level outside, where it is known beside the record.
        weight: Weight of a sample where levels vary by themselves, `(sensor,)`; 1 by default.
    """
    block = max(squares.shape[-1] // 512, 1)
    blocks = squares[..., : squares.shape[-1] // block * block].unflatten(-1, (-1, block)).sum(-1)
    n_blocks = blocks.shape[-1]
    share, n = _energy_share(n_blocks * block, reference)
    total = pad((share * blocks / blocks.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
    logs, best, where = [], -math.inf, (0, n_blocks * block)
    for length in sorted({round(2 ** (k / 2)) for k in range(int(2 * math.log2(n_blocks / 2)) + 1)}):
        start = torch.arange(0, n_blocks - length + 1, max(length // 8, 1))
        ratios = _log_ratios(total[:, start + length] - total[:, start], length * block, n, weight)
        logs.append(log_mean(ratios))
        if float(ratios.max()) > best:
            best, at = float(ratios.max()), int(start[int(ratios.amax(0).argmax())])
            where = (at * block, (at + length) * block)
    return LevelScan(log_mean(torch.tensor(logs, dtype=torch.float64)), *where)


def other_level(n_samples: int, reference: Reference, weight: Tensor | None = None) -> float:
    """Logarithm of the mean likelihood ratio of another level throughout the record than the reference's, nats."""
    share, n = _energy_share(n_samples, reference)
    return log_mean(_log_ratios(share, n_samples, n, weight))


def _energy_share(n_samples: int, reference: Reference | None) -> tuple[Tensor, float]:
    """Share of all energy that is the record's, `(sensor or 1, 1)`, and number of samples of record and reference."""
    if reference is None:
        return torch.ones(1, 1, dtype=torch.float64), n_samples
    n = n_samples + reference.n_samples
    return (n_samples / (n_samples + reference.n_samples * reference.level))[:, None], n


def _log_ratios(x: Tensor, m: float, n: float, weight: Tensor | None) -> Tensor:
    """Log ratios `(factor, stretch)` that some sensors have a level of their own.

    Args:
        x: Shares of the energy in `m` of `n` samples, `(sensor, stretch)`.
        m: Samples of the stretch.
        n: Samples of record and reference.
        weight: Weight of a sample, `(sensor,)`.
    """
    weight = torch.ones(len(x), dtype=x.dtype) if weight is None else weight
    reach = _DEVIATIONS * math.sqrt((2 / m + 2 / (n - m)) / float(weight.mean()))
    reach = reach.clamp(max=math.log(30.0))  # larger factors show under this one as well
    log_r = torch.cat([reach, -reach])[:, None]
    return e_value_of_some(
        weight[:, None, None] * (-m / 2 * log_r - n / 2 * torch.log1p(x[:, None] * torch.expm1(-log_r)))
    )


def local_level(values: Tensor) -> Tensor:
    """Mean of clipped squares around each sample over that of all, `(..., time)`; at the ends of as many as there are.

    Squares are clipped at nine times the level found so far, so that an outlier is no level. Where the level is ten
    times the mean the first round follows half of it, the second nearly all.

    Args:
        values: White or nearly white noise, `(..., time)`.
    """
    n = values.shape[-1]
    half = min(WINDOW // 2, (n - 1) // 2)
    at = torch.arange(n)
    low, high = (at - half).clamp(min=0), (at + half + 1).clamp(max=n)
    squares = values.square()
    level = squares.mean(-1, keepdim=True).clamp(min=1e-300)
    for _ in range(3):
        total = pad(squares.minimum(9.0 * level).cumsum(-1), (1, 0))
        level = ((total[..., high] - total[..., low]) / (high - low)).clamp(min=1e-300)
    return level / level.mean(-1, keepdim=True)


def octaves(first: int, n: int) -> Iterator[slice]:
    """Bins from a first one up to `n`, in octaves of eight at least."""
    low, width = first, 8
    while low < n:
        high = low + width if low + 2 * width <= n else n
        yield slice(low, high)
        low, width = high, max(high, 8)


def octave_level(power: Tensor, first: int) -> Tensor:
    """Level of noise near each bin, `(..., 1, bin)`: the median of its octave, over all frames `(..., frame, bin)`.

    In units of the mean of exponential values; one where nothing is known. What is not a number does not count.
    """
    level = torch.ones_like(power[..., :1, :])
    for octave in octaves(first, power.shape[-1]):
        own = power[..., octave].flatten(-2).nanmedian(-1).values / math.log(2)
        level[..., octave] = torch.where(own > 0, own, 1.0)[..., None, None]
    return level
