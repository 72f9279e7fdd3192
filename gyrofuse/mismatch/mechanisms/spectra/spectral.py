"""Mechanisms that are a matter of spectra alone: filters, and Gaussian noise added. Both go into the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.declared import declared
from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.data import reference_noise
from gyrofuse.mismatch.likelihoods.spectra.ratios import FLOOR
from gyrofuse.mismatch.likelihoods.spectra.slow_ordinates import slow_gains
from gyrofuse.mismatch.likelihoods.spectra.starts import SpectralTerms
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.filters import filtered
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum


@dataclass(frozen=True, eq=False)
class Spectral(Mechanism, SpectralTerms):
    """What is judged by blocks and, where they are too short, by the slowest ordinates of the whole record.

    Attributes:
        company: Shapes in whose company its numbers were found, and are estimated anew: by itself it would have to
            stand for them as well. No part of what is saved.
        approximate: Whether its form is not quite that of the recording. No part of what is saved.
    """

    changes_noise: ClassVar[bool] = True
    of_spectra: ClassVar[bool] = True
    level_after_repairs: ClassVar[float] = 0.1  # spectra are then compared at levels that repairs have estimated
    company: tuple[Any, ...] = field(default=(), kw_only=True, metadata={"saved": False})
    approximate: bool = field(default=False, kw_only=True, metadata={"saved": False})

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.ratio_of_spectra(ax, comparison, sensor, partial(self._seen, comparison) if fitted else None)

    def _seen(self, comparison: Comparison, f: Tensor) -> Tensor:
        """Its factor `(sensor, frequency)` as it shows above what both sides are rounded by."""
        made = self.factor(reference_noise(comparison), f)
        if comparison.rounding is None:
            return made
        last = (comparison.rounding[:, None] / comparison.reference.density(f)).clamp(max=1.0)
        return made * (1 - last) + last

    def factor(self, base: NoiseSpectrum, f: Tensor) -> Tensor:
        """What it makes of the powers of a simulation's noise, `(sensor, frequency)` at `f` cycles per sample."""
        raise NotImplementedError

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        built = super().apply_to_reference(comparison, generator)
        return (
            replace(built, bent=(*built.bent, partial(self.factor, reference_noise(comparison))))
            if self.approximate
            else built
        )

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> Spectral | None:
        """The mechanism that one of its terms stands for; None of another's, by default of any."""
        return None

    def with_company(self, comparison: Comparison) -> tuple[Mechanism, tuple[Mechanism, ...]]:
        made = [
            next((effect for kind in declared(Spectral) if (effect := kind.from_term(term, comparison))), None)
            for term in self.company
        ]
        company = tuple(effect for effect in made if effect is not None)
        return replace(self, company=()), company if len(company) == len(made) else ()

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return super().held_out_scores(comparison, fold) + slow_gains(comparison, self.spectra, fold)


class Filter(Spectral):
    """A linear filter of each sensor; recordings have a floor below it, of what leaks and of what is rounded."""

    def response(self, f: Tensor) -> Tensor:
        """Complex gains `(sensor, frequency)` at `f` cycles per sample."""
        raise NotImplementedError

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return filtered(signal, self.response)

    def factor(self, base: NoiseSpectrum, f: Tensor) -> Tensor:
        return self.response(f).abs().square()

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        built = super().apply_to_reference(comparison, generator)
        factor = partial(self.factor, reference_noise(comparison))
        return replace(built, filters=(*built.filters, (self.name, factor)))

    def beneath_noise(self, later: Sequence[Mechanism], before: Comparison) -> Mechanism:
        """What acts on the simulation's own noise alone, as it is judged beside noise on top."""
        on_top = tuple(effect for effect in later if isinstance(effect, Addition))
        return Beneath(self, on_top, before) if on_top else self

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        gain = self.response(f).mT.to(matrices.dtype)  # (frequency, sensor)
        return matrices * (gain[:, :, None] * gain[:, None, :].conj() + FLOOR * torch.eye(gain.shape[-1]))


@dataclass(frozen=True, eq=False)
class Beneath(Mechanism):
    """A filter of the simulation's own noise, where noise on top is there already, which it does not act on.

    Attributes:
        inner: The filter.
        on_top: The noise.
        before: Recording and simulation without it.
    """

    changes_noise: ClassVar[bool] = True
    inner: Filter
    on_top: tuple[Addition, ...]
    before: Comparison

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        inner = self.inner.fit_without(self.before, fold)
        return replace(self, inner=inner) if isinstance(inner, Filter) else inner

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        least = 1e-3  # share of its powers that the simulation's own noise has at least
        on_top = torch.stack([effect.density(f) for effect in self.on_top]).sum(0).diagonal(dim1=-2, dim2=-1).real
        whole = matrices.diagonal(dim1=-2, dim2=-1).real
        added = torch.diag_embed(on_top.minimum((1 - least) * whole)).to(matrices.dtype)
        return self.inner.spectra(matrices - added, f) + added

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return super().held_out_scores(comparison, fold) + slow_gains(comparison, self.spectra, fold)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        made = self.inner.repair(self.before, generator)
        for effect in self.on_top:
            made = effect.repair(made, generator)
        return made


class Addition(Spectral):
    """Gaussian noise on top."""

    def density(self, f: Tensor) -> Tensor:
        """Cross-spectral densities `(frequency, sensor, sensor)` at `f` cycles per sample."""
        raise NotImplementedError

    def factor(self, base: NoiseSpectrum, f: Tensor) -> Tensor:
        return 1 + self.density(f).diagonal(dim1=-2, dim2=-1).real.mT / base.spectrum(f)

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        """One record of it, `(sensor, time)`."""
        raise NotImplementedError

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        records = signal.flatten(0, -3) if signal.ndim > 2 else signal[None]
        return torch.stack([r + self.path(r.shape[-1], generator) for r in records]).view_as(signal)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        return matrices + self.density(f).to(matrices.dtype)
