"""A rough model of an array's noise at its last levels, fitted to its wavelet cross-covariance (WCCV).

White noise and one component with memory, each with a covariance matrix between the sensors: what falls and what rises
with the scale. The memory is that of a random walk, or where that is far from likely of an AR1, whose noise turns level
at the last levels. It says how far these can be off, where few observations leave nothing else to go by; a richer model
would fit their noise, and its intervals come out a tenth too narrow.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.linalg import geometric_mean
from gyrofuse.wavelets.lag_sums import covariance_table, unit_wavelet_variances, variance_table

# Levels with more observations than this speak for themselves.
_MOST_OBSERVATIONS = 2**6
_ITERATIONS = 60
# Time constants of AR1s that may stand for the memory, as parts of the record, and how much more likely (nats) than a
# random walk they have to be.
_TIME_CONSTANTS, _EVIDENCE = (1 / 4, 1 / 16), 3.0


@dataclass(frozen=True, eq=False)
class Pilot:
    """Matrices of the components of a rough noise model.

    Attributes:
        theta: `(..., 2, sensor, sensor)`, positive semi-definite: white noise, and the variance of an AR1 or that of
            the steps of a random walk.
        memory: `(...)`, which memory the second component has: 0 the random walk's, 1, 2, ... those of AR1s.
        n_samples: Length of the record.
        first_level: Lowest level (counted from 0) that the model was fitted to.
        n_levels: Levels J.
        observations: `(..., level)`, degrees of freedom of each level that the fit rests on; 0 elsewhere.
    """

    theta: Tensor
    memory: Tensor
    n_samples: int
    first_level: int
    n_levels: int
    observations: Tensor

    def __getitem__(self, items: Tensor) -> Pilot:
        """Some items of the leading batch dimension."""
        chosen = {name: getattr(self, name)[items] for name in ("theta", "memory", "observations")}
        return replace(self, **chosen)

    @property
    def time_constants(self) -> tuple[float, ...]:
        """Those of the AR1s that `memory` may name, in samples."""
        return _time_constants(self.n_samples)

    @property
    def wavelet_cross_covariance(self) -> Tensor:
        """`(..., level, sensor, sensor)` of the model at every level, trustworthy from `first_level` on."""
        return _model(self.theta, self.unit)

    @property
    def unit(self) -> Tensor:
        """Wavelet variances `(..., level, component)` of the components at unit size."""
        return _unit_variances(self.n_samples, self.n_levels).to(self.theta)[self.memory]

    def covariance_of_moments(self) -> Tensor:
        """Covariance of the wavelet cross-covariances of a Gaussian record, exact for its length.

        `Cov(gamma_ab,j, gamma_cd,l) = sum_km Q_jl[k,m] (Theta_k,ac Theta_m,bd + Theta_k,ad Theta_m,bc)`.

        Returns:
            `(..., level, sensor, sensor, level, sensor, sensor)`, signal^4: for few sensors and levels.
        """
        table = _by_memory(covariance_table(self.n_samples, self.n_levels, self.time_constants))
        table = table.to(self.theta)[self.memory]
        straight = torch.einsum("...jlkm,...kac,...mbd->...jablcd", table, self.theta, self.theta)
        return straight + straight.transpose(-1, -2)

    def degrees_of_freedom(self, weights: Tensor) -> Tensor:
        """Equivalent degrees of freedom `2 nu_j^2 / Var nu_j` of the wavelet variance of combinations of sensors.

        Args:
            weights: `(..., combination, sensor)`.

        Returns:
            `(..., level, combination)`.
        """
        shares = torch.einsum("...ni,...kio,...no->...kn", weights, self.theta, weights)
        table = _by_memory(variance_table(self.n_samples, self.n_levels, self.time_constants))
        # Var nu_j = 2 sum_km Q_jj[k,m] theta_k theta_m
        half = torch.einsum("...jkm,...kn,...mn->...jn", table.to(self.theta)[self.memory], shares, shares)
        return (self.unit @ shares).square() / half

    def certainty(self, weights: Tensor, scale_weights: Tensor) -> Tensor:
        """Degrees of freedom of the fitted wavelet variance of a combination of sensors, `2 s^2 / Var s`.

        Levels count as independent, as in the likelihood; they are not, and at the last ones a half or less is left.

        Args:
            weights: `(..., sensor)`.
            scale_weights: `(level,)`, which add the levels from `first_level` on up to `s = sum_j omega_j nu_j`.

        Returns:
            `(...)`.
        """
        shares = torch.einsum("...i,...kio,...o->...k", weights, self.theta, weights)
        parts = self.unit * shares[..., None, :]  # of each component in nu_j: (..., level, component)
        # Fisher information of the logarithms of the shares, levels taken for independent.
        precision = self.observations / (2 * parts.sum(-1).square())
        information = torch.einsum("...j,...jk,...jm->...km", precision, parts, parts)
        size = information.diagonal(dim1=-2, dim2=-1)
        # A component without a share has no information, and no slope either.
        information = information + torch.diag_embed(1e-9 * size.sum(-1, keepdim=True).expand_as(size))
        slope = torch.einsum("j,...jk->...k", scale_weights[self.first_level :], parts[..., self.first_level :, :])
        return 2 * slope.sum(-1).square() / (slope * torch.linalg.solve(information, slope)).sum(-1)


def fit_pilot(wccv: Tensor, n_samples: int, levels_below: int = 2) -> Pilot:
    """Fit the rough model to a wavelet cross-covariance.

    Maximises the Wishart likelihood `-sum_j eta_j (ln det S_j + tr(S_j^-1 Gamma_j)) / 2` with
    `S_j = Theta_0 / tau_j + Theta_1 u_j`, `u_j = (tau_j^2 + 2) / (12 tau_j)` for a random walk, and
    `eta_j = 2 M_j / tau_j`, levels taken for independent, over the last levels, and over some more where Akaike's
    criterion says that these fit as well.

    Args:
        wccv: `(..., level, sensor, sensor)`, signal^2, float64.
        n_samples: Length T of the record.
        levels_below: How many more levels may help. They make the fit more certain, and bend it where a tone or a
            filter shows in them.

    Returns:
        The fitted model, batched as `wccv`.
    """
    n_levels, n_sensors = wccv.shape[-3], wccv.shape[-1]
    level = torch.arange(1, n_levels + 1, dtype=torch.float64)
    observations = (n_samples - torch.exp2(level) + 1) / torch.exp2(level)
    first = max(min(int((observations > _MOST_OBSERVATIONS).sum()), n_levels - 4), 0)
    below = max(first - levels_below, 0)
    eta = (2 * observations).clamp(1, 300).to(wccv.device)
    unit = _unit_variances(n_samples, n_levels).to(wccv)  # (memory, level, component)

    # In units of each sensor, so that no sensor is small to rounding.
    nu = wccv.diagonal(dim1=-2, dim2=-1)
    size = nu.clamp(min=1e-12 * nu.amax(-2, keepdim=True))[..., first:, :].log().mean(-2).exp().sqrt()
    scale = size[..., :, None] * size[..., None, :]
    gamma = (wccv / scale[..., None, :, :])[..., None, :, :, :]  # (..., 1, level, sensor, sensor)
    theta, likelihood = _maximise(gamma[..., first:, :, :], unit[:, first:], eta[first:])
    start = torch.full(likelihood.shape, first, device=wccv.device)
    if below < first:
        wide, wide_likelihood = _maximise(gamma[..., below:, :, :], unit[:, below:], eta[below:])
        # The levels below, when no model but their own covariances has to fit them.
        own = gamma[..., below:first, :, :]
        n_parameters = (first - below) * n_sensors * (n_sensors + 1) / 2
        likelihood = likelihood + _likelihood(own, own, eta[below:first]) - n_parameters
        fits = wide_likelihood > likelihood
        theta = torch.where(fits[..., None, None, None], wide, theta)
        likelihood = torch.maximum(likelihood, wide_likelihood)
        start = torch.where(fits, below, start)
    likelihood[..., 1:] -= _EVIDENCE
    memory = likelihood.argmax(-1)
    theta = torch.take_along_dim(theta, memory[..., None, None, None, None], -4).squeeze(-4)
    start = torch.take_along_dim(start, memory[..., None], -1)
    rests = torch.where(torch.arange(n_levels, device=wccv.device) >= start, eta, 0.0)
    return Pilot(theta * scale[..., None, :, :], memory, n_samples, first, n_levels, rests)


def _maximise(gamma: Tensor, unit: Tensor, eta: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices `(..., memory, component, sensor, sensor)` and their log likelihood `(..., memory)`."""
    height = unit.amax(-2)  # (memory, component)
    shape = unit / height[:, None]  # components in units in which they are as large as the data where they are largest
    identity = torch.eye(gamma.shape[-1], dtype=gamma.dtype, device=gamma.device)
    start = gamma.diagonal(dim1=-2, dim2=-1).mean((-1, -2)) / height.shape[-1]  # (..., 1)
    theta = (start[..., None, None, None] * identity).expand(*gamma.shape[:-4], *height.shape, *identity.shape)
    for _ in range(_ITERATIONS):
        theta = _step(theta, gamma, shape, eta)
    return theta / height[..., None, None], _likelihood(_model(theta, shape), gamma, eta)


