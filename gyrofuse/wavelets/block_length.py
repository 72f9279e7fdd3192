"""Blocks of a block bootstrap: their length, their sums over all starts, and whether a recording is long enough."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.checks import check_floating, check_positive_integer

# Number of bins at most, over whose means the rule for the block length takes autocovariances: it sums `sqrt(bins)`
# lags, and bins of `time / 256` entries let 16 of them reach the weak, long correlation of products of wavelet
# coefficients.
_MOST_BINS = 256
# Number of blocks that the longest block leaves: the variance between 20 blocks is known within about a third.
_FEWEST_BLOCKS = 20
# Number of starts whose block sums are taken at a time, as differences of one cumulative sum: so many entries stay in
# cache, and a sum no longer than that keeps its digits.
_STARTS_AT_ONCE = 32_768


def default_block_length(series: Tensor) -> Tensor:
    """Block length from the correlation of the series: the rule of Politis and White, the longest of all rows.

    `l = (3 G^2 / (2 g^2))^(1/3) N^(1/3)` with `g = sum_k lambda_k r_k` and `G = sum_k lambda_k |k| r_k`, flat-top
    weights `lambda` and autocovariances `r`. At least `N^(1/3)`, the order that [Z] names, and at most `N / 20`, which
    leaves enough blocks to estimate a variance. The rule sums `sqrt(N)` lags, but products of wavelet coefficients
    stay weakly correlated over far more; so the rule is applied to means over bins, at most 256 of them. Blocks are
    then no shorter than about a bin.

    Args:
        series: `(..., row, time)`, any unit.

    Returns:
        `(...)`, whole numbers.

    Raises:
        TypeError: `series` is not a floating point tensor.
        ValueError: Not `(..., row, time)`.

    References:
        Politis & White, Automatic block-length selection for the dependent bootstrap, Econometric Reviews 23, 2004,
        with the correction of Patton, Politis & White, Econometric Reviews 28, 2009.
    """
    check_floating("series", series)
    if series.ndim < 2 or series.shape[-1] == 0:
        raise ValueError(f"`series`: expected (..., row, time) with entries, got shape {tuple(series.shape)}")
    return length_of_bins(bin_means(series), series.shape[-1])


def bin_means(series: Tensor) -> Tensor:
    """Means of consecutive entries, at most 256 of them.

    Args:
        series: `(..., time)`.

    Returns:
        `(..., bin)`, float64.
    """
    n = series.shape[-1]
    width = _bin_width(n)
    return series.detach()[..., : n - n % width].unflatten(-1, (-1, width)).mean(-1, dtype=torch.float64)


def length_of_bins(binned: Tensor, n_entries: int) -> Tensor:
    """Block length from means over bins.

    Args:
        binned: `bin_means` of the series, `(..., row, bin)`.
        n_entries: Entries of the series.

    Returns:
        `(...)`, whole numbers.
    """
    shortest = math.ceil(n_entries ** (1 / 3))
    longest = max(n_entries // _FEWEST_BLOCKS, min(shortest, n_entries))
    optimum = _bin_width(n_entries) * _politis_white(binned).amax(-1)
    return optimum.clamp(shortest, longest).ceil().to(torch.int64)


def _bin_width(n_entries: int) -> int:
    return -(-n_entries // _MOST_BINS)


def _politis_white(series: Tensor) -> Tensor:
    """Best block length of each series `(..., time)`; 0 for a constant."""
    n = series.shape[-1]
    quiet = max(5, math.ceil(math.log10(n)))  # so many correlations in a row that are no more than noise
    n_lags = min(math.ceil(math.sqrt(n)) + 2 * quiet, n - 1)
    spectrum = torch.fft.rfft(series - series.mean(-1, keepdim=True), 2 * n).abs().square()
    r = torch.fft.irfft(spectrum, 2 * n)[..., : n_lags + 1] / n
    if n_lags < quiet:
        return torch.zeros_like(r[..., 0])
    noise = 2 * math.sqrt(math.log10(n) / n) * r[..., :1]
    ends = (r[..., 1:].abs() <= noise).unfold(-1, quiet, 1).all(-1)  # (..., m): quiet at lags m + 1 to m + quiet
    m = torch.where(ends.any(-1), ends.to(torch.int8).argmax(-1), n_lags).clamp(1, max(1, n_lags // 2))
    lag = torch.arange(1, n_lags + 1, dtype=series.dtype, device=series.device)
    flat_top = (2 - lag / m[..., None]).clamp(0, 1)  # lambda(k / 2m)
    level = r[..., 0] + 2 * (flat_top * r[..., 1:]).sum(-1)
    bend = 2 * (flat_top * lag * r[..., 1:]).sum(-1)
    return (1.5 * n * (bend / level).square()).pow(1 / 3).nan_to_num(nan=0.0)


def n_columns(n_samples: int, n_levels: int) -> int:
    """Number of times `M_J = T - 2**J + 1` at which all levels have a coefficient.

    Args:
        n_samples: Length T of the recording.
        n_levels: Number of levels J.
    """
    return n_samples - 2**n_levels + 1


def check_block_length(block_length: int, n_samples: int, n_levels: int | None = None) -> int:
    """Return a block length that is no longer than the recording.

    Args:
        block_length: Samples of a block, or coefficients of a block where `n_levels` is given.
        n_samples: Length of the recording.
        n_levels: Number of levels whose common coefficients the blocks are taken from.

    Raises:
        ValueError: Not a whole number from 1 to the number of samples or of common coefficients.
    """
    length = check_positive_integer("block_length", block_length)
    if n_levels is None:
        if length > n_samples:
            raise ValueError(
                f"`block_length`: expected at most {n_samples}, as many as the recording has samples, got {length}; "
                "give shorter blocks"
            )
    elif length > n_columns(n_samples, n_levels):
        # Fewer levels that hold a block, and of which the block bootstrap would not warn.
        fewer = [j for j in range(1, n_levels) if length <= n_columns(n_samples, j) >= n_samples / 3]
        remedy = f" or fewer levels, such as `n_levels={fewer[-1]}`" if fewer else ""
        raise ValueError(
            f"`block_length`: expected at most {n_columns(n_samples, n_levels)}, as many coefficients as "
            f"{n_samples} samples have at level {n_levels}, got {length}; give shorter blocks{remedy}"
        )
    return length


def warn_of_few_columns(n_samples: int, n_levels: int, *, stacklevel: int) -> None:
    """Warn when trimming to the times that all levels share leaves less than a third of the recording.

    Args:
        n_samples: Length of the recording.
        n_levels: Number of levels.
        stacklevel: Frames between this call and the line that the warning is for, plus 1.
    """
    columns = n_columns(n_samples, n_levels)
    if 3 * columns < n_samples:
        warnings.warn(
            f"the block bootstrap trims all levels to the {columns} coefficients that {n_samples} samples have at "
            f"level {n_levels}: its variances are about {2 * columns / n_samples:.2g} of the true ones; "
            "ask for fewer levels",
            stacklevel=stacklevel,
        )


def alike(lengths: Tensor) -> Iterator[tuple[int, Tensor | slice]]:
    """Items grouped by block length.

    Args:
        lengths: Block length of each item, `(item,)`.

    Yields:
        A block length, and the indices of the items that have it.
    """
    different = lengths.unique().tolist()
    for length in different:
        # A slice of all items is no copy.
        yield length, slice(None) if len(different) == 1 else (lengths == length).nonzero().flatten()


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
        """Take in the next entries.

        Args:
            series: `(..., row, entry)`, float64.
        """
        if series.shape[-1] == 0:
            return
        if self._carried is None:
            # Second moments about a value close to the mean keep their digits.
            self._centre = series.mean(-1, keepdim=True)
            self._carried = series[..., :0]
            self._sums = [series.new_zeros(series.shape[:-1]) for _ in range(2)]
            self._products = [series.new_zeros(*series.shape[:-1], series.shape[-2]) for _ in range(2)]
        # The carried entries and a chunk first, then chunks that overlap by the length of a block.
        chunk, held = max(_STARTS_AT_ONCE, 4 * self._length), self._carried.shape[-1]
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
    """Moments over all starts.

    Args:
        sums: `(..., row, start)`.

    Returns:
        Mean `(..., row)` and population covariance `(..., row, row)`.
    """
    mean = sums.mean(-1)
    centred = sums - mean[..., None]
    return mean, centred @ centred.mT / sums.shape[-1]
