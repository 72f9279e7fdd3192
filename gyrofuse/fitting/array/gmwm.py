"""Noise models of arrays from wavelet cross-covariances: the Generalised Method of Wavelet Moments with matrices."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from gyrofuse._base.checks import (
    check_confidence_level,
    check_floating,
    check_length,
    check_n_levels,
    check_signal,
    infinite_where,
    largest_level,
)
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse._base.results import named, numbered
from gyrofuse.fitting.array.fit import fit_matrices
from gyrofuse.fitting.array.inference import ArrayFit, spread_of_fit
from gyrofuse.fitting.array.result import ArrayGMWMResult
from gyrofuse.fitting.moments.fit import composition_of
from gyrofuse.fitting.moments.records import Records
from gyrofuse.fitting.spectral.model_tones import model_tones
from gyrofuse.fitting.structure import Composition
from gyrofuse.io.recording import Recording
from gyrofuse.noise.processes import Model, Sinusoid
from gyrofuse.wavelets.covariance import wavelet_products

WEIGHTINGS = ("optimal", "pairwise")
# Numbers that the weights of all items may take at a time.
_NUMBERS_AT_ONCE = 4_000_000
# Largest correlation that entries (i, k) and (k, i) may differ by: float32 rounds to some 1e-7.
_ASYMMETRIC = 1e-5


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
    `Cov(gamma_ab,j, gamma_cd,l) = sum_km Q_jl[k,m] (Theta_k,ac Theta_m,bd + Theta_k,ad Theta_m,bc)`, followed until
    it rests. Matrices are positive by construction; `phi` of an AR1 and the frequency of a tone are of all sensors. The
    matrix of a tone is that of squared amplitudes in phase, `a_i a_k cos(phase_i - phase_k)`, which is all that wavelet
    moments see; its frequency comes from the sensor that shows it most sharply. A tone has two phases, so that of three
    or more sensors its matrix has rank 2 at most. The search knows no such bound, and at that edge entries are not
    normal: amplitudes of three or more sensors have upper limits only.

    A memory longer than a fiftieth of the record is hardly told from a random walk. Its matrix often lacks rank, its
    variances have upper limits only, its covariances and correlations no limits at all, nor has any `phi`; weights for
    long times may be no better than those of the measured moments. `remarks` say where. In about one of a
    hundred records a long memory is found shorter than that, with limits that do not hold.

    Missing samples leave out moments without any complete window; the others count as those of a complete record. A
    sensor without samples has NaN everywhere, and a pair that is never seen together a NaN covariance.

    Args:
        signal: `(..., sensor, time)`, NaN = missing sample, or a `Recording`; an array with infinite samples is not
            fitted. With `n_samples` given a wavelet cross-covariance `(..., level, sensor, sensor)` of records that
            long.
        model: Processes without values, such as `WhiteNoise() + AR1() + RandomWalk()`, or `"WN + AR1 + RW"`.
        n_levels: Number of levels J; by default all that hold two windows side by side.
        confidence_level: Probability that an interval holds the true value.
        weighting: `"optimal"`, or `"pairwise"`: of each pair of sensors the inverse covariance of its own levels, less
            efficient, and feasible for more than some twenty sensors; without a J test.
        n_samples: Length of the record behind a wavelet cross-covariance.

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
    recording = signal if isinstance(signal, Recording) else None
    values = signal.signal if isinstance(signal, Recording) else signal
    check_confidence_level(confidence_level)
    if weighting not in WEIGHTINGS:
        raise ValueError(f"`weighting`: expected one of {', '.join(map(repr, WEIGHTINGS))}, got {weighting!r}")
    if n_samples is None:
        check_signal("signal", values)
        length, wccv = values.shape[-1], _measured(values.detach(), n_levels)
    else:
        check_floating("signal", values)
        length = check_length(n_samples, recorded=recording is not None)
        wccv = _given(values.detach(), length, n_levels)
    levels, n_sensors = wccv.shape[-3:-1]
    sensors = tuple(recording.sensors) if recording else numbered(n_sensors)
    made_of = composition_of(model, held=n_samples is None)
    _check_model(made_of, levels)
    wccv = wccv.to(torch.float64)
    gamma = wccv.reshape(-1, levels, n_sensors, n_sensors)
    usable = _usable(gamma, sensors)
    series = values.detach().reshape(-1, n_sensors, length)[usable] if n_samples is None else None
    gamma = gamma[usable]
    whole = gamma[:, 0].isfinite().all(-1).all(-1)
    check_positive_definite("`signal`: the wavelet cross-covariance at level 1", gamma[whole, 0], sensors)
    # In units of each sensor, so that no sensor is small to rounding.
    nu = gamma.diagonal(dim1=-2, dim2=-1)
    size = nu.log().nanmean(-2).nan_to_num(nan=0.0).div(2).exp()  # (item, sensor)
    squared = (size[:, :, None] * size[:, None, :])[:, None]
    scaled = gamma / squared
    held, held_sd = _held(series, made_of, scaled)
    records = Records((length,), (levels,))
    fit = _fit(scaled, held, records, made_of, weighting)
    return ArrayGMWMResult.build(
        fit=fit,
        squared=squared,
        held_sd=held_sd,
        made_of=made_of,
        usable=usable,
        wavelet_cross_covariance=wccv,
        records=records,
        weighting=weighting,
        confidence_level=confidence_level,
        sensors=sensors,
        rate=recording.rate if recording else None,
        unit=recording.unit if recording and recording.unit != "unknown" else None,
    )


def _fit(gamma: Tensor, held: Tensor, records: Records, made_of: Composition, weighting: str) -> ArrayFit:
    """Fit arrays `(item, level, sensor, sensor)`, some at a time."""
    moments = gamma.shape[1] * gamma.shape[2] * (gamma.shape[2] + 1) // 2
    at_once = max(_NUMBERS_AT_ONCE // moments**2, 1)
    found = []
    for some, known in zip(gamma.split(at_once), held.split(at_once), strict=True):
        theta, shape, converged = fit_matrices(some, known, records, made_of, weighting)
        spread = spread_of_fit(some, theta, shape, records, made_of, weighting)
        found.append((theta, shape, converged & spread[1].isfinite(), *spread))
    return ArrayFit(*(torch.cat(parts) for parts in zip(*found, strict=True)))


def _held(series: Tensor | None, made_of: Composition, gamma: Tensor) -> tuple[Tensor, Tensor]:
    """`x` of the sinusoids, and the spread of beta, of the sensor that shows them most sharply, `(item, tone)`."""
    found = model_tones(series.flatten(0, 1), made_of) if series is not None else None
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
    most = largest_level(n_samples)
    if wccv.ndim < 3 or wccv.shape[-1] != wccv.shape[-2] or not 1 <= wccv.shape[-3] <= most:
        raise ValueError(
            f"`signal`: expected a wavelet cross-covariance (..., level, sensor, sensor) of at most {most} levels for "
            f"{n_samples} samples, got shape {tuple(wccv.shape)}; without `n_samples` it is taken for a signal"
        )
    if n_levels is not None and not 1 <= n_levels <= wccv.shape[-3]:
        raise ValueError(f"`n_levels`: expected 1 to {wccv.shape[-3]}, the levels given, got {n_levels}")
    size = wccv.diagonal(dim1=-2, dim2=-1).sqrt()
    if bool(((wccv - wccv.mT).abs() > _ASYMMETRIC * size[..., :, None] * size[..., None, :]).any()):
        raise ValueError(
            "`signal`: expected a symmetric wavelet cross-covariance, got one whose entries (i, k) and (k, i) differ; "
            "give that of `wavelet_cross_covariance`, or the mean of it and its transpose"
        )
    return wccv[..., :n_levels, :, :]


def _check_model(made_of: Composition, n_levels: int) -> None:
    if any(process.deterministic for process in made_of.processes):
        raise ValueError(
            "`model`: expected noise processes, got a Drift, which is deterministic and has no covariance; "
            "subtract a trend from every sensor"
        )
    n_unknown = made_of.n_linear + len(made_of.curved)
    if n_unknown > n_levels:
        raise ValueError(
            f"`model`: expected at most as many parameters of a sensor as the {n_levels} levels, got {n_unknown} in "
            f"{made_of.name}; record longer or leave processes out"
        )


def _usable(gamma: Tensor, sensors: tuple[str, ...]) -> Tensor:
    """Arrays `(item,)` that can be fitted; says which cannot."""
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
        raise ValueError(f"`signal`: {what}; leave sensors out or ask for fewer `n_levels`")
    warnings.warn(f"`signal`: {what}; their results are NaN and not converged", stacklevel=3)
    return usable
