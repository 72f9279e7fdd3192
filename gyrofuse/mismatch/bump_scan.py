"""A mean likelihood ratio over places, widths and sizes of a bump, one source that sensors share or one of each.

With `K` the sum of `z z^H` over the `m` bins of a stretch, `F` that over the `f` bins of its flanks and `W = K + F`, a
source whose power is `a` times that of the noise and that moves the sensors along `u`, both in coordinates in which the
noise is white, has the likelihood ratio

    E(u) = (1 + a)^-m (1 - c u^H B u)^-(m + f),   c = a / (1 + a),   B = W^-1/2 K W^-H/2,

whatever the noise, since `u^H B u` is a Beta variable of `m` and `f` where nothing stands out. The mean over all `u`
leaves open how sensors take part; with `B`'s other eigenvalues at their mean, which is never more, it is one over
the share `s` of `u` along the largest, a Beta variable of `1` and `p - 1`. Sources of each sensor have the product of
`1 - e + e E` with the sensors' own shares of `K` in `W`. The mean over everything exceeds `x` with probability `1/x` at
most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

_NARROWEST = 4  # bins
_FEWEST_CELLS, _FEWEST_BINS = 3, 24  # of a flank; a cell is half a stretch
_LOWEST, _NARROW = 12, 4  # bins, and widths, below a stretch
_BROADEST = 8  # of them in the spectrum
_SHARED, _OWN = (3.2, 5.6, 8.0, 11.2), (1.6, 2.8, 4.0, 5.6)  # sizes `a`, over the root of `m`
_TAKING_PART = (0.2, 0.5, 0.9)  # `e`
_NODES, _CLOSEST = 24, 1e-3  # of `1 - s`
_ROUNDS = 8
_RIDGE = 1e-9
_AT_ONCE = 2**15  # places


class Stretches(NamedTuple):
    """All of one width.

    Attributes:
        first: Bins `(place,)`.
        width: Bins.
        log_ratio: Of the mean likelihood ratio, `(place,)`.
    """

    first: Tensor
    width: int
    log_ratio: Tensor


def scanned_bumps(transform: Tensor, apart: Tensor, worth: float) -> Iterator[Stretches]:
    """Stretches of 4, 8, 16, .. bins that overlap by half.

    Args:
        transform: Of whitened samples, `(sensor, bin)`.
        apart: The same without what sensors share over broad bands: sources of their own are told in it.
        worth: Independent ordinates in a bin.
    """
    n_bins, width = transform.shape[-1], _NARROWEST
    pairs = transform[:, : n_bins // 2 * 2].unflatten(-1, (-1, 2)).movedim(1, 0)
    cells = pairs @ pairs.mH  # (cell, sensor, sensor)
    own = apart.abs().square()[:, : n_bins // 2 * 2].unflatten(-1, (-1, 2)).sum(-1).mT  # (cell, sensor)
    while width <= n_bins // _BROADEST:
        half = width // 2
        reach = max(_FEWEST_CELLS, _FEWEST_BINS // half)
        first = max(-(-_LOWEST // half) + reach + 1, 2 * _NARROW)
        last = len(cells) - reach - 3
        if last < first:
            return
        logs = []
        for a in range(first, last + 1, _AT_ONCE):
            b = min(a + _AT_ONCE, last + 1)
            both = [(_inside(x, a, b), _beside(x, a, b, reach)) for x in (cells, own)]
            logs.append(log_ratios(*both[0], *both[1], width * worth, 2 * reach * half * worth))
        yield Stretches(torch.arange(first, last + 1) * half, width, torch.cat(logs))
        cells, own = (x[: len(x) // 2 * 2].unflatten(0, (-1, 2)).sum(1) for x in (cells, own))
        width *= 2


def log_ratios(inside: Tensor, beside: Tensor, own: Tensor, own_beside: Tensor, m: float, f: float) -> Tensor:
    """Logarithms of mean likelihood ratios of places.

    Args:
        inside: Matrices `(place, sensor, sensor)` of stretches.
        beside: Of their flanks.
        own: Powers `(place, sensor)` of sensors apart.
        own_beside: Likewise.
        m: Independent ordinates in a stretch.
        f: In its flanks.
    """
    alone = _log_alone(own / (own + own_beside), m, f)
    if inside.shape[-1] == 1:
        return alone
    return torch.logaddexp(log_shared(inside, beside, m, f), alone) - math.log(2)


def _inside(cells: Tensor, a: int, b: int) -> Tensor:
    return cells[a:b] + cells[a + 1 : b + 1]


def _beside(cells: Tensor, a: int, b: int, reach: int) -> Tensor:
    """Flanks of so many cells, one cell off."""
    total = torch.zeros_like(cells[a:b])
    for k in range(reach):
        total += cells[a - 2 - k : b - 2 - k] + cells[a + 3 + k : b + 3 + k]
    return total


def log_shared(inside: Tensor, beside: Tensor, m: float, f: float) -> Tensor:
    """The same of one source of all sensors alone."""
    both, p = inside + beside, inside.shape[-1]
    if p == 1:
        return _log_alone((inside / both)[..., 0].real, m, f)
    size = both.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    root = torch.linalg.cholesky(both + torch.diag_embed((_RIDGE * size)[:, None].expand(-1, p)))
    left = torch.linalg.solve_triangular(root, inside, upper=False)
    share = torch.linalg.solve_triangular(root, left.mH, upper=False)
    top = _largest(share)
    rest = ((share.diagonal(dim1=-2, dim2=-1).real.sum(-1) - top) / (p - 1)).clamp(min=0)
    away = torch.cat([torch.logspace(0, math.log10(_CLOSEST), _NODES, dtype=torch.float64), torch.zeros(1)])
    mass = away.pow(p - 1).diff().neg().log()
    along = rest + (1 - away[:-1, None]) * (top - rest)  # (node, place), each at its lower end
    total = torch.full_like(top, -math.inf)
    for a in (size / math.sqrt(m) for size in _SHARED):
        mean = torch.logsumexp(mass[:, None] - (m + f) * torch.log1p(-a / (1 + a) * along), 0)
        total = torch.logaddexp(total, mean - m * math.log1p(a))
    return total - math.log(len(_SHARED))


def _largest(matrices: Tensor) -> Tensor:
    """Largest eigenvalue, or a little less, of matrices `(place, sensor, sensor)`, by powers."""
    column = matrices.abs().square().sum(-2).argmax(-1)
    v = matrices[torch.arange(len(matrices)), :, column][..., None]
    for _ in range(_ROUNDS):
        v = matrices @ (v / v.norm(dim=-2, keepdim=True).clamp(min=1e-300))
    return v.norm(dim=-2)[:, 0].clamp(max=1.0)


def _log_alone(share: Tensor, m: float, f: float) -> Tensor:
    """Sources of single sensors, `(place,)`, from shares `(place, sensor)`."""
    total = torch.full_like(share[:, 0], -math.inf)
    chances = _TAKING_PART if share.shape[-1] > 1 else (1.0,)
    for a in (size / math.sqrt(m) for size in _OWN):
        one = -m * math.log1p(a) - (m + f) * torch.log1p(-a / (1 + a) * share)
        for e in chances:
            some = one if e == 1 else torch.logaddexp(one + math.log(e), one.new_tensor(math.log(1 - e)))
            total = torch.logaddexp(total, some.sum(-1))
    return total - math.log(len(_OWN) * len(chances))
