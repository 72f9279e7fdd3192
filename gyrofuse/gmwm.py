"""Noise models from wavelet variances: the Generalised Method of Wavelet Moments (GMWM)."""

from __future__ import annotations

import warnings
from dataclasses import fields

import torch
from torch import Tensor

from gyrofuse import _moment_search as search
from gyrofuse._checks import check_confidence_level, check_floating, check_positive_integer, check_signal, largest_level
from gyrofuse._composition import Composition, shape_of
from gyrofuse._result import named, numbered
from gyrofuse.covariance import wavelet_variance
from gyrofuse.gmwm_result import GMWMResult
from gyrofuse.moment_covariance import moment_covariance
from gyrofuse.moment_inference import Estimates, Fit, Inference, estimated, infer
from gyrofuse.parsing import parse_model
from gyrofuse.processes import Model, Process, Sinusoid
from gyrofuse.recording import Recording
from gyrofuse.tones import find_tones
from gyrofuse.whittle import refine_whittle

WEIGHTINGS = ("optimal", "diagonal", "identity")
_REWEIGHTINGS, _UPDATES, _DISTINCT = 3, 3, 3
# Steps that the best start may take to its minimum; flat valleys need some hundreds.
_POLISHING = 500


def fit_gmwm(
    signal: Tensor | Recording,
    model: Model | str,
    *,
    weighting: str | Tensor = "optimal",
    confidence_level: float = 0.95,
    n_samples: int | None = None,
    n_levels: int | None = None,
    refine: bool = False,
    strict: bool = False,
) -> GMWMResult:
    """Fit a sum of noise processes to the wavelet variance of every sensor.

    `theta = argmin (nu - nu(theta))' Omega (nu - nu(theta))` over the levels ([V] equation 5), with `Omega = V^-1` of
    the fitted model (`optimal`), the reciprocal variances (`diagonal`), the identity, or weights of your own. The
    frequencies of sinusoids come from the signal's spectrum, where they show a thousand times more sharply than in
    wavelet variances. AR1s are given from slow to fast, sinusoids from high to low frequency.

    Args:
        signal: `(..., sensor, time)`, NaN = missing sample, or a `Recording`. With `n_samples` given a wavelet
            variance `(..., level, sensor)` of records that long.
        model: Processes without values, such as `WhiteNoise() + AR1() + RandomWalk()`, or `"WN + AR1 + RW"`.
        weighting: `"optimal"`, `"diagonal"`, `"identity"`, or `Omega` as `(level,)` or `(level, level)`.
        confidence_level: Probability that an interval holds the true value.
        n_samples: Length of the record behind a wavelet variance.
        n_levels: Number of levels J; by default all that hold two windows side by side.
        refine: Go on from the moments to the maximum of the spectral (Whittle) likelihood, which knows the parameters
            a few per cent better; the fit has to start near it, and the signal may have no missing samples.
        strict: Raise when an item cannot be fitted, instead of marking it.

    Returns:
        Parameters `(..., sensor, parameter)` with intervals, the fitted model, and how well it fits.

    Raises:
        TypeError: `signal` is not a floating point tensor or a `Recording`.
        ValueError: More parameters than levels, a model with values, bad options, or no item that can be fitted.

    References:
        [V] section III; S. Guerrier, J. Skaloud, Y. Stebler, M.-P. Victoria-Feser, JASA 108, 2013.
    """
    recording = signal if isinstance(signal, Recording) else None
    values = signal.signal if isinstance(signal, Recording) else signal
    check_confidence_level(confidence_level)
    if refine and n_samples is not None:
        raise ValueError("`refine`: expected a signal, whose spectrum says more than its wavelet variance, got none")
    if n_samples is None:
        check_signal("signal", values)
        length = values.shape[-1]
        variance = wavelet_variance(values.detach(), _levels(n_levels, length)).to(torch.float64)
        series = values.detach().reshape(-1, length)
    else:
        check_floating("signal", values)
        length, series = check_positive_integer("n_samples", n_samples), None
        variance = _given(values, length, n_levels).to(torch.float64)
    *batch, levels, n_sensors = variance.shape
    sensors = recording.sensors if recording else numbered(n_sensors)
    made_of = _composition(model, held=series is not None)
    n_unknown = made_of.n_linear + len(made_of.curved)
    if n_unknown > levels:
        raise ValueError(
            f"`model`: expected at most as many parameters as the {levels} levels, got {n_unknown} in "
            f"{made_of.name}; record longer or leave processes out"
        )
    name, omega = _weighting(weighting, levels)
    nu = variance.mT.reshape(-1, levels)  # (item, level)
    usable = (nu.isfinite() & (nu > 0)).all(-1)
    if not bool(usable.all()):
        _report(nu, usable, sensors, strict)
    fit = _fit_items(nu[usable], series[usable] if series is not None else None, length, made_of, omega)
    inference = infer(fit, made_of, length, confidence_level)
    estimates, fitted = inference.estimates, inference.fitted
    if refine and series is not None:
        estimates, fitted = _refined(series[usable], fit, made_of, inference, confidence_level)
    return GMWMResult.build(
        fit=fit,
        inference=inference,
        estimates=estimates,
        fitted=fitted,
        made_of=made_of,
        usable=usable,
        wavelet_variance=nu,
        batch=(*batch, n_sensors),
        n_samples=length,
        weighting=name,
        refined=refine,
        confidence_level=confidence_level,
        sensors=tuple(sensors),
        rate=recording.rate if recording else None,
        unit=recording.unit if recording and recording.unit != "unknown" else None,
    )


