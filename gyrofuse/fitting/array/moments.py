"""Moments of an array as one vector: the entries of its wavelet cross-covariance (WCCV) and how they vary together.

A symmetric matrix over the sensors is written as its `q = p (p + 1) / 2` entries on and above the diagonal, row after
row; the moments of all levels are `(level, pair)`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.structure import ModelStructure


def pairs(n_sensors: int) -> tuple[Tensor, Tensor]:
    """First and second sensor of every pair, each `(pair,)`."""
    first, second = torch.triu_indices(n_sensors, n_sensors)
    return first, second


def vech(matrix: Tensor) -> Tensor:
    """`(..., sensor, sensor)` to `(..., pair)`."""
    first, second = pairs(matrix.shape[-1])
    return matrix[..., first, second]


def unvech(entries: Tensor) -> Tensor:
    """`(..., pair)` to the symmetric `(..., sensor, sensor)`."""
    n_sensors = int((2 * entries.shape[-1]) ** 0.5)
    first, second = pairs(n_sensors)
    place = torch.zeros(n_sensors, n_sensors, dtype=torch.long)
    place[first, second] = place[second, first] = torch.arange(len(first))
    return entries[..., place.to(entries.device)]


def array_moment_covariance(structure: ModelStructure, theta: Tensor, shape: Tensor, records: SampleDesign) -> Tensor:
    """Covariance of the estimated WCCV of a Gaussian array, for the finite length of its record.

    `Cov(gamma_ab,j, gamma_cd,l) = sum_km Q_jl[k,m] (Theta_k,ac Theta_m,bd + Theta_k,ad Theta_m,bc)` over the processes,
    with `Q_jl[k,m] = sum_lag n_jl s^k_jl s^m_jl / (M_j M_l)` from the variances of sums of two processes
    (`moment_covariance`). A tone counts through its products with the noise.

    Args:
        structure: Structure of the model.
        theta: Matrices of the processes at unit size, `(item, process, sensor, sensor)`, positive.
        shape: `x` of the shaped processes, `(item, shaped)`.
        records: Their length and levels.

    Returns:
        `(item, level, pair, level, pair)`, signal^4.
    """
    size = theta.diagonal(dim1=-2, dim2=-1).mean(-1)  # (item, process)
    table = _table(structure, size, shape, records)
    part = theta / size[..., None, None]
    a, b = pairs(theta.shape[-1])
    straight = part[:, :, None, a[:, None], a] * part[:, None, :, b[:, None], b]
    crossed = part[:, :, None, a[:, None], b] * part[:, None, :, b[:, None], a]
    products = (straight + crossed).flatten(1, 2).flatten(2)  # (item, k m, pair pair)
    covariance = table.flatten(1, 2).flatten(2).mT @ products
    return covariance.view(-1, records.n_levels, records.n_levels, len(a), len(a)).transpose(2, 3)


def _table(structure: ModelStructure, size: Tensor, shape: Tensor, records: SampleDesign) -> Tensor:
    """`Q` of processes of these sizes, `(item, process, process, level, level)`.

    A sum of two processes has `V = 2 (Q_kk + Q_mm + 2 Q_km)`. Of their true sizes, so that what a small process loses
    to rounding is small beside the rest.
    """
    n_processes = size.shape[-1]
    first, second = torch.triu_indices(n_processes, n_processes)
    chosen = torch.zeros(len(first), n_processes, dtype=size.dtype, device=size.device)
    chosen[torch.arange(len(first)), first] = 1
    chosen[torch.arange(len(first)), second] = 1
    model = structure.model(size[:, None] * chosen, shape[:, None].expand(-1, len(first), -1))
    sums = records.covariance(model)  # (item, pair of processes, level, level)
    table = sums.new_empty(len(size), n_processes, n_processes, records.n_levels, records.n_levels)
    table[:, first, second] = table[:, second, first] = sums
    alone = table[:, range(n_processes), range(n_processes)]
    table = (table - alone[:, :, None] - alone[:, None]) / 4
    table[:, range(n_processes), range(n_processes)] = alone / 2
    return table


def weights_of(covariance: Tensor, present: Tensor, *, pairwise: bool = False) -> Tensor:
    """Weights of the moments: `V^-1`, 0 where there is none.

    Args:
        covariance: `V`, `(item, level, pair, level, pair)`.
        present: Moments that were measured, `(item, level, pair)`.
        pairwise: Whether pairs of sensors count as independent, each with the inverse covariance of its own levels.

    Returns:
        `(item, moment, moment)`, moments of one level side by side.
    """
    n_items, n_levels, n_pairs = present.shape
    if pairwise:
        own = covariance.diagonal(dim1=2, dim2=4).movedim(-1, 1)  # (item, pair, level, level)
        inverse = _inverse(own, present.mT)
        return torch.diag_embed(inverse.movedim(1, -1), dim1=2, dim2=4).reshape(n_items, n_levels * n_pairs, -1)
    return _inverse(covariance.reshape(n_items, n_levels * n_pairs, -1), present.flatten(1))


def _inverse(covariance: Tensor, present: Tensor, ridge: float = 1e-11) -> Tensor:
    """Inverse over the moments that are present, zero elsewhere; NaN where there is none.

    Args:
        covariance: Covariance matrix, `(..., moment, moment)`.
        present: Moments that were measured, `(..., moment)`.
        ridge: Share of the variance of each moment that is added to it, as its covariance is rounded: moments that
            hardly differ would have no inverse.
    """
    size = covariance.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(present, size.clamp(min=torch.finfo(size.dtype).tiny).rsqrt(), 0.0)
    regular = torch.where(present, 1 + ridge, 1.0) - (scale.square() * size)
    correlation = scale[..., :, None] * covariance * scale[..., None, :] + torch.diag_embed(regular)
    root, failed = torch.linalg.cholesky_ex(correlation)
    inverse = torch.cholesky_inverse(torch.where((failed > 0)[..., None, None], torch.nan, root))
    return scale[..., :, None] * inverse * scale[..., None, :]
