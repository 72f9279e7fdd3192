"""A level of noise that is another for a while, in several sensors by as little as only many together tell.

Of the energy of `n` normal values a stretch of `m` holds the share `x`. If their variance is `r` times that of the
others, whatever that is, its likelihood ratio is

    E = r^(-m/2) (1 - x + x/r)^(-n/2)

and `prod (1 + E)/2` over the sensors leaves open which of them take part. Means over stretches and factors have
expectation one where nothing changes, so that they exceed `x` with probability `1/x` at most (Ville, 1939), and with
less than `1/70x` by what importance sampling from the same mixture gives for 1 and 6 sensors: `1/20x` is held to.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.evidence import ratio_p_value
from gyrofuse.mismatch.shocks import log_half

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
        return ratio_p_value(self.log_ratio)


def scanned_levels(squares: Tensor) -> LevelScan:
    """Evidence of another level in squares `(sensor, time)` of whitened samples."""
    block = max(squares.shape[-1] // _FINEST, 1)
    blocks = squares[..., : squares.shape[-1] // block * block].unflatten(-1, (-1, block)).sum(-1)
    total = torch.nn.functional.pad((blocks / blocks.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
    n_blocks = blocks.shape[-1]
    n = n_blocks * block
    deviations = torch.tensor(_DEVIATIONS, dtype=torch.float64)
    logs, best, where = [], -math.inf, (0, n)
    lengths = sorted({round(2 ** (k / _LENGTHS)) for k in range(int(_LENGTHS * math.log2(n_blocks / 2)) + 1)})
    for length in lengths:
        m = length * block
        reach = (deviations * math.sqrt(2 / m + 2 / (n - m))).clamp(max=math.log(_LARGEST))
        log_r = torch.cat([reach, -reach])[:, None]
        start = torch.arange(0, n_blocks - length + 1, max(length // _STRIDE, 1))
        x = total[:, None, start + length] - total[:, None, start]  # (sensor, 1, place)
        one = -m / 2 * log_r - n / 2 * torch.log1p(x * torch.expm1(-log_r))
        every = log_half(one).sum(0)  # (factor, place)
        logs.append(torch.logsumexp(every.flatten(), 0) - math.log(every.numel()))
        if float(every.max()) > best:
            best, at = float(every.max()), int(start[int(every.amax(0).argmax())])
            where = (at * block, (at + length) * block)
    return LevelScan(float(torch.logsumexp(torch.stack(logs), 0)) - math.log(len(logs)), *where)