def _fit_items(nu: Tensor, series: Tensor | None, n_samples: int, made_of: Composition, omega: str | Tensor) -> Fit:
    """Fit all items `(item, level)` at once."""
    n_items, levels = nu.shape
    tau = torch.exp2(torch.arange(1, levels + 1, dtype=nu.dtype, device=nu.device))
    # Scaled so that no record is small to rounding.
    size = nu.amax(-1, keepdim=True)
    nu = nu / size
    held, held_sd = _tones(series, made_of, nu)
    # 3 M / tau windows' worth of observations, as white noise has.
    observations = (3 * (n_samples - tau + 1) / tau).clamp(min=1)
    own = omega.to(nu) if isinstance(omega, Tensor) else None
    weight = observations / nu.square() if own is None else (own if own.ndim == 1 else own.diagonal()).expand_as(nu)
    start = search.starting_points(nu, weight, tau, made_of, held, _n_starts(made_of))  # (item, start, shaped)
    n_starts = start.shape[1]

    def each(value: Tensor, n: int) -> Tensor:
        return value[:, None].expand(-1, n, *value.shape[1:]).flatten(0, 1)

    root = weight.sqrt() if own is None or own.ndim == 1 else torch.linalg.cholesky(own).mT.expand(n_items, -1, -1)
    linear, x, objective, _ = search.minimise(
        each(nu, n_starts), each(root, n_starts), tau, made_of, start.flatten(0, 1)
    )
    for _ in range(_REWEIGHTINGS if own is None else 0):
        fitted = made_of.wavelet_variance(tau, linear, x)
        root = (observations.sqrt() / fitted.clamp(min=1e-30)).clamp(max=1e15)
        linear, x, objective, _ = search.minimise(each(nu, n_starts), root, tau, made_of, x)
        # Distances with different weights: the likelihood of independent normal variances makes them comparable.
        objective = objective - 2 * root.log().sum(-1)
    kept = search.distinct(objective.view(n_items, -1), x.view(n_items, n_starts, -1), _DISTINCT)
    n_kept = kept.shape[1]
    chosen = (torch.arange(n_items, device=nu.device)[:, None] * n_starts + kept).flatten()
    linear, x, objective = linear[chosen], x[chosen], objective[chosen]
    if own is None:
        for _ in range(_UPDATES):
            covariance = moment_covariance(made_of.model(linear, x), n_samples, levels)
            root = covariance.diagonal(dim1=-2, dim2=-1).rsqrt() if omega == "diagonal" else _whitening(covariance)
            linear, x, distance, _ = search.minimise(each(nu, n_kept), root, tau, made_of, x)
        diagonal = root if root.ndim == 2 else root.diagonal(dim1=-2, dim2=-1)
        # r' V^-1 r + ln det V: a V too large would make its own fit look good.
        objective = distance - 2 * diagonal.log().sum(-1)
    best = objective.view(n_items, n_kept).nan_to_num(nan=torch.inf).argmin(-1)
    best = best + n_kept * torch.arange(n_items, device=nu.device)
    root = root[best] if own is None else root
    linear, x, _, reached = search.minimise(nu, root, tau, made_of, x[best], _POLISHING)
    linear, x = made_of.ordered(linear, x)
    return Fit(
        variance=nu * size,
        linear=linear * size,
        shape=x,
        held_sd=held_sd,
        tau=tau,
        converged=reached & linear.isfinite().all(-1),
        omega=omega,
    )


