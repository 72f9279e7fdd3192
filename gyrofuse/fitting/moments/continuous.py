"""Moment fits that go on from the one with weights held: weights `V(theta)^-1` that move along, or logarithms."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.fit import fit_items
from gyrofuse.fitting.moments.inference import Fit
from gyrofuse.fitting.moments.log_moments import log_residual
from gyrofuse.fitting.moments.records import Records
from gyrofuse.fitting.structure import Composition

_STEPS, _ENOUGH, _SHORTEST_STEP, _LONGEST_STEP, _MOST_DAMPING = 100, 1e-12, 1e-9, 1.0, 1e10
_FLATTEST = 1e-12  # second derivative
_ITEMS_AT_ONCE = 256  # the graph of V is much larger than V
# Share of where it started below which a variance is tried at zero; how many nats one may fall and rise.
_AS_GOOD_AS_ZERO, _MOST_FALL, _MOST_RISE = 1e-6, 50.0, 10.0
_ROUNDS, _STEPS_A_ROUND, _LONGEST_PACE, _SAME = 100, 4, 8.0, 1e-7


def fit_moments(
    nu: Tensor,
    frequencies: tuple[Tensor, Tensor] | None,
    records: Records,
    made_of: Composition,
    omega: str | Tensor,
    moments: str,
) -> Fit:
    """`moment_fit.fit_items`, and on from there where `omega` is `"continuous"` or `moments` are `"log"`."""
    fit = fit_items(nu, frequencies, records, made_of, "optimal" if omega == "continuous" else omega)
    if omega == "continuous":
        return continued(fit, made_of)
    return fit_logs(fit, made_of) if moments == "log" else fit


def continued(fit: Fit, made_of: Composition) -> Fit:
    """The minimum of `r' V(theta)^-1 r`, `V` moving along, downhill from a fit (continuously updated GMM).

    Newton's method, damped, with exact derivatives in `ln p` and `x`: where `V` moves, steps that take the residuals
    for linear jump across the valley. Variances at zero stay there, and one on its way there is set to zero where that
    is no worse. An item is not converged where there is no minimum, as where variances grow on and on to excuse the
    residuals.

    Args:
        fit: Where the search with `V` held ended.
        made_of: Structure of the model.

    References:
        L. P. Hansen, J. Heaton, A. Yaron, Journal of Business & Economic Statistics 14, 1996.
    """
    # Scaled so that no record is small to rounding.
    size = fit.variance.amax(-1, keepdim=True)
    found = [
        _descended(_Distance(target, p, x, fit.records, made_of))
        for target, p, x in zip(
            *(part.split(_ITEMS_AT_ONCE) for part in (fit.variance / size, fit.linear / size, fit.shape)), strict=True
        )
    ]
    linear, shape, reached = (torch.cat(parts) for parts in zip(*found, strict=True))
    linear, shape = made_of.ordered(linear * size, shape)
    return replace(fit, linear=linear, shape=shape, converged=fit.converged & reached, omega="continuous")


class _Distance:
    """`r' V^-1 r` of the model at `u`: `ln p` of all processes, then the `x` that are unknown.

    Args:
        target: Wavelet variances `(item, level)`.
        linear: `p` to start from, `(item, process)`.
        shape: `x` to start from, `(item, shaped)`.
        records: What was measured.
        made_of: Structure of the model.
    """

    def __init__(self, target: Tensor, linear: Tensor, shape: Tensor, records: Records, made_of: Composition) -> None:
        self._target, self._shape, self._records, self._made_of = target, shape, records, made_of
        self._tau = records.tau.to(target)
        self._moving = [made_of.shaped.index(k) for k in made_of.curved]
        self.present = linear > 0
        first = torch.where(self.present, linear, 1.0).log()
        self.start = torch.cat([first, shape[:, self._moving]], -1)
        low, high = (end[self._moving].expand(len(shape), -1) for end in search.limits(made_of, self._tau, shape))
        self.low = torch.cat([first - _MOST_FALL, low], -1)
        self.high = torch.cat([first + _MOST_RISE, high], -1)

    def __call__(self, u: Tensor, items: Tensor) -> Tensor:
        """`(item,)`; NaN where `V` has no inverse."""
        p, x = self.parts(u, items)
        root, failed = torch.linalg.cholesky_ex(self._records.covariance(self._made_of.model(p, x)))
        residual = self._target[items] - self._made_of.wavelet_variance(self._tau, p, x)
        whitened = torch.linalg.solve_triangular(root, residual[..., None], upper=False)
        return torch.where(failed > 0, torch.nan, whitened.square().sum((-2, -1)))

    @torch.enable_grad()
    def derivatives(self, u: Tensor, items: Tensor) -> tuple[Tensor, Tensor]:
        """First `(item, unknown)` and second `(item, unknown, unknown)`; of what stays where it is, 0 and 1."""
        u = u.detach().requires_grad_()
        (slope,) = torch.autograd.grad(self(u, items).sum(), u, create_graph=True)
        rows = [torch.autograd.grad(column.sum(), u, retain_graph=True)[0] for column in slope.unbind(-1)]
        present = self.present[items]
        free = torch.cat([present, present[:, self._made_of.curved]], -1)
        # At a limit, and downhill lies beyond.
        free &= ~(((u <= self.low[items]) & (slope > 0)) | ((u >= self.high[items]) & (slope < 0)))
        bend = torch.where(free[:, :, None] & free[:, None], torch.stack(rows, -1), 0.0)
        return torch.where(free, slope.detach(), 0.0), bend + torch.diag_embed((~free).to(bend))

    def parts(self, u: Tensor, items: Tensor) -> tuple[Tensor, Tensor]:
        """`p` and `x`."""
        logs, moved = u.split([self._made_of.n_linear, len(self._moving)], -1)
        x = self._shape[items].clone()
        x[:, self._moving] = moved
        return torch.where(self.present[items], logs.exp(), 0.0), x


def _descended(distance: _Distance) -> tuple[Tensor, Tensor, Tensor]:
    """`p`, `x` and whether they are at a minimum."""
    u, everyone = distance.start.clone(), torch.arange(len(distance.start), device=distance.start.device)
    objective = distance(u, everyone)
    damping = torch.full_like(objective, 1e-3)
    done = ~objective.isfinite()
    for _ in range(_STEPS):
        todo = (~done).nonzero()[:, 0]
        if not len(todo):
            break
        at, old = u[todo], objective[todo]
        slope, bend = distance.derivatives(at, todo)
        # Where there are none, eigenvectors of NaN would stop the others too.
        lost = ~(slope.isfinite().all(-1) & bend.isfinite().all((-2, -1)))
        slope, bend = slope.masked_fill(lost[:, None], 0.0), bend.masked_fill(lost[:, None, None], 0.0)
        # Downhill along every axis, also where the valley bends down.
        size, axes = torch.linalg.eigh(bend)
        size = size.abs() + damping[todo][:, None] * size.abs().amax(-1, keepdim=True) + _FLATTEST
        step = -(axes @ ((axes.mT @ slope[..., None]) / size[..., None]))[..., 0]
        tried = at + step.clamp(-_LONGEST_STEP, _LONGEST_STEP)
        tried = tried.clamp(distance.low[todo], distance.high[todo])
        new = distance(tried, todo)
        better = new < old
        u[todo] = torch.where(better[:, None], tried, at)
        objective[todo] = torch.where(better, new, old).masked_fill(lost, torch.nan)
        damping[todo] = torch.where(better, damping[todo] / 10, damping[todo] * 4).clamp(min=1e-12)
        stuck = (step.abs().amax(-1) < _SHORTEST_STEP) | (damping[todo] > _MOST_DAMPING)
        done[todo] = torch.where(better, old - new <= _ENOUGH * old, stuck)
    n = distance.present.shape[-1]
    vanishing = distance.present & (u[:, :n] < distance.start[:, :n] + math.log(_AS_GOOD_AS_ZERO))
    without = torch.cat([torch.where(vanishing, -torch.inf, u[:, :n]), u[:, n:]], -1)
    gone = distance(without, everyone) <= objective
    linear, shape = distance.parts(torch.where(gone[:, None], without, u), everyone)
    return linear, shape, done & objective.isfinite() & (u[:, :n] < distance.high[:, :n]).all(-1)


def fit_logs(fit: Fit, made_of: Composition) -> Fit:
    """Where `A' C^-1 (ln nu^ - bias - ln nu(theta)) = 0`, `A = d ln nu / d theta`, from a fit of the variances.

    Each round linearises the logarithms, which leaves a fit of variances that are as far off the model as these are,
    with weights of the last round. An item whose rounds do not come to rest is not converged.

    Args:
        fit: Of the variances, with weights `V^-1`.
        made_of: Structure of the model.
    """
    size = fit.variance.amax(-1, keepdim=True)
    target, linear, x = fit.variance / size, fit.linear / size, fit.shape.clone()
    expected = made_of.wavelet_variance(fit.tau, linear, x)
    pace, last = torch.ones_like(expected[:, :1]), torch.zeros_like(expected)
    todo = torch.arange(len(x), device=x.device)
    for _ in range(_ROUNDS):
        p, at, old = linear[todo], x[todo], expected[todo]
        residual, covariance = log_residual(target[todo], old, fit.records.covariance(made_of.model(p, at)))
        part = old + pace[todo] * residual
        p, at, _, _ = search.minimise(part, search.whitening(covariance), fit.tau, made_of, at, _STEPS_A_ROUND)
        new = made_of.wavelet_variance(fit.tau, p, at)
        moved = (new / old).log()
        # Longer steps, to the same end, for items that creep, shorter ones for those that go back and forth.
        onward = (moved * last[todo]).sum(-1, keepdim=True) >= 0
        pace[todo] = torch.where(onward, 1.3 * pace[todo], pace[todo] / 2).clamp(max=_LONGEST_PACE)
        linear[todo], x[todo], expected[todo], last[todo] = p, at, new, moved
        todo = todo[moved.abs().amax(-1) > _SAME * pace[todo, 0]]
        if not len(todo):
            break
    reached = torch.ones_like(fit.converged)
    reached[todo] = False
    linear, x = made_of.ordered(linear, x)
    return replace(fit, linear=linear * size, shape=x, converged=fit.converged & reached, moments="log")
