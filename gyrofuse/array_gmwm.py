"""Noise models of arrays from wavelet cross-covariances: the Generalised Method of Wavelet Moments with matrices."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from gyrofuse import _array_search as array_search
from gyrofuse import _moment_search as search
from gyrofuse._array_inference import ArrayFit, shared, spread_of_fit
from gyrofuse._array_moments import array_moment_covariance, vech, weights_of
from gyrofuse._checks import (
    check_confidence_level,
    check_floating,
    check_n_levels,
    check_positive_integer,
    check_signal,
    largest_level,
)
from gyrofuse._composition import Composition, shape_of
from gyrofuse._result import named, numbered
from gyrofuse.array_gmwm_result import ArrayGMWMResult
from gyrofuse.covariance import wavelet_products
from gyrofuse.moment_fit import composition_of, n_starts_for, tone_frequencies
from gyrofuse.processes import Drift, Model, Sinusoid
from gyrofuse.recording import Recording

WEIGHTINGS = ("optimal", "pairwise")
# Most steps with weights that follow the fit, the first of them with rough ones, and most steps with weights that stay.
_UPDATES, _ROUGH, _POLISHING = 20, 6, 100
# Changes of the fitted moments, chi-squares, with which these steps have come to rest.
_NEAR, _AT_REST = 1e-5, 1e-9
# Starts, by how much their `x` differ in all, and the steps after which the best of them goes on alone.
_DISTINCT, _APART, _TRIAL = 3, 0.5, 12
# Numbers that the weights of all items may take at a time.
_NUMBERS_AT_ONCE = 4_000_000
# Part of the lowest level that each process begins with at least, although a sensor shows nothing of it.
_SEED = 1e-2


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
    `Cov(gamma_ab,j, gamma_cd,l) = sum_km Q_jl[k,m] (Theta_k,ac Theta_m,bd + Theta_k,ad Theta_m,bc)`, followed for
    twenty steps or until it rests and then kept. Matrices are positive by construction; `phi` of an AR1 and the
    frequency of a tone are those of all sensors.
    Of a tone the matrix is that of squared amplitudes in phase, `a_i a_k cos(phase_i - phase_k)`, which is all that
    wavelet moments see; its frequency comes from the sensor that shows it most sharply.

    A memory as long as a seventh of the record is hardly told from a random walk: its matrix mostly lacks rank, weights
    for long times are no better than those of the measured moments, and in one of ten records the memory is found far
    too short. `remarks` tell all but the last; at a thirtieth all is well.

    Missing samples leave out moments without any complete window; the others count as those of a complete record. A
    sensor without samples has NaN everywhere, and a pair that is never seen together a NaN covariance.

    Args:
        signal: `(..., sensor, time)`, NaN = missing sample, or a `Recording`. With `n_samples` given a wavelet
            cross-covariance `(..., level, sensor, sensor)` of records that long.
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
        length, wccv = check_positive_integer("n_samples", n_samples), _given(values.detach(), n_samples, n_levels)
    levels, n_sensors = wccv.shape[-3:-1]
    made_of = composition_of(model, held=n_samples is None)
    _check_model(made_of, levels)
    wccv = wccv.to(torch.float64)
    gamma = wccv.reshape(-1, levels, n_sensors, n_sensors)
    usable = _usable(gamma)
    series = values.detach().reshape(-1, n_sensors, length)[usable] if n_samples is None else None
    gamma = gamma[usable]
    # In units of each sensor, so that no sensor is small to rounding.
    nu = gamma.diagonal(dim1=-2, dim2=-1)
    size = nu.log().nanmean(-2).nan_to_num(nan=0.0).div(2).exp()  # (item, sensor)
    squared = (size[:, :, None] * size[:, None, :])[:, None]
    scaled = gamma / squared
    held, held_sd = _held(series, made_of, scaled)
    fit = _fit(scaled, held, length, made_of, weighting)
    return ArrayGMWMResult.build(
        fit=fit,
        squared=squared,
        shared=shared(fit, held_sd, made_of, confidence_level, length),
        made_of=made_of,
        usable=usable,
        wavelet_cross_covariance=wccv,
        n_samples=length,
        weighting=weighting,
        confidence_level=confidence_level,
        sensors=tuple(recording.sensors) if recording else numbered(n_sensors),
        rate=recording.rate if recording else None,
        unit=recording.unit if recording and recording.unit != "unknown" else None,
    )


def _fit(gamma: Tensor, held: Tensor, n_samples: int, made_of: Composition, weighting: str) -> ArrayFit:
    """Fit arrays `(item, level, sensor, sensor)`, some at a time."""
    moments = gamma.shape[1] * gamma.shape[2] * (gamma.shape[2] + 1) // 2
    at_once = max(_NUMBERS_AT_ONCE // moments**2, 1)
    found = []
    for some, known in zip(gamma.split(at_once), held.split(at_once), strict=True):
        theta, shape, converged = _fit_items(some, known, n_samples, made_of, weighting)
        spread = spread_of_fit(some, theta, shape, n_samples, made_of, weighting)
        found.append((theta, shape, converged & spread[1].isfinite(), *spread))
    return ArrayFit(*(torch.cat(parts) for parts in zip(*found, strict=True)))


def _fit_items(
    gamma: Tensor, held: Tensor, n_samples: int, made_of: Composition, weighting: str
) -> tuple[Tensor, Tensor, Tensor]:
    """`Theta`, `x` and whether the search came to rest."""
    n_levels = gamma.shape[1]
    tau = torch.exp2(torch.arange(1, n_levels + 1, dtype=gamma.dtype, device=gamma.device))
    present = vech(gamma).isfinite()
    moments = torch.where(present, vech(gamma), 0.0)
    root, shape = _starts(gamma, held, tau, n_samples, made_of)  # (item, start, ...)
    n_items, n_starts = shape.shape[:2]
    root, shape = root.flatten(0, 1), shape.flatten(0, 1)
    if n_starts > 1:
        every, seen = (value.repeat_interleave(n_starts, 0) for value in (moments, present))
        root, shape = _follow(every, seen, tau, n_samples, made_of, weighting, root, shape, _ROUGH, _TRIAL)
        score = _misfit(every, seen, tau, n_samples, made_of, root, shape).nan_to_num(nan=torch.inf)
        best = score.view(n_items, -1).argmin(-1) + n_starts * torch.arange(n_items, device=score.device)
        root, shape = root[best], shape[best]
    rough = 0 if n_starts > 1 else _ROUGH
    root, shape = _follow(moments, present, tau, n_samples, made_of, weighting, root, shape, rough, _UPDATES)
    root, shape, rests = _settle(moments, present, tau, n_samples, made_of, weighting, root, shape)
    theta = root @ root
    # AR1s from slow to fast, tones from high to low frequency.
    place = torch.arange(made_of.n_linear, dtype=shape.dtype, device=shape.device).expand(len(shape), -1)
    order, shape = made_of.ordered(place, shape)
    return theta.take_along_dim(order.long()[..., None, None], 1), shape, rests


def _follow(
    moments: Tensor,
    present: Tensor,
    tau: Tensor,
    n_samples: int,
    made_of: Composition,
    weighting: str,
    root: Tensor,
    shape: Tensor,
    rough: int,
    most: int,
) -> tuple[Tensor, Tensor]:
    """`S` and `x` after steps with weights of where these start, the first `rough` ones with those of pairs.

    A minimum for weights that stay would be far off where the data hardly tell a memory, and the next one far off on
    the other side. Weights of the mean of the covariances so far, of which the latest counts half, keep steps from
    going to and fro between two fits of which each has the other's weights.
    """
    root, shape = root.clone(), shape.clone()
    fitted = torch.zeros_like(moments)
    todo = torch.arange(len(moments), device=moments.device)
    mean = moments.new_empty(0)
    for step in range(most):
        at, x = root[todo], shape[todo]
        covariance = array_moment_covariance(made_of, at @ at, x, n_samples, len(tau))
        mean = (mean + covariance) / 2 if step > rough else covariance
        weight = weights_of(mean, present[todo], weighting if step >= rough else "pairwise")
        at, x = array_search.step_downhill(moments[todo], weight, tau, made_of, at, x, exact=False)
        new = made_of.columns(tau, x) @ vech(at @ at)
        near = (_squared(weight, new - fitted[todo]) < _NEAR) & (step >= rough)
        root[todo], shape[todo], fitted[todo] = at, x, new
        todo, mean = todo[~near], mean[~near]
        if not len(todo):
            break
    return root, shape


def _settle(
    moments: Tensor,
    present: Tensor,
    tau: Tensor,
    n_samples: int,
    made_of: Composition,
    weighting: str,
    root: Tensor,
    shape: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """`S` and `x` of the minimum for the weights of where it starts, and whether the steps came to rest."""
    root, shape = root.clone(), shape.clone()
    covariance = array_moment_covariance(made_of, root @ root, shape, n_samples, len(tau))
    weight = weights_of(covariance, present, weighting)
    todo = torch.arange(len(moments), device=moments.device)
    rests = torch.zeros(len(moments), dtype=torch.bool, device=moments.device)
    for _ in range(_POLISHING):
        at, x = root[todo], shape[todo]
        before = made_of.columns(tau, x) @ vech(at @ at)
        at, x = array_search.step_downhill(moments[todo], weight[todo], tau, made_of, at, x, exact=True)
        move = made_of.columns(tau, x) @ vech(at @ at) - before
        root[todo], shape[todo] = at, x
        rests[todo] = _squared(weight[todo], move) < _AT_REST
        todo = (~rests).nonzero()[:, 0]
        if not len(todo):
            break
    return root, shape, rests


def _squared(weight: Tensor, move: Tensor) -> Tensor:
    """`d' W d`, `(item,)`, of moments `(item, level, pair)`."""
    flat = move.flatten(1)
    return ((weight @ flat[..., None])[..., 0] * flat).sum(-1)


def _misfit(
    moments: Tensor,
    present: Tensor,
    tau: Tensor,
    n_samples: int,
    made_of: Composition,
    root: Tensor,
    shape: Tensor,
) -> Tensor:
    """`r' V^-1 r + ln det V`, which compares fits with different weights, `(item,)`."""
    covariance = array_moment_covariance(made_of, root @ root, shape, n_samples, len(tau))
    weight = weights_of(covariance, present, "optimal")
    distance = _squared(weight, moments - made_of.columns(tau, shape) @ vech(root @ root))
    return distance - torch.logdet(weight + torch.diag_embed((~present.flatten(1)).to(weight)))


def _starts(gamma: Tensor, held: Tensor, tau: Tensor, n_samples: int, made_of: Composition) -> tuple[Tensor, Tensor]:
    """`S` of uncorrelated sensors and `x`, `(item, start, ...)`: of each sensor's own fits, those that suit all."""
    nu = gamma.diagonal(dim1=-2, dim2=-1).mT  # (item, sensor, level)
    n_items, n_sensors, _ = nu.shape
    known = nu.isfinite().any(-1).to(nu)
    nu = torch.where(nu.isfinite(), nu, nu.nanmean(1, keepdim=True))
    weight = (3 * (n_samples - tau + 1) / tau).clamp(min=1) / nu.square()  # as of white noise
    everywhere = held[:, None].expand(-1, n_sensors, -1).flatten(0, 1)
    own = search.starting_points(
        nu.flatten(0, 1), weight.flatten(0, 1), tau, made_of, everywhere, n_starts_for(made_of)
    )  # (item sensor, start, shaped)
    target, root = (v.flatten(0, 1)[:, None].expand(-1, own.shape[1], -1).flatten(0, 1) for v in (nu, weight.sqrt()))
    n, n_shaped = n_sensors * own.shape[1], own.shape[2]
    own = search.minimise(target, root, tau, made_of, own.flatten(0, 1))[1].view(n_items, n, n_shaped)
    _, own = made_of.ordered(own.new_zeros(n_items, n, made_of.n_linear), own)
    # Each of them in every sensor: (item, candidate, sensor)
    target, root = (v[:, None].expand(-1, n, -1, -1).flatten(0, 2) for v in (nu, weight.sqrt()))
    shape = own[:, :, None].expand(-1, -1, n_sensors, -1).flatten(0, 2)
    linear, _, objective, _ = search.minimise(target, root, tau, made_of, shape, 0)
    linear = linear.view(n_items, n, n_sensors, -1)
    score = (objective.view(n_items, n, n_sensors) * known[:, None]).sum(-1).nan_to_num(nan=torch.inf)
    kept = []
    for _ in range(_DISTINCT if len(made_of.curved) > 1 else 1):
        kept.append(score.argmin(-1))
        near = (own - own.take_along_dim(kept[-1][:, None, None], 1)).abs().sum(-1) < _APART
        score = torch.where(near, torch.inf, score)
    best = torch.stack(kept, -1)  # (item, start)
    linear, shape = linear.take_along_dim(best[..., None, None], 1), own.take_along_dim(best[..., None], 1)
    least = _SEED * (nu[:, None, :, :, None] / made_of.columns(tau, shape)[:, :, None]).amin(-2)
    return torch.diag_embed(torch.maximum(linear, least).sqrt().mT), shape