def _refined(
    series: Tensor, fit: Fit, made_of: Composition, inference: Inference, confidence_level: float
) -> tuple[Estimates, Tensor]:
    """Estimates and wavelet variances at the maximum of the spectral likelihood; the moments' where there is none."""
    whittle = refine_whittle(series, made_of, fit.linear, fit.shape)
    kept = ~whittle.converged
    if bool(kept.any()):
        warnings.warn(
            f"`refine`: {int(kept.sum())} of {len(kept)} fits could not be refined (missing samples, or no maximum "
            "near the moments); they are those of the moments",
            stacklevel=3,
        )
    linear = torch.where(kept[:, None], fit.linear, whittle.linear)
    shape = torch.where(kept[:, None], fit.shape, whittle.shape)
    better = estimated(made_of, linear, shape, whittle.covariance, whittle.edge_sd, confidence_level)
    own = inference.estimates
    merged = (
        torch.where(kept.view(-1, *(1,) * (new.ndim - 1)), old, new)
        for old, new in ((getattr(own, f.name), getattr(better, f.name)) for f in fields(Estimates))
    )
    return Estimates(*merged), made_of.wavelet_variance(fit.tau, linear, shape)


def _n_starts(made_of: Composition) -> int:
    """As many as found the lowest minimum of noisy copies every time."""
    tones = sum(isinstance(made_of.processes[k], Sinusoid) for k in made_of.curved)
    return min(4 * 4 ** (len(made_of.curved) - 1) if tones else (1, 4, 6, 8)[min(len(made_of.curved), 3)], 32)


def _whitening(covariance: Tensor) -> Tensor:
    """`W` with `W' W = V^-1`, lower triangular."""
    root, failed = torch.linalg.cholesky_ex(covariance)
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    whitening = torch.linalg.solve_triangular(root, eye.expand_as(root), upper=False)
    return torch.where((failed > 0)[:, None, None], torch.nan, whitening)


def _tones(series: Tensor | None, made_of: Composition, nu: Tensor) -> tuple[Tensor, Tensor]:
    """`x` of the sinusoids from the spectrum, from high to low frequency, and the spread of beta, `(item, tone)`."""
    n_tones = sum(isinstance(p, Sinusoid) for p in made_of.processes)
    if not made_of.held or n_tones == 0 or series is None:
        empty = nu.new_empty(len(nu), 0)
        return empty, empty
    found = find_tones(series.to(torch.float64), n_tones)
    order = found.beta.argsort(-1, descending=True)
    beta, sd = found.beta.gather(-1, order), found.beta_sd.gather(-1, order)
    return shape_of(beta.to(nu), Sinusoid), sd.to(nu)


