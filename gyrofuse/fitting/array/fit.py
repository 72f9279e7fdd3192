"""Search for the matrices of arrays, with weights that are updated with the fit."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.fitting.array import search as array_search
from gyrofuse.fitting.array.moments import array_moment_covariance, vech, weights_of
from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.fit import n_starts_for
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.structure import ModelStructure

# Largest number of steps with the weights of a fit that has come to rest. Flat valleys need some tens.
_POLISHING = 100


class _Problem(NamedTuple):
    """Moments and the model that is fitted to them.

    Methods take `root`, the square roots `S` of the matrices `Theta`, `(item, process, sensor, sensor)`, and `shape`,
    the `x` of the processes with a nonlinear parameter, `(item, shaped)`.

    Attributes:
        moments: Moments `(item, level, pair)` of unit size, 0 where there are none.
        present: Whether a moment was measured, `(item, level, pair)`.
        records: Length and levels of the records.
        structure: Structure of the model.
    """

    moments: Tensor
    present: Tensor
    records: SampleDesign
    structure: ModelStructure

    @property
    def tau(self) -> Tensor:
        return self.records.tau.to(self.moments)

    def some(self, items: Tensor) -> _Problem:
        """The problem of some items, given by their indices."""
        return self._replace(moments=self.moments[items], present=self.present[items])

    def fitted(self, root: Tensor, shape: Tensor) -> Tensor:
        """Moments of the model, `(item, level, pair)`."""
        return self.structure.columns(self.tau, shape) @ vech(root @ root)

    def covariance(self, root: Tensor, shape: Tensor) -> Tensor:
        """Covariance of the moments under the model, see `array_moment_covariance`."""
        return array_moment_covariance(self.structure, root @ root, shape, self.records)

    def step(self, weight: Tensor, root: Tensor, shape: Tensor, exact: bool) -> tuple[Tensor, Tensor]:
        """`S` and `x` after a step down the objective with fixed weights, see `step_downhill`."""
        return array_search.step_downhill(self.moments, weight, self.tau, self.structure, root, shape, exact)

    def objective(self, root: Tensor, shape: Tensor) -> Tensor:
        """`r' V^-1 r + ln det V`, which compares fits with different weights, `(item,)`."""
        weight = weights_of(self.covariance(root, shape), self.present)
        distance = _squared(weight, self.moments - self.fitted(root, shape))
        return distance - torch.logdet(weight + torch.diag_embed((~self.present.flatten(1)).to(weight)))


def fit_matrices(
    gamma: Tensor, held: Tensor, records: SampleDesign, structure: ModelStructure
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit matrices to wavelet cross-covariances of sensors of unit size.

    Args:
        gamma: Wavelet cross-covariances `(item, level, sensor, sensor)`, NaN where there is none.
        held: `x` of the sinusoids, `(item, sinusoid)`.
        records: Length and levels of the records.
        structure: Structure of the model.

    Returns:
        `Theta` `(item, process, sensor, sensor)`, `x` `(item, shaped)`, and whether the search came to rest.
    """
    present = vech(gamma).isfinite()
    problem = _Problem(torch.where(present, vech(gamma), 0.0), present, records, structure)
    root, shape = _starts(gamma, held, records, structure)  # (item, start, ...)
    n_items, n_starts = shape.shape[:2]
    root, shape = root.flatten(0, 1), shape.flatten(0, 1)
    if n_starts > 1:
        each = torch.arange(n_items, device=gamma.device)
        every = problem.some(each.repeat_interleave(n_starts))
        # Enough steps for the start next to the lowest minimum to have the lowest objective.
        root, shape, _ = _follow(every, root, shape, n_rough=6, n_steps=12)
        score = every.objective(root, shape).nan_to_num(nan=torch.inf)
        best = score.view(n_items, -1).argmin(-1) + n_starts * each
        root, shape = root[best], shape[best]
    root, shape, _ = _follow(problem, root, shape, n_rough=0 if n_starts > 1 else 6, n_steps=20)
    root, shape, rests = _settle(problem, root, shape)
    theta = root @ root
    # AR1s from slow to fast, sinusoids from high to low frequency.
    place = torch.arange(structure.n_linear, dtype=shape.dtype, device=shape.device).expand(len(shape), -1)
    order, shape = structure.ordered(place, shape)
    return theta.take_along_dim(order.long()[..., None, None], 1), shape, rests


