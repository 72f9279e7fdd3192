"""Noise models from wavelet variances: the Generalised Method of Wavelet Moments (GMWM)."""

from __future__ import annotations

import warnings
from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse._base.checks import (
    check_confidence_level,
    check_floating,
    check_positive_integer,
    infinite_where,
    largest_level,
)
from gyrofuse._base.deprecation import warn_deprecated
from gyrofuse._base.results import named, numbered, sensor_label
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.moments.covariance import check_gaussian
from gyrofuse.fitting.moments.drift_sign import rising, with_drift_sign
from gyrofuse.fitting.moments.fit import composition_of, fit_batch
from gyrofuse.fitting.moments.identifiability import notes
from gyrofuse.fitting.moments.inference import Fit, Inference, either, infer, infer_efficient
from gyrofuse.fitting.moments.profile import profiled
from gyrofuse.fitting.moments.profile_objectives import MomentProfile, SpectralProfile
from gyrofuse.fitting.moments.records import SampleDesign, check_wavelet_variance, deprecate_moments
from gyrofuse.fitting.moments.white_kurtosis import white_excess_kurtosis, with_excess_kurtosis
from gyrofuse.fitting.spectral.model_tones import model_tones
from gyrofuse.fitting.spectral.tones import Tones
from gyrofuse.fitting.spectral.whittle import refine_whittle
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import KnownSignal, as_recording
from gyrofuse.noise.processes import Model
from gyrofuse.wavelets.robust import check_efficiency, robust_wavelet_variance

WEIGHTINGS = ("optimal", "diagonal", "identity")


def fit_gmwm(
    signal: Tensor | Recording,
    model: Model | str,
    *,
    weighting: str | Tensor = "optimal",
    confidence_level: float = 0.95,
    n_levels: int | None = None,
    refine: bool = False,
    efficiency: float = 1.0,
    strict: bool = False,
    n_samples: int | None = None,
    moments: str | None = None,
) -> GMWMResult:
    """Fit a sum of noise processes to the wavelet variance of every sensor.

    `theta = argmin (nu - nu(theta))' Omega (nu - nu(theta))` over the levels ([V] equation (4)), with `Omega = V^-1` of
    the fitted model (`optimal`), the reciprocal variances (`diagonal`), the identity, or weights of your own. `Omega`
    is updated between fits and held in each.

    Frequencies of sinusoids come from the signal's spectrum, where they are a thousand times better known than from
    wavelet variances. Lines of fewer than 30 cycles, or hardly above the noise, are tested against a noise spectrum
    fitted to the record; `notes` name those that could be noise, and those whose amplitude in the moments is larger
    than in the spectrum. The sign of a drift is that of the signal's slope. AR1s are ordered from slow to fast,
    sinusoids from high to low frequency.

    Intervals are symmetric in the logarithm of variances and amplitudes, in `atanh phi` and in `logit(beta / pi)`.
    Where such an interval is unreliable, the limits are those of the profiled objective: all values at which its
    minimum over the other parameters exceeds the global minimum by at most `z^2`, `z` the normal quantile (`z^2` the
    chi-square quantile of two degrees of freedom where the model may have an AR1 too many). This is so for variances at
    zero, parameters of which hardly the order of magnitude is known, AR1s whose interval includes the white-noise or
    random-walk limit, and objectives that are not nearly quadratic. Near zero these intervals hold the true value
    somewhat more often than stated. Parameters that the record does not identify are named in `notes`.

    Noise is assumed Gaussian except for its white part, whose excess kurtosis, estimated from the differences of the
    signal as if its samples were independent, enters the interval of its variance.

    Args:
        signal: `(..., sensor, time)`, NaN = missing sample, or a `Recording`; a sensor with infinite samples is not
            fitted.
        model: Processes without values, such as `WhiteNoise() + AR1() + RandomWalk()`, or `"WN + AR1 + RW"`.
        weighting: `"optimal"`, `"diagonal"`, `"identity"`, or `Omega` as `(level,)` or `(level, level)`.
        confidence_level: Probability that an interval holds the true value.
        n_levels: Number of levels J; by default all that hold two non-overlapping windows.
        refine: Whether to go on from the moments to the maximum of the spectral (Whittle) likelihood, whose estimates
            are somewhat more accurate. Where the search from the moments reaches no maximum, or samples are missing,
            the fit to the moments is kept, with a warning. The J test is that of the refined parameters.
        efficiency: Efficiency of the wavelet variance: 1 for the mean square of the coefficients; a value below 1
            switches to `robust_wavelet_variance` of that efficiency, with its own covariance in weights, intervals and
            J test, by default with levels of at least 16 windows. Gaussian processes only: it is not consistent for
            sinusoids and drifts. Outliers then do not count as white noise, but intervals are those of clean noise;
            with one outlier in 2000 samples or more, slow processes come out too large, and the J test rejects the
            model.
        strict: Whether to raise when an item cannot be fitted, instead of marking it.
        n_samples: Deprecated; see `fit_gmwm_moments`.
        moments: Deprecated; only `"variance"` is left.

    Returns:
        Parameters `(..., sensor, parameter)` with intervals, the fitted model, and how well it fits.

    Raises:
        TypeError: `signal` is not a floating point tensor or a `Recording`.
        ValueError: More parameters than levels, a model with values, bad options, a sinusoid or a drift with
            `efficiency` below 1, or no item that can be fitted.

    References:
        [V] section III; S. Guerrier, J. Skaloud, Y. Stebler, M.-P. Victoria-Feser, JASA 108, 2013.
    """
    check_confidence_level(confidence_level)
    _check_moments(moments)
    if refine and n_samples is not None:
        raise ValueError("`refine`: expected a signal, whose spectrum says more than its wavelet variance, got none")
    if check_efficiency(efficiency) < 1 and refine:
        raise ValueError(
            "`refine`: expected `efficiency=1`, as the likelihood is not robust, got less; use one of them"
        )
    if n_samples is not None:
        deprecate_moments(signal, n_samples, "fit_gmwm")
        return fit_gmwm_moments(
            signal,  # type: ignore[arg-type]
            n_samples,
            model,
            weighting=weighting,
            confidence_level=confidence_level,
            n_levels=n_levels,
            efficiency=efficiency,
            strict=strict,
        )
    known = as_recording(signal)
    values = known.values.detach()
    length = values.shape[-1]
    if n_levels is None:
        # Two non-overlapping windows; a robust scale needs sixteen.
        n_levels = max(largest_level(length) - (1 if efficiency == 1 else 4), 1)
    variance = robust_wavelet_variance(values, n_levels, efficiency=efficiency).to(torch.float64)
    variance = infinite_where(values.isinf().any(-1)[..., None, :], variance)
    series = values.reshape(-1, length)
    records = SampleDesign((length,), variance.shape[-2:-1], efficiency)
    return _fit(variance, series, records, model, known, weighting, confidence_level, refine, strict)


