"""Search for the matrices of arrays, with weights that follow the fit."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.fitting.array import search as array_search
from gyrofuse.fitting.array.moments import array_moment_covariance, vech, weights_of
from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.fit import n_starts_for
from gyrofuse.fitting.moments.records import Records
from gyrofuse.fitting.structure import Composition

# Most steps with weights that follow the fit, the first of them with rough ones, and most steps after these.
_UPDATES, _ROUGH, _POLISHING = 20, 6, 100
# Changes of the fitted moments, chi-squares, with which these steps have come to rest.
_NEAR, _AT_REST = 1e-5, 1e-9
# Change of the fitted moments, chi-square, beyond which a minimum for weights that stay is another one.
_FAR = 0.1
# Starts, by how much their `x` differ in all, and the steps after which the best of them goes on alone.
_DISTINCT, _APART, _TRIAL = 5, 0.5, 12
# Part of the lowest level that each process begins with at least, although a sensor shows nothing of it.
_SEED = 1e-2


class _Problem(NamedTuple):
    """What is fitted to what.

    Attributes:
        moments: `(item, level, pair)` of unit size, 0 where there are none.
        present: Where there are, the same.
        records: Their length and levels.
        made_of: Structure of the model.
        weighting: Of the moments.
    """

    moments: Tensor
    present: Tensor
    records: Records
    made_of: Composition
    weighting: str

    @property
    def tau(self) -> Tensor:
        return self.records.tau.to(self.moments)

    def some(self, items: Tensor) -> _Problem:
        return self._replace(moments=self.moments[items], present=self.present[items])

    def fitted(self, root: Tensor, shape: Tensor) -> Tensor:
        """Moments of the model, `(item, level, pair)`."""
        return self.made_of.columns(self.tau, shape) @ vech(root @ root)

    def covariance(self, root: Tensor, shape: Tensor) -> Tensor:
        return array_moment_covariance(self.made_of, root @ root, shape, self.records)

    def step(self, weight: Tensor, root: Tensor, shape: Tensor, exact: bool) -> tuple[Tensor, Tensor]:
        return array_search.step_downhill(self.moments, weight, self.tau, self.made_of, root, shape, exact)

    def misfit(self, root: Tensor, shape: Tensor) -> Tensor:
        """`r' V^-1 r + ln det V`, which compares fits with different weights, `(item,)`."""
        weight = weights_of(self.covariance(root, shape), self.present, "optimal")
        distance = _squared(weight, self.moments - self.fitted(root, shape))
        return distance - torch.logdet(weight + torch.diag_embed((~self.present.flatten(1)).to(weight)))


def fit_matrices(
    gamma: Tensor, held: Tensor, records: Records, made_of: Composition, weighting: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit matrices to wavelet cross-covariances of sensors of unit size.

    Args:
        gamma: `(item, level, sensor, sensor)`, NaN where there is none.
        held: `x` of the tones, `(item, tone)`.
        records: Length and levels.
        made_of: Structure of the model.
        weighting: Of the moments.

    Returns:
        `Theta` `(item, process, sensor, sensor)`, `x` `(item, shaped)`, and whether the search came to rest.
    """
    present = vech(gamma).isfinite()
    problem = _Problem(torch.where(present, vech(gamma), 0.0), present, records, made_of, weighting)
    root, shape = _starts(gamma, held, records, made_of)  # (item, start, ...)
    n_items, n_starts = shape.shape[:2]
    root, shape = root.flatten(0, 1), shape.flatten(0, 1)
    if n_starts > 1:
        each = torch.arange(n_items, device=gamma.device)
        every = problem.some(each.repeat_interleave(n_starts))
        root, shape, _ = _follow(every, root, shape, _ROUGH, _TRIAL)
        score = every.misfit(root, shape).nan_to_num(nan=torch.inf)
        best = score.view(n_items, -1).argmin(-1) + n_starts * each
        root, shape = root[best], shape[best]
    root, shape, _ = _follow(problem, root, shape, 0 if n_starts > 1 else _ROUGH, _UPDATES)
    root, shape, rests = _settle(problem, root, shape)
    theta = root @ root
    # AR1s from slow to fast, tones from high to low frequency.
    place = torch.arange(made_of.n_linear, dtype=shape.dtype, device=shape.device).expand(len(shape), -1)
    order, shape = made_of.ordered(place, shape)
    return theta.take_along_dim(order.long()[..., None, None], 1), shape, rests


