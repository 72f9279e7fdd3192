"""The ways to weigh the sensors of an array, behind one door."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gyrofuse.fusion.uncertainty.cross_fitting import MANY_DRAWS, CrossFit, Fusion, cross_fit
from gyrofuse.fusion.weights.baselines import precision_weights
from gyrofuse.fusion.weights.rdvg import rdvg
from gyrofuse.fusion.weights.selection import ESTIMATORS, Selection, select_estimator
from gyrofuse.fusion.weights.svo import counting, optimal_weights
from gyrofuse.wavelets.pilot import Pilot

# Model-assisted weights take 150 steps for every draw; they overfit little, so that few draws tell by how much.
_DRAWS_OF_MODELS = 16
# Arrays whose weights are fitted anew together: the draws of so many fit into memory.
_ITEMS_AT_ONCE = 8
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

    def __getitem__(self, items: Tensor) -> Chosen:
        """Some items of the batch."""
        definite = None if self.positive_definite is None else self.positive_definite[items]
        selection = self.selection and self.selection[items]
        return replace(self, weights=self.weights[items], selection=selection, positive_definite=definite)

    @property
    def spread_of(self) -> Callable[[Tensor], Tensor] | None:
        """The function of `A` whose spread is that of the weights, or on the safe side of it; None when unknown.

        Weights with a model's help, or drawn towards others, vary less than those without.
        """
        if self.method == "inverse_variance":
            return precision_weights
        return optimal_weights if self.method in ("svo", "model_assisted", "shrinkage", "auto") else None

    @property
    def iterates(self) -> bool:
        """Whether the weights of any array come from a model that is fitted step by step."""
        if self.method == "auto" and self.selection is not None:
            return "model_assisted" in {self.selection.candidates[i] for i in self.selection.chosen.unique().tolist()}
        return self.method == "model_assisted"

    def fitted_anew(self, wccv: Tensor, counts: Tensor, omega: Tensor) -> Tensor:
        """Weights by the same methods from other moments of the same arrays; those of RDVG stay as they are.

        Args:
            wccv: `(item, draw, level, sensor, sensor)`.
            counts: `(item, draw, level)`, windows of each level.
            omega: `(level,)`, scale weights.

        Returns:
            `(item, draw, sensor)`.
        """
        if self.method == "rdvg":
            return self.weights[:, None].expand(*wccv.shape[:2], -1)
        wccv = counting(wccv, omega)
        if self.selection is None or self.method != "auto":
            return ESTIMATORS[self.method](wccv, counts, omega)
        weights = self.weights.new_empty(*wccv.shape[:2], wccv.shape[-1])
        for index in self.selection.chosen.unique().tolist():
            alike = self.selection.chosen == index
            weights[alike] = ESTIMATORS[self.selection.candidates[index]](wccv[alike], counts[alike], omega)
        return weights


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


def judge_weights(
    chosen: Chosen,
    sums: Tensor,
    counts: Tensor,
    omega: Tensor,
    pilot: Pilot,
    degrees: Tensor,
    confidence_level: float,
) -> CrossFit:
    """Cross-fit one vector of weights for all scales, see `gyrofuse.fusion.uncertainty.cross_fitting.cross_fit`.

    Args:
        chosen: The weights.
        sums: `(item, bin, level, sensor, sensor)`.
        counts: The same shape.
        omega: `(level,)`, scale weights.
        pilot: Model of the noise at the last levels.
        degrees: `(item, level)`, independent observations of each level.
        confidence_level: Of the limits.
    """
    parts = []
    for items in torch.arange(len(sums), device=sums.device).split(_ITEMS_AT_ONCE):
        some = chosen[items]
        fusion = _fusion(some, sums[items], counts[items], omega)
        args = (some.weights, sums[items], counts[items], pilot[items], degrees[items], confidence_level)
        parts.append(cross_fit(fusion, *args))
    return CrossFit.cat(parts)


def _fusion(chosen: Chosen, sums: Tensor, counts: Tensor, omega: Tensor) -> Fusion:
    totals = counts.sum(1)
    parts, most = sums / totals[:, None], totals.amax((-1, -2))[:, None]  # shares of the means; (item, 1, level)
    present = counts.amax((-1, -2))

    def squares_of(weights: Tensor, first: int, last: int, n_levels: int) -> tuple[Tensor, Tensor]:
        squares = torch.einsum("ni,ntjik,nk->ntj", weights, parts[:, first:last, :n_levels], weights)
        return squares * most[..., :n_levels], present[:, first:last, :n_levels]

    def variance_of(weights: Tensor, wccv: Tensor) -> Tensor:
        return torch.einsum("nri,nrjik,nrk->nrj", weights, wccv, weights)

    return Fusion(
        lambda wccv, windows: chosen.fitted_anew(wccv, windows, omega),
        variance_of,
        squares_of,
        n_draws=_DRAWS_OF_MODELS if chosen.iterates else MANY_DRAWS,
    )
