"""A mean likelihood ratio over positions, widths and sizes of a bump that one source of all sensors makes.

With `K` the sum of `z z^H` over the `m` bins of a stretch, `F` that over the `f` bins of its flanks and `W = K + F`, a
source whose power is `a` times that of the noise and that moves the sensors along `u`, both in coordinates in which the
noise is white, has the likelihood ratio

    E(u) = (1 + a)^-m (1 - c u^H B u)^-(m + f),   c = a / (1 + a),   B = W^-1/2 K W^-H/2,

whatever the noise, since `u^H B u` is a Beta variable of `m` and `f` where nothing stands out. The mean over all `u`
leaves open how sensors take part; with `B`'s other eigenvalues at their mean, which is never more, it is one over
the share `s` of `u` along the largest, a Beta variable of `1` and `p - 1`. The mean over everything exceeds `x` with
probability `1/x` at most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.modulated_ordinates import inflation

SMOOTH = 8  # part of a spectrum over which whitened noise may be taken for level
LOWEST = 12  # bins below which whitening is not exact


class Stretches(NamedTuple):
    """All of one width.

    Attributes:
        first: Bins `(position,)`.
        width: Bins.
        log_ratio: Of the mean likelihood ratio, `(position,)`.
    """

    first: Tensor
    width: int
    log_ratio: Tensor


def flank_of(width: int, n_bins: int) -> int:
    """Bins on either side with which a stretch of so many is compared, in a spectrum of `n_bins`: four times it."""
    return max(min(4 * width, n_bins // SMOOTH), least_flank(width))


def least_flank(width: int) -> int:
    """Fewest bins on either side from which a level is known: one and a half times a stretch, and 24."""
    return max(round(1.5 * width), 24)


def scanned_shared_peaks(
    transform: Tensor, ordinates: float, levels: Tensor, width_of_bin: float
) -> Iterator[Stretches]:
    """Stretches of 4, 8, 16, .. bins that overlap by half.

    Args:
        transform: Of whitened samples of two sensors or more, `(sensor, bin)`.
        ordinates: Number of independent ordinates in a bin.
        levels: Correlations of ordinates of noise whose level varies, `(sensor, distance)`.
        width_of_bin: In bins of the record, of which those distances are.
    """
    at_once = 2**15  # positions, to bound memory
    n_bins, width = transform.shape[-1], 4
    pairs = transform[:, : n_bins // 2 * 2].unflatten(-1, (-1, 2)).movedim(1, 0)
    cells = pairs @ pairs.mH  # (cell, sensor, sensor)
    while width <= n_bins // SMOOTH:
        half = width // 2
        reach = flank_of(width, n_bins) // half
        first = max(-(-LOWEST // half) + reach + 1, 8)
        last = len(cells) - reach - 3
        if last < first:
            return
        flank = torch.full((reach,), -1 / (2 * reach), dtype=torch.float64)
        contrast = torch.cat([flank, flank.new_tensor([0.0, 0.5, 0.5, 0.0]), flank])  # in halves of a stretch
        own = ordinates / float(inflation(levels, contrast, half * width_of_bin).amax())
        logs = []
        for a in range(first, last + 1, at_once):
            b = min(a + at_once, last + 1)
            inside, beside = _inside(cells, a, b), _beside(cells, a, b, reach)
            logs.append(log_ratios(inside, beside, width * own, 2 * reach * half * own))
        yield Stretches(torch.arange(first, last + 1) * half, width, torch.cat(logs))
        cells = cells[: len(cells) // 2 * 2].unflatten(0, (-1, 2)).sum(1)
        width *= 2


def log_ratios(inside: Tensor, beside: Tensor, m: float, f: float) -> Tensor:
    """Logarithms of mean likelihood ratios, `(position,)`.

    Args:
        inside: Matrices `(position, sensor, sensor)` of stretches.
        beside: Of their flanks.
        m: Independent ordinates in a stretch.
        f: In its flanks.
    """
    sizes = (3.2, 5.6, 8.0, 11.2)  # of a source's power, in standard deviations of that of a stretch
    away = torch.cat([torch.logspace(0, -3, 24, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)])  # 1 - s
    both, p = inside + beside, inside.shape[-1]
    size = both.diagonal(dim1=-2, dim2=-1).real.mean(-1)
    root = torch.linalg.cholesky(both + torch.diag_embed((1e-9 * size)[:, None].expand(-1, p)))  # for rounding
    left = torch.linalg.solve_triangular(root, inside, upper=False)
    share = torch.linalg.solve_triangular(root, left.mH, upper=False)
    top = _largest(share)
    if p == 1:
        along, mass = top[None], top.new_zeros(1)
    else:
        rest = ((share.diagonal(dim1=-2, dim2=-1).real.sum(-1) - top) / (p - 1)).clamp(min=0)
        mass = away.pow(p - 1).diff().neg().log()
        along = rest + (1 - away[:-1, None]) * (top - rest)  # (node, position), each at its lower end
    total = torch.full_like(top, -math.inf)
    for a in (size / math.sqrt(m) for size in sizes):
        mean = torch.logsumexp(mass[:, None] - (m + f) * torch.log1p(-a / (1 + a) * along), 0)
        total = torch.logaddexp(total, mean - m * math.log1p(a))
    return total - math.log(len(sizes))


def _inside(cells: Tensor, a: int, b: int) -> Tensor:
    return cells[a:b] + cells[a + 1 : b + 1]


def _beside(cells: Tensor, a: int, b: int, reach: int) -> Tensor:
    """Flanks of so many cells, one cell off."""
    total = torch.zeros_like(cells[a:b])
    for k in range(reach):
        total += cells[a - 2 - k : b - 2 - k] + cells[a + 3 + k : b + 3 + k]
    return total


def _largest(matrices: Tensor) -> Tensor:
    """Largest eigenvalue, or a little less, of matrices `(position, sensor, sensor)`, by powers."""
    rounds = 8
    column = matrices.abs().square().sum(-2).argmax(-1)
    v = matrices[torch.arange(len(matrices)), :, column][..., None]
    for _ in range(rounds):
        v = matrices @ (v / v.norm(dim=-2, keepdim=True).clamp(min=1e-300))
    return v.norm(dim=-2)[:, 0].clamp(max=1.0)
