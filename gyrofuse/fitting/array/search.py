"""Minimum of a weighted distance between the wavelet cross-covariance of arrays and that of a model.

Matrices are `Theta = S S` with a symmetric `S`, and steps are of `S`: they stay positive whatever the step, and one
that wants to lose rank does so in a few steps, since the distance is quadratic in what `S` loses.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse._base.optimize import Trial, descend
from gyrofuse.fitting.array.moments import pairs, unvech, vech
from gyrofuse.fitting.moments import search
from gyrofuse.fitting.structure import ModelStructure


def step_downhill(
    gamma: Tensor,
    weight: Tensor,
    tau: Tensor,
    structure: ModelStructure,
    root: Tensor,
    shape: Tensor,
    exact: bool,
    *,
    longest_step: float = 1.0,
    flat: float = 1e-10,
    least: float = 1e-10,
) -> tuple[Tensor, Tensor]:
    """One damped Newton step on `r' W r`, `r = gamma - sum_k u_k(x) Theta_k`.

    Args:
        gamma: Moments `(item, level, pair)` of unit size; those without weight may be anything finite.
        weight: `W`, `(item, moment, moment)`.
        tau: `(level,)`.
        structure: Structure of the model.
        root: `S`, `(item, process, sensor, sensor)`.
        shape: `x`, `(item, shaped)`.
        exact: Whether all second derivatives are used, which also leave saddles; else those that are never negative,
            whose steps are shorter far from a minimum.
        longest_step: Largest change of an `x`, which is nearly linear that far.
        flat: Curvature, relative to the scaled ones, that is added to each: below it a direction is rounding.
        least: Smallest contribution of an eigenvalue of `Theta` to a moment of unit size: a step of `S` cannot leave
            zero itself.

    Returns:
        `S` and `x`, as they were where no step leads downhill.
    """
    moving = [structure.nonlinear.index(k) for k in structure.free_nonlinear]
    low, high = (ends[moving] for ends in search.limits(structure, tau, shape))
    distance = _distance(gamma, weight, tau, structure, root, shape)
    gradient, bends, size = _quadratic(gamma, weight, tau, structure, root, shape, exact)
    # What no moment depends on does not move.
    unit = torch.where(size > 0, size, 1.0).rsqrt()
    scaled = unit[..., :, None] * bends * unit[..., None, :]
    finite = distance.isfinite() & scaled.isfinite().flatten(1).all(-1)
    curvature, vectors = torch.linalg.eigh(torch.where(finite[:, None, None], scaled, 0.0))
    # Where the distance bends down a step leads away from the saddle, as long as if it bent up.
    curvature = curvature.abs() + flat
    downhill = (vectors.mT @ (unit * gradient)[..., None])[..., 0]
    undamped = 1e-6  # damping, relative to the scaled curvatures, that counts as none: of the first attempt

    def attempt(todo: Tensor, state: list[Tensor], old: Tensor, damping: Tensor) -> Trial:
        at, x = state
        damped = curvature[todo] + torch.where(damping > undamped, damping, 0.0)[:, None]
        step = unit[todo] * (vectors[todo] @ (downhill[todo] / damped)[..., None])[..., 0]
        n_linear = step.shape[-1] - len(moving)
        tried = at + _in_basis(step[:, :n_linear].unflatten(-1, (at.shape[1], -1)))
        moved = x.clone()
        moved[:, moving] = (x[:, moving] + step[:, n_linear:].clamp(-longest_step, longest_step)).clamp(low, high)
        new = _distance(gamma[todo], weight[todo], tau, structure, tried, moved)
        return Trial((tried, moved), new, new <= old, new <= old)

    # The damping rises until a step leads downhill, at most to 100 times the curvatures.
    start = torch.where(finite, distance, torch.nan)
    (root, shape), _, _ = descend((root, shape), start, attempt, n_steps=5, ease=1, tighten=100, damping=undamped)
    return square_root(root @ root, least / structure.columns(tau, shape).amax(-2)), shape


def square_root(theta: Tensor, least: Tensor) -> Tensor:
    """The symmetric `S` with `S S = Theta`, of eigenvalues of at least `least` `(item, process)`."""
    values, vectors = torch.linalg.eigh(theta)
    return (vectors * torch.maximum(values, least[..., None]).sqrt()[..., None, :]) @ vectors.mT


def _distance(
    gamma: Tensor, weight: Tensor, tau: Tensor, structure: ModelStructure, root: Tensor, shape: Tensor
) -> Tensor:
    residual = (gamma - structure.columns(tau, shape) @ vech(root @ root)).flatten(1)
    return ((weight @ residual[..., None])[..., 0] * residual).sum(-1)


def jacobian(tau: Tensor, structure: ModelStructure, theta: Tensor, shape: Tensor) -> Tensor:
    """Derivatives of the moments by the entries of `Theta` and by `x`, `(item, moment, unknown)`."""
    n_items, n_pairs = len(theta), vech(theta).shape[-1]
    values = structure.columns(tau, shape)
    eye = torch.eye(n_pairs, dtype=theta.dtype, device=theta.device)
    linear = torch.einsum("njk,qr->njqkr", values, eye).reshape(n_items, len(tau) * n_pairs, -1)
    moving = [structure.nonlinear.index(k) for k in structure.free_nonlinear]
    slopes = structure.slopes(tau, shape)[..., moving]
    free_nonlinear = torch.einsum("njs,nsq->njqs", slopes, vech(theta)[:, structure.free_nonlinear]).flatten(1, 2)
    return torch.cat([linear, free_nonlinear], -1)


def _quadratic(
    gamma: Tensor, weight: Tensor, tau: Tensor, structure: ModelStructure, root: Tensor, shape: Tensor, exact: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Half of the gradient downhill and of the second derivatives, by `S` in the basis and by `x`, item by item.

    `exact` has those of the model in it, weighted with the residuals; else only what of them bends the distance up. The
    third is a curvature for the scale of each unknown, `(item, unknown)`, positive where any moment depends on it.
    """
    n_items, n_levels, n_pairs = gamma.shape
    n_processes = root.shape[1]
    theta = vech(root @ root)
    moving = [structure.nonlinear.index(k) for k in structure.free_nonlinear]
    values, slopes = structure.columns(tau, shape), structure.slopes(tau, shape)[..., moving]
    residual = gamma - values @ theta
    weighted = (weight @ residual.flatten(1)[..., None]).view_as(gamma)
    both = torch.cat([values, slopes], -1)  # (item, level, k), k: processes, then shapes
    downhill = both.mT @ weighted  # (item, k, pair)
    # Sums over levels on both sides of W: (item, k, pair, k, pair)
    half = both.mT @ weight.reshape(n_items, n_levels, -1)
    half = half.view(n_items, -1, n_pairs, n_levels, n_pairs).movedim(3, -1) @ both[:, None, None]
    full = half.transpose(-1, -2)
    # Moves of Theta along the basis, (item, process, pair, basis), and of the shapes along theta
    side = root[:, :, None] @ _basis(root)
    free = _free(weight, n_pairs)
    moves = vech(side + side.mT).mT * free[:, None, None]
    along = theta[:, structure.free_nonlinear]
    linear = torch.einsum("nkqa,nkqmr,nmrb->nkamb", moves, full[:, :n_processes, :, :n_processes], moves)
    mixed = torch.einsum("nkqa,nkqsr,nsr->nkas", moves, full[:, :n_processes, :, n_processes:], along)
    free_nonlinear = torch.einsum("nsq,nsqtr,ntr->nst", along, full[:, n_processes:, :, n_processes:], along)
    gradient = torch.cat(
        [
            torch.einsum("nkqa,nkq->nka", moves, downhill[:, :n_processes]).flatten(1),
            (along * downhill[:, n_processes:]).sum(-1),
        ],
        -1,
    )
    both_free = (free[:, :, None] * free[:, None])[:, None]
    plain = torch.cat([torch.einsum("nkaka->nka", linear).flatten(1), torch.einsum("nss->ns", free_nonlinear)], -1)
    linear.diagonal(dim1=1, dim2=3).add_((_bend(root, downhill[:, :n_processes], exact) * both_free).movedim(1, -1))
    if exact:
        for at, k in enumerate(structure.free_nonlinear):
            mixed[:, k, :, at] -= torch.einsum("nqa,nq->na", moves[:, k], downhill[:, n_processes + at])
        apart = 1e-4  # in `x`, of the two slopes: rounding and the third derivative both leave 1e-8 of the second
        ahead, behind = (structure.slopes(tau, shape + sign * apart)[..., moving] for sign in (1, -1))
        second = (ahead - behind) / (2 * apart)
        free_nonlinear.diagonal(dim1=1, dim2=2).sub_((along * (second.mT @ weighted)).sum(-1))
    top = torch.cat([linear.flatten(3).flatten(1, 2), mixed.flatten(1, 2)], -1)
    bends = torch.cat([top, torch.cat([mixed.flatten(1, 2).mT, free_nonlinear], -1)], -2)
    return gradient, bends, torch.maximum(plain, bends.diagonal(dim1=-2, dim2=-1).abs())


def _free(weight: Tensor, n_pairs: int) -> Tensor:
    """1 for directions of the basis between sensors with moments, else 0, `(item, basis)`: the others stay."""
    measured = (weight.diagonal(dim1=-2, dim2=-1).unflatten(-1, (-1, n_pairs)) > 0).any(1)
    first, second = pairs(int((2 * n_pairs) ** 0.5))
    own = measured[:, first == second]
    return (own[:, first] & own[:, second]).to(weight)


def _bend(root: Tensor, downhill: Tensor, exact: bool) -> Tensor:
    """Half of the second derivatives of `2 tr(G D^2)`, `G` half of the gradient by `Theta`, or its positive part.

    Returns:
        `(item, process, basis, basis)`.
    """
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    gradient = -unvech(downhill) * (1 + eye) / 2
    if not exact:
        values, vectors = torch.linalg.eigh(gradient)
        gradient = (vectors * values.clamp(min=0)[..., None, :]) @ vectors.mT
    basis = _basis(root)
    bend = (gradient[:, :, None] @ basis).flatten(-2) @ basis.flatten(-2).mT
    return bend + bend.mT


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
