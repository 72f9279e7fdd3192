"""Flicker noise where the simulation has none."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.axes import OfSensors
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.colour import noise
from gyrofuse.mismatch.gaussian import Addition
from gyrofuse.mismatch.mechanism import Finding, Mechanism
from gyrofuse.mismatch.shape_terms import Flicker
from gyrofuse.mismatch.shape_words import found, spanned
from gyrofuse.mismatch.shapes import chosen_shape, refit


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
    level: OfSensors

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        shape = chosen_shape(case, cls.name, level)
        if shape is None:
            return None
        a, sd = shape.term.local[0], shape.sd[0][0]
        sensors = tuple(int(i) for i in shape.term.free[0].nonzero()[:, 0])
        parameters = {}
        for i in sensors:
            parameters[f"level[{i}]"] = spanned(
                lambda x: math.sqrt(2 * max(x, 0.0)), float(a[i]), float(sd[i]), case.scene.measure
            )
        where = case.scene.named(sensors, "all sensors")
        largest = max(math.sqrt(2 * float(a[i])) for i in sensors)
        return found(
            case,
            cls(a),
            shape,
            sensors,
            parameters,
            f"1/f noise in {where} that the simulation does not have, up to {largest:.3g} "
            f"{case.scene.measure} rms in each factor e of frequency",
        )

    def density(self, f: Tensor) -> Tensor:
        return torch.diag_embed(self.level / f[:, None])

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        return self.level.sqrt()[:, None] * noise(n_samples, torch.reciprocal, len(self.level), generator)

    def refitted(self, case: Case, fold: int) -> Mechanism:
        own = self.level[None]
        term = Flicker(own, own > 0, torch.zeros(0, dtype=torch.float64))
        return replace(self, level=refit(case, fold, term, self.company).local[0])
