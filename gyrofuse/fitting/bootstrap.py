"""Parametric bootstrap of moment fits: the same fit to records simulated from the fitted model."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive_integer, own_generator
from gyrofuse._base.chunks import items_at_once
from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import ConfidenceInterval, Result, scattered, sensor_label
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.moments.drift_sign import drifts_of
from gyrofuse.fitting.moments.fit import fit_batch
from gyrofuse.fitting.moments.inference import Fit, Inference, infer, infer_efficient
from gyrofuse.fitting.moments.white_kurtosis import white_excess_kurtosis, with_excess_kurtosis
from gyrofuse.fitting.spectral.model_tones import model_tones
from gyrofuse.fitting.spectral.whittle import refine_whittle
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.processes import Process
from gyrofuse.wavelets.robust import robust_wavelet_variance

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Fewest resamples: the 2.5 % quantile of fewer lies beyond the smallest of them.
_FEWEST = 20


@dataclass(frozen=True, eq=False, repr=False)
class GMWMBootstrap(Result):
    """Fits to simulated records beside the fit they were simulated from; `...` are the leading dimensions of the
    signal.

    Attributes:
        param_names: Names of the parameters.
        params: Estimates `(..., sensor, parameter)` that were simulated from.
        bias: Mean of the resampled estimates less the estimate, `(..., sensor, parameter)`.
        std_err: Standard deviation of the resampled estimates, the same; NaN of fewer than two.
        percentile: Interval between quantiles of the resampled estimates.
        studentized: Interval by quantiles of `(u* - u) / sd*`, with `u` the logarithm of variances and amplitudes,
            `atanh phi`, `logit(beta / pi)`. It is that of the percentiles where a standard deviation is unknown, as in
            resamples without one of the processes, in more of them than an interval leaves on one side.
        confidence_level: Probability that either interval holds the true value.
        p_value: P value of the test that the model is complete, `(..., sensor)`: share of resamples whose J statistic
            is at least that of the fit, `(1 + number) / (1 + resamples)`. It holds for any weighting but the identity,
            whose poor estimates make it reject complete models too often.
        n_resamples: Number of records simulated for each item.
        n_failed: Number of them that could not be fitted and are left out, `(..., sensor)`.
        sensors: Names of the sensors.
    """

    param_names: tuple[str, ...]
    params: Tensor
    bias: Tensor
    std_err: Tensor
    percentile: ConfidenceInterval
    studentized: ConfidenceInterval
    confidence_level: float
    p_value: Tensor
    n_resamples: int
    n_failed: Tensor
    sensors: tuple[str, ...]

    std = RenamedAttribute("std_err")
    _batched = ("params", "bias", "std_err", "percentile", "studentized", "p_value", "n_failed")
    _keys: ClassVar = {"std_err": "std"}

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions before the sensors; `()` for a single array."""
        return tuple(self.params.shape[:-2])

    def summary(self) -> str:
        """Bias, spread and interval of every parameter, sensor by sensor, or why there are none."""
        level = f"{100 * self.confidence_level:g} % studentized"
        lines = [f"Parametric bootstrap of a GMWM fit: {self.n_resamples} resamples"]
        for index in itertools.product(*map(range, self.params.shape[:-1])):
            lines += ["", f"sensor {sensor_label(self.sensors, index)}: {self._head(index)}"]
            if not bool(self.params[index].isfinite().all()):
                continue
            lines.append(f"  {'parameter':<24}{'estimate':>13}{'bias':>13}{'std':>13}  {level:^29}")
            columns = (self.params, self.bias, self.std_err, *self.studentized)
            for name, *row in zip(self.param_names, *(column[index].tolist() for column in columns), strict=True):
                value, bias, std, low, high = row
                limits = f"[{low:>13.6g}, {high:>13.6g}]" if math.isfinite(low) else f"{'-':^29}"
                note = "  at its limit: see the interval of the fit" if value == 0 else ""
                shown = (f"{number:>13.3g}" if math.isfinite(number) else f"{'-':>13}" for number in (bias, std))
                lines.append(f"  {name:<24}{value:>13.6g}{''.join(shown)}  {limits}{note}")
        return "\n".join(lines)

    def _head(self, index: tuple[int, ...]) -> str:
        """The p-value of one sensor, or why there is none, and how many resamples were lost."""
        n_failed = int(self.n_failed[index])
        if not bool(self.params[index].isfinite().all()):
            return "not fitted, so that there is nothing to resample"
        if n_failed == self.n_resamples:
            return f"none of {n_failed} resamples could be fitted; the fit stands alone"
        return f"p = {self.p_value[index].item():.2g}" + (f", {n_failed} not fitted" if n_failed else "")

    def plot(self, ax: Axes | None = None, *, index: tuple[int, ...] | None = None) -> Axes:
        """Draw bias and both intervals of one sensor's parameters, less the estimates, in standard deviations.

        Args:
            ax: Axes to draw on; new ones by default.
            index: Index of the sensor among the leading dimensions; the first by default.

        Returns:
            The axes.
        """
        from gyrofuse.fitting.plots import plot_resampled

        index = (0,) * (self.params.ndim - 1) if index is None else index
        own, std = self.params[index], self.std_err[index]
        known = std > 0  # a variance at zero in every resample has no scale
        percentile, studentized = (
            tuple(((limit[index] - own) / std)[known] for limit in interval)
            for interval in (self.percentile, self.studentized)
        )
        names = [name for name, there in zip(self.param_names, known.tolist(), strict=True) if there]
        bias = (self.bias[index] / std)[known]
        return plot_resampled(names, bias, percentile, studentized, percent=100 * self.confidence_level, ax=ax)


