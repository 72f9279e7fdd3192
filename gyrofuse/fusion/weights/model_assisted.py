"""Wavelet cross-covariance (WCCV) whose last levels are those of a fitted model.

The last levels hold fewer observations than the array has sensors, yet long scale weights depend on them most. There
the WCCV is replaced by that of a sum of white noise, AR1s and a random walk, each with a covariance matrix between the
sensors, fitted to all levels from some level on. A model of many matrices fits noise and a model of few may be wrong:
each matrix is penalised by its number of entries, and the level where the model begins is chosen by Akaike's criterion.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from gyrofuse.wavelets.lag_sums import unit_wavelet_variances
from gyrofuse.wavelets.pilot import climb_likelihood, mixture

# Relative variance below which a component has left the model, and which keeps matrices regular: small beside the share
# of any component that matters, large beside rounding.
_NEGLIGIBLE = 1e-6


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
    # The model begins at or after the first level with no more than 512 observations, above which a level needs none;
    # levels before it keep their own covariance, for which they need as many observations as sensors; the last three
    # levels are always the model's.
    first = (observations > 512).sum(-1).clamp(max=max(n_levels - 3, 0))  # (...)
    last = torch.maximum(first, (observations >= n_sensors).sum(-1).clamp(max=n_levels - 3))
    known = (counts > 0) & (wccv.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    # No more than 300 degrees of freedom, so that one level does not decide the fit of a model that is off by a few per
    # cent. An unknown level counts as a trace of uncorrelated noise, which keeps the fit regular.
    eta = torch.where(known, (2 * observations).clamp(1.0, 300.0), _NEGLIGIBLE)
    lowest, highest = int(first.min()), int(last.max())  # over the batch
    level, eta, known = level[lowest:], eta[..., lowest:], known[..., lowest:]

    # In units of each sensor, so that no sensor is lost to rounding.
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


def _fit(gamma: Tensor, eta: Tensor, unit: Tensor, own: Tensor, n_steps: int = 150) -> tuple[Tensor, Tensor]:
    """Covariances of a model `(..., level, sensor, sensor)` and half of Akaike's criterion `(...)`.

    By `climb_likelihood` of `S_j = sum_k f_k(tau_j) Theta_k`, with the penalty `-p(p+1)/2 ln tr Theta_k`.

    Args:
        gamma: `(..., level, sensor, sensor)`.
        eta: `(..., level)`, degrees of freedom, 0 for levels to leave out.
        unit: `(level, component)`, wavelet variances `f_k(tau_j)`.
        own: `(..., level)`, levels whose misfit is taken relative to that of their own covariance.
        n_steps: Number of steps; the penalty makes them slower than those of a pilot.
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
    theta = climb_likelihood(theta, gamma, unit, weight, n_steps, n_parameters=n_parameters)
    model = mixture(theta, unit)
    lower = torch.linalg.cholesky(model)
    trace_ratio = torch.cholesky_solve(gamma, lower).diagonal(dim1=-2, dim2=-1).sum(-1)
    log_det = 2 * lower.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    least = torch.where(own, torch.logdet(gamma) + n_sensors, 0.0)
    misfit = (eta * (trace_ratio + log_det - least)).sum(-1)
    size = theta.diagonal(dim1=-2, dim2=-1).sum(-1)
    n_matrices = (size > _NEGLIGIBLE * size.amax(-1, keepdim=True)).sum(-1)
    return model, misfit / 2 + n_parameters * n_matrices


def _positive(matrix: Tensor) -> Tensor:
    """The nearest regular covariances; entries that average over different samples may form an indefinite matrix."""
    values, vectors = torch.linalg.eigh(matrix)
    least = _NEGLIGIBLE * matrix.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
    return (vectors * torch.maximum(values, least)[..., None, :]) @ vectors.mT


@functools.lru_cache(maxsize=32)
def _unit_variances(n_levels: int) -> Tensor:
    """Wavelet variances `(level, component)` of unit white noise, AR1s and random walk."""
    # Five AR1s, two octaves apart, up to half the longest filter: a sum of them is smooth between neighbouring ones.
    longest = n_levels - 1
    time_constants = torch.logspace(max(longest - 8, 0), longest, 5, base=2.0, dtype=torch.float64)
    return torch.from_numpy(unit_wavelet_variances(n_levels, tuple(time_constants.tolist())))