def _held(series: Tensor | None, made_of: Composition, gamma: Tensor) -> tuple[Tensor, Tensor]:
    """`x` of the sinusoids, and the spread of beta, of the sensor that shows them most sharply, `(item, tone)`."""
    found = tone_frequencies(series.flatten(0, 1), made_of) if series is not None else None
    if series is None or found is None:
        empty = gamma.new_empty(len(gamma), 0)
        return empty, empty
    beta, sd = (value.to(gamma).unflatten(0, series.shape[:2]) for value in found)  # (item, sensor, tone)
    best = sd.amax(-1).argmin(-1)[:, None, None]
    return shape_of(beta.take_along_dim(best, 1)[:, 0], Sinusoid), sd.take_along_dim(best, 1)[:, 0]


def _measured(signal: Tensor, n_levels: int | None) -> Tensor:
    """Wavelet cross-covariance, NaN where there is no window; by default without levels that an array lacks."""
    length = signal.shape[-1]
    asked = check_n_levels(n_levels, length) if n_levels is not None else max(largest_level(length) - 1, 1)
    sums, counts = wavelet_products(signal, asked)
    if n_levels is None:
        seen = counts.diagonal(dim1=-2, dim2=-1).amax(-1) > 0  # (..., level)
        asked = max(int(seen.reshape(-1, asked).all(0).sum()), 1)
    return (sums / counts)[..., :asked, :, :]


