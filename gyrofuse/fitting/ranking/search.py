"""Largest likelihoods of structures for many records, each climbed to from every one with one process less."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import fields, replace
from typing import Generic, TypeVar

import torch
from torch import Tensor

from gyrofuse.fitting.ranking import candidates as structures
from gyrofuse.fitting.ranking.candidates import Key, Kinds
from gyrofuse.fitting.ranking.moments import MomentFit, Moments
from gyrofuse.fitting.ranking.spectra import NoiseFit, Spectra
from gyrofuse.fitting.structure import ModelStructure

# Difference of two criteria below which candidates are equivalent: penalised likelihoods within a factor of e^2 = 7.
EQUIVALENT = 4.0

FitT = TypeVar("FitT", NoiseFit, MomentFit)


class _Search(ABC, Generic[FitT]):
    """Fits of structures to some of the records each.

    Args:
        n_items: How many records.
        n_samples: Length T of each.
        device: Where they are.

    Attributes:
        held: Whether frequencies of sinusoids are fixed beforehand.
        afresh: Structures with one shape start from a grid too.
        fits: Of all records; NaN where a structure was not tried.
    """

    held: bool
    afresh: bool

    def __init__(self, n_items: int, n_samples: int, device: torch.device) -> None:
        self._everyone, self._n_samples = torch.arange(n_items, device=device), n_samples
        self.fits: dict[Key, tuple[ModelStructure, FitT]] = {}

    def run(self, wanted: list[Kinds], searching: bool) -> None:
        """Fit all that are wanted to all records, or search among them for those that matter to each."""
        if searching:
            known = {structures.key_of(kinds) for kinds in wanted}
            self._widen([kinds for kinds in wanted if len(kinds) == 1], known)
            self._settle(known)
            return
        for kinds in structures.with_ancestors(wanted):
            self._try_out(kinds, self._everyone)

    def found(self, key: Key) -> tuple[ModelStructure, Tensor, FitT]:
        """A structure, the records to which it was fitted, and the fit of those."""
        structure, fit = self.fits[key]
        items = self._loss(fit).isfinite().nonzero()[:, 0]
        return structure, items, _part(fit, items)

    def criterion(self, key: Key) -> Tensor:
        """Of Hannan and Quinn, `(item,)`, infinite where it was not tried."""
        structure, fit = self.fits[key]
        return (self._loss(fit) + structures.penalty(structure, self._n_samples)).nan_to_num(nan=torch.inf)

    def _widen(self, first: list[Kinds], known: set[Key]) -> None:
        """From one process to more, for every record the children of its few best, as long as one of them gains."""
        everyone = torch.ones_like(self._everyone, dtype=torch.bool)
        best = torch.full_like(self._everyone, torch.inf, dtype=torch.float64)
        todo = {structures.key_of(kinds): (kinds, everyone) for kinds in first}
        while todo:
            for kinds, which in todo.values():
                self._try_out(kinds, which.nonzero()[:, 0])
            found = torch.stack([self.criterion(key) for key in todo])  # (candidate, item)
            # Larger structures are tried while the best of a size is at most six above the best of all so far: a little
            # less than one parameter costs (6.7 at 10^4 samples, 8.3 at 10^7). A size all of whose structures fit no
            # better than smaller ones thus ends the search.
            going = found.amin(0) < best + 6.0
            best = torch.minimum(best, found.amin(0))
            # The extensions of the three best of a size: where an AR1 stands for two processes, the best of a size
            # may not be among the parents of the best structure. `_settle` looks for what the three miss.
            kept = (found.argsort(0).argsort(0) < 3) & found.isfinite() & going
            following: dict[Key, tuple[Kinds, Tensor]] = {}
            for (kinds, _), which in zip(todo.values(), kept, strict=True):
                for child in structures.children(kinds, known) if bool(which.any()) else ():
                    _, other = following.get(structures.key_of(child), (child, torch.zeros_like(which)))
                    following[structures.key_of(child)] = child, which | other
            todo = following

    def _settle(self, known: set[Key]) -> None:
        """Compare the best one of each record with all next to it, until none of these is better.

        The three structures kept may all lack a process that an AR1 replaced.
        """
        seen = {key: self._loss(fit).isfinite() for key, (_, fit) in self.fits.items()}
        while True:
            keys = list(self.fits)
            best = torch.stack([self.criterion(key) for key in keys]).argmin(0)
            unseen = False
            for b in best.unique().tolist():
                structure, fit = self.fits[keys[b]]
                for kinds, k in structures.next_to(structures.kinds_of(structure), known):
                    before = seen.get(structures.key_of(kinds), torch.zeros_like(best, dtype=torch.bool))
                    items = ((best == b) & ~before).nonzero()[:, 0]
                    if len(items):
                        unseen = True
                        self._try_out(kinds, items, None if k is None else self._without(structure, fit, k))
                        seen[structures.key_of(kinds)] = before | (best == b)
            if not unseen:
                return

    def _without(self, structure: ModelStructure, fit: FitT, k: int) -> tuple[ModelStructure, FitT]:
        """A structure less one of its processes, and what is left of its fit."""
        kinds = structures.kinds_of(structure)
        linear = [i for i in range(structure.n_linear) if i != k]
        shape = [i for i, at in enumerate(structure.nonlinear) if at != k]
        left = structures.structure_of(kinds[:k] + kinds[k + 1 :], self.held)
        return left, replace(fit, linear=fit.linear[:, linear], shape=fit.shape[:, shape])

    def _try_out(self, kinds: Kinds, items: Tensor, start: tuple[ModelStructure, FitT] | None = None) -> None:
        """Fit one structure to some records, from each of its parents: from the best of them alone it may be stuck.

        Where an AR1 of the best one stands for white noise, say, white noise cannot take its place.

        Args:
            kinds: Processes.
            items: Which records.
            start: Another place to start from: a structure with up to two processes less, and its parameters.
        """
        structure = structures.structure_of(kinds, self.held)
        smaller = [self.fits[key] for key in structures.parents(kinds) if key in self.fits]
        smaller += [start] if start else []
        afresh = not smaller or (self.afresh and len(structure.free_nonlinear) == 1)
        found = self._whole(self._first(structure, items), items) if afresh else None
        for parent, fit in smaller:
            own = items[self._loss(fit)[items].isfinite()]
            if len(own):
                climbed = self._climb(structure, own, *self._start(structure, own, parent, _part(fit, own)))
                whole = self._whole(climbed, own)
                found = whole if found is None else self._better(found, whole)
        key = structures.key_of(kinds)
        if found is not None:
            self.fits[key] = structure, self._better(self.fits[key][1], found) if key in self.fits else found

    def _whole(self, fit: FitT, items: Tensor) -> FitT:
        """Of all records, NaN but for these."""
        return type(fit)(*(_among(items, getattr(fit, f.name), len(self._everyone)) for f in fields(fit)))

    def _better(self, one: FitT, other: FitT) -> FitT:
        """For each record the fit with less loss."""
        first = ~(self._loss(other) < self._loss(one).nan_to_num(nan=torch.inf))
        pairs = ((getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
        return type(one)(*(torch.where(first.view(-1, *(1,) * (a.ndim - 1)), a, b) for a, b in pairs))

    @abstractmethod
    def _loss(self, fit: FitT) -> Tensor:
        """Minus twice the log likelihood `(item,)`."""

    @abstractmethod
    def _first(self, structure: ModelStructure, items: Tensor) -> FitT:
        """Fit a structure from no other one's fit."""

    @abstractmethod
    def _start(self, structure: ModelStructure, items: Tensor, parent: ModelStructure, fit: FitT) -> tuple[Tensor, ...]:
        """Where to start, from a parent's fit to the same records."""

    @abstractmethod
    def _climb(self, structure: ModelStructure, items: Tensor, *start: Tensor) -> FitT:
        """Fit from there."""


