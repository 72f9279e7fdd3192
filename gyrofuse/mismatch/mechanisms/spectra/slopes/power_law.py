"""Noise that falls by another power of frequency than flicker noise and random walks do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import PowerLaw, Term
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.spectra.findings import found, spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.rivals import happened_instead, walks_of
from gyrofuse.mismatch.mechanisms.spectra.spectral import Addition
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.filters import noise
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class PowerLawNoise(Addition):
    """`S_i -> S_i + b_i (f0/f)^slope`: fractional noise, of any slope but that of flicker noise.

    Looked for where flicker noise, or other numbers of the simulation, would be named and it is plainly likelier.

    Attributes:
        level: `b`, `(sensor,)`, the density per sample at `f0`, unit of the signal squared.
        slope: Between 0.2 and 2; flicker noise has 1, a random walk 2.
        at: `f0`, cycles per sample.
    """

    name: ClassVar[str] = "power_law"
    rivals: ClassVar[tuple[str, ...]] = ("flicker", "parameter_shift")
    separated_by: ClassVar[str] = "a recording ten times as long"
    level: OfSensors
    slope: float
    at: float

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level)
        if shape is None or not isinstance(shape.term, PowerLaw):
            return None
        effect, info = cls._of(shape.term), comparison.info
        sensors = tuple(int(i) for i in shape.term.free[0].nonzero()[:, 0])
        parameters = {"slope": Parameter.around(effect.slope, Z * float(shape.sd[1][0]), "", least=0.0)}
        for i in sensors:
            parameters[f"density[{i}]"] = spanned(
                lambda x: math.sqrt(max(x, 0.0) / info.rate),
                float(effect.level[i]),
                float(shape.sd[0][0, i]),
                f"{info.measure}/sqrt(Hz)",
            )
        largest = max(math.sqrt(float(effect.level[i]) / info.rate) for i in sensors)
        return found(
            effect,
            shape,
            sensors,
            parameters,
            f"noise in {info.named(sensors, 'all sensors')} that the simulation does not have, whose density falls as "
            f"1/f^{effect.slope:.3g}, from up to {largest:.3g} {info.measure}/sqrt(Hz) at {effect.at * info.rate:.3g} "
            "Hz",
        )

    @classmethod
    def _of(cls, term: PowerLaw) -> PowerLawNoise:
        return cls(term.local[0], float(term.shared[0]), term.middle)

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> PowerLawNoise | None:
        return cls._of(term) if isinstance(term, PowerLaw) else None

    def explained_by_others(
        self, comparison: Comparison, finding: Finding, beside: Sequence[Finding]
    ) -> tuple[str, ...]:
        return happened_instead(comparison, finding, beside, walks_of(comparison, finding))

    def density(self, f: Tensor) -> Tensor:
        return torch.diag_embed(self.level * ((self.at / f) ** self.slope)[:, None])

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        own = noise(n_samples, lambda f: (self.at / f) ** self.slope, len(self.level), generator)
        return self.level.sqrt()[:, None] * own

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        own = self.level[None]
        term = PowerLaw(own, own > 0, torch.tensor([self.slope], dtype=torch.float64), self.at)
        again = refit(comparison, fold, term, self.company)
        return replace(self, level=again.local[0], slope=float(again.shared[0]))
