"""The line of a tone along a channel: its law, and its amplitudes at knots."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.detectors.moving.channel_tracks import ChannelTrack, as_it_moves
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.transients.carrier import Carrier
from gyrofuse.mismatch.mechanisms.transients.transient import path_gain
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.filters import late
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class ChannelLine:
    """`x_i(t) = Re A_i(t) g(t)^k exp(i phi(t))` with `phi' = 2 pi f`, `f = f_0 + b u + c u^2`, `u` a row of a channel.

    What turns comes to its speed late: `u` is a mean over the past, with weights that fall exponentially. `g` is `f` or
    `u` over its value in the middle; an imbalance has `f^2`. `A` lies on straight lines between knots: what the channel
    does not say of the phase. One source: the `A_i` have one course.

    Attributes:
        channel: Name of the channel.
        row: Position of its row.
        straight: Whether it goes on straight lines between values that a slower source sent.
        offset_hz: `f_0`.
        slope: `b`, Hz for each unit of the channel.
        bend: `c`, Hz for each of its square.
        late_s: Time constant of that mean, s.
        middle: Median of `u`.
        of_channel: Whether `g` is `u`, not `f`.
        growth: `k`.
        cosine, sine: Real part of `A` and its imaginary part times -1 at knots evenly over the recording, unit of the
            signal, `(knot, sensor)`.
    """

    channel: str
    row: int
    straight: bool
    offset_hz: float
    slope: float
    bend: float
    late_s: float
    middle: float
    of_channel: bool
    growth: int
    cosine: Annotated[Tensor, Dims(("knot", "sensor"))]
    sine: Annotated[Tensor, Dims(("knot", "sensor"))]

    @classmethod
    def followed(cls, comparison: Comparison, track: ChannelTrack) -> ChannelLine:
        """Fitted to all samples, its line straightened by the phases of ever longer stretches."""
        rate, n = comparison.info.rate, comparison.n_samples
        row, most = track.values(comparison), 512  # knots
        none, n_knots = torch.zeros(1, comparison.n_sensors, dtype=torch.float64), min(2 * n // track.length, most)
        offset, slope = track.offset * rate, track.slope * rate
        tried = [
            cls(track.channel, track.row, straight, offset, slope, 0.0, 0.0, float(u.median()), False, 0, none, none)
            for straight, u in ((False, row), (True, as_it_moves(row)))
            if not straight or u is not row
        ]
        late_ones = [one.fitted(comparison, n_knots)._as_late(comparison) for one in tried]
        found = max(late_ones, key=lambda one: one.gain(comparison))._of_fewer(comparison, n_knots)
        if not found.late_s:
            return found
        # Amplitudes at many knots go along with phases that lateness makes: of few it is known better.
        again = found.fitted(comparison, found._some_more)._as_late(comparison)
        again = again._of_fewer(comparison, found._some_more)
        return max(found, again, key=lambda one: one.gain(comparison) - one.cost())

    def refitted(self, comparison: Comparison) -> ChannelLine:
        """Where others were taken off: from some more knots on than it has, but not so many that they fit others."""
        return self._of_fewer(comparison, self._some_more)

    @property
    def _some_more(self) -> int:
        more, most = 4, 64
        return min(max(more * len(self.cosine), 2 * more), most)

    def is_near(self, other: ChannelLine, comparison: Comparison) -> bool:
        """Whether it is another one's line, to what as many knots as are refitted tell apart."""
        if self.row != other.row:
            return False
        n, info, told = comparison.n_samples, comparison.info, 64
        return float((self.frequencies(info, n) - other.frequencies(info, n)).abs().mean()) < told * info.rate / n

    def _of_fewer(self, comparison: Comparison, n_knots: int) -> ChannelLine:
        """Its line straightened by so many knots and ever fewer, as many as explain most for what they cost."""
        rounds, effect, tried = 4, self, list[ChannelLine]()  # times that it is straightened by the same knots
        while n_knots:
            effect = effect.fitted(comparison, n_knots)
            for k in range(rounds if n_knots > 4 else 0):  # from fewer turns there is no bend
                straight = effect._straightened(comparison, 1).fitted(comparison, n_knots)
                bent = effect._straightened(comparison, 2).fitted(comparison, n_knots) if k else straight
                more = bent.gain(comparison) - straight.gain(comparison)
                effect = bent if more > NATS_PER_NUMBER else straight
            grown = [replace(effect, growth=k, of_channel=u).fitted(comparison, n_knots) for k, u in effect._growths()]
            effect = max(grown, key=lambda one: one.gain(comparison))
            tried.append(effect)
            n_knots //= 2
        return max(tried, key=lambda one: one.gain(comparison) - one.cost())

    def _as_late(self, comparison: Comparison) -> ChannelLine:
        """With the lateness that explains most, its line straightened for each."""
        n_knots, steps = len(self.cosine), (4.0, 2.0, 2**0.5, 2**0.25)

        def at(late_s: float) -> tuple[float, ChannelLine]:
            moved = replace(self, late_s=late_s).fitted(comparison, n_knots)
            moved = moved._straightened(comparison, 1).fitted(comparison, n_knots)
            return moved.gain(comparison), moved

        seconds = comparison.n_samples / comparison.info.rate
        first = [at(0.0), *(at(seconds / 4**k) for k in range(4, 9) if 4**k < comparison.n_samples / 2)]
        first += [at(self.late_s)] if self.late_s else []
        best = max(first, key=lambda one: one[0])
        for step in steps:
            beside = [at(best[1].late_s * by) for by in (step, 1 / step)] if best[1].late_s else []
            best = max([best, *beside], key=lambda one: one[0])
        return best[1] if best[0] > first[0][0] + NATS_PER_NUMBER else first[0][1]

    def _course(self, info: RecordingInfo) -> Tensor:
        """What the frequency follows, `(time,)`."""
        row = info.channel_rows(self.channel)[self.row]
        return late(as_it_moves(row) if self.straight else row, self.late_s * info.rate)

    def frequencies(self, info: RecordingInfo, n_samples: int) -> Tensor:
        """Of a recording with these channels, Hz, `(time,)`."""
        row = self._course(info)
        if len(row) < n_samples:
            raise ValueError(
                f"`channels`: expected {n_samples} samples of {self.channel}, which a tone follows, got {len(row)}; "
                "give as many as are simulated"
            )
        return self.offset_hz + (self.slope + self.bend * row[:n_samples]) * row[:n_samples]

    def _carrier(self, info: RecordingInfo, n_samples: int, n_knots: int) -> Carrier:
        f = self.frequencies(info, n_samples)
        angle = 2 * math.pi * f.cumsum(0) / info.rate
        return Carrier.even(torch.polar(torch.ones_like(angle), angle), n_knots)

    @property
    def middle_hz(self) -> float:
        """Frequency at the channel's median."""
        return self.offset_hz + (self.slope + self.bend * self.middle) * self.middle

    @property
    def law(self) -> str:
        """In words."""
        lag = f", {1e3 * self.late_s:.3g} ms late" if self.late_s else ""
        what = "it" if self.of_channel else "its frequency"
        grows = ("", f", its size growing as {what}", f", its size growing as the square of {what}")[self.growth]
        nearly = 0.005  # of the frequency
        if self.bend:
            law = f"{self.middle_hz:.4g} Hz at {self.middle:.4g} of it and {self.rise:.4g} Hz for each unit there"
        elif abs(self.offset_hz) < nearly * abs(self.middle_hz):
            law = f"{self.rise:.4g} Hz for each unit of it"
        else:
            law = f"{self.offset_hz:.4g} Hz and {self.rise:.4g} Hz for each unit of it"
        return f"{law}{lag}{grows}"

    @property
    def rise(self) -> float:
        """Of its frequency for each unit of the channel, at the channel's median."""
        return self.slope + 2 * self.bend * self.middle

    def _growths(self) -> list[tuple[int, bool]]:
        """Powers by which its amplitude may grow, and whether with the channel."""
        of_frequency = [(k, False) for k in (0, 1, 2)]
        return [*of_frequency, (1, True), (2, True)] if self.middle else of_frequency

    def _growth(self, info: RecordingInfo, n_samples: int) -> Tensor:
        if self.of_channel:
            course = self._course(info)[:n_samples] / self.middle
        else:
            course = self.frequencies(info, n_samples) / self.middle_hz
        return course.abs().pow(self.growth)

    def fitted(self, comparison: Comparison, n_knots: int, keep: Tensor | None = None) -> ChannelLine:
        """With the amplitudes at so many knots, of the samples to keep `(time,)`, by default of all."""
        n, info = comparison.n_samples, comparison.info
        grown = self._growth(info, n)
        carrier = self._carrier(info, n, n_knots)
        signal = comparison.recording - comparison.recording.mean(-1, keepdim=True)
        amplitude = carrier.amplitudes(signal, self.density(comparison).sqrt(), keep, grown)
        return replace(self, cosine=amplitude.real, sine=-amplitude.imag)

    def _straightened(self, comparison: Comparison, degree: int) -> ChannelLine:
        """With what the phases of neighbouring amplitudes say of offset, slope and, of degree two, bend."""
        left, weight, u = self._turns(comparison)
        if degree == 1:
            left = left + self.bend * u.square()
        scale = max(float((u - self.middle).abs().max()), 1e-300)
        z = (u - self.middle) / scale
        design = torch.stack([z**k for k in range(degree + 1)], -1) * weight.sqrt()[:, None]
        found = torch.linalg.lstsq(design, (left * weight.sqrt())[:, None]).solution[:, 0]
        first, slope, bend = [*found.tolist(), 0.0, 0.0][:3]
        slope, bend = slope / scale, bend / scale**2
        own = 0.0 if degree == 1 else self.bend
        return replace(
            self,
            offset_hz=self.offset_hz + first - slope * self.middle + bend * self.middle**2,
            slope=self.slope + slope - 2 * bend * self.middle,
            bend=own + bend,
        )

    def _turns(self, comparison: Comparison) -> tuple[Tensor, Tensor, Tensor]:
        """Between knots: frequencies beside the line, Hz, their weights, and means of the channel, `(knot - 1,)`."""
        amplitude, weight = torch.complex(self.cosine, -self.sine), 1 / self.density(comparison)
        both = ((amplitude[1:] * amplitude[:-1].conj()) * weight).sum(-1)
        seconds = comparison.n_samples / comparison.info.rate / (len(amplitude) - 1)
        row = self._course(comparison.info)[: comparison.n_samples]
        means = torch.stack([part.mean() for part in row.tensor_split(len(amplitude) - 1)])
        return both.angle() / (2 * math.pi * seconds), both.abs(), means

    def limits(self, comparison: Comparison) -> tuple[Parameter, Parameter]:
        """Frequency in the middle of the channel, and its rise there, with 95 % limits.

        By Fisher's information of the phase, whatever the amplitudes are; by how the phases between knots scatter where
        there are many.
        """
        few = 16  # knots
        covariance = self._information(comparison) if len(self.cosine) <= few else self._scatter(comparison)
        reach = Z * covariance.diagonal().clamp(min=0).sqrt()
        values = (self.middle_hz, self.rise)
        return tuple(  # type: ignore[return-value]
            Parameter.around(value, own, unit)
            for value, own, unit in zip(values, reach.tolist(), ("Hz", "Hz per unit"), strict=True)
        )

    def _information(self, comparison: Comparison) -> Tensor:
        """Covariance of frequency and rise, `(2, 2)`."""
        n, rate = comparison.n_samples, comparison.info.rate
        z = self._course(comparison.info)[:n] - self.middle
        designs = [torch.ones_like(z), z, *([z.square()] if self.bend else [])]
        turns = 2 * math.pi * torch.stack(designs).cumsum(-1) / rate
        carrier = self._carrier(comparison.info, n, len(self.cosine))
        hats = torch.zeros(n, len(self.cosine), dtype=torch.float64)
        for k, weight in enumerate(carrier.weights[: len(self.cosine)]):
            hats.scatter_add_(1, carrier.inside[:, None] + k, weight[:, None])
        power = (self.cosine.square() + self.sine.square()) / 2 / self.density(comparison)
        loud = (hats @ power.sum(-1)) * self._growth(comparison.info, n).square()
        root = loud.sqrt()[:, None]
        free = root * hats
        left = root * turns.mT
        left = left - free @ torch.linalg.lstsq(free, left).solution
        return torch.linalg.pinv(left.mT @ left)[:2, :2]

    def _scatter(self, comparison: Comparison) -> Tensor:
        """The same, of phases that the channel does not say either."""
        left, weight, u = self._turns(comparison)
        z = u - self.middle
        design = torch.stack([torch.ones_like(z), z, *([z.square()] if self.bend else [])], -1)
        inverse = torch.linalg.pinv(design.mT @ (weight[:, None] * design))
        away = left - design @ (inverse @ (design.mT @ (weight * left)))
        return (inverse * (weight * away.square()).sum() / (len(left) - design.shape[-1]))[:2, :2]

    def density(self, comparison: Comparison) -> Tensor:
        """Density of the noise in the middle of its course, per sample `(sensor,)`."""
        f = torch.tensor([abs(math.remainder(self.middle_hz / comparison.info.rate, 1.0))], dtype=torch.float64)
        return comparison.base.spectrum(f.clamp(min=1 / comparison.n_samples))[:, 0]

    def size(self, comparison: Comparison) -> Tensor:
        """Root mean square of the amplitude over the recording, beyond what noise makes of it, `(sensor,)`."""
        size = (self.cosine.square() + self.sine.square()).mean(0)
        by_noise = 4 * len(self.cosine) * self.density(comparison) / comparison.n_samples
        return (size - by_noise).clamp(min=0).sqrt()

    def size_sd(self, comparison: Comparison) -> Tensor:
        """Standard deviations of that, `(sensor,)`."""
        return (2 * self.density(comparison) / comparison.n_samples).sqrt()

    @property
    def sensors(self) -> tuple[int, ...]:
        """Positions of those that have it."""
        return tuple((self.cosine.any(0) | self.sine.any(0)).nonzero()[:, 0].tolist())

    def gain(self, comparison: Comparison) -> float:
        """Log likelihood ratio to none, nats."""
        return path_gain(comparison, self.path(comparison.info, comparison.n_samples))

    @property
    def numbers(self) -> int:
        """How many it has."""
        return 2 * len(self.cosine) + int(self.cosine.any(0).sum()) + self.growth

    def cost(self) -> float:
        """Nats that so many numbers gain by chance, and more."""
        return NATS_PER_NUMBER * self.numbers

    def path(self, info: RecordingInfo, n_samples: int) -> Tensor:
        amplitude = torch.complex(self.cosine, -self.sine)
        path = self._carrier(info, n_samples, len(amplitude)).path(amplitude, n_samples)
        return path * self._growth(info, n_samples)

    def drawn(self, info: RecordingInfo, n_samples: int, turn: float) -> Tensor:
        """Along the channel as it is in another recording, `(sensor, time)`, of steady amplitudes in another phase."""
        amplitude = torch.complex(self.cosine, -self.sine)
        loudest = int(amplitude.abs().square().sum(0).argmax())
        together = (amplitude * amplitude[:, loudest, None].conj()).sum(0)
        steady = together / together.abs().clamp(min=1e-300) * amplitude.abs().square().mean(0).sqrt()
        path = self._carrier(info, n_samples, 1).path(steady[None] * complex(math.cos(turn), math.sin(turn)), n_samples)
        return path * self._growth(info, n_samples)

    def of_sensors(self, there: Tensor) -> ChannelLine:
        """In some sensors `(sensor,)` alone."""
        return replace(self, cosine=self.cosine * there, sine=self.sine * there)
