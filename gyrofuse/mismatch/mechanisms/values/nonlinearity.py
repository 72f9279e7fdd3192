"""A scale that is bent: a response to rates that is no straight line."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.detectors.lines.interleaving import alternation
from gyrofuse.mismatch.detectors.values.bends import bends
from gyrofuse.mismatch.detectors.values.lattices import distinct_values
from gyrofuse.mismatch.detectors.values.values import end_stops
from gyrofuse.mismatch.detectors.variance.level_spread import level_lasts
from gyrofuse.mismatch.detectors.variance.normality import gaussian_sensors
from gyrofuse.mismatch.likelihoods.laws.bend import Array, BentNoise, Curve
from gyrofuse.mismatch.likelihoods.laws.heavy_tails import heavy_tailed
from gyrofuse.mismatch.likelihoods.laws.two_levels import TwoLevels
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims, OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class Nonlinearity(Mechanism):
    """`y = g(x)` with a rising `g`, whose inverse has slopes that are linear between knots.

    All that is felt goes through it, noise as well: the recording taken back is the simulation's noise. Heavy tails of
    the noise itself, and episodes, are not undone by a curve.

    Attributes:
        centre: Mean of the recording, `(sensor,)`, unit of the signal.
        shift: Mean of what it is taken back to, from there, `(sensor,)`, likewise.
        knots: Values from the centre at which slopes are given, `(sensor, knot)`, likewise.
        slopes: Of what was felt over what was put out there, `(sensor, knot)`; 1 in sensors without a bend.
    """

    name: ClassVar[str] = "nonlinearity"
    likelihood: ClassVar[str] = "innovations"
    rivals: ClassVar[tuple[str, ...]] = ("scale_mixture",)
    separated_by: ClassVar[str] = "rates that are known, over the range of the sensor"
    stage: ClassVar[int] = 1
    centre: OfSensors
    shift: OfSensors
    knots: Annotated[Tensor, Dims(("sensor", "knot"))]
    slopes: Annotated[Tensor, Dims(("sensor", "knot"))]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        scores, p_values, info = *bends(comparison), comparison.info
        if float(p_values.min()) > level:
            return None
        first, others = 10.0, 2 * NATS_PER_NUMBER  # nats over its rivals, of a sensor by itself and beside one
        plain = 6.0  # standard deviations
        at_ends = {end.sensor for end in end_stops(comparison) if end.p_value <= level}
        # Two laws in turns are no normal one, though nothing is bent.
        alternates = alternation(comparison).square > plain**2
        bent = dict[int, _Bend]()
        for i in included_sensors(scores.square().sum(-1), 2).positions:
            if i not in at_ends and _has_a_density(comparison, i) and not alternates[i]:
                bend = _Bend.of(comparison.recording[i], comparison.base, i)
                if bend.explains(comparison, first if float(p_values[i]) <= level else others):
                    bent[i] = bend
        if not any(float(p_values[i]) <= level for i in bent):
            return None
        effect = cls._of(comparison, bent)
        if not effect._leaves_spectra_alike(comparison):
            return None
        parameters, unit = {}, "per unit" if info.unit == "unknown" else f"/({info.unit})"
        for i, bend in bent.items():
            for name, (value, sd), power in zip(("quadratic", "cubic"), bend.numbers(), ("", "^2"), strict=True):
                parameters[f"{name}[{i}]"] = Parameter.around(value, Z * sd, f"{unit}{power}")
        sensors, most = tuple(bent), max(bent, key=lambda i: bent[i].off)
        return effect.found(
            f"the scale is bent in {info.named(sensors, 'all sensors')}: what is within two standard deviations of the "
            f"mean is up to {bent[most].off:.3g} {info.measure} off a straight line (sensor {info.sensors[most]})",
            float(p_values[list(sensors)].min()),
            sensors,
            parameters,
            levels=(1,),
            gain=sum(bend.gain for bend in bent.values()),
        )

    @classmethod
    def _of(cls, comparison: Comparison, bent: dict[int, _Bend]) -> Nonlinearity:
        n_knots = max(len(bend.curve.knots) for bend in bent.values())
        centre = comparison.recording.mean(-1)
        knots = centre.new_zeros(len(centre), n_knots) + torch.linspace(-1, 1, n_knots, dtype=centre.dtype)
        shift, slopes = torch.zeros_like(centre), torch.ones_like(knots)
        for i, bend in bent.items():
            curve = bend.scaled()
            more = np.arange(1, n_knots - len(curve.knots) + 1)  # beyond the last one nothing changes
            apart = curve.knots[-1] - curve.knots[-2]
            knots[i] = torch.from_numpy(np.concatenate([curve.knots, curve.knots[-1] + apart * more]))
            slopes[i] = torch.from_numpy(np.concatenate([curve.slopes, curve.slopes[-1:].repeat(len(more))]))
            shift[i] = float(curve.at(bend.noise.y).mean())
        return cls(centre, shift, knots, slopes)

    def fit_without(self, comparison: Comparison, fold: int) -> Nonlinearity:
        keep = estimation_samples(comparison.n_samples, fold).numpy()
        bent = {
            i: _Bend.with_knots(comparison.recording[i], comparison.base, i, self.knots[i].numpy(), keep)
            for i in self._bent
        }
        return self._of(comparison, bent)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        own = comparison.recording[sensor]
        pictures.values(ax, comparison, sensor, float(own.mean()), 5 * float(own.std()))

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        made = signal.clone()
        for i in self._bent:
            row = signal[..., i, :]
            mean = row.mean(-1, keepdim=True)
            put_out = self._curve(i).inverse((row - mean + self.shift[i]).numpy())
            made[..., i, :] = mean + torch.from_numpy(put_out)
        return made

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        straight = signal.clone()
        for i in self._bent:
            felt = self._curve(i).at((signal[..., i, :] - self.centre[i]).numpy())
            straight[..., i, :] = self.centre[i] + torch.from_numpy(felt) - self.shift[i]
        return straight

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The recording on a straight scale: there, all other laws hold as they are."""
        straight = comparison.with_recording(self.remove(comparison.recording, comparison.info))
        return replace(straight, straightened=(*comparison.straightened, *self._bent))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        keep = estimation_samples(comparison.n_samples, fold).numpy()
        scores = torch.zeros_like(comparison.recording)
        for i in self._bent:
            curve = self._curve(i)
            noise = BentNoise.of(comparison.recording[i] - self.centre[i], comparison.base, i, curve.knots)
            scores[i] = torch.from_numpy(noise.gains(curve, keep))
        return held_out_blocks(scores, fold).sum((0, -1))

    @property
    def _bent(self) -> list[int]:
        return (self.slopes != 1).any(-1).nonzero()[:, 0].tolist()

    def _curve(self, sensor: int) -> Curve:
        knots, slopes = self.knots[sensor], self.slopes[sensor]
        if not (bool((knots.diff() > 0).all()) and bool((slopes > 0).all())):
            raise ValueError(
                f"`knots`, `slopes`: expected rising knots and positive slopes, got {knots.tolist()}, {slopes.tolist()}"
            )
        return Curve(knots.numpy(), slopes.numpy())

    def _leaves_spectra_alike(self, comparison: Comparison) -> bool:
        """Whether nothing stands out of the spectrum of what is taken back: tones and modes are not normal either."""
        most, sd = math.log(2), 4.0
        made = comparison.with_recording(self.remove(comparison.recording, comparison.info))
        sides = made.observed, made.reference
        ratio = (sides[0].log_power - sides[1].log_power)[self._bent]
        chance = torch.stack([1 / side.power_dof[self._bent].clamp(min=1e-3) for side in sides]).sum(0)
        off = (ratio - ratio.median(-1, keepdim=True).values).abs()
        return bool((off - sd * chance.sqrt() < most).all())


