"""A tone that is on for a while: a motor, a fan, a pump that starts and stops."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.decisions import NATS_PER_NUMBER, NEW_TERM_NATS
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.peaks import strongest_peak
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.mechanisms.transients.transient import Transient, kept_of
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.segments import runs_of


@dataclass(frozen=True, eq=False)
class ToneInSpells(Transient):
    """`x_i(t) = cosine_mi cos(2 pi f_m t) + sine_mi sin(2 pi f_m t)` while spell `m` lasts, and nothing between them.

    The other form of a vibration tone, whose phase and frequency are those of each start. Looks like a resonance or a
    line that wanders, which are there all the time, and like several tones near to each other, which beat.

    Attributes:
        start_s, stop_s: Of each spell, s after the first sample, `(spell,)`.
        frequency_hz: `f_m`, `(spell,)`.
        cosine, sine: `(spell, sensor)`, unit of the signal; `t` counts from the first sample.
        duration_s: Of the recording.
    """

    name: ClassVar[str] = "vibration_tone"
    separated_by: ClassVar[str] = "a recording in which it starts and stops more often"
    start_s: Annotated[Tensor, Dims(("spell",))]
    stop_s: Annotated[Tensor, Dims(("spell",))]
    frequency_hz: Annotated[Tensor, Dims(("spell",))]
    cosine: Annotated[Tensor, Dims(("spell", "sensor"))]
    sine: Annotated[Tensor, Dims(("spell", "sensor"))]
    duration_s: float

    @property
    def amplitude(self) -> Tensor:
        """`(spell, sensor)`, unit of the signal."""
        return torch.hypot(self.cosine, self.sine)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        line, peak, info, n = comparison.line, strongest_peak(comparison), comparison.info, comparison.n_samples
        p_value = min(line.p_value, peak.p_value)
        if p_value > level:
            return None
        # The middle of a peak may be bins away from where a tone that is on for long is surely seen.
        inside = line.p_value <= peak.p_value or abs(line.frequency - peak.frequency) < peak.width
        seen = _seen_in_parts(comparison, line.frequency if inside else peak.frequency)
        noise = _noise_near(comparison, seen)
        spells = _spells(comparison, seen, noise)
        if not spells:
            return None
        whole, f = torch.ones(n, dtype=torch.bool), seen * info.rate
        for _ in range(2):  # numbers and ends in turn
            spells = cls._fitted(comparison, spells, [f] * len(spells), whole)._likeliest(comparison, spells, noise)
        effect = cls._fitted(comparison, spells, [f] * len(spells), whole)
        lengths = torch.tensor([stop - start for start, stop in spells], dtype=torch.float64)
        variance = 2 * noise / lengths[:, None]  # of either part of an amplitude, `(spell, sensor)`
        snr = effect.amplitude / variance.sqrt()
        there = included_sensors((snr.square()).sum(0) / len(spells), 2).positions
        outside = torch.ones(comparison.n_sensors, dtype=torch.bool)
        outside[list(there)] = False
        effect = replace(effect, cosine=effect.cosine * ~outside, sine=effect.sine * ~outside)
        gain = float((snr.square() * ~outside).sum()) / 2
        always = VibrationTone.at(comparison, line.frequency * info.rate)
        as_always = float((always.amplitude.square() * ~outside / (4 * noise)).sum()) * n
        numbers = len(spells) * (3 + 2 * len(there)) - 1 - 2 * len(there)
        if gain - NATS_PER_NUMBER * numbers - 2 * len(spells) * math.log(n) < as_always + NEW_TERM_NATS:
            return None
        if not _steady(comparison, effect, spells, seen, noise):
            return None
        if spells[1:] and _of_steady_tones(comparison, seen, noise / ~outside) > gain:  # whose beats come and go
            return None
        longest = int((snr.square() * ~outside).sum(-1).argmax())
        per_sample = float((effect.amplitude[longest].square() / (4 * noise)).sum())  # nats that tell an end of a spell
        reach = Z * max(1.0, 3 / per_sample) / info.rate
        energy = max(float((snr[longest].square() * ~outside).sum()), 1.0)
        frequency = float(effect.frequency_hz[longest])
        spread = Z * math.sqrt(12 / energy) / (2 * math.pi * float(lengths[longest])) * info.rate
        start, stop = float(effect.start_s[longest]), float(effect.stop_s[longest])
        parameters = {
            "frequency": Parameter.around(frequency, spread, "Hz"),
            "start": Parameter.around(start, reach, "s", least=0.0),
            "stop": Parameter.around(stop, reach, "s", most=effect.duration_s),
        }
        for i in there:
            a, sd = float(effect.amplitude[longest, i]), float(variance[longest, i].sqrt())
            parameters[f"amplitude[{i}]"] = Parameter.around(a, Z * sd, info.measure, least=0.0)
        loudest = max(there, key=lambda i: float(effect.amplitude[longest, i]))
        more = f" and {len(spells) - 1} more times, {float(lengths.sum()) / n:.1%} of the time," if spells[1:] else ""
        return effect.found(
            f"a tone at {frequency:.6g} Hz that is on from {start:.5g} s to {stop:.5g} s{more} in "
            f"{info.named(there, 'all sensors')}, of amplitude up to {float(effect.amplitude[longest, loudest]):.3g} "
            f"{info.measure} (sensor {info.sensors[loudest]}), that the simulation does not have: something that "
            "starts and stops",
            p_value,
            there,
            parameters,
            levels=(level_of(seen),),
            frequency_hz=frequency,
            time_s=start,
            gain=gain,
        )

    @classmethod
    def _fitted(
        cls, comparison: Comparison, spells: list[tuple[int, int]], frequency_hz: list[float], keep: Tensor
    ) -> ToneInSpells:
        """With frequencies near to these, of the samples `keep` `(time,)`."""
        rate, tones = comparison.info.rate, []
        for (start, stop), f in zip(spells, frequency_hz, strict=True):
            inside = torch.zeros_like(keep)
            inside[start:stop] = keep[start:stop]
            tones.append(VibrationTone.fitted_to(comparison, _nearest(comparison, f, start, stop), inside))
        ends = torch.tensor(spells, dtype=torch.float64) / rate
        return cls(
            ends[:, 0],
            ends[:, 1],
            torch.tensor([tone.frequency_hz for tone in tones], dtype=torch.float64),
            torch.stack([tone.cosine for tone in tones]),
            torch.stack([tone.sine for tone in tones]),
            comparison.n_samples / rate,
        )

    def _likeliest(self, comparison: Comparison, spells: list[tuple[int, int]], noise: Tensor) -> list[tuple[int, int]]:
        """Spells whose ends are likeliest, between the middles of those before and after."""
        n, rate = comparison.n_samples, comparison.info.rate
        signal = (comparison.recording - comparison.recording.mean(-1, keepdim=True)) / noise[:, None]
        angle, found = 2 * math.pi * torch.arange(n, dtype=torch.float64) / rate, list[tuple[int, int]]()
        middles = [0, *((start + stop) // 2 for start, stop in spells), n]
        for k, (f, cosine, sine) in enumerate(zip(self.frequency_hz, self.cosine, self.sine, strict=True)):
            low, middle, high = middles[k : k + 3]
            part = slice(low, high)
            tone = cosine[:, None] * (f * angle[part]).cos() + sine[:, None] * (f * angle[part]).sin()
            gains = (tone * signal[:, part] - tone.square() / (2 * noise[:, None])).sum(0)
            before, after = gains[: middle - low].flip(0).cumsum(0), gains[middle - low :].cumsum(0)
            start, stop = middle - 1 - int(before.argmax()), middle + 1 + int(after.argmax())
            if found and start < found[-1][1]:  # one ends where the other starts
                start = (spells[k - 1][1] + spells[k][0]) // 2
                found[-1] = (found[-1][0], start)
            found.append((start, stop))
        return found

    def fit_without(self, comparison: Comparison, fold: int) -> ToneInSpells:
        rate = comparison.info.rate
        ends = (torch.stack([self.start_s, self.stop_s], -1) * rate).round().long().tolist()
        spells = [(start, stop) for start, stop in ends]
        found = self._fitted(comparison, spells, self.frequency_hz.tolist(), kept_of(comparison.n_samples, fold))
        there = self.amplitude.any(0)
        return replace(found, cosine=found.cosine * there, sine=found.sine * there)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        f = float(self.frequency_hz[int(self.amplitude[:, sensor].argmax())])
        path = self.path(comparison.n_samples, comparison.info.rate) if fitted else None
        pictures.tone_over_time(ax, comparison, sensor, f, path)

    def drawn(self, n_samples: int, rate: float, generator: torch.Generator) -> Tensor:
        """The same spells from another time on, one after the other as they were, each with a phase of its own."""
        shift = float(torch.rand((), generator=generator, dtype=torch.float64)) * self.duration_s
        turns = 2 * math.pi * torch.rand(len(self.start_s), generator=generator, dtype=torch.float64)
        return self._from(n_samples, rate, shift, turns)

    def path(self, n_samples: int, rate: float) -> Tensor:
        return self._from(n_samples, rate, 0.0, torch.zeros(len(self.start_s), dtype=torch.float64))

    def _from(self, n_samples: int, rate: float, shift: float, turns: Tensor) -> Tensor:
        """`(sensor, time)` from a time of the recording on, which begins anew at its end."""
        t = torch.arange(n_samples, dtype=torch.float64) / rate
        place = (t + shift).remainder(self.duration_s * (1 + 1e-12))  # the last sample is within
        path = torch.zeros(self.cosine.shape[-1], n_samples, dtype=torch.float64)
        rows = zip(self.start_s, self.stop_s, self.frequency_hz, self.cosine, self.sine, turns, strict=True)
        for start, stop, f, cosine, sine, turn in rows:
            on = (place >= start - 0.25 / rate) & (place < stop - 0.25 / rate)
            angle = 2 * math.pi * f.remainder(rate) * t[on] + turn
            path[:, on] += cosine[:, None] * angle.cos() + sine[:, None] * angle.sin()
        return path


def _spells(comparison: Comparison, frequency: float, noise: Tensor) -> list[tuple[int, int]]:
    """Stretches in which a tone is on, samples; none where it is on all the time, or goes up and down.

    Blocks' powers along the gains of the sensors have two levels, one of which is that of the noise.

    Args:
        comparison: Recording and simulation.
        frequency: Of the tone, cycles per sample.
        noise: Density of the noise near it, per sample `(sensor,)`.
    """
    n, most, block = comparison.n_samples, 24, _block(comparison, frequency)
    z = _of_blocks(comparison, frequency, noise)
    on = _on((_gains(z) @ z).abs().square())
    if not bool(on.any()) or bool(on.all()):
        return []
    spells = [(a * block, min(b * block, n)) for a, b in runs_of(on).tolist()]
    return spells if len(spells) <= most else []


def _block(comparison: Comparison, frequency: float) -> int:
    """Samples of a block: six periods at least."""
    return max(comparison.n_samples // 512, math.ceil(6 / min(frequency, 0.5 - frequency)))


def _of_blocks(comparison: Comparison, frequency: float, noise: Tensor) -> Tensor:
    """Complex amplitudes of blocks, of noise of variance one, `(sensor, block)`."""
    block = _block(comparison, frequency)
    count = comparison.n_samples // block
    turned = _turned(comparison, frequency)[:, : count * block].unflatten(-1, (count, block))
    return turned.sum(-1) / (block * noise).sqrt()[:, None]


def _gains(z: Tensor) -> Tensor:
    """Weights of the sensors `(sensor,)` along which amplitudes `(sensor, block)` have most power."""
    return torch.linalg.eigh(z @ z.mH).eigenvectors[:, -1].conj()


def _steady(
    comparison: Comparison, effect: ToneInSpells, spells: list[tuple[int, int]], frequency: float, noise: Tensor
) -> bool:
    """Whether the spells leave noise, in them and between them, but for a seventh: narrow noise keeps no phase."""
    share, block = 1 / 7, _block(comparison, frequency)
    left = comparison.subtract(effect.path(comparison.n_samples, comparison.info.rate))
    z, rest = (_of_blocks(one, frequency, noise) for one in (comparison, left))
    gains = _gains(z)
    before, after = ((gains @ one).abs().square() for one in (z, rest))  # of noise of variance one
    start = block * torch.arange(len(before))
    on = torch.stack([(start >= a) & (start + block <= b) for a, b in spells]).any(0)
    off = ~torch.stack([(start + block > a) & (start < b) for a, b in spells]).any(0)
    if not bool(on.any()) or not bool(off.any()):
        return False
    most = 1 + share * (float(before[on].mean()) - 1) + 2 / math.sqrt(min(int(on.sum()), int(off.sum())))
    return max(float(after[on].mean()), float(before[off].mean())) < most


def _on(power: Tensor) -> Tensor:
    """Which blocks have a tone, `(block,)`, by the likeliest path between two levels (Viterbi).

    Powers are exponential without a tone, and those of a Rice variable with one; levels and path are found in turn.

    Args:
        power: Of the blocks, `(block,)`.
    """
    rounds, cost = 6, math.log(len(power)) + 2  # nats of each change
    order = power.sort().values
    noise, tone = float(order[: len(order) // 4].mean()) * 2, float(order[-len(order) // 10 :].mean())
    on = torch.zeros(len(power), dtype=torch.bool)
    for _ in range(rounds):
        tone = max(tone - noise, noise)
        x = 2 * (power * tone).sqrt() / noise
        gains = (torch.special.i0e(x).log() + x - tone / noise).tolist()
        off_score, on_score, came = 0.0, 0.0, []
        for gain in gains:
            came.append((off_score >= on_score - cost, on_score >= off_score - cost))
            off_score, on_score = max(off_score, on_score - cost), max(on_score, off_score - cost) + gain
        state, path = on_score > off_score, []
        for stayed_off, stayed_on in reversed(came):
            path.append(state)
            state = state if (stayed_on if state else stayed_off) else not state
        on = torch.tensor(path[::-1])
        if not bool(on.any()) or bool(on.all()):
            break
        noise, tone = float(power[~on].mean()), float(power[on].mean())
    return on


def _seen_in_parts(comparison: Comparison, frequency: float) -> float:
    """Frequency near another one at which the parts of a record have most power, cycles per sample.

    A tone that starts in another phase each time may have nothing where it is in the spectrum of the whole.
    """
    reach, padding = 2, 4  # in bins of a part
    powers = _powers_of_parts(comparison, padding)
    place = torch.arange(powers.shape[-1], dtype=torch.float64) / (2 * (powers.shape[-1] - 1))
    near = ((place - frequency).abs() <= reach * padding * place[1]) & (place > 0) & (place < 0.5)
    power = powers[..., near].sum(1) / comparison.base.spectrum(place[near])
    return float(place[near][power.sum(0).argmax()])


def _noise_near(comparison: Comparison, frequency: float) -> Tensor:
    """Density of the noise near a tone, per sample `(sensor,)`: the median of parts.

    It starts or stops in few of them; in the spectrum of the whole it would be its own noise.
    """
    gap, reach = 3, 12  # bins of a part
    powers = _unpadded_powers(comparison)
    place = torch.arange(powers.shape[-1], dtype=torch.float64) / (2 * (powers.shape[-1] - 1))
    away = (place - frequency).abs() / place[1]
    near = (away > gap) & (away <= reach) & (place > 0)
    return powers[..., near].flatten(1).median(-1).values / math.log(2)


@derived
def _unpadded_powers(comparison: Comparison) -> Tensor:
    """For the noise near each of the spells, and of the folds."""
    return _powers_of_parts(comparison, 1)


def _powers_of_parts(comparison: Comparison, padding: int) -> Tensor:
    """Densities per sample of the 32 parts of a recording under a Hann taper, `(sensor, part, bin)`."""
    parts = 32
    length = comparison.n_samples // parts // 2 * 2
    blocks = comparison.recording[:, : parts * length].unflatten(-1, (parts, length))
    taper = torch.hann_window(length, dtype=torch.float64)
    transform = torch.fft.rfft((blocks - blocks.mean(-1, keepdim=True)) * (taper / taper.norm()), n=padding * length)
    return squared_modulus(transform)


def _of_steady_tones(comparison: Comparison, frequency: float, noise: Tensor) -> float:
    """Nats of three tones near to one another that are there all the time, the strongest first.

    Args:
        comparison: Recording and simulation.
        frequency: Near which they are, cycles per sample.
        noise: Density of the noise near it, per sample `(sensor,)`; infinite in sensors that do not count.
    """
    n, reach, padding, gained = comparison.n_samples, 64, 4, 0.0  # reach: bins to either side
    turned = _turned(comparison, frequency)
    t = torch.arange(n, dtype=torch.float64) / (padding * n)
    for _ in range(3):
        transform = torch.fft.fft(turned, n=padding * n)
        near = torch.cat([transform[:, : reach * padding], transform[:, -reach * padding :]], -1)
        gains = (near.abs().square() / (n * noise[:, None])).sum(0)
        best = int(gains.argmax())
        gained += float(gains[best])
        bin_ = best if best < reach * padding else best - 2 * reach * padding
        tone = torch.polar(torch.ones_like(t), 2 * math.pi * bin_ * t)
        turned = turned - near[:, best, None] / n * tone
    return gained


def _turned(comparison: Comparison, frequency: float) -> Tensor:
    """The recording turned back by a frequency, `(sensor, time)`."""
    angle = 2 * math.pi * frequency * torch.arange(comparison.n_samples, dtype=torch.float64)
    signal = comparison.recording - comparison.recording.mean(-1, keepdim=True)
    return signal * torch.polar(torch.ones_like(angle), -angle)


def _nearest(comparison: Comparison, frequency_hz: float, start: int, stop: int) -> float:
    """Frequency of the highest ordinate of a stretch, within a few of its bins or two dozen of the record's, Hz."""
    padded, rate, n = 4, comparison.info.rate, stop - start
    bins = max(3, math.ceil(24 * n / comparison.n_samples))
    turned = _turned(comparison, frequency_hz / rate)[:, start:stop]
    weights = 1 / _noise_near(comparison, frequency_hz / rate)
    power = (torch.fft.fft(turned, n=padded * n).abs().square() * weights[:, None]).sum(0)
    reach = min(bins * padded, (padded * n - 1) // 2)  # a spell may be a few samples long
    near = torch.arange(-reach, reach + 1)
    frequencies = frequency_hz + near / (padded * n) * rate
    inside = (frequencies > 0) & (frequencies < rate / 2)  # the bins of a short spell are wide
    return float(frequencies[inside][power[near][inside].argmax()])
