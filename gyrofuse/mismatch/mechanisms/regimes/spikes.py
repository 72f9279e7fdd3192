"""Isolated outliers: shocks that all sensors feel, or errors of a bus, one sensor at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.noise_level import whitened_recording
from gyrofuse.mismatch.detectors.variance.normality import gaussian_sensors
from gyrofuse.mismatch.detectors.variance.outliers import likely_outliers, spike_p_value, spike_p_values
from gyrofuse.mismatch.detectors.variance.weak_outliers import WeakOutliers
from gyrofuse.mismatch.likelihoods.laws.heavy_tails import heavy_tailed
from gyrofuse.mismatch.likelihoods.laws.outlier_law import (
    Outliers,
    clustered,
    fitted,
    fitted_shock,
    free_gaussian,
    mixture,
    shock_posterior,
    shock_scores,
)
from gyrofuse.mismatch.likelihoods.laws.two_levels import TwoLevels
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.regimes.outlier_limits import with_limits
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.prediction_errors import left_out, predicted
from gyrofuse.mismatch.stats.segments import episodes_of, two_level_scores

_HOUR = 3600.0
_ALIKE = 5.0  # nats
_RARE = 2.5  # nats by which a few outliers have to surpass noise that is heavy-tailed throughout
_LAW, _TAILS = 1.5, 0.5  # nats that their law, and one of such noise, gain by chance: half of each number but the scale
_PLAIN = 5.0  # sd: outliers that can be taken off one by one
_PRESENT, _OWN_LAW = 4.0, 10.0  # nats of a sensor that has the law of all, and of one that has a law of its own
_UNLIKE = 5.0  # nats for each sensor that has a law of its own
_LIKELY = 0.8  # probability of being hit
_SEEN = 0.02  # p value of a sensor's tails
_ROUNDS, _ROUNDS_AGAIN = 40, 10
_ISOLATED = 0.03  # more frequent ones are another law of the noise


@dataclass(frozen=True, eq=False)
class Spikes(Mechanism):
    """`y_t = x_t + a_t` at isolated samples, `a_t` of either sign, of modulus `height` with some `spread`.

    Looks like white noise; the tails of what is left of a sample when all others have spoken tell them apart. Loud
    episodes have such tails too, but their outliers lie together. Noise that is heavy-tailed throughout has more of the
    small ones than a few spikes leave: that is another law of the noise.

    Attributes:
        rate: Of spikes, for a sample, `(sensor,)`; 0 where there are none.
        height, spread: Mean and sd of their modulus, unit of the signal, `(sensor,)`.
        together: Whether the sensors concerned are hit at the same time: a shock.
        beside: Share, smaller and larger standard deviation of the noise beside them in each sensor, in its robust sd,
            where that is no normal noise; empty where it is.
    """

    name: ClassVar[str] = "spikes"
    likelihood: ClassVar[str] = "innovations"
    rivals: ClassVar[tuple[str, ...]] = ("variance_change", "pulses")
    separated_by: ClassVar[str] = "more events, or a second sensor on the same supply"
    time_words: ClassVar[str] = "largest at"
    additive: ClassVar[bool] = True
    rate: OfSensors
    height: OfSensors
    spread: OfSensors
    together: bool
    beside: tuple[tuple[float, float, float], ...] = ()

    @property
    def amplitude(self) -> Tensor:
        """Root mean square of the spikes, `(sensor,)`."""
        return torch.hypot(self.height, self.spread)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = spike_p_value(comparison)
        if p_value > level:
            return None
        beside = _noise_beside(comparison)
        z = _normal_scores(left_out(comparison.observed).z[0], beside)
        laws = [fitted(row) for row in z]
        gains = _gains(z, laws).sum(-1) - _of_the_simulation(comparison, beside)
        hit = tuple((gains > _PRESENT).nonzero()[:, 0].tolist())
        weak = likely_outliers(comparison)
        if weak is not None and not weak.shock and weak.apart > -math.log(level):
            hit = tuple(i for i in range(comparison.n_sensors) if i in hit or float(weak.sensors[i]) > _LIKELY)
        if hit:  # what the law of all of them is likelier in has it, however little that gains by itself
            as_others = _gains(z, _shared(z, laws, hit)).sum(-1)
            hit = tuple(i for i in range(comparison.n_sensors) if float(as_others[i]) > 0 or float(gains[i]) > _OWN_LAW)
        if beside:  # else tails that the simulation has as well would count
            hit = tuple(i for i in hit if float(spike_p_values(comparison)[i]) < _SEEN)
        apart = float(gains[list(hit)].sum())
        laws = _alike(z, laws, hit)
        gain = float(_gains(z, laws)[list(hit)].sum())
        shock = _shock(z, likely_outliers(comparison), laws, hit)
        together = shock is not None and shock[1] > gain
        if shock is not None and together:
            laws, gain = shock
            hit = tuple(i for i, law in enumerate(laws) if law.rate > 0)
        frequent = any(laws[i].rate > _ISOLATED for i in hit)
        white = _normal_scores(whitened_recording(comparison), beside)
        if not hit or frequent or clustered(white[list(hit)]):
            return None
        n_laws = 1 if together else _n_laws(laws, hit)
        if max(gain - _LAW * n_laws, apart - _LAW * len(hit)) < _heavy_tailed(z, hit) + _RARE:
            return None
        rival = _louder(comparison)
        if rival > gain + _ALIKE:
            return None
        effect = cls._of(comparison, hit, laws, together, beside)
        parameters = effect._parameters(comparison, hit, laws if together else _limited(z, laws, hit))
        alternatives = [
            name
            for name, alike in (
                ("variance_change", rival > gain - _ALIKE),
                ("parameter_shift", gain < _ALIKE),
            )
            if alike
        ]
        largest = max(hit, key=lambda i: float(effect.amplitude[i]))
        info = comparison.info
        where = info.named(hit, "all sensors")
        how = "at the same time, as shocks do" if effect.together else "not at the same time, as errors of a bus are"
        return effect.found(
            f"isolated outliers in {where}{', ' + how if len(hit) > 1 else ''}: "
            f"{laws[largest].rate * info.rate * _HOUR:.3g} an hour of {float(effect.amplitude[largest]):.3g} "
            f"{info.measure}{f' in sensor {info.sensors[largest]}' if len(hit) > 1 else ''}",
            p_value,
            hit,
            parameters,
            levels=(1,),
            alternatives=tuple(alternatives),
            time_s=int(z[largest].abs().argmax()) / info.rate,
            gain=gain,
        )

    @classmethod
    def _of(
        cls,
        comparison: Comparison,
        hit: tuple[int, ...],
        laws: list[Outliers],
        together: bool,
        beside: tuple[tuple[float, float, float], ...],
    ) -> Spikes:
        rows = [laws[i] if i in hit else Outliers.none() for i in range(comparison.n_sensors)]
        ends = [
            [noise.of_normal_score(row.height + sign * row.spread) for sign in (-1, 1)]
            for row, noise in zip(rows, _noise(beside, comparison.n_sensors), strict=True)
        ]
        low, high = torch.tensor(ends, dtype=torch.float64).unbind(-1)
        rate = torch.tensor([row.rate for row in rows], dtype=torch.float64)
        sd = left_out(comparison.observed).sd[0]
        return cls(rate, (low + high) / 2 * sd, (high - low) / 2 * sd, together, beside)

    def _parameters(self, comparison: Comparison, hit: tuple[int, ...], laws: list[Outliers]) -> dict[str, Parameter]:
        per_hour, sd, parameters = comparison.info.rate * _HOUR, left_out(comparison.observed).sd[0], {}
        noise = _noise(self.beside, comparison.n_sensors)
        for i in hit:
            law = laws[i]
            low, high = law.rate_limits
            parameters["rate" if self.together else f"rate[{i}]"] = Parameter(
                law.rate * per_hour, low * per_hour, high * per_hour, "1/h"
            )
            size, low, high = (
                noise[i].of_normal_score(score) * float(sd[i]) for score in (law.amplitude, *law.amplitude_limits)
            )
            parameters[f"amplitude[{i}]"] = Parameter(size, low, high, comparison.info.measure)
        return parameters

    def fit_without(self, comparison: Comparison, fold: int) -> Spikes:
        keep = estimation_samples(comparison.n_samples, fold)
        z = _normal_scores(left_out(comparison.observed).z[0], self.beside)
        hit = tuple(self.rate.nonzero()[:, 0].tolist())
        if self.together:
            laws = fitted_shock(z[:, keep], self._laws(comparison), _ROUNDS_AGAIN)
            return self._of(comparison, hit, laws, True, self.beside)
        laws = [fitted(row[keep]) if i in hit else Outliers.none() for i, row in enumerate(z)]
        return self._of(comparison, hit, _alike(z[:, keep], laws, hit), False, self.beside)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        def draw(kind: str, shape: tuple[int, ...]) -> Tensor:
            source = torch.rand if kind == "even" else torch.randn
            return source(shape, generator=generator, dtype=torch.float64)

        rate = self.rate[:, None]
        when = (*signal.shape[:-2], 1, signal.shape[-1]) if self.together else tuple(signal.shape)
        at = draw("even", when) < (rate.amax() if self.together else rate)
        sign = torch.where(draw("even", tuple(signal.shape)) < 0.5, -1.0, 1.0)
        size = self.height[:, None] + self.spread[:, None] * draw("normal", tuple(signal.shape))
        return signal + torch.where(at & (rate > 0), sign * size, 0.0)

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        """Samples that are outliers more likely than not are predicted from all others of their record."""
        if signal.ndim > 2:
            return torch.stack([self.remove(record, info) for record in signal.flatten(0, -3)]).view_as(signal)
        comparison = Comparison.of(info, signal, signal[None])
        error = left_out(comparison.observed).correctable()[0]
        return torch.where(self._outliers(comparison, error), signal - error, signal)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        expected = left_out(comparison.observed)
        plain = self.amplitude >= _PLAIN * expected.sd[0]
        if not bool(plain[self.rate > 0].all()):
            return super().repair(comparison, generator)
        outliers = self._outliers(comparison, expected.correctable()[0])
        return comparison.with_recording(predicted(comparison.observed, outliers, generator))

    def replaced(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        """A record `(sensor, time)` without outliers, which are drawn by their probabilities, with noise instead."""
        comparison = Comparison.of(info, signal, signal[None])
        likely = self._likely(comparison, left_out(comparison.observed).correctable()[0])
        draws = torch.rand(likely.shape, generator=generator, dtype=torch.float64)
        return predicted(comparison.observed, (draws < likely) & (self.rate > 0)[:, None], generator)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.tails(ax, comparison, sensor)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        z, laws = _normal_scores(left_out(comparison.observed).z[0], self.beside), self._laws(comparison)
        if self.together:
            return held_out_blocks(_shock_gains(z, laws), fold).sum(-1)
        laws = [law.scaled(row) for row, law in zip(z, laws, strict=True)]
        return held_out_blocks(_gains(z, laws) * (self.rate[:, None] > 0), fold).sum((0, -1))

    def _laws(self, comparison: Comparison) -> list[Outliers]:
        """In standard normal scores."""
        sd, laws = left_out(comparison.observed).sd[0], []
        ends = torch.stack([self.height - self.spread, self.height + self.spread], -1) / sd[:, None]
        for rate, own, noise in zip(self.rate.tolist(), ends, _noise(self.beside, len(sd)), strict=True):
            low, high = noise.normal_scores(own).tolist()
            laws.append(Outliers(rate, (low + high) / 2, (high - low) / 2))
        return laws

    def _outliers(self, comparison: Comparison, error: Tensor) -> Tensor:
        """Samples that are outliers more likely than not by their errors, `(sensor, time)`."""
        return (self.rate > 0)[:, None] & (self._likely(comparison, error) > 0.5)

    def _likely(self, comparison: Comparison, error: Tensor) -> Tensor:
        """Probability that samples are outliers, by their errors: `(sensor, time)`, or `(1, time)` of shocks."""
        z = _normal_scores(error / left_out(comparison.observed).sd[0][:, None], self.beside)
        laws = self._laws(comparison)
        if self.together:
            return shock_posterior(z, laws)[None]
        return torch.stack([law.posterior(row) for row, law in zip(z, laws, strict=True)])


def _noise_beside(comparison: Comparison) -> tuple[tuple[float, float, float], ...]:
    """Two levels that the noise has in each sensor, where the simulation's is not normal in all of them.

    Those of the recording, within the largest value of the simulation: numbers of its noise may be a little off there.
    """
    gaussian = gaussian_sensors(comparison.reference)
    if bool(gaussian.all()):
        return ()
    largest, own = _simulated(comparison).abs().amax(-1), left_out(comparison.observed).z[0]
    laws = [
        TwoLevels.normal() if is_normal else TwoLevels.fitted(row[row.abs() <= most])
        for is_normal, row, most in zip(gaussian, own, largest, strict=True)
    ]
    return tuple((law.share, law.small, law.large) for law in laws)


def _of_the_simulation(comparison: Comparison, beside: tuple[tuple[float, float, float], ...]) -> Tensor:
    """What outliers gain in the simulation by itself, `(sensor,)`, nats: its noise has not quite two levels."""
    gains = torch.zeros(comparison.n_sensors, dtype=torch.float64)
    if not beside:
        return gains
    z = _normal_scores(_simulated(comparison), beside)
    for i, (share, _, _) in enumerate(beside):
        if share:
            gains[i] = _gains(z[i : i + 1], [fitted(z[i])]).sum() * comparison.n_samples / z.shape[-1]
    return gains


def _simulated(comparison: Comparison) -> Tensor:
    """Standardised prediction errors of the simulation, `(sensor, time)`, its records one after the other."""
    return left_out(comparison.reference).z.movedim(0, 1).flatten(1)


def _noise(beside: tuple[tuple[float, float, float], ...], n_sensors: int) -> list[TwoLevels]:
    return [TwoLevels(*own) for own in beside] or [TwoLevels.normal()] * n_sensors


def _normal_scores(z: Tensor, beside: tuple[tuple[float, float, float], ...]) -> Tensor:
    """Values `(sensor, time)` as standard normal ones that are as unlikely beside that noise."""
    return torch.stack([noise.normal_scores(row) for row, noise in zip(z, _noise(beside, len(z)), strict=True)])


def _gains(z: Tensor, laws: list[Outliers]) -> Tensor:
    """Log likelihood over normal laws of their own variance, `(sensor, time)`."""
    return torch.stack([mixture(row, law) - free_gaussian(row) for row, law in zip(z, laws, strict=True)])


def _heavy_tailed(z: Tensor, hit: tuple[int, ...]) -> float:
    """Nats of noise that is heavy-tailed throughout, in each sensor in its way or in all alike, without chance's."""
    each = sum(heavy_tailed(z[i]) - _TAILS for i in hit)
    if len(hit) < 2:
        return each
    return max(each, heavy_tailed(torch.cat([z[i] / z[i].square().mean().sqrt() for i in hit])) - _TAILS)


