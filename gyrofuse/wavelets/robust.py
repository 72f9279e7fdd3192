"""Wavelet variance that a few outliers do not move: a bounded M-scale of the Haar coefficients.

With `chi(x) = x^2 (1 - x^2/c^2)^4` for `|x| < c` and 0 beyond, the square of Tukey's biweight, the robust wavelet
variance of a level is the `nu` that solves

    (1/M) sum_t chi(W_t / sqrt(nu)) = a(c),   a(c) = E chi(Z),   Z ~ N(0, 1)

so that it is consistent for Gaussian coefficients. Its asymptotic efficiency for independent coefficients is

    e(c) = (E[chi(Z) (Z^2 - 1)])^2 / (2 Var chi(Z))

against the mean square, and sets `c`: 0.6 gives 4.400, 0.8 gives 5.449, 0.95 gives 7.879.
"""

from __future__ import annotations

import functools
import math
import warnings
from numbers import Real
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.checks import check_n_levels, check_signal
from gyrofuse.wavelets.covariance import wavelet_variance
from gyrofuse.wavelets.haar import coefficients_by_level

# Number of samples whose levels are held together: 32 MiB, so that a batch of many recordings needs no more memory.
_SAMPLES_AT_ONCE = 4_194_304


def robust_wavelet_variance(signal: Tensor, n_levels: int | None = None, *, efficiency: float = 0.6) -> Tensor:
    """Robust wavelet variance of every sensor at every level, consistent for Gaussian noise.

    `(1/M_j) sum_t chi(W_{j,t} / sqrt(nu_j)) = a` with the squared biweight `chi`, solved from the median of `|W|` on.
    The influence of one coefficient is bounded, and one outlier spoils `2**j` coefficients of level `j`: outliers in
    one of `n` samples leave the levels with `2**j` well below `n / 10` unchanged; at higher levels they count as noise.
    Coefficients that are not Gaussian have another scale than their standard deviation: the result is larger than the
    wavelet variance for tones and ramps. No gradients.

    Args:
        signal: `(..., sensor, time)`, any unit, NaN = missing sample.
        n_levels: Number of levels J; the largest with `2**J <= time` by default.
        efficiency: Variance of the wavelet variance of independent Gaussian coefficients over that of the robust one,
            0.5 to 1. Less is more robust; 1 is the classic `wavelet_variance`.

    Returns:
        `(..., level, sensor)`, unit of the signal squared. NaN, with a warning, where no scale solves the equation: no
        coefficient, or most coefficients zero, as at the first levels of a coarsely quantised signal. 0 where all
        coefficients are 0, as in `wavelet_variance`.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: The shape is not `(..., sensor, time)`, the signal is too short for `n_levels`, or `efficiency` is
            out of range.

    References:
        S. Guerrier, R. Molinari, M.-P. Victoria-Feser, Austrian Journal of Statistics 43, 2014, section 2.
        D. Mondal, D. B. Percival, Annals of the Institute of Statistical Mathematics 64, 2012.
    """
    check_signal("signal", signal)
    n_levels = check_n_levels(n_levels, signal.shape[-1])
    if check_efficiency(efficiency) == 1:
        return wavelet_variance(signal, n_levels)
    biweight = biweight_of(efficiency)
    *batch, n_sensors, length = signal.shape
    items = signal.detach().reshape(-1, length)
    found = [
        torch.stack([m_variance(w, biweight) for w in coefficients_by_level(some, n_levels)], -1)
        for some in items.split(max(1, _SAMPLES_AT_ONCE // length))
    ]
    variance = torch.cat(found)  # (item, level)
    unsolved = int(variance.isnan().sum())
    if unsolved:
        warnings.warn(
            f"no robust scale at {unsolved} of {variance.numel()} levels: NaN there; they hold no complete window (ask "
            "for fewer levels), or are zero for the most part as a coarse quantiser makes them (give `efficiency=1`)",
            stacklevel=2,
        )
    return variance.view(*batch, n_sensors, n_levels).mT.to(signal.dtype)


def check_efficiency(value: float) -> float:
    """Return `value` as a float when it is an efficiency that the biweight can have, or 1.

    Args:
        value: Efficiency. Below 0.5 the biweight cuts off the shoulders of the Gaussian itself, and samples of a
            hundred coefficients often have no solution.

    Raises:
        TypeError: Not a number.
        ValueError: Out of range.
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"`efficiency`: expected a number between 0.5 and 1 such as 0.6, got {type(value).__name__}")
    number = float(value)
    if not 0.5 <= number <= 1:
        raise ValueError(f"`efficiency`: expected 0.5 to 1, got {value!r}; 1 is classic, 0.6 a robust choice")
    return number


class Biweight(NamedTuple):
    """The squared biweight at one tuning constant.

    Attributes:
        c: Coefficients beyond `c` standard deviations do not count.
        mean: `a = E chi(Z)`.
        efficiency: `e(c)`.
        orders: `(a_2k / a_2)^2` for k = 1, 2, ..., of its expansion in normalised Hermite polynomials of degree `2k`.
    """

    c: float
    mean: float
    efficiency: float
    orders: tuple[float, ...]


@functools.lru_cache(maxsize=32)
def biweight_of(efficiency: float) -> Biweight:
    """The squared biweight of a given efficiency, by bisection in `ln c`: where `c >= 3` it grows with `c`.

    Args:
        efficiency: `e(c)`, 0.5 or more (`c = 3` has less) and below 1 (which `c = 1000` reaches to 2e-10).
    """
    low, high = math.log(3.0), math.log(1e3)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if biweight(math.exp(middle)).efficiency < efficiency else (low, middle)
    return biweight(math.exp(high))


def biweight(c: float) -> Biweight:
    """The squared biweight with its expansion in Hermite polynomials.

    Args:
        c: Tuning constant, in standard deviations.
    """
    # Gauss-Legendre up to ten standard deviations, beyond which the density is below 1e-22.
    nodes, node_weights = np.polynomial.legendre.leggauss(200)
    half = min(c, 10.0) / 2
    x = half * (1 + nodes)
    n_orders = 12  # even Hermite polynomials, whose coefficients have fallen to 2e-4 of the first by then
    density = node_weights * half * np.sqrt(2 / np.pi) * np.exp(-x * x / 2)  # of both signs
    chi = x**2 * (1 - (x / c) ** 2) ** 4
    mean = chi @ density
    # Normalised Hermite polynomials: sqrt(n + 1) h_{n+1} = x h_n - sqrt(n) h_{n-1}.
    polynomials = [np.ones_like(x), x]
    for n in range(1, 2 * n_orders):
        polynomials.append((x * polynomials[n] - math.sqrt(n) * polynomials[n - 1]) / math.sqrt(n + 1))
    squares = np.array([((chi * polynomials[2 * k]) @ density) ** 2 for k in range(1, n_orders + 1)])
    return Biweight(
        c=c,
        mean=float(mean),
        efficiency=float(squares[0] / (chi**2 @ density - mean**2)),
        orders=tuple((squares / squares[0]).tolist()),
    )


def m_variance(coefficients: Tensor, biweight: Biweight) -> Tensor:
    """Square of the M-scale of coefficients.

    Around the solution the sum falls with the scale. A redescending `chi` has a second, wrong solution at a much
    smaller scale. The search starts at the median; where the median of few coefficients leads to no solution, it starts
    again from above all solutions.

    Args:
        coefficients: `(item, time)`, NaN where missing.
        biweight: The function `chi`.

    Returns:
        `(item,)`, float64; NaN without a solution.
    """
    counts = coefficients.isfinite().sum(-1).to(torch.float64)
    # 1.4826 is the standard deviation of a Gaussian over the median of its absolute value.
    centre = coefficients.abs().nanmedian(-1).values.to(torch.float64) * 1.482602218505602
    filled = coefficients.nan_to_num(nan=0.0)
    highest = filled.square().sum(-1, dtype=torch.float64) / (counts * biweight.mean)
    variance = _solved(filled, counts, centre.square(), biweight)
    unsolved = variance.isnan() & (highest > 0)
    if bool(unsolved.any()):
        variance[unsolved] = _solved(filled[unsolved], counts[unsolved], highest[unsolved], biweight)
    return torch.where(highest == 0, 0.0, variance)


def _solved(
    coefficients: Tensor,
    counts: Tensor,
    start: Tensor,
    biweight: Biweight,
    *,
    most_steps: int = 60,
    precision: float = 1e-12,
    accepted: float = 1e-6,
    near: float = 0.15,
) -> Tensor:
    """First solution `(item,)` on the way from a start; NaN where there is none.

    A fixed point step `nu <- nu sum chi / (M a)` moves towards the solution and never past it; near the solution,
    Newton's step in `ln nu` is taken.

    Args:
        coefficients: `(item, time)`, 0 where missing.
        counts: Number of coefficients, `(item,)`.
        start: First value of `nu`, `(item,)`.
        biweight: The function `chi`.
        most_steps: Number of steps at most; ten are usual.
        precision: Step in `ln nu` at which the search ends, some thousand roundings.
        accepted: Last step in `ln nu` of what counts as a solution, far below the sampling error of any variance.
        near: Relative distance of the sum from `a` within which Newton's step is safe.
    """
    log_nu = start.log()
    step = torch.full_like(start, torch.nan)
    for _ in range(most_steps):
        total, slope = _sums(coefficients, log_nu, biweight.c) / (counts * biweight.mean)
        excess = total - 1
        newton = (excess.abs() < near) & (slope < 0)
        step = torch.where(newton, (-excess / slope).clamp(-0.5, 0.5), excess.log1p())
        log_nu = log_nu + step
        if not bool((step.abs() > precision).any()):
            break
    return torch.where(step.abs() < accepted, log_nu.exp(), torch.nan)


def _sums(coefficients: Tensor, log_nu: Tensor, c: float) -> Tensor:
    """`sum_t chi` and its slope in `ln nu`, `(2, item)`."""
    rate = (-log_nu / 2).exp()[:, None]
    total, slope = torch.zeros_like(log_nu), torch.zeros_like(log_nu)
    for part in coefficients.split(max(1, 65_536 // len(coefficients)), -1):  # what fits the cache of one core
        share = (part * (rate / c)).square_()  # x^2 / c^2, float64
        weight = (1 - share).clamp_(min=0)
        cubed = (share * weight).mul_(weight).mul_(weight)
        slope -= share.mul_(-5).add_(1).mul_(cubed).sum(-1)
        total += weight.mul_(cubed).sum(-1)
    return c * c * torch.stack([total, slope])
