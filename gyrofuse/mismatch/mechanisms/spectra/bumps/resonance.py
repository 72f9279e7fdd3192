"""A mechanical mode that noise drives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import peak_starts
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode, OscillationOnTop, nominated, refitted_mode
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.filters import noise, of_phase

_NARROWEST = 1.5  # bins: half width of the narrowest peak that a record shows, in the place of a line


@dataclass(frozen=True, eq=False)
class Resonance(OscillationOnTop):
    """`S_ij -> S_ij + G_ij B(f)`, `B` the density of an AR2 of variance one with poles at `f_0` and half width `w`.

    Where one mode moves all sensors `G = g g^H`, else it is diagonal. Its envelope is that of Gaussian noise, which a
    tone's is not, however its frequency wanders; it falls off on both sides, which coloured noise does not.

    Attributes:
        mode: Centre, width and gains.
    """

    name: ClassVar[str] = "resonance"
    rivals: ClassVar[tuple[str, ...]] = ("vibration_tone", "parameter_shift", "low_pass", "flicker", "common_mode")
    named_together: ClassVar[tuple[str, ...]] = ("drifting_tone",)
    separated_by: ClassVar[str] = (
        "a longer recording: the envelope of noise through a resonance is Rayleigh distributed"
    )
    broad: ClassVar[bool] = True
    mode: Mode

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        return peak_starts(data, company)

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

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        """Noise in a band as narrow as the record can show, in the place of a tone."""
        tone = finding.effect
        if not isinstance(tone, VibrationTone):
            return None
        gain = torch.complex(tone.cosine, -tone.sine) / math.sqrt(2)
        centre, width = tone.frequency_hz / comparison.info.rate, _NARROWEST / comparison.n_samples
        return Rival(cls(Mode(centre, width, gain, True)), finding.gain)

    def line_width(self, parameters: Mapping[str, Parameter], comparison: Comparison) -> float | None:
        return self.mode.width * comparison.info.rate

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        built = super().apply_to_reference(comparison, generator)
        return replace(built, modes=(*built.modes, (self.mode.centre, self.mode.width)))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        rate = comparison.info.rate
        pictures.spectrum_near(ax, comparison, sensor, self.mode.centre * rate, self.mode.width * rate)

    def density(self, f: Tensor) -> Tensor:
        return self.mode.matrix() * self.mode.profile(f, 2 * float(f[1] - f[0]))[:, None, None]

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        rows = 1 if self.mode.shared else len(self.mode.gain)
        return of_phase(self.mode.gain, noise(n_samples, self.mode.profile, rows, generator))

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        return replace(self, mode=refitted_mode(comparison, fold, self.mode))
