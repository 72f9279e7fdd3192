"""A mechanical mode that noise drives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.spectra.oscillation import Mode, nominated, refitted_mode
from gyrofuse.mismatch.mechanisms.spectra.spectral import Addition
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.filters import noise, of_phase


@dataclass(frozen=True, eq=False)
class Resonance(Addition):
    """`S_ij -> S_ij + G_ij B(f)`, `B` the density of an AR2 of variance one with poles at `f_0` and half width `w`.

    Where one mode moves all sensors `G = g g^H`, else it is diagonal. Its envelope is that of Gaussian noise, which a
    tone's is not, however its frequency wanders; it falls off on both sides, which coloured noise does not.

    Attributes:
        mode: Centre, width and gains.
    """

    name: ClassVar[str] = "resonance"
    mode: Mode

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        seen = nominated(comparison, level, tone=False)
        if seen is None:
            return None
        mode, finding = seen
        rate, unit = comparison.info.rate, comparison.info.measure
        source = "one mode moves" if mode.shared else "modes of their own move"
        return finding.of(
            cls(mode),
            f"a resonance at {mode.centre * rate:.4g} Hz with a quality factor of {mode.centre / mode.width / 2:.3g} "
            f"that the simulation does not have: {source} {finding.where}, by up to "
            f"{float(mode.gain.abs().max()):.3g} {unit} rms",
            amplitude="rms",
            factor=1.0,
        )

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        built = super().apply_to_reference(comparison, generator)
        return replace(built, modes=(*built.modes, (self.mode.centre, self.mode.width)))

    def density(self, f: Tensor) -> Tensor:
        return self.mode.matrix() * self.mode.profile(f, 2 * float(f[1] - f[0]))[:, None, None]

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        rows = 1 if self.mode.shared else len(self.mode.gain)
        return of_phase(self.mode.gain, noise(n_samples, self.mode.profile, rows, generator))

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        return replace(self, mode=refitted_mode(comparison, fold, self.mode))
