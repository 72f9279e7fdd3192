"""How the estimated Haar wavelet variances of one sensor vary together: `V(theta)` of a model, for its length.

For Gaussian noise with covariances `s_jk(lag)` between the coefficients of levels `j` and `k`

    Cov(nu_j, nu_k) = 2 sum_lag n_jk(lag) s_jk(lag)^2 / (M_j M_k)

with `n_jk(lag)` pairs of coefficients that far apart, of `M_j = T - tau_j + 1` and `M_k`; for filters short beside the
record that is `2 / max(M_j, M_k) int |H_j|^2 |H_k|^2 S^2 df`. A tone or a ramp in the same record multiplies the noise
and adds terms of the same order.

The sums are those of a fixed family of components, tabulated once for each length. With `cos(2 pi f) = tanh w` and
`phi = tanh(v / 2)` the spectrum of an AR1 of unit variance is `cosh(w) / cosh(v - w)`: one bump, moved along. AR1s
evenly spaced in `v`, white noise among them, and the random walk that they become for large `v` interpolate any smooth
spectrum from its values at as many frequencies. Hence `V` is a quadratic form in these values.

Robust wavelet variances of efficiency `e(c)` are averages of a bounded `chi`. To first order in the influence function,
with the expansion `chi - a = sum_k a_2k h_2k` in normalised Hermite polynomials and the correlations `rho_jk(lag)`
between the coefficients of levels `j` and `k`

    Cov(nu_j, nu_k) = 2 nu_j nu_k / (M_j M_k) sum_lag n_jk(lag) sum_k (a_2k / a_2)^2 rho_jk(lag)^2k

because `E h_m(X) h_n(Y) = rho^n` for `m = n`, else 0. The first order is the classic covariance whatever `chi`; for
independent coefficients the orders add up to `1 / e(c)`, for the correlated ones of overlapping windows to less.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gyrofuse._base.checks import check_positive_integer, largest_level
from gyrofuse.noise.processes import Model, Process
from gyrofuse.wavelets.lag_sums import lag_quadrature, unit_covariances
from gyrofuse.wavelets.robust import biweight_of, check_efficiency

Array = NDArray[np.float64]

# Spacing of the grid of `v`: between its AR1s the spectrum of any other AR1 is followed to 2e-3, up and down, so that
# sums over it come out better.
_SPACING = 0.65


def moment_covariance(
    model: Model,
    n_samples: int,
    n_levels: int,
    *,
    excess_kurtosis: Tensor | float = 0.0,
    efficiency: float = 1.0,
) -> Tensor:
    """Covariance matrix of the estimated Haar wavelet variances of a record, for its finite length.

    The sum, for `M = max(M_j, M_k)`, of

    - noise, all processes with a continuous spectrum `S`: `2 sum_lag n_jk s_jk^2 / (M_j M_k)`;
    - noise times each tone of amplitude `a` at `f0`: `(2 a^2 / M) |H_j(f0)|^2 |H_k(f0)|^2 S(f0)`, which is
      `(8 a^2 S / M) h_j h_k` with `h = d nu / d a^2`. [V] theorem 1 leaves it out, though it is as large as the noise
      term: without it the variances of the tone's levels are several times too small;
    - noise times a drift of slope `w`: `4 (w tau_j / 4) (w tau_k / 4) Cov(mean W_j, mean W_k)`;
    - white noise of variance `s2` that is not Gaussian: `kappa (s2 / tau_j) (s2 / tau_k) / M`.

    Noise terms are exact within 1 % for processes as smooth in frequency as AR1s with `phi > -0.9`, 5 % down to
    -0.99. That of a tone takes its line for narrow: it is right to 2 % from some fifteen cycles in the record on, to a
    half with two of them. How the mean square of a tone depends on its phase is left out. That of robust wavelet
    variances is of first order in their errors and needs some ten non-overlapping windows at the last level. The
    covariance is differentiable in the parameters.

    Args:
        model: Known processes, parameters with batch dimensions `(...)`.
        n_samples: Length T of the record.
        n_levels: Levels J, `2**J <= n_samples`.
        excess_kurtosis: Excess kurtosis `kappa` of the samples of the white noise, a number or `(...)`; for the classic
            wavelet variance only.
        efficiency: Efficiency of the robust wavelet variance; 1 is the classic one.

    Returns:
        `(..., level, level)`, signal^4, float64. NaN where a parameter is.

    Raises:
        ValueError: A parameter is to be estimated, `n_levels` is below 1 or too large for `n_samples`,
            `excess_kurtosis` is given to a model without white noise, `efficiency` is out of range, or below 1 for a
            model with a sinusoid or a drift.

    References:
        [V] theorem 1, for the noise; Percival & Walden, Wavelet Methods for Time Series Analysis, section 8.3; for
        robust variances D. Mondal, D. B. Percival, Annals of the Institute of Statistical Mathematics 64, 2012,
        section 4.
    """
    n_samples = check_positive_integer("n_samples", n_samples)
    n_levels = check_positive_integer("n_levels", n_levels)
    if n_levels > largest_level(n_samples):
        raise ValueError(
            f"`n_levels`: expected at most {largest_level(n_samples)} for {n_samples} samples "
            f"(2**n_levels <= samples), got {n_levels}; ask for fewer levels or give a longer record"
        )
    known = model._known()
    device = model._device()
    if check_efficiency(efficiency) < 1:
        check_gaussian(model)
    tables = _Tables(*(table.to(device) for table in _tables(n_samples, n_levels)))
    shares = _shares(known, tables)  # (..., component)
    first, second = tables.pairs
    products = shares[..., first] * shares[..., second]  # (..., pair of components)
    covariance = _symmetric(products @ tables.squares, n_levels)

    tau = torch.exp2(torch.arange(1, n_levels + 1, dtype=torch.float64, device=device))
    windows = n_samples + 1 - torch.minimum(tau[:, None], tau)  # max(M_j, M_k)
    kurtosis = torch.as_tensor(excess_kurtosis, dtype=torch.float64, device=device)
    if bool((kurtosis != 0).any()) and not any(process.white for process, _ in known):
        raise ValueError(
            f"`excess_kurtosis`: expected a model with WhiteNoise, whose kurtosis it is, got {model}; "
            "add WhiteNoise or leave `excess_kurtosis` out"
        )
    for process, columns in known:
        if process.has_line:
            f0 = columns["beta"] / (2 * math.pi)
            density = torch.stack(torch.broadcast_tensors(*(p._spectrum(f0, **values) for p, values in known))).sum(0)
            gain = process._wavelet_variance(tau, torch.ones_like(f0), columns["beta"])  # h = |H(f0)|^2 / 2
            scale = 8 * columns["amplitude"] ** 2 * density
            covariance = covariance + scale[..., None] * _outer(gain) / windows
        elif process.deterministic:
            ramp = columns["slope"] * tau / 4
            covariance = covariance + 4 * _outer(ramp) * _symmetric(shares @ tables.means, n_levels)
        elif process.white:
            covariance = covariance + kurtosis[..., None, None] * _outer(columns["variance"] / tau) / windows
    if efficiency == 1:
        return covariance
    return covariance + _higher_orders(model.wavelet_variance(n_levels), shares, n_samples, efficiency)


def _higher_orders(nu: Tensor, shares: Tensor, n_samples: int, efficiency: float, least: float = 1e-3) -> Tensor:
    """What the orders above the first add to the covariance of robust wavelet variances, `(..., level, level)`.

    Args:
        nu: Wavelet variance of the model, `(..., level)`.
        shares: Share of each component in the model, `(..., component)`.
        n_samples: Length T of the record.
        efficiency: Efficiency of the robust wavelet variance, below 1.
        least: Orders whose `(a_2k / a_2)^2` is below are left out: a thousandth of the classic covariance at most.
    """
    orders = [order for order in biweight_of(efficiency).orders[1:] if order > least]
    n_levels = nu.shape[-1]
    entries = []
    for table in _lag_tables(n_samples, n_levels):
        scale = nu[..., table.levels[0]] * nu[..., table.levels[1]]
        rho = (shares @ table.covariances.to(nu.device)).square() / scale[..., None]
        rho = rho.clamp(max=1)  # (..., lag), squared
        series = torch.zeros_like(rho)
        for order in reversed(orders):
            series = (series + order) * rho
        entries.append(2 * scale * ((series * rho) @ table.weights.to(nu.device)))
    return _symmetric(torch.stack(entries, -1), n_levels)


def check_gaussian(model: Model) -> None:
    """Refuse processes whose coefficients are not Gaussian.

    Raises:
        ValueError: A sinusoid or a drift.
    """
    strange = [p.symbol for p in model.processes if not p.gaussian]
    if strange:
        raise ValueError(
            f"`model`: expected Gaussian processes with a robust wavelet variance, got {' + '.join(strange)}, whose "
            "coefficients have another scale (a tone alone seems 40 % stronger); leave them out or give "
            "`efficiency=1`"
        )


class _Tables(NamedTuple):
    """What depends on the length and the levels alone; components are the AR1s, random walk and quantisation noise.

    Attributes:
        frequencies: `(frequency,)` at which a spectrum is read, cycles per sample.
        interpolation: `(frequency, component)`, what its values put into the components but the last.
        pairs: `(2, pair)`, which components.
        squares: `(pair, entry)`: `2 sum_lag n s s' / (M_j M_k)`, once more for the pair the other way round.
        means: `(component, entry)`, covariances of the mean coefficients, `sum_lag n s / (M_j M_k)`.
    """

    frequencies: Tensor
    interpolation: Tensor
    pairs: Tensor
    squares: Tensor
    means: Tensor


@functools.lru_cache(maxsize=8)
def _tables(n_samples: int, n_levels: int) -> _Tables:
    v = _grid(n_samples)
    # Where each AR1 has its bump, and once beyond for the random walk; spectra are those over cosh(w).
    w = np.append(v, v[-1] + _SPACING)
    spectra = np.column_stack([1 / np.cosh(v - w[:, None]), np.exp(w - v[-1])])
    interpolation = np.linalg.inv(spectra) / np.cosh(w)  # (component, frequency)

    first, second = np.triu_indices(len(w) + 1)
    squares, means = [], []
    for j in range(n_levels):
        for k in range(j + 1):
            lags, weights, alone = lag_quadrature(2**j, 2**k, n_samples)
            covariances = _covariances(2**j, 2**k, lags, alone, v)
            counts = (n_samples - 2 ** (j + 1) + 1) * (n_samples - 2 ** (k + 1) + 1)
            sums = (covariances * np.append(weights, weights[~alone])) @ covariances.T / counts
            squares.append(2 * np.where(first == second, 1, 2) * sums[first, second])
            means.append(covariances[:, : len(lags)] @ weights / counts)
    frequencies = np.arctan(np.exp(-w)) / math.pi
    arrays = (frequencies, interpolation.T, np.stack([first, second]), np.stack(squares, -1), np.stack(means, -1))
    return _Tables(*(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays))


class _LagTable(NamedTuple):
    """Covariances of the coefficients of a pair of levels, the first the higher.

    Attributes:
        levels: Their indices.
        covariances: `(component, lag)`.
        weights: `(lag,)`, numbers of pairs included, over `M_j M_k`.
    """

    levels: tuple[int, int]
    covariances: Tensor
    weights: Tensor


@functools.lru_cache(maxsize=2)
def _lag_tables(n_samples: int, n_levels: int) -> tuple[_LagTable, ...]:
    v = _grid(n_samples)
    tables = []
    for j in range(n_levels):
        for k in range(j + 1):
            lags, weights, alone = lag_quadrature(2**j, 2**k, n_samples)
            smooth, turning = np.split(_covariances(2**j, 2**k, lags, alone, v), [len(lags)], axis=1)
            weights = weights / ((n_samples - 2 ** (j + 1) + 1) * (n_samples - 2 ** (k + 1) + 1))
            # Stretches: what alternates has one sign at half the lags.
            stretch = smooth[:, ~alone]
            covariances = np.hstack([smooth[:, alone], stretch + turning, stretch - turning])
            half = weights[~alone] / 2
            both = np.concatenate([weights[alone], half, half])
            tables.append(_LagTable((j, k), torch.from_numpy(covariances), torch.from_numpy(both)))
    return tuple(tables)


def _grid(n_samples: int) -> Array:
    """Values of `v` of the AR1s, from `phi = -0.989` (`v = -5.2`) to a time constant of eight records (`e^v / 2`)."""
    steps = math.ceil(math.log(2 * 8 * n_samples) / _SPACING)
    return _SPACING * np.arange(round(-5.2 / _SPACING), steps + 1, dtype=np.float64)


def _covariances(h: int, k: int, lags: Array, alone: NDArray[np.bool_], v: Array) -> Array:
    """Cross-covariances `(component, lag)` of coefficients of filter lengths `2h` and `2k`, in two parts.

    The second part repeats the lags that stand for stretches: a negative `phi` alternates there, and over a stretch
    `sum (a + (-1)^lag b) (c + (-1)^lag d) = sum a c + b d`. The first part holds `a` and `c`, the second `b` and `d`.
    """
    shifts, copies = np.unique((-h * np.arange(3)[:, None] + k * np.arange(3)).ravel(), return_inverse=True)
    taps = np.bincount(copies, np.outer([1, -2, 1], [1, -2, 1]).ravel() / (4 * h * k))
    distance = np.abs(lags[:, None] + shifts)  # (lag, pair of taps)
    rows = np.zeros((len(v) + 2, len(lags) + np.count_nonzero(~alone)))
    smooth, turning = rows[:, : len(lags)], rows[:, len(lags) :]
    memory = -1 / np.log(np.tanh(v[v > 1e-9] / 2))
    n_negative = len(v) - len(memory) - 1
    smooth[n_negative:-1] = unit_covariances(h, k, lags, tuple(memory))
    # Steps of a random walk whose spectrum over cosh(w) is exp(w - v_last), not exp(w) / 2.
    smooth[-2] *= 2 * math.exp(-v[-1])
    # An angle's white noise: the generalised covariance of the cumulative sum is 1 at distance 0.
    smooth[-1] = (distance == 0) @ taps
    # Of an AR1 with phi = -z the generalised covariance of the cumulative sum, see `_lag_sums`, is
    # z / (1 + z)^2 (-z)^d - (1 - z) / (1 + z) d / 2.
    sign = np.where(shifts % 2 == 0, 1.0, -1.0)
    nearest = distance.min(-1)
    for row, z in enumerate(-np.tanh(v[:n_negative] / 2)):
        rate = -math.log(z)
        near = nearest < 40 / rate  # beyond, e^-40
        term = np.zeros(len(lags))
        term[near] = z / (1 + z) ** 2 * np.exp(-rate * distance[near]) @ (taps * sign)
        smooth[row] = (1 - z) / (1 + z) * smooth[n_negative]
        smooth[row, alone] += np.where(lags[alone] % 2 == 0, 1, -1) * term[alone]
        turning[row] = term[~alone]
    return rows


def _shares(known: list[tuple[Process, dict[str, Tensor]]], tables: _Tables) -> Tensor:
    """Share of each component `(..., component)` in a model."""
    density = torch.zeros_like(tables.frequencies)
    angle = torch.zeros_like(density[:1])
    for process, columns in known:
        # Its spectrum falls to 0 with the frequency, where nothing of others may be left over.
        if process.white_integral:
            angle = columns["variance"]
        else:
            density = density + process._spectrum(tables.frequencies, **columns)
    interpolated = density @ tables.interpolation
    batch = torch.broadcast_shapes(interpolated.shape[:-1], angle.shape[:-1])
    return torch.cat([interpolated.expand(*batch, -1), angle.expand(*batch, 1)], -1)


def _outer(values: Tensor) -> Tensor:
    return values[..., :, None] * values[..., None, :]


def _symmetric(entries: Tensor, n_levels: int) -> Tensor:
    """Matrices `(..., level, level)` from their lower triangles `(..., entry)`, row after row."""
    level = torch.arange(n_levels, device=entries.device)
    high, low = torch.maximum(level[:, None], level), torch.minimum(level[:, None], level)
    return entries[..., high * (high + 1) // 2 + low]
