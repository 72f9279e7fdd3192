"""A tone whose frequency moves: a motor that runs up or down, or from one speed to another."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.detectors.moving.moving_lines import (
    MovingLine,
    lines_that_rest,
    moving_line,
    moving_line_p_value,
    straight_line,
)
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.transients.carrier import Carrier
from gyrofuse.mismatch.mechanisms.transients.transient import Transient, kept_of, path_gain
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak
from gyrofuse.mismatch.stats.segments import runs_of

_MOVES = 1.25  # highest over lowest frequency, from which a tone moves and does not wander


@dataclass(frozen=True, eq=False)
class Chirp(Transient):
    """`x_i(t) = Re A_i(t) exp(i phi(t))` with `phi' = 2 pi f(t)`, `f` and `A` on straight lines between knots.

    One source: the `A_i` have one course. Unlike that of a tone which wanders, the frequency goes somewhere, by a
    quarter at least.

    Attributes:
        time_s: Knots, s after the first sample, `(knot,)`.
        frequency_hz: `f` there, `(knot,)`.
        cosine, sine: Real part of `A` there and its imaginary part times -1, unit of the signal, `(knot, sensor)`.
    """

    name: ClassVar[str] = "chirp"
    separated_by: ClassVar[str] = "the speed of the motor, logged"
    happened_once: ClassVar[bool] = True
    time_words: ClassVar[str] = "is there from"
    time_s: Annotated[Tensor, Dims(("knot",))]
    frequency_hz: Annotated[Tensor, Dims(("knot",))]
    cosine: Annotated[Tensor, Dims(("knot", "sensor"))]
    sine: Annotated[Tensor, Dims(("knot", "sensor"))]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        lines = ((moving_line_p_value(comparison), moving_line(comparison.observed)), straight_line(comparison))
        info, n = comparison.info, comparison.n_samples
        p_value = sidak(min(p for p, _ in lines), 2)
        if p_value > level:
            return None
        seen = [*(line for p, line in lines if sidak(p, 2) <= level), *lines_that_rest(comparison)]
        courses = [_course(line, n) for line in seen if line is not None]
        tried = [cls._of_course(comparison, *course)._followed(comparison) for course in courses if course is not None]
        if not tried:
            return None
        effect = max(tried, key=lambda one: one._gain(comparison) - one._cost())
        first, last = max(float(effect.time_s[0]), 0.0), min(float(effect.time_s[-1]), n / info.rate)
        samples = (last - first) * info.rate
        sd = (2 * effect._noise(comparison) / samples).sqrt()  # of an amplitude throughout
        size = effect._level() * effect._beyond_noise(comparison)
        there = included_sensors((size / sd).square(), 2).positions
        outside = torch.ones(comparison.n_sensors, dtype=torch.bool)
        outside[list(there)] = False
        effect = effect._shrunk(comparison, ~outside)
        gain = effect._gain(comparison) - effect._cost()
        if gain <= 0:
            return None
        step = float(effect.time_s[1] - effect.time_s[0])
        start, stop = np.interp([first, last], effect.time_s.numpy(), effect.frequency_hz.numpy()).tolist()
        reach = 1 / (4 * step)  # a quarter of a bin of two steps
        parameters = {
            "start": Parameter.around(first, 4 * step, "s", least=0.0),
            "stop": Parameter.around(last, 4 * step, "s", most=n / info.rate),
            "start_frequency": Parameter.around(start, reach, "Hz", least=0.0),
            "stop_frequency": Parameter.around(stop, reach, "Hz", least=0.0),
        }
        for i in there:
            a, own = float(size[i]), Z * float(sd[i])
            parameters[f"amplitude[{i}]"] = Parameter.around(a, own, info.measure, least=0.0)
        loudest = max(there, key=lambda i: float(size[i]))
        does = "runs up" if stop > start * _MOVES else "runs down" if start > stop * _MOVES else "changes its speed"
        return effect.found(
            f"a tone whose frequency moves from {start:.4g} Hz at {first:.4g} s to {stop:.4g} Hz at {last:.4g} s in "
            f"{info.named(there, 'all sensors')}, of amplitude {float(size[loudest]):.3g} {info.measure} (sensor "
            f"{info.sensors[loudest]}), that the simulation does not have: something that {does}",
            p_value,
            there,
            parameters,
            levels=tuple(sorted({level_of(max(f / info.rate, 1 / n)) for f in (start, stop)})),
            time_s=first,
            gain=gain,
        )

    @classmethod
    def _of_course(cls, comparison: Comparison, time: Tensor, frequency: Tensor) -> Chirp:
        """Without amplitudes, of times in samples and frequencies in cycles per sample."""
        rate = comparison.info.rate
        none = torch.zeros(len(time), comparison.n_sensors, dtype=torch.float64)
        return cls(time / rate, frequency * rate, none, none)

    def _followed(self, comparison: Comparison) -> Chirp:
        """Fitted to all samples, its frequency straightened as long as that explains more, its ends cut."""
        first = self._often_straightened(comparison)
        again = first._going_on()._often_straightened(comparison)
        return max(first, again, key=lambda fit: fit._gain(comparison))._trimmed(comparison)

    def _often_straightened(self, comparison: Comparison) -> Chirp:
        tried, rounds = [self._fitted(comparison)], 5
        for _ in range(rounds):
            tried.append(tried[-1]._straightened(comparison))
        return max(tried, key=lambda fit: fit._gain(comparison))

    def _going_on(self) -> Chirp:
        """With the frequencies of the outermost knots on a line through those beside them: ends have fewer samples."""
        outer, several, frequency = 2, 4, self.frequency_hz.clone()
        if len(frequency) < 2 * (outer + several):
            return self
        k = torch.arange(len(frequency), dtype=torch.float64)
        ends = ((k < outer, slice(outer, outer + several)), (k >= len(k) - outer, slice(-outer - several, -outer)))
        for end, beside in ends:
            x, y = k[beside] - k[beside].mean(), frequency[beside]
            line = y.mean() + (x @ y) / x.square().sum() * (k - k[beside].mean())
            frequency = torch.where(end, line, frequency)
        return replace(self, frequency_hz=frequency.clamp(min=0.0))

    def _gain(self, comparison: Comparison) -> float:
        """Log likelihood ratio to none, nats."""
        return path_gain(comparison, self.path(comparison.n_samples, comparison.info.rate))

    def _cost(self) -> float:
        """Nats that so many numbers gain by chance, and more."""
        return NATS_PER_NUMBER * (2 * len(self.time_s) + int(self.cosine.any(0).sum()))

    def _fitted(self, comparison: Comparison, keep: Tensor | None = None) -> Chirp:
        """With the amplitudes of the samples to keep `(time,)`, by default of all, of one source."""
        signal = comparison.recording - comparison.recording.mean(-1, keepdim=True)
        carrier = self._carrier(comparison.n_samples, comparison.info.rate)
        amplitude = carrier.amplitudes(signal, self._noise(comparison).sqrt(), keep)
        return replace(self, cosine=amplitude.real, sine=-amplitude.imag)

    def _beyond_noise(self, comparison: Comparison) -> float:
        """Factor of the amplitude that is not what noise makes of one course at so many knots."""
        by_noise = float(self._by_noise(comparison).mean())
        seen = float((self._level().square() / self._noise(comparison)).sum())
        return math.sqrt(max(1 - by_noise / max(seen, 1e-300), 0.0))

    def _by_noise(self, comparison: Comparison) -> Tensor:
        """Squared amplitude that noise makes of one course at each knot, in units of its density, `(knot,)`."""
        return self._carrier(comparison.n_samples, comparison.info.rate).by_noise()

    def _shrunk(self, comparison: Comparison, there: Tensor) -> Chirp:
        """In some sensors `(sensor,)`, and by as much smaller as noise has a share of the power of its amplitudes."""
        share = self._beyond_noise(comparison) ** 2 * there
        return replace(self, cosine=self.cosine * share, sine=self.sine * share)

    def _straightened(self, comparison: Comparison) -> Chirp:
        """With what the phases of neighbouring amplitudes say of the frequency between them."""
        amplitude = torch.complex(self.cosine, -self.sine)
        weight = 1 / self._noise(comparison)
        both = ((amplitude[1:] * amplitude[:-1].conj()).to(torch.complex128) * weight).sum(-1)  # (knot - 1,)
        near = torch.nn.functional.pad(both, (1, 1))
        step, loud = float(self.time_s[1] - self.time_s[0]) * comparison.info.rate, 200.0  # squared phases of 1 / loud
        smooth = near[:-2] + 2 * both + near[2:]  # single ones of a faint tone are noise
        off = torch.where(both.abs() * step > loud, both, smooth).angle() / (2 * math.pi * self.time_s.diff())
        off = torch.cat([off[:1], (off[1:] + off[:-1]) / 2, off[-1:]])
        moved = replace(self, frequency_hz=(self.frequency_hz + off).clamp(min=0.0, max=comparison.info.rate / 2))
        return moved._fitted(comparison)

    def _trimmed(self, comparison: Comparison) -> Chirp:
        """Without the knots of either end in which noise has as much power, but one."""
        power = ((self.cosine.square() + self.sine.square()) / self._noise(comparison)).sum(-1)
        beyond = torch.nn.functional.pad(power / self._by_noise(comparison), (1, 1))
        there = ((beyond[:-2] + beyond[1:-1] + beyond[2:]) > 8).nonzero()[:, 0]  # of noise 3 on average
        if len(there) < 2:
            return self
        kept = slice(max(int(there[0]) - 1, 0), int(there[-1]) + 2)
        time, frequency, cosine, sine = (x[kept] for x in (self.time_s, self.frequency_hz, self.cosine, self.sine))
        return Chirp(time, frequency, cosine, sine)._fitted(comparison)

    def _noise(self, comparison: Comparison) -> Tensor:
        """Density of the noise in the middle of the course, per sample `(sensor,)`."""
        f = self.frequency_hz.median()[None] / comparison.info.rate
        return comparison.base.spectrum(f)[:, 0]

    def _level(self) -> Tensor:
        """Root mean square of the amplitude, `(sensor,)`."""
        return (self.cosine.square() + self.sine.square()).mean(0).sqrt()

    def _carrier(self, n_samples: int, rate: float) -> Carrier:
        """Its phase, and its knots."""
        first = max(math.ceil(float(self.time_s[0]) * rate - 1e-6), 0)
        last = min(math.floor(float(self.time_s[-1]) * rate + 1e-6), n_samples - 1)
        t = torch.arange(first, max(last + 1, first), dtype=torch.float64) / rate
        step = self.time_s.diff()
        inside = (torch.bucketize(t, self.time_s, right=True) - 1).clamp(0, len(step) - 1)
        after = t - self.time_s[inside]
        share = (after / step[inside].clamp(min=1e-12)).clamp(0.0, 1.0)
        rise = self.frequency_hz.diff()
        cycles = torch.nn.functional.pad(
            ((self.frequency_hz[1:] + self.frequency_hz[:-1]) / 2 * step).cumsum(0), (1, 0)
        )
        angle = 2 * math.pi * (cycles[inside] + after * (self.frequency_hz[inside] + rise[inside] * share / 2))
        return Carrier(first, inside, (1 - share, share), torch.polar(torch.ones_like(angle), angle), len(self.time_s))

    def _path(self, n_samples: int, rate: float, turned: float) -> Tensor:
        amplitude = torch.complex(self.cosine, -self.sine) * complex(math.cos(turned), math.sin(turned))
        return self._carrier(n_samples, rate).path(amplitude, n_samples)

    def path(self, n_samples: int, rate: float) -> Tensor:
        return self._path(n_samples, rate, 0.0)

    def drawn(self, n_samples: int, rate: float, generator: torch.Generator) -> Tensor:
        """The same course at the same time, in another phase."""
        turn = 2 * math.pi * float(torch.rand((), generator=generator, dtype=torch.float64))
        return self._path(n_samples, rate, turn)

    def fit_without(self, comparison: Comparison, fold: int) -> Chirp:
        there = self.cosine.any(0) | self.sine.any(0)
        return self._fitted(comparison, kept_of(comparison.n_samples, fold))._shrunk(comparison, there)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        low, high = float(self.frequency_hz.min()), float(self.frequency_hz.max())
        track = (self.time_s, self.frequency_hz) if fitted else None
        window = 2 * float(self.time_s[1] - self.time_s[0])
        pictures.spectrogram(ax, comparison, sensor, (low - (high - low) / 4, high + (high - low) / 4), window, track)


def _course(line: MovingLine, n_samples: int) -> tuple[Tensor, Tensor] | None:
    """Knots of the longest stretch in which a tone moves, samples, and their frequencies; None without one.

    It moves by a quarter at least, and back and forth by twice as much as from end to end at most.
    """
    fewest = 8  # segments of a path, and bins that it moves by
    best: tuple[Tensor, Tensor] | None = None
    for a, b in runs_of(~line.path.isnan()).tolist():
        path = line.path[a:b]
        reach = float(path.max() - path.min())
        if b - a < fewest or float(path.max()) < _MOVES * float(path.min()) or reach * line.length < fewest:
            continue
        parts = torch.stack([part.mean() for part in path.tensor_split(min(12, b - a))])
        if float(parts.diff().abs().sum()) > 2 * float(parts.max() - parts.min()):
            continue
        if best is not None and len(path) * line.length <= float(best[0][-1] - best[0][0]):
            continue
        half = line.length // 2
        # It may begin or end in segments beside, and what is left of the record is less than one.
        beside = 3
        first, last = max(a - beside, 0) * line.length, (b + beside) * line.length
        last = min(last, n_samples + half) if last <= n_samples - line.length else n_samples + half
        time = torch.arange(first, last + 1, half, dtype=torch.float64)
        middles = (torch.arange(a, b, dtype=torch.float64) + 0.5) * line.length
        best = time, _interpolated(time, middles, path)
    return best


def _interpolated(at: Tensor, knots: Tensor, path: Tensor) -> Tensor:
    """Means of three neighbours, since bins are whole, on straight lines between knots, and on as the ends go."""
    several = 8  # knots of an end, whose line is gone on with
    values = path.clone()
    values[1:-1] = (path[:-2] + path[1:-1] + path[2:]) / 3
    k = (torch.bucketize(at, knots) - 1).clamp(0, len(knots) - 2)
    slope = (values[k + 1] - values[k]) / (knots[k + 1] - knots[k])
    found = values[k] + slope * (at - knots[k])
    for part, beyond in ((slice(several), at < knots[1]), (slice(-several, None), at > knots[-2])):
        x, y = knots[part] - knots[part].mean(), path[part]
        line = y.mean() + (x @ y) / x.square().sum() * (at - knots[part].mean())
        found = torch.where(beyond, line, found)
    return found.clamp(0.0, 0.5)
