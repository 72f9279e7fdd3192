"""The moving block bootstrap of the wavelet cross-covariance (WCCV), by drawing and in closed form.

[Z] Algorithm 1: all levels are trimmed to the `M_J` times that the last one has; blocks of `l` times, the same for all
sensors and levels, are drawn with replacement, the last one cut to fit; each level is completed by one stretch of
`D_j = M_j - M_J` consecutive coefficients. A resampled moment is the mean of the products drawn. The mean and the
covariance of such sums over all draws, what endless resamples give, are known without drawing.

**Where it is wrong.** A block keeps correlation up to lag `l`, and products of coefficients are correlated up to lag
`tau_j = 2**j`: at levels with `tau_j` far above `l` the variance is too small. Trimming makes it smaller still: where
the last level has fewer than half of the `T` samples the variance is too small at *all* levels, by about `2 M_J / T`,
and that of the last levels themselves says nothing. The intervals of `fit_svo(covariance="model")` have neither flaw.

Missing samples: blocks bring their gaps along, and a resampled moment is the mean of the products that it has; in
closed form, to first order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.checks import (
    check_confidence_level,
    check_n_levels,
    check_positive_integer,
    check_signal,
    own_generator,
)
from gyrofuse._base.results import ConfidenceInterval
from gyrofuse.wavelets.block_length import (
    BlockSums,
    alike,
    check_block_length,
    default_block_length,
    moments_over_starts,
    n_columns,
    warn_of_few_columns,
)
from gyrofuse.wavelets.covariance import wavelet_products
from gyrofuse.wavelets.haar import coefficients_by_level

# Numbers of float64 held at a time, be they products of coefficients, sums looked up or resampled signals: 16 MiB, more
# than the cache and little beside a recording.
_AT_ONCE = 2_097_152


def block_bootstrap(
    signal: Tensor,
    n_levels: int | None = None,
    *,
    block_length: int | None = None,
    n_resamples: int = 100,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Resample the wavelet cross-covariance by blocks of wavelet coefficients, [Z] Algorithm 1.

    Too narrow at levels with `tau_j` far above the block length, and at all levels when the last level has few
    coefficients; see the module.
    Block sums are differences of cumulative sums of centred products, right to about 1e-10. Memory: a few
    times that of the signal.

    Args:
        signal: `(..., sensor, time)`, any unit; NaN = missing sample.
        n_levels: Number of levels J; the largest with `2**J <= time` by default, which may keep few coefficients.
        block_length: Coefficients `l` of a block, at most `time - 2**J + 1`; by default `default_block_length` of the
            squared coefficients, the largest of all levels.
        n_resamples: Number of resamples H.
        generator: Source of randomness; by default a fresh one. All items of a batch share the starts drawn.

    Returns:
        `(..., resample, level, sensor, sensor)`, unit of the signal squared; NaN where a resample has no product.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Wrong shape, or a number of levels, blocks or resamples that does not fit.

    References:
        [Z] section IV, Algorithm 1.
    """
    values, n_levels = _checked(signal, n_levels)
    n_resamples = check_positive_integer("n_resamples", n_resamples)
    columns = n_columns(signal.shape[-1], n_levels)
    seed = _seed(generator)
    out = values.new_empty(len(values), n_resamples, n_levels, values.shape[1], values.shape[1])
    for length, items in alike(_lengths_for_coefficients(values, n_levels, block_length)):
        starts, completions = (x.to(signal.device) for x in draw_starts(seed, n_resamples, n_levels, columns, length))
        for level, some_products in enumerate(_products_by_level(values[items], n_levels)):
            moments = []
            for products in some_products:
                draws = columns, length, starts, completions[:, level]
                sums, counts = _resampled_sums(products.centred, *draws), products.counts
                if products.known is not None:
                    counts = _resampled_sums(products.known, *draws)
                moments.append(products.means + sums / counts)  # (item, pair, resample)
            out[items, :, level] = _squared(torch.cat(moments, dim=-2).mT).to(out.dtype)
    return out.view(*signal.shape[:-2], *out.shape[1:])


