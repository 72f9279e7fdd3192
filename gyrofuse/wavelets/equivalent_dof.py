"""Degrees of freedom of wavelet variances, and the laws that turn them into intervals.

Without a model of the noise, a level with `M_j` coefficients of filter length `tau_j` is taken to hold

    eta_j = max(k_j M_j / tau_j, 1),   k_1 = 4/3,   k_j = 280/151 = 1.85 for j >= 2

independent observations: at level 1 what white noise has, which is less there than a random walk has; above, what a
random walk has for large tau, the slowest of the usual gyro errors. That is on the safe side for faster ones (white
noise comes to 3 M_j / tau_j). `gyrofuse.wavelets.pilot` knows better for a given recording.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse._base.results import ConfidenceInterval

_WHITE_NOISE_DEGREES_AT_LEVEL_1 = 4 / 3
_RANDOM_WALK_DEGREES = 280 / 151


def degrees_of_freedom(counts: Tensor) -> Tensor:
    """Equivalent degrees of freedom of wavelet variances.

    Args:
        counts: `(..., level)`, number of coefficients `M_j` of each level.

    Returns:
        `(..., level)`, at least 1.
    """
    levels = torch.arange(1, counts.shape[-1] + 1, dtype=torch.float64, device=counts.device)
    factor = torch.where(levels == 1, _WHITE_NOISE_DEGREES_AT_LEVEL_1, _RANDOM_WALK_DEGREES)
    return (factor * counts * torch.exp2(-levels)).clamp(min=1.0)


def chi_square_interval(variance: Tensor, degrees: Tensor, confidence_level: float = 0.95) -> ConfidenceInterval:
    """Interval of a wavelet variance whose estimate follows a scaled chi-square law.

    `[eta nu / q_{1 - a/2}, eta nu / q_{a/2}]` with the quantiles `q` of chi-square with `eta` degrees of freedom.

    Args:
        variance: Estimates, any shape.
        degrees: Equivalent degrees of freedom, broadcastable to `variance`.
        confidence_level: Probability that the interval holds the true value.

    Returns:
        Limits of the shape of `variance`.
    """
    from scipy import stats

    eta = degrees.detach().cpu().numpy()
    tail = (1 - confidence_level) / 2
    low, high = (torch.as_tensor(stats.chi2.ppf(q, eta)).to(variance) for q in (1 - tail, tail))
    scaled = degrees.to(variance) * variance
    return ConfidenceInterval(scaled / low, scaled / high)


def normal_quantile(probability: float) -> float:
    """Quantile of the standard normal law."""
    return float(torch.special.ndtri(torch.tensor(probability, dtype=torch.float64)))


def t_quantile(degrees: Tensor, confidence_level: float) -> Tensor:
    """Quantile of Student's t for a symmetric interval, of the shape of `degrees`; infinite ones are normal."""
    from scipy import stats

    quantile = stats.t.ppf((1 + confidence_level) / 2, degrees.detach().cpu().numpy())
    return torch.as_tensor(quantile).to(degrees)


def chi_square_tail(statistic: Tensor, degrees: Tensor) -> Tensor:
    """Probability that chi-square of so many degrees of freedom exceeds the statistic; NaN where there are none."""
    tail = torch.special.gammaincc(torch.where(degrees > 0, degrees, 1) / 2, statistic.clamp(min=0) / 2)
    return torch.where(degrees > 0, tail, torch.nan)
