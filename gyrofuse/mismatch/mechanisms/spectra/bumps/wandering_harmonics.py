"""A tone whose frequency wanders, with its harmonics: a rotor, an engine, the mains."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation, oscillation_of
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.signals.harmonics import folded
from gyrofuse.mismatch.mechanisms.spectra.bumps.oscillation import Mode, refitted_mode, wandering_sd
from gyrofuse.mismatch.mechanisms.spectra.bumps.phase_track import Family, PhaseTrack, lines_in_step
from gyrofuse.mismatch.mechanisms.spectra.bumps.wandering_tone import DriftingTone
from gyrofuse.mismatch.mechanisms.spectra.findings import spanned
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class WanderingHarmonics(DriftingTone):
    """`x_i(t) = sum_k a_ik cos(k phi(t) + theta_ik)`, `phi' = 2 pi (f_0 + u(t)) / m`: lines in step.

    Attributes:
        multiple: `m`, that of the line which is described as the mode.
        multiples: Those of the others.
        others: These, where they are seen.
    """

    rivals: ClassVar[tuple[str, ...]] = ()
    named_together: ClassVar[tuple[str, ...]] = ()
    shown: ClassVar[float] = 15.0
    multiple: int = 1
    multiples: tuple[int, ...] = ()
    others: tuple[Mode, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        peak = oscillation_of(comparison)
        narrow = 0.05  # half width over centre
        if peak is None or peak.stretch.p_value > level or peak.width > narrow * peak.centre:
            return None
        track = PhaseTrack.of(comparison, peak)
        if track is None or not track.wanders:
            return None
        family = lines_in_step(comparison, peak, track)
        if family is None or family.p_value > level:
            return None
        return cls._found(comparison, peak, family, track.spread(peak.width) * comparison.info.rate)

    @classmethod
    def _found(cls, comparison: Comparison, peak: Oscillation, family: Family, spread_hz: float) -> Finding:
        own, info = family.lines[0], comparison.info
        plain, most_told = 30.0, 6  # square of an amplitude; harmonics with limits
        modes = [
            Mode(
                float(folded(torch.tensor(line.multiple / family.multiple * peak.centre, dtype=torch.float64))),
                line.multiple / family.multiple * peak.width,
                torch.where(line.square > plain, line.amplitude, 0.0) / math.sqrt(2),
                True,
            )
            for line in family.lines
        ]
        effect = cls(
            modes[0],
            True,  # its phase is seen to be followed
            multiple=family.multiple,
            multiples=tuple(line.multiple for line in family.lines[1:]),
            others=tuple(modes[1:]),
        )
        sensors = tuple(torch.stack([mode.gain != 0 for mode in modes]).any(0).nonzero()[:, 0].tolist())
        centre_sd = math.hypot(peak.log_sd[0], wandering_sd(comparison, peak) / peak.centre)
        rate = info.rate
        parameters = {
            "frequency": spanned(lambda x: rate * math.exp(x), math.log(peak.centre), centre_sd, "Hz"),
            "width": spanned(lambda x: 2 * rate * math.exp(x), math.log(peak.width), peak.log_sd[1], "Hz"),
        }
        told = sorted(family.lines[1:], key=lambda line: -float(line.square.max()))[:most_told]
        for line in (own, *sorted(told, key=lambda line: line.multiple)):
            name = "amplitude" if line is own else f"harmonic_{line.multiple}"
            size = line.amplitude.abs()
            reach = Z * size / line.square.clamp(min=1e-12).sqrt()
            for i in sensors if line is own else [int(line.square.argmax())]:
                value, span = float(size[i]), float(reach[i])
                parameters[f"{name}[{i}]"] = Parameter.around(value, span, info.measure, least=0.0)
        fundamental = peak.centre * rate / family.multiple
        times = ", ".join(str(line.multiple) for line in family.lines[1:])
        itself = "" if family.multiple == 1 else f", of which it is {family.multiple} times"
        return effect.found(
            f"a tone near {peak.centre * rate:.4g} Hz whose frequency wanders by about {spread_hz:.2g} Hz, in "
            f"{info.named(sensors, 'all sensors')}, of amplitude up to {float(own.amplitude.abs().max()):.3g} "
            f"{info.measure}, that the simulation does not have; {_many(len(times.split(', ')))} in step with it, at "
            f"{times} times {fundamental:.4g} Hz{itself}, as of something that turns",
            max(peak.stretch.p_value, family.p_value),
            sensors,
            parameters,
            levels=(level_of(peak.centre),),
            frequency_hz=peak.centre * rate,
            gain=sum(float(line.square.sum()) for line in family.lines) / 2,
        )

    @property
    def modes(self) -> tuple[Mode, ...]:
        return (self.mode, *self.others)

    @property
    def turns(self) -> tuple[float, ...]:
        return (1.0, *(k / self.multiple for k in self.multiples))

    def course(self, n_samples: int, generator: torch.Generator) -> Tensor:
        """Of a Lorentzian's law, up to twenty half widths: what is slow has the spectrum of its law."""
        farthest, width = math.atan(20.0), self.mode.width
        share = torch.special.erf(super().course(n_samples, generator) / (math.sqrt(2) * width))  # -1 to 1
        return width * torch.tan(farthest * share)

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        mode, *others = (refitted_mode(comparison, fold, one) for one in self.modes)
        return replace(self, mode=mode, others=tuple(others))


def _many(count: int) -> str:
    return "one line is" if count == 1 else f"{count} lines are"
