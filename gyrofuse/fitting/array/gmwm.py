"""Noise models of arrays from wavelet cross-covariances: the Generalised Method of Wavelet Moments with matrices."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from gyrofuse._base.checks import (
    check_confidence_level,
    check_floating,
    check_n_levels,
    check_positive_integer,
    infinite_where,
    largest_level,
)
from gyrofuse._base.chunks import items_at_once
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse._base.results import named, numbered
from gyrofuse.fitting.array.fit import fit_matrices
from gyrofuse.fitting.array.inference import ArrayFit, covariance_of_fit
from gyrofuse.fitting.array.result import ArrayGMWMResult
from gyrofuse.fitting.moments.fit import composition_of
from gyrofuse.fitting.moments.records import SampleDesign, deprecate_moments
from gyrofuse.fitting.spectral.model_tones import model_tones
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import KnownSignal, as_recording
from gyrofuse.noise.processes import Model, Sinusoid
from gyrofuse.wavelets.covariance import wavelet_products


def fit_array_gmwm(
    signal: Tensor | Recording,
    model: Model | str,
    *,
    n_levels: int | None = None,
    confidence_level: float = 0.95,
    weighting: str = "optimal",
    n_samples: int | None = None,
) -> ArrayGMWMResult:
    """Fit one sum of noise processes to an array, each with a covariance matrix between the sensors.

    `theta = argmin r' Omega r`, `r = vech(Gamma_j - sum_k f_k(tau_j) Theta_k)` over all levels, with `Omega = V^-1` of
    the fitted model and its finite length,
    `Cov(gamma_ab,j, gamma_cd,l) = sum_km Q_jl[k,m] (Theta_k,ac Theta_m,bd + Theta_k,ad Theta_m,bc)`, updated until the
    fit comes to rest. Matrices are positive semi-definite by construction; `phi` of an AR1 and the frequency of a
    sinusoid are shared by all sensors. The matrix of a sinusoid is that of its in-phase squared amplitudes,
    `a_i a_k cos(phase_i - phase_k)`, which is all that wavelet moments depend on; its frequency comes from the sensor
    with the smallest standard error of it. A sinusoid has two phases, so that for three or more sensors its matrix has
    rank 2 at most. The search knows no such bound, and at that edge entries are not normal: amplitudes of three or more
    sensors have upper limits only.

    An AR1 with a time constant above a fiftieth of the record hardly differs from a random walk. Its matrix often lacks
    rank, its variances have upper limits only, its covariances, correlations and every `phi` no limits at all; weights
    for long times may be no better than those of the measured moments. `notes` say where. In rare records a long time
    constant is estimated shorter than that, with limits that do not hold.

    Missing samples leave out moments without any complete window; the others count as those of a complete record. A
    sensor without samples has NaN everywhere, and a pair that is never seen together a NaN covariance.

    Args:
        signal: Signal `(..., sensor, time)`, NaN = missing sample, or a `Recording`; an array with infinite samples is
            not fitted. The weights of all moments are one matrix: some twenty sensors are feasible.
        model: Processes without values, such as `WhiteNoise() + AR1() + RandomWalk()`, or `"WN + AR1 + RW"`.
        n_levels: Number of levels J; by default all that hold two non-overlapping windows.
        confidence_level: Probability that an interval holds the true value.
        weighting: Deprecated; only `"optimal"` is left.
        n_samples: Deprecated; see `fit_array_gmwm_moments`.

    Returns:
        Matrices `(..., process, sensor, sensor)` with intervals, shared parameters, and how well the model fits.

    Raises:
        TypeError: `signal` is not a floating point tensor or a `Recording`.
        ValueError: More parameters than levels, a model with values or a drift, bad options, or no array that can be
            fitted.
        SingularCovarianceError: A duplicated or linearly dependent sensor.

    References:
        [V] section III, for one sensor.
    """
    check_confidence_level(confidence_level)
    if weighting != "optimal":
        raise ValueError(
            f"`weighting`: expected 'optimal', got {weighting!r}; weights of single pairs of sensors were less "
            "efficient and are gone, fit arrays of more than some twenty sensors in groups"
        )
    if n_samples is not None:
        deprecate_moments(signal, n_samples, "fit_array_gmwm")
        return fit_array_gmwm_moments(
            signal,  # type: ignore[arg-type]
            n_samples,
            model,
            n_levels=n_levels,
            confidence_level=confidence_level,
        )
    known = as_recording(signal)
    values = known.values.detach()
    wccv = _measured(values, n_levels)
    return _fit(wccv, values.reshape(-1, *values.shape[-2:]), values.shape[-1], model, known, confidence_level)


def fit_array_gmwm_moments(
    wavelet_cross_covariance: Tensor,
    n_samples: int,
    model: Model | str,
    *,
    n_levels: int | None = None,
    confidence_level: float = 0.95,
) -> ArrayGMWMResult:
    """Fit a sum of noise processes to wavelet cross-covariances whose signals are not at hand; see `fit_array_gmwm`.

    Frequencies of sinusoids are then fitted to the moments.

    Args:
        wavelet_cross_covariance: `(..., level, sensor, sensor)`, signal^2, as `wavelet_cross_covariance` returns it.
        n_samples: Length of the records behind it.
        model: As for `fit_array_gmwm`.
        n_levels: Number of levels J; by default all that are given.
        confidence_level: Probability that an interval holds the true value.

    Returns:
        Matrices `(..., process, sensor, sensor)` with intervals, shared parameters, and how well the model fits.

    Raises:
        TypeError: `wavelet_cross_covariance` is not a floating point tensor.
        ValueError: No wavelet cross-covariance of records that long, or as for `fit_array_gmwm`.
        SingularCovarianceError: A duplicated or linearly dependent sensor.
    """
    check_confidence_level(confidence_level)
    n_samples = check_positive_integer("n_samples", n_samples)
    check_floating("wavelet_cross_covariance", wavelet_cross_covariance)
    wccv = _given(wavelet_cross_covariance.detach(), n_samples, n_levels)
    known = KnownSignal(wccv, numbered(wccv.shape[-1]))
    return _fit(wccv, None, n_samples, model, known, confidence_level)


def _fit(
    wccv: Tensor,
    series: Tensor | None,
    n_samples: int,
    model: Model | str,
    known: KnownSignal,
    confidence_level: float,
) -> ArrayGMWMResult:
    """Fit `(..., level, sensor, sensor)`, with the help of the signals `(item, sensor, time)` if at hand."""
    levels, n_sensors = wccv.shape[-3:-1]
    argument = "wavelet_cross_covariance" if series is None else "signal"
    structure = composition_of(model, held=series is not None)
    _check_model(structure, levels)
    wccv = wccv.to(torch.float64)
    gamma = wccv.reshape(-1, levels, n_sensors, n_sensors)
    usable = _usable(argument, gamma, known.sensors)
    gamma = gamma[usable]
    whole = gamma[:, 0].isfinite().all(-1).all(-1)
    check_positive_definite(f"`{argument}`: the wavelet cross-covariance at level 1", gamma[whole, 0], known.sensors)
    # In units of each sensor, so that no sensor is small to rounding.
    nu = gamma.diagonal(dim1=-2, dim2=-1)
    size = nu.log().nanmean(-2).nan_to_num(nan=0.0).div(2).exp()  # (item, sensor)
    squared = (size[:, :, None] * size[:, None, :])[:, None]
    scaled = gamma / squared
    held, held_sd = _held(None if series is None else series[usable], structure, scaled)
    records = SampleDesign((n_samples,), (levels,))
    return ArrayGMWMResult.build(
        fit=_fit_in_parts(scaled, held, records, structure),
        squared=squared,
        held_sd=held_sd,
        structure=structure,
        usable=usable,
        wavelet_cross_covariance=wccv,
        records=records,
        confidence_level=confidence_level,
        sensors=known.sensors,
        rate=known.rate,
        unit=known.unit,
    )


def _fit_in_parts(gamma: Tensor, held: Tensor, records: SampleDesign, structure: ModelStructure) -> ArrayFit:
    """Fit arrays `(item, level, sensor, sensor)`, some at a time."""
    moments = gamma.shape[1] * gamma.shape[2] * (gamma.shape[2] + 1) // 2
    at_once = items_at_once(moments**2)
    found = []
    for some, known in zip(gamma.split(at_once), held.split(at_once), strict=True):
        theta, shape, converged = fit_matrices(some, known, records, structure)
        inference = covariance_of_fit(some, theta, shape, records, structure)
        found.append((theta, shape, converged & inference[1].isfinite(), *inference))
    return ArrayFit(*(torch.cat(parts) for parts in zip(*found, strict=True)))


def _held(series: Tensor | None, structure: ModelStructure, gamma: Tensor) -> tuple[Tensor, Tensor]:
    """`x` of the sinusoids and the standard error of `beta`, `(item, sinusoid)`, of the sensor with the smallest."""
    found = model_tones(series.flatten(0, 1), structure) if series is not None else None
    if series is None or found is None:
        empty = gamma.new_empty(len(gamma), 0)
        return empty, empty
    # (item, sensor, tone)
    beta, sd = (value.to(gamma).unflatten(0, series.shape[:2]) for value in (found.beta, found.beta_sd))
    best = sd.amax(-1).nan_to_num(nan=torch.inf).argmin(-1)[:, None, None]
    return Sinusoid.to_unconstrained(beta.take_along_dim(best, 1)[:, 0]), sd.take_along_dim(best, 1)[:, 0]


def _measured(signal: Tensor, n_levels: int | None) -> Tensor:
    """Wavelet cross-covariance, NaN where there is no window; by default without levels that an array lacks."""
    length = signal.shape[-1]
    asked = check_n_levels(n_levels, length) if n_levels is not None else max(largest_level(length) - 1, 1)
    sums, counts = wavelet_products(signal, asked)
    if n_levels is None:
        seen = counts.diagonal(dim1=-2, dim2=-1).amax(-1) > 0  # (..., level)
        asked = max(int(seen.reshape(-1, asked).all(0).sum()), 1)
    infinite = signal.isinf().any(-1)
    both = (infinite[..., :, None] | infinite[..., None, :])[..., None, :, :]
    return infinite_where(both, sums / counts)[..., :asked, :, :]


def _given(wccv: Tensor, n_samples: int, n_levels: int | None) -> Tensor:
    """A wavelet cross-covariance with `n_levels` of its levels, checked."""
    most = largest_level(n_samples)
    if wccv.ndim < 3 or wccv.shape[-1] != wccv.shape[-2] or not 1 <= wccv.shape[-3] <= most:
        raise ValueError(
            f"`wavelet_cross_covariance`: expected (..., level, sensor, sensor) of at most {most} levels for "
            f"{n_samples} samples, got shape {tuple(wccv.shape)}; for a signal there is fit_array_gmwm"
        )
    if n_levels is not None and not 1 <= n_levels <= wccv.shape[-3]:
        raise ValueError(f"`n_levels`: expected 1 to {wccv.shape[-3]}, the levels given, got {n_levels}")
    size = wccv.diagonal(dim1=-2, dim2=-1).sqrt()
    asymmetric = 1e-5  # difference of two entries, as a correlation: a hundred times what float32 rounds
    if bool(((wccv - wccv.mT).abs() > asymmetric * size[..., :, None] * size[..., None, :]).any()):
        raise ValueError(
            "`wavelet_cross_covariance`: expected a symmetric one, got one whose entries (i, k) and (k, i) differ; "
            "give that of `wavelet_cross_covariance`, or the mean of it and its transpose"
        )
    return wccv[..., :n_levels, :, :]


def _check_model(structure: ModelStructure, n_levels: int) -> None:
    if any(process.deterministic for process in structure.processes):
        raise ValueError(
            "`model`: expected noise processes, got a Drift, which is deterministic and has no covariance; "
            "subtract a trend from every sensor"
        )
    n_unknown = structure.n_linear + len(structure.free_nonlinear)
    if n_unknown > n_levels:
        raise ValueError(
            f"`model`: expected at most as many parameters of a sensor as the {n_levels} levels, got {n_unknown} in "
            f"{structure.name}; record longer or leave processes out"
        )


def _usable(argument: str, gamma: Tensor, sensors: tuple[str, ...]) -> Tensor:
    """Arrays that can be fitted, `(item,)`; warns of those that cannot."""
    nu = gamma.diagonal(dim1=-2, dim2=-1)
    # A moment counts where it was measured; a variance of zero or an infinite entry is no noise.
    usable = (
        (nu.isfinite().any(-1).all(-1)) & ((nu > 0) | nu.isnan()).flatten(1).all(-1) & ~gamma.isinf().flatten(1).any(-1)
    )
    if bool(usable.all()):
        return usable
    places = []
    for i in (~usable).nonzero()[:, 0].tolist():
        bad = ((nu[i] <= 0) | nu[i].isinf()).any(0).nonzero()[:, 0].tolist()
        places.append(f"{i} (sensor {named(sensors, bad)})" if bad else str(i))
    what = (
        "expected wavelet variances > 0 (a constant signal has none, nor has one with infinite samples) and a sensor "
        f"with windows at every level, got others in array(s) {named(places, range(len(places)))}"
    )
    if not bool(usable.any()):
        raise ValueError(f"`{argument}`: {what}; leave sensors out or ask for fewer `n_levels`")
    warnings.warn(f"`{argument}`: {what}; their results are NaN and not converged", stacklevel=4)
    return usable
