"""Values that lost their fraction: cut off towards zero, where the step around zero is twice as wide as the others.

Noise has a density there that hardly bends over a few steps: the exponential of a parabola. Its shares of the seven
steps around zero are fitted with all steps alike, with that of zero twice as wide, which has to fit, and with any share
of zero: values that stand in for missing ones are often zeros as well.
"""

from __future__ import annotations

import torch
from scipy import optimize
from torch import Tensor


def step_counts(unique: Tensor, counts: Tensor, step: float) -> Tensor:
    """How many samples lie on each of the seven steps around zero, `(7,)`."""
    k, reach = (unique / step).round(), 3
    near = k.abs() <= reach
    found = torch.zeros(2 * reach + 1, dtype=torch.float64)
    return found.index_add(0, (k[near] + reach).long(), counts[near].to(torch.float64))


def is_cut_off(near: Tensor) -> bool | None:
    """Whether samples on the steps around zero, `(7,)`, were cut off towards it; None where that cannot be told."""
    least, sure, slack, zero = 20, 20.0, 3.0, len(near) // 2  # samples on a step; nats; position
    off, part = 12.0, 0.1  # nats by which densities are no parabolas, and part of those that the other law is off by
    if int((near >= least).sum()) < 4 or float(near[zero]) < least:
        return None
    alike, cut = (float(near @ log_shares(near, cut)) for cut in (False, True))
    free = float(torch.special.xlogy(near, near / near.sum()).sum())
    if alike > cut + sure:
        return False if free - alike < off + part * (free - cut) else None
    others = near.clone()
    others[zero] = 0
    pair = torch.stack([near[zero], others.sum()])
    # Among the other steps alone zero may have any share.
    any_share = float(others @ log_shares(others, cut=False, but_zero=True)) + float(pair @ (pair / pair.sum()).log())
    fits = free - cut < off + part * (free - alike)
    return True if fits and cut > max(alike + sure, any_share - slack - part / 3 * (free - alike)) else None


def cut_off_gain(values: Tensor, unique: Tensor, counts: Tensor, step: float) -> Tensor:
    """Log likelihood ratio of each value `(time,)` that it was cut off and not rounded; 0 beyond those near zero.

    Args:
        values: On a grid of multiples of the step.
        unique, counts: Distinct values, and how often each is there.
        step: Of the grid.
    """
    near = step_counts(unique, counts, step)
    gain = log_shares(near, cut=True) - log_shares(near, cut=False)
    k, reach = (values / step).round(), len(near) // 2
    return torch.where(k.abs() <= reach, gain[(k.clamp(-reach, reach) + reach).long()], 0.0)


def log_shares(near: Tensor, cut: bool, but_zero: bool = False) -> Tensor:
    """Logarithms of the likeliest shares of the steps around zero, `(7,)`.

    Args:
        near: Samples on each.
        cut: Whether they were cut off towards zero; else rounded.
        but_zero: Whether to leave out zero.
    """
    points, zero = 32, len(near) // 2  # within a step; position
    k = torch.arange(len(near), dtype=torch.float64)[:, None] - zero
    within = (torch.arange(points, dtype=torch.float64) + 0.5) / points - 0.5
    x = k + within + k.sign() / 2 if cut else k + within
    width = torch.ones(len(k), dtype=torch.float64)
    if cut:
        x[zero], width[zero] = 2 * within, 2.0
    width[zero] *= not but_zero
    powers = torch.stack([x, x.square()])  # (number, step, point)

    def shares(numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithms of the shares, and their slopes `(number, step)`."""
        log_density = (numbers[:, None, None] * powers).sum(0)
        mass = log_density.logsumexp(-1) + width.log()
        moments = (powers * log_density.softmax(-1)).sum(-1)
        share = mass.log_softmax(0)
        return share, moments - (moments * share.exp()).sum(-1, keepdim=True)

    def cost(numbers: object) -> tuple[float, object]:
        share, slopes = shares(torch.as_tensor(numbers, dtype=torch.float64))
        weight = near / near.sum()
        return -float(weight @ share.clamp(min=-1e3)), -(slopes @ weight).numpy()

    best = optimize.minimize(cost, [0.0, -0.1], jac=True, method="BFGS").x
    return shares(torch.as_tensor(best, dtype=torch.float64))[0].clamp(min=-1e3)
