"""Optimal weights of subsets of an array."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse._base.linalg import check_positive_definite
from gyrofuse.fusion.weights.svo import ScaleWeights, check_levels, resolve_scale_weights
from gyrofuse.wavelets.moments import combined_covariance


def subset_weights(wccv: Tensor, scale_weights: ScaleWeights, live: Tensor) -> Tensor:
    """Optimal weights of any live subset of an array, from the covariance of the whole array; differentiable.

    `c_S = A_SS^-1 1 / (1' A_SS^-1 1)` with `A = sum_j omega_j Gamma_j`: the weights of a fit without the other
    sensors. Equal subsets, of which a stream has many, are solved once.

    Args:
        wccv: `(..., level, sensor, sensor)`, signal^2.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
        live: `(..., sensor)`, bool; its leading dimensions broadcast with those of `wccv`, so that
            `(time, sensor)` goes with one array.

    Returns:
        `(..., sensor)`, sum 1, 0 for a sensor that is not live; NaN where none is.

    Raises:
        TypeError: `wccv` is not a floating point tensor, or `live` is not boolean.
        ValueError: Wrong shape or scale weights.
        SingularCovarianceError: `A_SS` is not positive definite.

    References:
        [Z] equation (7).
    """
    n_levels = check_levels(wccv)
    if live.dtype != torch.bool:
        raise TypeError(f"`live`: expected a boolean tensor, got {live.dtype}; compare with something")
    if live.shape[-1:] != wccv.shape[-1:]:
        raise ValueError(f"`live`: expected (..., sensor) with {wccv.shape[-1]} sensors, got shape {tuple(live.shape)}")
    omega = resolve_scale_weights(scale_weights, n_levels).to(wccv)
    return solve_subsets(combined_covariance(wccv, omega), live, check=True)


def solve_subsets(combined: Tensor, live: Tensor, *, check: bool = False) -> Tensor:
    """Optimal weights of live subsets, each distinct subset solved once.

    Args:
        combined: `A`, `(..., sensor, sensor)`.
        live: `(..., sensor)`, bool; its leading dimensions broadcast with those of `combined`.
        check: Whether to raise where a submatrix is not positive definite.

    Returns:
        `(..., sensor)`.
    """
    batch = torch.broadcast_shapes(combined.shape[:-2], live.shape[:-1])
    n_sensors = combined.shape[-1]
    item = torch.arange(combined[..., 0, 0].numel(), device=live.device).view(combined.shape[:-2]).expand(batch)
    item, masks = item.reshape(-1), live.expand(*batch, n_sensors).reshape(-1, n_sensors)
    code = item
    for word in masks.split(32, dim=-1):
        bits = (word.long() << torch.arange(word.shape[-1], device=word.device)).sum(-1)
        code = torch.unique((code << 32) | bits, return_inverse=True)[1]
    one = torch.zeros(int(code.max()) + 1 if code.numel() else 0, dtype=torch.int64, device=code.device)
    one[code] = torch.arange(len(code), device=code.device)  # any one of each kind
    mask = masks[one]
    both = mask[:, :, None] & mask[:, None, :]
    matrix = torch.where(
        both, combined.reshape(-1, n_sensors, n_sensors)[item[one]], torch.diag_embed(~mask).to(combined)
    )
    if check:
        check_positive_definite("the wavelet cross-covariance of live sensors combined over scales", matrix)
    solved = torch.linalg.solve(matrix, mask.to(combined))
    weights = solved / solved.sum(-1, keepdim=True)
    return weights[code].view(*batch, n_sensors)
