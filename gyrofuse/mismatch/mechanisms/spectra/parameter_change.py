"""Noise of the kinds that a base has, with other numbers: of one that the simulation shows none of as well."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.power_differs import power_differs
from gyrofuse.mismatch.likelihoods.spectra.components import Shift, Term
from gyrofuse.mismatch.likelihoods.spectra.data import analog_noise, block_spectra
from gyrofuse.mismatch.likelihoods.spectra.fit import pieces, powers
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Parts
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import best_start
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.spectra.findings import found, spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import Shape, chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.rivals import fit_alone, happened_instead, walks_of
from gyrofuse.mismatch.mechanisms.spectra.spectral import Filter
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.stats.limits import Z

_PARTS = ("white", "ar1", "corner", "random_walk")
_WORDS = ("white noise", "AR1 noise", "AR1 corner frequency", "random walk")


@dataclass(frozen=True, eq=False)
class ParameterShift(Filter):
    """`S_i = a_i W_i(f) + b_i A_i(f / c_i) + d_i R_i(f)`: the simulation's noise with other numbers.

    Every band of a sensor's spectrum changes smoothly between levels that its own noise has. A filter turns spectra
    down near the highest frequency alone, more than any level of white noise can follow; what is added keeps apart by
    its own shape. Where records are short, a changed level and a weak filter are alike. The factor of a part that the
    simulation shows none of is over what it would not show, and the sentence says "none".

    Attributes:
        base: Noise that the numbers apply to.
        log_factors: Logarithms of `a`, `b`, `c`, `d`, `(4, sensor)`; levels are powers.
    """

    name: ClassVar[str] = "parameter_shift"
    rivals: ClassVar[tuple[str, ...]] = ("low_pass", "flicker", "common_mode")
    separated_by: ClassVar[str] = "a longer recording, or one of the same device under other conditions"
    made_of: ClassVar[str] = "scale"
    base: NoiseSpectrum
    log_factors: Annotated[Tensor, Dims(("part", "sensor"))]

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        if any(isinstance(term, Shift) for term in company) or not bool(data.ground.matters.any()):
            return
        beside = pieces(data, company)
        starts = [best_start(data, beside, family)[0] for family in Shift.starts(data.ground)]
        yield from starts
        # Two parts together, each from where it starts alone: from all at once one may stay where the other should be.
        for one, other in itertools.combinations(starts, 2):
            if not bool((one.free & other.free).any()):
                yield replace(one, local=one.local + other.local, free=one.free | other.free)

    @classmethod
    def levels(cls, data: Ratios, passed: Tensor) -> Iterable[Term]:
        log_ratio = powers(data.observed)[passed].clamp(min=1e-300).log().mean(0)
        return Shift.levels(data.ground, log_ratio, passed)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level) if power_differs(comparison, level) else None
        if shape is None:
            return None
        parameters, words, lacking = {}, [], set()
        base = analog_noise(comparison)
        before, least = _numbers(base, comparison.info.rate, comparison.info.measure)
        for i in range(comparison.n_sensors):
            for k, name in enumerate(_PARTS):
                sd = float(shape.sd[0][k, i])
                if math.isnan(sd):
                    continue
                value = float(shape.term.local[k, i])
                low, high = value - Z * sd, value + Z * sd
                number, unit = before[k][i]
                if number:  # else the simulation does not show how much it has
                    parameters[f"{name}_factor[{i}]"] = spanned(math.exp, value, sd, "")  # of variances
                elif name == "corner":
                    parameters[f"{name}[{i}]"] = spanned(math.exp, value + math.log(least[k][i]), sd, unit)
                if low > 0 or high < 0:
                    factor = math.exp(value if name == "corner" else value / 2)  # in standard deviations
                    if name == "ar1":  # of one plateau, a faster one has more variance
                        factor *= math.exp(float(shape.term.local[2, i]) / 2)
                    before_it = f"{number:.3g}" if number else "none"
                    if not number and name != "corner":
                        lacking.add(_WORDS[k])
                    after = f"{(number or least[k][i]) * factor:.3g} {unit}"
                    words.append(f"{_WORDS[k]} of sensor {comparison.info.sensors[i]} {before_it} -> {after}")
        sensors = tuple(int(i) for i in shape.term.free.any(0).nonzero()[:, 0])
        return found(
            cls(base, shape.term.local),
            shape,
            sensors,
            parameters,
            f"{_said_of(lacking, shape)}: {'; '.join(words) or 'levels differ slightly'}",
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        found = fit_alone(comparison, finding.sensors, _start)
        return None if found is None else Rival(cls(comparison.base, found[0].local), found[1])

    def explained_by_others(
        self, comparison: Comparison, finding: Finding, beside: Sequence[Finding]
    ) -> tuple[str, ...]:
        slow = bool((self.log_factors[1:] != 0).any())  # of the simulation's parts all but the white one
        return happened_instead(comparison, finding, beside, walks_of(comparison, finding) if slow else None)

    @property
    def only_numbers(self) -> bool:
        lacks = Parts(self.base, torch.tensor([1 / self.base.n_samples], dtype=torch.float64)).lacks
        return not bool((lacks & (self.log_factors[[0, 1, 3]] != 0)).any())

    def beneath(self, later: Sequence[Mechanism], before: Comparison) -> Mechanism:
        return self.beneath_noise(later, before)

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> ParameterShift | None:
        return cls(analog_noise(comparison), term.local) if isinstance(term, Shift) else None

    def response(self, f: Tensor) -> Tensor:
        parts = Parts(self.base, f.clamp(min=0.5 / self.base.n_samples))
        return (parts.shifted(self.log_factors) / parts.densities.sum(0)).sqrt()

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        parts = Parts(self.base, block_spectra(comparison).bands.nodes)
        term = Shift(self.log_factors, self.log_factors != 0, torch.zeros(0, dtype=torch.float64), of=parts)
        return replace(self, log_factors=refit(comparison, fold, term, self.company).local)


def _start(data: Ratios) -> Term | None:
    """Other numbers of the simulation's parts, from the likeliest grid point; None where it has no part that shows."""
    return (
        best_start(data, pieces(data, []), Shift.starts(data.ground)[0])[0] if bool(data.ground.matters.any()) else None
    )


