"""How robust wavelet variances of one sensor vary together: `V(theta)` of a Gaussian model.

To first order in the influence function, with the expansion `chi - a = sum_k a_2k h_2k` in normalised Hermite
polynomials and the correlations `rho_jk(lag)` between the coefficients of levels `j` and `k`

    Cov(nu_j, nu_k) = 2 nu_j nu_k / (M_j M_k) sum_lag n_jk(lag) sum_k (a_2k / a_2)^2 rho_jk(lag)^2k

because `E h_m(X) h_n(Y) = rho^n` for `m = n`, else 0. The first order is the classic covariance whatever `chi`; for
independent coefficients the orders add up to `1 / e(c)`, for the correlated ones of overlapping windows to less.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse.fitting.moments.covariance import _covariances, _grid, _shares, _symmetric, _tables, moment_covariance
from gyrofuse.noise.model import Model
from gyrofuse.wavelets.lag_sums import lag_quadrature
from gyrofuse.wavelets.robust import biweight_of, check_efficiency

# Orders of less than this are left out.
_LEAST_ORDER = 1e-3


def robust_moment_covariance(model: Model, n_samples: int, n_levels: int, *, efficiency: float = 0.6) -> Tensor:
    """Covariance matrix of the robust Haar wavelet variances of a record, for its finite length.

    `moment_covariance` and the higher orders of the squared biweight. As it is of first order in the spread of the
    estimates it needs some ten windows side by side at the last level; with two or three the robust estimates are
    biased and vary more. Differentiable in the parameters.

    Args:
        model: Known processes with a continuous spectrum, parameters with batch dimensions `(...)`.
        n_samples: Length T of the record.
        n_levels: Levels J, `2**J <= n_samples`.
        efficiency: Of the robust wavelet variance; 1 is the classic.

    Returns:
        `(..., level, level)`, signal^4, float64. NaN where a parameter is.

    Raises:
        ValueError: A parameter is to be estimated, `n_levels` is below 1 or too large for `n_samples`, `efficiency`
            is out of range, or below 1 for a model with a sinusoid or a drift.

    References:
        D. Mondal, D. B. Percival, Annals of the Institute of Statistical Mathematics 64, 2012, section 4.
    """
    covariance = moment_covariance(model, n_samples, n_levels)
    if check_efficiency(efficiency) == 1:
        return covariance
    check_gaussian(model)
    orders = [order for order in biweight_of(efficiency).orders[1:] if order > _LEAST_ORDER]
    device = covariance.device
    tables = _tables(n_samples, n_levels)
    shares = _shares(model._known(), type(tables)(*(table.to(device) for table in tables)))
    nu = model.wavelet_variance(n_levels)
    entries = []
    for table in _lag_tables(n_samples, n_levels):
        scale = nu[..., table.levels[0]] * nu[..., table.levels[1]]
        rho = (shares @ table.covariances.to(device)).square() / scale[..., None]
        rho = rho.clamp(max=1)  # (..., lag), squared
        series = torch.zeros_like(rho)
        for order in reversed(orders):
            series = (series + order) * rho
        entries.append(2 * scale * ((series * rho) @ table.weights.to(device)))
    return covariance + _symmetric(torch.stack(entries, -1), n_levels)


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
