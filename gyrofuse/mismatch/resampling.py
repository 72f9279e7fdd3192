"""Signals at other times than they were sampled."""

from __future__ import annotations

import torch
from torch import Tensor

_HALF = 32  # taps on either side
_BETA = 6.0  # of the Kaiser window


def resampled(signal: Tensor, times: Tensor) -> Tensor:
    """Signals `(..., time)` at `times` `(time,)` in samples, by windowed sincs; beyond their ends they are mirrored.

    At whole samples these are the samples themselves.
    """
    n = signal.shape[-1]
    whole = times.floor()
    part = times - whole
    whole = whole.long()
    total = torch.zeros(*signal.shape[:-1], len(times), dtype=torch.float64)
    edge = torch.i0(torch.tensor(_BETA, dtype=torch.float64))
    for tap in range(-_HALF + 1, _HALF + 1):
        apart = part - tap
        window = torch.i0(_BETA * (1 - (apart / _HALF).square()).clamp(min=0).sqrt()) / edge
        total += signal[..., _mirrored(whole + tap, n)] * (torch.sinc(apart) * window)
    return total


def _mirrored(index: Tensor, n: int) -> Tensor:
    """Indices beyond the ends, as if in a mirror."""
    index = index.remainder(2 * n)
    return torch.where(index < n, index, 2 * n - 1 - index)
