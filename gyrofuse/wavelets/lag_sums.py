"""How wavelet moments of a Gaussian process vary together in a record of finite length, exactly.

For a sum of independent components with matrices `Theta_k` the coefficients have the cross-covariances
`sum_k Theta_k,ac s^k_jl(lag)`, and the wavelet cross-covariances of levels `j` and `l`

    Cov(gamma_ab,j, gamma_cd,l) = sum_km Q_jl[k,m] (Theta_k,ac Theta_m,bd + Theta_k,ad Theta_m,bc)
    Q_jl[k,m] = sum_lag n_jl(lag) s^k_jl(lag) s^m_jl(lag) / (M_j M_l)

with `n_jl(lag)` pairs of coefficients that far apart. `Q` depends on the length and the components only.

A Haar coefficient is a second difference of the cumulative sum of the signal, `W_t = (C_t - 2 C_{t-h} + C_{t-2h}) / 2h`
with `h = tau/2`, so that nine values of one function, the generalised covariance `g` of `C`, give `s_jl(lag)`: `g` is
any function with `-(g(l+1) - 2 g(l) + g(l-1))` the (generalised) autocovariance of the signal.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Number of lags between two corners of s(lag) up to which they are summed one by one; the sum over a wider stretch is
# an integral by Gauss-Legendre with 8 nodes, right to 1e-5 of an entry (3000 samples, 9 levels).
_ONE_BY_ONE = 48


@functools.lru_cache(maxsize=8)
def covariance_table(n_samples: int, n_levels: int, time_constants: tuple[float, ...]) -> Array:
    """`Q` of the components white noise, AR1 with these time constants, random walk.

    Args:
        n_samples: Length T of the record.
        n_levels: Number of levels J.
        time_constants: Time constants `-1/ln(phi)` of the AR1s, samples.

    Returns:
        `(level, level, component, component)`, read-only. White noise has unit variance, an AR1 has unit variance, a
        random walk has unit variance of its steps.
    """
    n_components = len(time_constants) + 2
    table = np.empty((n_levels, n_levels, n_components, n_components))
    for j in range(n_levels):
        for k in range(j + 1):
            table[j, k] = table[k, j] = _entry(j, k, n_samples, time_constants)
    table.setflags(write=False)
    return table


@functools.lru_cache(maxsize=8)
def variance_table(n_samples: int, n_levels: int, time_constants: tuple[float, ...]) -> Array:
    """The diagonal `Q_jj` of `covariance_table`, for a fraction of the work.

    Args:
        n_samples: Length T of the record.
        n_levels: Number of levels J.
        time_constants: Time constants `-1/ln(phi)` of the AR1s, samples.

    Returns:
        `(level, component, component)`, read-only.
    """
    table = np.stack([_entry(j, j, n_samples, time_constants) for j in range(n_levels)])
    table.setflags(write=False)
    return table


def _entry(j: int, k: int, n_samples: int, time_constants: tuple[float, ...]) -> Array:
    lags, weights, _ = lag_quadrature(2**j, 2**k, n_samples)
    s = unit_covariances(2**j, 2**k, lags, time_constants)  # (component, lag)
    counts = (n_samples - 2 ** (j + 1) + 1) * (n_samples - 2 ** (k + 1) + 1)
    return (s * weights) @ s.T / counts


def unit_wavelet_variances(n_levels: int, time_constants: tuple[float, ...]) -> Array:
    """Wavelet variances of the components of `covariance_table`.

    Args:
        n_levels: Number of levels J.
        time_constants: Time constants `-1/ln(phi)` of the AR1s, samples.

    Returns:
        `(level, component)`.
    """
    return np.stack([unit_covariances(2**j, 2**j, np.zeros(1), time_constants)[:, 0] for j in range(n_levels)])


def unit_covariances(h: int, k: int, lags: Array, time_constants: tuple[float, ...]) -> Array:
    """Cross-covariances of wavelet coefficients of two filter lengths, of the components of `covariance_table`.

    Args:
        h: Half the filter length of the first coefficient, samples.
        k: Half the filter length of the second coefficient, samples.
        lags: Time from the second coefficient to the first, `(lag,)`, samples.
        time_constants: Time constants `-1/ln(phi)` of the AR1s, samples.

    Returns:
        `(component, lag)`.
    """
    taps = np.array([1.0, -2.0, 1.0])
    # Pairs of taps as far apart as each other count once.
    shifts, copies = np.unique((-h * np.arange(3)[:, None] + k * np.arange(3)).ravel(), return_inverse=True)
    weights = np.bincount(copies, np.outer(taps, taps).ravel()) / (4 * h * k)
    inside = (lags > -2 * k) & (lags < 2 * h)
    distance = np.abs(lags[inside, None] + shifts)  # (lag, pair of taps)
    # Where the two filters do not overlap the covariance is one exponential, without any cancellation.
    gap = np.where(lags[~inside] > 0, lags[~inside] - 2 * h, -lags[~inside] - 2 * k)
    covariances = np.zeros((len(time_constants) + 2, len(lags)))
    covariances[0, inside] = -distance / 2 @ weights
    for row, time_constant in zip(covariances[1:-1], time_constants, strict=True):
        x = 1 / time_constant
        row[inside] = _exponential(x, distance, weights, fine=x * x * h * k < 0.01)
        edge = (math.expm1(-x * h) * math.expm1(-x * k) / math.sinh(x / 2)) ** 2 / (16 * h * k)
        row[~inside] = -edge * np.exp(-x * gap)
    covariances[-1, inside] = (distance**3 - distance) / 12 @ weights
    return covariances


def block_mean_covariances(block: int, n_blocks: int, time_constants: tuple[float, ...]) -> Array:
    """Autocovariances of the means of successive blocks, of the components of `covariance_table`.

    The autocovariance of the random walk is a generalised one: right for all sums whose weights add up to zero.

    Args:
        block: Length of a block, samples.
        n_blocks: Number of lags, in blocks, from 0 on.
        time_constants: Time constants `-1/ln(phi)` of the AR1s, samples.

    Returns:
        `(component, lag)`.
    """
    lag = np.arange(n_blocks, dtype=float)
    covariances = np.zeros((len(time_constants) + 2, n_blocks))
    covariances[0, 0] = 1 / block
    for row, time_constant in zip(covariances[1:-1], time_constants, strict=True):
        x = 1 / time_constant
        curvature = 1 / (2 * math.sinh(x / 2) * block) ** 2
        row[:] = curvature * math.expm1(-x * block) ** 2 * np.exp(-x * block * (lag - 1).clip(min=0))
        row[0] = 2 * curvature * math.expm1(-x * block) + 1 / (math.tanh(x / 2) * block)
    edges = np.abs(lag[:, None] + np.array([1.0, 0.0, -1.0])) * block
    covariances[-1] = (edges**3 - edges) / 12 @ np.array([-1.0, 2.0, -1.0]) / block**2
    return covariances


def _exponential(x: float, distance: Array, weights: Array, *, fine: bool) -> Array:
    """Weighted sums `(lag,)` of the generalised covariance of the sum of an AR1 of unit variance with `phi = e^-x`.

    Even polynomials of the distance are left out, which the weights do not see; `fine` leaves out all of them where the
    weights would cancel what is left to rounding.
    """
    u = x * distance
    curvature = 1 / (4 * math.sinh(x / 2) ** 2)
    if not fine:
        return -curvature * (np.exp(-u) @ weights) - distance @ weights / (2 * math.tanh(x / 2))
    # e^-u - 1 + u - u^2/2, by its series where that cancels.
    few = u < 0.02
    v = u if few.all() else u[few]
    series = -v * v * v / 6 * (1 - v / 4 * (1 - v / 5 * (1 - v / 6 * (1 - v / 7))))
    if few.all():
        remainder = series
    else:
        remainder = np.exp(-u) - 1 + u - u * u / 2
        remainder[few] = series
    slope = 1 / (2 * math.tanh(x / 2)) - x * curvature if x > 0.02 else x / 6 * (1 - x**2 / 30)
    return -curvature * (remainder @ weights) - slope * (distance @ weights)


def lag_quadrature(h: int, k: int, n_samples: int) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Nodes and weights of the sum of `n_jl(lag) f(lag)` over all lags, for `f` that is smooth far from its corners.

    Near the corners each lag is a node; a longer stretch between them is an integral by Gauss-Legendre, whose nodes are
    not whole numbers, with half the values at its ends (Euler-Maclaurin).

    Args:
        h: Half the filter length of the first coefficient, samples.
        k: Half the filter length of the second coefficient, samples.
        n_samples: Length T of the record.

    Returns:
        Lags `(node,)`, samples; their weights, times the number of pairs of coefficients that far apart; and whether a
        node stands for a single lag.
    """
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    first, last = 2 * h - n_samples, n_samples - 2 * k
    # Stretches between the corners of s(lag) grow with the distance from a corner, as fast as its memory may fade.
    corners = {a * h - b * k for a in range(3) for b in range(3)} | {2 * h - 2 * k}
    steps = [_ONE_BY_ONE << n for n in range(0, n_samples.bit_length(), 2)]
    near, far = min(h, k), n_samples
    graded = {c + sign * d for c in corners for sign in (-1, 1) for d in steps if d < 2 * near}
    graded |= {c + sign * d for c in (-2 * k, -k, 0, h, 2 * h) for sign in (-1, 1) for d in steps if near <= d < far}
    corners |= graded | {first, last + 1}
    edges = np.array(sorted(c for c in corners if first <= c <= last + 1), dtype=float)
    low, width = edges[:-1], np.diff(edges)
    narrow = width <= _ONE_BY_ONE
    single = np.concatenate([start + np.arange(n) for start, n in zip(low[narrow], width[narrow], strict=True)])
    # Sum over low <= lag < high of a smooth function, by its integral and half the ends (Euler-Maclaurin).
    low, width = low[~narrow, None], width[~narrow, None]
    at = np.concatenate([single, np.hstack([low, low + width * (1 + nodes) / 2, low + width]).ravel()])
    ends = np.full_like(low, 0.5)
    weights = np.concatenate([np.ones_like(single), np.hstack([ends, width / 2 * node_weights, -ends]).ravel()])
    # Newest samples t and t - lag both inside the record and each with a whole window.
    pairs = np.minimum(n_samples, n_samples + at) - np.maximum(2 * h - 1, 2 * k - 1 + at)
    return at, weights * np.maximum(pairs, 0), np.arange(len(at)) < len(single)
