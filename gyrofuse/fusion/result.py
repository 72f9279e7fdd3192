"""A fitted virtual gyro: weights, what they gain, and how to apply them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive, check_signal
from gyrofuse._base.results import ConfidenceInterval, listed, named, numbered
from gyrofuse.fusion.uncertainty import tests as hypotheses
from gyrofuse.fusion.uncertainty import variance_reduction
from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit
from gyrofuse.fusion.uncertainty.tests import EnoughData, Evidence, WeightsTest
from gyrofuse.fusion.uncertainty.variance_reduction import VarianceReduction
from gyrofuse.fusion.virtual_gyro import VirtualGyro
from gyrofuse.fusion.weights.selection import Selection
from gyrofuse.io.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def fuse(weights: Tensor, signal: Tensor) -> Tensor:
    """Weighted sum of the sensors: weights `(..., sensor)` and signal `(..., sensor, time)` to `(..., time)`.

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


def plot_deviations(array: SVOResult, virtual: Tensor, band: ConfidenceInterval, ax: Axes | None = None) -> Axes:
    """Draw the Allan deviation of every sensor, the plain mean and a virtual gyro, with the latter's band.

    Args:
        array: One array; its own weights are not looked at.
        virtual: Wavelet variance of the virtual gyro, `(level,)`.
        band: Its limits.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.

    Raises:
        ValueError: `array` holds a batch.
    """
    from gyrofuse.fusion import plots as plotting

    if array.weights.ndim > 1:
        raise ValueError(f"expected one virtual gyro to plot, got {len(array.weights)}; index the result, result[0]")
    return plotting.plot_allan_deviation(
        array.tau,
        array.wavelet_variance,
        names=array.sensors,
        virtual=virtual,
        band=band,
        equal=array.equal_wavelet_variance,
        unit=array.unit,
        in_seconds=array.rate is not None,
        ax=ax,
    )


# Noise of separate sensors hardly agrees more than this at any scale; motion that all of them feel does.
_MOTION = 0.7
# A level of fewer observations than this shows agreement by chance.
_TELLING = 8.0