class SpectralSearch(_Search[NoiseFit]):
    """By the spectral likelihood of records without lines."""

    held, afresh = True, False

    def __init__(self, spectra: Spectra) -> None:
        super().__init__(len(spectra.energy), spectra.bins.n_samples, spectra.energy.device)
        self._spectra = spectra

    def _loss(self, fit: NoiseFit) -> Tensor:
        return -2 * fit.log_likelihood

    def _first(self, structure: ModelStructure, items: Tensor) -> NoiseFit:
        spectra = self._spectra.part(items)
        size = spectra.energy.sum(-1, keepdim=True) / spectra.count.sum(-1, keepdim=True)
        linear = size.expand(-1, structure.n_linear)
        if not structure.nonlinear:
            return spectra.fit(structure, linear, linear[:, :0])
        process = structure.processes[structure.nonlinear[0]]
        # Time constants of the first process with a memory, spread over all scales.
        powers = size.new_tensor((-0.2, 0.2, 0.5, 0.8))
        starts = process.from_time_scale(float(self._n_samples) ** powers)
        ends = [spectra.fit(structure, linear, start.expand_as(size)) for start in starts]
        best = ends[0]
        for other in ends[1:]:
            best = self._better(best, other)
        return best

    def _start(
        self, structure: ModelStructure, items: Tensor, parent: ModelStructure, fit: NoiseFit
    ) -> tuple[Tensor, ...]:
        return self._spectra.part(items).widened(parent, fit, structure)

    def _climb(self, structure: ModelStructure, items: Tensor, *start: Tensor) -> NoiseFit:
        linear, shape = start
        return self._spectra.part(items).fit(structure, linear, shape)


class MomentSearch(_Search[MomentFit]):
    """By the likelihood of wavelet variances, taken for normal with the `V` of each fit."""

    # The few long scales by which a shape is known are noisy: a smaller structure's fit may lead away from it.
    held, afresh = False, True

    def __init__(self, moments: Moments) -> None:
        super().__init__(len(moments.variance), moments.n_samples, moments.variance.device)
        self._moments = moments

    def _loss(self, fit: MomentFit) -> Tensor:
        return fit.objective + fit.log_det

    def _first(self, structure: ModelStructure, items: Tensor) -> MomentFit:
        moments = self._moments.part(items)
        return moments.fit(structure, moments.roots(structure))

    def _start(
        self, structure: ModelStructure, items: Tensor, parent: ModelStructure, fit: MomentFit
    ) -> tuple[Tensor, ...]:
        return (self._moments.part(items).widened(parent, fit, structure),)

    def _climb(self, structure: ModelStructure, items: Tensor, *start: Tensor) -> MomentFit:
        return self._moments.part(items).fit(structure, list(start))


def _part(fit: FitT, items: Tensor) -> FitT:
    """Of some records."""
    return type(fit)(*(getattr(fit, f.name)[items] for f in fields(fit)))


def _among(places: Tensor, values: Tensor, n_items: int) -> Tensor:
    """Values in their places among so many, NaN elsewhere."""
    whole = values.new_full((n_items, *values.shape[1:]), torch.nan)
    whole[places] = values
    return whole
