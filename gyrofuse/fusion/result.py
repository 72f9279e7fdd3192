"""A fitted virtual gyro: weights, their uncertainty and their variance reduction, and the fused signal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive, check_signal
from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import ConfidenceInterval, named
from gyrofuse.fusion.uncertainty import tests as hypotheses
from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit
from gyrofuse.fusion.uncertainty.tests import EnoughData, WeightsInference, WeightsTest
from gyrofuse.fusion.uncertainty.variance_reduction import VarianceReduction, ratio_to_equal
from gyrofuse.fusion.virtual_gyro import CrossFittedGyro
from gyrofuse.fusion.weights.selection import Selection
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import as_recording


def fuse(weights: Tensor, signal: Tensor) -> Tensor:
    """Weighted sum of the sensors.

    Args:
        weights: `(..., sensor)`.
        signal: `(..., sensor, time)`.

    Returns:
        `(..., time)`.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: `signal` does not have one row for each of the weights.
    """
    check_signal("signal", signal)
    if signal.shape[-2] != weights.shape[-1]:
        raise ValueError(
            f"`signal`: expected (..., sensor, time) with the {weights.shape[-1]} sensors that the weights are for, "
            f"got shape {tuple(signal.shape)}"
        )
    return (weights.unsqueeze(-2) @ signal).squeeze(-2)  # (..., 1, sensor) @ (..., sensor, time)


@dataclass(frozen=True, eq=False)
class SVOResult(CrossFittedGyro):
    """A fitted virtual gyro. Batched over the leading dimensions of the signal; index it to get one item.

    Attributes:
        weights: `(..., sensor)`, sum 1, may be negative.
        weights_cov: `(..., sensor, sensor)`, covariance of the estimated weights themselves; NaN when unknown.
        weights_dof: `(..., sensor)`, degrees of freedom of the variance of each weight.
        confidence_level: Confidence level of the intervals.
        confidence_interval: Limits `(..., sensor)` of the weights.
        wavelet_cross_covariance: `(..., level, sensor, sensor)`, signal^2.
        scale_weights: `(level,)`, sum 1.
        dof: `(..., level)`, independent observations of the virtual gyro that a level holds.
        cross_fit: How the wavelet variance in other recordings compares with that in this one.
        method: Method of the weights; `"auto"` where methods differ over the batch.
        n_samples: Length of the signal.
        sensors: Name of each sensor.
        axes: Names along the leading dimension (`("x", "y", "z")`), empty when it has none.
        rate: Sampling rate in Hz, when known.
        unit: Unit of the signal, when known.
        selection: Held-out risks, where the method was chosen by them.
        positive_definite: `(...)`, for RDVG whether the estimated covariance of the random walks is positive definite;
            otherwise the weights minimise nothing. None for other methods.
    """

    weights: Tensor
    weights_cov: Tensor
    weights_dof: Tensor
    confidence_level: float
    confidence_interval: ConfidenceInterval
    wavelet_cross_covariance: Tensor
    scale_weights: Tensor
    dof: Tensor
    cross_fit: CrossFit
    method: str
    n_samples: int
    sensors: tuple[str, ...]
    axes: tuple[str, ...] = ()
    rate: float | None = None
    unit: str | None = None
    selection: Selection | None = None
    positive_definite: Tensor | None = None
    weights_degrees = RenamedAttribute("weights_dof")
    degrees_of_freedom = RenamedAttribute("dof")
    _batched = tuple(
        (
            "weights weights_cov weights_dof confidence_interval wavelet_cross_covariance dof cross_fit selection "
            "positive_definite"
        ).split()
    )
    _contents = tuple(
        (
            "method selection positive_definite sensors axes rate unit n_samples confidence_level motion weights "
            "weights_cov confidence_interval scale_weights tau dof wavelet_cross_covariance wavelet_variance "
            "virtual_wavelet_variance in_sample_wavelet_variance equal_wavelet_variance"
        ).split()
    )
    _keys: ClassVar[dict[str, str]] = {"dof": "degrees_of_freedom"}

    @property
    def agreement(self) -> Tensor:
        """Median wavelet correlation between the sensors, `(..., level)`; near 1 where they measure the same motion."""
        scale = self.wavelet_variance.rsqrt()
        correlation = scale[..., :, None] * self.wavelet_cross_covariance * scale[..., None, :]
        first, second = torch.triu_indices(len(self.sensors), len(self.sensors), 1).to(scale.device)
        return correlation[..., first, second].quantile(0.5, -1)

    @property
    def motion(self) -> str:
        """A warning that the array seems to have moved while it was fitted, or an empty string."""
        # Fewer than 8 observations agree by chance.
        judged = (self.scale_weights > 0) & (self.dof >= 8)
        agreement = torch.where(judged, self.agreement, 0.0)
        level = int(agreement.reshape(-1, self.n_levels).amax(0).argmax())
        largest = agreement[..., level].max().item()
        if not largest > 0.7:  # noise of separate sensors hardly correlates more at any scale, common motion does
            return ""
        where = f"{self.tau[level].item():.4g} {self.time_unit}"
        return (
            f"the sensors agree closely (median correlation {largest:.2f} at {where}): the array seems to have moved, "
            "and what it felt is taken for noise; fit the weights on a stretch at rest"
        )

    @property
    def effective_observations(self) -> Tensor:
        """Effective number of independent observations of each SVO weight, `(..., sensor)`."""
        return self._inference("effective_observations").observations.to(self.weights)

    def test_equal(self) -> WeightsTest:
        """Test whether equal weights are as good: an F test of SVO weights, and the loss with equal weights.

        Returns:
            The test, batched over the leading dimensions.

        Raises:
            ValueError: Not SVO weights, or no covariance of them.
        """
        return hypotheses.equal_weights_test(self._inference("test_equal"))

    def test_drop(self, sensor: int | str) -> WeightsTest:
        """Test whether a sensor is needed: its SVO weight against zero, and the loss without the sensor.

        Args:
            sensor: Index or name of the sensor.

        Returns:
            The test, batched over the leading dimensions.

        Raises:
            ValueError: Not SVO weights, no covariance of them, or no such sensor.
        """
        inference, index = self._inference("test_drop"), self._index_of(sensor)
        return hypotheses.dropped_sensor_test(inference, index, self.sensors[index])

    def enough_data(self, largest_excess: float = hypotheses.SMALL_EXCESS) -> EnoughData:
        """Test whether the recording is long enough for these SVO weights.

        Args:
            largest_excess: Acceptable mean loss by errors of the weights in wavelet variance, combined over scales; a
                ratio less 1.

        Returns:
            The answer, batched over the leading dimensions.

        Raises:
            ValueError: Not SVO weights, no covariance of them, or `largest_excess` is not positive.
        """
        return hypotheses.enough_data(self._inference("enough_data"), check_positive("largest_excess", largest_excess))

    def gain_over_equal(self) -> VarianceReduction:
        """Wavelet variance of the plain mean over that of the virtual gyro, by level, with its interval.

        For these weights in any other recording of the array, whatever the method. Weights by RDVG are treated as if
        they had been chosen beforehand.

        Returns:
            The ratio, batched over the leading dimensions.

        Raises:
            ValueError: Equal weights, whose ratio is 1.
        """
        if self.method == "equal":
            raise ValueError(
                "`gain_over_equal`: expected weights other than equal ones, got method 'equal'; fit with method='svo'"
            )
        estimate, interval = ratio_to_equal(
            self.weights.double(),
            self.wavelet_cross_covariance.double(),
            self.dof,
            self.cross_fit,
            self.confidence_level,
        )
        return VarianceReduction(
            estimate=estimate,
            confidence_interval=interval,
            confidence_level=self.confidence_level,
            in_sample=self.equal_wavelet_variance / self.in_sample_wavelet_variance,
            tau=self.tau,
            tau_unit=self.time_unit,
        )

    def virtual(self, signal: Tensor | Recording) -> Tensor:
        """Fuse a signal with these weights: `(..., sensor, time)` to `(..., time)`.

        A sample that any sensor lacks is NaN.

        Args:
            signal: `(..., sensor, time)`, or a `Recording`.

        Raises:
            TypeError: Neither a floating point tensor nor a `Recording`.
            ValueError: Another number of sensors.
        """
        values = as_recording(signal).values
        return fuse(self.weights.to(values), values)

    def __getitem__(self, index: Any) -> SVOResult:
        """One item, or some, of the leading batch dimensions."""
        return replace(super().__getitem__(index), axes=())

    def _summary_of_one(self) -> str:
        low, high = self.confidence_interval
        name = {"svo": "SVO"}.get(self.method, self.method.replace("_", " "))
        width = max(6, *(len(sensor) for sensor in self.sensors))
        lines = [
            self._headline(f"Virtual gyro ({name})"),
            "",
            f"{'sensor':<{width}}  {'weight':>10}  {f'{100 * self.confidence_level:g} % interval':>24}",
        ]
        for i, sensor in enumerate(self.sensors):
            interval = f"[{low[i].item():+.5f}, {high[i].item():+.5f}]" if not low[i].isnan() else "-"
            lines.append(f"{sensor:<{width}}  {self.weights[i].item():>+10.5f}  {interval:>24}")
        lines += ["", *self._plain_table("other recordings")]
        if self.selection:
            lines += ["", self.selection.sentence]
        if self._has_covariance:
            lines += ["", *hypotheses.verdicts(self._inference("summary"), self.sensors)]
        if self.motion:
            lines += ["", f"Warning: {self.motion}."]
        return "\n".join(lines)

    @property
    def _has_covariance(self) -> bool:
        return self.method == "svo" and not bool(self.weights_cov.isnan().all())

    def _inference(self, asked: str) -> WeightsInference:
        """What the tests need; an error that names the test where it is missing."""
        if self.method != "svo":
            raise ValueError(f"`{asked}`: expected SVO weights, got method {self.method!r}; fit with method='svo'")
        if not self._has_covariance:
            raise ValueError(
                f"`{asked}`: expected the covariance of the weights, got none; fit with covariance='model'"
            )
        omega = self.scale_weights.double()
        return WeightsInference(
            weights=self.weights.double(),
            covariance=self.weights_cov.double(),
            weights_dof=self.weights_dof.double(),
            wccv=self.wavelet_cross_covariance.double().nan_to_num(nan=0.0),  # NaN where a level does not count
            scale_weights=omega,
            dof=self.dof.double(),
            confidence_level=self.confidence_level,
        )

    def _index_of(self, sensor: int | str) -> int:
        if sensor in self.sensors:
            return self.sensors.index(str(sensor))
        if isinstance(sensor, int) and not isinstance(sensor, bool) and 0 <= sensor < len(self.sensors):
            return sensor
        raise ValueError(
            f"`sensor`: expected an index from 0 to {len(self.sensors) - 1} or one of "
            f"{named(self.sensors, range(len(self.sensors)))}, got {sensor!r}"
        )
