"""What weights and the wavelet cross-covariance of an array say together, however the latter was computed."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.fusion.weights.baselines import equal_weights


class VirtualGyro:
    """Base of the results that hold one vector of weights for all scales; they declare these attributes.

    Attributes:
        weights: `(..., sensor)`.
        wavelet_cross_covariance: `(..., level, sensor, sensor)`, signal^2.
        scale_weights: `(level,)`.
        n_samples: Length of the signal.
        sensors: Name of each sensor.
        rate: Sampling rate in Hz, when known.
        unit: Unit of the signal, when known.
    """

    weights: Tensor
    wavelet_cross_covariance: Tensor
    scale_weights: Tensor
    n_samples: int
    sensors: tuple[str, ...]
    rate: float | None
    unit: str | None
    _judged_in = "this recording"  # which recordings `virtual_wavelet_variance` is for, in words

    @property
    def n_levels(self) -> int:
        """Number of levels J."""
        return self.scale_weights.shape[0]

    @property
    def tau(self) -> Tensor:
        """Averaging time `2**(j-1)` of each level as in the Allan deviation; seconds, or samples without a rate."""
        level = torch.arange(self.n_levels, dtype=torch.float64)
        return torch.exp2(level) / (self.rate or 1.0)

    @property
    def wavelet_variance(self) -> Tensor:
        """Wavelet variance of every sensor, `(..., level, sensor)`."""
        return self.wavelet_cross_covariance.diagonal(dim1=-2, dim2=-1)

    @property
    def in_sample_wavelet_variance(self) -> Tensor:
        """Wavelet variance `c' Gamma_j c` of the virtual gyro in the recording that it was fitted to, `(..., level)`.

        Weights flatter themselves there.
        """
        return self._variance_of(self.weights)

    @property
    def virtual_wavelet_variance(self) -> Tensor:
        """Wavelet variance of the virtual gyro, `(..., level)`; in sample, where nothing better is known."""
        return self.in_sample_wavelet_variance

    @property
    def equal_wavelet_variance(self) -> Tensor:
        """Wavelet variance of the plain mean of the sensors, `(..., level)`."""
        return self._variance_of(equal_weights(self.wavelet_cross_covariance))

    def _variance_of(self, weights: Tensor) -> Tensor:
        return torch.einsum("...i,...jik,...k->...j", weights, self.wavelet_cross_covariance, weights)

    def _headline(self, method: str) -> str:
        rate = f", {self.rate:.6g} Hz" if self.rate else ""
        return f"Virtual gyro ({method}) of {len(self.sensors)} sensors, {self.n_samples} samples{rate}"

    def _deviation_table(self) -> list[str]:
        """Lines on the Allan deviation of one array by level: the best sensor, the plain mean, the virtual gyro."""
        second = "s" if self.rate else "samples"
        unit = self.unit or "signal"
        lines = [
            f"Allan deviation ({unit}) at averaging time tau, of the virtual gyro in {self._judged_in}",
            f"{'level':>5}  {f'tau ({second})':>13}  {'weight':>7}  {'best sensor':>12}  {'equal':>12}  {'virtual':>12}"
            f"  {'virtual/equal':>13}",
        ]
        best = (2 * self.wavelet_variance.amin(-1)).sqrt()
        equal = (2 * self.equal_wavelet_variance).sqrt()
        virtual = (2 * self.virtual_wavelet_variance).sqrt()
        columns = (self.tau, self.scale_weights, best, equal, virtual, virtual / equal)
        for j, row in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
            tau, omega, *deviations, ratio = row
            numbers = "  ".join(f"{value:>12.5g}" for value in deviations)
            lines.append(f"{j + 1:>5}  {tau:>13.6g}  {omega:>7.4f}  {numbers}  {ratio:>13.4f}")
        return lines