def _follow(
    problem: _Problem, root: Tensor, shape: Tensor, n_rough: int, n_steps: int, at_rest: float = 1e-5
) -> tuple[Tensor, Tensor, Tensor]:
    """Steps whose weights are those of the fit before each of them.

    A minimum for fixed weights would be far off where a time constant is hardly determined, and the next one far off on
    the other side. The weights are those of the mean of the covariances so far, of which the latest counts half, which
    damps oscillations between two fits of which each has the other's weights.

    Args:
        problem: Moments and the model.
        root: `S` to start from, `(item, process, sensor, sensor)`.
        shape: `x` to start from, `(item, shaped)`.
        n_rough: Number of first steps in which pairs of sensors count as independent: rough, and cheap to get near.
        n_steps: Largest number of steps.
        at_rest: Change of the fitted moments, as a chi-square, below which they have come to rest.

    Returns:
        `S`, `x` and whether they came to rest, `(item,)`.
    """
    root, shape, fitted = root.clone(), shape.clone(), torch.zeros_like(problem.moments)
    todo = torch.arange(len(shape), device=shape.device)
    rests = torch.zeros_like(todo, dtype=torch.bool)
    mean = shape.new_empty(0)
    for step in range(n_steps):
        own, at, x = problem.some(todo), root[todo], shape[todo]
        covariance = own.covariance(at, x)
        mean = (mean + covariance) / 2 if step > n_rough else covariance
        weight = weights_of(mean, own.present, pairwise=step < n_rough)
        at, x = own.step(weight, at, x, exact=False)
        new = own.fitted(at, x)
        near = (_squared(weight, new - fitted[todo]) < at_rest) & (step >= n_rough)
        root[todo], shape[todo], fitted[todo], rests[todo] = at, x, new, near
        todo, mean = todo[~near], mean[~near]
        if not len(todo):
            break
    return root, shape, rests


def _settle(
    problem: _Problem, root: Tensor, shape: Tensor, at_rest: float = 1e-9, far: float = 0.1
) -> tuple[Tensor, Tensor, Tensor]:
    """Minimum for the weights of the point where the search starts.

    Where that minimum is another one, which happens with a time constant that is hardly determined, its objective is
    far larger with its own weights; there the weights go on following the fit.

    Args:
        problem: Moments and the model.
        root: `S` to start from, `(item, process, sensor, sensor)`.
        shape: `x` to start from, `(item, shaped)`.
        at_rest: Change of the fitted moments, as a chi-square, below which they have come to rest.
        far: Distance of the minimum from the start, as a chi-square, beyond which it is another one.

    Returns:
        `S`, `x` and whether they came to rest, `(item,)`.
    """
    weight = weights_of(problem.covariance(root, shape), problem.present)
    start = problem.fitted(root, shape)
    found, x = root.clone(), shape.clone()
    todo = torch.arange(len(shape), device=shape.device)
    rests = torch.zeros_like(todo, dtype=torch.bool)
    for _ in range(_POLISHING):
        own = problem.some(todo)
        before = own.fitted(found[todo], x[todo])
        found[todo], x[todo] = own.step(weight[todo], found[todo], x[todo], exact=True)
        rests[todo] = _squared(weight[todo], own.fitted(found[todo], x[todo]) - before) < at_rest
        todo = (~rests).nonzero()[:, 0]
        if not len(todo):
            break
    other = (_squared(weight, problem.fitted(found, x) - start) > far).nonzero()[:, 0]
    if len(other):
        found[other], x[other], rests[other] = _follow(problem.some(other), root[other], shape[other], 0, _POLISHING)
    return found, x, rests