def _likelihood(model: Tensor, gamma: Tensor, eta: Tensor) -> Tensor:
    misfit = torch.logdet(model) + torch.linalg.solve(model, gamma).diagonal(dim1=-2, dim2=-1).sum(-1)
    return -(eta * misfit).sum(-1) / 2


def _step(theta: Tensor, gamma: Tensor, shape: Tensor, eta: Tensor) -> Tensor:
    """One step up the likelihood: `Theta` becomes the geometric mean of `D^-1` and `Theta N Theta`.

    `D` and `N` are the two halves of the gradient; the step minimises a bound of the misfit that touches it at `Theta`,
    so that it never raises it, and keeps the matrices positive.
    """
    precision = torch.cholesky_inverse(torch.linalg.cholesky(_model(theta, shape)))  # (..., level, sensor, sensor)
    weighted = eta[:, None] * shape  # (..., level, component)
    down = torch.einsum("...jk,...jio->...kio", weighted, precision)  # D
    up = torch.einsum("...jk,...jio->...kio", weighted, precision @ gamma @ precision)  # N
    return geometric_mean(down, theta @ up @ theta)


def _model(theta: Tensor, unit: Tensor) -> Tensor:
    return torch.einsum("...jk,...kio->...jio", unit, theta)


def _time_constants(n_samples: int) -> tuple[float, ...]:
    return tuple(part * n_samples for part in _TIME_CONSTANTS)


@functools.lru_cache(maxsize=8)
def _unit_variances(n_samples: int, n_levels: int) -> Tensor:
    """Wavelet variances `(memory, level, component)` of components of unit size."""
    table = unit_wavelet_variances(n_levels, _time_constants(n_samples))
    return torch.stack([torch.from_numpy(table[:, pair]) for pair in components_of_memories()])


def _by_memory(table: np.ndarray) -> Tensor:
    """A table over pairs of all components `(..., component, component)`, `(memory, ..., 2, 2)` of those that meet."""
    return torch.stack([torch.from_numpy(table[..., pair, :][..., pair]) for pair in components_of_memories()])


def components_of_memories() -> list[list[int]]:
    """Which components each memory has among white noise, the AR1s, and a random walk."""
    return [[0, len(_TIME_CONSTANTS) + 1]] + [[0, k + 1] for k in range(len(_TIME_CONSTANTS))]
