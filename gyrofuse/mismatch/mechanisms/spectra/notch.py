"""A notch: a filter that takes a band out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.fit import pieces
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import best_of_families
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.spectra.findings import found, spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.rivals import fit_alone
from gyrofuse.mismatch.mechanisms.spectra.spectral import Filter
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import OfSensors


@dataclass(frozen=True, eq=False)
class Notch(Term):
    """A notch of each sensor: local is its depth in nepers, shared are the logarithms of the centre and of the width.

    The centre is in cycles per sample, the width over the centre.
    """

    name: ClassVar[str] = "notch"
    acts: ClassVar[str] = "filter"
    lower: ClassVar[float] = 0.0
    upper: ClassVar[float] = 5.0  # what leaks into it is more than what it lets through

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        centre, width = (shared[..., k, None, None].exp() for k in (0, 1))
        return notch_response(ground.nodes, centre, width, local[..., 0, :, None]).abs().square()

    def step_limit(self) -> tuple[Tensor, Tensor]:
        half_a_width = self.shared[1].exp() / 2
        return torch.full_like(self.local, 1.0), torch.stack(
            [half_a_width.clamp(max=0.5), torch.ones_like(half_a_width)]
        )

    def everywhere(self, ground: Ground) -> Term:
        faint = 0.05
        return replace(self, free=torch.ones_like(self.free), local=torch.where(self.free, self.local, faint))

    def within(self) -> Notch:
        """Both sides of it are below half the rate: else it is a low pass."""
        narrowest, widest = math.log(0.02), torch.tensor(0.0, dtype=torch.float64)
        centre = self.shared[..., 0].clamp(max=math.log(0.46))
        upper = torch.minimum((0.5 / centre.exp() - 1).log(), widest)
        shared = torch.stack([centre, self.shared[..., 1].clamp(min=narrowest).minimum(upper)], -1)
        return replace(self, local=self.local.clamp(min=self.lower, max=self.upper), shared=shared)


@dataclass(frozen=True, eq=False)
class NotchFilter(Filter):
    """`S_i -> |H_i(f)|^2 S_i`, `H_i = (1 - u^2 + j d_i w u) / (1 - u^2 + j w u)`: a filter that takes a band out.

    `u = f / f0`, and `d` is what it lets through at its centre. Flight controllers have them against
    motors, drivers of gyros against modes. A low pass passes nothing above its band, other levels of noise have no
    hole.

    Attributes:
        centre: `f0`, cycles per sample.
        width: `w`, between the frequencies of half power of a deep one, over the centre.
        depth: `-log d`, `(sensor,)`; 0 is none.
    """

    name: ClassVar[str] = "notch"
    rivals: ClassVar[tuple[str, ...]] = ("low_pass", "parameter_shift")
    separated_by: ClassVar[str] = "the response to a known motion"
    made_of: ClassVar[str] = "filter"
    centre: float
    width: float
    depth: OfSensors

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        if any(isinstance(term, Notch) for term in company):
            return ()
        return (_start(data, company),)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level)
        if shape is None or not isinstance(shape.term, Notch):
            return None
        term, rate = shape.term, comparison.info.rate
        effect = cls.of(term)
        sensors = tuple(effect.depth.nonzero()[:, 0].tolist())
        at, over = term.shared.tolist()
        at_sd, over_sd = shape.sd[1].tolist()
        at += math.log(rate)
        decibel = 20 / math.log(10)  # in a neper
        parameters = {
            "centre": spanned(math.exp, at, at_sd, "Hz"),
            "width": spanned(math.exp, at + over, math.hypot(at_sd, over_sd), "Hz"),
        }
        for i in sensors:
            parameters[f"depth[{i}]"] = spanned(
                lambda x: decibel * x, float(effect.depth[i]), float(shape.sd[0][0, i]), "dB"
            )
        where = comparison.info.named(sensors, "all sensors")
        return found(
            comparison,
            effect,
            shape,
            sensors,
            parameters,
            f"a notch at {math.exp(at):.4g} Hz in {where} that the simulation does not have, {math.exp(at + over):.3g} "
            f"Hz wide and up to {decibel * float(effect.depth.max()):.3g} dB deep",
            frequency_hz=math.exp(at),
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        found = fit_alone(comparison, finding.sensors, lambda data: _start(data, []))
        if found is None or not isinstance(term := found[0], Notch):
            return None
        return Rival(cls.of(term), found[1])

    @classmethod
    def of(cls, term: Term) -> NotchFilter:
        """That of a component."""
        centre, width = term.shared.exp().tolist()
        return cls(centre, width, torch.where(term.free[0], term.local[0], 0.0))

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> NotchFilter | None:
        return cls.of(term) if isinstance(term, Notch) else None

    def response(self, f: Tensor) -> Tensor:
        centre, width = (torch.tensor(x, dtype=torch.float64) for x in (self.centre, self.width))
        return notch_response(f, centre, width, self.depth[:, None])

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        shared = torch.tensor([self.centre, self.width], dtype=torch.float64).log()
        term = refit(comparison, fold, Notch(self.depth[None], self.depth[None] > 0, shared), self.company)
        again = self.of(term)
        return replace(self, centre=again.centre, width=again.width, depth=again.depth)


def notch_response(f: Tensor, centre: Tensor, width: Tensor, depth: Tensor) -> Tensor:
    """Complex response at `f` cycles per sample of notches, numbers that broadcast with it."""
    u = f / centre.clamp(min=1e-9)
    through, taken = 1 - u.square(), width.clamp(min=1e-9) * u
    left = (-depth).exp() * taken
    return torch.complex(through.expand_as(left), left) / torch.complex(through, taken.expand_as(through))


def _start(data: Ratios, company: Sequence[Term]) -> Term:
    """The likeliest of a grid of centres and widths, each sensor's depth by itself."""
    lowest = max(16 * float(data.ground.bands.frequency[0]), 1e-3)
    centres = torch.linspace(math.log(lowest), math.log(0.46), 32, dtype=torch.float64)
    widths = torch.tensor([0.1, 0.3, 0.9], dtype=torch.float64).log()
    depths = torch.tensor([0.0, 0.1, 0.3, 0.7, 1.5, 3.0], dtype=torch.float64)
    every = torch.ones(1, data.n_sensors, dtype=torch.bool)
    family = Notch(depths[:, None, None], every, torch.cartesian_prod(centres, widths)[:, None]).within()
    best = best_of_families(data, pieces(data, company), family)
    return replace(best, local=best.local.clamp(min=float(depths[1])))
