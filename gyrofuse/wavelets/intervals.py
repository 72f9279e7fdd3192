"""Confidence intervals of wavelet variances and cross-covariances, and the laws they rest on.

At a level with many non-overlapping windows the interval follows from the series of products of coefficients itself
(`gyrofuse.wavelets.long_run_variance`), whatever the noise is. At the last levels it is that of a chi-square law, whose
degrees of freedom are those of a model fitted to the recording (`gyrofuse.wavelets.pilot`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse._base.checks import check_confidence_level, check_n_levels, check_signal
from gyrofuse._base.results import ConfidenceInterval
from gyrofuse.wavelets import long_run_variance as series
from gyrofuse.wavelets.moments import Moments, filter_lengths
from gyrofuse.wavelets.pilot import FEWEST_LEVELS, Pilot, fit_pilot


def wavelet_variance_interval(
    signal: Tensor, n_levels: int | None = None, *, confidence_level: float = 0.95
) -> ConfidenceInterval:
    """Intervals of the wavelet variance of every sensor at every level.

    From the series of the squared coefficients where `M_j / tau_j >= 16`, by Student's t for the cube root of the
    variance; else `[eta nu / q_{1-a/2}, eta nu / q_{a/2}]` of chi-square with the `eta_j = 2 nu_j^2 / Var nu_j` of a
    pilot model. Indicative only at levels with fewer than two observations (about `M_j < tau_j`), and at the last
    levels of a slow process that is not Gaussian (a few dozen steps or switches in the recording).

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
    moments = Moments.of(items, n_levels, series.bin_length(n_samples, n_sensors))
    total, wccv = moments.totals, moments.wccv  # (item, level, sensor, sensor)
    windows = total / filter_lengths(n_levels).to(wccv)[:, None, None]
    by_series = _by_series(moments, windows, confidence_level)
    known = total > 0
    complete = known.flatten(2).all(-1).sum(-1)  # levels that every pair has, per item
    by_model = torch.full_like(wccv, torch.nan), torch.full_like(wccv, torch.nan)
    for n_known in complete[complete > 0].unique().tolist():
        alike = complete == n_known
        pilot = fit_pilot(_regular(wccv[alike, :n_known]), n_samples)
        modelled = _by_model(pilot, wccv[alike, :n_known], confidence_level)
        for limit, values in zip(by_model, modelled, strict=True):
            limit[alike, :n_known] = values
    fewest = torch.full_like(windows, series.MANY_WINDOWS)
    fewest.diagonal(dim1=-2, dim2=-1).fill_(series.FEWEST_WINDOWS)
    low, high = (torch.where(windows >= fewest, s, m) for s, m in zip(by_series, by_model, strict=True))
    changing = wccv.diagonal(dim1=-2, dim2=-1) > 0
    known &= changing[..., :, None] & changing[..., None, :]
    return torch.where(known, low, torch.nan), torch.where(known, high, torch.nan)


def _regular(wccv: Tensor) -> Tensor:
    """Covariances that a model can be fitted to.

    Of arrays with copied or stuck sensors, and of recordings too short for their number of sensors, only the variances
    on the diagonal are kept; a variance of zero is replaced by that of unit white noise.
    """
    nu = wccv.diagonal(dim1=-2, dim2=-1)
    white = torch.exp2(-torch.arange(1, nu.shape[-2] + 1, dtype=nu.dtype, device=nu.device))
    own = torch.where(nu > 0, nu, white[:, None])
    size = own.rsqrt()
    # The mean correlation over the levels that any pilot is fitted to.
    together = (size[..., :, None] * wccv * size[..., None, :])[:, -FEWEST_LEVELS:].mean(1)
    smallest = torch.linalg.eigvalsh(torch.where(together.isfinite(), together, 0.0))[:, 0]
    # An eigenvalue of 1e-10 of a correlation matrix is zero but for the rounding of sums over the recording.
    singular = (smallest <= 1e-10) | (nu <= 0).any(-1).any(-1)
    return torch.where(singular[:, None, None, None], torch.diag_embed(own), wccv)


def _by_series(moments: Moments, windows: Tensor, confidence_level: float) -> tuple[Tensor, Tensor]:
    cosines, wccv = series.n_basis(windows), moments.wccv
    # Every entry is a series of its own: (item, level, sensor, sensor, bin, 1)
    sums, counts = moments.sums.movedim(1, -1), moments.counts.movedim(1, -1)
    variance = series.mean_covariance(sums[..., None], counts, cosines)[..., 0, 0]
    margin = t_quantile(cosines, confidence_level) * variance.sqrt()
    low, high = wccv - margin, wccv + margin
    # For variances the limits are those of the cube root, which is nearly normal (Wilson & Hilferty).
    nu = wccv.diagonal(dim1=-2, dim2=-1).clamp(min=0)
    root, step = nu.pow(1 / 3), margin.diagonal(dim1=-2, dim2=-1) / (3 * nu.pow(2 / 3))
    low.diagonal(dim1=-2, dim2=-1).copy_((root - step).clamp(min=0).pow(3))
    high.diagonal(dim1=-2, dim2=-1).copy_((root + step).pow(3))
    return low, high


