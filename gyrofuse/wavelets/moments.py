"""Wavelet moments of a recording: sums and counts of products of coefficients, in bins of time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from gyrofuse.wavelets.tiles import WaveletProducts, tile_length


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums of products of wavelet coefficients in bins of time, and the cross-covariance that they add up to.

    Attributes:
        sums: `(..., bin, level, sensor, sensor)`, signal^2, float64. A coefficient belongs to the bin of its newest
            sample.
        counts: The same shape: number of products in each sum, fewer where samples are missing.
        bin_length: Samples of a bin.
        n_samples: Length T of the recording.
    """

    sums: Tensor
    counts: Tensor
    bin_length: int
    n_samples: int

    @classmethod
    def of(cls, signal: Tensor, n_levels: int, bin_length: int | None = None) -> Moments:
        """Measure a signal.

        Args:
            signal: `(..., sensor, time)`; NaN = missing sample.
            n_levels: Number of levels J.
            bin_length: Samples of a bin, a power of two; by default the whole recording is one bin.
        """
        *batch, n_sensors, length = signal.shape
        items = signal.reshape(-1, n_sensors, length)
        # As many short recordings at a time as fill one tile.
        group = max(1, tile_length(n_sensors, signal.device, None) // max(length, 1))
        sums: list[Tensor] = []
        counts: list[Tensor] = []
        for some in items.split(group):
            products = WaveletProducts(
                some.shape[0],
                n_sensors,
                n_levels,
                dtype=signal.dtype,
                device=signal.device,
                length=length,
                bin_length=bin_length,
            )
            products.update(some)
            for parts, total in zip((sums, counts), products.totals(), strict=True):
                parts.append(total.permute(1, 2, 0, 3, 4))  # (item, bin, level, sensor, sensor)
        shape = (*batch, *sums[0].shape[1:])
        return cls(torch.cat(sums).view(shape), torch.cat(counts).view(shape), bin_length or length, length)

    def __getitem__(self, items: Tensor | slice) -> Moments:
        """Some items of the leading batch dimension."""
        return replace(self, sums=self.sums[items], counts=self.counts[items])

    def lowest(self, n_levels: int) -> Moments:
        """The first levels only."""
        sums, counts = (values[..., :n_levels, :, :] for values in (self.sums, self.counts))
        return replace(self, sums=sums, counts=counts)

    @property
    def n_levels(self) -> int:
        """Number of levels J."""
        return self.sums.shape[-3]

    @property
    def n_sensors(self) -> int:
        """Number of sensors p."""
        return self.sums.shape[-1]

    @cached_property
    def totals(self) -> Tensor:
        """Number of products over the whole recording, `(..., level, sensor, sensor)`."""
        return self.counts.sum(-4)

    @cached_property
    def wccv(self) -> Tensor:
        """Wavelet cross-covariance, `(..., level, sensor, sensor)`, signal^2; NaN without any product."""
        return self.sums.sum(-4) / self.totals

    @cached_property
    def fewest(self) -> Tensor:
        """Number of products of the pair of sensors that has fewest, `(..., level)`."""
        return self.totals.amin((-1, -2))

    @property
    def observations(self) -> Tensor:
        """Non-overlapping windows `M_j / tau_j` of the pair of sensors that has fewest, `(..., level)`."""
        return self.fewest / filter_lengths(self.n_levels).to(self.sums)

    def combined(self, scale_weights: Tensor) -> Tensor:
        """The wavelet cross-covariance combined over scales, `(..., sensor, sensor)`; see `combined_covariance`."""
        return combined_covariance(self.wccv, scale_weights)


def combined_covariance(wccv: Tensor, scale_weights: Tensor) -> Tensor:
    """`A = sum_j omega_j Gamma_j`, [Z] equation (4); differentiable.

    Args:
        wccv: `(..., level, sensor, sensor)`; a level whose scale weight is 0 may be unknown (NaN).
        scale_weights: `omega`, `(level,)`.

    Returns:
        `(..., sensor, sensor)`.
    """
    omega = scale_weights.to(wccv)
    return torch.einsum("j,...jik->...ik", omega, torch.where(omega[:, None, None] > 0, wccv, 0.0))


def filter_lengths(n_levels: int) -> Tensor:
    """Length `tau_j = 2**j` in samples of the filter of each level, `(level,)`, float64."""
    return torch.exp2(torch.arange(1, n_levels + 1, dtype=torch.float64))
