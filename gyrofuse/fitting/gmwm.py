"""Noise models from wavelet variances: the Generalised Method of Wavelet Moments (GMWM)."""

from __future__ import annotations

import warnings
from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse._base.checks import (
    check_confidence_level,
    check_floating,
    check_length,
    check_signal,
    infinite_where,
    largest_level,
)
from gyrofuse._base.results import named, numbered, place
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.moments.continuous import fit_moments
from gyrofuse.fitting.moments.drift_sign import rising, signed
from gyrofuse.fitting.moments.fit import composition_of
from gyrofuse.fitting.moments.identifiability import remarks
from gyrofuse.fitting.moments.inference import Fit, Inference, either, infer, infer_efficient
from gyrofuse.fitting.moments.profile import profiled
from gyrofuse.fitting.moments.profile_surfaces import MomentSurface, SpectralSurface
from gyrofuse.fitting.moments.records import Records
from gyrofuse.fitting.moments.robust_covariance import check_gaussian
from gyrofuse.fitting.moments.white_kurtosis import white_excess_kurtosis, with_excess_kurtosis
from gyrofuse.fitting.spectral.model_tones import model_tones
from gyrofuse.fitting.spectral.tones import Tones
from gyrofuse.fitting.spectral.whittle import refine_whittle
from gyrofuse.fitting.structure import Composition
from gyrofuse.io.recording import Recording
from gyrofuse.noise.processes import Model
from gyrofuse.wavelets.robust import check_efficiency, robust_wavelet_variance

WEIGHTINGS = ("optimal", "diagonal", "identity", "continuous")
MOMENTS = ("variance", "log")


