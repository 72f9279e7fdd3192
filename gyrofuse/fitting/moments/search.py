"""Minimum of weighted distances between wavelet variances and those of a model, for many records at once.

Variances are solved for inside (variable projection with non-negative least squares), so that the search runs over the
few parameters that are not linear: from the best points of a grid, by Levenberg-Marquardt with Kaufman's Jacobian.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from gyrofuse._base.chunks import items_at_once
from gyrofuse._base.nnls import nonnegative_least_squares
from gyrofuse._base.optimize import Trial, descend
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.processes import Process


def starting_points(
    target: Tensor,
    weight: Tensor,
    tau: Tensor,
    structure: ModelStructure,
    held: Tensor,
    n_starts: int,
    fixed: tuple[int, Tensor] | None = None,
) -> Tensor:
    """The best points of a grid that are not neighbours.

    Args:
        target: Wavelet variances, `(item, level)`.
        weight: Of each squared residual, `(item, level)`.
        tau: `(level,)`.
        structure: Structure of the model.
        held: `x` of the sinusoids where these are held, `(item, sinusoid)`.
        n_starts: How many; fewer where the grid has fewer.
        fixed: A process, and its `p` `(item,)`; None where all are free.

    Returns:
        `x` of the shaped processes, `(item, start, shaped)`.
    """
    free = structure.free_nonlinear
    n_items = len(target)
    if not free:
        return held[:, None]
    axes, blocks = [], []
    for kind, group in itertools.groupby(free, key=lambda k: type(structure.processes[k])):
        grid = _grid(kind, tau)
        blocks.append(list(itertools.combinations(range(len(grid)), len(list(group)))))
        axes.append(grid)
    index = [tuple(itertools.chain(*parts)) for parts in itertools.product(*blocks)]
    which = [n for n, block in enumerate(blocks) for _ in block[0]]
    points = torch.stack([axes[n][torch.tensor([i[d] for i in index])] for d, n in enumerate(which)], -1).to(target)
    objective = []
    for part in points.split(items_at_once(n_items * len(tau) * len(structure.processes))):
        # What does not differ between the items is computed once.
        n_own = n_items if held.shape[-1] else 1
        values = structure.columns(tau, _with_held(part[None].expand(n_own, -1, -1), held, structure))
        given = (fixed[0], fixed[1][:, None]) if fixed else None
        objective.append(_solve(values, target[:, None], weight.sqrt()[:, None], given)[1])
    cost = torch.cat(objective, -1)  # (item, point)
    place = torch.tensor(index, device=target.device)
    chosen = []
    for _ in range(min(n_starts, len(points))):
        best = cost.argmin(-1)
        chosen.append(points[best])
        near = (place - place[best][:, None]).abs().amax(-1) <= 1
        cost = torch.where(near, torch.inf, cost)
    return _with_held(torch.stack(chosen, 1), held, structure)


def minimise(
    target: Tensor,
    root: Tensor,
    tau: Tensor,
    structure: ModelStructure,
    start: Tensor,
    n_steps: int = 30,
    *,
    fixed: tuple[int, Tensor] | None = None,
    still: int | None = None,
    enough: float = 1e-10,
    shortest_step: float = 1e-7,
    longest_step: float = 2.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Levenberg-Marquardt on `|W (target - u(x) p)|^2`.

    Args:
        target: `(problem, level)`.
        root: `W`, `(problem, level, level)`, or `(problem, level)` where it is diagonal.
        tau: `(level,)`.
        structure: Structure of the model.
        start: `x`, `(problem, shaped)`.
        n_steps: At most so many steps.
        fixed: A process, and its `p` `(problem,)`; None where all are free.
        still: One of `x` that stays where it starts.
        enough: Share of the objective by which a step has to lower it to be followed by another.
        shortest_step: Change of `x` below which a step that does not lower the objective fails for rounding.
        longest_step: Largest change of an `x` in one step: `atanh phi` and `logit` are nearly linear that far.

    Returns:
        `p` `(problem, linear)`, `x` `(problem, shaped)`, the minimum `(problem,)` and whether it was reached.
    """
    moving = [at for at in map(structure.nonlinear.index, structure.free_nonlinear) if at != still]
    linear, objective = _evaluate(target, root, tau, structure, start, fixed)
    if not moving:
        return linear, start.clone(), objective, torch.ones_like(objective, dtype=torch.bool)
    low, high = (ends[moving] for ends in limits(structure, tau, start))

    def attempt(todo: Tensor, state: list[Tensor], old: Tensor, damping: Tensor) -> Trial:
        x, p = state
        y, w = target[todo], root[todo]
        values, slope = structure.columns(tau, x), structure.slopes(tau, x)
        jacobian = _times(w, slope * p[:, None, structure.nonlinear])[..., moving]
        free = p > 0
        if fixed:
            free[:, fixed[0]] = False
        jacobian = jacobian - _projected(_times(w, values), free, jacobian)
        residual = _times(w, y[..., None] - values @ p[..., None])
        gradient = (jacobian.mT @ residual)[..., 0]
        normal = jacobian.mT @ jacobian
        size = normal.diagonal(dim1=-2, dim2=-1)
        # An AR1 whose variance is zero does not move.
        own_size = torch.where(size > 0, size, 1.0)
        step = torch.linalg.solve_ex(normal + torch.diag_embed(damping[:, None] * own_size), gradient)[0]
        tried = x.clone()
        tried[:, moving] = (x[:, moving] + step.clamp(-longest_step, longest_step)).clamp(low, high)
        given = (fixed[0], fixed[1][todo]) if fixed else None
        new_linear, new = _evaluate(y, w, tau, structure, tried, given)
        better = new < old
        last = torch.where(better, old - new <= enough * old, step.abs().amax(-1) < shortest_step)
        return Trial((tried, new_linear), new, better, last)

    (x, linear), objective, done = descend((start, linear), objective, attempt, n_steps=n_steps, ease=5, tighten=4)
    return linear, x, objective, done & objective.isfinite()


