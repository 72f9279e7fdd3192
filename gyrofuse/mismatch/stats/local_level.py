"""The local level of noise: what a slow course of its variance leaves of it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

WINDOW = 257  # samples: of Gaussian noise their mean square is known to a tenth, bursts of tens of samples stay
_CUT = 9.0  # of the level found so far: an outlier is no level
_ROUNDS = 3  # where the level is ten times the mean the first one sees half of it, the second nearly all


def local_level(values: Tensor) -> Tensor:
    """Mean of clipped squares around each sample over that of all, `(..., time)`; at the ends of as many as there are.

    Args:
        values: White or nearly white noise `(..., time)`.
    """
    squares = values.square().flatten(0, -2)
    level = squares.mean(-1, keepdim=True).clamp(min=1e-300).expand_as(squares)
    for _ in range(_ROUNDS):
        level = _smooth(squares.minimum(_CUT * level)).clamp(min=1e-300)
    return (level / level.mean(-1, keepdim=True)).view(values.shape)


def _smooth(rows: Tensor) -> Tensor:
    """Means of `(row, time)` around each sample."""
    half = min(WINDOW // 2, (rows.shape[-1] - 1) // 2)
    sums, counts = (
        avg_pool1d(pad(v[:, None], (half, half)), 2 * half + 1, stride=1)[:, 0]
        for v in (rows, torch.ones_like(rows[:1]))
    )
    return sums / counts