def _follow(problem: _Problem, root: Tensor, shape: Tensor, rough: int, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """`S` and `x` after steps with weights of where these start, and whether they came to rest.

    The first `rough` steps have the weights of pairs. A minimum for weights that stay would be far off where the data
    hardly tell a memory, and the next one far off on the other side. Weights of the mean of the covariances so far, of
    which the latest counts half, keep steps from going to and fro between two fits of which each has the other's
    weights.
    """
    root, shape, fitted = root.clone(), shape.clone(), torch.zeros_like(problem.moments)
    todo = torch.arange(len(shape), device=shape.device)
    rests = torch.zeros_like(todo, dtype=torch.bool)
    mean = shape.new_empty(0)
    for step in range(most):
        own, at, x = problem.some(todo), root[todo], shape[todo]
        covariance = own.covariance(at, x)
        mean = (mean + covariance) / 2 if step > rough else covariance
        weight = weights_of(mean, own.present, own.weighting if step >= rough else "pairwise")
        at, x = own.step(weight, at, x, exact=False)
        new = own.fitted(at, x)
        near = (_squared(weight, new - fitted[todo]) < _NEAR) & (step >= rough)
        root[todo], shape[todo], fitted[todo], rests[todo] = at, x, new, near
        todo, mean = todo[~near], mean[~near]
        if not len(todo):
            break
    return root, shape, rests


def _settle(problem: _Problem, root: Tensor, shape: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`S` and `x` of the minimum for the weights of where it starts, and whether the steps came to rest.

    Where that minimum is another one, which happens with a memory that the data hardly tell, its misfit is far larger
    with its own weights; there weights go on following the fit.
    """
    weight = weights_of(problem.covariance(root, shape), problem.present, problem.weighting)
    start = problem.fitted(root, shape)
    found, x = root.clone(), shape.clone()
    todo = torch.arange(len(shape), device=shape.device)
    rests = torch.zeros_like(todo, dtype=torch.bool)
    for _ in range(_POLISHING):
        own = problem.some(todo)
        before = own.fitted(found[todo], x[todo])
        found[todo], x[todo] = own.step(weight[todo], found[todo], x[todo], exact=True)
        rests[todo] = _squared(weight[todo], own.fitted(found[todo], x[todo]) - before) < _AT_REST
        todo = (~rests).nonzero()[:, 0]
        if not len(todo):
            break
    far = (_squared(weight, problem.fitted(found, x) - start) > _FAR).nonzero()[:, 0]
    if len(far):
        found[far], x[far], rests[far] = _follow(problem.some(far), root[far], shape[far], 0, _POLISHING)
    return found, x, rests


def _squared(weight: Tensor, move: Tensor) -> Tensor:
    """`d' W d`, `(item,)`, of moments `(item, level, pair)`."""
    flat = move.flatten(1)
    return ((weight @ flat[..., None])[..., 0] * flat).sum(-1)


def _starts(gamma: Tensor, held: Tensor, records: Records, made_of: Composition) -> tuple[Tensor, Tensor]:
    """`S` of uncorrelated sensors and `x`, `(item, start, ...)`: of each sensor's own fits, those that suit all."""
    tau = records.tau.to(gamma)
    nu = gamma.diagonal(dim1=-2, dim2=-1).mT  # (item, sensor, level)
    n_items, n_sensors, _ = nu.shape
    known = nu.isfinite().any(-1).to(nu)
    nu = torch.where(nu.isfinite(), nu, nu.nanmean(1, keepdim=True))
    weight = records.observations.to(nu) / nu.square()  # as of white noise
    everywhere = held[:, None].expand(-1, n_sensors, -1).flatten(0, 1)
    own = search.starting_points(
        nu.flatten(0, 1), weight.flatten(0, 1), tau, made_of, everywhere, n_starts_for(made_of)
    )  # (item sensor, start, shaped)
    target, root = (v.flatten(0, 1)[:, None].expand(-1, own.shape[1], -1).flatten(0, 1) for v in (nu, weight.sqrt()))
    n, n_shaped = n_sensors * own.shape[1], own.shape[2]
    own = search.minimise(target, root, tau, made_of, own.flatten(0, 1))[1].view(n_items, n, n_shaped)
    _, own = made_of.ordered(own.new_zeros(n_items, n, made_of.n_linear), own)
    # Each of them in every sensor: (item, candidate, sensor)
    target, root = (v[:, None].expand(-1, n, -1, -1).flatten(0, 2) for v in (nu, weight.sqrt()))
    shape = own[:, :, None].expand(-1, -1, n_sensors, -1).flatten(0, 2)
    linear, _, objective, _ = search.minimise(target, root, tau, made_of, shape, 0)
    linear = linear.view(n_items, n, n_sensors, -1)
    score = (objective.view(n_items, n, n_sensors) * known[:, None]).sum(-1).nan_to_num(nan=torch.inf)
    kept = []
    for _ in range(_DISTINCT if len(made_of.curved) > 1 else 1):
        kept.append(score.argmin(-1))
        near = (own - own.take_along_dim(kept[-1][:, None, None], 1)).abs().sum(-1) < _APART
        score = torch.where(near, torch.inf, score)
    best = torch.stack(kept, -1)  # (item, start)
    linear, shape = linear.take_along_dim(best[..., None, None], 1), own.take_along_dim(best[..., None], 1)
    least = _SEED * (nu[:, None, :, :, None] / made_of.columns(tau, shape)[:, :, None]).amin(-2)
    return torch.diag_embed(torch.maximum(linear, least).sqrt().mT), shape
