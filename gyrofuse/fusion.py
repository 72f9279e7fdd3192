"""The ways to weigh the sensors of an array, behind one door."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse.competitors import precision_weights
from gyrofuse.rdvg import rdvg
from gyrofuse.selection import ESTIMATORS, Selection, select_estimator
from gyrofuse.svo_weights import counting, optimal_weights

METHODS = ("auto", "svo", "model_assisted", "shrinkage", "nonnegative", "inverse_variance", "equal", "rdvg")


@dataclass(frozen=True, eq=False)
class Chosen:
    """Weights of a batch of arrays, and where they came from.

    Attributes:
        weights: `(item, sensor)`.
        method: How they were chosen.
        selection: Why, where they were chosen by held-out risk.
        positive_definite: `(item,)`, whether weights by RDVG minimise anything; None for other methods.
    """

    weights: Tensor
    method: str
    selection: Selection | None = None
    positive_definite: Tensor | None = None

    @property
    def spread_of(self) -> Callable[[Tensor], Tensor] | None:
        """The function of `A` whose spread is that of the weights, or on the safe side of it; None when unknown.

        Weights with a model's help, or drawn towards others, vary less than those without.
        """
        if self.method == "inverse_variance":
            return precision_weights
        return optimal_weights if self.method in ("svo", "model_assisted", "shrinkage", "auto") else None


def choose_weights(method: str, signal: Tensor, wccv: Tensor, totals: Tensor, omega: Tensor) -> Chosen:
    """Weights by one method, or by the one with the least held-out risk.

    Args:
        method: One of `METHODS`.
        signal: `(item, sensor, time)`.
        wccv: `(item, level, sensor, sensor)`.
        totals: The same shape, products in each entry.
        omega: `(level,)`, scale weights.
    """
    if method == "rdvg":
        found = rdvg(signal)
        return Chosen(found.weights.to(wccv), method, positive_definite=found.positive_definite)
    counts, wccv = totals.amin((-1, -2)), counting(wccv, omega)
    if method != "auto":
        return Chosen(ESTIMATORS[method](wccv, counts, omega), method)
    selection = select_estimator(signal, omega)
    names = selection.candidates
    candidates = torch.stack([ESTIMATORS[name](wccv, counts, omega) for name in names], 1)
    weights = candidates.take_along_dim(selection.chosen[:, None, None], 1)[:, 0]
    different = selection.chosen.unique()
    return Chosen(weights, names[int(different)] if len(different) == 1 else "auto", selection)
