"""Maximum of a chi-square process along a curve of templates: its tail probability, and the gain of the best template.

The whitened templates of a family draw a curve on the sphere. How often a chi-square process along it exceeds a level
follows from its length, and is never more than the number of exceedances of as many separate tests.

References:
    Davies, Hypothesis testing when a nuisance parameter is present only under the alternative, Biometrika 74 (1987),
    33.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def curve_length(variance: Tensor, templates: Tensor, information: Tensor) -> Tensor:
    """Length of the curve of whitened unit templates on the sphere, `(..., sensor)`."""
    inner = (1 / variance) @ (templates[:-1] * templates[1:]).mT
    cosine = inner / (information[..., :-1] * information[..., 1:]).sqrt()
    return cosine.clamp(-1, 1).arccos().sum(-1)


def expected_exceedances(q: Tensor, dof: int, length: Tensor, n_templates: int) -> Tensor:
    """Expected number of exceedances of `q` by a chi-square process along a curve (Davies), or by separate tests.

    Args:
        q: Level of the statistic.
        dof: Degrees of freedom of the process.
        length: Length of the curve.
        n_templates: Number of templates on it.
    """
    one = torch.special.gammaincc(torch.full_like(q, dof / 2), q / 2)
    high = q.clamp(min=max(dof - 1, 1e-3))  # below the mode there are fewer upcrossings, but more exceedances
    log_rate = (dof - 1) / 2 * (high / 2).log() - high / 2 - math.lgamma(dof / 2) - math.log(math.pi) / 2
    along = torch.where(length.isinf(), length, length * log_rate.exp())
    return torch.minimum(one + along, n_templates * one)


def _pooled(z: Tensor, relation: Tensor) -> Tensor:
    """`z' R^-1 z`, `(..., sensor, any)` -> `(..., any)`."""
    return (z * torch.linalg.solve(relation, z)).sum(-2)


def most_extreme(z: Tensor, lengths: Tensor, relation: Tensor) -> Tensor:
    """Position `(...)` of the template that is least expected, of all sensors together or of one.

    Args:
        z: Estimates in sd, `(..., sensor, template, column)`.
        lengths: Lengths of the curves, `(..., sensor)`.
        relation: Correlation of the sensors, `(..., sensor, sensor)`.
    """
    n_sensors, n_templates, n_columns = z.shape[-3:]
    pooled, at = _pooled(z.flatten(-2), relation).unflatten(-1, (n_templates, n_columns)).sum(-1).max(-1)
    squares, alone_at = z.square().sum(-1).max(-1)  # (..., sensor)
    together = expected_exceedances(pooled, n_sensors * n_columns, lengths.mean(-1), n_templates)
    alone, which = expected_exceedances(squares, n_columns, lengths, n_templates).min(-1)
    better = n_sensors * alone < together
    return torch.where(better, alone_at.gather(-1, which[..., None])[..., 0], at)


def surprise(z: Tensor, lengths: Tensor, relation: Tensor, n_templates: int) -> tuple[Tensor, Tensor]:
    """Gain of the best template less the price of the search, nats, and p value, `(...)` each.

    Args:
        z: Estimates of that template in sd, `(..., sensor, column)`.
        lengths: Lengths of the curves, `(..., sensor)`.
        relation: Correlation of the sensors, `(..., sensor, sensor)`.
        n_templates: Number of templates searched.
    """
    n_sensors, n_columns = z.shape[-2:]
    dof = n_sensors * n_columns
    pooled, squares = _pooled(z, relation).sum(-1), z.square().sum(-1)
    together = expected_exceedances(pooled, dof, lengths.mean(-1), n_templates)
    far = pooled.clamp(max=1000.0)  # beyond, tails of chi-square are zero to rounding
    one = torch.special.gammaincc(torch.full_like(far, dof / 2), far / 2)
    searched = (expected_exceedances(far, dof, lengths.mean(-1), n_templates) / one).log()
    # A further column costs 3 nats, as one effect in twenty has another form than the simplest of its physics, and its
    # size in each sensor, which may be as large as that of the first (Occam's factor).
    further = (n_columns - 1) * (3.0 + squares.log1p().sum(-1) / 2)
    gain = pooled / 2 - searched - further
    if n_sensors == 1:
        return gain, -torch.expm1(-together)
    alone = n_sensors * expected_exceedances(squares, n_columns, lengths, n_templates).amin(-1)
    # The better of two tests, whose exceedances come as in a Poisson process.
    return gain, -torch.expm1(-2 * torch.minimum(together, alone))
