"""A level of noise that is another for a while, in several sensors by as little as only many together tell.

Of the energy of `n` normal values a stretch of `m` holds the share `x`. If their variance is `r` times that of the
others, whatever that is, its likelihood ratio is

    E = r^(-m/2) (1 - x + x/r)^(-n/2)

and which of the sensors take part is left open. Means over stretches, factors and shares of the sensors have
expectation one where nothing changes, so that they exceed `x` with probability `1/x` at most (Ville, 1939), and with
`1/30x` or less in 4500 drawn records of 1 to 6 sensors: `1/20x` is held to.

Where another record is known to have the level that does not change, its samples count with those outside the stretch.
Where levels vary by themselves, ratios are tempered: `E^w`, with `w` the weight of a sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.stats.multiplicity import e_value_of_some, p_value_from_e_value

_FINEST = 512  # blocks in the record
_STRIDE = 8  # starts in a stretch
_LENGTHS = 2  # in an octave
_DEVIATIONS = (1.2, 2.0, 3.2, 5.0, 8.0, 14.0, 25.0)  # of a factor's logarithm from 0, sd
_LARGEST = 30.0  # factor


class LevelScan(NamedTuple):
    """The likeliest stretch with another level.

    Attributes:
        log_ratio: Log of the mean likelihood ratio over all stretches and factors, nats.
        start, stop: Samples.
    """

    log_ratio: float
    start: int
    stop: int

    @property
    def p_value(self) -> float:
        """Of a level that does not change."""
        return p_value_from_e_value(self.log_ratio)


class Reference(NamedTuple):
    """Another record, of the level that is compared with.

    Attributes:
        level: Of the squares of the record looked at, `(sensor,)`; 1 is its own mean.
        worth: Independent samples from which it is known.
    """

    level: Tensor
    worth: float

    def of(self, sensors: Sequence[int]) -> Reference:
        """For some of the sensors."""
        return self._replace(level=self.level[list(sensors)])


def scanned_levels(squares: Tensor, reference: Reference | None = None, weight: Tensor | None = None) -> LevelScan:
    """Evidence of a stretch with another level than the rest, and the reference if there is one, has.

    Args:
        squares: Of whitened samples, `(sensor, time)`.
        reference: What else is known of the level outside.
        weight: What a sample counts for where levels vary by themselves, `(sensor,)`; 1 by default.
    """
    block = max(squares.shape[-1] // _FINEST, 1)
    blocks = squares[..., : squares.shape[-1] // block * block].unflatten(-1, (-1, block)).sum(-1)
    n_blocks = blocks.shape[-1]
    share, n = _of_all(n_blocks * block, reference)
    total = torch.nn.functional.pad((share * blocks / blocks.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
    logs, best, where = [], -math.inf, (0, n_blocks * block)
    lengths = sorted({round(2 ** (k / _LENGTHS)) for k in range(int(_LENGTHS * math.log2(n_blocks / 2)) + 1)})
    for length in lengths:
        start = torch.arange(0, n_blocks - length + 1, max(length // _STRIDE, 1))
        every = _log_ratios(total[:, start + length] - total[:, start], length * block, n, weight)
        logs.append(torch.logsumexp(every.flatten(), 0) - math.log(every.numel()))
        if float(every.max()) > best:
            best, at = float(every.max()), int(start[int(every.amax(0).argmax())])
            where = (at * block, (at + length) * block)
    return LevelScan(float(torch.logsumexp(torch.stack(logs), 0)) - math.log(len(logs)), *where)


def other_level(n_samples: int, reference: Reference, weight: Tensor | None = None) -> float:
    """Log of the mean likelihood ratio of another level throughout the record than the reference has, nats."""
    share, n = _of_all(n_samples, reference)
    every = _log_ratios(share, n_samples, n, weight)
    return float(torch.logsumexp(every.flatten(), 0)) - math.log(every.numel())


def _of_all(n_samples: int, reference: Reference | None) -> tuple[Tensor, float]:
    """The record's share of all energy, `(sensor, 1)` or what goes for each, and samples of record and reference."""
    if reference is None:
        return torch.ones(1, 1, dtype=torch.float64), n_samples
    return (n_samples / (n_samples + reference.worth * reference.level))[:, None], n_samples + reference.worth


def _log_ratios(x: Tensor, m: float, n: float, weight: Tensor | None) -> Tensor:
    """Log ratios `(factor, place)` of shares `(sensor, place)` of the energy in `m` of `n` samples, any sensors."""
    weight = torch.ones(len(x), dtype=x.dtype) if weight is None else weight
    deviations = torch.tensor(_DEVIATIONS, dtype=torch.float64)
    reach = (deviations * math.sqrt((2 / m + 2 / (n - m)) / float(weight.mean()))).clamp(max=math.log(_LARGEST))
    log_r = torch.cat([reach, -reach])[:, None]
    return e_value_of_some(
        weight[:, None, None] * (-m / 2 * log_r - n / 2 * torch.log1p(x[:, None] * torch.expm1(-log_r)))
    )
