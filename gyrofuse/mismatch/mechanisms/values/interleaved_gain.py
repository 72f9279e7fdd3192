"""Interleaved converters: two take turns, and their gains differ."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.axes import BLUE, INK, finish, with_unit
from gyrofuse.mismatch.detectors.lines.interleaving import size_alternation
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.values.interleaving import Interleaving
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class InterleavedGain(Mechanism):
    """`y_i(t) = even_i x_i(t)` at even samples and `odd_i x_i(t)` at odd ones.

    All noise is folded at half the rate: seen by spectra alone it is other noise, and by its tails two levels of it.

    Attributes:
        even, odd: `(sensor,)`; 1 in sensors of one gain. `t` counts from the first sample.
        centre: `(sensor,)`, mean of the recording: a simulation's own mean stands for it.
    """

    name: ClassVar[str] = Interleaving.name
    likelihood: ClassVar[str] = "innovations"
    separated_by: ClassVar[str] = Interleaving.separated_by
    stage: ClassVar[int] = 1
    even: OfSensors
    odd: OfSensors
    centre: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found, info = size_alternation(comparison), comparison.info
        if found.p_value > level:
            return None
        sensors = included_sensors(found.square, 1).positions
        keep = torch.ones(comparison.n_samples, dtype=torch.bool)
        effect = cls(*_gains(comparison, sensors, keep), comparison.recording.mean(-1))
        ratio = effect.odd / effect.even
        reach = Z * ratio.log().abs() / found.square.sqrt().clamp(min=1e-9)
        most = max(sensors, key=lambda i: abs(math.log(float(ratio[i]))))
        return effect.found(
            f"every second sample has another gain in {info.named(sensors, 'all sensors')}, odd ones "
            f"{float(ratio[most]):.4g} times that of even ones (sensor {info.sensors[most]}), as of two converters in "
            "turns",
            found.p_value,
            sensors,
            {f"gain_ratio[{i}]": Parameter.within(float(ratio[i]), math.exp(float(reach[i])), "") for i in sensors},
            levels=(1,),
            frequency_hz=info.rate / 2,
            gain=float(effect._scores(comparison, keep).sum()),
        )

    def fit_without(self, comparison: Comparison, fold: int) -> InterleavedGain:
        keep, sensors = estimation_samples(comparison.n_samples, fold), (self.even != self.odd).nonzero()[:, 0].tolist()
        even, odd = _gains(comparison, sensors, keep)
        return replace(self, even=even, odd=odd)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        mean = signal.mean(-1, keepdim=True)
        return torch.where((self.even != self.odd)[:, None], mean + (signal - mean) * self._factors(signal), signal)

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        centre = self.centre[:, None]
        straight = centre + (signal - centre) / self._factors(signal)
        return torch.where((self.even != self.odd)[:, None], straight, signal)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """The recording with one gain: there, all other laws hold as they are."""
        return comparison.with_recording(self.remove(comparison.recording, comparison.info))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        keep = estimation_samples(comparison.n_samples, fold)
        return held_out_blocks(self._scores(comparison, keep), fold).sum((0, -1))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        """Histograms of even and of odd samples."""
        own = comparison.recording[sensor] - comparison.recording[sensor].mean()
        reach, handles = 4.5 * float(own.std()), []
        for part, color in ((own[::2], INK), (own[1::2], BLUE)):
            share, edges = np.histogram(part.numpy(), np.linspace(-reach, reach, 101))
            handles.append(ax.stairs(share / len(part), edges, color=color, linewidth=1.2))
        ax.set_xlabel(with_unit("value from the mean", comparison.info.measure), parse_math=False)
        ax.set_ylabel("share of the samples in a bin")
        finish(ax, handles, ["even samples", "odd samples"])

    def _factors(self, signal: Tensor) -> Tensor:
        odd = torch.arange(signal.shape[-1]) % 2 == 1
        return torch.where(odd, self.odd[:, None], self.even[:, None])

    def _scores(self, comparison: Comparison, keep: Tensor) -> Tensor:
        """Log likelihood ratio of each sample to one gain, `(sensor, time)`, levels fitted where to keep."""
        factors, terms = self._factors(comparison.recording), []
        for signal in (self.remove(comparison.recording, comparison.info), comparison.recording):
            error = whitened(signal, comparison.base)
            variance = error[:, keep].square().mean(-1, keepdim=True)
            terms.append(-variance.log() / 2 - error.square() / (2 * variance))
        return terms[0] - terms[1] - factors.log()


def _gains(comparison: Comparison, sensors: tuple[int, ...] | list[int], keep: Tensor) -> tuple[Tensor, Tensor]:
    """Those of even and odd samples, `(sensor,)`, over the simulation's, by differences of every second sample.

    Within what such an estimate is off by chance one of them is 1: one converter is as simulated.
    """
    near = 0.05  # logarithm of a gain
    off = (comparison.recording[:, 2:] - comparison.recording[:, :-2]).square()
    simulated = comparison.reference.signal
    level = (simulated[..., 2:] - simulated[..., :-2]).square().mean((0, -1))
    odd = torch.arange(off.shape[-1]) % 2 == 1
    kept = keep[2:] & keep[:-2]
    gains = torch.stack([(off[:, kept & part].mean(-1) / level).sqrt() for part in (~odd, odd)])
    closer = gains.log().abs().argmin(0)
    own = gains.gather(0, closer[None])[0]
    gains = torch.where(own.log().abs() < near, gains / own, gains)
    even, odd_ones = torch.ones_like(gains)
    even[list(sensors)], odd_ones[list(sensors)] = gains[:, list(sensors)]
    return even, odd_ones
