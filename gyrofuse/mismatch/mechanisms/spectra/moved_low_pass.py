"""A low-pass filter that the simulation has as well, of another corner or order."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import LowPass, Term
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import (
    filter_corner,
    filter_number,
    filter_power,
    filter_response,
    filter_strength,
    strength_of,
)
from gyrofuse.mismatch.likelihoods.spectra.fit import pieces
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import closest_starts
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.spectra.findings import found, half_power_words, spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.low_pass import LowPassFilter, falls
from gyrofuse.mismatch.mechanisms.spectra.spectral import Filter
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import OfSensors

_KINDS = ("bilinear", "bilinear2", "bilinear3", "bilinear4", "sampled2")
_MOST = 1e6  # of a ratio of powers: where the simulation lets less through, others leak


@dataclass(frozen=True, eq=False)
class MovedLowPass(Term):
    """The recording's filter over the simulation's.

    Local is the number of a sensor's, shared that of the simulation's, see `LowPass`.
    """

    name: ClassVar[str] = "low_pass"
    acts: ClassVar[str] = "filter"
    turns: ClassVar[bool] = True
    lower: ClassVar[float] = LowPass.lower
    upper: ClassVar[float] = LowPass.upper

    kind: str = "bilinear2"
    simulated_kind: str = "bilinear2"

    def step_limit(self) -> tuple[Tensor, Tensor]:
        return torch.full_like(self.local, 0.7), torch.full_like(self.shared, 0.7)

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        own = filter_power(self.kind, strength_of(self.kind, local[..., 0, :]), ground.nodes)
        undone = filter_power(self.simulated_kind, strength_of(self.simulated_kind, shared[..., :1]), ground.nodes)
        return torch.where(self.free[0, :, None], (own / undone.clamp(min=1e-100)).clamp(max=_MOST), 1.0)

    def turn(self, f: Tensor) -> Tensor:
        own = filter_response(self.kind, strength_of(self.kind, self.local[0]), f)
        undone = filter_response(self.simulated_kind, strength_of(self.simulated_kind, self.shared[:1]), f)
        return torch.where(self.free[0, :, None], (own * undone.conj()).sgn(), 1.0)

    def form_cost(self, n_sensors: int) -> float:
        return super().form_cost(n_sensors) + math.log(len(_KINDS) ** 2)

    def everywhere(self, ground: Ground) -> Term:
        """Sensors without have the simulation's corner."""
        corner = filter_corner(self.simulated_kind, strength_of(self.simulated_kind, self.shared[:1]))
        there = filter_number(self.kind, filter_strength(self.kind, corner))
        return replace(self, free=torch.ones_like(self.free), local=torch.where(self.free, self.local, there))

    def within(self) -> MovedLowPass:
        """The simulation's filter is one that shows: without it that of the recording is a filter by itself."""
        highest = torch.tensor([0.47], dtype=torch.float64)  # corner, cycles per sample
        least = float(filter_number(self.simulated_kind, filter_strength(self.simulated_kind, highest)))
        local = self.local.clamp(min=self.lower, max=self.upper)
        return replace(self, local=local, shared=self.shared.clamp(min=self.lower, max=least))


