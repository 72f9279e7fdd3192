"""Scale-wise variance optimisation (SVO): one virtual gyro from an array, by closed-form optimal weights.

The weights minimise the wavelet variance of the virtual signal, summed over levels with scale weights `omega_j`:

    A = sum_j omega_j Gamma_j,   c = A^-1 1 / (1' A^-1 1)                                   [Z] equations (6), (7)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from gyrofuse import uncertainty
from gyrofuse._checks import (
    check_confidence_level,
    check_floating,
    check_n_levels,
    check_signal,
)
from gyrofuse._linalg import check_positive_definite
from gyrofuse._result import named, numbered
from gyrofuse.competitors import equal_weights, inverse_variance_weights
from gyrofuse.covariance import wavelet_products
from gyrofuse.recording import Recording
from gyrofuse.scale_weights import ScaleWeights, normalised, resolve_scale_weights
from gyrofuse.svo_result import SVOResult, fuse

METHODS = ("svo", "inverse_variance", "equal")
COVARIANCES = ("model", "none")


def svo_weights(wccv: Tensor, scale_weights: ScaleWeights = "flat") -> Tensor:
    """Optimal weights of an array from its wavelet cross-covariance; differentiable.

    Args:
        wccv: `(..., level, sensor, sensor)`, signal^2.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.

    Returns:
        `(..., sensor)`, sum 1, may be negative.

    Raises:
        TypeError: `wccv` is not a floating point tensor.
        ValueError: Wrong shape or scale weights.
        SingularCovarianceError: `A` is not positive definite (a dead or duplicated sensor, say).

    References:
        [Z] equation (7).
    """
    omega = resolve_scale_weights(scale_weights, _check_levels(wccv)).to(wccv)
    combined = _combine(_counting(wccv, omega), omega)
    check_positive_definite("the wavelet cross-covariance combined over scales", combined)
    return _optimal_weights(combined)


def fit_svo(
    signal: Tensor | Recording,
    scale_weights: ScaleWeights = "flat",
    *,
    method: str = "svo",
    confidence_level: float = 0.95,
    covariance: str = "model",
    n_levels: int | None = None,
) -> SVOResult:
    """Fuse an array of gyros into one virtual gyro of the smallest wavelet variance.

    Bias does not matter (the wavelets difference it away), but the array has to be at rest or to turn at a constant
    rate while it is fitted, for real motion is common to all sensors and is no error.

    Args:
        signal: `(..., sensor, time)` of at least two sensors, or a `Recording`; NaN = missing sample.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        method: `"svo"`; `"inverse_variance"` (ignores correlation) or `"equal"` for comparison.
        confidence_level: Of every interval in the result.
        covariance: `"model"` for Gaussian intervals on the safe side, or `"none"`.
        n_levels: Number of levels J. By default as many as there are scale weights, else the largest at which
            every pair of sensors has a complete window.

    Returns:
        The weights with their uncertainty, and the wavelet variances before and after.

    Raises:
        TypeError: `signal` is neither a floating point tensor nor a `Recording`.
        ValueError: Fewer than two sensors, too few samples, a sensor without any sample, or bad options.
        SingularCovarianceError: A dead, duplicated or linearly dependent sensor.

    References:
        [Z] section II and Theorem 2.

    Example:
        >>> result = fit_svo(signal, "long")
        >>> virtual = result.virtual(signal)  # (..., time)
    """
    recording = signal if isinstance(signal, Recording) else None
    values = signal.signal if isinstance(signal, Recording) else signal
    check_signal("signal", values)
    sensors = recording.sensors if recording else numbered(values.shape[-2])
    _check_choice("method", method, METHODS)
    _check_choice("covariance", covariance, COVARIANCES)
    check_confidence_level(confidence_level)
    _check_array(values, sensors)
    if n_levels is None and not isinstance(scale_weights, str):
        n_levels = len(normalised(scale_weights))
    wccv, n_products = _measure(values, n_levels)
    omega = resolve_scale_weights(scale_weights, wccv.shape[-3]).to(wccv)
    degrees = uncertainty.degrees_of_freedom(n_products)
    counting = _counting(wccv, omega)
    combined = _combine(counting, omega)
    check_positive_definite("the wavelet cross-covariance combined over scales", combined, sensors, dtype=values.dtype)

    weights_degrees = torch.full_like(combined[..., 0], torch.inf)
    if method == "svo":
        weights = _optimal_weights(combined)
        weights_cov, weights_degrees = uncertainty.svo_weights_covariance(counting, omega, weights, degrees)
    elif method == "inverse_variance":
        weights = inverse_variance_weights(counting, omega)
        weights_cov = uncertainty.inverse_variance_weights_covariance(counting, omega, weights, degrees)
    else:
        weights, weights_cov = equal_weights(wccv), torch.zeros_like(combined)
    if covariance == "none":
        weights_cov = torch.full_like(combined, torch.nan)
    return SVOResult(
        weights=weights.to(values.dtype),
        weights_cov=weights_cov.to(values.dtype),
        weights_degrees=weights_degrees,
        confidence_level=confidence_level,
        wavelet_cross_covariance=wccv.to(values.dtype),
        scale_weights=omega.to(values.dtype),
        degrees_of_freedom=degrees,
        method=method,
        n_samples=values.shape[-1],
        sensors=tuple(sensors),
        axes=recording.axes if recording else (),
        rate=recording.rate if recording else None,
        unit=recording.unit if recording and recording.unit != "unknown" else None,
    )


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


def _measure(values: Tensor, n_levels: int | None) -> tuple[Tensor, Tensor]:
    """Wavelet cross-covariance in float64 and the number of products of the pair that has fewest, `(..., level)`.

    Without `n_levels`, as many levels as all pairs have a complete window for.
    """
    asked = check_n_levels(n_levels, values.shape[-1])
    sums, counts = wavelet_products(values.detach(), asked)
    fewest = counts.amin((-1, -2))  # (..., level)
    if n_levels is None:
        asked = int((fewest > 0).reshape(-1, fewest.shape[-1]).all(0).sum())
        if asked == 0:
            raise ValueError(
                "`signal`: expected two samples in a row that all sensors have, found none; "
                "the sensors are not recorded together"
            )
    windows = fewest[..., :asked].sum(-1)
    if bool((windows < values.shape[-2]).any()):
        raise ValueError(
            f"`signal`: expected at least as many complete windows as sensors ({values.shape[-2]}), "
            f"got {int(windows.min())}; record longer or leave sensors out"
        )
    return (sums / counts)[..., :asked, :, :], fewest[..., :asked]


class SVOWeights(nn.Module):
    """`svo_weights` as a layer, without looking at values: `nn.Sequential(HaarFilterBank(J), CrossCovariance(),
    SVOWeights("long"))` maps a signal to its weights, differentiable end to end.

    Args:
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
    """

    def __init__(self, scale_weights: ScaleWeights = "flat") -> None:
        super().__init__()
        self.scale_weights = scale_weights
        # The values of numbers are looked at here, once.
        self._numbers = None if isinstance(scale_weights, str) else normalised(scale_weights)

    def forward(self, wccv: Tensor) -> Tensor:
        """Map `(..., level, sensor, sensor)` to `(..., sensor)`."""
        n_levels, omega = _check_levels(wccv), self._numbers
        if omega is None:
            omega = resolve_scale_weights(self.scale_weights, n_levels)
        elif len(omega) != n_levels:
            raise ValueError(f"`wccv`: expected {len(omega)} levels, one for each scale weight, got {n_levels}")
        omega = omega.to(wccv)
        return _optimal_weights(_combine(_counting(wccv, omega), omega))


class SVO(nn.Module):
    """A virtual gyro as a layer: `fit` chooses the weights and keeps them, `forward` fuses.

    The weights are a buffer: they are saved in `state_dict`, follow `.to(...)`, and are not trained. `forward` has no
    memory, so a stream may come in chunks of any length.

    Args:
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.

    Example:
        >>> svo = SVO("long")
        >>> result = svo.fit(calibration)  # (..., sensor, time)
        >>> virtual = svo(signal)  # (..., time)
    """

    weights: Tensor

    def __init__(self, scale_weights: ScaleWeights = "flat") -> None:
        super().__init__()
        if isinstance(scale_weights, str):
            resolve_scale_weights(scale_weights, 1)  # a wrong name is told now, not when it is used
        else:
            normalised(scale_weights)
        self.scale_weights = scale_weights
        self.register_buffer("weights", torch.empty(0, dtype=torch.float64))

    def fit(self, signal: Tensor | Recording, **options: Any) -> SVOResult:
        """Choose the weights from a recording at rest and keep them.

        Args:
            signal: `(..., sensor, time)` or a `Recording`.
            **options: As for `fit_svo`.

        Returns:
            The result of `fit_svo`.

        Raises:
            TypeError, ValueError, SingularCovarianceError: As `fit_svo`; the weights then stay as they were.
        """
        result = fit_svo(signal, self.scale_weights, **options)
        with torch.inference_mode(False):  # so that they can be used in training later
            self.weights = result.weights.detach().clone()
        return result

    def forward(self, signal: Tensor) -> Tensor:
        """Fuse `(..., sensor, time)` into `(..., time)`."""
        if self.weights.numel() == 0:
            raise RuntimeError("SVO has no weights yet: call fit(signal), or load a state_dict")
        return fuse(self.weights.to(signal.dtype), signal)

    def extra_repr(self) -> str:
        """Show the scale weights."""
        return f"scale_weights={self.scale_weights!r}"

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        # The number of sensors is known only from what is loaded.
        loaded = state_dict.get(prefix + "weights")
        if loaded is not None:
            self.weights = torch.empty_like(loaded, device=self.weights.device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def _check_levels(wccv: Tensor) -> int:
    check_floating("wccv", wccv)
    if wccv.ndim < 3 or wccv.shape[-1] != wccv.shape[-2]:
        raise ValueError(f"`wccv`: expected (..., level, sensor, sensor), got shape {tuple(wccv.shape)}")
    return wccv.shape[-3]


def _combine(counting: Tensor, omega: Tensor) -> Tensor:
    """`A = sum_j omega_j Gamma_j`, [Z] equation (6)."""
    return torch.einsum("j,...jik->...ik", omega, counting)


def _counting(wccv: Tensor, omega: Tensor) -> Tensor:
    """Levels that count; one that does not may well be unknown (NaN)."""
    return torch.where(omega[:, None, None] > 0, wccv, 0.0)


def _optimal_weights(combined: Tensor) -> Tensor:
    solved = torch.linalg.solve(combined, combined.new_ones(combined.shape[-1]).expand(combined.shape[:-1]))
    return solved / solved.sum(-1, keepdim=True)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"`{name}`: expected one of {', '.join(map(repr, choices))}, got {value!r}")
