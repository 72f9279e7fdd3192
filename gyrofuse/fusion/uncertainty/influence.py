"""Covariance of estimated weights by the moving block bootstrap, in closed form: its limit for endless resamples.

To first order a resampled weight vector is a sum of influences `u_{j,t}` over the times drawn, so its covariance over
all draws is known without drawing. With `h_t = sum_j u_{j,t}` at the `M_J` times that all levels share, `S` the sums of
`l` consecutive `h`, `R` those of the last, cut block from the same starts, and `E_j` the sums of the `D_j = M_j - M_J`
consecutive `u_{j,t}` that complete level `j`,

    Cov* = floor(M_J / l) cov(S) + cov(R) + sum_j cov(E_j) + bias bias'

with `cov` over all starts, and `bias` from the mean over all draws to the estimate, at which [Z] centres. For the SVO
weights and `B = (I - c 1') A^-1`

    u_{j,t} = -omega_j B W_{j,t} (W_{j,t}' c) / M_j

are products of the coefficients of the signals `B x` and of the virtual signal `c' x`: one pass over the data.

**Where it is wrong**: at large scales, as all of this bootstrap (`gyrofuse.wavelets.block_bootstrap`). It is of first
order, as (8) of [Z] is: where a sensor's noise comes in a few bursts, weights fitted to the resamples of
`block_bootstrap` vary more.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gyrofuse._base.checks import check_floating, check_n_levels, check_positive_integer, check_signal
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse.fusion.uncertainty.sweep import Statistic, Sweeps, joined
from gyrofuse.fusion.weights.svo import ScaleWeights, influence_matrix, resolve_scale_weights
from gyrofuse.wavelets.block_length import (
    BlockSums,
    alike,
    bin_means,
    check_block_length,
    length_of_bins,
    n_columns,
    warn_of_few_columns,
)
from gyrofuse.wavelets.covariance import wavelet_products
from gyrofuse.wavelets.moments import combined_covariance, filter_lengths

# Samples of all sensors in short recordings that are swept together (2**19): 4 MiB, which stay in cache.
_GROUP = 524_288
# Number of the longest windows in a stretch that is swept at a time: a stretch looks ahead by one of them, an eighth.
_WINDOWS = 8


def bootstrap_weights_covariance(
    signal: Tensor,
    wccv: Tensor,
    scale_weights: ScaleWeights,
    weights: Tensor,
    *,
    counts: Tensor | None = None,
    block_length: int | None = None,
) -> Tensor:
    """Covariance of estimated SVO weights by the moving block bootstrap in closed form.

    `Sigma* / T` of [Z] for endless resamples, in one pass over the data. In recordings of 2**14 samples or more,
    stretches that complete a level start at every 2nd, 4th, ... time. Memory: about twice that of the signal.

    Too small where scales far beyond the blocks dominate, and for all scale weights when the last level has few
    coefficients; see the module and `gyrofuse.wavelets.block_bootstrap`.

    Args:
        signal: `(..., sensor, time)`, that gave the weights; NaN = missing sample.
        wccv: `(..., level, sensor, sensor)` of the signal.
        scale_weights: As for `fit_svo`.
        weights: `(..., sensor)`, the SVO weights of these.
        counts: `(..., level, sensor, sensor)`, products in each entry of `wccv`, to save counting them where samples
            are missing.
        block_length: Coefficients `l` of a block; by default `default_block_length` of `h_t`.

    Returns:
        `(..., sensor, sensor)`, covariance of the weights themselves (already divided by the sample size).

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Shapes do not agree, or a block length that does not fit.

    References:
        [Z] section IV, Algorithm 1 and equation (8).
    """
    return _weights_covariance(_svo, signal, wccv, scale_weights, weights, counts, block_length)


def bootstrap_inverse_variance_weights_covariance(
    signal: Tensor,
    wccv: Tensor,
    scale_weights: ScaleWeights,
    weights: Tensor,
    *,
    counts: Tensor | None = None,
    block_length: int | None = None,
) -> Tensor:
    """Covariance of estimated inverse-variance weights by the moving block bootstrap in closed form.

    By `dc_i = -c_i (dA_ii / A_ii - sum_k c_k dA_kk / A_kk)`. Wrong where `bootstrap_weights_covariance` is.

    Args:
        signal: `(..., sensor, time)`, that gave the weights; NaN = missing sample.
        wccv: `(..., level, sensor, sensor)` of the signal.
        scale_weights: As for `fit_svo`.
        weights: `(..., sensor)`, the inverse-variance weights of these.
        counts: As for `bootstrap_weights_covariance`.
        block_length: As for `bootstrap_weights_covariance`.

    Returns:
        `(..., sensor, sensor)`, covariance of the weights themselves.

    Raises:
        TypeError, ValueError: As `bootstrap_weights_covariance`.
    """
    return _weights_covariance(_inverse_variance, signal, wccv, scale_weights, weights, counts, block_length)


class BootstrapWeightsCovariance:
    """`bootstrap_weights_covariance` of a recording that comes in chunks, for weights known beforehand.

    The moments and weights come from a first pass over the recording, whose length has to be known, as the number of
    blocks follows from it. Holds a few times `2**n_levels` samples. As wrong at large scales as the function.

    Args:
        wccv: `(..., level, sensor, sensor)`.
        scale_weights: As for `fit_svo`.
        weights: `(..., sensor)`, the SVO weights of these.
        n_samples: Length T of the recording.
        block_length: Coefficients `l` of a block.
        counts: `(..., level, sensor, sensor)`, products in each entry of `wccv`; needed where samples are missing.

    Raises:
        ValueError: Shapes do not agree, or a block length that does not fit.

    Example:
        >>> covariance = BootstrapWeightsCovariance(wccv, "short", weights, n_samples=10**9, block_length=1000)
        >>> for chunk in chunks:  # each (..., sensor, time)
        ...     covariance.update(chunk)
        >>> weights_cov = covariance.compute()  # (..., sensor, sensor)
    """

    def __init__(
        self,
        wccv: Tensor,
        scale_weights: ScaleWeights,
        weights: Tensor,
        *,
        n_samples: int,
        block_length: int,
        counts: Tensor | None = None,
    ) -> None:
        n_samples = check_positive_integer("n_samples", n_samples)
        omega = _checked_levels(wccv, scale_weights, weights, counts, n_samples)
        length = check_block_length(block_length, n_samples, len(omega))
        warn_of_few_columns(n_samples, len(omega), stacklevel=3)
        _check_combined(wccv, omega)
        self._shape, self._dtype = weights.shape, weights.dtype
        self._n_samples, self._n_seen = n_samples, 0
        self._complete = counts is None
        statistic = _svo(*_items(wccv, weights, counts), omega, n_samples)
        self._n_items = len(statistic.estimate)
        self._sweeps = Sweeps(statistic, n_samples, windows=1)
        self._blocks = BlockSums(length, n_columns(n_samples, len(omega)))

    def update(self, chunk: Tensor) -> None:
        """Take in the next chunk.

        Args:
            chunk: `(..., sensor, time)`, right after the previous chunk; non-finite samples are missing.

        Raises:
            TypeError: `chunk` is not a floating point tensor.
            ValueError: Another shape than the weights, more samples than were announced, or samples that are missing
                where none were counted.
        """
        check_signal("chunk", chunk)
        if chunk.shape[:-1] != self._shape:
            raise ValueError(
                f"`chunk`: expected (..., sensor, time) for weights of shape {tuple(self._shape)}, "
                f"got shape {tuple(chunk.shape)}"
            )
        if self._n_seen + chunk.shape[-1] > self._n_samples:
            raise ValueError(
                f"`chunk`: expected {self._n_samples} samples in all, got {self._n_seen + chunk.shape[-1]}; "
                "give `n_samples` the length of the recording"
            )
        if self._complete and not bool(chunk.sum().isfinite()):
            raise ValueError("`chunk`: expected finite samples, got missing ones; give the `counts` of the first pass")
        self._n_seen += chunk.shape[-1]
        # A copy, for the caller may use the memory again.
        for series in self._sweeps.update(chunk.detach().reshape(self._n_items, *chunk.shape[-2:]).clone()):
            self._blocks.update(series)

    def compute(self) -> Tensor:
        """Return the covariance of the weights, `(..., sensor, sensor)`.

        Raises:
            RuntimeError: The recording has not come to its end.
        """
        if self._n_seen < self._n_samples:
            raise RuntimeError(
                f"expected {self._n_samples} samples before `compute`, got {self._n_seen}; update with the rest"
            )
        covariance = self._sweeps.covariance(*self._blocks.moments())
        return covariance.view(*self._shape, -1).to(self._dtype)


def _svo(wccv: Tensor, weights: Tensor, counts: Tensor | None, omega: Tensor, n_samples: int) -> Statistic:
    """SVO weights: influences `-omega_j B W (W' c) / M_j`; with missing samples, on the means of known products."""
    used = torch.where(omega[:, None, None] > 0, wccv, 0.0)
    combined = combined_covariance(wccv, omega)
    minus = -influence_matrix(combined, weights)  # -B
    # The last weight is 1 less the others.
    minus, unit = minus[:, :-1], torch.eye(weights.shape[1] - 1, dtype=torch.float64, device=omega.device)
    jacobian = torch.cat([unit, -torch.ones_like(unit[:1])]) if len(unit) else unit.new_zeros(1, 0)
    layout = jacobian.expand(len(wccv), -1, -1), tuple(omega.nonzero().flatten().tolist()), len(omega)
    size = omega / filter_lengths(len(omega)).to(omega).square()
    if counts is None:
        factor = (size / _n_coefficients(omega, n_samples)).tolist()

        def influence(d: Tensor, level: int, series: Tensor) -> None:
            series.addcmul_(d[:, :-1], d[:, -1:], value=factor[level])

        estimate = torch.einsum("nik,nkl,nl->ni", minus, combined, weights)
        return Statistic(torch.cat([minus, weights[:, None, :]], dim=1), influence, estimate, *layout)

    share = weights[:, None, None, :] / counts  # c_k / count_ik: (item, level, sensor i, sensor k)
    products, means = size[:, None, None] * share, omega[:, None, None] * share * used

    def influence_with_gaps(d: Tensor, level: int, series: Tensor) -> None:
        flat = d.flatten(2)
        known = flat.isfinite()
        filled, exists = torch.where(known, flat, 0.0), known.to(flat.dtype)
        u = filled * (products[:, level] @ filled) - exists * (means[:, level] @ exists)
        series += (minus @ u).view(series.shape)

    return Statistic(None, influence_with_gaps, torch.zeros_like(minus[..., 0]), *layout)


def _inverse_variance(wccv: Tensor, weights: Tensor, counts: Tensor | None, omega: Tensor, n_samples: int) -> Statistic:
    """Weights `c_i ~ 1 / A_ii`: influences on `A_ii = sum_j omega_j gamma_ii,j`, and the derivative of the weights."""
    variance = torch.where(omega[:, None] > 0, wccv.diagonal(dim1=-2, dim2=-1), 0.0)  # (item, level, sensor)
    combined = torch.einsum("j,nji->ni", omega, variance)
    jacobian = (weights[:, :, None] * weights[:, None, :] - torch.diag_embed(weights)) / combined[:, None, :]
    layout = jacobian, tuple(omega.nonzero().flatten().tolist()), len(omega)
    size = omega / filter_lengths(len(omega)).to(omega).square()
    if counts is None:
        factor = (size / _n_coefficients(omega, n_samples)).tolist()

        def influence(d: Tensor, level: int, series: Tensor) -> None:
            series.addcmul_(d, d, value=factor[level])

        return Statistic(None, influence, combined, *layout)

    share = counts.diagonal(dim1=-2, dim2=-1).reciprocal()
    squares, means = size[:, None] * share, omega[:, None] * share * variance

    def influence_with_gaps(d: Tensor, level: int, series: Tensor) -> None:
        flat = d.flatten(2)
        u = flat.square() * squares[:, level, :, None] - means[:, level, :, None]
        series += torch.where(flat.isfinite(), u, 0.0).view(series.shape)

    return Statistic(None, influence_with_gaps, torch.zeros_like(combined), *layout)


def _n_coefficients(omega: Tensor, n_samples: int) -> Tensor:
    """Coefficients `M_j` of each level of a recording without gaps, `(level,)`."""
    return n_samples + 1 - filter_lengths(len(omega)).to(omega)


def _weights_covariance(
    statistic_of: Callable[..., Statistic],
    signal: Tensor,
    wccv: Tensor,
    scale_weights: ScaleWeights,
    weights: Tensor,
    counts: Tensor | None,
    block_length: int | None,
) -> Tensor:
    check_signal("signal", signal)
    n_samples = signal.shape[-1]
    omega = _checked_levels(wccv, scale_weights, weights, counts, n_samples)
    if signal.shape[:-1] != weights.shape:
        raise ValueError(
            f"`signal`: expected (..., sensor, time) for weights of shape {tuple(weights.shape)}, "
            f"got shape {tuple(signal.shape)}"
        )
    if statistic_of is _svo:
        _check_combined(wccv, omega)
    given = None if block_length is None else check_block_length(block_length, n_samples, len(omega))
    warn_of_few_columns(n_samples, len(omega), stacklevel=4)
    values = signal.detach().reshape(-1, *signal.shape[-2:])
    if counts is None and not bool(values.sum().isfinite()):
        counts = wavelet_products(values, len(omega))[1].view(wccv.shape)
    elif counts is not None and bool((counts.movedim(-3, -1) == _n_coefficients(omega, n_samples)).all()):
        counts = None  # nothing is missing
    moments, fixed, counted = _items(wccv, weights, counts)
    group = max(1, _GROUP // (n_samples * values.shape[1]))
    parts = []
    for first in range(0, len(values), group):
        some = slice(first, first + group)
        some_counts = None if counted is None else counted[some]
        statistic = statistic_of(moments[some], fixed[some], some_counts, omega, n_samples)
        sweeps = Sweeps(statistic, n_samples, windows=_WINDOWS)
        series = joined(list(sweeps.update(values[some])))  # (item, out, time)
        if given is None:
            lengths = length_of_bins(statistic.jacobian @ bin_means(series), series.shape[-1])
        else:
            lengths = torch.full((len(series),), given)
        mean = torch.empty_like(statistic.estimate)
        covariance = mean.new_empty(*mean.shape, mean.shape[-1])
        for length, items in alike(lengths):
            blocks = BlockSums(length, series.shape[-1])
            blocks.update(series[items])
            mean[items], covariance[items] = blocks.moments()
        parts.append(sweeps.covariance(mean, covariance))
    return torch.cat(parts).view(*weights.shape, -1).to(signal.dtype)


def _checked_levels(
    wccv: Tensor, scale_weights: ScaleWeights, weights: Tensor, counts: Tensor | None, n_samples: int
) -> Tensor:
    """Scale weights `(level,)`, where the shapes of moments, weights and counts agree."""
    check_floating("wccv", wccv)
    check_floating("weights", weights)
    if wccv.ndim < 3 or wccv.shape[-1] != wccv.shape[-2] or (*wccv.shape[:-3], wccv.shape[-1]) != weights.shape:
        raise ValueError(
            "`wccv`, `weights`: expected shapes (..., level, sensor, sensor) and (..., sensor), "
            f"got {tuple(wccv.shape)} and {tuple(weights.shape)}"
        )
    if counts is not None and counts.shape != wccv.shape:
        raise ValueError(f"`counts`: expected the shape {tuple(wccv.shape)} of `wccv`, got {tuple(counts.shape)}")
    check_n_levels(wccv.shape[-3], n_samples)
    return resolve_scale_weights(scale_weights, wccv.shape[-3]).to(wccv.device)


def _check_combined(wccv: Tensor, omega: Tensor) -> None:
    combined = combined_covariance(wccv.double(), omega)
    check_positive_definite("the wavelet cross-covariance combined over scales", combined, dtype=wccv.dtype)


def _items(wccv: Tensor, weights: Tensor, counts: Tensor | None) -> tuple[Tensor, Tensor, Tensor | None]:
    """In float64, with one batch dimension."""
    moments = wccv.detach().reshape(-1, *wccv.shape[-3:]).to(torch.float64)
    counted = None if counts is None else counts.reshape(moments.shape).to(moments)
    return moments, weights.detach().reshape(-1, weights.shape[-1]).to(torch.float64), counted
