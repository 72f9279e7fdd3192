"""Pulses: something that pushes sensors one way for some samples, and is gone: a shock, a fault of a bus."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD, NATS_PER_NUMBER
from gyrofuse.mismatch.detectors.lines.ring_cells import strongest_by_chance
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.variance.pulses import disordered, pulse_p_value, pulses_of, scanned_pulses
from gyrofuse.mismatch.detectors.variance.random_levels import is_random_level
from gyrofuse.mismatch.likelihoods.damped_tone import Surroundings
from gyrofuse.mismatch.likelihoods.pulse import FittedPulse, Pulse, fitted_pulse, other_course, sized, width_limits
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
class Pulses(Transient):
    """`x_i(t) = sum_m amplitude_mi sin(pi u)^q_m`, `u = (t - t_m) / width_m` from 0 to 1, at random.

    Half sines, haversines, and next to rectangles. Looks like spikes, which are gone after a sample; like what rings,
    which goes to and fro; like steps, which stay; and like switching between two levels, whose stays are of any length.

    Attributes:
        onset_s: `t_m`, s after the first sample, `(pulse,)`; the strongest is the first.
        width_s: `(pulse,)`.
        power: `q_m`, `(pulse,)`.
        size: `(pulse, sensor)`, unit of the signal; 0 in sensors that do not have it.
        duration_s: Of the recording in which so many were.
    """

    name: ClassVar[str] = "pulses"
    separated_by: ClassVar[str] = "more pulses"
    time_words: ClassVar[str] = "strongest at"
    onset_s: Annotated[Tensor, Dims(("pulse",))]
    width_s: Annotated[Tensor, Dims(("pulse",))]
    power: Annotated[Tensor, Dims(("pulse",))]
    size: Annotated[Tensor, Dims(("pulse", "sensor"))]
    duration_s: float

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = pulse_p_value(comparison)
        if p_value > level:
            return None
        shortest = 1.5  # samples: what is over sooner is a spike
        pulses = [one for one in _those_alone(comparison, _pulses(comparison)) if one.pulse.width > shortest]
        pulses.sort(key=lambda one: -float(one.log_ratio.sum()))
        if not pulses or _to_and_fro(pulses) or _of_any_length(pulses):
            return None
        if sum(float(one.log_ratio.sum()) for one in pulses) < -math.log(max(p_value, 1e-300)):
            return None  # what is so conspicuous is something else
        info, rate = comparison.info, comparison.info.rate
        effect, strongest = cls.of(pulses, comparison), pulses[0]
        gain = effect.gained(comparison, 3 * len(pulses) + int(effect.size.count_nonzero()))
        if is_random_level(comparison, gain):
            return None  # whose loud stretches are many
        around = _around(comparison, comparison.recording, strongest.pulse)
        width, often = strongest.pulse.width / rate, hourly(len(pulses), effect.duration_s)
        low, high = width_limits(around, strongest)
        parameters = {
            "rate": often,
            "width": Parameter(width, low / rate, high / rate, "s"),
        }
        for i in strongest.amplitude.nonzero()[:, 0].tolist():
            value, reach = float(strongest.amplitude[i]), Z * float(strongest.sd[i])
            parameters[f"amplitude[{i}]"] = Parameter.around(value, reach, info.measure)
        concerned = tuple((effect.size != 0).any(0).nonzero()[:, 0].tolist())
        largest, onset = int(strongest.amplitude.abs().argmax()), strongest.pulse.onset / rate
        many = "a pulse" if len(pulses) == 1 else f"{len(pulses)} pulses"
        return effect.found(
            f"{many} of one sign and then gone{often_words(len(pulses), often)}, in "
            f"{info.named(concerned, 'all sensors')}: the strongest at {onset:.6g} s, {width:.3g} s long, of "
            f"{float(strongest.amplitude[largest]):.3g} {info.measure} in sensor {info.sensors[largest]}, as of "
            "a shock or a fault of transmission",
            p_value,
            concerned,
            parameters,
            levels=(level_of(min(0.5 / strongest.pulse.width, 0.5)),),
            time_s=onset,
            gain=gain,
        )

    @classmethod
    def of(cls, pulses: Sequence[FittedPulse], comparison: Comparison) -> Pulses:
        """Of pulses that were fitted to a recording."""
        rate = comparison.info.rate
        onset, width, power = (
            torch.tensor(x, dtype=torch.float64) for x in zip(*(one.pulse for one in pulses), strict=True)
        )
        size = torch.stack([one.amplitude for one in pulses])
        return cls(onset / rate, width / rate, power, size, comparison.n_samples / rate)

    def fit_without(self, comparison: Comparison, fold: int) -> Pulses:
        """With the amplitudes that every fourth sample is not used for: a pulse lies in one block."""
        left, sizes = self.remove(comparison.recording, comparison.info), list[Tensor]()
        for pulse, size in zip(self._each(comparison.info.rate), self.size, strict=True):
            own = left + _path(pulse, size, comparison.n_samples)
            around = _around(comparison, own, pulse).without(fold, N_FOLDS)
            sizes.append(sized(around, pulse, size.nonzero()[:, 0].tolist()).amplitude)
            left = own - _path(pulse, sizes[-1], comparison.n_samples)
        return replace(self, size=torch.stack(sizes))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        rate = comparison.info.rate
        width = float(self.width_s[0]) * rate  # of the strongest
        first = round(float(self.onset_s[0]) * rate - 2 * width - 8)
        path = self.path(comparison.n_samples, rate) if fitted else None
        pictures.transient(ax, comparison, sensor, first, round(5 * width) + 24, path)

    def path(self, n_samples: int, rate: float) -> Tensor:
        path = torch.zeros(self.size.shape[-1], n_samples, dtype=torch.float64)
        for pulse, size in zip(self._each(rate), self.size, strict=True):
            path = path + _path(pulse, size, n_samples)
        return path

    def drawn(self, n_samples: int, rate: float, generator: torch.Generator) -> Tensor:
        """Pulses at random, each one of those that were found."""
        expected = torch.tensor(len(self.size) * n_samples / rate / self.duration_s, dtype=torch.float64)
        which = torch.randint(len(self.size), (int(torch.poisson(expected, generator=generator)),), generator=generator)
        onset = torch.rand(len(which), generator=generator, dtype=torch.float64) * n_samples / rate
        drawn = {name: getattr(self, name)[which] for name in ("width_s", "power", "size")}
        return replace(self, onset_s=onset, **drawn).path(n_samples, rate)

    def _each(self, rate: float) -> list[Pulse]:
        numbers = torch.stack([self.onset_s * rate, self.width_s * rate, self.power], -1)
        return [Pulse(*row) for row in numbers.tolist()]


def _pulses(comparison: Comparison) -> list[FittedPulse]:
    """Those that stand out, the strongest of each scan first, each fitted to what the others leave."""
    scan, found, left = pulses_of(comparison), list[FittedPulse](), comparison.recording
    rounds, most, most_doubtful, n = 4, 200, 6, comparison.n_samples
    slow = comparison.shortest_transient
    shared = torch.corrcoef(comparison.lineless.clamp(-4, 4)).view(comparison.n_sensors, -1)
    for _ in range(rounds):
        doubtful, new = list[FittedPulse](), list[FittedPulse]()
        by_chance = strongest_by_chance(scan, disordered(comparison))
        for cell in scan.cells:
            if cell.log_ratio < by_chance or len(found) + len(new) >= most or len(doubtful) >= most_doubtful:
                break
            around = Surroundings.of(left, comparison.base, cell.onset, float(cell.length))
            one = fitted_pulse(around, cell.onset, cell.length, range(comparison.n_sensors))
            one = sized(around, one.pulse, included_sensors(2 * one.log_ratio, 1).positions)
            numbers = int(one.amplitude.count_nonzero())  # each of which gains half a nat by chance
            if min(float(one.log_ratio.sum()), _jointly(one, shared)) < by_chance + NATS_AS_GOOD + numbers / 2:
                continue
            (new if _is_one(around, one, slow) else doubtful).append(one)
            left = left - _path(one.pulse, one.amplitude, n)
        for one in doubtful:  # beside another one that was not known yet, either seems to be something else
            own = left + _path(one.pulse, one.amplitude, n)
            if _is_one(_around(comparison, own, one.pulse), one, slow):
                new.append(one)
            else:
                left = own
        found += new
        if not new:
            break
        scan = scanned_pulses(whitened(left, comparison.base))
    return found


def _jointly(one: FittedPulse, shared: Tensor) -> float:
    """Log likelihood ratio of a pulse where sensors share noise, of correlations `(sensor, sensor)`."""
    has = one.amplitude != 0
    z = torch.sqrt(2 * one.log_ratio[has]) * one.amplitude[has].sign()
    among = shared[has][:, has] + 1e-6 * torch.eye(len(z), dtype=z.dtype)
    return float(z @ torch.linalg.solve(among, z)) / 2


def _is_one(around: Surroundings, one: FittedPulse, slow: float) -> bool:
    """Whether no other course explains as much, nor a jump that decays over `slow` samples or more.

    A level that stays for as long is one of the bias, between two steps.
    """
    flat = 0.1  # power of a half wave that is nearly a rectangle
    if one.pulse.power < flat and one.pulse.width > slow:
        return False
    there = sized(around, one.pulse, one.amplitude.nonzero()[:, 0].tolist())
    return float(there.log_ratio.sum()) > other_course(around, there, slow) + NATS_PER_NUMBER


def _those_alone(comparison: Comparison, found: Sequence[FittedPulse]) -> list[FittedPulse]:
    """Those that begin and end, and are no end of what is loud before or after, nor left of what was taken off."""
    sides, loud, larger, normal = 8, 4.0, 10.0, 0.6745  # widths; sds of the record; times the pulse; of a modulus
    n, paths = comparison.n_samples, [_path(one.pulse, one.amplitude, comparison.n_samples) for one in found]
    all_of_them = torch.stack(paths).sum(0) if paths else torch.zeros_like(comparison.recording)
    quiet = whitened(comparison.recording - all_of_them, comparison.base).abs()
    level = quiet.median(-1).values / normal
    taken = whitened(comparison.taken_off + all_of_them, comparison.base)
    alone = []
    for one, path in zip(found, paths, strict=True):
        if one.pulse.onset < -0.5 or one.pulse.onset + one.pulse.width > n:  # a record's end shows no pulse
            continue
        has, width = one.amplitude != 0, max(math.ceil(one.pulse.width), 4)
        first, end = max(round(one.pulse.onset) - width, 0), min(round(one.pulse.onset) + 2 * width, n)
        besides = (quiet[has, max(first - sides * width, 0) : first], quiet[has, end : end + sides * width])
        noisy = [(b.square().mean(-1).sqrt() > loud * level[has]).any() for b in besides if b.shape[-1] >= width]
        seen = whitened(path, comparison.base)
        own, others = (x[has, first:end].square().sum() for x in (seen, taken - seen))
        if not any(noisy) and float(others) < larger**2 * float(own):
            alone.append(one)
    return alone


def _to_and_fro(pulses: Sequence[FittedPulse]) -> bool:
    """Whether most of them are half waves of something that goes to and fro."""
    near = 4  # widths
    in_time = sorted(pulses, key=lambda one: one.pulse.onset)
    beside = [
        b.pulse.onset - a.pulse.onset < near * max(a.pulse.width, b.pulse.width) for a, b in itertools.pairwise(in_time)
    ]
    return sum(beside) > len(pulses) / 2


def _of_any_length(pulses: Sequence[FittedPulse]) -> bool:
    """Whether stays are of any length, as those of what switches are: as exponential values are, or more."""
    fewest, spread = 8, 1.1  # between the quartiles of the logarithms: of exponential values 1.57
    widths = torch.tensor([one.pulse.width for one in pulses], dtype=torch.float64)
    quartiles = widths.log().quantile(torch.tensor([0.25, 0.75], dtype=torch.float64))
    return len(widths) >= fewest and float(quartiles.diff()) > spread


def _around(comparison: Comparison, recording: Tensor, pulse: Pulse) -> Surroundings:
    return Surroundings.of(recording, comparison.base, round(pulse.onset), pulse.width)


def _path(pulse: Pulse, size: Tensor, n_samples: int) -> Tensor:
    """`(sensor, time)`."""
    path = torch.zeros(len(size), n_samples, dtype=torch.float64)
    first, end = max(math.floor(pulse.onset), 0), min(math.ceil(pulse.onset + pulse.width) + 1, n_samples)
    if end > first:
        path[:, first:end] = size[:, None] * pulse.path(first, end - first)
    return path
