"""A notch: a filter that takes a band out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import order_of, stopped
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

_FORMS = ("sampled", "bilinear", "bilinear2", "bilinear4", "bilinear8")  # as those of low passes are called


@dataclass(frozen=True, eq=False)
class Notch(Term):
    """A notch of each sensor: local is its depth in nepers, shared are the logarithms of the centre and of the width.

    The centre is in cycles per sample, the width over the centre, both as `_over_centre` has frequencies.
    """

    name: ClassVar[str] = "notch"
    acts: ClassVar[str] = "filter"
    lower: ClassVar[float] = 0.0
    upper: ClassVar[float] = 7.0  # what leaks into it is more than what it lets through

    kind: str = "sampled"

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        centre, width = (shared[..., k, None, None].exp() for k in (0, 1))
        u, order = _over_centre(ground.nodes, centre, self.kind), order_of(self.kind)
        through, taken = (1 - u.square()).square().pow(order), (width * u).square().pow(order)
        return (through + (-2 * local[..., 0, :, None]).exp() * taken) / (through + taken)

    def step_limit(self) -> tuple[Tensor, Tensor]:
        half_a_width = self.shared[1].exp() / 2
        return torch.full_like(self.local, 1.0), torch.stack(
            [half_a_width.clamp(max=0.5), torch.ones_like(half_a_width)]
        )

    def everywhere(self, ground: Ground) -> Term:
        faint = 0.05
        return replace(self, free=torch.ones_like(self.free), local=torch.where(self.free, self.local, faint))

    def form_cost(self, n_sensors: int) -> float:
        return super().form_cost(n_sensors) + (0.0 if self.kind == "sampled" else math.log(len(_FORMS)))

    def within(self) -> Notch:
        """Both sides of it are below half the rate: else it is a low pass."""
        narrowest, widest = math.log(0.02), torch.tensor(math.log(8.0), dtype=torch.float64)
        centre = self.shared[..., 0].clamp(max=math.log(0.46))
        upper = widest
        if self.kind == "sampled":
            upper = torch.minimum((0.5 / centre.exp() - 1).log(), torch.zeros_like(widest))
        shared = torch.stack([centre, self.shared[..., 1].clamp(min=narrowest).minimum(upper)], -1)
        return replace(self, local=self.local.clamp(min=self.lower, max=self.upper), shared=shared)


@dataclass(frozen=True, eq=False)
class NotchFilter(Filter):
    """`S_i -> |H_i(f)|^2 S_i`, `|H_i|^2 = (1 + d_i^2 x^2m) / (1 + x^2m)`, `x = w u / (1 - u^2)`: it takes a band out.

    `u` is the frequency over that of the centre, `d` what it lets through there. Flight controllers have them against
    motors, drivers of gyros against modes. Digital ones, also of higher order (band-stop filters), are Butterworth's by
    the bilinear transform: `u = tan(pi f) / tan(pi f0)`. A low pass passes nothing above its band, other levels of
    noise have no hole.

    Attributes:
        centre: `f0`, cycles per sample.
        width: `w`, between the values of `u` at half power of a deep one.
        depth: `-log d`, `(sensor,)`; 0 is none.
        kind: "sampled", or "bilinear" with its order `m`, if that is not one.
    """

    name: ClassVar[str] = "notch"
    rivals: ClassVar[tuple[str, ...]] = ("low_pass", "parameter_shift")
    separated_by: ClassVar[str] = "the response to a known motion"
    made_of: ClassVar[str] = "filter"
    centre: float
    width: float
    depth: OfSensors
    kind: str = "sampled"

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        if any(isinstance(term, Notch) for term in company):
            return ()
        first, deep = _start(data, company), 1.5  # nepers, from which the form shows
        return _starts(data, company) if float(first.local.max()) >= deep else [first]

    @classmethod
    def forms(cls, data: Ratios, term: Term, company: Sequence[Term]) -> Iterable[Term]:
        if not isinstance(term, Notch):
            return ()
        return [form for form in _starts(data, company) if form.kind != term.kind]

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
        decibel = 20 / math.log(10)  # in a neper
        parameters = {
            "centre": spanned(lambda x: rate * math.exp(x), at, at_sd, "Hz"),
            "width": spanned(
                lambda x: rate * _between_halves(math.exp(at), math.exp(x), term.kind),
                over,
                math.hypot(at_sd, over_sd),
                "Hz",
            ),
        }
        for i in sensors:
            if float(effect.depth[i]) < Notch.upper:
                parameters[f"depth[{i}]"] = spanned(
                    lambda x: decibel * x, float(effect.depth[i]), float(shape.sd[0][0, i]), "dB"
                )
        where = comparison.info.named(sensors, "all sensors")
        reach = "up to" if float(effect.depth.max()) < Notch.upper else "more than"
        return found(
            effect,
            shape,
            sensors,
            parameters,
            f"a notch at {parameters['centre'].value:.4g} Hz in {where} that the simulation does not have, "
            f"{parameters['width'].value:.3g} Hz wide and {reach} {decibel * float(effect.depth.max()):.3g} dB deep",
            frequency_hz=parameters["centre"].value,
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        found = fit_alone(comparison, finding.sensors, lambda data: _start(data, []))
        if found is None or not isinstance(term := found[0], Notch):
            return None
        return Rival(cls.of(term), found[1])

    @classmethod
    def of(cls, term: Notch) -> NotchFilter:
        """That of a component."""
        centre, width = term.shared.exp().tolist()
        return cls(centre, width, torch.where(term.free[0], term.local[0], 0.0), term.kind)

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> NotchFilter | None:
        return cls.of(term) if isinstance(term, Notch) else None

    def response(self, f: Tensor) -> Tensor:
        return notch_response(f, self.centre, self.width, self.depth, self.kind)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        shared = torch.tensor([self.centre, self.width], dtype=torch.float64).log()
        term = Notch(self.depth[None], self.depth[None] > 0, shared, self.kind)
        found = refit(comparison, fold, term, self.company)
        assert isinstance(found, Notch)
        again = self.of(found)
        return replace(self, centre=again.centre, width=again.width, depth=again.depth)


def notch_response(f: Tensor, centre: float, width: float, depth: Tensor, kind: str) -> Tensor:
    """Complex response `(sensor, frequency)` at `f` cycles per sample of notches of depth `(sensor,)`."""
    u = _over_centre(f, torch.tensor(centre, dtype=torch.float64), kind)
    taken = torch.complex(torch.zeros_like(u), max(width, 1e-9) * u)
    return stopped(taken, 1 - u.square(), depth[:, None], order_of(kind))


def _over_centre(f: Tensor, centre: Tensor, kind: str) -> Tensor:
    """Frequencies over the centre's, both in cycles per sample, as a form has them."""
    if kind == "sampled":
        return f / centre.clamp(min=1e-9)
    return torch.tan(math.pi * f) / torch.tan(math.pi * centre.clamp(min=1e-9))


