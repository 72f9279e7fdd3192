"""Wavelet cross-covariance (WCCV) with a model's help where the record is too short to tell it.

The last levels hold fewer observations than the array has sensors, yet the long scale weights look at them most. There
the WCCV is replaced by that of a sum of white noise, AR1s and a random walk, each with a covariance matrix between the
sensors, fitted to the higher levels. A model of many matrices fits noise and a model of few may not hold, so both are
kept to what the data ask for: a matrix pays for its entries, and where the model begins is chosen by the data as well.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from gyrofuse._base.linalg import geometric_mean
from gyrofuse.wavelets.lag_sums import unit_wavelet_variances

# Levels with more observations than this in every recording speak for themselves.
_MOST_OBSERVATIONS = 2**9
# More of them add nothing to the likelihood: a model that is off by a few per cent shall not be driven by one level.
_MOST_DEGREES = 300.0
# AR1s with time constants spread over so many octaves, up to half the longest filter.
_N_AR1, _OCTAVES = 5, 8
_ITERATIONS = 150
# Relative size under which a component has left the model, and variance that keeps matrices regular.
_GONE, _FLOOR = 1e-6, 1e-6


def assisted_covariance(wccv: Tensor, counts: Tensor) -> Tensor:
    """Wavelet cross-covariance with its last levels taken from a fitted model.

    For every start `s` from the first level that holds few observations on, white noise and a random walk are fitted
    to the levels from `s` on, and from the first of these also five AR1s besides. Akaike's criterion chooses, with
    `p(p+1)/2` parameters for each matrix of the model and for each level before it, which keeps its own covariance.

    Args:
        wccv: `(..., level, sensor, sensor)`, signal^2; levels without coefficients may hold anything.
        counts: `(..., level)`, number of coefficients of each level.

    Returns:
        The same shape and dtype: measured below the level where the model begins, of the model from there on.
    """
    n_levels, n_sensors = wccv.shape[-3], wccv.shape[-1]
    level = torch.arange(n_levels, device=wccv.device)
    observations = counts * torch.exp2(-level.double() - 1)
    # The model begins where few observations are left; a level before can keep its own covariance only if that is well
    # determined, and three levels are the model's.
    first = (observations > _MOST_OBSERVATIONS).sum(-1).clamp(max=max(n_levels - 3, 0))  # (...)
    last = torch.maximum(first, (observations >= n_sensors).sum(-1).clamp(max=n_levels - 3))
    known = (counts > 0) & (wccv.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    # An unknown level is next to nothing of uncorrelated noise, which keeps the fit regular where all are unknown.
    eta = torch.where(known, (2 * observations).clamp(1.0, _MOST_DEGREES), _FLOOR)
    lowest, highest = int(first.min()), int(last.max())  # of all items: levels below are nobody's
    level, eta, known = level[lowest:], eta[..., lowest:], known[..., lowest:]

    # In units of each sensor, so that no sensor is small to rounding.
    inside = level >= first[..., None]
    measured = torch.where(known[..., None, None], wccv[..., lowest:, :, :], 0.0).double()
    variance = torch.where(inside[..., None], measured.diagonal(dim1=-2, dim2=-1), 0.0).amax(-2)
    size = torch.where(variance > 0, variance, 1.0).sqrt()
    scale = (size[..., :, None] * size[..., None, :])[..., None, :, :]
    gamma = _positive(torch.where(known[..., None, None], measured / scale, torch.eye(n_sensors).to(measured)))
    unit = _unit_variances(n_levels).to(gamma)[lowest:]

    own = inside & (level < last[..., None])
    wide, wide_score = _fit(gamma, eta * inside, unit, own)
    wide = torch.where(inside[..., None, None], wide, gamma)
    # White noise and a random walk, from every start on.
    starts = torch.arange(lowest, highest + 1, device=wccv.device)
    inside = level >= starts[:, None]  # (start, level)
    some, some_scores = _fit(gamma[..., None, :, :, :], eta[..., None, :] * inside, unit[:, [0, -1]], own[..., None, :])
    some = torch.where(inside[..., None, None], some, gamma[..., None, :, :, :])
    some_scores = some_scores + n_sensors * (n_sensors + 1) / 2 * (starts - first[..., None])
    allowed = (starts >= first[..., None]) & (starts <= last[..., None])
    some_scores = torch.where(allowed, some_scores, torch.inf)

    candidates = torch.cat([wide[..., None, :, :, :], some], dim=-4)  # (..., candidate, level, sensor, sensor)
    best = torch.cat([wide_score[..., None], some_scores], dim=-1).argmin(-1)
    best = candidates.take_along_dim(best[..., None, None, None, None], -4).squeeze(-4)
    kept = (level < first[..., None])[..., None, None]
    best = torch.where(kept, wccv[..., lowest:, :, :], (best * scale).to(wccv))
    return torch.cat([wccv[..., :lowest, :, :], best], dim=-3)


def _fit(gamma: Tensor, eta: Tensor, unit: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
    """Covariances of a model `(..., level, sensor, sensor)` and half of Akaike's criterion `(...)`.

    Each step replaces `Theta_k` by the geometric mean of `D_k^-1` and `Theta_k N_k Theta_k`, where `D` and `N` are the
    two halves of the gradient of the Wishart likelihood `-sum_j eta_j (ln det S_j + tr(S_j^-1 Gamma_j)) / 2` of
    `S_j = sum_k f_k(tau_j) Theta_k`, which never lowers it and keeps matrices positive. To the likelihood comes
    `-p(p+1)/2 ln tr Theta_k`, one for each entry: it drives out the components that the data do not ask for.

    Args:
        gamma: `(..., level, sensor, sensor)`.
        eta: `(..., level)`, degrees of freedom, 0 for levels to leave out.
        unit: `(level, component)`, wavelet variances `f_k(tau_j)`.
        own: `(..., level)`, levels whose misfit is counted from that of their own covariance.
    """
    n_sensors, n_components = gamma.shape[-1], unit.shape[-1]
    n_parameters = n_sensors * (n_sensors + 1) / 2
    # Components in units in which they are as large as the data where they are largest.
    counting = (eta > 0).to(unit)[..., None]
    unit = unit / (unit * counting).amax(-2, keepdim=True)
    weight = eta[..., None] * unit  # (..., level, component)
    size = (gamma.diagonal(dim1=-2, dim2=-1).mean(-1) * counting[..., 0]).sum(-1) / counting[..., 0].sum(-1)
    identity = torch.eye(n_sensors, dtype=gamma.dtype, device=gamma.device)
    theta = (size / n_components)[..., None, None, None] * identity.expand(n_components, n_sensors, n_sensors)
    for _ in range(_ITERATIONS):
        precision = torch.cholesky_inverse(torch.linalg.cholesky(_mix(unit, theta)))
        down = torch.einsum("...jk,...jio->...kio", weight, precision)
        up = torch.einsum("...jk,...jio->...kio", weight, precision @ gamma @ precision)
        trace = theta.diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=1e-100)
        down = down + (2 * n_parameters / trace)[..., None, None] * identity
        theta = geometric_mean(down, theta @ up @ theta)
    model = _mix(unit, theta)
    lower = torch.linalg.cholesky(model)
    trace_ratio = torch.cholesky_solve(gamma, lower).diagonal(dim1=-2, dim2=-1).sum(-1)
    log_det = 2 * lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    least = torch.where(own, torch.logdet(gamma) + n_sensors, 0.0)
    misfit = (eta * (trace_ratio + log_det - least)).sum(-1)
    size = theta.diagonal(dim1=-2, dim2=-1).sum(-1)
    n_matrices = (size > _GONE * size.amax(-1, keepdim=True)).sum(-1)
    return model, misfit / 2 + n_parameters * n_matrices


def _positive(matrix: Tensor) -> Tensor:
    """The nearest regular covariances: entries that average over different samples may not be one."""
    values, vectors = torch.linalg.eigh(matrix)
    least = _FLOOR * matrix.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
    return (vectors * torch.maximum(values, least)[..., None, :]) @ vectors.mT


def _mix(unit: Tensor, theta: Tensor) -> Tensor:
    return torch.einsum("...jk,...kio->...jio", unit, theta)


@functools.lru_cache(maxsize=32)
def _unit_variances(n_levels: int) -> Tensor:
    """Wavelet variances `(level, component)` of unit white noise, AR1s and random walk."""
    longest = n_levels - 1
    time_constants = torch.logspace(max(longest - _OCTAVES, 0), longest, _N_AR1, base=2.0, dtype=torch.float64)
    return torch.from_numpy(unit_wavelet_variances(n_levels, tuple(time_constants.tolist())))
