"""Flicker noise where the simulation has none."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import Flicker, Term
from gyrofuse.mismatch.likelihoods.spectra.fit import pieces
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import best_start
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.spectra.findings import found, spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.rivals import fit_alone, happened_instead, walks_of
from gyrofuse.mismatch.mechanisms.spectra.spectral import Addition
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.filters import noise


@dataclass(frozen=True, eq=False)
class FlickerNoise(Addition):
    """`S_i -> S_i + a_i / f`, `f` in cycles per sample: a flat stretch of the Allan deviation.

    A sum of AR1s does the same over a few decades; one or two are told apart where flicker stands over white noise by
    hundreds of bins of the spectrum. Walks fall as `1 / f^2`.

    Attributes:
        level: `a`, `(sensor,)`, unit of the signal squared. The noise between `f` and `e f` has the variance `2 a`:
            spectra are two-sided.
    """

    name: ClassVar[str] = "flicker"
    rivals: ClassVar[tuple[str, ...]] = ("parameter_shift", "low_pass", "common_mode")
    separated_by: ClassVar[str] = "a recording ten times as long"
    level: OfSensors

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        if any(isinstance(term, Flicker) for term in company):
            return ()
        return (best_start(data, pieces(data, company), Flicker.starts(data.ground))[0],)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level)
        if shape is None:
            return None
        a, sd = shape.term.local[0], shape.sd[0][0]
        sensors = tuple(int(i) for i in shape.term.free[0].nonzero()[:, 0])
        parameters = {}
        for i in sensors:
            parameters[f"level[{i}]"] = spanned(
                lambda x: math.sqrt(2 * max(x, 0.0)), float(a[i]), float(sd[i]), comparison.info.measure
            )
        where = comparison.info.named(sensors, "all sensors")
        largest = max(math.sqrt(2 * float(a[i])) for i in sensors)
        return found(
            cls(a),
            shape,
            sensors,
            parameters,
            f"1/f noise in {where} that the simulation does not have, of a level of up to {largest:.3g} "
            f"{comparison.info.measure} rms in each factor e of frequency",
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        found = fit_alone(
            comparison, finding.sensors, lambda data: best_start(data, pieces(data, []), Flicker.starts(data.ground))[0]
        )
        return None if found is None else Rival(cls(found[0].local[0]), found[1])

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> FlickerNoise | None:
        return cls(term.local[0]) if isinstance(term, Flicker) else None

    def explained_by_others(
        self, comparison: Comparison, finding: Finding, beside: Sequence[Finding]
    ) -> tuple[str, ...]:
        return happened_instead(comparison, finding, beside, walks_of(comparison, finding))

    def density(self, f: Tensor) -> Tensor:
        return torch.diag_embed(self.level / f[:, None])

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        return self.level.sqrt()[:, None] * noise(n_samples, torch.reciprocal, len(self.level), generator)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        own = self.level[None]
        term = Flicker(own, own > 0, torch.zeros(0, dtype=torch.float64))
        return replace(self, level=refit(comparison, fold, term, self.company).local[0])
