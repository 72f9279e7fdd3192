"""Wavelet variance that a few wild samples do not move: a bounded M-scale of the Haar coefficients.

With `chi(x) = x^2 (1 - x^2/c^2)^4` for `|x| < c` and 0 beyond, the square of Tukey's biweight, the robust wavelet
variance of a level is the `nu` that solves

    (1/M) sum_t chi(W_t / sqrt(nu)) = a(c),   a(c) = E chi(Z),   Z ~ N(0, 1)

so that Gaussian coefficients have the variance that they have. Its asymptotic efficiency, for independent ones, is

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

# Below, the biweight throws away the shoulders of the Gaussian itself: samples of a hundred often have no solution, and
# at c = 2.5 it says nothing of the scale.
_LEAST_EFFICIENCY = 0.5
_LEAST_C, _LARGEST_C = 3.0, 1e3
# Beyond ten standard deviations there is nothing to integrate.
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(200)
_FARTHEST = 10.0
_N_HERMITE = 12

# Coefficients worked on together, and items whose levels are held together: megabytes, not recordings.
_CHUNK, _GROUP = 2**16, 2**22
_MOST_STEPS, _PRECISION, _ACCEPTED = 60, 1e-12, 1e-6
# Newton's step is taken where the sum is this close to `a`; the fixed point, slower but monotone, leads there.
_NEAR = 0.15
_MAD = 1.482602218505602  # of a Gaussian, standard deviation / median of |W|


def robust_wavelet_variance(signal: Tensor, n_levels: int | None = None, *, efficiency: float = 0.6) -> Tensor:
    """Robust wavelet variance of every sensor at every level, consistent for Gaussian noise.

    `(1/M_j) sum_t chi(W_{j,t} / sqrt(nu_j)) = a` with the squared biweight `chi`, solved from the median of `|W|` on.
    What is bounded is the influence of a coefficient, and one wild sample spoils `2**j` of them at level `j`. Each per
    cent of them takes some 2 % off, and a quarter is too many (at an efficiency of 0.6): spikes in one of `n` samples
    leave the levels with `2**j` well below `n / 10` alone, further up they are noise like any other.
    Coefficients that are not Gaussian have another scale: a tone alone comes out 40 % above
    its wavelet variance, 10 % where noise is as strong, and a ramp as strong as the noise 14 %. No gradients.

    Args:
        signal: `(..., sensor, time)`, any unit, NaN = missing sample.
        n_levels: Number of levels J; the largest with `2**J <= time` by default.
        efficiency: Variance of the wavelet variance of independent Gaussian coefficients over that of the robust one,
            0.5 to 1. Less is more robust; 1 is the classic `wavelet_variance`.

    Returns:
        `(..., level, sensor)`, unit of the signal squared. NaN, with a warning, where no scale fits: no coefficient,
        or most of them zero, as at the first levels of a signal of few distinct values. 0 where all of them are, as in
        `wavelet_variance`.

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
    found = [_levels(some, n_levels, biweight) for some in items.split(max(1, _GROUP // length))]
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

    Raises:
        TypeError: Not a number.
        ValueError: Out of range.
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"`efficiency`: expected a number between 0.5 and 1 such as 0.6, got {type(value).__name__}")
    number = float(value)
    if not _LEAST_EFFICIENCY <= number <= 1:
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
    """The squared biweight of a given efficiency, by bisection in `ln c`: where `c >= 3` it grows with `c`."""
    low, high = math.log(_LEAST_C), math.log(_LARGEST_C)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if biweight(math.exp(middle)).efficiency < efficiency else (low, middle)
    return biweight(math.exp(high))


def biweight(c: float) -> Biweight:
    """The squared biweight that ends at `c`."""
    half = min(c, _FARTHEST) / 2
    x = half * (1 + _NODES)
    density = _NODE_WEIGHTS * half * np.sqrt(2 / np.pi) * np.exp(-x * x / 2)  # of both signs
    chi = x**2 * (1 - (x / c) ** 2) ** 4
    mean = chi @ density
    # Normalised Hermite polynomials: sqrt(n + 1) h_{n+1} = x h_n - sqrt(n) h_{n-1}.
    polynomials = [np.ones_like(x), x]
    for n in range(1, 2 * _N_HERMITE):
        polynomials.append((x * polynomials[n] - math.sqrt(n) * polynomials[n - 1]) / math.sqrt(n + 1))
    squares = np.array([((chi * polynomials[2 * k]) @ density) ** 2 for k in range(1, _N_HERMITE + 1)])
    return Biweight(
        c=c,
        mean=float(mean),
        efficiency=float(squares[0] / (chi**2 @ density - mean**2)),
        orders=tuple((squares / squares[0]).tolist()),
    )


def _levels(items: Tensor, n_levels: int, biweight: Biweight) -> Tensor:
    """Robust wavelet variances `(item, level)`, float64, of items `(item, time)`, one level in memory at a time."""
    known = torch.where(items.isfinite(), items, torch.nan)
    smooth = known - known.nanmean(-1, keepdim=True)
    variances = []
    for level in range(n_levels):
        newest, oldest = smooth[:, 2**level :], smooth[:, : -(2**level)]
        variances.append(m_variance((newest - oldest) / 2, biweight))
        smooth = (newest + oldest) / 2
    return torch.stack(variances, -1)


def m_variance(coefficients: Tensor, biweight: Biweight) -> Tensor:
    """Square of the M-scale `(item,)`, float64, of coefficients `(item, time)`; NaN where there is none.

    The sum falls with the scale around the solution and rises below a wrong one, much smaller, that a redescending
    `chi` has besides. The search starts at the median; few windows may have theirs at the wrong one, and come from
    above then, where every solution lies below.
    """
    counts = coefficients.isfinite().sum(-1).to(torch.float64)
    centre = coefficients.abs().nanmedian(-1).values.to(torch.float64) * _MAD
    filled = coefficients.nan_to_num(nan=0.0)
    highest = filled.square().sum(-1, dtype=torch.float64) / (counts * biweight.mean)
    variance = _solved(filled, counts, centre.square(), biweight)
    unsolved = variance.isnan() & (highest > 0)
    if bool(unsolved.any()):
        variance[unsolved] = _solved(filled[unsolved], counts[unsolved], highest[unsolved], biweight)
    return torch.where(highest == 0, 0.0, variance)


def _solved(coefficients: Tensor, counts: Tensor, start: Tensor, biweight: Biweight) -> Tensor:
    """First solution `(item,)` on the way from a start; NaN where there is none.

    A fixed point step `nu <- nu sum chi / (M a)` moves towards it and never past it; near it, Newton's step in `ln nu`
    takes over.
    """
    log_nu = start.log()
    step = torch.full_like(start, torch.nan)
    for _ in range(_MOST_STEPS):
        total, slope = _sums(coefficients, log_nu, biweight.c) / (counts * biweight.mean)
        excess = total - 1
        newton = (excess.abs() < _NEAR) & (slope < 0)
        step = torch.where(newton, (-excess / slope).clamp(-0.5, 0.5), excess.log1p())
        log_nu = log_nu + step
        if not bool((step.abs() > _PRECISION).any()):
            break
    return torch.where(step.abs() < _ACCEPTED, log_nu.exp(), torch.nan)


def _sums(coefficients: Tensor, log_nu: Tensor, c: float) -> Tensor:
    """`sum_t chi` and its slope in `ln nu`, `(2, item)`."""
    rate = (-log_nu / 2).exp()[:, None]
    total, slope = torch.zeros_like(log_nu), torch.zeros_like(log_nu)
    for part in coefficients.split(max(1, _CHUNK // len(coefficients)), -1):
        share = (part * (rate / c)).square_()  # x^2 / c^2, float64
        weight = (1 - share).clamp_(min=0)
        cubed = (share * weight).mul_(weight).mul_(weight)
        slope -= share.mul_(-5).add_(1).mul_(cubed).sum(-1)
        total += weight.mul_(cubed).sum(-1)
    return c * c * torch.stack([total, slope])