def fit_gmwm_moments(
    wavelet_variance: Tensor,
    n_samples: int,
    model: Model | str,
    *,
    weighting: str | Tensor = "optimal",
    confidence_level: float = 0.95,
    n_levels: int | None = None,
    efficiency: float = 1.0,
    strict: bool = False,
) -> GMWMResult:
    """Fit a sum of noise processes to wavelet variances whose signals are not at hand; see `fit_gmwm`.

    Frequencies of sinusoids are then fitted to the moments, the slope of a drift is reported positive, as wavelet
    variances do not determine its sign, and white noise is assumed Gaussian.

    Args:
        wavelet_variance: `(..., level, sensor)`, signal^2, as `wavelet_variance` returns it.
        n_samples: Length of the records behind it.
        model: As for `fit_gmwm`.
        weighting: As for `fit_gmwm`.
        confidence_level: Probability that an interval holds the true value.
        n_levels: Number of levels J; by default all that are given.
        efficiency: Efficiency of the wavelet variance; below 1 for one of `robust_wavelet_variance`.
        strict: Whether to raise when an item cannot be fitted, instead of marking it.

    Returns:
        Parameters `(..., sensor, parameter)` with intervals, the fitted model, and how well it fits.

    Raises:
        TypeError: `wavelet_variance` is not a floating point tensor.
        ValueError: No wavelet variance of records that long, or as for `fit_gmwm`.
    """
    check_confidence_level(confidence_level)
    n_samples = check_positive_integer("n_samples", n_samples)
    variance = check_wavelet_variance(wavelet_variance, n_samples, n_levels).to(torch.float64)
    records = SampleDesign((n_samples,), variance.shape[-2:-1], check_efficiency(efficiency))
    known = KnownSignal(wavelet_variance, numbered(variance.shape[-1]))
    return _fit(variance, None, records, model, known, weighting, confidence_level, False, strict)


