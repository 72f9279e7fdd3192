"""Interleaved converters: two take turns, and their zeros differ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.lines.interleaving import alternation, interleaving_p_value
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.known_path import KnownPath
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, signal_gains
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class Interleaving(KnownPath):
    """`x_i(t) = offset_i (-1)^t`: even samples are too high by as much as odd ones are too low.

    A line at half the rate looks like it: with samples at one rate nothing tells them apart.

    Attributes:
        offset: `(sensor,)`, unit of the signal; `t` counts from the first sample. 0 in sensors that have none.
    """

    name: ClassVar[str] = "interleaving"
    separated_by: ClassVar[str] = "a recording at another rate"
    offset: OfSensors

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p_value = interleaving_p_value(comparison)
        if p_value > level:
            return None
        found, info = alternation(comparison), comparison.info
        there = included_sensors(found.square, 1).positions
        half = torch.tensor([0.5], dtype=torch.float64)
        sd = (found.noise * comparison.base.spectrum(half)[:, 0] / comparison.n_samples).sqrt()
        effect = cls(_means(comparison.recording, there))
        limits = {
            f"offset[{i}]": Parameter.around(a, Z * s, info.measure)
            for i, a, s in zip(range(len(sd)), effect.offset.tolist(), sd.tolist(), strict=True)
            if i in there
        }
        largest = max(there, key=lambda i: abs(float(effect.offset[i])))
        off = float(effect.offset[largest])
        return effect.found(
            f"every second sample is off in {info.named(there, 'all sensors')}, even ones by {off:+.3g} and odd ones "
            f"by {-off:+.3g} {info.measure} (sensor {info.sensors[largest]}), as of two converters in turns, or a tone "
            "at half the rate",
            p_value,
            there,
            limits,
            levels=(1,),
            frequency_hz=info.rate / 2,
            gain=float(found.square[list(there)].sum()) / 2,
        )

    @property
    def amplitudes(self) -> Tensor:
        return self.offset

    def with_amplitudes(self, amplitudes: Tensor) -> Interleaving:
        return replace(self, offset=amplitudes)

    def fit_without(self, comparison: Comparison, fold: int) -> Interleaving:
        there = tuple(self.offset.nonzero()[:, 0].tolist())
        return replace(self, offset=_means(comparison.recording, there, estimation_samples(comparison.n_samples, fold)))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return signal_gains(comparison, self._path(comparison.info, comparison.n_samples), fold)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        rate = comparison.info.rate
        pictures.spectrum_near(ax, comparison, sensor, rate / 2, rate / comparison.n_samples)

    def _path(self, info: RecordingInfo, n_samples: int) -> Tensor:
        return self.offset[:, None] * _turns(n_samples)


def _turns(n_samples: int) -> Tensor:
    """One and minus one in turns, `(time,)`."""
    return 1.0 - 2.0 * (torch.arange(n_samples) % 2)


def _means(signal: Tensor, there: tuple[int, ...], keep: Tensor | None = None) -> Tensor:
    """Half the difference of the means of even and odd samples of signals `(sensor, time)`, where it is there."""
    kept = torch.ones(signal.shape[-1], dtype=torch.bool) if keep is None else keep
    even = torch.arange(signal.shape[-1]) % 2 == 0
    half = (signal[:, kept & even].mean(-1) - signal[:, kept & ~even].mean(-1)) / 2
    only = torch.zeros_like(half)
    only[list(there)] = half[list(there)]
    return only