def _given(wccv: Tensor, n_samples: int, n_levels: int | None) -> Tensor:
    most = largest_level(n_samples)
    if wccv.ndim < 3 or wccv.shape[-1] != wccv.shape[-2] or not 1 <= wccv.shape[-3] <= most:
        raise ValueError(
            f"`signal`: expected a wavelet cross-covariance (..., level, sensor, sensor) of at most {most} levels for "
            f"{n_samples} samples, got shape {tuple(wccv.shape)}; without `n_samples` it is taken for a signal"
        )
    if n_levels is not None and not 1 <= n_levels <= wccv.shape[-3]:
        raise ValueError(f"`n_levels`: expected 1 to {wccv.shape[-3]}, the levels given, got {n_levels}")
    return wccv[..., :n_levels, :, :]


def _check_model(made_of: Composition, n_levels: int) -> None:
    if any(isinstance(process, Drift) for process in made_of.processes):
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


def _usable(gamma: Tensor) -> Tensor:
    """Arrays `(item,)` that can be fitted; says which cannot."""
    nu = gamma.diagonal(dim1=-2, dim2=-1)
    # A moment counts where it was measured; a variance of zero or an infinite entry is no noise.
    usable = (
        (nu.isfinite().any(-1).all(-1)) & ((nu > 0) | nu.isnan()).flatten(1).all(-1) & ~gamma.isinf().flatten(1).any(-1)
    )
    if bool(usable.all()):
        return usable
    items = [str(i) for i in (~usable).nonzero()[:, 0].tolist()]
    what = (
        "expected wavelet variances > 0 (a constant signal has none) and a sensor with windows at every level, got "
        f"others in array(s) {named(items, range(len(items)))}"
    )
    if not bool(usable.any()):
        raise ValueError(f"`signal`: {what}; leave sensors out or ask for fewer `n_levels`")
    warnings.warn(f"`signal`: {what}; their results are NaN and not converged", stacklevel=3)
    return usable