def bootstrap_gmwm(
    result: GMWMResult,
    n_resamples: int = 200,
    *,
    weighting: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> GMWMBootstrap:
    """Fit records simulated from a fitted model as the signal was fitted.

    The records are Gaussian, as long as the signal and without gaps, and the frequencies of sinusoids are estimated
    from their spectra. A variance estimated as zero is zero in all of them, so that its bootstrap interval is void:
    that of the fit itself is valid. Memory grows with the number of resamples by `resample x parameter` estimates only.

    Args:
        result: Result of `fit_gmwm`.
        n_resamples: Number of records for each item; 200 give standard errors within a tenth, intervals need 1000.
        weighting: Weights `Omega`, where the fit was given weights of its own.
        generator: Source of randomness; by default a fresh one.

    Returns:
        Intervals, bias and the p-value of the fit.

    Raises:
        TypeError: `result` is none of `fit_gmwm`.
        ValueError: Fewer than 20 resamples, weights missing or given to a fit that had none, or nothing was fitted.

    References:
        B. Efron, R. J. Tibshirani, An Introduction to the Bootstrap, 1993, chapters 12 and 13.
    """
    if not isinstance(result, GMWMResult):
        raise TypeError(
            f"`result`: expected a GMWMResult of fit_gmwm, got {type(result).__name__}; of a joint fit give `.joint`"
        )
    n_resamples = check_positive_integer("n_resamples", n_resamples)
    if n_resamples < _FEWEST:
        raise ValueError(f"`n_resamples`: expected at least {_FEWEST}, got {n_resamples}; quantiles need them")
    if (weighting is None) == (result.weighting == "given"):
        raise ValueError(
            f"`weighting`: expected the weights exactly where the fit was given its own, got a fit with weighting "
            f"{result.weighting!r} and {'none' if weighting is None else 'weights'}; give those of the fit"
        )
    levels = result.wavelet_variance.shape[-2]
    omega: str | Tensor = result.weighting if weighting is None else weighting.to(torch.float64)
    if omega == "identity":
        omega = torch.ones(levels, dtype=torch.float64)
    params = result.params.flatten(0, -2)  # (item, parameter)
    usable = params.isfinite().all(-1)
    if not bool(usable.any()):
        raise ValueError("`result`: expected at least one fitted sensor, got none; fit another signal or model")
    generator = own_generator(generator, params.device)
    model = result.model.with_params(params[usable])
    structure = ModelStructure(model.processes, held=True)
    n_items = int(usable.sum())
    size = items_at_once(n_items * result.n_samples)
    drawn = []
    for first in range(0, n_resamples, size):
        some = min(size, n_resamples - first)
        records = model.simulate(result.n_samples, batch=(some,), generator=generator)  # (resample, item, time)
        drawn.append(_fitted(records, result, structure, omega))
    again, spread, distance = (torch.cat(parts) for parts in zip(*drawn, strict=True))
    # Moments hold squares of slopes: what falls is resampled as if it rose, and turned back at the end.
    turn = torch.where(drifts_of(model).to(params.device) & (params[usable] < 0), -1.0, 1.0).to(torch.float64)
    own = params[usable] * turn

    failed = ~again.isfinite().all(-1)
    n_failed = failed.sum(0)
    again = torch.where(failed[..., None], torch.nan, again)
    mean = again.nanmean(0)
    std = ((again - mean).square().nansum(0) / (n_resamples - n_failed - 1)[:, None]).sqrt()
    std = torch.where((n_resamples - n_failed > 1)[:, None], std, torch.nan)
    tail = (1 - result.confidence_level) / 2
    percentile = again.nanquantile(tail, 0), again.nanquantile(1 - tail, 0)
    studentized = _studentized(structure, own, again, spread, _sds(result, structure, own, usable), tail, percentile)
    larger = (distance >= result.j_statistic.flatten()[usable]).sum(0)
    p_value = torch.where(n_failed < n_resamples, (1 + larger) / (1 + n_resamples - n_failed), torch.nan)

    batch = result.params.shape[:-1]

    def turned(limits: tuple[Tensor, Tensor]) -> ConfidenceInterval:
        low, high = (limit * turn for limit in limits)
        ends = torch.where(turn < 0, high, low), torch.where(turn < 0, low, high)
        return ConfidenceInterval(*(scattered(end, usable, batch) for end in ends))

    return GMWMBootstrap(
        param_names=result.param_names,
        params=result.params,
        bias=scattered((mean - own) * turn, usable, batch),
        std_err=scattered(std, usable, batch),
        percentile=turned(percentile),
        studentized=turned(studentized),
        confidence_level=result.confidence_level,
        p_value=scattered(p_value.to(own), usable, batch),
        n_resamples=n_resamples,
        n_failed=scattered(n_failed, usable, batch, 0),
        sensors=result.sensors,
    )


def _fitted(
    records: Tensor, result: GMWMResult, structure: ModelStructure, omega: str | Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Estimates and standard deviations `(resample, item, parameter)`, J statistics `(resample, item)`."""
    levels, series = result.wavelet_variance.shape[-2], records.flatten(0, 1)
    variance = robust_wavelet_variance(series[:, None], levels, efficiency=result.records.efficiency)[..., 0]
    tones = model_tones(series, structure)
    frequencies = None if tones is None else (tones.beta, tones.beta_sd)
    fit: Fit = fit_batch(variance, frequencies, result.records, structure, omega)
    inference: Inference = infer(fit, structure, result.confidence_level)
    if result.refined:
        refined = refine_whittle(series, structure, fit.linear, fit.shape, tones=tones)
        there = replace(fit, linear=refined.linear, shape=refined.shape)
        inference = infer_efficient(there, structure, refined.covariance, refined.edge_sd, result.confidence_level)
    if result.efficiency == 1:
        kappa = white_excess_kurtosis(series, tones, structure, inference.estimates.params)
        inference = with_excess_kurtosis(inference, kappa, structure, result.n_samples, result.confidence_level)
    params, covariance = inference.estimates.params, inference.estimates.covariance
    spread = _in_unknowns(structure, params, covariance)
    batch = records.shape[:2]
    return params.unflatten(0, batch), spread.unflatten(0, batch), inference.j_statistic.unflatten(0, batch)


def _sds(result: GMWMResult, structure: ModelStructure, params: Tensor, usable: Tensor) -> Tensor:
    return _in_unknowns(structure, params, result.param_cov.flatten(0, -3)[usable])


def _in_unknowns(structure: ModelStructure, params: Tensor, covariance: Tensor) -> Tensor:
    """Standard deviations of `u`, `(item, parameter)`; NaN of what is at zero."""
    sd = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    slope = torch.stack([_slope(*which, value) for which, value in _columns(structure, params)], -1)
    found = sd / slope
    return torch.where((found > 0) & found.isfinite(), found, torch.nan)


def _columns(structure: ModelStructure, params: Tensor) -> list[tuple[tuple[Process, bool], Tensor]]:
    """Each parameter `(...)` with its process and whether it is the nonlinear one."""
    names = [(p, name == p.shape_name) for p in structure.processes for name in p.parameters]
    return list(zip(names, params.unbind(-1), strict=True))


def _slope(process: Process, nonlinear: bool, value: Tensor) -> Tensor:
    """`d value / d u`."""
    return process.unconstrained_slope(process.to_unconstrained(value)) if nonlinear else value


def _transformed(process: Process, nonlinear: bool, value: Tensor) -> Tensor:
    """`u`."""
    return process.to_unconstrained(value) if nonlinear else value.log()


def _back(process: Process, nonlinear: bool, u: Tensor) -> Tensor:
    return process.from_unconstrained(u) if nonlinear else u.exp()


def _studentized(
    structure: ModelStructure,
    own: Tensor,
    again: Tensor,
    spread: Tensor,
    sd: Tensor,
    tail: float,
    percentile: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    limits = []
    for at, (which, value) in enumerate(_columns(structure, own)):
        u = _transformed(*which, value)
        t = (_transformed(*which, again[..., at]) - u) / spread[..., at]
        unknown = (~t.isfinite()).double().mean(0) > tail
        t = torch.where(t.isfinite(), t, torch.nan)
        low = _back(*which, u - t.nanquantile(1 - tail, 0) * sd[:, at])
        high = _back(*which, u - t.nanquantile(tail, 0) * sd[:, at])
        kept = unknown | ~low.isfinite() | ~high.isfinite()
        limits.append((torch.where(kept, percentile[0][:, at], low), torch.where(kept, percentile[1][:, at], high)))
    low, high = (torch.stack(side, -1) for side in zip(*limits, strict=True))
    return low, high