class _Bend(NamedTuple):
    """The curve of one sensor.

    Attributes:
        sensor: Position.
        noise: What its likelihood needs.
        curve: Of any scale.
        gain: Log likelihood ratio to a straight line, nats.
    """

    sensor: int
    noise: BentNoise
    curve: Curve
    gain: float

    @classmethod
    def of(cls, signal: Tensor, base: NoiseSpectrum | None, sensor: int) -> _Bend:
        """Of as many knots as pay for their numbers, at values that are met as often as normal ones some sd off."""
        values, found = (signal - signal.mean()).sort().values, list[_Bend]()
        for scores in ((2.0,), (1.5, 3.0), (1.0, 2.0, 3.0)):
            at = torch.tensor([-s for s in reversed(scores)] + [0.0, *scores], dtype=torch.float64)
            knots = values[(torch.special.ndtr(at) * len(values)).long()].unique().numpy()
            if len(knots) == len(at):
                found.append(cls.with_knots(signal, base, sensor, knots))
        return max(found, key=lambda one: one.gain - NATS_PER_NUMBER * len(one.curve.knots))

    @classmethod
    def with_knots(
        cls, signal: Tensor, base: NoiseSpectrum | None, sensor: int, knots: Array, keep: Array | slice = slice(None)
    ) -> _Bend:
        """Of these knots, fitted where to keep."""
        noise = BentNoise.of(signal - signal.mean(), base, sensor, knots)
        curve = noise.likeliest(keep)
        return cls(sensor, noise, curve, float(noise.gains(curve, keep)[keep].sum()))

    def explains(self, comparison: Comparison, better: float) -> bool:
        """Whether noise behind the curve is as the simulation's, and so many nats likelier than one of heavy tails."""
        left, most, chance = 0.25, 0.3, 5.0  # share of the moments that were, and largest one that is left; sd
        z = left_out(comparison.observed).white[0, self.sensor]
        law = TwoLevels.fitted(z)
        rival = max(float(law.gains(z).sum()), heavy_tailed(z[law.within(z)]))
        if max(self.curve.slopes[[0, -1]]) < 1:  # tails grow at both ends: rather those of the noise's own law
            rival = max(rival, _Bend.of(z, None, self.sensor).gain)
        own, simulated = 0.0, np.zeros(2)
        if not bool(gaussian_sensors(comparison.reference)[self.sensor]):
            other = _Bend.of(comparison.reference.signal[0, self.sensor], comparison.base, self.sensor)
            own, simulated = other.gain * len(z) / len(other.noise.y), _moments(other.noise.white.sum(0))
        if self.gain < max(rival, own) + better:
            return False
        straight = self.noise.error(self.curve)
        if level_lasts(torch.from_numpy(straight)):
            return False
        before, after = (np.abs(_moments(v) - simulated) for v in (self.noise.white.sum(0), straight))
        by_chance = chance * np.sqrt(np.array([6.0, 24.0]) / len(straight))
        return bool((after < np.maximum(min(left * before.max(), most), by_chance)).all())

    def scaled(self) -> Curve:
        """The curve of the simulation's level, where its slope is one near the mean then.

        Else the level differs for another reason, and the slope is one at the mean.
        """
        level = self.curve.times(1 / math.sqrt(float((self.noise.error(self.curve) ** 2).mean())))
        slopes = level.slope(self.noise.y.std() * np.linspace(-1, 1, 33))
        if slopes.min() <= 1 <= slopes.max():
            return level
        return self.curve.times(1 / float(self.curve.slope(np.zeros(1))[0]))

    @property
    def off(self) -> float:
        """Largest distance between what was felt and what was put out, within two standard deviations."""
        y = 2 * self.noise.y.std() * np.linspace(-1, 1, 65)
        return float(np.abs(self.scaled().at(y) - y).max())

    def numbers(self) -> list[tuple[float, float]]:
        """Quadratic and cubic coefficient of `g`, over that of the straight part, and their standard deviations."""
        curve, step = self.scaled(), 1e-4
        value = self._coefficients(curve)
        moved = [np.exp(step * one) for one in np.eye(len(curve.knots))]
        slopes = [(self._coefficients(curve._replace(slopes=m * curve.slopes)) - value) / step for m in moved]
        covariance = self.noise.covariance(self.curve)
        sd = np.sqrt(np.einsum("kn,kl,ln->n", slopes, covariance, slopes))
        return list(zip(value.tolist(), sd.tolist(), strict=True))

    def _coefficients(self, curve: Curve) -> Array:
        """Those of noise as large as was felt."""
        felt = curve.at(self.noise.y)
        return curve.coefficients(float(felt.mean()), float(felt.std()))


def _has_a_density(comparison: Comparison, sensor: int) -> bool:
    """Whether no value of the recording stands for many: coarse steps and dead bands are facts on the numbers."""
    often, more = 0.2, 1.5  # share of the samples: of steps of half an sd; times the next ones, beyond chance
    counts = distinct_values(comparison.observed)[sensor][1].to(torch.float64).sort(descending=True).values
    n, first, next_one = float(counts.sum()), float(counts[0]), float(counts[min(2, len(counts) - 1)])
    return first < often * n and first < more * next_one + 10 * math.sqrt(next_one)


def _moments(values: Array) -> Array:
    """Skewness and excess kurtosis."""
    z = (values - values.mean()) / values.std()
    return np.array([(z**3).mean(), (z**4).mean() - 3])