def _alike(z: Tensor, laws: list[Outliers], hit: tuple[int, ...]) -> list[Outliers]:
    """One law for all sensors concerned, in sd of their noise, where it is as good as one for each."""
    if len(hit) < 2:
        return laws
    one = [own if i in hit else law for i, (own, law) in enumerate(zip(_shared(z, laws, hit), laws, strict=True))]
    worse = float((_gains(z, laws) - _gains(z, one)).sum())
    return one if worse < _UNLIKE * (len(hit) - 1) else laws


def _shared(z: Tensor, laws: list[Outliers], hit: tuple[int, ...]) -> list[Outliers]:
    """The law of some sensors, in sd of their noise, for each."""
    # Where a law of its own takes much of the noise for outliers its scale is not that of the noise.
    units = [
        law.scale if law.rate < _ISOLATED else float(row.square().mean().sqrt())
        for row, law in zip(z, laws, strict=True)
    ]
    law = fitted(torch.cat([z[i] / units[i] for i in hit]))
    scales = [law.times(unit).scaled(row).scale for row, unit in zip(z, units, strict=True)]
    return [law.times(scale / law.scale) for scale in scales]


def _n_laws(laws: list[Outliers], hit: tuple[int, ...]) -> int:
    """One where the sensors concerned share it."""
    return len({laws[i].rate for i in hit})


