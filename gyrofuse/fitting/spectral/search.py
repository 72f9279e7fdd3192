"""Maximum of the Whittle likelihood of binned ordinates, for many records at once, and the curvature there."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse._base.nnls import nonnegative_least_squares
from gyrofuse._base.optimize import Trial, descend
from gyrofuse.fitting.spectral.bands import BandSpectrum, Bins


def maximise(
    energy: Tensor,
    count: Tensor,
    bins: Bins,
    noise: BandSpectrum,
    p: Tensor,
    x: Tensor,
    held: int | None = None,
    enough: float = 1e-8,
    n_steps: int = 100,
    longest_step: float = 1.0,
    longest_memory: float = 32,
) -> tuple[Tensor, Tensor, Tensor]:
    """Damped scoring.

    With the observed information where it is positive definite: near the top of a flat likelihood it ends in a few
    steps, for which the Fisher information takes hundreds.

    A step maximises the quadratic model over `p >= 0`: with `x` eliminated it is a non-negative least-squares problem,
    so that a variance is 0 exactly where raising it does not help, and leaves 0 where it does. The `x` of an AR1
    without variance stays where it is, as does one at the end of its range that would go on.

    Args:
        energy: Sums of squared ordinates, `(item, bin)`.
        count: Number of ordinates in each sum, `(item, bin)`.
        bins: Bins of the ordinates.
        noise: Processes of the model that have a spectrum.
        p: Variances to start from, `(item, process)`.
        x: Values `atanh phi` to start from, `(item, AR1)`.
        held: Index of an unknown that stays where it starts, among `p` followed by `x`; None where all move.
        enough: Gain in nats below which a step is not worth taking; 1e-8 nats are 1e-4 standard deviations from the
            top.
        n_steps: Largest number of steps.
        longest_step: Largest change of `x` in one step; the likelihood is nearly quadratic that far.
        longest_memory: Time constant of an AR1 at the end of its range, in records: a ramp, for all a record shows.

    Returns:
        `p`, `x` and whether the top was reached, `(item,)`.
    """
    unit = energy.sum(-1, keepdim=True) / count.sum(-1, keepdim=True)
    mean = (energy / count / unit).clamp(min=torch.finfo(energy.dtype).tiny)
    longest = x.new_tensor(float(longest_memory * bins.n_samples))
    end = torch.stack([noise.processes[k].from_time_scale(longest) for k in noise.moving] or [longest])[: x.shape[-1]]
    n_linear = p.shape[-1]
    columns, slopes, bends = noise.columns(bins, x)
    start = _deviance(mean, count, (columns @ (p / unit)[..., None])[..., 0])
    reached = torch.zeros_like(start, dtype=torch.bool)

    def attempt(todo: Tensor, state: list[Tensor], old: Tensor, damping: Tensor) -> Trial:
        own_p, own_x, u, own_slopes, own_bends = state
        gradient, information, observed = _score(mean[todo], count[todo], u, own_slopes, own_bends, own_p, noise)
        by_x = gradient[:, n_linear:]
        moving = (own_p[:, noise.moving] > 0) & ~((own_x >= end) & (by_x > 0)) & ~((own_x <= -end) & (by_x < 0))
        active = torch.cat([torch.ones_like(own_p, dtype=torch.bool), moving], -1).to(own_p)
        if held is not None:
            active[:, held] = 0.0
        gradient = gradient * active
        size = information.diagonal(dim1=-2, dim2=-1) * active
        more = torch.diag_embed(damping[:, None] * size + (1 - active))
        both = active[:, :, None] * active[:, None, :]
        damped = observed * both + more
        indefinite = torch.linalg.cholesky_ex(damped)[1] > 0
        damped = torch.where(indefinite[:, None, None], information * both + more, damped)
        # x = C^-1 (g_x - B' (p - p_0)) eliminated
        corner, side = damped[:, n_linear:, n_linear:], damped[:, :n_linear, n_linear:]
        solved = torch.linalg.solve_ex(corner, torch.cat([side.mT, gradient[:, n_linear:, None]], -1))[0]
        gram = damped[:, :n_linear, :n_linear] - side @ solved[..., :-1]
        moment = gradient[:, :n_linear] - (side @ solved[..., -1:])[..., 0] + (gram @ own_p[..., None])[..., 0]
        new_p = nonnegative_least_squares(gram, moment)
        step_p = new_p - own_p
        step_x = solved[..., -1] - (solved[..., :-1] @ step_p[..., None])[..., 0]
        new_x = (own_x + step_x.clamp(-longest_step, longest_step)).clamp(-end, end)
        promised = (gradient * torch.cat([step_p, step_x], -1)).sum(-1) * (1 + damping)
        new_columns, new_slopes, new_bends = noise.columns(bins, new_x)
        new = _deviance(mean[todo], count[todo], (new_columns @ new_p[..., None])[..., 0])
        reached[todo] = promised < enough
        last = reached[todo] | ~promised.isfinite()
        return Trial((new_p, new_x, new_columns, new_slopes, new_bends), new, new < old, last)

    state = (p / unit, x, columns, slopes, bends)
    (p, x, *_), _, _ = descend(state, start, attempt, n_steps=n_steps, ease=10, tighten=10)
    return p * unit, x, reached


def deviance(energy: Tensor, count: Tensor, bins: Bins, noise: BandSpectrum, p: Tensor, x: Tensor) -> Tensor:
    """Minus twice the log likelihood, but for what does not depend on the model, `(item,)`."""
    mean = (energy / count).clamp(min=torch.finfo(energy.dtype).tiny)
    return _deviance(mean, count, noise.variances(bins, p, x))


def _deviance(mean: Tensor, count: Tensor, variance: Tensor) -> Tensor:
    """Minus twice the log likelihood, less that of variances that fit every bin: small numbers keep their digits."""
    ratio = mean / variance
    return (count * (ratio - 1 - ratio.log())).sum(-1).nan_to_num(nan=torch.inf)


def _score(
    mean: Tensor, count: Tensor, columns: Tensor, slopes: Tensor, bends: Tensor, p: Tensor, noise: BandSpectrum
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient of the log likelihood by `(p, x)`, `(item, unknown)`, and its expected and its observed curvature.

    The latter two, the Fisher and the observed information, are `(item, unknown, unknown)`.
    """
    variance = (columns @ p[..., None])[..., 0]
    own = p[:, None, noise.moving]
    jacobian = torch.cat([columns, slopes * own], -1) / variance[..., None]  # d ln v
    weighted = jacobian * (count / 2)[..., None]
    misfit = (mean / variance - 1)[..., None]
    gradient = (weighted.mT @ misfit)[..., 0]
    information = jacobian.mT @ weighted
    observed = information + 2 * jacobian.mT @ (weighted * misfit)
    # less d2 v, which an AR1 has by its variance and x, and by x twice
    pull = (count / 2 / variance)[..., None] * misfit
    mixed, twice = (pull * slopes).sum(-2), (pull * bends * own).sum(-2)  # (item, AR1)
    for i, k in enumerate(noise.moving):
        place = p.shape[-1] + i
        observed[:, k, place] -= mixed[:, i]
        observed[:, place, k] -= mixed[:, i]
        observed[:, place, place] -= twice[:, i]
    return gradient, information, observed


