"""Sums of consecutive entries of a series: their mean and covariance over all places to start."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

# Starts taken at a time: the cumulative sums of so many stay in cache and keep their digits.
_CHUNK = 2**15


class BlockSums:
    """Mean and covariance of a series rebuilt from blocks that are drawn with replacement.

    The series of `n` entries becomes `n // length` blocks of `length` and, for what is left, the beginning of one more;
    all starts `0..n - length` are equally likely, also for the last block.

    Args:
        length: Entries of a block, at most `n_entries`.
        n_entries: How many entries the whole series has.
    """

    def __init__(self, length: int, n_entries: int) -> None:
        self._length = length
        self._n_blocks, self._rest = divmod(n_entries, length)
        self._n_starts = 0
        self._carried: Tensor | None = None

    def update(self, series: Tensor) -> None:
        """Take in the next entries, `(..., row, entry)`, float64."""
        if series.shape[-1] == 0:
            return
        if self._carried is None:
            # Second moments about a value close to the mean keep their digits.
            self._centre = series.mean(-1, keepdim=True)
            self._carried = series[..., :0]
            self._sums = [series.new_zeros(series.shape[:-1]) for _ in range(2)]
            self._products = [series.new_zeros(*series.shape[:-1], series.shape[-2]) for _ in range(2)]
        # Those carried and a chunk first, the rest in chunks that overlap by the length of a block.
        chunk, held = max(_CHUNK, 4 * self._length), self._carried.shape[-1]
        self._add(torch.cat([self._carried, series[..., :chunk]], dim=-1))
        for first in range(max(0, chunk - self._length + 1), series.shape[-1] - self._length + 1, chunk):
            self._add(series[..., first : first + chunk + self._length - 1])
        kept = min(self._length - 1, held + series.shape[-1])
        self._carried = torch.cat([self._carried, series[..., -self._length :]], dim=-1)
        self._carried = self._carried[..., self._carried.shape[-1] - kept :].clone()

    def _add(self, part: Tensor) -> None:
        """Take in all starts whose block lies within a part."""
        n_starts = part.shape[-1] - self._length + 1
        if n_starts <= 0:
            return
        total = torch.sub(part, self._centre).cumsum_(-1)
        total = pad(total, (1, 0))
        for i, length in enumerate((self._length, self._rest)):
            if length:
                block = total[..., length : length + n_starts] - total[..., :n_starts]  # (..., row, start)
                self._sums[i] += block.sum(-1)
                self._products[i] += block @ block.mT
        self._n_starts += n_starts

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean `(..., row)` and covariance `(..., row, row)` of the sum of the rebuilt series."""
        means = [sums / self._n_starts for sums in self._sums]
        covariances = [
            products / self._n_starts - mean[..., :, None] * mean[..., None, :]
            for products, mean in zip(self._products, means, strict=True)
        ]
        n_entries = self._n_blocks * self._length + self._rest
        mean = self._n_blocks * means[0] + means[1] + n_entries * self._centre.squeeze(-1)
        return mean, self._n_blocks * covariances[0] + covariances[1]


def moments_over_starts(sums: Tensor) -> tuple[Tensor, Tensor]:
    """Mean `(..., row)` and population covariance `(..., row, row)` of sums `(..., row, start)`."""
    mean = sums.mean(-1)
    centred = sums - mean[..., None]
    return mean, centred @ centred.mT / sums.shape[-1]