def _by_model(pilot: Pilot, wccv: Tensor, confidence_level: float) -> tuple[Tensor, Tensor]:
    n_sensors = wccv.shape[-1]
    identity = torch.eye(n_sensors, dtype=wccv.dtype, device=wccv.device)
    nu = wccv.diagonal(dim1=-2, dim2=-1)  # (item, level, sensor)
    own = chi_square_interval(nu, pilot.dof(identity.expand(len(wccv), -1, -1)), confidence_level)
    first, second = torch.triu_indices(n_sensors, n_sensors, 1, device=wccv.device)
    limits = tuple(torch.diag_embed(limit) for limit in own)
    if n_sensors == 1:
        return limits[0], limits[1]
    # One scale for all levels is enough: it only has to give the two signals similar variances.
    scale = nu.mean(1).sqrt()  # s: (item, sensor)
    a, b = (identity[index] / scale[:, index, None] for index in (first, second))  # (item, pair, sensor)
    pair = scale[:, first] * scale[:, second] / 4  # (item, pair)
    halves = []
    for combination in (a + b, a - b):
        variance = torch.einsum("npi,njik,npk->njp", combination, wccv, combination)
        halves.append((variance, *chi_square_interval(variance, pilot.dof(combination), confidence_level)))
    (u, u_low, u_high), (v, v_low, v_high) = halves
    difference = u - v
    low = pair[:, None] * (difference - torch.hypot(u - u_low, v_high - v))
    high = pair[:, None] * (difference + torch.hypot(u_high - u, v - v_low))
    for limit, values in zip(limits, (low, high), strict=True):
        limit[..., first, second] = values
        limit[..., second, first] = values
    return limits[0], limits[1]


def equivalent_dof(counts: Tensor) -> Tensor:
    """Equivalent degrees of freedom (EDF) of wavelet variances, without a model of the noise.

        eta_j = max(k_j M_j / tau_j, 1),   k_1 = 4/3,   k_j = 280/151 = 1.85 for j >= 2

    At level 1 the EDF of white noise, which are fewer there than those of a random walk; above, those of a random walk
    for large `tau`, the slowest of the usual gyro errors. Faster errors have more (white noise `3 M_j / tau_j`), so
    that intervals are on the wide side. `gyrofuse.wavelets.pilot` has the EDF of a model that is fitted to the
    recording.

    Args:
        counts: `(..., level)`, number of coefficients `M_j` of each level.

    Returns:
        `(..., level)`, at least 1.
    """
    levels = torch.arange(1, counts.shape[-1] + 1, dtype=torch.float64, device=counts.device)
    factor = torch.where(levels == 1, 4 / 3, 280 / 151)
    return (factor * counts * torch.exp2(-levels)).clamp(min=1.0)


def chi_square_interval(variance: Tensor, dof: Tensor, confidence_level: float = 0.95) -> ConfidenceInterval:
    """Interval of a wavelet variance whose estimate follows a scaled chi-square law.

    `[eta nu / q_{1 - a/2}, eta nu / q_{a/2}]` with the quantiles `q` of chi-square with `eta` degrees of freedom.

    Args:
        variance: Estimates, any shape.
        dof: Equivalent degrees of freedom, broadcastable to `variance`.
        confidence_level: Probability that the interval holds the true value.

    Returns:
        Limits of the shape of `variance`.
    """
    from scipy import stats

    eta = dof.detach().cpu().numpy()
    tail = (1 - confidence_level) / 2
    low, high = (torch.as_tensor(stats.chi2.ppf(q, eta)).to(variance) for q in (1 - tail, tail))
    scaled = dof.to(variance) * variance
    return ConfidenceInterval(scaled / low, scaled / high)


def normal_quantile(probability: float) -> float:
    """Quantile of the standard normal law.

    Args:
        probability: Probability below the quantile.
    """
    return float(torch.special.ndtri(torch.tensor(probability, dtype=torch.float64)))


def t_quantile(dof: Tensor, confidence_level: float) -> Tensor:
    """Quantile of Student's t for a symmetric interval.

    Args:
        dof: Degrees of freedom, any shape; infinite ones give the normal quantile.
        confidence_level: Probability within plus and minus the quantile.

    Returns:
        The shape of `dof`.
    """
    from scipy import stats

    quantile = stats.t.ppf((1 + confidence_level) / 2, dof.detach().cpu().numpy())
    return torch.as_tensor(quantile).to(dof)


def chi_square_tail(statistic: Tensor, dof: Tensor) -> Tensor:
    """Probability that a chi-square variable exceeds the statistic.

    Args:
        statistic: Any shape.
        dof: Degrees of freedom, the same shape.

    Returns:
        The same shape; NaN without degrees of freedom.
    """
    tail = torch.special.gammaincc(torch.where(dof > 0, dof, 1) / 2, statistic.clamp(min=0) / 2)
    return torch.where(dof > 0, tail, torch.nan)
