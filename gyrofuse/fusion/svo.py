"""Scale-wise variance optimisation (SVO): one virtual gyro from an array, with weights that can be trusted."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from gyrofuse._base.checks import check_confidence_level, check_n_levels, check_signal
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse._base.results import ConfidenceInterval, named, numbered
from gyrofuse.fusion.result import SVOResult, fuse
from gyrofuse.fusion.uncertainty.influence import (
    bootstrap_inverse_variance_weights_covariance,
    bootstrap_weights_covariance,
)
from gyrofuse.fusion.uncertainty.weights import WeightsSpread, certain, normal_spread, spread_of_weights, unknown
from gyrofuse.fusion.weights.methods import METHODS, Chosen, choose_weights, judge_weights
from gyrofuse.fusion.weights.svo import ScaleWeights, combine, counting, normalised, resolve_scale_weights
from gyrofuse.io.recording import Recording
from gyrofuse.wavelets import equivalent_dof as uncertainty
from gyrofuse.wavelets.block_bootstrap import signal_bootstrap
from gyrofuse.wavelets.covariance import binned_products
from gyrofuse.wavelets.long_run_variance import bin_length
from gyrofuse.wavelets.pilot import fit_pilot

COVARIANCES = ("model", "block_bootstrap", "resampling", "none")
_LEAST_DISTINCT = 1e-10


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

    Bias does not matter (the wavelets difference it away), but the array has to be at rest or to turn at a constant
    rate while it is fitted, for real motion is common to all sensors and is no error.

    Args:
        signal: `(..., sensor, time)` of at least two sensors, or a `Recording`; NaN = missing sample.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        method: `"svo"`; `"auto"` chooses between it and its relatives by held-out risk: `"model_assisted"` takes the
            last levels from a smooth model, `"shrinkage"` draws them towards the levels beside them, `"nonnegative"`
            keeps every weight >= 0; `"inverse_variance"` ignores correlation; `"equal"`, and `"rdvg"` of Vaccaro and
            Zaki, which knows white noise and random walk only, for comparison.
        confidence_level: Of every interval in the result.
        covariance: What the intervals rest on. `"model"`: the series itself where levels hold many windows, a fitted
            model where they do not; right at every level. `"block_bootstrap"`: that of [Z] in closed form; it
            overlooks what lasts longer than a block, more so the longer the scale. `"resampling"`: signals resampled
            in blocks ([Z] Remark C), for stationary signals. `"none"`. Model-assisted and shrunk weights, which vary
            less, get the intervals of SVO weights; nonnegative and RDVG weights get none.
        block_length: Of the two bootstraps; by default chosen from the data.
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
    batch, items = values.shape[:-2], values.detach().reshape(-1, *values.shape[-2:])
    sums, counts = _measure(items, n_levels)  # (item, bin, level, sensor, sensor)
    totals = counts.sum(1)
    wccv = sums.sum(1) / totals
    omega = resolve_scale_weights(scale_weights, wccv.shape[-3]).to(wccv)
    combined = combine(counting(wccv, omega), omega)
    check_positive_definite(
        "the wavelet cross-covariance combined over scales",
        combined.view(*batch, *combined.shape[1:]),
        sensors,
        dtype=values.dtype,
        # A model of the noise is fitted to every pair of sensors, and fails sooner than the weights do.
        least=_LEAST_DISTINCT if covariance == "model" else 0.0,
    )
    chosen = choose_weights(method, items, wccv, totals, omega)
    n_known = int((totals > 0).all(0).flatten(1).all(1).sum())  # later levels do not count, or this were refused
    known = (sums[:, :, :n_known], counts[:, :, :n_known], omega[:n_known])
    pilot = fit_pilot(wccv[:, :n_known], values.shape[-1])
    degrees = pilot.degrees_of_freedom(chosen.weights[:, None])[..., 0]
    judged = judge_weights(chosen, *known, pilot, degrees, confidence_level)
    if covariance == "none":
        spread, degrees = unknown(chosen.weights), uncertainty.degrees_of_freedom(totals.amin((-1, -2)))
    else:
        spread = _spread(chosen, items, *known, covariance, block_length, confidence_level)
        degrees = pad(degrees, (0, len(omega) - n_known), value=1.0)
    low, high = chosen.weights - spread.half_width, chosen.weights + spread.half_width

    def batched(value: Tensor, dtype: torch.dtype = values.dtype) -> Tensor:
        return value.to(dtype).reshape(*batch, *value.shape[1:])

    return SVOResult(
        weights=batched(chosen.weights),
        weights_cov=batched(spread.covariance),
        weights_degrees=batched(spread.degrees, torch.float64),
        confidence_level=confidence_level,
        confidence_interval=ConfidenceInterval(batched(low), batched(high)),
        wavelet_cross_covariance=batched(wccv),
        scale_weights=omega.to(values.dtype),
        degrees_of_freedom=batched(degrees, torch.float64),
        cross_fit=judged.padded(len(omega)).reshape(*batch),
        method=chosen.method,
        selection=chosen.selection and chosen.selection.reshape(batch),
        positive_definite=None if chosen.positive_definite is None else chosen.positive_definite.reshape(batch),
        n_samples=values.shape[-1],
        sensors=tuple(sensors),
        axes=recording.axes if recording else (),
        rate=recording.rate if recording else None,
        unit=recording.unit if recording and recording.unit != "unknown" else None,
    )


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


def _spread(
    chosen: Chosen,
    items: Tensor,
    sums: Tensor,
    counts: Tensor,
    omega: Tensor,
    covariance: str,
    block_length: int | None,
    confidence_level: float,
) -> WeightsSpread:
    """Spread of the weights; that of equal ones is none, and of those without a law unknown."""
    weights = chosen.weights
    if chosen.method == "equal":
        return certain(weights)
    weights_of = chosen.spread_of
    if weights_of is None:
        return unknown(weights)
    if covariance == "model":
        return spread_of_weights(sums, counts, omega, items.shape[-1], weights_of, confidence_level)
    totals = counts.sum(1)
    wccv = counting(sums.sum(1) / totals, omega)
    if covariance == "block_bootstrap":
        closed_form = bootstrap_weights_covariance
        if chosen.method == "inverse_variance":
            closed_form = bootstrap_inverse_variance_weights_covariance
        found = closed_form(items, wccv, omega, weights, counts=totals, block_length=block_length)
    else:
        resamples = signal_bootstrap(
            items, len(omega), block_length=block_length, generator=torch.Generator().manual_seed(0)
        )
        moved = weights_of(combine(counting(resamples, omega), omega)) - weights[:, None]
        found = moved.mT @ moved / moved.shape[1]  # around the estimate, as [Z] does
        lost = int(found.isnan().flatten(1).any(1).sum())
        if lost:
            warnings.warn(
                f"`covariance`: resampling gives no intervals for {lost} of {len(items)} array(s), for the missing "
                "samples leave some resamples without any complete window at some level; give covariance='model', a "
                "stretch without gaps or fewer `n_levels`",
                stacklevel=3,
            )
    return normal_spread(found.to(weights), confidence_level)


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


def _measure(items: Tensor, n_levels: int | None) -> tuple[Tensor, Tensor]:
    """Sums and counts of products `(item, bin, level, sensor, sensor)`.

    Without `n_levels`, of as many levels as all pairs have a complete window for.
    """
    n_sensors, n_samples = items.shape[1:]
    asked = check_n_levels(n_levels, n_samples)
    sums, counts = binned_products(items, asked, bin_length(n_samples, n_sensors))
    fewest = counts.sum(1).amin((-1, -2))  # (item, level)
    if n_levels is None:
        asked = int((fewest > 0).all(0).sum())
        if asked == 0:
            raise ValueError(
                "`signal`: expected two samples in a row that all sensors have, found none; "
                "the sensors are not recorded together"
            )
    windows = fewest[:, :asked].sum(-1)
    if bool((windows < n_sensors).any()):
        raise ValueError(
            f"`signal`: expected at least as many complete windows as sensors ({n_sensors}), "
            f"got {int(windows.min())}; record longer or leave sensors out"
        )
    return sums[:, :, :asked], counts[:, :, :asked]


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"`{name}`: expected one of {', '.join(map(repr, choices))}, got {value!r}")
