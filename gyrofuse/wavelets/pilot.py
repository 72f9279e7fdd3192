"""A rough model of an array's noise at its last levels, fitted to its wavelet cross-covariance (WCCV).

The model is white noise and one component with memory, each with a covariance matrix between the sensors. The memory is
that of a random walk or, where an AR1 is much more likely, that of an AR1 whose wavelet variance levels off at the last
levels. The model gives the sampling distribution of the last levels, which hold too few observations to show it
themselves. A model of more components would overfit them.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.linalg import geometric_mean
from gyrofuse.wavelets.lag_sums import covariance_table, unit_wavelet_variances, variance_table
from gyrofuse.wavelets.long_run_variance import MANY_WINDOWS
from gyrofuse.wavelets.moments import filter_lengths

# Number of levels at least that the model is fitted to, where there are as many: two components at two levels leave two
# more to fit them to.
FEWEST_LEVELS = 4
# Time constants of the AR1s that may describe the memory, as fractions of the recording: a longer one cannot be told
# from a random walk within the recording, a shorter one levels off before the last levels.
_TIME_CONSTANTS = (0.25, 0.0625)


@dataclass(frozen=True, eq=False)
class Pilot:
    """Matrices of the components of a rough noise model.

    Attributes:
        theta: `(..., 2, sensor, sensor)`, positive semi-definite: white noise, and the variance of an AR1 or that of
            the steps of a random walk.
        memory: `(...)`, process of the second component: 0 the random walk, 1, 2, ... the AR1s.
        n_samples: Length of the record.
        first_level: Lowest level (counted from 0) that the model is always fitted to. Where Akaike's criterion prefers
            it, the fit begins up to `levels_below` levels lower, item by item, as `observations` shows.
        n_levels: Levels J.
        observations: `(..., level)`, degrees of freedom of each level that was fitted; 0 at the others.
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
        """Time constants of the AR1s that `memory` may name, in samples."""
        return _time_constants(self.n_samples)

    @property
    def wavelet_cross_covariance(self) -> Tensor:
        """`(..., level, sensor, sensor)` of the model at every level; fitted at those that have `observations`."""
        return mixture(self.theta, self.unit)

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

    def dof(self, weights: Tensor) -> Tensor:
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

    def dof_of_fit(self, weights: Tensor, scale_weights: Tensor) -> Tensor:
        """Degrees of freedom of the fitted wavelet variance of a combination of sensors, `2 s^2 / Var s`.

        Levels are taken to be independent, as in the likelihood. They are correlated, so that the true number is
        smaller, at the last levels by half or more.

        Args:
            weights: `(..., sensor)`.
            scale_weights: `omega`, `(level,)`, of the sum `s = sum_j omega_j nu_j` over the levels from `first_level`
                on.

        Returns:
            `(...)`.
        """
        shares = torch.einsum("...i,...kio,...o->...k", weights, self.theta, weights)
        parts = self.unit * shares[..., None, :]  # of each component in nu_j: (..., level, component)
        # Fisher information of the logarithms of the shares.
        precision = self.observations / (2 * parts.sum(-1).square())
        information = torch.einsum("...j,...jk,...jm->...km", precision, parts, parts)
        size = information.diagonal(dim1=-2, dim2=-1)
        # A component without a share has neither information nor slope, and the matrix is singular. A ridge of a
        # relative 1e-9 is allowed here, as it enters no estimate: the result is a number of degrees of freedom that the
        # independence of levels makes wrong by much more.
        information = information + torch.diag_embed(1e-9 * size.sum(-1, keepdim=True).expand_as(size))
        slope = torch.einsum("j,...jk->...k", scale_weights[self.first_level :], parts[..., self.first_level :, :])
        return 2 * slope.sum(-1).square() / (slope * torch.linalg.solve(information, slope)).sum(-1)


def fit_pilot(wccv: Tensor, n_samples: int, levels_below: int = 2) -> Pilot:
    """Fit the rough model to a wavelet cross-covariance.

    Maximises the Wishart likelihood `-sum_j eta_j (ln det S_j + tr(S_j^-1 Gamma_j)) / 2` with
    `S_j = Theta_0 / tau_j + Theta_1 u_j`, `u_j = (tau_j^2 + 2) / (12 tau_j)` for a random walk, and
    `eta_j = 2 M_j / tau_j` for the `M_j = T - tau_j + 1` windows of a level, but at least 1 and at most 300. Levels are
    taken to be independent. The fit is to the last levels, and to some more where Akaike's criterion prefers that.

    Args:
        wccv: `(..., level, sensor, sensor)`, signal^2, float64.
        n_samples: Length T of the record.
        levels_below: Number of further levels that may be fitted too. They make the fit more certain, but biased where
            they hold a tone or the mark of a filter.

    Returns:
        The fitted model, batched as `wccv`.
    """
    n_levels, n_sensors = wccv.shape[-3], wccv.shape[-1]
    tau = filter_lengths(n_levels)
    observations = (n_samples - tau + 1) / tau
    # Levels with more than 64 non-overlapping windows are judged by their own series and need no model.
    first = max(min(int((observations > MANY_WINDOWS).sum()), n_levels - FEWEST_LEVELS), 0)
    below = max(first - levels_below, 0)
    # More than 300 degrees of freedom would let one level decide the fit of a model that is only rough.
    eta = (2 * observations).clamp(1, 300).to(wccv.device)
    unit = _unit_variances(n_samples, n_levels).to(wccv)  # (memory, level, component)

    # In units of each sensor, so that no sensor is lost to rounding.
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
    # An AR1 is chosen when it is 3 nats (20 times) more likely than the random walk: of the two AR1s one is better by
    # chance, and the random walk gives the wider intervals.
    likelihood[..., 1:] -= 3.0
    memory = likelihood.argmax(-1)
    theta = torch.take_along_dim(theta, memory[..., None, None, None, None], -4).squeeze(-4)
    start = torch.take_along_dim(start, memory[..., None], -1)
    fitted = torch.where(torch.arange(n_levels, device=wccv.device) >= start, eta, 0.0)
    return Pilot(theta * scale[..., None, :, :], memory, n_samples, first, n_levels, fitted)


