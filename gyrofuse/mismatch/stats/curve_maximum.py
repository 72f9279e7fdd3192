"""How surprising the best of a family of slow templates is, and what it gains.

Tails of the maximum of a chi-square process along the whitened templates, from the length of the curve they draw on the
sphere (Davies, 1987), and never more than that of so many separate tests.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_FORM = 3.0  # nats: one effect in twenty is of another form than the simplest of its physics
_FAR = 1000.0  # of chi-squares, beyond which tails are zero to rounding


def curve_length(variance: Tensor, templates: Tensor, information: Tensor) -> Tensor:
    """Length of the curve of whitened unit templates on the sphere, `(..., sensor)`."""
    inner = (1 / variance) @ (templates[:-1] * templates[1:]).mT
    cosine = inner / (information[..., :-1] * information[..., 1:]).sqrt()
    return cosine.clamp(-1, 1).arccos().sum(-1)


def expected_exceedances(q: Tensor, dof: int, length: Tensor, places: int) -> Tensor:
    """How often a chi-square process along a curve exceeds `q`, by Davies (1987), or by the number of its places."""
    one = torch.special.gammaincc(torch.full_like(q, dof / 2), q / 2)
    high = q.clamp(min=max(dof - 1, 1e-3))  # below the mode, upcrossings do not count the places
    log_rate = (dof - 1) / 2 * (high / 2).log() - high / 2 - math.lgamma(dof / 2) - math.log(math.pi) / 2
    along = torch.where(length.isinf(), length, length * log_rate.exp())
    return torch.minimum(one + along, places * one)


def _pooled(z: Tensor, relation: Tensor) -> Tensor:
    """`z' R^-1 z`, `(..., sensor, any)` -> `(..., any)`."""
    return (z * torch.linalg.solve(relation, z)).sum(-2)


def most_extreme(z: Tensor, lengths: Tensor, relation: Tensor) -> Tensor:
    """Template that is least expected by sizes `(..., sensor, template, column)`, of all or of one, `(...)`."""
    n_sensors, places, n_columns = z.shape[-3:]
    pooled, at = _pooled(z.flatten(-2), relation).unflatten(-1, (places, n_columns)).sum(-1).max(-1)
    squares, alone_at = z.square().sum(-1).max(-1)  # (..., sensor)
    together = expected_exceedances(pooled, n_sensors * n_columns, lengths.mean(-1), places)
    alone, which = expected_exceedances(squares, n_columns, lengths, places).min(-1)
    better = n_sensors * alone < together
    return torch.where(better, alone_at.gather(-1, which[..., None])[..., 0], at)


def surprise(z: Tensor, lengths: Tensor, relation: Tensor, places: int) -> tuple[Tensor, Tensor]:
    """Gain of the best template's sizes `(..., sensor, column)` less the price of having looked, and p value."""
    n_sensors, n_columns = z.shape[-2:]
    dof = n_sensors * n_columns
    pooled, squares = _pooled(z, relation).sum(-1), z.square().sum(-1)
    together = expected_exceedances(pooled, dof, lengths.mean(-1), places)
    far = pooled.clamp(max=_FAR)
    here = torch.special.gammaincc(torch.full_like(far, dof / 2), far / 2)
    looked = (expected_exceedances(far, dof, lengths.mean(-1), places) / here).log()
    # Of a further path, and of its size in each sensor, which may be as large as that of the first (Occam's factor).
    further = (n_columns - 1) * (_FORM + squares.log1p().sum(-1) / 2)
    gain = pooled / 2 - looked - further
    if n_sensors == 1:
        return gain, -torch.expm1(-together)
    alone = n_sensors * expected_exceedances(squares, n_columns, lengths, places).amin(-1)
    # The better of two ways, where exceedances come as in a Poisson process.
    return gain, -torch.expm1(-2 * torch.minimum(together, alone))