def _said_of(lacking: Set[str], shape: Shape) -> str:
    """Whether all kinds of noise that the recording has show in the simulation, and are what they seem to be."""
    white, ar1 = shape.term.local[:2]
    if any(term.acts == "filter" for term in shape.company) and bool(((white > 0) & (ar1 < -1)).any()):
        return "AR1 noise of the simulation stands for a filter of white noise"
    if not lacking:
        return "the simulation's numbers are off"
    return f"the simulation shows no {' and no '.join(sorted(lacking))} where the recording does"


def _numbers(base: NoiseSpectrum, rate: float, unit: str) -> tuple[list[list[tuple[float, str]]], list[list[float]]]:
    """Numbers of the parts before, each sensor's with its unit: sds of a sample, corner in Hz, sd of an increment.

    Parts that are not seen have zeros; the numbers that stand for them come last, of every part.
    """
    f = torch.tensor([1 / base.n_samples], dtype=torch.float64)
    parts = Parts(base, f)
    white = (parts.densities[0][:, 0] + parts.unseen_white).sqrt()
    variance, corner = parts.moments()
    slower, plateau = parts.unseen_ar1[0], parts.unseen_ar1[1][:, 0]
    lacks_white, lacks_ar1, lacks_walk = parts.lacks
    phi = math.exp(-slower)
    least_rms = (plateau * (1 - phi) / (1 + phi)).sqrt()
    least_corner = torch.full_like(plateau, rate * slower / (2 * math.pi))
    walk = parts.growing_walk.sqrt()
    columns = (
        (torch.where(lacks_white, 0.0, white), f"{unit} per sample"),
        (torch.where(lacks_ar1, 0.0, variance.sqrt()), f"{unit} rms"),
        (torch.where(lacks_ar1, 0.0, corner * rate), "Hz"),
        (torch.where(lacks_walk, 0.0, walk), f"{unit} per step"),
    )
    numbers = [[(float(x), words) for x in column] for column, words in columns]
    return numbers, [x.tolist() for x in (white, least_rms, least_corner, walk)]
