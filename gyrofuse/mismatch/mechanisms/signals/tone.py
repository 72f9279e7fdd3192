"""A stationary tone, with its harmonics: a rotor, a fan, a pump, a supply that switches."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.mechanisms.signals.harmonics import (
    Harmonics,
    folded,
    harmonics_of,
    surroundings,
    tapered,
)
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z, amplitude_limits


@dataclass(frozen=True, eq=False)
class Harmonic:
    """What a periodic motion has at another multiple of its fundamental frequency than its tone.

    Attributes:
        multiple: Which one.
        cosine, sine: `(sensor,)`, unit of the signal; `t` counts from the first sample.
    """

    multiple: int
    cosine: OfSensors
    sine: OfSensors


@dataclass(frozen=True, eq=False)
class VibrationTone(Mechanism):
    """`x_i(t) = cosine_i cos(2 pi f t) + sine_i sin(2 pi f t)` in every sensor `i`, and harmonics of that.

    Samples at one rate `f_s` do not tell `f` from `k f_s - f` and `k f_s + f`.

    Attributes:
        frequency_hz: `f`, one for all sensors.
        cosine, sine: `(sensor,)`, unit of the signal; `t` counts from the first sample.
        multiple: Of the fundamental frequency, that it is.
        harmonics: At others; none by default.
    """

    name: ClassVar[str] = "vibration_tone"
    rivals: ClassVar[tuple[str, ...]] = ("resonance",)
    replaced_by: ClassVar[tuple[str, ...]] = ("resonance", "drifting_tone")
    separated_by: ClassVar[str] = "a longer recording: the line gets as narrow as one over its length"
    additive: ClassVar[bool] = True
    frequency_hz: float
    cosine: OfSensors
    sine: OfSensors
    multiple: int = 1
    harmonics: tuple[Harmonic, ...] = ()

    @property
    def amplitude(self) -> Tensor:
        """`(sensor,)`, unit of the signal."""
        return torch.hypot(self.cosine, self.sine)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        line = comparison.line
        if line.p_value > level:
            return None
        tone = cls._with_family(comparison, *_line_alone(comparison))
        if tone is None:
            return None
        sd = tone._sd(comparison)
        spreads = tone._frequency_sds(comparison, sd) * comparison.info.rate
        squares = tone._squares(sd)
        snr = squares[0].sqrt()
        there = included_sensors(squares[0], 2)
        seen, most_told = math.sqrt(there.least), 6  # harmonics with limits
        present = tuple(tone._has(squares).nonzero()[:, 0].tolist())
        parameters = {
            name: Parameter.around(value, Z * spread, "Hz")
            for (name, value), spread in zip(tone._frequencies().items(), spreads.tolist(), strict=True)
        }
        low, value, high = sd[0, list(present)] * amplitude_limits(snr[list(present)], seen)
        for row in zip(present, value.tolist(), low.tolist(), high.tolist(), strict=True):
            parameters[f"amplitude[{row[0]}]"] = Parameter(*row[1:], comparison.info.measure)
        for k in sorted((squares[1:].amax(-1).argsort(descending=True)[:most_told] + 1).tolist()):
            harmonic, i = tone.harmonics[k - 1], int(squares[k].argmax())
            size, reach = float(torch.hypot(harmonic.cosine[i], harmonic.sine[i])), Z * float(sd[k, i])
            parameters[f"{tone._word(harmonic)}[{i}]"] = Parameter.around(size, reach, comparison.info.measure)
        largest = max(present, key=lambda i: parameters[f"amplitude[{i}]"].value)
        info = comparison.info
        where = info.named(present, "all sensors")
        return tone.found(
            f"a tone at {tone.frequency_hz:.6g} Hz in {where}, of amplitude up to "
            f"{parameters[f'amplitude[{largest}]'].value:.3g} {info.measure} (sensor {info.sensors[largest]}), "
            f"that the simulation does not have; {tone._besides(info)}",
            line.p_value,
            present,
            parameters,
            levels=(level_of(line.frequency),),
            frequency_hz=tone.frequency_hz,
            gain=float(squares.sum()) / 2,
        )

    def _besides(self, info: RecordingInfo) -> str:
        """Words of its harmonics, or of what else it may be."""
        f = self.frequency_hz
        if not self.harmonics:
            return f"without a filter before sampling it may be one at {info.rate - f:.6g}, {info.rate + f:.6g} .. Hz"
        multiples, fewest = [str(one.multiple) for one in self.harmonics], 8
        if len(multiples) > fewest:
            multiples[fewest - 2 : -1] = [".."]
        many = "a harmonic" if len(self.harmonics) == 1 else f"{len(self.harmonics)} harmonics"
        own = "" if self.multiple == 1 else f", of which it is {self.multiple} times"
        return (
            f"with {many} at {', '.join(multiples)} times {f / self.multiple:.6g} Hz{own}, as of something periodic; "
            "those above half the rate are seen folded"
        )

    @classmethod
    def _with_family(cls, comparison: Comparison, tone: VibrationTone, series: Harmonics) -> VibrationTone | None:
        """A line by itself with those that go along with it; None of what is nothing without them."""
        return tone.with_harmonics(comparison, series) if series.others else tone

    def _has(self, squares: Tensor) -> Tensor:
        """Which sensors have it, by squares of amplitudes `(line, sensor)`."""
        certain = 30.0  # of a harmonic
        return included_sensors(squares[0], 2).which | (squares[1:] > certain).any(0)

    @staticmethod
    def _word(one: Harmonic) -> str:
        """Name of the amplitude of another line."""
        return f"harmonic_{one.multiple}"

    def _frequencies(self) -> dict[str, float]:
        """Those that are free, by the names of their parameters, Hz."""
        return {"frequency": self.frequency_hz}

    def _at_frequencies(self, hz: list[float]) -> VibrationTone:
        """The same with others in their place."""
        return replace(self, frequency_hz=hz[0])

    def _turns(self) -> Tensor:
        """How many times as fast as each of them the lines turn, `(frequency, line)`, its own first."""
        return torch.tensor([[1.0, *(one.multiple / self.multiple for one in self.harmonics)]], dtype=torch.float64)

    def _frequency_sds(self, comparison: Comparison, sd: Tensor) -> Tensor:
        """Sds of its frequencies, by the noise and a phase that walks, cycles per sample `(frequency,)`.

        Args:
            comparison: Recording and simulation.
            sd: Of the amplitudes, `(line, sensor)`.
        """
        squares = self._squares(sd)
        present = included_sensors(squares[0], 2).which
        # Noise adds to the squares of amplitudes, but has no information on the frequency.
        squares = (squares - 2).clamp(min=0.0)
        own = max(float(squares[0, present].sum()), 1.0)
        energy, turns = torch.cat([torch.tensor([own], dtype=sd.dtype), squares[1:].sum(-1)]), self._turns()
        information = (turns * energy) @ turns.mT
        n, noise = comparison.n_samples, sd[0].square() * comparison.n_samples / 2
        by_noise = (12 * torch.linalg.inv(information).diagonal()).sqrt() / (2 * math.pi * n)
        wander = torch.zeros_like(by_noise)
        wander[0] = self.wander(comparison, noise, own)
        return torch.hypot(by_noise, wander)

    def _sd(self, comparison: Comparison) -> Tensor:
        """Standard deviation of each amplitude, `(1 + harmonic, sensor)`."""
        return (2 * self._densities(comparison) / comparison.n_samples).sqrt()

    def _squares(self, sd: Tensor) -> Tensor:
        """Squares of amplitudes over their variances, `(1 + harmonic, sensor)`."""
        return (torch.hypot(*self._parts()) / sd).square()

    def _densities(self, comparison: Comparison) -> Tensor:
        """Noise of the recording around each line, without that itself, per sample `(1 + harmonic, sensor)`."""
        reach = 64  # bins on either side
        places = torch.tensor(self._places(comparison.info), dtype=torch.float64)
        return squared_modulus(surroundings(comparison, places, reach)[0]).nanmean(-1).mT

    def _parts(self) -> tuple[Tensor, Tensor]:
        """Cosines and sines of its own line and of the others, `(line, sensor)`."""
        return (
            torch.stack([self.cosine, *(one.cosine for one in self.harmonics)]),
            torch.stack([self.sine, *(one.sine for one in self.harmonics)]),
        )

    def _lines_hz(self) -> Tensor:
        """Frequencies of these, `(line,)`, not folded."""
        return torch.tensor(list(self._frequencies().values()), dtype=torch.float64) @ self._turns()

    def _places(self, info: RecordingInfo) -> list[float]:
        """Where these are seen, cycles per sample."""
        return folded(self._lines_hz() / info.rate).tolist()

    def with_harmonics(self, comparison: Comparison, series: Harmonics) -> VibrationTone:
        """The same with lines at multiples of a fundamental frequency."""
        none = torch.zeros_like(self.cosine)
        more = replace(self, multiple=series.multiple, harmonics=tuple(Harmonic(k, none, none) for k in series.others))
        return more._fitted(comparison, torch.ones(comparison.n_samples, dtype=torch.bool))

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        """A tone at the highest ordinate of a peak."""
        width = finding.effect.line_width(finding.parameters, comparison)
        if width is None or finding.frequency_hz is None:
            return None
        rate = comparison.info.rate
        f = line_near(comparison, finding.frequency_hz / rate, 2 * width / rate)
        return Rival(cls.at(comparison, f * rate), finding.gain)

    def line_width(self, parameters: Mapping[str, Parameter], comparison: Comparison) -> float | None:
        limits = parameters["frequency"]
        return max((limits.high - limits.low) / 2, comparison.info.rate / comparison.n_samples)

    def wander(self, comparison: Comparison, noise: Tensor, energy: float) -> float:
        """Standard deviation that a phase which walks gives to the mean frequency, cycles per sample.

        The phases of `n` parts of the record have the covariance `q min(i, j)` of a walk beside that of the noise. What
        is left of them beside a straight line tells `q`: the variance is the mean over the values that it may have, in
        proportion to their likelihoods, with as much weight on none as on all others.

        Args:
            comparison: Recording and simulation.
            noise: Density of the noise near the tone, per sample `(sensor,)`.
            energy: Sum over sensors of the squared amplitudes in units of the variance that noise gives them.
        """
        fewest_parts, most_parts = 4, 32
        per_part = 20.0  # squared amplitude over its variance: a phase has a standard deviation of 0.2 rad in a part
        n_sizes, decades = 60, 4  # of walks, from a tenth of the noise's variance in the slowest mode on
        n = min(int(energy / per_part), most_parts)
        if n < fewest_parts:
            return 0.0
        length = comparison.n_samples // n
        angle = 2 * math.pi * self.frequency_hz * comparison.info.seconds(n * length)
        turned = comparison.recording[:, : n * length] * torch.polar(torch.ones_like(angle), -angle)
        weight = torch.complex(self.cosine, self.sine) / noise  # conjugates of the amplitudes
        phase = (weight @ turned.unflatten(-1, (n, length)).sum(-1)).angle()
        steps = torch.remainder(phase.diff() + math.pi, 2 * math.pi) - math.pi
        phase = torch.nn.functional.pad(steps.cumsum(0), (1, 0))
        place = torch.arange(n, dtype=torch.float64)
        walk = torch.minimum(place, place[:, None])
        slope = (place - place.mean()) / (place - place.mean()).square().sum()
        line = torch.stack([torch.ones_like(place) / math.sqrt(n), slope / slope.norm()])
        beside = torch.eye(n, dtype=torch.float64) - line.mT @ line
        values, vectors = torch.linalg.eigh(beside @ walk @ beside)
        values, left = values[2:], (vectors.mT @ phase)[2:]  # of a line itself there are two zeros
        own = n / energy  # variance of a phase by the noise
        sizes = own / values[-1] * torch.logspace(-1, decades, n_sizes, dtype=torch.float64)
        variance = torch.cat([torch.zeros(1, dtype=torch.float64), sizes])[:, None] * values + own
        log_likelihood = -(left.square() / variance + variance.log()).sum(-1) / 2
        log_likelihood[0] += math.log(n_sizes)
        expected = log_likelihood.softmax(0)[1:] @ sizes
        return math.sqrt(float(expected * (slope @ walk @ slope))) / (2 * math.pi * length)

    @classmethod
    def at(cls, comparison: Comparison, frequency_hz: float) -> VibrationTone:
        """The tone of all samples within half a bin of a frequency."""
        return cls.fitted_to(comparison, frequency_hz, torch.ones(comparison.n_samples, dtype=torch.bool))

    @classmethod
    def fitted_to(cls, comparison: Comparison, frequency_hz: float, keep: Tensor) -> VibrationTone:
        """Least squares with the noise near the tone as weights, starting within half a bin of the samples' span."""
        none = torch.zeros(comparison.n_sensors, dtype=torch.float64)
        return cls(frequency_hz, none, none)._fitted(comparison, keep)

    def _fitted(self, comparison: Comparison, keep: Tensor) -> VibrationTone:
        """Frequencies and amplitudes by least squares on samples to keep, from where the frequencies stand."""
        stretch, rate = 2**18, comparison.info.rate  # samples at a time
        turns, weights = self._turns(), 1 / self._densities(comparison)
        t = torch.arange(comparison.n_samples, dtype=torch.float64)[keep]
        signal = comparison.recording[:, keep]
        signal = signal - signal.mean(-1, keepdim=True)
        span, m, middle = float(t[-1] - t[0]) + 1, turns.shape[-1], t.mean()
        free = 2 * math.pi / rate * torch.tensor(list(self._frequencies().values()), dtype=torch.float64)
        for _ in range(6):
            gram = torch.zeros(4 * m, 4 * m, dtype=torch.float64)
            seen = torch.zeros(4 * m, len(signal), dtype=torch.float64)
            for part, times in zip(signal.split(stretch, -1), t.split(stretch), strict=True):
                angle = (free @ turns)[:, None] * times
                tones = torch.cat([angle.cos(), angle.sin()])
                basis = torch.cat([tones, (times - middle) / span * tones])
                gram, seen = gram + basis @ basis.mT, seen + basis @ part.mT
            # Next to half the rate sines vanish.
            gram = gram + 1e-12 * gram.trace() * torch.eye(4 * m, dtype=gram.dtype)
            at = torch.linalg.solve(gram[: 2 * m, : 2 * m], seen[: 2 * m])  # (cosines then sines, sensor)
            # Of the phases, on the clock, for each frequency: lines turn as many times as fast.
            slope = turns.repeat(1, 2)[..., None] * torch.cat([at[m:], -at[:m]])  # (frequency, line, sensor)
            with_it = torch.linalg.solve(gram[: 2 * m, : 2 * m], gram[: 2 * m, 2 * m :] @ slope)
            slope = torch.cat([-with_it, slope], 1)
            left = seen - gram[:, : 2 * m] @ at
            each = weights.repeat(4, 1) * slope
            downhill = (each * left).sum((-1, -2))
            curvature = torch.einsum("kls,mls->km", each, gram @ slope)
            free = free + torch.linalg.solve(curvature, downhill).clamp(-1.0, 1.0) / span
        cosines, sines = at[:m], at[m:]
        harmonics = tuple(
            replace(one, cosine=cosine, sine=sine)
            for one, cosine, sine in zip(self.harmonics, cosines[1:], sines[1:], strict=True)
        )
        found = replace(self, cosine=cosines[0], sine=sines[0], harmonics=harmonics)
        return found._at_frequencies((free * rate / (2 * math.pi)).tolist())

    def fit_without(self, comparison: Comparison, fold: int) -> VibrationTone:
        return self._fitted(comparison, estimation_samples(comparison.n_samples, fold))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.spectrum_near(ax, comparison, sensor, self.frequency_hz, comparison.info.rate / comparison.n_samples)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        turns = 2 * math.pi * torch.rand(len(self._frequencies()), generator=generator, dtype=torch.float64)
        return signal + self._path(signal.shape[-1], info, turns)

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        return signal - self._path(signal.shape[-1], info)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        return comparison.subtract(self._path(comparison.n_samples, comparison.info))

    def apply_elsewhere(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """A line that the simulation has: its phase counts from when a record began."""
        built = self.apply_to_reference(comparison, generator)
        return built.knowing((*comparison.reference.lines, *self._places(comparison.info)))

    def _path(self, n_samples: int, info: RecordingInfo, turned: Tensor | None = None) -> Tensor:
        """Its course, with the phases of its fundamental frequencies turned on."""
        path, seconds = torch.zeros(len(self.cosine), n_samples, dtype=torch.float64), info.seconds(n_samples)
        turns = self._turns()
        on = torch.zeros(turns.shape[-1], dtype=torch.float64) if turned is None else (turned * self.multiple) @ turns
        for f, start, cosine, sine in zip(self._lines_hz().tolist(), on.tolist(), *self._parts(), strict=True):
            angle = 2 * math.pi * f * seconds + start
            path = path + cosine[:, None] * angle.cos() + sine[:, None] * angle.sin()
        return path


def line_near(comparison: Comparison, f: float, reach: float) -> float:
    """The highest place of the recording's spectrum over the simulation's noise within a reach, cycles per sample."""
    transform, length = tapered(comparison.observed)
    first, last = max(math.floor((f - reach) * length), 1), min(math.ceil((f + reach) * length), length // 2 - 1)
    place = torch.arange(first, last + 1, dtype=torch.float64) / length
    return float(
        place[(squared_modulus(transform[:, first : last + 1]) / comparison.base.spectrum(place)).sum(0).argmax()]
    )


class _Alone(NamedTuple):
    """A line by itself, and the lines at multiples of its frequency or of a part of that."""

    tone: VibrationTone
    series: Harmonics


@derived
def _line_alone(comparison: Comparison) -> _Alone:
    """The strongest line of the recording."""
    tone = VibrationTone.at(comparison, comparison.line.frequency * comparison.info.rate)
    spread = float(tone._frequency_sds(comparison, tone._sd(comparison))[0])
    return _Alone(tone, harmonics_of(comparison, tone.frequency_hz / comparison.info.rate, spread))