def _between_halves(centre: float, width: float, kind: str) -> float:
    """Cycles per sample between the frequencies at which a deep one halves the power."""
    if kind == "sampled":
        return centre * width
    middle, tangent = math.hypot(1, width / 2), math.tan(math.pi * centre)
    return (math.atan(tangent * (middle + width / 2)) - math.atan(tangent * (middle - width / 2))) / math.pi


def _start(data: Ratios, company: Sequence[Term], kind: str = "sampled") -> Notch:
    """The likeliest of a grid of centres and widths, each sensor's depth by itself."""
    lowest = max(16 * float(data.ground.bands.frequency[0]), 1e-3)
    centres = torch.linspace(math.log(lowest), math.log(0.46), 32, dtype=torch.float64)
    widths = torch.tensor([0.1, 0.3, 0.9] + [2.7] * (kind != "sampled"), dtype=torch.float64).log()
    depths = torch.tensor([0.0, 0.1, 0.3, 0.7, 1.5, 3.0], dtype=torch.float64)
    every = torch.ones(1, data.n_sensors, dtype=torch.bool)
    family = Notch(depths[:, None, None], every, torch.cartesian_prod(centres, widths)[:, None], kind).within()
    best = best_of_families(data, pieces(data, company), family)
    assert isinstance(best, Notch)
    return replace(best, local=best.local.clamp(min=float(depths[1])))


def _starts(data: Ratios, company: Sequence[Term]) -> list[Notch]:
    """That of every form."""
    return [_start(data, company, kind) for kind in _FORMS]