def fit_gmwm(
    signal: Tensor | Recording,
    model: Model | str,
    *,
    weighting: str | Tensor = "optimal",
    moments: str = "variance",
    confidence_level: float = 0.95,
    n_samples: int | None = None,
    n_levels: int | None = None,
    refine: bool = False,
    efficiency: float = 1.0,
    strict: bool = False,
) -> GMWMResult:
    """Fit a sum of noise processes to the wavelet variance of every sensor.

    `theta = argmin (nu - nu(theta))' Omega (nu - nu(theta))` over the levels ([V] equation 5), with `Omega = V^-1` of
    the fitted model (`optimal`), the reciprocal variances (`diagonal`), the identity, or weights of your own. The
    frequencies of sinusoids come from the signal's spectrum, where they show a thousand times more sharply than in
    wavelet variances; lines of fewer than 30 cycles or hardly above the noise are tested against a noise spectrum
    fitted to the record, and `remarks` say which could be noise, and where the amplitude that the moments ask for is
    more than the spectrum holds. A drift has the sign of the signal's slope; a wavelet variance tells none, and it is
    given as rising. AR1s are given from slow to fast, sinusoids from high to low frequency.

    Intervals are symmetric in logarithms, `atanh phi` and `logit(beta / pi)`. Those of variances at zero, of what is
    known to hardly its order of magnitude, of AR1s that another process could stand for, and of what a straight line
    from the estimate misjudges, such as AR1s that are alike or hardly shorter than the record, are by profile: every
    value with which the best fit is at most `z^2` worse; near zero they hold the truth somewhat more often than stated.
    What cannot be told apart is said in `remarks`.

    Noise is taken for Gaussian but for its white part, whose excess kurtosis, estimated from the signal's differences
    as if its samples were independent, counts in the interval of its variance.

    `Omega` is updated between fits and held in each. With `continuous`, `r' V(theta)^-1 r` is minimised over both, from
    the optimal fit downhill: a large `V` then excuses any residual, and what the last levels decide comes out large. In
    1000 records each of white noise and a random walk of 512, 1024, 2048 samples the walk's mean is 92, 57, 34 % too
    large (optimal: 3, 2, 1 %) and 95 % intervals hold it in 83 to 84 % (94 to 97 %). With 40 000 samples it differs
    from the optimal fit by 0.6 standard deviations (median of 200 records) in a walk, 0.3 in the `phi` of an AR1
    without one, 0.1 or less in the rest. It is for comparison with other software; `optimal` is better.

    With `moments="log"`, `ln nu` is matched with its bias `digamma(eta / 2) - ln(eta / 2)` and the covariance of
    logarithms of chi-squares. In the same records the walk's median is 4, 4, 2 % too large instead of 15, 4, 2 % too
    small; its mean is 24, 11, 5 % too large, its root mean square error 15, 6, 3 % larger, and
    intervals hold the truth as often (95 to 97 %).

    Args:
        signal: `(..., sensor, time)`, NaN = missing sample, or a `Recording`; a sensor with infinite samples is not
            fitted. With `n_samples` given a wavelet variance `(..., level, sensor)` of records that long.
        model: Processes without values, such as `WhiteNoise() + AR1() + RandomWalk()`, or `"WN + AR1 + RW"`.
        weighting: `"optimal"`, `"diagonal"`, `"identity"`, `"continuous"`, or `Omega` as `(level,)` or
            `(level, level)`.
        moments: `"variance"`, or `"log"` with optimal weighting.
        confidence_level: Probability that an interval holds the true value.
        n_samples: Length of the record behind a wavelet variance.
        n_levels: Number of levels J; by default all that hold two windows side by side.
        refine: Go on from the moments to the maximum of the spectral (Whittle) likelihood, which knows the parameters
            a few per cent better; the fit has to start near it, and the signal may have no missing samples. The J test
            is that of the parameters given: of white noise, an AR1 and a random walk without and with a tone it refuses
            4.3 and 4.7 % at 5 % (300 records each of 10 000 samples), 6.0 and 2.8 % (250 records each of 40 000).
        efficiency: 1 for the mean square of the coefficients; below, for `robust_wavelet_variance` of that efficiency
            (as a wavelet variance given must be), with its own covariance in weights, intervals and J test. Gaussian
            processes only: it is not consistent for sinusoids and drifts. Levels hold 16 windows by default. Spikes no
            longer count as white noise, but intervals are those of clean noise: where there is one in 2000 samples or
            more, slow processes come out too large, and the J test tells.
        strict: Raise when an item cannot be fitted, instead of marking it.

    Returns:
        Parameters `(..., sensor, parameter)` with intervals, the fitted model, and how well it fits.

    Raises:
        TypeError: `signal` is not a floating point tensor or a `Recording`.
        ValueError: More parameters than levels, a model with values, bad options, `n_samples` of what is no wavelet
            variance, a sinusoid or a drift with `efficiency` below 1, or no item that can be fitted.

    References:
        [V] section III; S. Guerrier, J. Skaloud, Y. Stebler, M.-P. Victoria-Feser, JASA 108, 2013; for `continuous`
        L. P. Hansen, J. Heaton, A. Yaron, Journal of Business & Economic Statistics 14, 1996.
    """
    recording = signal if isinstance(signal, Recording) else None
    values = signal.signal if isinstance(signal, Recording) else signal
    check_confidence_level(confidence_level)
    if refine and n_samples is not None:
        raise ValueError("`refine`: expected a signal, whose spectrum says more than its wavelet variance, got none")
    if check_efficiency(efficiency) < 1 and refine:
        raise ValueError(
            "`refine`: expected `efficiency=1`, as the likelihood is not robust, got less; use one of them"
        )
    if n_samples is None:
        check_signal("signal", values)
        length = values.shape[-1]
        levels = _levels(n_levels, length, efficiency)
        variance = robust_wavelet_variance(values.detach(), levels, efficiency=efficiency).to(torch.float64)
        variance = infinite_where(values.isinf().any(-1)[..., None, :], variance)
        series = values.detach().reshape(-1, length)
    else:
        check_floating("signal", values)
        length, series = check_length(n_samples, recorded=recording is not None), None
        variance = _given(values, length, n_levels).to(torch.float64)
    *batch, levels, n_sensors = variance.shape
    sensors = recording.sensors if recording else numbered(n_sensors)
    made_of = composition_of(model, held=series is not None)
    if not any(p.gaussian for p in made_of.processes):
        raise ValueError(f"`model`: expected a noise process beside sinusoids and drifts, got {made_of.name}; add WN")
    if efficiency < 1:
        check_gaussian(Model(list(made_of.processes)))
    n_unknown = made_of.n_linear + len(made_of.curved)
    if n_unknown > levels:
        raise ValueError(
            f"`model`: expected at most as many parameters as the {levels} levels, got {n_unknown} in "
            f"{made_of.name}; record longer or leave processes out"
        )
    name, omega = _weighting(weighting, levels)
    _check_moments(moments, name)
    nu = variance.mT.reshape(-1, levels)  # (item, level)
    usable = (nu.isfinite() & (nu > 0)).all(-1)
    if not bool(usable.all()):
        _report(nu, usable, sensors, strict, efficiency)
    records = Records((length,), (levels,), efficiency)
    tones = model_tones(series[usable], made_of) if series is not None else None
    frequencies = None if tones is None else (tones.beta, tones.beta_sd)
    fit = fit_moments(nu[usable], frequencies, records, made_of, omega, moments)
    inference = infer(fit, made_of, confidence_level)
    if refine and series is not None:
        inference = _refined(series[usable], tones, fit, made_of, inference, confidence_level)
    else:
        inference = profiled(inference, MomentSurface(fit, made_of), fit, made_of, confidence_level)
    if series is not None and efficiency == 1:
        kappa = white_excess_kurtosis(series[usable], tones, made_of, inference.estimates.params)
        inference = with_excess_kurtosis(inference, kappa, made_of, length, confidence_level)
    said = remarks(made_of, inference.estimates, length, confidence_level, tones)
    if series is not None:
        estimates = signed(inference.estimates, Model(list(made_of.processes)), rising(series[usable]))
        inference = replace(inference, estimates=estimates)
    return GMWMResult.build(
        inference=inference,
        remarks=said,
        made_of=made_of,
        usable=usable,
        wavelet_variance=nu,
        batch=(*batch, n_sensors),
        records=records,
        weighting=name,
        moments=moments,
        refined=refine,
        confidence_level=confidence_level,
        sensors=tuple(sensors),
        rate=recording.rate if recording else None,
        unit=recording.unit if recording and recording.unit != "unknown" else None,
        axes=recording.axes if recording else (),
    )