@dataclass(frozen=True, eq=False)
class SVOResult(VirtualGyro):
    """A fitted virtual gyro. Batched over the leading dimensions of the signal; index it to get one item.

    Attributes:
        weights: `(..., sensor)`, sum 1, may be negative.
        weights_cov: `(..., sensor, sensor)`, covariance of the estimated weights themselves; NaN when not asked for.
        weights_degrees: `(..., sensor)`, degrees of freedom of the variance of each weight.
        confidence_level: Of the intervals.
        confidence_interval: Limits `(..., sensor)` of the weights.
        wavelet_cross_covariance: `(..., level, sensor, sensor)`, signal^2.
        scale_weights: `(level,)`, sum 1.
        degrees_of_freedom: `(..., level)`, independent observations of the virtual gyro that a level holds.
        cross_fit: How the wavelet variance in other recordings compares with that in this one.
        method: How the weights were chosen; `"auto"` where that differs over the batch.
        n_samples: Length of the signal.
        sensors: Name of each sensor.
        axes: Names along the leading dimension (`("x", "y", "z")`), empty when it has none.
        rate: Sampling rate in Hz, when known.
        unit: Unit of the signal, when known.
        selection: Held-out risks, where the method was chosen by them.
        positive_definite: `(...)`, of RDVG whether the estimated covariance of the random walks is one: where not, the
            weights minimise nothing. None for other methods.
    """

    weights: Tensor
    weights_cov: Tensor
    weights_degrees: Tensor
    confidence_level: float
    confidence_interval: ConfidenceInterval
    wavelet_cross_covariance: Tensor
    scale_weights: Tensor
    degrees_of_freedom: Tensor
    cross_fit: CrossFit
    method: str
    n_samples: int
    sensors: tuple[str, ...]
    axes: tuple[str, ...] = ()
    rate: float | None = None
    unit: str | None = None
    selection: Selection | None = None
    positive_definite: Tensor | None = None
    _judged_in = "other recordings"

    @property
    def agreement(self) -> Tensor:
        """Median wavelet correlation between the sensors, `(..., level)`; near 1 where they feel the same motion."""
        scale = self.wavelet_variance.rsqrt()
        correlation = scale[..., :, None] * self.wavelet_cross_covariance * scale[..., None, :]
        first, second = torch.triu_indices(len(self.sensors), len(self.sensors), 1).to(scale.device)
        return correlation[..., first, second].quantile(0.5, -1)

    @property
    def motion(self) -> str:
        """A warning that the array seems to have moved while it was fitted, or an empty string."""
        telling = (self.scale_weights > 0) & (self.degrees_of_freedom >= _TELLING)
        agreement = torch.where(telling, self.agreement, 0.0)
        level = int(agreement.reshape(-1, self.n_levels).amax(0).argmax())
        largest = agreement[..., level].max().item()
        if not largest > _MOTION:
            return ""
        where = f"{self.tau[level].item():.4g} {'s' if self.rate else 'samples'}"
        return (
            f"the sensors agree closely (median correlation {largest:.2f} at {where}): the array seems to have moved, "
            "and what it felt is taken for noise; fit the weights on a stretch at rest"
        )

    def interval_of(self, wavelet_variance: Tensor) -> ConfidenceInterval:
        """Limits `(..., level)` of `virtual_wavelet_variance`, or of that of another combination as slow as it."""
        return self.cross_fit.limits_of(wavelet_variance)

    @property
    def virtual_wavelet_variance(self) -> Tensor:
        """Wavelet variance of the virtual gyro in other recordings of the array, cross-fitted, `(..., level)`."""
        return self.in_sample_wavelet_variance * (1 + self.cross_fit.optimism).to(self.weights)

    @property
    def effective_observations(self) -> Tensor:
        """Number of independent observations that each SVO weight rests on, `(..., sensor)`."""
        return self._evidence("effective_observations").observations.to(self.weights)

    def test_equal(self) -> WeightsTest:
        """Ask whether equal weights would do: an F test of SVO weights, and what equal ones cost.

        Returns:
            The test, batched over the leading dimensions.

        Raises:
            ValueError: Not SVO weights, or no covariance of them.
        """
        return hypotheses.equal_weights_test(self._evidence("test_equal"))

    def test_drop(self, sensor: int | str) -> WeightsTest:
        """Ask whether a sensor earns its place: a test of its SVO weight against zero, and what leaving it out costs.

        Args:
            sensor: Its index or name.

        Returns:
            The test, batched over the leading dimensions.

        Raises:
            ValueError: Not SVO weights, no covariance of them, or no such sensor.
        """
        evidence, index = self._evidence("test_drop"), self._index_of(sensor)
        return hypotheses.dropped_sensor_test(evidence, index, self.sensors[index])

    def enough_data(self, largest_excess: float = hypotheses.SMALL_EXCESS) -> EnoughData:
        """Ask whether the recording is long enough for these SVO weights.

        Args:
            largest_excess: What not knowing the best weights may cost on average in wavelet variance, combined over
                scales; a ratio less 1.

        Returns:
            The answer, batched over the leading dimensions.

        Raises:
            ValueError: Not SVO weights, no covariance of them, or `largest_excess` is not positive.
        """
        return hypotheses.enough_data(self._evidence("enough_data"), check_positive("largest_excess", largest_excess))

    def gain_over_equal(self) -> VarianceReduction:
        """How many times smaller the wavelet variance is than that of the plain mean, by level, with its interval.

        For these weights in any other recording of the array: weights flatter themselves in their own, for which they
        are corrected, whatever the method. Those of RDVG are taken as if they had been chosen beforehand.

        Returns:
            The gain, batched over the leading dimensions.

        Raises:
            ValueError: Equal weights, whose gain is 1.
        """
        if self.method == "equal":
            raise ValueError(
                "`gain_over_equal`: expected weights other than equal ones, got method 'equal'; fit with method='svo'"
            )
        estimate, interval = variance_reduction.ratio_to_equal(
            self.weights.double(),
            self.wavelet_cross_covariance.double(),
            self.degrees_of_freedom,
            self.cross_fit,
            self.confidence_level,
        )
        return VarianceReduction(
            estimate=estimate,
            confidence_interval=interval,
            confidence_level=self.confidence_level,
            in_sample=self.equal_wavelet_variance / self.in_sample_wavelet_variance,
            tau=self.tau,
            tau_unit="s" if self.rate else "samples",
        )

    def virtual(self, signal: Tensor | Recording) -> Tensor:
        """Fuse a signal with these weights: `(..., sensor, time)` to `(..., time)`.

        A sample that any sensor lacks is NaN.
        """
        values = signal.signal if isinstance(signal, Recording) else signal
        return fuse(self.weights.to(values), values)

    def __getitem__(self, item: Any) -> SVOResult:
        """One item, or some, of the leading batch dimensions."""
        n_batch = self.weights.ndim - 1
        index = item if isinstance(item, tuple) else (item,)
        if len(index) > n_batch:
            raise IndexError(f"expected at most {n_batch} indices for batch shape {tuple(self.weights.shape[:-1])}")
        batched = ("weights", "weights_cov", "weights_degrees", "wavelet_cross_covariance", "degrees_of_freedom")
        interval = ConfidenceInterval(*(limit[index] for limit in self.confidence_interval))
        items = {name: getattr(self, name)[index] for name in batched}
        if self.positive_definite is not None:
            items["positive_definite"] = self.positive_definite[index]
        selection = self.selection and self.selection[index]
        items["cross_fit"] = self.cross_fit[index]
        return replace(self, axes=(), confidence_interval=interval, selection=selection, **items)

    def summary(self) -> str:
        """The weights with their intervals and the gain over equal weights per level, as fixed-width text."""
        if self.weights.ndim > 1:
            names = self.axes or numbered(self.weights.shape[0])
            parts = [f"[{name}]\n{self[i].summary()}" for i, name in enumerate(names[:8])]
            if len(names) > 8:
                parts.append(f"... and {len(names) - 8} more")
            return "\n\n".join(parts)
        low, high = self.confidence_interval
        name = {"svo": "SVO"}.get(self.method, self.method.replace("_", " "))
        width = max(6, *(len(sensor) for sensor in self.sensors))
        lines = [
            self._headline(name),
            "",
            f"{'sensor':<{width}}  {'weight':>10}  {f'{100 * self.confidence_level:g} % interval':>24}",
        ]
        for i, sensor in enumerate(self.sensors):
            interval = f"[{low[i].item():+.5f}, {high[i].item():+.5f}]" if not low[i].isnan() else "-"
            lines.append(f"{sensor:<{width}}  {self.weights[i].item():>+10.5f}  {interval:>24}")
        lines += ["", *self._deviation_table()]
        if self.selection:
            lines += ["", self.selection.sentence]
        if self._has_covariance:
            lines += ["", *hypotheses.verdicts(self._evidence("summary"), self.sensors)]
        if self.motion:
            lines += ["", f"Warning: {self.motion}."]
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the Allan deviation of every sensor, the plain mean and the virtual gyro, with the latter's band.

        Args:
            ax: Where to draw; new axes by default.

        Returns:
            The axes.

        Raises:
            ValueError: The result holds a batch; index it first.
        """
        virtual = self.virtual_wavelet_variance
        return plot_deviations(self, virtual, self.interval_of(virtual), ax)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN as None)."""
        low, high = self.confidence_interval
        return {
            "method": self.method,
            "selection": self.selection.to_dict() if self.selection else None,
            "positive_definite": None if self.positive_definite is None else self.positive_definite.tolist(),
            "sensors": list(self.sensors),
            "axes": list(self.axes),
            "rate": self.rate,
            "unit": self.unit,
            "n_samples": self.n_samples,
            "confidence_level": self.confidence_level,
            "motion": self.motion,
            "weights": listed(self.weights),
            "weights_cov": listed(self.weights_cov),
            "confidence_interval": {"low": listed(low), "high": listed(high)},
            "scale_weights": listed(self.scale_weights),
            "tau": listed(self.tau),
            "degrees_of_freedom": listed(self.degrees_of_freedom),
            "wavelet_cross_covariance": listed(self.wavelet_cross_covariance),
            "wavelet_variance": listed(self.wavelet_variance),
            "virtual_wavelet_variance": listed(self.virtual_wavelet_variance),
            "in_sample_wavelet_variance": listed(self.in_sample_wavelet_variance),
            "equal_wavelet_variance": listed(self.equal_wavelet_variance),
        }

    @property
    def _has_covariance(self) -> bool:
        return self.method == "svo" and not bool(self.weights_cov.isnan().all())

    def _evidence(self, asked: str) -> Evidence:
        """What the questions above are answered from."""
        if self.method != "svo":
            raise ValueError(f"`{asked}`: expected SVO weights, got method {self.method!r}; fit with method='svo'")
        if not self._has_covariance:
            raise ValueError(
                f"`{asked}`: expected the covariance of the weights, got none; fit with covariance='model'"
            )
        omega = self.scale_weights.double()
        return Evidence(
            weights=self.weights.double(),
            covariance=self.weights_cov.double(),
            weights_degrees=self.weights_degrees.double(),
            wccv=self.wavelet_cross_covariance.double().nan_to_num(nan=0.0),  # NaN where a level does not count
            scale_weights=omega,
            degrees=self.degrees_of_freedom.double(),
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
