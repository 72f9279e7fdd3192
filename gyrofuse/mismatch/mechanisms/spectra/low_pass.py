"""A sensor's own low-pass filter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.components import LowPass, SimulatedLowPass, Term
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import (
    FILTERS,
    UNDONE,
    filter_corner,
    filter_number,
    filter_response,
    strength_of,
)
from gyrofuse.mismatch.likelihoods.spectra.fit import pieces
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import closest_starts
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.spectra.findings import found, half_power_words
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.rivals import fit_alone
from gyrofuse.mismatch.mechanisms.spectra.spectral import Filter
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class LowPassFilter(Filter):
    """`S_i -> |H_i(f)|^2 S_i`: poles, Butterworth and Bessel filters, means over samples, FIR filters.

    It multiplies all there is, walks and tones too; the deficit sits in the first levels and grows towards the highest
    frequency. Lower white noise alone would lower all frequencies above the corner alike.

    Attributes:
        kind: Form of the filter.
        strength: Of each sensor's, `(sensor,)`; 0 is none.
        undone: Whether it is the simulation's, and taken off that.
    """

    name: ClassVar[str] = "low_pass"
    rivals: ClassVar[tuple[str, ...]] = ("parameter_shift", "flicker", "common_mode")
    separated_by: ClassVar[str] = "a higher sampling rate, or the response to a known motion"
    made_of: ClassVar[str] = "filter"
    kind: str
    strength: OfSensors
    undone: bool = False

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        there = {type(term) for term in company}
        if LowPass not in there:
            likeliest = 3  # forms
            yield from filter_starts(data, company)[:likeliest]
        if SimulatedLowPass not in there and bool(falls(data).any()):
            yield from filter_starts(data, company, SimulatedLowPass)[:1]

    @classmethod
    def forms(cls, data: Ratios, term: Term, company: Sequence[Term]) -> Iterable[Term]:
        if not isinstance(term, LowPass):
            return ()
        return [form for form in filter_starts(data, company, type(term)) if form.kind != term.kind]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level)
        if shape is None or not isinstance(shape.term, LowPass):
            return None
        term, rate = shape.term, comparison.info.rate
        sensors = tuple(int(i) for i in term.free[0].nonzero()[:, 0])
        # Which form it has is not known either; digital ones need not halve the power at all.
        forms = [
            _limits(form, sd[0][0]) * rate for form, sd in ((term, shape.sd), *shape.forms) if isinstance(form, LowPass)
        ]
        forms = [limits for limits in forms if bool(limits[1, list(sensors)].isfinite().all())] or forms
        corner, lowest, highest = forms[0][1], torch.stack(forms)[:, 0].amin(0), torch.stack(forms)[:, 2].amax(0)
        parameters = {}
        for i in sensors:
            if float(corner[i]) <= rate / 2:  # what lies above is guessed by the form alone
                parameters[f"corner[{i}]"] = Parameter(float(corner[i]), float(lowest[i]), float(highest[i]), "Hz")
        where = comparison.info.named(sensors, "all sensors")
        inside = [float(corner[i]) for i in sensors if float(corner[i]) <= rate / 2]
        corners = "more than half of the power still passes at half the rate"
        if inside:
            corners = half_power_words(inside)
        effect = cls.of(term)
        words = f"a low-pass filter in {where} that the simulation does not have, {corners}"
        if effect.undone:
            words = f"the simulation has a low-pass filter in {where} that the recording does not have, {corners}"
        return found(
            effect,
            shape,
            sensors,
            parameters,
            words,
            frequency_hz=min(inside) if inside else None,
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        found = fit_alone(comparison, finding.sensors, lambda data: filter_starts(data, [])[0])
        if found is None or not isinstance(term := found[0], LowPass):
            return None
        return Rival(cls(term.kind, strengths(term)), found[1])

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> LowPassFilter | None:
        return cls.of(term) if isinstance(term, LowPass) else None

    @classmethod
    def of(cls, term: LowPass) -> LowPassFilter:
        """What a term stands for."""
        return cls(term.kind, strengths(term), isinstance(term, SimulatedLowPass))

    def response(self, f: Tensor) -> Tensor:
        response = filter_response(self.kind, self.strength, f)
        least = 1e-12  # of its power: what is less is lost in rounding
        return response.conj() / response.abs().square().clamp(min=least) if self.undone else response

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        has = self.strength > 0
        own = torch.where(has, filter_number(self.kind, self.strength), 0.0)[None]
        form = SimulatedLowPass if self.undone else LowPass
        term = form(own, has[None], torch.zeros(0, dtype=torch.float64), self.kind)
        found = refit(comparison, fold, term, self.company)
        assert isinstance(found, LowPass)
        return replace(self, strength=strengths(found))


def filter_starts(data: Ratios, company: Sequence[Term], form: type[LowPass] = LowPass) -> list[LowPass]:
    """Every form of a filter at its likeliest corners, the likeliest first."""
    families = [form.starts(data.ground, kind) for kind in (UNDONE if form is SimulatedLowPass else FILTERS)]
    found = closest_starts(data, pieces(data, company), families)
    return [start for start in found if isinstance(start, LowPass)]


def falls(data: Ratios) -> Tensor:
    """Whether the simulation's noise falls towards half the rate, more than an AR1 does, `(sensor,)`."""
    least = 0.4  # power at 0.48 over that at 0.24 of the rate: of an AR1 0.47
    middle, high = (data.power[int((data.ground.bands.frequency - f).abs().argmin())] for f in (0.24, 0.48))
    return high < least * middle


def strengths(term: LowPass) -> Tensor:
    """Of each sensor's filter, 0 for none, `(sensor,)`."""
    return torch.where(term.free[0], strength_of(term.kind, term.local[0]), 0.0)


def _limits(term: LowPass, sd: Tensor) -> Tensor:
    """Lowest, best and highest corners, cycles per sample, `(3, sensor)`."""
    steps = torch.tensor([-Z, 0.0, Z], dtype=torch.float64)[:, None]
    return filter_corner(term.kind, strength_of(term.kind, term.local[0] + steps * sd.nan_to_num(nan=0.0)))
