"""Minimum of a weighted distance between the wavelet cross-covariance of arrays and that of a model.

Matrices are `Theta = L L'` and move to `L exp(D) L'` with a symmetric `D`: they stay positive whatever the step, and
a matrix that wants to lose rank does so as fast as its logarithm can fall.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse import _moment_search as search
from gyrofuse._array_moments import pairs, unvech, vech
from gyrofuse._composition import Composition

# The longest step of a logarithm.
_STRIDE = 3.0
# Damping of a step, relative to the diagonal, one after the other until it leads downhill.
_DAMPINGS = (1e-7, 1e-4, 1e-2, 1.0, 1e2)


def step_downhill(
    gamma: Tensor, weight: Tensor, tau: Tensor, made_of: Composition, root: Tensor, shape: Tensor
) -> tuple[Tensor, Tensor]:
    """One damped Newton step on `r' W r`, `r = gamma - sum_k u_k(x) Theta_k`.

    Args:
        gamma: Moments `(item, level, pair)`; those without weight may be anything finite.
        weight: `W`, `(item, moment, moment)`.
        tau: `(level,)`.
        made_of: Structure of the model.
        root: `L`, `(item, process, sensor, sensor)`.
        shape: `x`, `(item, shaped)`.

    Returns:
        `L` and `x`, as they were where no step leads downhill.
    """
    root, shape = root.clone(), shape.clone()
    moving = [made_of.shaped.index(k) for k in made_of.curved]
    low, high = (ends[moving] for ends in search.limits(made_of, tau, shape))
    distance = _distance(gamma, weight, tau, made_of, root, shape)
    gradient, normal = _quadratic(gamma, weight, tau, made_of, root, shape)
    size = normal.diagonal(dim1=-2, dim2=-1)
    # What no moment depends on does not move.
    still = torch.diag_embed(1e-12 * size.mean(-1, keepdim=True) + torch.finfo(size.dtype).tiny + 0 * size)
    todo = distance.isfinite().nonzero()[:, 0]
    for damping in _DAMPINGS:
        at, x = root[todo], shape[todo]
        system = normal[todo] + still[todo] + torch.diag_embed(damping * size[todo])
        step = torch.linalg.solve_ex(system, gradient[todo])[0]
        n_linear = step.shape[-1] - len(moving)
        values, vectors = torch.linalg.eigh(_in_basis(step[:, :n_linear].unflatten(-1, (root.shape[1], -1))))
        tried = at @ (vectors * (values.clamp(-_STRIDE, _STRIDE) / 2).exp()[..., None, :]) @ vectors.mT
        moved = x.clone()
        moved[:, moving] = (x[:, moving] + step[:, n_linear:].clamp(-1, 1)).clamp(low, high)
        better = _distance(gamma[todo], weight[todo], tau, made_of, tried, moved) <= distance[todo]
        root[todo] = torch.where(better[:, None, None, None], tried, at)
        shape[todo] = torch.where(better[:, None], moved, x)
        todo = todo[~better]
        if not len(todo):
            break
    return root, shape


def _distance(gamma: Tensor, weight: Tensor, tau: Tensor, made_of: Composition, root: Tensor, shape: Tensor) -> Tensor:
    residual = (gamma - made_of.columns(tau, shape) @ vech(root @ root.mT)).flatten(1)
    return ((weight @ residual[..., None])[..., 0] * residual).sum(-1)


def jacobian(tau: Tensor, made_of: Composition, theta: Tensor, shape: Tensor) -> Tensor:
    """Derivatives of the moments by the entries of `Theta` and by `x`, `(item, moment, unknown)`."""
    n_items, n_pairs = len(theta), vech(theta).shape[-1]
    values = made_of.columns(tau, shape)
    eye = torch.eye(n_pairs, dtype=theta.dtype, device=theta.device)
    linear = torch.einsum("njk,qr->njqkr", values, eye).reshape(n_items, len(tau) * n_pairs, -1)
    moving = [made_of.shaped.index(k) for k in made_of.curved]
    slopes = made_of.slopes(tau, shape)[..., moving]
    curved = torch.einsum("njs,nsq->njqs", slopes, vech(theta)[:, made_of.curved]).flatten(1, 2)
    return torch.cat([linear, curved], -1)


def _quadratic(
    gamma: Tensor, weight: Tensor, tau: Tensor, made_of: Composition, root: Tensor, shape: Tensor
) -> tuple[Tensor, Tensor]:
    """Half of the gradient downhill and of the second derivatives, by `D` in the basis and by `x`, item by item.

    `exp(D) = 1 + D + D^2/2` adds `tr(M D^2) / 2` with `M = L' G L` and the gradient `G` by `Theta`, of which the
    positive part is kept: then a step is always one downhill.
    """
    n_items, n_levels, n_pairs = gamma.shape
    n_processes = root.shape[1]
    theta = vech(root @ root.mT)
    moving = [made_of.shaped.index(k) for k in made_of.curved]
    values, slopes = made_of.columns(tau, shape), made_of.slopes(tau, shape)[..., moving]
    residual = gamma - values @ theta
    weighted = (weight @ residual.flatten(1)[..., None]).view_as(gamma)
    both = torch.cat([values, slopes], -1)  # (item, level, k), k: processes, then shapes
    downhill = both.mT @ weighted  # (item, k, pair)
    # Sums over levels on both sides of W: (item, k, pair, k, pair)
    half = both.mT @ weight.reshape(n_items, n_levels, -1)
    half = half.view(n_items, -1, n_pairs, n_levels, n_pairs).movedim(3, -1) @ both[:, None, None]
    full = half.transpose(-1, -2)
    # Moves of Theta along the basis, (item, process, pair, basis), and of the shapes along theta
    moves = vech(root[:, :, None] @ _basis(root) @ root[:, :, None].mT).mT
    along = theta[:, made_of.curved]
    linear = torch.einsum("nkqa,nkqmr,nmrb->nkamb", moves, full[:, :n_processes, :, :n_processes], moves)
    mixed = torch.einsum("nkqa,nkqsr,nsr->nkas", moves, full[:, :n_processes, :, n_processes:], along)
    curved = torch.einsum("nsq,nsqtr,ntr->nst", along, full[:, n_processes:, :, n_processes:], along)
    gradient = torch.cat(
        [
            torch.einsum("nkqa,nkq->nka", moves, downhill[:, :n_processes]).flatten(1),
            (along * downhill[:, n_processes:]).sum(-1),
        ],
        -1,
    )
    linear.diagonal(dim1=1, dim2=3).add_(_bend(root, downhill[:, :n_processes]).movedim(1, -1))
    top = torch.cat([linear.flatten(3).flatten(1, 2), mixed.flatten(1, 2)], -1)
    return gradient, torch.cat([top, torch.cat([mixed.flatten(1, 2).mT, curved], -1)], -2)


def _bend(root: Tensor, downhill: Tensor) -> Tensor:
    """The second derivatives of `tr(M D^2) / 2`, `(item, process, basis, basis)`."""
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    gradient = -unvech(downhill) * (1 + eye) / 2
    values, vectors = torch.linalg.eigh(root.mT @ gradient @ root)
    positive = (vectors * values.clamp(min=0)[..., None, :]) @ vectors.mT
    basis = _basis(root)
    bend = (positive[:, :, None] @ basis).flatten(-2) @ basis.flatten(-2).mT
    return (bend + bend.mT) / 2


def _basis(like: Tensor) -> Tensor:
    """Orthonormal symmetric matrices `(basis, sensor, sensor)`."""
    n_sensors = like.shape[-1]
    first, second = pairs(n_sensors)
    basis = torch.zeros(len(first), n_sensors, n_sensors, dtype=like.dtype, device=like.device)
    size = torch.where(first == second, 1.0, 0.5**0.5).to(like)
    basis[range(len(first)), first, second] = size
    basis[range(len(first)), second, first] = size
    return basis


def _in_basis(coordinates: Tensor) -> Tensor:
    """The symmetric matrix `(..., sensor, sensor)` with these coordinates `(..., basis)`."""
    matrix = unvech(coordinates)
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return matrix * (eye + (1 - eye) * 0.5**0.5)