def _fit(
    variance: Tensor,
    series: Tensor | None,
    records: SampleDesign,
    model: Model | str,
    known: KnownSignal,
    weighting: str | Tensor,
    confidence_level: float,
    refine: bool,
    strict: bool,
) -> GMWMResult:
    """Fit wavelet variances `(..., level, sensor)`, with the help of their signals `(item, time)` if at hand."""
    *batch, levels, n_sensors = variance.shape
    structure = composition_of(model, held=series is not None)
    if not any(p.gaussian for p in structure.processes):
        raise ValueError(f"`model`: expected a noise process beside sinusoids and drifts, got {structure.name}; add WN")
    if records.efficiency < 1:
        check_gaussian(Model(list(structure.processes)))
    n_unknown = structure.n_linear + len(structure.free_nonlinear)
    if n_unknown > levels:
        raise ValueError(
            f"`model`: expected at most as many parameters as the {levels} levels, got {n_unknown} in "
            f"{structure.name}; record longer or leave processes out"
        )
    name, omega = _weighting(weighting, levels)
    nu = variance.mT.reshape(-1, levels)  # (item, level)
    usable = (nu.isfinite() & (nu > 0)).all(-1)
    if not bool(usable.all()):
        argument = "wavelet_variance" if series is None else "signal"
        _report(argument, nu, usable, known.sensors, strict, records.efficiency)
    series = None if series is None else series[usable]
    tones = None if series is None else model_tones(series, structure)
    frequencies = None if tones is None else (tones.beta, tones.beta_sd)
    fit = fit_batch(nu[usable], frequencies, records, structure, omega)
    inference = infer(fit, structure, confidence_level)
    if refine and series is not None:
        inference = _refined(series, tones, fit, structure, inference, confidence_level)
    else:
        inference = profiled(inference, MomentProfile(fit, structure), fit, structure, confidence_level)
    if series is not None and records.efficiency == 1:
        kappa = white_excess_kurtosis(series, tones, structure, inference.estimates.params)
        inference = with_excess_kurtosis(inference, kappa, structure, records.longest, confidence_level)
    own_notes = notes(structure, inference.estimates, records.longest, confidence_level, tones)
    if series is not None:
        estimates = with_drift_sign(inference.estimates, Model(list(structure.processes)), rising(series))
        inference = replace(inference, estimates=estimates)
    return GMWMResult.build(
        inference=inference,
        notes=own_notes,
        structure=structure,
        usable=usable,
        wavelet_variance=nu,
        batch=(*batch, n_sensors),
        records=records,
        weighting=name,
        refined=refine,
        confidence_level=confidence_level,
        sensors=known.sensors,
        rate=known.rate,
        unit=known.unit,
        axes=known.axes,
    )


def _refined(
    series: Tensor,
    tones: Tones | None,
    fit: Fit,
    structure: ModelStructure,
    inference: Inference,
    confidence_level: float,
) -> Inference:
    """Inference at the maximum of the spectral likelihood, and from the moments where none is found."""
    whittle = refine_whittle(series, structure, fit.linear, fit.shape, tones=tones)
    kept = ~whittle.converged
    if bool(kept.any()):
        warnings.warn(
            f"`refine`: {int(kept.sum())} of {len(kept)} fits could not be refined (missing samples, or no maximum "
            "near the moments); they are those of the moments",
            stacklevel=4,
        )
    linear, shape = either(kept, fit.linear, whittle.linear), either(kept, fit.shape, whittle.shape)
    there = replace(fit, linear=linear, shape=shape, converged=torch.ones_like(kept))
    better = infer_efficient(there, structure, whittle.covariance, whittle.edge_sd, confidence_level)
    likelihood = SpectralProfile(linear, shape, whittle.energy, whittle.count, structure, series.shape[-1])
    better = profiled(better, likelihood, fit, structure, confidence_level, ~kept)
    own = profiled(inference, MomentProfile(fit, structure), fit, structure, confidence_level, kept)
    return either(kept, own, better)


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
            f"`weighting`: expected one of {', '.join(map(repr, WEIGHTINGS))} or a tensor, got {weighting!r}; "
            "'optimal' has the smallest errors"
        )
    return weighting, torch.ones(levels, dtype=torch.float64) if weighting == "identity" else weighting


def _check_moments(moments: str | None) -> None:
    """Refuse moments that are gone, and warn of the argument that chose between them."""
    if moments not in (None, "variance"):
        raise ValueError(
            f"`moments`: expected 'variance', got {moments!r}; logarithms of wavelet variances have larger errors "
            "and are no longer fitted; leave `moments` out"
        )
    if moments is not None:
        warn_deprecated("argument `moments` of fit_gmwm", "fit_gmwm without it", stacklevel=3)


def _report(
    argument: str, nu: Tensor, usable: Tensor, sensors: tuple[str, ...], strict: bool, efficiency: float
) -> None:
    """Raise or warn about items that cannot be fitted."""
    bad = (~usable).nonzero()[:, 0].tolist()
    n_sensors = len(sensors)
    places = [f"sensor {sensor_label(sensors, divmod(i, n_sensors) if len(nu) > n_sensors else (i,))}" for i in bad]
    what = (
        "expected wavelet variances that are finite and > 0 at every level (a constant signal has none, nor has one "
        "with infinite samples; squares of huge or tiny numbers leave the range; gaps leave no whole window at the "
        "last levels), got others at "
        f"{named(places, range(len(places)))}"
    )
    if strict or not bool(usable.any()):
        # Of few distinct values the first levels have no robust scale, with whatever number of levels.
        coarse = efficiency < 1 and bool(nu[~usable, 0].isnan().any())
        remedy = "give `efficiency=1` (no --robust) for signals of few distinct values, or " if coarse else ""
        raise ValueError(f"`{argument}`: {what}; {remedy}leave them out or ask for fewer `n_levels`")
    warnings.warn(f"`{argument}`: {what}; their results are NaN and not converged", stacklevel=4)