@dataclass(frozen=True, eq=False)
class MovedLowPassFilter(Filter):
    """`S_i -> |H_i(f) / H_0(f)|^2 S_i`: the recording's low-pass filter in the place of the simulation's own.

    Their ratio rises or falls to a plateau, and has a foot where the higher of both corners is, which no filter by
    itself has. The simulation's is looked for where its noise falls towards half the rate.

    Attributes:
        kind: Form of the recording's filter.
        strength: Of each sensor's, `(sensor,)`; 0 where it has the simulation's.
        simulated_kind: Form of the simulation's filter.
        simulated_strength: Its strength.
    """

    name: ClassVar[str] = "low_pass"
    rivals: ClassVar[tuple[str, ...]] = LowPassFilter.rivals
    separated_by: ClassVar[str] = LowPassFilter.separated_by
    made_of: ClassVar[str] = "filter"
    kind: str
    strength: OfSensors
    simulated_kind: str
    simulated_strength: float

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        if not bool(falls(data).any()) or any(isinstance(term, LowPass | MovedLowPass) for term in company):
            return ()
        return _starts(data, company)[:1]

    @classmethod
    def forms(cls, data: Ratios, term: Term, company: Sequence[Term]) -> Iterable[Term]:
        if not isinstance(term, MovedLowPass):
            return ()
        own = (term.kind, term.simulated_kind)
        return [form for form in _starts(data, company) if (form.kind, form.simulated_kind) != own]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level)
        if shape is None or not isinstance(shape.term, MovedLowPass):
            return None
        term, rate = shape.term, comparison.info.rate
        effect = cls.of(term)
        sensors = tuple(effect.strength.nonzero()[:, 0].tolist())

        def hertz(kind: str, number: float) -> float:
            return rate * float(filter_corner(kind, strength_of(kind, torch.tensor(number, dtype=torch.float64))))

        shared_sd = float(shape.sd[1][0])
        parameters = {
            "simulated_corner": spanned(lambda x: hertz(term.simulated_kind, x), float(term.shared[0]), shared_sd, "Hz")
        }
        for i in sensors:
            parameters[f"corner[{i}]"] = spanned(
                lambda x: hertz(term.kind, x), float(term.local[0, i]), float(shape.sd[0][0, i]), "Hz"
            )
        corners = [parameters[f"corner[{i}]"].value for i in sensors]
        where = comparison.info.named(sensors, "all sensors")
        before = half_power_words([parameters["simulated_corner"].value])
        return found(
            effect,
            shape,
            sensors,
            parameters,
            f"the low-pass filter of {where} has {half_power_words(corners)}, that of the simulation {before}",
            frequency_hz=min(corners),
        )

    @classmethod
    def of(cls, term: MovedLowPass) -> MovedLowPassFilter:
        """What a term stands for."""
        strength = torch.where(term.free[0], strength_of(term.kind, term.local[0]), 0.0)
        return cls(term.kind, strength, term.simulated_kind, float(strength_of(term.simulated_kind, term.shared[:1])))

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> MovedLowPassFilter | None:
        return cls.of(term) if isinstance(term, MovedLowPass) else None

    def response(self, f: Tensor) -> Tensor:
        own = filter_response(self.kind, self.strength, f)
        undone = filter_response(self.simulated_kind, torch.full_like(self.strength[:1], self.simulated_strength), f)
        ratio = own * undone.conj() / undone.abs().square().clamp(min=1e-100)
        ratio = ratio / (ratio.abs() / math.sqrt(_MOST)).clamp(min=1.0)
        return torch.where(self.strength[:, None] > 0, ratio, 1.0)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        has = self.strength > 0
        own = torch.where(has, filter_number(self.kind, self.strength), 0.0)[None]
        shared = filter_number(self.simulated_kind, torch.tensor([self.simulated_strength], dtype=torch.float64))
        term = MovedLowPass(own, has[None], shared, self.kind, self.simulated_kind)
        found = refit(comparison, fold, term, self.company)
        assert isinstance(found, MovedLowPass)
        again = self.of(found)
        return replace(self, strength=again.strength, simulated_strength=again.simulated_strength)


def _starts(data: Ratios, company: Sequence[Term]) -> list[MovedLowPass]:
    """Every pair of forms, the likeliest first.

    The simulation's filter is the one without which its noise would be the most even in all but the slow bands, in the
    sensors where it falls: others may have none.
    """
    ground = data.ground
    free, low = torch.ones(1, data.n_sensors, dtype=torch.bool), falls(data)
    came, slow, faint = data.power * ground.rounded[0], 0.03, 1e-3  # of the most in a band: below it is what leaks
    fast = ground.bands.frequency > slow
    shown = came[fast][:, low].log().mean(-1)
    weight = (data.s * data.usable.amax(-1))[fast] * (shown > shown.max() + math.log(faint))
    families: list[Term] = []
    for simulated in _KINDS:
        numbers = torch.linspace(LowPass.lower, LowPass.upper, 400, dtype=torch.float64)
        undone = filter_power(simulated, strength_of(simulated, numbers), ground.nodes)  # (start, node)
        left = shown - ground.bands.mean_of(undone).clamp(min=1e-100)[:, fast].log()
        mean = (left * weight).sum(-1, keepdim=True) / weight.sum()
        likeliest = int(((left - mean).square() * weight).sum(-1).argmin())
        families += [
            MovedLowPass(LowPass.starts(ground, kind).local, free, numbers[likeliest, None], kind, simulated)
            for kind in _KINDS
        ]
    found = closest_starts(data, pieces(data, company), families)
    return [start for start in found if isinstance(start, MovedLowPass)]