def _composition(model: Model | str, held: bool) -> Composition:
    model = parse_model(model) if isinstance(model, str) else model
    if not isinstance(model, Model):
        raise TypeError(f"`model`: expected a model or a formula such as 'WN + AR1 + RW', got {type(model).__name__}")
    given = [name for name, value in model._named() if value is not None]
    if given:
        raise ValueError(
            f"`model`: expected parameters to be estimated, got values of {', '.join(given)}; "
            "write the process without values, as in WhiteNoise() + AR1()"
        )
    # Processes of a kind side by side, in the order in which the kinds first appear.
    kinds = list(dict.fromkeys(map(type, model.processes)))
    processes: list[Process] = sorted(model.processes, key=lambda p: kinds.index(type(p)))
    return Composition(tuple(processes), held)


def _weighting(weighting: str | Tensor, levels: int) -> tuple[str, str | Tensor]:
    """Its name, and the weights themselves where they do not depend on the fit."""
    if isinstance(weighting, Tensor):
        omega = check_floating("weighting", weighting).to(torch.float64)
        if omega.shape not in ((levels,), (levels, levels)):
            raise ValueError(
                f"`weighting`: expected ({levels},) or ({levels}, {levels}) for {levels} levels, got "
                f"{tuple(omega.shape)}; give `n_levels` or other weights"
            )
        positive = bool((omega >= 0).all()) if omega.ndim == 1 else int(torch.linalg.cholesky_ex(omega)[1]) == 0
        if not positive or not bool(omega.isfinite().all()):
            raise ValueError("`weighting`: expected weights >= 0 or a positive definite matrix, got others")
        return "given", omega
    if weighting not in WEIGHTINGS:
        raise ValueError(
            f"`weighting`: expected one of {', '.join(map(repr, WEIGHTINGS))} or a tensor, got {weighting!r}"
        )
    return weighting, torch.ones(levels, dtype=torch.float64) if weighting == "identity" else weighting


def _levels(n_levels: int | None, n_samples: int) -> int:
    if n_levels is not None:
        return n_levels  # the wavelet variance checks it
    return max(largest_level(n_samples) - 1, 1)


def _given(values: Tensor, n_samples: int, n_levels: int | None) -> Tensor:
    """A wavelet variance `(..., level, sensor)`, with `n_levels` of its levels."""
    most = largest_level(n_samples)
    if values.ndim < 2 or values.shape[-2] > most or values.shape[-2] == 0:
        raise ValueError(
            f"`signal`: expected a wavelet variance (..., level, sensor) of at most {most} levels for {n_samples} "
            f"samples, got shape {tuple(values.shape)}; without `n_samples` it is taken for a signal"
        )
    if n_levels is None:
        return values
    if not 1 <= n_levels <= values.shape[-2]:
        raise ValueError(f"`n_levels`: expected 1 to {values.shape[-2]}, the levels given, got {n_levels}")
    return values[..., :n_levels, :]


def _report(nu: Tensor, usable: Tensor, sensors: tuple[str, ...], strict: bool) -> None:
    """Say which items cannot be fitted."""
    bad = (~usable).nonzero()[:, 0].tolist()
    n_sensors = len(sensors)
    items = [f" of item {i // n_sensors}" if len(nu) > n_sensors else "" for i in bad]
    places = [f"sensor {sensors[i % n_sensors]}{item}" for i, item in zip(bad, items, strict=True)]
    what = (
        "expected wavelet variances that are finite and > 0 at every level (a constant signal has none, gaps leave no "
        f"whole window at the last levels), got others at {named(places, range(len(places)))}"
    )
    if strict or not bool(usable.any()):
        raise ValueError(f"`signal`: {what}; leave them out or ask for fewer `n_levels`")
    warnings.warn(f"`signal`: {what}; their results are NaN and not converged", stacklevel=3)