def distinct(objective: Tensor, x: Tensor, n_kept: int, close: float = 1e-3) -> Tensor:
    """Indices `(item, kept)` of the best starts of `x` `(item, start, shaped)` that differ from one another."""
    cost = torch.where(objective.isfinite(), objective, torch.finfo(objective.dtype).max)
    kept = []
    for _ in range(min(n_kept, cost.shape[1])):
        best = cost.argmin(-1)
        kept.append(best)
        same = (x - x.gather(1, best[:, None, None].expand(-1, 1, x.shape[-1]))).abs().sum(-1) < close
        same |= torch.arange(cost.shape[1], device=cost.device) == best[:, None]
        cost = torch.where(same, torch.inf, cost)
    return torch.stack(kept, 1)


def whitening(covariance: Tensor) -> Tensor:
    """`W` with `W' W = V^-1`, lower triangular; NaN where there is none."""
    root, failed = torch.linalg.cholesky_ex(covariance)
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    found = torch.linalg.solve_triangular(root, eye.expand_as(root), upper=False)
    return torch.where((failed > 0)[:, None, None], torch.nan, found)


def _evaluate(
    target: Tensor, root: Tensor, tau: Tensor, structure: ModelStructure, x: Tensor, fixed: tuple[int, Tensor] | None
) -> tuple[Tensor, Tensor]:
    return _solve(structure.columns(tau, x), target, root, fixed)


def _solve(values: Tensor, target: Tensor, root: Tensor, fixed: tuple[int, Tensor] | None) -> tuple[Tensor, Tensor]:
    """Variances that fit best, and the distance left; `values` `(..., level, linear)`."""
    columns, y = _times(root, values), _times(root, target[..., None])
    others = columns
    if fixed:
        k, value = fixed
        y = y - value[..., None, None] * columns[..., k : k + 1]
        others = columns.clone()
        others[..., k] = 0.0  # whose own solution is zero
    linear = nonnegative_least_squares(others.mT @ others, (others.mT @ y)[..., 0])
    objective = (y - others @ linear[..., None]).square().sum((-2, -1))
    if fixed:
        linear[..., k] = value
    return linear, objective


def _times(root: Tensor, matrix: Tensor) -> Tensor:
    return root @ matrix if root.ndim == matrix.ndim else root[..., None] * matrix


def _projected(columns: Tensor, active: Tensor, matrix: Tensor) -> Tensor:
    """Projection of `matrix` on the active columns."""
    size = columns.norm(dim=-2, keepdim=True)
    columns = columns / torch.where(size > 0, size, 1.0) * active[:, None]
    gram = columns.mT @ columns + torch.diag_embed((~active).to(columns) + 1e-13)
    return columns @ torch.linalg.solve_ex(gram, columns.mT @ matrix)[0]


def _with_held(free: Tensor, held: Tensor, structure: ModelStructure) -> Tensor:
    """`x` of all shaped processes from those of the free ones, `(item, point, free)`, and of the held sinusoids."""
    if not structure.held or held.shape[-1] == 0:
        return free
    parts, at_free, at_held = [], iter(free.unbind(-1)), iter(held.unbind(-1))
    for k in structure.nonlinear:
        found = k in structure.free_nonlinear
        parts.append(next(at_free) if found else next(at_held)[:, None].expand(free.shape[:2]))
    return torch.stack(parts, -1)


def _grid(kind: type[Process], tau: Tensor) -> Tensor:
    longest, shortest = kind.time_scales(float(tau[-1]))
    octaves = torch.arange(0, math.log2(longest / shortest), 1 / kind.starts_per_octave, dtype=torch.float64)
    return with_alternating(kind, kind.from_time_scale(longest / 2.0**octaves))


def with_alternating(kind: type[Process], x: Tensor, phi: tuple[float, ...] = (-0.3, -0.7)) -> Tensor:
    """Starts of a search `(start,)`, with some that alternate in sign: these are rare, but some filters leave them."""
    return torch.cat([x, kind.to_unconstrained(x.new_tensor(phi))]) if kind.alternates else x


def limits(structure: ModelStructure, tau: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest `x` of the shaped processes, `(shaped,)`."""
    low, high = [], []
    for k in structure.nonlinear:
        least, most = structure.processes[k].unconstrained_limits(float(tau[-1]))
        low.append(least)
        high.append(most)
    return x.new_tensor(low), x.new_tensor(high)