def _limited(z: Tensor, laws: list[Outliers], hit: tuple[int, ...]) -> list[Outliers]:
    """With limits; those of one law for all sensors from the values of all."""
    limited = list(laws)
    for group in [hit] if _n_laws(laws, hit) == 1 else [(i,) for i in hit]:
        unit = laws[group[0]].times(1 / laws[group[0]].scale)
        found = with_limits(torch.cat([z[i] / laws[i].scale for i in group]), unit)
        for i in group:
            limited[i] = found.times(laws[i].scale)
    return limited


def _shock(
    z: Tensor, weak: WeakOutliers | None, apart: list[Outliers], hit: tuple[int, ...]
) -> tuple[list[Outliers], float] | None:
    """Laws of outliers that hit several sensors at once, and what they gain, nats."""
    starts = [(hit, [law._replace(rate=max((apart[i].rate for i in hit), default=0.0)) for law in apart])]
    if weak is not None and weak.shock:
        likely = tuple((weak.sensors > 0.5).nonzero()[:, 0].tolist())
        starts.append((likely, [Outliers(weak.rate, weak.size, 0.1 * weak.size)] * len(z)))
    found = []
    for sensors, start in starts:
        if len(sensors) > 1:
            laws = [law if i in sensors else Outliers.none() for i, law in enumerate(start)]
            laws = fitted_shock(z, laws, _ROUNDS)
            found.append((laws, float(_shock_gains(z, laws).sum())))
    return max(found, key=lambda entry: entry[1], default=None)


def _shock_gains(z: Tensor, laws: list[Outliers]) -> Tensor:
    """Log likelihood of shocks over normal laws of their own variance, `(time,)`."""
    rows = [row for row, law in zip(z, laws, strict=True) if law.rate > 0]
    plain = sum((mixture(row, Outliers.none()) - free_gaussian(row) for row in rows), torch.zeros(()))
    return shock_scores(z, laws) + plain


def _louder(comparison: Comparison) -> float:
    """What an episode of louder noise would gain, nats."""
    white = whitened_recording(comparison)
    found = episodes_of(white)
    return (
        0.0 if found is None else float(two_level_scores(white, found.factor, found.inside(comparison.n_samples)).sum())
    )