def uncertainty(count: Tensor, bins: Bins, noise: BandSpectrum, p: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Covariance of `(ln p, x)`, `(item, unknown, unknown)`, and the `sd` of `p` off its edge, `(item, process)`."""
    columns, slopes, bends = noise.columns(bins, x)
    variance = (columns @ p[..., None])[..., 0]
    information = _score(variance, count, columns, slopes, bends, p, noise)[1]
    there = p > 0
    active = torch.cat([there, there[:, noise.moving]], -1)
    natural = _inverse(information, active)
    scale = torch.cat([torch.where(there, 1 / p, 0.0), torch.ones_like(x)], -1)
    off_edge = _inverse(information, torch.cat([torch.ones_like(there), there[:, noise.moving]], -1))
    edge_sd = off_edge.diagonal(dim1=-2, dim2=-1)[:, : p.shape[-1]].sqrt()
    return natural * scale[:, :, None] * scale[:, None, :], edge_sd


def _inverse(information: Tensor, active: Tensor) -> Tensor:
    """Inverse over the active unknowns, zero elsewhere; NaN where there is none to rounding."""
    size = information.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(information.dtype).tiny).rsqrt()
    keep = (active[:, :, None] & active[:, None, :]).to(information)
    scaled = information * size[:, :, None] * size[:, None, :] * keep + torch.diag_embed((~active).to(information))
    root, failed = torch.linalg.cholesky_ex(scaled)
    root = torch.where((failed > 0)[:, None, None], torch.eye(root.shape[-1]).to(root), root)
    inverse = torch.cholesky_inverse(root) * size[:, :, None] * size[:, None, :] * keep
    return torch.where((failed > 0)[:, None, None], torch.where(keep > 0, torch.nan, 0.0), inverse)
