"""The local level of noise: a slow course of its variance."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

WINDOW = 257  # samples: of Gaussian noise their mean square is known to a tenth, bursts of tens of samples stay


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