def _squared(weight: Tensor, move: Tensor) -> Tensor:
    """`d' W d`, `(item,)`, of moments `(item, level, pair)`."""
    flat = move.flatten(1)
    return ((weight @ flat[..., None])[..., 0] * flat).sum(-1)


def _starts(
    gamma: Tensor,
    held: Tensor,
    records: SampleDesign,
    structure: ModelStructure,
    *,
    n_distinct: int = 5,
    apart: float = 0.5,
    least_share: float = 1e-2,
) -> tuple[Tensor, Tensor]:
    """Starting points: uncorrelated sensors with the `x` of single sensors' fits that fit all sensors best.

    Args:
        gamma: Wavelet cross-covariances `(item, level, sensor, sensor)`.
        held: `x` of the sinusoids, `(item, sinusoid)`.
        records: Length and levels of the records.
        structure: Structure of the model.
        n_distinct: Number of starting points with several AR1s or sinusoids to be found; one is enough otherwise.
        apart: Smallest distance between the `x` of two of them, the sum of absolute differences.
        least_share: Smallest share of a sensor's lowest level that each process starts with, as a matrix of zero would
            not move.

    Returns:
        `S` and `x`, `(item, start, ...)`.
    """
    tau = records.tau.to(gamma)
    nu = gamma.diagonal(dim1=-2, dim2=-1).mT  # (item, sensor, level)
    n_items, n_sensors, _ = nu.shape
    known = nu.isfinite().any(-1).to(nu)
    nu = torch.where(nu.isfinite(), nu, nu.nanmean(1, keepdim=True))
    weight = records.observations.to(nu) / nu.square()  # as of white noise
    everywhere = held[:, None].expand(-1, n_sensors, -1).flatten(0, 1)
    own = search.starting_points(
        nu.flatten(0, 1), weight.flatten(0, 1), tau, structure, everywhere, n_starts_for(structure)
    )  # (item sensor, start, shaped)
    target, root = (v.flatten(0, 1)[:, None].expand(-1, own.shape[1], -1).flatten(0, 1) for v in (nu, weight.sqrt()))
    n, n_shaped = n_sensors * own.shape[1], own.shape[2]
    own = search.minimise(target, root, tau, structure, own.flatten(0, 1))[1].view(n_items, n, n_shaped)
    _, own = structure.ordered(own.new_zeros(n_items, n, structure.n_linear), own)
    # Each of them in every sensor: (item, candidate, sensor)
    target, root = (v[:, None].expand(-1, n, -1, -1).flatten(0, 2) for v in (nu, weight.sqrt()))
    shape = own[:, :, None].expand(-1, -1, n_sensors, -1).flatten(0, 2)
    linear, _, objective, _ = search.minimise(target, root, tau, structure, shape, 0)
    linear = linear.view(n_items, n, n_sensors, -1)
    score = (objective.view(n_items, n, n_sensors) * known[:, None]).sum(-1).nan_to_num(nan=torch.inf)
    kept = []
    for _ in range(n_distinct if len(structure.free_nonlinear) > 1 else 1):
        kept.append(score.argmin(-1))
        near = (own - own.take_along_dim(kept[-1][:, None, None], 1)).abs().sum(-1) < apart
        score = torch.where(near, torch.inf, score)
    best = torch.stack(kept, -1)  # (item, start)
    linear, shape = linear.take_along_dim(best[..., None, None], 1), own.take_along_dim(best[..., None], 1)
    least = least_share * (nu[:, None, :, :, None] / structure.columns(tau, shape)[:, :, None]).amin(-2)
    return torch.diag_embed(torch.maximum(linear, least).sqrt().mT), shape
