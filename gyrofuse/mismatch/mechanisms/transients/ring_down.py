"""Ring-downs: knocks after which a structure rings and dies away."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD, NATS_PER_NUMBER
from gyrofuse.mismatch.detectors.lines.ring_cells import strongest_by_chance
from gyrofuse.mismatch.detectors.lines.ring_downs import disordered, ring_down_p_value, ring_downs, scanned_ring_downs
from gyrofuse.mismatch.detectors.moving.moving_lines import moving_line
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.variance.random_levels import is_random_level
from gyrofuse.mismatch.likelihoods.damped_tone import DampedTone, FittedTone, Surroundings
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.transients.transient import Transient, hourly, often_words
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.folds import N_FOLDS
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class RingDown(Transient):
    """`x_i(t) = sum_m exp(-u / tau_m) [cosine_mi cos(2 pi f_m u) + sine_mi sin(2 pi f_m u)]`, `u = t - t_m >= 0`.

    Modes that are struck at times `t_m`, at random. Looks like spikes, which are gone after a sample; like a tone or a
    resonance, which have no beginning; and like louder noise, in which no two sensors keep a phase. What grows before
    it dies away is two modes that beat, where these are likelier by more than their numbers cost, or has another name.

    Attributes:
        onset_s: `t_m`, s after the first sample, `(tone,)`; modes that set in together are one knock. The strongest
            is the first.
        frequency_hz: `f_m`, `(tone,)`.
        decay_s: `tau_m`, `(tone,)`.
        cosine, sine: `(tone, sensor)`, unit of the signal.
        duration_s: Of the recording in which so many were.
    """

    name: ClassVar[str] = "ring_down"
    separated_by: ClassVar[str] = "more knocks"
    time_words: ClassVar[str] = "strongest at"
    onset_s: Annotated[Tensor, Dims(("tone",))]
    frequency_hz: Annotated[Tensor, Dims(("tone",))]
    decay_s: Annotated[Tensor, Dims(("tone",))]
    cosine: Annotated[Tensor, Dims(("tone", "sensor"))]
    sine: Annotated[Tensor, Dims(("tone", "sensor"))]
    duration_s: float

    @property
    def amplitude(self) -> Tensor:
        """At the onset, `(tone, sensor)`, unit of the signal."""
        return torch.hypot(self.cosine, self.sine)

    @property
    def knocks(self) -> tuple[tuple[int, ...], ...]:
        """Tones that set in together, in the order of time."""
        groups: list[list[int]] = []
        together = 0.1  # time constants
        for k in self.onset_s.argsort().tolist():
            last = groups[-1][-1] if groups else None
            if last is not None and float(self.onset_s[k] - self.onset_s[last]) < together * float(
                self.decay_s[[k, last]].max()
            ):
                groups[-1].append(k)
            else:
                groups.append([k])
        return tuple(tuple(group) for group in groups)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = ring_down_p_value(comparison)
        if p_value > level:
            return None
        tones = sorted(_tones(comparison), key=lambda tone: -float(tone.log_ratio.sum()))
        if not tones:
            return None
        info = comparison.info
        effect, strongest = cls.of(tones, comparison), tones[0]
        gain = effect.gained(comparison, 3 * len(tones) + 2 * int((effect.amplitude > 0).sum()))
        if is_random_level(comparison, gain):
            return None  # whose loud stretches are many
        around = Surroundings.of(comparison.recording, comparison.base, strongest.tone.onset, strongest.tone.tau)
        frequency_sd, decay_sd, size_sd = around.sd(strongest)
        there = tuple((strongest.size != 0).any(0).nonzero()[:, 0].tolist())
        f, decay = strongest.tone.frequency * info.rate, strongest.tone.tau / info.rate
        spread, factor = Z * frequency_sd * info.rate, math.exp(min(Z * decay_sd, 20.0))
        knocks = len(effect.knocks)
        often = hourly(knocks, effect.duration_s)
        parameters = {
            "rate": often,
            "frequency": Parameter.around(f, spread, "Hz", least=0.0, most=info.rate / 2),
            "decay_time": Parameter.within(decay, factor, "s"),
        }
        amplitude = torch.hypot(*strongest.size)
        # Of the two parts of an amplitude the one along its phase counts.
        sd = (strongest.size * size_sd).square().sum(0).sqrt() / amplitude.clamp(min=1e-300)
        for i in there:
            a, reach = float(amplitude[i]), Z * float(sd[i])
            parameters[f"amplitude[{i}]"] = Parameter.around(a, reach, info.measure, least=0.0)
        concerned = tuple((effect.amplitude > 0).any(0).nonzero()[:, 0].tolist())
        largest, onset = int(amplitude.argmax()), strongest.tone.onset / info.rate
        return effect.found(
            f"{knocks} {'knock' if knocks == 1 else 'knocks'} after which something rings"
            f"{often_words(knocks, often)}, in {info.named(concerned, 'all sensors')}: the strongest at {onset:.6g} s, "
            f"at {f:.4g} Hz, dies "
            f"away in {decay:.3g} s, from {float(amplitude[largest]):.3g} {info.measure} in sensor "
            f"{info.sensors[largest]}",
            p_value,
            concerned,
            parameters,
            levels=(level_of(strongest.tone.frequency),),
            frequency_hz=f,
            time_s=onset,
            gain=gain,
        )

    @classmethod
    def of(cls, tones: Sequence[FittedTone], comparison: Comparison) -> RingDown:
        """Of tones that were fitted to a recording."""
        rate = comparison.info.rate
        onset, frequency, tau = (
            torch.tensor(x, dtype=torch.float64) for x in zip(*(t.tone for t in tones), strict=True)
        )
        size = torch.stack([tone.size for tone in tones])
        duration = comparison.n_samples / rate
        return cls(onset / rate, frequency * rate, tau / rate, size[:, 0], size[:, 1], duration)

    def fit_without(self, comparison: Comparison, fold: int) -> RingDown:
        """With the numbers that every fourth sample is not used for: a tone lies in one block, or in few."""
        left, fitted = self.remove(comparison.recording, comparison.info), list[FittedTone]()
        for tone, size in self._tones(comparison.info.rate):
            own = left + size.mT @ tone.paths(0, comparison.n_samples)
            around = Surroundings.of(own, comparison.base, tone.onset, tone.tau).without(fold, N_FOLDS)
            sensors = size.any(0).nonzero()[:, 0].tolist()
            fitted.append(_only(around.refined(tone, sensors), sensors))
            left = own - _path(fitted[-1], comparison.n_samples)
        return self.of(fitted, comparison)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        rate = comparison.info.rate
        tau = float(self.decay_s[0]) * rate  # of the strongest
        first = round(float(self.onset_s[0]) * rate - 2 * tau - 8)
        path = self.path(comparison.n_samples, rate) if fitted else None
        pictures.transient(ax, comparison, sensor, first, round(8 * tau) + 24, path)

    def drawn(self, n_samples: int, rate: float, generator: torch.Generator) -> Tensor:
        """Knocks at random, each one of those that were found, of either sign."""
        knocks, path = self.knocks, torch.zeros(self.cosine.shape[-1], n_samples, dtype=torch.float64)
        expected = torch.tensor(len(knocks) * n_samples / rate / self.duration_s, dtype=torch.float64)
        for _ in range(int(torch.poisson(expected, generator=generator))):
            which = list(knocks[int(torch.randint(len(knocks), (), generator=generator))])
            onset = float(torch.rand((), generator=generator, dtype=torch.float64)) * n_samples / rate
            sign = 1.0 if bool(torch.randint(2, (), generator=generator)) else -1.0
            one = replace(
                self,
                onset_s=onset + self.onset_s[which] - self.onset_s[which].min(),
                **{name: getattr(self, name)[which] for name in ("frequency_hz", "decay_s", "cosine", "sine")},
            )
            path = path + sign * one.path(n_samples, rate)
        return path

    def _tones(self, rate: float) -> list[tuple[DampedTone, Tensor]]:
        """Each with its sizes, `(2, sensor)`."""
        numbers = torch.stack([self.onset_s * rate, self.frequency_hz / rate, self.decay_s * rate], -1)
        sizes = torch.stack([self.cosine, self.sine], 1)
        return [
            (DampedTone(round(onset), frequency, tau), size)
            for (onset, frequency, tau), size in zip(numbers.tolist(), sizes, strict=True)
        ]

    def path(self, n_samples: int, rate: float) -> Tensor:
        path = torch.zeros(self.cosine.shape[-1], n_samples, dtype=torch.float64)
        for tone, size in self._tones(rate):
            first = max(tone.onset, 0)
            end = min(tone.gone_after, n_samples)
            if end > first:
                path[:, first:end] += size.mT @ tone.paths(first, end - first)
        return path


def _tones(comparison: Comparison) -> list[FittedTone]:
    """All tones that ring down, the strongest of each scan first."""
    left, scan, tones = comparison.recording, ring_downs(comparison), list[FittedTone]()
    # Scans, tones that are told apart, and cells of a scan that are no ring-down: what lasts has many of them.
    rounds, most, most_refused, most_waves, waves = 4, 48, 4, 4, 0
    mostly = 0.8  # of the energy
    line = moving_line(comparison.observed)
    for _ in range(rounds):
        new, by_chance, refused = list[FittedTone](), strongest_by_chance(scan, disordered(comparison)), 0
        least = by_chance + NATS_AS_GOOD
        for cell in scan.cells:
            if cell.log_ratio < by_chance or len(tones) + len(new) >= most or refused >= most_refused:
                break
            passes = line.passes(cell.onset, cell.frequency)  # a line that wanders, and beats with the noise
            if passes and waves >= most_waves:
                continue
            around = Surroundings.of(left, comparison.base, cell.onset, cell.tau)
            found = around.fitted(DampedTone(cell.onset, cell.frequency, cell.tau))
            which = list(included_sensors(2 * found.log_ratio, 2).positions)
            found = _only(around.fitted(found.tone, which), which)
            if float(found.log_ratio.sum()) < least or _faint(found, tones + new):
                continue
            if not _rings(found):
                refused += 1
                continue
            # Of a line there is more before and after; knocks one after the other look like one that comes and goes.
            if passes and float(around.explained(found)[which].max()) < mostly:
                waves += 1
                continue
            rung = _ring_down(around, found, which)
            if not all(map(_rings, rung)):
                rung = []
            left = left - sum(_path(one, comparison.n_samples) for one in rung)
            new += rung
            refused += not rung
        if not new:
            return tones
        tones = [tone for tone in _one_by_one(comparison, tones + new) if _rings(tone)]
        left = comparison.recording - sum(_path(tone, comparison.n_samples) for tone in tones)
        scan = scanned_ring_downs(whitened(left, comparison.base))
    return tones


def _rings(found: FittedTone) -> bool:
    """Whether it goes up and down before it has died away: else it is a step, a drift, a bias that swings."""
    least = 0.3  # cycles in a time constant
    return found.tone.frequency * found.tone.tau >= least


def _ring_down(around: Surroundings, found: FittedTone, sensors: Sequence[int]) -> list[FittedTone]:
    """The tone, or two where one seems to grow at first; none where another course is likelier.

    Two that set in together and beat, or one mode that is struck once more before it has died away.
    """
    rival, gain, near = around.other_courses(found, sensors), float(found.log_ratio.sum()), 0.4
    nearly_all = 0.95  # of the energy there: what another course says more of is a matter of form
    if gain > rival + NATS_PER_NUMBER or around.explained(found)[list(sensors)].min() > nearly_all:
        return [found]
    if gain < near * rival:  # two that beat, or one after the other, look like one, more or less
        return []
    both = max(
        around.two_modes(found, sensors, rival),
        around.two_knocks(found, sensors),
        key=lambda two: float(two[0].log_ratio[list(sensors)].sum()),
    )
    gain = float(both[0].log_ratio[list(sensors)].sum())
    more = 2 + 2 * len(sensors)  # numbers
    return [_only(one, sensors) for one in both] if gain > rival + NATS_PER_NUMBER * (1 + more) else []


def _one_by_one(comparison: Comparison, tones: list[FittedTone]) -> list[FittedTone]:
    """Tones that ring at the same time, each fitted anew to what the others leave."""
    sweeps, n = 2, comparison.n_samples
    left = comparison.recording - sum(_path(tone, n) for tone in tones)
    for k in [k for k, one in enumerate(tones) if any(_overlap(one, o) for o in tones if o is not one)] * sweeps:
        own = left + _path(tones[k], n)
        around = Surroundings.of(own, comparison.base, tones[k].tone.onset, tones[k].tone.tau)
        which = tones[k].size.any(0).nonzero()[:, 0].tolist()
        tones[k] = _only(around.fitted(tones[k].tone, which), which)
        left = own - _path(tones[k], n)
    return tones


def _path(found: FittedTone, n_samples: int) -> Tensor:
    """`(sensor, time)`."""
    return found.size.mT @ found.tone.paths(0, n_samples)


def _overlap(one: FittedTone, other: FittedTone) -> bool:
    """Whether they ring at the same time."""
    return one.tone.onset < other.tone.gone_after and other.tone.onset < one.tone.gone_after


def _only(found: FittedTone, sensors: Sequence[int]) -> FittedTone:
    """In some sensors alone."""
    there = torch.zeros(found.size.shape[-1], dtype=torch.bool)
    there[list(sensors)] = True
    return found._replace(size=found.size * there, log_ratio=found.log_ratio * there)


def _faint(found: FittedTone, others: Sequence[FittedTone]) -> bool:
    """Whether it is hardly anything beside a stronger one that rings at the same time: what its form leaves."""
    share = 1e-3
    return any(
        float(found.log_ratio.sum()) < share * float(other.log_ratio.sum()) and _overlap(found, other)
        for other in others
    )
