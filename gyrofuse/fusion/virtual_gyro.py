"""What fitted virtual gyros share: variances that follow from weights and moments, text for a batch, and the figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gyrofuse._base.results import ConfidenceInterval, Result, numbered
from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit
from gyrofuse.fusion.weights.baselines import equal_weights

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class VirtualGyro(Result):
    """Base of the results of a fused array; they declare these attributes.

    Attributes:
        weights: `(..., sensor)`, or `(..., band, sensor)` for a multi-scale virtual gyro.
        wavelet_cross_covariance: `(..., level, sensor, sensor)`, signal^2.
        scale_weights: `(level,)`.
        n_samples: Length of the signal.
        sensors: Name of each sensor.
        axes: Names along the leading dimension, empty when it has none.
        rate: Sampling rate in Hz, when known.
        unit: Unit of the signal, when known.
    """

    weights: Tensor
    wavelet_cross_covariance: Tensor
    scale_weights: Tensor
    n_samples: int
    sensors: tuple[str, ...]
    axes: tuple[str, ...]
    rate: float | None
    unit: str | None

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions; `()` for a single array."""
        return tuple(self.wavelet_cross_covariance.shape[:-3])

    @property
    def n_levels(self) -> int:
        """Number of levels J."""
        return self.scale_weights.shape[0]

    @property
    def time_unit(self) -> str:
        """Unit of averaging times: `"s"`, or `"samples"` without a rate."""
        return "s" if self.rate else "samples"

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

        Too small, as the weights were chosen in that recording.
        """
        return self._variance_of(self.weights)

    @property
    def virtual_wavelet_variance(self) -> Tensor:
        """Wavelet variance of the virtual gyro, `(..., level)`; in sample without a cross-fit."""
        return self.in_sample_wavelet_variance

    @property
    def equal_wavelet_variance(self) -> Tensor:
        """Wavelet variance of the plain mean of the sensors, `(..., level)`."""
        return self._variance_of(equal_weights(self.wavelet_cross_covariance))

    def interval_of(self, wavelet_variance: Tensor) -> ConfidenceInterval | None:
        """Limits of the wavelet variance of the virtual gyro; None without a cross-fit.

        Args:
            wavelet_variance: `(..., level)`.
        """
        return None

    def summary(self) -> str:
        """Weights and Allan deviations as fixed-width text, for each of the first items of a batch."""
        if not self.batch_shape:
            return self._summary_of_one()
        names = self.axes or numbered(self.batch_shape[0])
        parts = [f"[{name}]\n{self[i].summary()}" for i, name in enumerate(names[:8])]
        if len(names) > 8:
            parts.append(f"... and {len(names) - 8} more")
        return "\n\n".join(parts)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the Allan deviation of every sensor, the plain mean and the virtual gyro, with its confidence band.

        Args:
            ax: Where to draw; new axes by default.

        Returns:
            The axes.

        Raises:
            ValueError: The result holds a batch; index it first.
        """
        from gyrofuse.fusion.plots import plot_allan_deviation

        if self.batch_shape:
            raise ValueError(
                f"expected one virtual gyro to plot, got {self.batch_shape[0]}; index the result, result[0]"
            )
        virtual = self.virtual_wavelet_variance
        return plot_allan_deviation(
            self.tau,
            self.wavelet_variance,
            names=self.sensors,
            virtual=virtual,
            band=self.interval_of(virtual),
            equal=self.equal_wavelet_variance,
            unit=self.unit,
            in_seconds=self.rate is not None,
            ax=ax,
        )

    def _summary_of_one(self) -> str:
        raise NotImplementedError

    def _variance_of(self, weights: Tensor) -> Tensor:
        return torch.einsum("...i,...jik,...k->...j", weights, self.wavelet_cross_covariance, weights)

    def _headline(self, kind: str) -> str:
        rate = f", {self.rate:.6g} Hz" if self.rate else ""
        return f"{kind} of {len(self.sensors)} sensors, {self.n_samples} samples{rate}"

    def _deviation_table(self, whose: str, columns: dict[str, Tensor]) -> list[str]:
        """Lines on Allan deviations of one array by level.

        Args:
            whose: What the deviations of the virtual gyro are for, in words.
            columns: Variances `(level,)` by name, of which the last is the virtual gyro's, and of `weight` the scale
                weights.
        """
        weighted = "weight" in columns
        deviations = {name: (2 * values).sqrt() for name, values in columns.items() if name != "weight"}
        ratio = deviations["virtual"] / deviations["equal"]
        head = f"{'level':>5}  {f'tau ({self.time_unit})':>13}  " + (f"{'weight':>7}  " if weighted else "")
        lines = [
            f"Allan deviation ({self.unit or 'signal'}) at averaging time tau, {whose}",
            head + "  ".join(f"{name:>12}" for name in deviations) + f"  {'virtual/equal':>13}",
        ]
        for j in range(self.n_levels):
            start = f"{j + 1:>5}  {self.tau[j].item():>13.6g}  "
            start += f"{columns['weight'][j].item():>7.4f}  " if weighted else ""
            numbers = "  ".join(f"{values[j].item():>12.5g}" for values in deviations.values())
            lines.append(f"{start}{numbers}  {ratio[j].item():>13.4f}")
        return lines

    def _plain_table(self, judged_in: str) -> list[str]:
        """`_deviation_table` of the best sensor, the plain mean and the virtual gyro, with the scale weights."""
        columns = {
            "weight": self.scale_weights,
            "best sensor": self.wavelet_variance.amin(-1),
            "equal": self.equal_wavelet_variance,
            "virtual": self.virtual_wavelet_variance,
        }
        return self._deviation_table(f"of the virtual gyro in {judged_in}", columns)


class CrossFittedGyro(VirtualGyro):
    """Base of the virtual gyros whose variance in other recordings was estimated by cross-fitting.

    Attributes:
        cross_fit: How the wavelet variance in other recordings compares with that in this one.
    """

    cross_fit: CrossFit

    @property
    def virtual_wavelet_variance(self) -> Tensor:
        """Wavelet variance of the virtual gyro in other recordings of the array, cross-fitted, `(..., level)`."""
        return self.in_sample_wavelet_variance * (1 + self.cross_fit.optimism).to(self.weights)

    def interval_of(self, wavelet_variance: Tensor) -> ConfidenceInterval:
        """Limits of `virtual_wavelet_variance`, or of the variance of another combination with as many observations.

        Args:
            wavelet_variance: `(..., level)`.

        Returns:
            Limits `(..., level)`.
        """
        return self.cross_fit.limits_of(wavelet_variance)
