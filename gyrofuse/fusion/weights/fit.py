"""Weights of a batch of arrays by any method, with the sampling law they follow, and their cross-fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gyrofuse.fusion.uncertainty.cross_fitting import MANY_DRAWS, CrossFit, Fusion, cross_fit
from gyrofuse.fusion.weights.baselines import precision_weights
from gyrofuse.fusion.weights.methods import ESTIMATORS
from gyrofuse.fusion.weights.rdvg import rdvg
from gyrofuse.fusion.weights.selection import Selection, select_estimator
from gyrofuse.fusion.weights.svo import optimal_weights
from gyrofuse.wavelets.moments import Moments
from gyrofuse.wavelets.pilot import Pilot


@dataclass(frozen=True, eq=False)
class FusionWeights:
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

    def __getitem__(self, items: Tensor) -> FusionWeights:
        """Some items of the batch."""
        definite = None if self.positive_definite is None else self.positive_definite[items]
        selection = self.selection and self.selection[items]
        return replace(self, weights=self.weights[items], selection=selection, positive_definite=definite)

    @property
    def sampled_as(self) -> Callable[[Tensor], Tensor] | None:
        """The function of `A` whose sampling distribution is that of the weights, or a wider one; None when unknown.

        Model-assisted and shrunk weights vary less than SVO weights.
        """
        if self.method == "inverse_variance":
            return precision_weights
        return optimal_weights if self.method in ("svo", "model_assisted", "shrinkage", "auto") else None

    @property
    def iterates(self) -> bool:
        """Whether the weights of any array come from an iteratively fitted model."""
        if self.method == "auto" and self.selection is not None:
            return "model_assisted" in {self.selection.candidates[i] for i in self.selection.chosen.unique().tolist()}
        return self.method == "model_assisted"

    def refitted(self, wccv: Tensor, counts: Tensor, omega: Tensor) -> Tensor:
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
        wccv = _used(wccv, omega)
        if self.selection is None or self.method != "auto":
            return ESTIMATORS[self.method](wccv, counts, omega)
        weights = self.weights.new_empty(*wccv.shape[:2], wccv.shape[-1])
        for index in self.selection.chosen.unique().tolist():
            alike = self.selection.chosen == index
            weights[alike] = ESTIMATORS[self.selection.candidates[index]](wccv[alike], counts[alike], omega)
        return weights


def fit_weights(method: str, signal: Tensor, moments: Moments, omega: Tensor) -> FusionWeights:
    """Weights by one method, or by the one with the least held-out risk.

    Args:
        method: One of `METHODS`.
        signal: `(item, sensor, time)`.
        moments: Moments of the signal, batch `(item,)`.
        omega: Scale weights, `(level,)`.

    Returns:
        The weights, batch `(item,)`.
    """
    if method == "rdvg":
        found = rdvg(signal)
        return FusionWeights(found.weights.to(moments.wccv), method, positive_definite=found.positive_definite)
    counts, wccv = moments.fewest, _used(moments.wccv, omega)
    if method != "auto":
        return FusionWeights(ESTIMATORS[method](wccv, counts, omega), method)
    selection = select_estimator(signal, omega)
    names = selection.candidates
    candidates = torch.stack([ESTIMATORS[name](wccv, counts, omega) for name in names], 1)
    weights = candidates.take_along_dim(selection.chosen[:, None, None], 1)[:, 0]
    different = selection.chosen.unique()
    return FusionWeights(weights, names[int(different)] if len(different) == 1 else "auto", selection)


def cross_fit_weights(
    fitted: FusionWeights, moments: Moments, omega: Tensor, pilot: Pilot, dof: Tensor, confidence_level: float
) -> CrossFit:
    """Cross-fit one vector of weights for all scales, see `gyrofuse.fusion.uncertainty.cross_fitting.cross_fit`.

    Args:
        fitted: The weights.
        moments: What they were fitted to, batch `(item,)`.
        omega: Scale weights, `(level,)`.
        pilot: Model of the noise at the last levels.
        dof: `(item, level)`, independent observations of each level.
        confidence_level: Probability that the limits hold the variance in other recordings.

    Returns:
        The comparison, batch `(item,)`.
    """
    parts = []
    for items in torch.arange(len(dof), device=dof.device).split(8):  # 200 draws of eight arrays fit into memory
        some, own = fitted[items], moments[items]
        fusion = _fusion(some, own, omega)
        parts.append(cross_fit(fusion, some.weights, own, pilot[items], dof[items], confidence_level))
    return CrossFit.cat(parts)


def _used(wccv: Tensor, omega: Tensor) -> Tensor:
    """The levels that count; the others, which may be unknown (NaN), as 0."""
    return torch.where(omega.to(wccv.device)[:, None, None] > 0, wccv, 0.0)


def _fusion(fitted: FusionWeights, moments: Moments, omega: Tensor) -> Fusion:
    totals, counts = moments.totals, moments.counts
    parts, most = moments.sums / totals[:, None], totals.amax((-1, -2))[:, None]  # terms of the means; (item, 1, level)
    present = counts.amax((-1, -2))

    def squares_of(weights: Tensor, first: int, last: int, n_levels: int) -> tuple[Tensor, Tensor]:
        squares = torch.einsum("ni,ntjik,nk->ntj", weights, parts[:, first:last, :n_levels], weights)
        return squares * most[..., :n_levels], present[:, first:last, :n_levels]

    def variance_of(weights: Tensor, wccv: Tensor) -> Tensor:
        return torch.einsum("nri,nrjik,nrk->nrj", weights, wccv, weights)

    return Fusion(
        lambda wccv, windows: fitted.refitted(wccv, windows, omega),
        variance_of,
        squares_of,
        # Iterative fits overfit little, so that few draws are enough, and each takes 150 steps.
        n_draws=16 if fitted.iterates else MANY_DRAWS,
    )
