"""A tone that sets in at once and dies away, fitted to the samples around it.

    x_i(t) = exp(-(t - t0) / tau) [cosine_i cos(2 pi f (t - t0)) + sine_i sin(2 pi f (t - t0))],   t >= t0,

Samples and tones are whitened by the simulation's spectra, times what octaves of the noise before and after have over
them; the level of the noise is that of the samples themselves, so that the log likelihood ratio of a sensor is
`m/2 log(RSS0 / RSS)` for `m` samples.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import fft, optimize
from torch import Tensor

from gyrofuse.mismatch.likelihoods.noise_near import noise_around
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum


class DampedTone(NamedTuple):
    """One tone.

    Attributes:
        onset: `t0`, samples.
        frequency: `f`, cycles per sample.
        tau: Samples.
    """

    onset: int
    frequency: float
    tau: float

    @property
    def gone_after(self) -> int:
        """Sample from which it is no more."""
        return self.onset + math.ceil(12 * self.tau)  # exp(-12): a hundredth of the noise beside one of 1600 sd

    def paths(self, first: int, n: int) -> Tensor:
        """Cosine and sine at `n` samples from a first one on, `(2, time)`."""
        t = torch.arange(n, dtype=torch.float64) + first - self.onset
        angle, decay = 2 * math.pi * self.frequency * t, torch.exp(-t.clamp(min=0) / self.tau) * (t >= 0)
        return torch.stack([decay * angle.cos(), decay * angle.sin()])

    def ordinates(self, first: int, n: int, k: Tensor) -> Tensor:
        """Orthonormal DCT-II of cosine and sine at `n` samples from a first one on, `(2, k)`, as a geometric series."""
        turn = cmath.exp(complex(-1 / self.tau, 2 * math.pi * self.frequency))
        start = max(self.onset - first, 0)
        theta = math.pi / n * k
        turns = [_turned(samples * theta) for samples in (start + 0.5, n - start, 1)]
        total = torch.zeros(len(k), dtype=torch.complex128)
        for begin, end, one in (turns, [each.conj() for each in turns]):
            total += begin * (1 - turn ** (n - start) * end) / (1 - turn * one)
        return torch.view_as_real(turn ** (start + first - self.onset) / math.sqrt(2 * n) * total).mT


class FittedTone(NamedTuple):
    """A tone with its sizes.

    Attributes:
        tone: Onset, frequency and time constant.
        size: Of cosine and sine, `(2, sensor)`.
        log_ratio: Log likelihood ratio of each sensor, `(sensor,)`.
    """

    tone: DampedTone
    size: Tensor
    log_ratio: Tensor


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Samples around a tone.

    Attributes:
        base: Noise of the simulation.
        first: Position of the first sample.
        samples: `(sensor, time)`.
        near: Density of the noise near them over the simulation's, from 0 to half the rate, `(sensor, bin)`.
        keep: Those to be used, `(time,)`; all by default.
    """

    base: NoiseSpectrum
    first: int
    samples: Tensor
    near: Tensor
    keep: Tensor | None = None

    @classmethod
    def of(cls, recording: Tensor, base: NoiseSpectrum, onset: int, tau: float) -> Surroundings:
        """Of a recording `(sensor, time)`, as far as it goes."""
        before, after = (round(times * tau) + 64 for times in (6, 10))  # where it is not yet, and no more
        first, end = max(onset - before, 0), min(onset + after, recording.shape[-1])
        return cls(base, first, recording[:, first:end], noise_around(recording, base, onset, tau))

    def without(self, turn: int, of: int) -> Surroundings:
        """Without every so many-th sample, to be judged by."""
        return replace(self, keep=(torch.arange(self.samples.shape[-1]) + self.first) % of != turn)

    @cached_property
    def white(self) -> Tensor:
        """Whitened samples, `(sensor, time)`."""
        return torch.from_numpy(fft.idct(self._ordinates.numpy(), norm="ortho", axis=-1))

    @cached_property
    def _ordinates(self) -> Tensor:
        """Whitened cosine ordinates, `(sensor, ordinate)`."""
        return torch.from_numpy(fft.dct(self.samples.numpy(), norm="ortho", axis=-1)) * self._factors

    @cached_property
    def _factors(self) -> Tensor:
        """What whitens cosine ordinates, `(sensor, ordinate)`, and takes the mean off."""
        n = self.samples.shape[-1]
        near = torch.nn.functional.interpolate(self.near[:, None], n, mode="linear", align_corners=True)[:, 0]
        factors = (self.base.of_ordinates(n) * near).rsqrt()
        factors[:, 0] = 0.0
        return factors

    @cached_property
    def _own(self) -> Tensor:
        """What is explained, `(sensor, value)`: ordinates, or whitened samples where some are left out."""
        return self._ordinates if self.keep is None else self.white[:, self.keep]

    def _seen(self, paths: Tensor) -> Tensor:
        """Paths `(path, time)` as they show there, `(sensor, path, value)`."""
        seen = torch.from_numpy(fft.dct(paths.numpy(), norm="ortho", axis=-1)) * self._factors[:, None]
        if self.keep is None:
            return seen
        return torch.from_numpy(fft.idct(seen.numpy(), norm="ortho", axis=-1))[..., self.keep]

    def _tone_paths(self, *tones: DampedTone) -> Tensor:
        """`(path, time)`."""
        return torch.cat([tone.paths(self.first, self.samples.shape[-1]) for tone in tones])

    def regression(self, paths: Tensor) -> tuple[Tensor, Tensor]:
        """Sizes `(path, sensor)` and log likelihood ratios `(sensor,)` of paths `(path, time)`."""
        return self._regressed(self._own, self._seen(paths))

    def each(self, paths: Tensor) -> Tensor:
        """Log likelihood ratios `(path, sensor)` of paths `(path, time)`, each by itself."""
        y, at_once = self._own, 32
        total = y.square().sum(-1, keepdim=True)
        found = []
        for some in paths.split(at_once):
            x = self._seen(some)
            explained = (x @ y[..., None])[..., 0].square() / x.square().sum(-1).clamp(min=1e-300)
            found.append(y.shape[-1] / 2 * (total / (total - explained).clamp(min=1e-12 * total)).log())
        return torch.cat(found, -1).mT

    def _regressed(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Of values `(sensor, value)`, all or those that matter, and what paths show there, `(sensor, path, value)`."""
        gram = x @ x.mT
        ridge = 1e-10 * gram.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=1e-300)  # of a sine at half the rate
        gram = gram + ridge[:, None, None] * torch.eye(x.shape[1], dtype=gram.dtype)
        seen = (x @ y[..., None])[..., 0]
        size = torch.linalg.solve(gram, seen)
        total = self._own.square().sum(-1)
        left = (total - (size * seen).sum(-1)).clamp(min=1e-12 * total)
        return size.mT, self._own.shape[-1] / 2 * (total / left).log()

    def _gain(self, which: list[int], *tones: DampedTone) -> float:
        """Log likelihood ratio of tones in some sensors, from the ordinates near them."""
        if self.keep is not None:
            return float(self.regression(self._tone_paths(*tones))[1][which].sum())
        n, widths = self.samples.shape[-1], 256  # inverse time constants: all but 1/2500 of a tone's power are nearer
        near = [(2 * n * tone.frequency, 2 * n * widths / tone.tau) for tone in tones]
        low, high = min(k - reach for k, reach in near), max(k + reach for k, reach in near)
        some = slice(max(int(low), 1), min(int(high) + 1, n))
        k = torch.arange(some.start, some.stop, dtype=torch.float64)
        paths = torch.cat([tone.ordinates(self.first, n, k) for tone in tones])
        return float(self._regressed(self._ordinates[:, some], paths * self._factors[:, None, some])[1][which].sum())

    def of_tone(self, tone: DampedTone) -> FittedTone:
        """With the sizes that fit best."""
        return FittedTone(tone, *self.regression(self._tone_paths(tone)))

    def fitted(self, start: DampedTone, sensors: Sequence[int] | None = None) -> FittedTone:
        """The likeliest onset, frequency and time constant near those of a start, in some sensors or all."""
        which = list(range(len(self.samples)) if sensors is None else sensors)
        best = self._onset(start, which, math.ceil(start.tau), max(round(start.tau / 8), 1))
        step = max(round(start.tau / 8), 1)
        while True:
            best = self._numbers(best, which)
            if step == 1:
                return self.of_tone(self._onset(best, which, 2, 1))
            best, step = self._onset(best, which, 2 * step, max(step // 4, 1)), max(step // 4, 1)

    def two_modes(self, start: FittedTone, sensors: Sequence[int], wanted: float) -> tuple[FittedTone, FittedTone]:
        """Two tones near a start that set in together: they beat, and seem to grow before they die away.

        The log likelihood ratio of both is that of the first; the second has what it adds. Far from what is wanted
        nothing is tried between onsets half a time constant apart.
        """
        hopeless = 0.7  # of it: onsets between gain a fifth at most
        which, tone = list(sensors), start.tone
        onsets = [tone.onset - round(k / 2 * tone.tau) for k in range(-1, 5)]
        step = max(round(tone.tau / 8), 1)
        while True:
            tried = [self._beating(tone._replace(onset=onset), which) for onset in onsets]
            gain, first, second = max(tried, key=lambda one: one[0])
            if step == 1 or gain < hopeless * wanted:
                break
            tone, step, onsets = first, max(step // 3, 1), [first.onset + k * step for k in (-2, -1, 0, 1, 2)]
        return self._both(first, second)

    def _both(self, first: DampedTone, second: DampedTone) -> tuple[FittedTone, FittedTone]:
        """Two tones with the sizes that fit best together."""
        size, log_ratio = self.regression(self._tone_paths(first, second))
        alone = self.of_tone(first).log_ratio
        return FittedTone(first, size[:2], log_ratio), FittedTone(second, size[2:], (log_ratio - alone).clamp(min=0))

    def _beating(self, tone: DampedTone, which: list[int]) -> tuple[float, DampedTone, DampedTone]:
        """Log likelihood ratio, and frequencies and time constants of two tones at an onset."""
        apart = 0.3  # frequencies to begin with, in inverse time constants

        def at(point: NDArray[np.float64]) -> tuple[DampedTone, DampedTone]:
            first, second = (self._moved(tone, float(point[k]), float(point[2 + k])) for k in (0, 1))
            return first, second

        def loss(point: NDArray[np.float64]) -> float:
            return -self._gain(which, *at(point))

        start = np.array([-apart / 2, apart / 2, 0.0, 0.0])
        simplex = np.stack(
            [start, *(start + move * row for move, row in zip((0.15, 0.15, 0.4, 0.4), np.eye(4), strict=True))]
        )
        found = optimize.minimize(
            loss, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 120, "fatol": 1e-2}
        )
        return -float(found.fun), *at(found.x)

    def two_knocks(self, start: FittedTone, sensors: Sequence[int]) -> tuple[FittedTone, FittedTone]:
        """One mode that is struck once more before it has died away, as `two_modes` gives them."""
        which, tone = list(sensors), start.tone
        tried = [
            (one, one._replace(onset=one.onset + round(k * one.tau)))
            for one in (tone._replace(tau=factor * tone.tau) for factor in (0.4, 0.7, 1.0))
            for k in (-6.0, -4.0, -2.8, -2.0, -1.4, -1.0, -0.5, 0.5, 1.0, 1.4, 2.0, 2.8, 4.0, 6.0, 8.0)
        ]
        first, second = max(tried, key=lambda both: self._gain(which, *both))
        step = max(round(first.tau / 8), 1)
        while True:
            first = self._numbers(first, which, second)
            second = first._replace(onset=second.onset)
            second = self._onset(second, which, 2 * step, step, first)
            first = self._onset(first, which, 2 * step, step, second)
            if step == 1:
                break
            step = max(step // 4, 1)
        return self._both(first, second)

    def refined(self, start: DampedTone, sensors: Sequence[int]) -> FittedTone:
        """The likeliest frequency and time constant next to those of a start, at its onset: by Gauss and Newton."""
        best, most = self.of_tone(start), 4  # steps
        concerned = torch.zeros(len(self.samples), dtype=torch.bool)
        concerned[list(sensors)] = True
        for _ in range(most):
            step = self._step(best._replace(size=best.size * concerned))
            found = self.of_tone(self._moved(best.tone, float(step[0]), float(step[1])))
            more = float((found.log_ratio - best.log_ratio)[concerned].sum())
            if more > 0:
                best = found
            if more < 1e-2:  # nats
                break
        return best

    def _onset(self, tone: DampedTone, which: list[int], reach: int, step: int, *others: DampedTone) -> DampedTone:
        last = self.first + self.samples.shape[-1] - 2
        onsets = {min(max(tone.onset + k, self.first), last) for k in range(-reach, reach + 1, step)}
        tried = [tone._replace(onset=onset) for onset in sorted(onsets)]
        return max(tried, key=lambda one: self._gain(which, one, *others))

    def _numbers(self, tone: DampedTone, which: list[int], *again: DampedTone) -> DampedTone:
        """Frequency and time constant of an onset, and of those where the same mode is struck again."""

        def at(point: NDArray[np.float64]) -> DampedTone:
            return self._moved(tone, float(point[0]), float(point[1]))

        simplex = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.4]])
        found = optimize.minimize(
            lambda point: -self._gain(which, *(at(point)._replace(onset=one.onset) for one in (tone, *again))),
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": 60, "xatol": 1e-3, "fatol": 1e-3},
        )
        return at(found.x)

    def _moved(self, tone: DampedTone, by: float, factor: float) -> DampedTone:
        """With a frequency moved by so many inverse time constants, and a time constant by a factor's logarithm."""
        shortest, longest = 2.0, self.samples.shape[-1] / 4  # samples; one that takes longer is not seen to die away
        tau = min(max(tone.tau * math.exp(min(max(factor, -5.0), 5.0)), shortest), longest)
        return tone._replace(frequency=min(max(tone.frequency + by / tone.tau, 0.0), 0.5), tau=tau)

    def sd(self, found: FittedTone) -> tuple[float, float, Tensor]:
        """Standard deviations of frequency, of the logarithm of the time constant, and of the sizes `(2, sensor)`.

        By the information of all numbers together; the onset is taken for known.
        """
        covariance, _ = self._information(found)
        sd = covariance.diagonal().clamp(min=0).sqrt()
        return float(sd[0] / found.tone.tau), float(sd[1]), sd[2:].view(-1, 2).mT

    def _step(self, found: FittedTone) -> Tensor:
        """By which frequency, in inverse time constants, and the logarithm of the time constant move; all sizes do."""
        covariance, score = self._information(found)
        return (covariance @ score)[:2]

    def _information(self, found: FittedTone) -> tuple[Tensor, Tensor]:
        """Covariance and score of frequency in inverse time constants, logarithm of the time constant, and sizes."""
        tone, y, x = found.tone, self._own, self._seen(self._tone_paths(found.tone))  # (sensor, path, value)
        step = 1e-4
        nearby = (
            tone._replace(frequency=tone.frequency + step / tone.tau),
            tone._replace(tau=tone.tau * math.exp(step)),
        )
        size = found.size.mT[..., None]  # (sensor, path, 1)
        here = (size * x).sum(1)
        slopes = [((size * self._seen(self._tone_paths(other))).sum(1) - here) / step for other in nearby]
        left = y - here
        noise = left.square().mean(-1)
        p = len(y)
        information, score = torch.zeros(2 + 2 * p, 2 + 2 * p, dtype=y.dtype), torch.zeros(2 + 2 * p, dtype=y.dtype)
        for i in range(p):
            rows = torch.cat([torch.stack([slope[i] for slope in slopes]), x[i]])
            at = torch.tensor([0, 1, 2 + 2 * i, 3 + 2 * i])
            information[at[:, None], at] += rows @ rows.mT / noise[i]
            score[at] += rows @ left[i] / noise[i]
        scale = information.diagonal().clamp(min=1e-300).rsqrt()
        covariance = torch.linalg.pinv(information * scale * scale[:, None], hermitian=True) * scale * scale[:, None]
        return covariance, score

    def other_courses(self, found: FittedTone, sensors: Sequence[int]) -> float:
        """Log likelihood ratio of what is no ring-down.

        One sample, a step, noise that is louder for a while, a tone that swells and dies away, or lasts and stops.
        """
        which, n, tone = list(sensors), self.samples.shape[-1], found.tone
        t = torch.arange(n, dtype=torch.float64) + self.first - tone.onset
        y = self.white[which]
        step = self.regression((t >= 0).to(torch.float64)[None])[1][which].sum()

        angle = 2 * math.pi * tone.frequency * t

        def within(envelope: Tensor) -> Tensor:
            return self.regression(torch.stack([envelope * angle.cos(), envelope * angle.sin()]))[1][which].sum()

        def swelling(middle: float, power: int, width: float) -> Tensor:
            return within(torch.exp(-((t - middle).abs() / width).pow(power)))

        widths = ((1, 0.35), (1, 0.7), (1, 1.4), (2, 0.5), (2, 1.0), (2, 2.0))
        grown = [swelling(k / 2 * tone.tau, power, w * tone.tau) for k in range(-1, 5) for power, w in widths]
        lasting = _lasting(y * _turned(-angle))
        return max(float(torch.stack([step, *grown, lasting]).max()), self.of_no_course(which))

    def explained(self, found: FittedTone) -> Tensor:
        """Share of the energy of whitened samples that a tone explains, `(sensor,)`, from its likelihood ratios."""
        return 1 - torch.exp(-2 / self._own.shape[-1] * found.log_ratio)

    def of_no_course(self, sensors: Sequence[int]) -> float:
        """Log likelihood ratio of one sample that is off, or of noise that is louder for a while."""
        y = self.white[list(sensors)]
        total = y.square().sum(-1, keepdim=True)
        one = y.shape[-1] / 2 * (total / (total - y.square()).clamp(min=1e-12 * total)).log().sum(0).max()
        return float(torch.maximum(one, _louder(y)))


def _turned(angle: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(angle), angle)


def _lasting(turned: Tensor) -> Tensor:
    """Log likelihood ratio of a steady tone in the likeliest stretch of samples turned back by it, `(sensor, time)`."""
    n, ends = turned.shape[-1], 97
    at = torch.linspace(0, n, ends).round().long()
    sums = torch.nn.functional.pad(turned.cumsum(-1), (1, 0))[:, at]
    length = (at - at[:, None]).clamp(min=1)
    explained = 2 * (sums[:, None] - sums[..., None]).abs().square() / length * (at - at[:, None] >= n // ends)
    total = turned.abs().square().sum(-1)[:, None, None]
    return (n / 2 * (total / (total - explained).clamp(min=1e-12 * total)).log()).sum(0).max()


def _louder(y: Tensor) -> Tensor:
    """Log likelihood ratio of another variance of samples `(sensor, time)` in the likeliest stretch of them."""
    squares, n = y.square(), y.shape[-1]
    whole, best, length = squares.sum(-1, keepdim=True), [y.new_zeros(())], 8
    while 2 * length <= n:
        inside = squares.unfold(-1, length, length // 4).sum(-1)  # (sensor, stretch)
        outside = (whole - inside).clamp(min=1e-12 * whole)
        own, rest = length / n * (inside / length).log(), (1 - length / n) * (outside / (n - length)).log()
        best.append((n / 2 * ((whole / n).log() - own - rest)).sum(0).max())
        length = length * 3 // 2 // 4 * 4
    return torch.stack(best).max()
