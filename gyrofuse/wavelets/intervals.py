"""Confidence intervals of wavelet variances and cross-covariances that hold at every level.

A level with many windows side by side tells its own variance by its series (`gyrofuse.wavelets.long_run_variance`),
whatever the noise is. At the last levels a pilot model (`gyrofuse.wavelets.pilot`) says how many independent
observations they hold, and a chi-square law the rest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse._base.checks import check_confidence_level, check_n_levels, check_signal
from gyrofuse._base.results import ConfidenceInterval
from gyrofuse.wavelets import long_run_variance as series
from gyrofuse.wavelets.covariance import binned_products
from gyrofuse.wavelets.equivalent_dof import chi_square_interval, t_quantile
from gyrofuse.wavelets.pilot import Pilot, fit_pilot

# Products of two sensors have heavier tails than squares: a series has to be longer to be believed.
_FEWEST_WINDOWS_OF_PAIRS = 64
_FITTED = 4  # levels at least that a pilot is fitted to, where there are as many
_SINGULAR = 1e-10  # smallest eigenvalue of a mean correlation matrix that is zero but for rounding


def wavelet_variance_interval(
    signal: Tensor, n_levels: int | None = None, *, confidence_level: float = 0.95
) -> ConfidenceInterval:
    """Intervals of the wavelet variance of every sensor at every level.

    Where `M_j / tau_j >= 16` from the series of the squared coefficients, by Student's t on the scale of the cube root,
    else `[eta nu / q_{1-a/2}, eta nu / q_{a/2}]` of chi-square with the `eta_j = 2 nu_j^2 / Var nu_j` of a pilot model.
    Below two observations (`M_j < tau_j`, say) take them as indicative; so too where a slow process that is not
    Gaussian (a few dozen steps or switches in the record) makes the last levels.

    Args:
        signal: `(..., sensor, time)`; NaN = missing sample.
        n_levels: Number of levels J; the largest with `2**J <= time` by default.
        confidence_level: Probability that the interval holds the true value.

    Returns:
        Limits `(..., level, sensor)`, unit of the signal squared; NaN where a level has no complete window, and of a
        sensor that never changes.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: The shape is not `(..., sensor, time)`, or the signal is too short for `n_levels`.

    References:
        Percival & Walden, Wavelet Methods for Time Series Analysis, section 8.4, for `eta`.
    """
    check_signal("signal", signal)
    n_levels = check_n_levels(n_levels, signal.shape[-1])
    check_confidence_level(confidence_level)
    # A sensor on its own is an array of one: (item, sensor = 1, time)
    low, high = _intervals(signal.detach().reshape(-1, 1, signal.shape[-1]), n_levels, confidence_level)
    shape = (*signal.shape[:-1], n_levels)
    return ConfidenceInterval(*(x[..., 0, 0].reshape(shape).mT.to(signal.dtype) for x in (low, high)))


def wavelet_cross_covariance_interval(
    signal: Tensor, n_levels: int | None = None, *, confidence_level: float = 0.95
) -> ConfidenceInterval:
    """Intervals of every entry of the wavelet cross-covariance.

    The diagonal as `wavelet_variance_interval`. A pair has `gamma = s_a s_b (nu_u - nu_v) / 4` with the variances of
    `u, v = x_a / s_a +- x_b / s_b`: from the series of the products where `M_j / tau_j >= 64`, else from the chi-square
    intervals of the two variances, combined as independent.

    Args:
        signal: `(..., sensor, time)`; NaN = missing sample.
        n_levels: Number of levels J; the largest with `2**J <= time` by default.
        confidence_level: Probability that the interval holds the true value.

    Returns:
        Limits `(..., level, sensor, sensor)`, unit of the signal squared; NaN where a level has no complete window, and
        with a sensor that never changes.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: The shape is not `(..., sensor, time)`, or the signal is too short for `n_levels`.

    References:
        G. Y. Zou, A. Donner, Statistics in Medicine 27, 2008 (MOVER).
    """
    check_signal("signal", signal)
    n_levels = check_n_levels(n_levels, signal.shape[-1])
    check_confidence_level(confidence_level)
    low, high = _intervals(signal.detach().reshape(-1, *signal.shape[-2:]), n_levels, confidence_level)
    return ConfidenceInterval(*(x.view(*signal.shape[:-2], *x.shape[1:]).to(signal.dtype) for x in (low, high)))


def _intervals(items: Tensor, n_levels: int, confidence_level: float) -> tuple[Tensor, Tensor]:
    """Limits `(item, level, sensor, sensor)`."""
    n_sensors, n_samples = items.shape[1:]
    sums, counts = binned_products(items, n_levels, series.bin_length(n_samples, n_sensors))
    total = counts.sum(1)
    wccv = sums.sum(1) / total  # (item, level, sensor, sensor)
    windows = total / torch.exp2(torch.arange(1, n_levels + 1, dtype=wccv.dtype, device=wccv.device))[:, None, None]
    by_series = _by_series(sums, counts, wccv, windows, confidence_level)
    known = total > 0
    complete = known.flatten(2).all(-1).sum(-1)  # levels that every pair has, per item
    by_model = torch.full_like(wccv, torch.nan), torch.full_like(wccv, torch.nan)
    for n_known in complete[complete > 0].unique().tolist():
        alike = complete == n_known
        pilot = fit_pilot(_regular(wccv[alike, :n_known]), n_samples)
        modelled = _by_model(pilot, wccv[alike, :n_known], confidence_level)
        for limit, values in zip(by_model, modelled, strict=True):
            limit[alike, :n_known] = values
    fewest = torch.full_like(windows, _FEWEST_WINDOWS_OF_PAIRS)
    fewest.diagonal(dim1=-2, dim2=-1).fill_(series.FEWEST_WINDOWS)
    low, high = (torch.where(windows >= fewest, s, m) for s, m in zip(by_series, by_model, strict=True))
    changing = wccv.diagonal(dim1=-2, dim2=-1) > 0
    known &= changing[..., :, None] & changing[..., None, :]
    return torch.where(known, low, torch.nan), torch.where(known, high, torch.nan)


def _regular(wccv: Tensor) -> Tensor:
    """Covariances that a model can be fitted to: of arrays with copies or stuck sensors, and of records too short for
    their number of sensors, each sensor's own variance alone; of one that has none, that of white noise.
    """
    nu = wccv.diagonal(dim1=-2, dim2=-1)
    white = torch.exp2(-torch.arange(1, nu.shape[-2] + 1, dtype=nu.dtype, device=nu.device))
    own = torch.where(nu > 0, nu, white[:, None])
    size = own.rsqrt()
    # The levels that any pilot is fitted to.
    together = (size[..., :, None] * wccv * size[..., None, :])[:, -_FITTED:].mean(1)
    smallest = torch.linalg.eigvalsh(torch.where(together.isfinite(), together, 0.0))[:, 0]
    singular = (smallest <= _SINGULAR) | (nu <= 0).any(-1).any(-1)
    return torch.where(singular[:, None, None, None], torch.diag_embed(own), wccv)


def _by_series(
    sums: Tensor, counts: Tensor, wccv: Tensor, windows: Tensor, confidence_level: float
) -> tuple[Tensor, Tensor]:
    terms = series.number_of_terms(windows)
    # Every entry is a series of its own: (item, level, sensor, sensor, bin, 1)
    variance = series.mean_covariance(sums.movedim(1, -1)[..., None], counts.movedim(1, -1), terms)[..., 0, 0]
    sd = t_quantile(terms, confidence_level) * variance.sqrt()
    low, high = wccv - sd, wccv + sd
    # A variance on the scale of the cube root, on which chi-square is nearly normal (Wilson & Hilferty).
    nu = wccv.diagonal(dim1=-2, dim2=-1).clamp(min=0)
    root, step = nu.pow(1 / 3), sd.diagonal(dim1=-2, dim2=-1) / (3 * nu.pow(2 / 3))
    low.diagonal(dim1=-2, dim2=-1).copy_((root - step).clamp(min=0).pow(3))
    high.diagonal(dim1=-2, dim2=-1).copy_((root + step).pow(3))
    return low, high


def _by_model(pilot: Pilot, wccv: Tensor, confidence_level: float) -> tuple[Tensor, Tensor]:
    n_sensors = wccv.shape[-1]
    identity = torch.eye(n_sensors, dtype=wccv.dtype, device=wccv.device)
    nu = wccv.diagonal(dim1=-2, dim2=-1)  # (item, level, sensor)
    own = chi_square_interval(nu, pilot.degrees_of_freedom(identity.expand(len(wccv), -1, -1)), confidence_level)
    first, second = torch.triu_indices(n_sensors, n_sensors, 1, device=wccv.device)
    limits = tuple(torch.diag_embed(limit) for limit in own)
    if n_sensors == 1:
        return limits[0], limits[1]
    # One scale for all levels is as good as one for each: it only has to make u and v alike in size.
    scale = nu.mean(1).sqrt()  # s: (item, sensor)
    a, b = (identity[index] / scale[:, index, None] for index in (first, second))  # (item, pair, sensor)
    pair = scale[:, first] * scale[:, second] / 4  # (item, pair)
    halves = []
    for combination in (a + b, a - b):
        variance = torch.einsum("npi,njik,npk->njp", combination, wccv, combination)
        degrees = pilot.degrees_of_freedom(combination)
        halves.append((variance, *chi_square_interval(variance, degrees, confidence_level)))
    (u, u_low, u_high), (v, v_low, v_high) = halves
    difference = u - v
    low = pair[:, None] * (difference - torch.hypot(u - u_low, v_high - v))
    high = pair[:, None] * (difference + torch.hypot(u_high - u, v - v_low))
    for limit, values in zip(limits, (low, high), strict=True):
        limit[..., first, second] = values
        limit[..., second, first] = values
    return limits[0], limits[1]
