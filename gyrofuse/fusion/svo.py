"""Scale-wise variance optimisation (SVO): one virtual gyro from an array, with weights that can be trusted."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.checks import check_confidence_level, check_n_levels
from gyrofuse._base.deprecation import warn_deprecated
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse._base.results import ConfidenceInterval, named
from gyrofuse.fusion.layer import FittedLayer
from gyrofuse.fusion.result import SVOResult, fuse
from gyrofuse.fusion.uncertainty.influence import (
    bootstrap_inverse_variance_weights_covariance,
    bootstrap_weights_covariance,
)
from gyrofuse.fusion.uncertainty.weights import (
    WeightsUncertainty,
    normal_uncertainty,
    undefined_uncertainty,
    weights_uncertainty,
    zero_uncertainty,
)
from gyrofuse.fusion.weights.fit import FusionWeights, cross_fit_weights, fit_weights
from gyrofuse.fusion.weights.methods import COVARIANCES, METHODS
from gyrofuse.fusion.weights.svo import ScaleWeights, normalised, resolve_scale_weights
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import as_recording
from gyrofuse.wavelets.block_bootstrap import signal_bootstrap
from gyrofuse.wavelets.intervals import equivalent_dof
from gyrofuse.wavelets.long_run_variance import bin_length
from gyrofuse.wavelets.moments import Moments, combined_covariance
from gyrofuse.wavelets.pilot import fit_pilot


def fit_svo(
    signal: Tensor | Recording,
    scale_weights: ScaleWeights = "flat",
    *,
    method: str = "svo",
    confidence_level: float = 0.95,
    covariance: str = "model",
    block_length: int | None = None,
    n_levels: int | None = None,
) -> SVOResult:
    """Fuse an array of gyros into one virtual gyro of the smallest wavelet variance.

    Wavelets remove a constant bias. The array has to be at rest or to turn at a constant rate while it is fitted, as
    motion that all sensors measure would be taken for correlated errors.

    Args:
        signal: `(..., sensor, time)` of at least two sensors, or a `Recording`; NaN = missing sample.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        method: `"svo"`; `"auto"` is `"model_assisted"` (last levels of a smooth model) unless the held-out risk of
            `"shrinkage"` (last levels shrunk towards neighbouring levels) or SVO is lower by three standard errors, and
            SVO where the recording is too short for held-out blocks; `"nonnegative"` keeps every weight >= 0;
            `"inverse_variance"` ignores correlation; `"equal"`, and `"rdvg"` of Vaccaro and Zaki, whose model is white
            noise and random walk, are for comparison.
        confidence_level: Confidence level of every interval in the result.
        covariance: What the intervals rest on. `"model"`: the variation along the recording where levels hold many
            windows, a fitted model elsewhere; right at every level. `"block_bootstrap"`: the bootstrap of [Z] in closed
            form, too narrow at scales beyond the blocks. `"resampling"`: signals resampled in blocks ([Z] Remark C),
            for stationary signals. `"none"`. Model-assisted and shrunk weights, which vary less, get the intervals of
            SVO weights; nonnegative and RDVG weights get none.
        block_length: Block length of the two bootstraps; by default chosen from the data.
        n_levels: Number of levels J. By default as many as there are scale weights, else the largest at which
            every pair of sensors has a complete window.

    Returns:
        The weights with their uncertainty, and the wavelet variances before and after.

    Raises:
        TypeError: `signal` is neither a floating point tensor nor a `Recording`.
        ValueError: Fewer than two sensors, too few samples, a sensor without any sample, or bad options.
        SingularCovarianceError: A dead, duplicated or linearly dependent sensor.

    References:
        [Z] section II, Theorem 2 and section IV.

    Example:
        >>> result = fit_svo(signal, "long")
        >>> virtual = result.virtual(signal)  # (..., time)
    """
    known_as = as_recording(signal)
    values, sensors = known_as.values, known_as.sensors
    _check_choice("method", method, METHODS)
    _check_choice("covariance", covariance, COVARIANCES)
    check_confidence_level(confidence_level)
    _check_array(values, sensors)
    if n_levels is None and not isinstance(scale_weights, str):
        n_levels = len(normalised(scale_weights))
    batch, items = values.shape[:-2], values.detach().reshape(-1, *values.shape[-2:])
    moments = _measure(items, n_levels)  # batch (item,)
    omega = resolve_scale_weights(scale_weights, moments.n_levels).to(moments.wccv)
    combined = moments.combined(omega)
    check_positive_definite(
        "the wavelet cross-covariance combined over scales",
        combined.view(*batch, *combined.shape[1:]),
        sensors,
        dtype=values.dtype,
        # A model of the noise is fitted to every pair of sensors, and fails at eigenvalues where weights still exist.
        least=1e-10 if covariance == "model" else 0.0,
    )
    fitted = fit_weights(method, items, moments, omega)
    # Levels at which some pair has no window come last, and their scale weight is 0.
    n_known = int((moments.fewest > 0).all(0).sum())
    known, known_omega = moments.lowest(n_known), omega[:n_known]
    pilot = fit_pilot(known.wccv, values.shape[-1])
    dof = pilot.dof(fitted.weights[:, None])[..., 0]
    crossed = cross_fit_weights(fitted, known, known_omega, pilot, dof, confidence_level)
    if covariance == "none":
        found, dof = undefined_uncertainty(fitted.weights), equivalent_dof(moments.fewest)
    else:
        found = _uncertainty(fitted, items, known, known_omega, covariance, block_length, confidence_level)
        dof = pad(dof, (0, len(omega) - n_known), value=1.0)
    low, high = fitted.weights - found.margin, fitted.weights + found.margin

    def batched(value: Tensor, dtype: torch.dtype = values.dtype) -> Tensor:
        return value.to(dtype).reshape(*batch, *value.shape[1:])

    return SVOResult(
        weights=batched(fitted.weights),
        weights_cov=batched(found.covariance),
        weights_dof=batched(found.dof, torch.float64),
        confidence_level=confidence_level,
        confidence_interval=ConfidenceInterval(batched(low), batched(high)),
        wavelet_cross_covariance=batched(moments.wccv),
        scale_weights=omega.to(values.dtype),
        dof=batched(dof, torch.float64),
        cross_fit=crossed.padded(len(omega)).reshape(*batch),
        method=fitted.method,
        selection=fitted.selection and fitted.selection.reshape(batch),
        positive_definite=None if fitted.positive_definite is None else fitted.positive_definite.reshape(batch),
        n_samples=values.shape[-1],
        sensors=sensors,
        axes=known_as.axes,
        rate=known_as.rate,
        unit=known_as.unit,
    )


class SVO(FittedLayer):
    """A virtual gyro as a layer: `fit` chooses the weights and keeps them, `forward` fuses.

    The weights are a buffer: they are saved in `state_dict`, follow `.to(...)`, and are not trained. `forward` has no
    memory, so a stream may come in chunks of any length.

    Args:
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        method: As for `fit_svo`, and so are all options below.
        confidence_level: Confidence level of the intervals in the result of `fit`.
        covariance: What the intervals rest on: `"model"`, `"block_bootstrap"`, `"resampling"` or `"none"`.
        block_length: Block length of the two bootstraps.
        n_levels: Number of levels J.

    Raises:
        TypeError, ValueError: Bad scale weights.

    Example:
        >>> svo = SVO("long")
        >>> result = svo.fit(calibration)  # (..., sensor, time)
        >>> virtual = svo(signal)  # (..., time)
    """

    def __init__(
        self,
        scale_weights: ScaleWeights = "flat",
        *,
        method: str = "svo",
        confidence_level: float = 0.95,
        covariance: str = "model",
        block_length: int | None = None,
        n_levels: int | None = None,
    ) -> None:
        super().__init__(
            scale_weights,
            method=method,
            confidence_level=confidence_level,
            covariance=covariance,
            block_length=block_length,
            n_levels=n_levels,
        )

    def fit(self, signal: Tensor | Recording, **options: Any) -> SVOResult:
        """Choose the weights from a recording at rest and keep them.

        Args:
            signal: `(..., sensor, time)` or a `Recording`.
            **options: Options of the constructor; deprecated here.

        Returns:
            The result of `fit_svo`.

        Raises:
            TypeError, ValueError, SingularCovarianceError: As `fit_svo`; the weights then stay as they were.
        """
        if options:
            warn_deprecated("SVO.fit with options", "SVO(scale_weights, ...) with these options")
        result = fit_svo(signal, self.scale_weights, **(self.options | options))
        self.keep(result.weights)
        return result

    def forward(self, signal: Tensor) -> Tensor:
        """Fuse a signal.

        Args:
            signal: `(..., sensor, time)`.

        Returns:
            `(..., time)`.

        Raises:
            RuntimeError: No weights yet.
            TypeError: `signal` is not a floating point tensor.
            ValueError: `signal` does not have one row for each of the weights.
        """
        self.check_fitted()
        return fuse(self.weights.to(signal.dtype), signal)

    def extra_repr(self) -> str:
        """Show the scale weights."""
        return f"scale_weights={self.scale_weights!r}"


def _uncertainty(
    fitted: FusionWeights,
    items: Tensor,
    moments: Moments,
    omega: Tensor,
    covariance: str,
    block_length: int | None,
    confidence_level: float,
) -> WeightsUncertainty:
    """Uncertainty of the weights; zero for equal ones, undefined for those without a known law."""
    weights, weights_of = fitted.weights, fitted.sampled_as
    if fitted.method == "equal":
        return zero_uncertainty(weights)
    if weights_of is None:
        return undefined_uncertainty(weights)
    if covariance == "model":
        return weights_uncertainty(moments, omega, weights_of, confidence_level)
    if covariance == "block_bootstrap":
        closed_form = bootstrap_weights_covariance
        if fitted.method == "inverse_variance":
            closed_form = bootstrap_inverse_variance_weights_covariance
        wccv = torch.where(omega[:, None, None] > 0, moments.wccv, 0.0)
        found = closed_form(items, wccv, omega, weights, counts=moments.totals, block_length=block_length)
    else:
        resamples = signal_bootstrap(
            items, len(omega), block_length=block_length, generator=torch.Generator().manual_seed(0)
        )
        moved = weights_of(combined_covariance(resamples, omega)) - weights[:, None]
        found = moved.mT @ moved / moved.shape[1]  # about the estimate, as in [Z]
        lost = int(found.isnan().flatten(1).any(1).sum())
        if lost:
            warnings.warn(
                f"`covariance`: resampling gives no intervals for {lost} of {len(items)} array(s), for the missing "
                "samples leave some resamples without any complete window at some level; give covariance='model', a "
                "stretch without gaps or fewer `n_levels`",
                stacklevel=3,
            )
    return normal_uncertainty(found.to(weights), confidence_level)


def _check_array(values: Tensor, sensors: Sequence[str]) -> None:
    """At least two sensors, each with a sample."""
    if values.shape[-2] < 2:
        raise ValueError(
            f"`signal`: expected at least 2 sensors to fuse, got {values.shape[-2]}; give an array of gyros"
        )
    known = values.isfinite().any(-1)
    if not bool(known.all()):
        empty = (~known).reshape(-1, values.shape[-2]).any(0).nonzero().flatten().tolist()
        raise ValueError(f"`signal`: sensor(s) {named(sensors, empty)} have no finite sample; leave them out")


def _measure(items: Tensor, n_levels: int | None) -> Moments:
    """Moments of signals `(item, sensor, time)`.

    Without `n_levels`, of as many levels as all pairs have a complete window for.
    """
    n_sensors, n_samples = items.shape[1:]
    moments = Moments.of(items, check_n_levels(n_levels, n_samples), bin_length(n_samples, n_sensors))
    if n_levels is None:
        n_complete = int((moments.fewest > 0).all(0).sum())
        if n_complete == 0:
            raise ValueError(
                "`signal`: expected two samples in a row that all sensors have, found none; "
                "the sensors are not recorded together"
            )
        moments = moments.lowest(n_complete)
    windows = moments.fewest.sum(-1)
    if bool((windows < n_sensors).any()):
        raise ValueError(
            f"`signal`: expected at least as many complete windows as sensors ({n_sensors}), "
            f"got {int(windows.min())}; record longer or leave sensors out"
        )
    return moments


def _check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    if value not in choices:
        raise ValueError(f"`{name}`: expected one of {', '.join(map(repr, choices))}, got {value!r}")
