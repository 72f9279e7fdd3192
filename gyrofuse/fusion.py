"""The ways to weigh the sensors of an array, behind one door."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse.assisted import assisted_covariance
from gyrofuse.competitors import equal_weights, inverse_variance_weights
from gyrofuse.rdvg import rdvg_weights
from gyrofuse.svo_weights import combine, counting, optimal_weights

METHODS = ("svo", "model_assisted", "inverse_variance", "equal", "rdvg")


@dataclass(frozen=True, eq=False)
class Chosen:
    """Weights of a batch of arrays, and where they came from.

    Attributes:
        weights: `(item, sensor)`.
        method: How they were chosen.
        weights_of: Maps `A` `(..., sensor, sensor)` to the weights, where they are a function of it alone.
    """

    weights: Tensor
    method: str
    weights_of: Callable[[Tensor], Tensor] | None = None


def choose_weights(method: str, signal: Tensor, sums: Tensor, counts: Tensor, omega: Tensor) -> Chosen:
    """Weights by one method.

    Args:
        method: One of `METHODS`.
        signal: `(item, sensor, time)`.
        sums: `(item, bin, level, sensor, sensor)`, of `gyrofuse.covariance.binned_products`.
        counts: The same shape.
        omega: `(level,)`, scale weights.
    """
    wccv = counting(sums.sum(1) / counts.sum(1), omega)
    if method == "svo":
        return Chosen(optimal_weights(combine(wccv, omega)), method, optimal_weights)
    if method == "inverse_variance":
        return Chosen(inverse_variance_weights(wccv, omega), method, _inverse_variance)
    if method == "model_assisted":
        totals = counts.sum(1)
        smooth = assisted_covariance(sums.sum(1) / totals, totals.amin((-1, -2)))
        return Chosen(optimal_weights(combine(counting(smooth, omega), omega)), method)
    if method == "rdvg":
        return Chosen(rdvg_weights(signal).to(wccv), method)
    return Chosen(equal_weights(wccv), method)


def _inverse_variance(combined: Tensor) -> Tensor:
    precision = combined.diagonal(dim1=-2, dim2=-1).reciprocal()
    return precision / precision.sum(-1, keepdim=True)