def _maximise(gamma: Tensor, unit: Tensor, eta: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices `(..., memory, component, sensor, sensor)` and their log likelihood `(..., memory)`."""
    height = unit.amax(-2)  # (memory, component)
    shape = unit / height[:, None]  # components in units in which they are as large as the data where they are largest
    identity = torch.eye(gamma.shape[-1], dtype=gamma.dtype, device=gamma.device)
    start = gamma.diagonal(dim1=-2, dim2=-1).mean((-1, -2)) / height.shape[-1]  # (..., 1)
    theta = (start[..., None, None, None] * identity).expand(*gamma.shape[:-4], *height.shape, *identity.shape)
    theta = climb_likelihood(theta, gamma, shape, eta[:, None] * shape)
    return theta / height[..., None, None], _likelihood(mixture(theta, shape), gamma, eta)


def _likelihood(model: Tensor, gamma: Tensor, eta: Tensor) -> Tensor:
    misfit = torch.logdet(model) + torch.linalg.solve(model, gamma).diagonal(dim1=-2, dim2=-1).sum(-1)
    return -(eta * misfit).sum(-1) / 2


def climb_likelihood(
    theta: Tensor, gamma: Tensor, unit: Tensor, weight: Tensor, n_steps: int = 60, n_parameters: float = 0.0
) -> Tensor:
    """Maximise the Wishart likelihood of a sum of components by minorisation-maximisation (MM).

    Of `-sum_j eta_j (ln det S_j + tr(S_j^-1 Gamma_j)) / 2` with `S_j = sum_k f_jk Theta_k`. Each step replaces
    `Theta_k` by the geometric mean of `D_k^-1` and `Theta_k N_k Theta_k`, where `D` and `N` are the two halves of the
    gradient. It minimises a bound of the misfit that touches it at `Theta`, so that the likelihood never falls and the
    matrices stay positive.

    Args:
        theta: Start, `(..., component, sensor, sensor)`, positive definite.
        gamma: `Gamma_j`, `(..., level, sensor, sensor)`.
        unit: `f_jk`, `(..., level, component)`, of order 1.
        weight: `eta_j f_jk`, `(..., level, component)`.
        n_steps: Number of steps. After 60 a pilot is within 2e-5 nats of its maximum (20 arrays of 4096 samples).
        n_parameters: Penalty `-n_parameters ln tr Theta_k` of each component, which removes the components that the
            data do not need.

    Returns:
        The matrices after the last step, in the shape of `theta`.
    """
    identity = torch.eye(gamma.shape[-1], dtype=gamma.dtype, device=gamma.device)
    for _ in range(n_steps):
        precision = torch.cholesky_inverse(torch.linalg.cholesky(mixture(theta, unit)))  # (..., level, sensor, sensor)
        down = torch.einsum("...jk,...jio->...kio", weight, precision)  # D
        up = torch.einsum("...jk,...jio->...kio", weight, precision @ gamma @ precision)  # N
        if n_parameters:
            trace = theta.diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=1e-100)
            down = down + (2 * n_parameters / trace)[..., None, None] * identity
        theta = geometric_mean(down, theta @ up @ theta)
    return theta


def mixture(theta: Tensor, unit: Tensor) -> Tensor:
    """Covariances of a sum of components at every level.

    Args:
        theta: `(..., component, sensor, sensor)`.
        unit: Wavelet variances of the components at unit size, `(..., level, component)`.

    Returns:
        `(..., level, sensor, sensor)`.
    """
    return torch.einsum("...jk,...kio->...jio", unit, theta)


def _time_constants(n_samples: int) -> tuple[float, ...]:
    return tuple(part * n_samples for part in _TIME_CONSTANTS)


@functools.lru_cache(maxsize=8)
def _unit_variances(n_samples: int, n_levels: int) -> Tensor:
    """Wavelet variances `(memory, level, component)` of components of unit size."""
    table = unit_wavelet_variances(n_levels, _time_constants(n_samples))
    return torch.stack([torch.from_numpy(table[:, pair]) for pair in components_of_memories()])


def _by_memory(table: np.ndarray) -> Tensor:
    """Parts `(memory, ..., 2, 2)` of a table over pairs of all components `(..., component, component)`."""
    return torch.stack([torch.from_numpy(table[..., pair, :][..., pair]) for pair in components_of_memories()])


def components_of_memories() -> list[list[int]]:
    """Indices of the components of each memory among white noise, the AR1s, and a random walk."""
    return [[0, len(_TIME_CONSTANTS) + 1]] + [[0, k + 1] for k in range(len(_TIME_CONSTANTS))]