def _refined(
    series: Tensor,
    tones: Tones | None,
    fit: Fit,
    made_of: Composition,
    inference: Inference,
    confidence_level: float,
) -> Inference:
    """What the maximum of the spectral likelihood says, and the moments where there is none."""
    whittle = refine_whittle(series, made_of, fit.linear, fit.shape, tones=tones)
    kept = ~whittle.converged
    if bool(kept.any()):
        warnings.warn(
            f"`refine`: {int(kept.sum())} of {len(kept)} fits could not be refined (missing samples, or no maximum "
            "near the moments); they are those of the moments",
            stacklevel=3,
        )
    linear, shape = either(kept, fit.linear, whittle.linear), either(kept, fit.shape, whittle.shape)
    there = replace(fit, linear=linear, shape=shape, converged=torch.ones_like(kept))
    better = infer_efficient(there, made_of, whittle.covariance, whittle.edge_sd, confidence_level)
    likelihood = SpectralSurface(linear, shape, whittle.energy, whittle.count, made_of, series.shape[-1])
    better = profiled(better, likelihood, fit, made_of, confidence_level, ~kept)
    own = profiled(inference, MomentSurface(fit, made_of), fit, made_of, confidence_level, kept)
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
            f"`weighting`: expected one of {', '.join(map(repr, WEIGHTINGS))} or a tensor, got {weighting!r}"
        )
    return weighting, torch.ones(levels, dtype=torch.float64) if weighting == "identity" else weighting


def _check_moments(moments: str, weighting: str) -> None:
    if moments not in MOMENTS:
        raise ValueError(f"`moments`: expected one of {', '.join(map(repr, MOMENTS))}, got {moments!r}")
    if moments == "log" and weighting != "optimal":
        raise ValueError(
            f"`moments`: expected 'log' with `weighting=\"optimal\"`, whose covariance has the logarithms' spread, got "
            f"{weighting!r}; leave one of them out"
        )


def _levels(n_levels: int | None, n_samples: int, efficiency: float) -> int:
    if n_levels is not None:
        return n_levels  # the wavelet variance checks it
    # Two windows side by side; a robust scale wants to see more of them.
    return max(largest_level(n_samples) - (1 if efficiency == 1 else 4), 1)


def _given(values: Tensor, n_samples: int, n_levels: int | None) -> Tensor:
    """A wavelet variance `(..., level, sensor)`, with `n_levels` of its levels."""
    most = largest_level(n_samples)
    if values.shape[-1:] == (n_samples,):
        raise ValueError(
            f"`signal`: expected a wavelet variance (..., level, sensor) with `n_samples`, got shape "
            f"{tuple(values.shape)}, that of a signal; leave out `n_samples`, or give as many sensors one by one"
        )
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


def _report(nu: Tensor, usable: Tensor, sensors: tuple[str, ...], strict: bool, efficiency: float) -> None:
    """Say which items cannot be fitted."""
    bad = (~usable).nonzero()[:, 0].tolist()
    n_sensors = len(sensors)
    places = [f"sensor {place(sensors, divmod(i, n_sensors) if len(nu) > n_sensors else (i,))}" for i in bad]
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
        raise ValueError(f"`signal`: {what}; {remedy}leave them out or ask for fewer `n_levels`")
    warnings.warn(f"`signal`: {what}; their results are NaN and not converged", stacklevel=3)
