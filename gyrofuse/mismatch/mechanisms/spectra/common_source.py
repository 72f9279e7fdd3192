"""Noise of one source in several sensors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.common_sources import Common, common_density
from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.data import reference_noise
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.likelihoods.spectra.starts import common_starts
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.spectra.findings import found, spanned
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape, refit
from gyrofuse.mismatch.mechanisms.spectra.rivals import fit_alone, happened_instead
from gyrofuse.mismatch.mechanisms.spectra.spectral import Addition
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import ComplexOfSensors
from gyrofuse.mismatch.signals.filters import filtered, noise, of_phase
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.stats.limits import Z

_WORDS = {"white": "white noise", "ar1": "AR1 noise", "walk": "a random walk"}
_REST = 0.01  # of a sensor's power that is its own, at least
_SEEN, _LEAST = 2.5, 1.5  # standard deviations of a sensor's gain, and of the second largest


@dataclass(frozen=True, eq=False)
class CommonMode(Addition):
    """`S_ij -> S_ij + g_i g_j* C(f)`: one source in every sensor, with gains, signs and phases of their own.

    Sensors are coherent where it shows; what each has of its own never is. Covariances at no lag miss a source whose
    phases are a quarter of a cycle apart, cross-spectra do not.

    Attributes:
        kind: White, AR1 or walk.
        corner: Of an AR1, cycles per sample; 0 for others.
        gain: `g`, complex, `(sensor,)`: a sample's rms; for walks that of an increment.
        own: Noise of the simulation.
        inside: Whether it is a part of that noise, so that each sensor's power stays, instead of coming on top.
    """

    name: ClassVar[str] = "common_mode"
    rivals: ClassVar[tuple[str, ...]] = ("parameter_shift", "low_pass", "flicker", "g_sensitivity", "cross_talk")
    replaced_by: ClassVar[tuple[str, ...]] = ("cross_talk",)
    separated_by: ClassVar[str] = "one sensor mounted apart, or on another supply"
    kind: str
    corner: float
    gain: ComplexOfSensors
    own: NoiseSpectrum
    inside: bool

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        return common_starts(data, company) if data.n_sensors > 1 else ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        shape = chosen_shape(comparison, cls.name, level)
        if shape is None or not isinstance(shape.term, Common):
            return None
        term, unit = shape.term, comparison.info.measure
        gain = torch.complex(*term.local)
        reference = gain[gain.abs().argmax()]
        gain = gain * reference.conj() / reference.abs()
        sd = shape.sd[0].square().nanmean(0).sqrt()
        size, t_values = gain.abs(), term.t_values(shape.sd_alone)
        second = float(t_values.topk(2).values[-1])
        if second < _LEAST:  # one sensor has nothing in common
            return None
        least = min(_SEEN, second)
        sensors = tuple(i for i in range(len(gain)) if float(t_values[i]) >= least)
        parameters = {}
        for i in sensors:
            s, d = float(size[i]), float(sd[i])
            parameters[f"gain[{i}]"] = Parameter.around(s, Z * d, unit, least=0.0)
            if term.turned:
                turn, reach = math.degrees(float(gain[i].angle())), math.degrees(Z * d / s)
                parameters[f"phase[{i}]"] = Parameter.around(turn, reach, "deg")
        corner = 0.0
        if term.kind == "ar1":
            middle, spread = float(term.shared[0]), float(shape.sd[1][0])
            corner = math.exp(middle)
            rate = comparison.info.rate
            parameters["corner"] = spanned(lambda x: math.exp(x) * rate, middle, spread, "Hz")
        against = [i for i in sensors if float(gain[i].real) < 0]
        where = comparison.info.named(sensors, "all sensors")
        sign = f", with the sign reversed in {comparison.info.named(against)}" if against else ""
        share = ", as a part of the noise that each has" if term.inside else ""
        return found(
            cls(term.kind, corner, gain, reference_noise(comparison), term.inside),
            shape,
            sensors,
            parameters,
            f"{_WORDS[term.kind]} common to {where} that the simulation does not have, with a gain of "
            f"up to {float(size.max()):.3g} {unit}{sign}{share}",
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        found = fit_alone(comparison, finding.sensors, _white_source)
        if found is None or not isinstance(term := found[0], Common):
            return None
        return Rival(cls(term.kind, 0.0, torch.complex(*term.local), comparison.base, term.inside), found[1])

    @classmethod
    def from_term(cls, term: Term, comparison: Comparison) -> CommonMode | None:
        if not isinstance(term, Common) or term.name != cls.name:  # a bump that sensors share
            return None
        corner = float(term.shared[0].exp()) if term.kind == "ar1" else 0.0
        return cls(term.kind, corner, torch.complex(*term.local), reference_noise(comparison), term.inside)

    def explained_by_others(
        self, comparison: Comparison, finding: Finding, beside: Sequence[Finding]
    ) -> tuple[str, ...]:
        walks = None if self.kind == "white" else self.gain.real[None]
        return happened_instead(comparison, finding, beside, walks)

    def density(self, f: Tensor) -> Tensor:
        return self._source(f)[:, None, None] * (self.gain[:, None] * self.gain.conj())

    def left(self, f: Tensor) -> Tensor:
        """Factors `(sensor, frequency)` on what each sensor has of its own."""
        if not self.inside:
            return torch.ones(len(self.gain), len(f), dtype=torch.float64)
        f = f.clamp(min=1 / self.own.n_samples)
        part = self.gain.abs().square()[:, None] * self._source(f) / self.own.spectrum(f)
        return (1 - part).clamp(min=_REST).sqrt()

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.coherence(ax, comparison, sensor, self.gain)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        own = filtered(signal, self.left) if self.inside else signal
        return super().apply(own, info, generator)

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        left = self.left(f).mT.to(matrices.dtype)
        return super().spectra(matrices * left[:, :, None] * left[:, None, :], f)

    def path(self, n_samples: int, generator: torch.Generator) -> Tensor:
        if self.kind == "walk":
            source = torch.randn(1, n_samples, generator=generator, dtype=torch.float64)
        else:
            source = noise(n_samples, self._source, 1, generator)
        sensors = of_phase(self.gain, source)
        return sensors.cumsum(-1) if self.kind == "walk" else sensors

    def _source(self, f: Tensor) -> Tensor:
        return common_density(self.kind, f, torch.tensor([self.corner], dtype=torch.float64))

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        shared = torch.tensor([math.log(self.corner)] if self.kind == "ar1" else [], dtype=torch.float64)
        local = torch.stack([self.gain.real, self.gain.imag])
        free = (self.gain != 0).expand_as(local).clone()
        free[1] &= bool(self.gain.imag.any())
        whole = None
        if self.inside:
            f = comparison.bands.frequency
            whole = (self.own.spectrum(f) / self._source(f)).amin(-1).sqrt()
        term = refit(comparison, fold, Common(local, free, shared, self.kind, self.inside, whole), self.company)
        corner = math.exp(float(term.shared[0])) if self.kind == "ar1" else 0.0
        return replace(self, gain=torch.complex(*term.local), corner=corner)


def _white_source(data: Ratios) -> Term | None:
    """White noise of one source where its fit starts; None of a single sensor."""
    if data.n_sensors < 2:
        return None
    nothing = torch.zeros(0, dtype=torch.float64)
    return Common.starts(data.ground, data.observed - data.expected, data.information, "white", nothing)[0]
