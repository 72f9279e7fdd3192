"""The local level of noise: a slow course of its variance."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

WINDOW = 257  # samples: of Gaussian noise their mean square is known to a tenth, bursts of tens of samples stay


def local_level(values: Tensor) -> Tensor:
    """Mean of clipped squares around each sample over that of all, `(..., time)`; at the ends of as many as there are.

    Squares are clipped at nine times the level found so far, so that an outlier is no level. Where the level is ten
    times the mean the first round follows half of it, the second nearly all.

    Args:
        values: White or nearly white noise, `(..., time)`.
    """
    squares = values.square().flatten(0, -2)
    half = min(WINDOW // 2, (squares.shape[-1] - 1) // 2)
    counts = _sums(torch.ones_like(squares[:1]), half)
    level = squares.mean(-1, keepdim=True).clamp(min=1e-300).expand_as(squares)
    for _ in range(3):
        level = (_sums(squares.minimum(9.0 * level), half) / counts).clamp(min=1e-300)
    return (level / level.mean(-1, keepdim=True)).view(values.shape)


def _sums(rows: Tensor, half: int) -> Tensor:
    """Sums of `(row, time)` around each sample, up to a factor."""
    return avg_pool1d(pad(rows[:, None], (half, half)), 2 * half + 1, stride=1)[:, 0]
