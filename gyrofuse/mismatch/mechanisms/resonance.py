"""A mechanical mode that noise drives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.colour import noise, of_phase
from gyrofuse.mismatch.gaussian import Addition
from gyrofuse.mismatch.mechanism import Finding, Mechanism
from gyrofuse.mismatch.oscillating import Mode, nominated, refitted_mode


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
    def nominate(cls, case: Case, level: float) -> Finding | None:
        seen = nominated(case, level, tone=False)
        if seen is None:
            return None
        mode, finding = seen
        rate, unit = case.scene.rate, case.scene.measure
        source = "one mode moves" if mode.shared else "modes of their own move"
        return finding.of(
            cls(mode),
            f"a resonance at {mode.centre * rate:.4g} Hz with a quality factor of {mode.centre / mode.width / 2:.3g} "
            f"that the simulation does not have: {source} {finding.where}, by up to "
            f"{float(mode.gain.abs().max()):.3g} {unit} rms",
            amplitude="rms",
            factor=1.0,
        )

    def built_into(self, case: Case, generator: torch.Generator) -> Case:
        built = super().built_into(case, generator)
        return replace(built, modes=(*built.modes, (self.mode.centre, self.mode.width)))

    def density(self, f: Tensor) -> Tensor:
        return self.mode.matrix() * self.mode.profile(f, 2 * float(f[1] - f[0]))[:, None, None]

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        rows = 1 if self.mode.shared else len(self.mode.gain)
        return of_phase(self.mode.gain, noise(n_samples, self.mode.profile, rows, generator))

    def refitted(self, case: Case, fold: int) -> Mechanism:
        return replace(self, mode=refitted_mode(case, fold, self.mode))
