"""How long the blocks of a block bootstrap are, and whether a recording bears them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator

import torch
from torch import Tensor

from gyrofuse._base.checks import check_floating, check_positive_integer

# The choice of a length looks at so many means of consecutive entries at most, and leaves so many blocks.
_MOST_BINS = 2**8
_FEWEST_BLOCKS = 20


def default_block_length(series: Tensor) -> Tensor:
    """Block length from the correlation of the series: the rule of Politis and White, the longest of all rows.

    `l = (3 G^2 / (2 g^2))^(1/3) N^(1/3)` with `g = sum_k lambda_k r_k` and `G = sum_k lambda_k |k| r_k`, flat-top
    weights `lambda` and autocovariances `r`. At least `N^(1/3)`, the order that [Z] names, and at most `N / 20`, which
    leaves enough blocks to tell a variance. The rule looks at `sqrt(N)` lags, but products of wavelet coefficients
    stay weakly correlated over far more; so it is given means over bins, at most 256 of them. Blocks come out no
    shorter than about a bin, which costs little, and intervals hold better at large scales.

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
    """Means of consecutive entries of series `(..., time)`, at most 256 of them, float64."""
    n = series.shape[-1]
    width = _bin_width(n)
    return series.detach()[..., : n - n % width].unflatten(-1, (-1, width)).mean(-1, dtype=torch.float64)


def length_of_bins(binned: Tensor, n_entries: int) -> Tensor:
    """Block length `(...)` of series of `n_entries`, given their `bin_means`, `(..., row, bin)`."""
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
    """Times `M_J` that all levels share."""
    return n_samples - 2**n_levels + 1


def check_block_length(block_length: int, n_samples: int, n_levels: int | None = None) -> int:
    """Return a block length that fits what blocks are taken from: samples, or coefficients of `n_levels` levels.

    Raises:
        ValueError: Not a whole number from 1 to that.
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
    """Say so when trimming leaves too little of the recording."""
    columns = n_columns(n_samples, n_levels)
    if 3 * columns < n_samples:
        warnings.warn(
            f"the block bootstrap trims all levels to the {columns} coefficients that {n_samples} samples have at "
            f"level {n_levels}: its variances are about {2 * columns / n_samples:.2g} of the true ones; "
            "ask for fewer levels",
            stacklevel=stacklevel,
        )


def alike(lengths: Tensor) -> Iterator[tuple[int, Tensor | slice]]:
    """Each block length with the items that have it."""
    different = lengths.unique().tolist()
    for length in different:
        # A slice of all of them is no copy.
        yield length, slice(None) if len(different) == 1 else (lengths == length).nonzero().flatten()