def signal_bootstrap(
    signal: Tensor,
    n_levels: int | None = None,
    *,
    block_length: int | None = None,
    n_resamples: int = 100,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Resample the wavelet cross-covariance by blocks of the signals themselves.

    For jointly stationary signals only: where a signal wanders (random walk, drift) the blocks meet in jumps that it
    does not have. Even then every window across a seam is no window of the recording, so that at scales beyond the
    blocks the resamples are biased and not only too narrow. Costs one wavelet cross-covariance for every resample.

    Args:
        signal: `(..., sensor, time)`, any unit; NaN = missing sample.
        n_levels: Number of levels J; the largest with `2**J <= time` by default.
        block_length: Samples of a block, at most `time`; by default as for `block_bootstrap`.
        n_resamples: Number of resamples H.
        generator: Source of randomness; by default a fresh one. All items of a batch share the starts drawn.

    Returns:
        `(..., resample, level, sensor, sensor)`, unit of the signal squared; NaN where a resample has no product.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Wrong shape, or a number of levels, blocks or resamples that does not fit.

    References:
        [Z] section IV, Remark C.
    """
    values, n_levels = _checked(signal, n_levels)
    n_resamples = check_positive_integer("n_resamples", n_resamples)
    n_samples = signal.shape[-1]
    seed = _seed(generator)
    out = values.new_empty(len(values), n_resamples, n_levels, values.shape[1], values.shape[1])
    lengths = _lengths(values, n_levels, n_samples, block_length)
    for length, items in alike(lengths):
        starts, _ = draw_starts(seed, n_resamples, n_levels, n_samples, length)
        some = values[items]
        at_once = max(1, _AT_ONCE // some.numel())
        for first in range(0, n_resamples, at_once):
            which = starts[first : first + at_once, :, None] + torch.arange(length)  # (resample, block, time)
            times = which.flatten(1)[:, :n_samples].to(signal.device)
            sums, counts = wavelet_products(some[..., times].movedim(1, 2), n_levels)
            out[items, first : first + at_once] = (sums / counts).to(out.dtype)
    return out.view(*signal.shape[:-2], *out.shape[1:])


def bootstrap_wccv_covariance(
    signal: Tensor, n_levels: int | None = None, *, block_length: int | None = None
) -> Tensor:
    """Covariance of the entries of the wavelet cross-covariance: `block_bootstrap` for endless resamples.

    `V* / T` of [Z] (his `V*` is `T` times the covariance). For small arrays and few levels: memory is a few times
    `time * level * sensor * (sensor + 1) / 2` numbers. Too small at levels with `tau_j` far above the block length, and
    at all levels when the last level has few coefficients; see the module.

    Args:
        signal: `(..., sensor, time)`, any unit; NaN = missing sample.
        n_levels: Number of levels J; the largest with `2**J <= time` by default, which may keep few coefficients.
        block_length: As for `block_bootstrap`.

    Returns:
        `(..., level, sensor, sensor, level, sensor, sensor)`, unit of the signal to the fourth.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Wrong shape, or a number of levels or a block length that does not fit.

    References:
        [Z] section IV, Algorithm 1 and Corollary 1.
    """
    values, n_levels = _checked(signal, n_levels)
    n_sensors = values.shape[1]
    shape = (n_levels, n_sensors, n_sensors)
    out = values.new_empty(len(values), *shape, *shape)
    for length, items in alike(_lengths_for_coefficients(values, n_levels, block_length)):
        influences = [
            torch.cat([products.influences for products in level], dim=-2)
            for level in _products_by_level(values[items], n_levels)
        ]
        covariance = closed_form(influences, n_columns(signal.shape[-1], n_levels), length)
        rows = covariance.unflatten(-1, (n_levels, -1)).unflatten(1, (n_levels, -1))  # (item, level, pair) twice
        out[items] = _squared(_squared(rows).movedim(2, -1)).movedim((-2, -1), (2, 3)).to(out.dtype)
    return out.view(*signal.shape[:-2], *shape, *shape)


def bootstrap_wccv_interval(
    signal: Tensor,
    n_levels: int | None = None,
    *,
    confidence_level: float = 0.95,
    block_length: int | None = None,
) -> ConfidenceInterval:
    """Interval of each entry of the wavelet cross-covariance, by the normal law and `block_bootstrap`'s limit.

    Too narrow at levels with `tau_j` far above the block length, and at all levels when the last level has few
    coefficients; see the module.
    The normal law is poor where a level holds few independent coefficients; limits of a variance may be negative.
    For variances alone, give each sensor as an array of one, `signal.unsqueeze(-2)`.

    Args:
        signal: `(..., sensor, time)`, any unit; NaN = missing sample.
        n_levels: Number of levels J; the largest with `2**J <= time` by default, which may keep few coefficients.
        confidence_level: Probability that an interval holds the true value, were the law right.
        block_length: As for `block_bootstrap`.

    Returns:
        Limits `(..., level, sensor, sensor)`, unit of the signal squared.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Wrong shape, or a number of levels or a block length that does not fit.

    References:
        [Z] section IV, Corollary 2.
    """
    check_confidence_level(confidence_level)
    values, n_levels = _checked(signal, n_levels)
    columns = n_columns(signal.shape[-1], n_levels)
    quantile = torch.special.ndtri(torch.tensor((1 + confidence_level) / 2, dtype=torch.float64)).item()
    limits = values.new_empty(2, len(values), n_levels, values.shape[1], values.shape[1])
    for length, items in alike(_lengths_for_coefficients(values, n_levels, block_length)):
        for level, some_products in enumerate(_products_by_level(values[items], n_levels)):
            means, variances = [], []
            for products in some_products:
                covariance = closed_form([products.influences], columns, length)
                variances.append(covariance.diagonal(dim1=-2, dim2=-1))  # (item, pair)
                means.append(products.means.squeeze(-1))
            mean, half = torch.cat(means, dim=-1), quantile * torch.cat(variances, dim=-1).clamp(min=0).sqrt()
            limits[0, items, level] = _squared(mean - half).to(limits.dtype)
            limits[1, items, level] = _squared(mean + half).to(limits.dtype)
    low, high = limits.view(2, *signal.shape[:-2], *limits.shape[2:])
    return ConfidenceInterval(low, high)


def draw_starts(seed: int, n_resamples: int, n_levels: int, columns: int, length: int) -> tuple[Tensor, Tensor]:
    """Draw where blocks start.

    Args:
        seed: Of the draw.
        n_resamples: Number of resamples H.
        n_levels: Number of levels J.
        columns: Times that all levels share.
        length: Length of a block.

    Returns:
        Starts of the blocks `(resample, block)` and of the completing stretches `(resample, level)`.
    """
    generator = torch.Generator().manual_seed(seed)
    n_blocks = -(-columns // length)
    starts = torch.randint(columns - length + 1, (n_resamples, n_blocks), generator=generator)
    return starts, torch.randint(columns + 1, (n_resamples, n_levels), generator=generator)


def closed_form(influences: list[Tensor], columns: int, length: int) -> Tensor:
    """Second moment about the estimate of resampled sums of influences, over all draws.

    Args:
        influences: `(item, row, M_j)` of each level, which sum to 0 over all times; every level has its own rows.
        columns: Times that all levels share.
        length: Length of a block.

    Returns:
        `(item, row, row)`, rows of all levels in order.
    """
    blocks = BlockSums(length, columns)
    blocks.update(torch.cat([u[..., :columns] for u in influences], dim=-2))
    mean, covariance = blocks.moments()
    row = 0
    for u in influences:
        rows = slice(row, row + u.shape[-2])
        extra_mean, extra_covariance = moments_over_starts(_stretches(u, u.shape[-1] - columns))
        mean[..., rows] += extra_mean
        covariance[..., rows, rows] += extra_covariance
        row = rows.stop
    return covariance + mean[..., :, None] * mean[..., None, :]


class _Products(NamedTuple):
    """Products of the coefficients of one level for some pairs `i <= k` of sensors.

    Attributes:
        centred: `(item, pair, time)`, products less their mean, 0 where missing.
        means: `(item, pair, 1)`.
        counts: `(item, pair, 1)`, products that exist.
        known: `(item, pair, time)`, 1 where a product exists, or None where all do.
    """

    centred: Tensor
    means: Tensor
    counts: Tensor
    known: Tensor | None

    @property
    def influences(self) -> Tensor:
        """Of each time on the mean product."""
        return self.centred / self.counts


def _products_by_level(values: Tensor, n_levels: int) -> Iterator[Iterator[_Products]]:
    """Products of each level in turn, some pairs at a time, of signals `(item, sensor, time)`."""
    pairs = torch.triu_indices(values.shape[1], values.shape[1], device=values.device)
    at_once = max(1, _AT_ONCE // (len(values) * values.shape[-1]))
    for w in coefficients_by_level(values.double(), n_levels):
        yield (_products(w, *some) for some in pairs.split(at_once, dim=-1))


def _products(w: Tensor, first: Tensor, second: Tensor) -> _Products:
    products = w[:, first] * w[:, second]
    if bool(products.sum().isfinite()):
        means = products.mean(-1, keepdim=True)
        return _Products(products.sub_(means), means, torch.full_like(means, w.shape[-1]), None)
    exist = products.isfinite()
    counts = exist.sum(-1, keepdim=True, dtype=torch.float64)
    means = torch.where(exist, products, 0.0).sum(-1, keepdim=True) / counts
    return _Products(torch.where(exist, products - means, 0.0), means, counts, exist.to(torch.float64))


def _stretches(series: Tensor, length: int) -> Tensor:
    """Sums of `length` consecutive entries from every start, `(..., time - length + 1)`."""
    total = pad(series.cumsum(-1), (1, 0))
    return total[..., length:] - total[..., : total.shape[-1] - length]


def _resampled_sums(series: Tensor, columns: int, length: int, starts: Tensor, completions: Tensor) -> Tensor:
    """Sums over the entries `(item, pair, time)` of each resample, `(item, pair, resample)`."""
    total = pad(series.cumsum(-1), (1, 0))
    n_whole, rest = divmod(columns, length)
    missing = series.shape[-1] - columns
    ends = torch.full_like(starts, length)
    ends[:, n_whole:] = rest  # the last block is cut to fit
    at_once = max(1, _AT_ONCE // (series.shape[0] * series.shape[1] * starts.shape[1]))
    sums = [
        (total[..., to] - total[..., since]).sum(-1)
        for since, to in zip(starts.split(at_once), (starts + ends).split(at_once), strict=True)
    ]
    return torch.cat(sums, dim=-1) + total[..., completions + missing] - total[..., completions]


def _squared(pairs: Tensor) -> Tensor:
    """Entries of the pairs `i <= k` along the last dimension as symmetric matrices `(..., sensor, sensor)`."""
    n_sensors = (math.isqrt(8 * pairs.shape[-1] + 1) - 1) // 2
    first, second = torch.triu_indices(n_sensors, n_sensors, device=pairs.device)
    where = torch.empty(n_sensors, n_sensors, dtype=torch.int64, device=pairs.device)
    where[first, second] = where[second, first] = torch.arange(pairs.shape[-1], device=pairs.device)
    return pairs[..., where]


def _checked(signal: Tensor, n_levels: int | None) -> tuple[Tensor, int]:
    check_signal("signal", signal)
    return signal.detach().reshape(-1, *signal.shape[-2:]), check_n_levels(n_levels, signal.shape[-1])


def _lengths_for_coefficients(values: Tensor, n_levels: int, block_length: int | None) -> Tensor:
    """Block length of each item for blocks of coefficients, no longer than the times that all levels share."""
    warn_of_few_columns(values.shape[-1], n_levels, stacklevel=4)
    if block_length is not None:
        return torch.full((len(values),), check_block_length(block_length, values.shape[-1], n_levels))
    return _lengths(values, n_levels, n_columns(values.shape[-1], n_levels), None)


def _lengths(values: Tensor, n_levels: int, n_entries: int, block_length: int | None) -> Tensor:
    """Block length of each item, by default the longest that the squared coefficients of any level need."""
    if block_length is not None:
        return torch.full((len(values),), check_block_length(block_length, n_entries))
    longest = torch.ones(len(values), dtype=torch.int64)
    for w in coefficients_by_level(values.double(), n_levels):
        power = w.square().nan_to_num_(nan=0.0)
        relative = (power / power.mean(-1, keepdim=True)).nan_to_num_(nan=0.0)  # (item, sensor, time)
        series = relative.sum(-2, keepdim=True)[..., :n_entries]
        longest = longest.maximum(default_block_length(series).cpu())
    return longest


def _seed(generator: torch.Generator | None) -> int:
    """One draw from the generator of the caller, from which all others follow on any device."""
    generator = own_generator(generator, None)
    return int(torch.randint(2**62, (), generator=generator, device=generator.device))
