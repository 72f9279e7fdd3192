"""A stationary tone: a rotor, a fan, a pump."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.folds import estimation_samples
from gyrofuse.mismatch.mechanism import Finding, Mechanism, Parameter, Z
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.side import Side
from gyrofuse.mismatch.spectra import hann_transform
from gyrofuse.mismatch.witnesses import level_of

_ROUNDS = 6
_SEEN = 0.04  # chance that a sensor is named which has no tone
_REACH, _GUARD = 64, 3  # bins on either side that tell the noise, and those too near to


@dataclass(frozen=True, eq=False)
class VibrationTone(Mechanism):
    """`x_i(t) = cosine_i cos(2 pi f t) + sine_i sin(2 pi f t)` in every sensor `i`.

    Samples at one rate `f_s` do not tell `f` from `k f_s - f` and `k f_s + f`.

    Attributes:
        frequency_hz: `f`, one for all sensors.
        cosine, sine: `(sensor,)`, unit of the signal; `t` counts from the first sample.
    """

    name: ClassVar[str] = "vibration_tone"
    frequency_hz: float
    cosine: Tensor
    sine: Tensor

    @property
    def amplitude(self) -> Tensor:
        """`(sensor,)`, unit of the signal."""
        return torch.hypot(self.cosine, self.sine)

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        line = case.line
        if line.p_value > level:
            return None
        tone = cls._fitted(case, line.frequency * case.scene.rate, torch.ones(case.n_samples, dtype=torch.bool))
        f = tone.frequency_hz / case.scene.rate
        n, noise = case.n_samples, density_near(case, f)  # (sensor,)
        sd = (2 * noise / n).sqrt()
        snr = tone.amplitude / sd
        seen = math.sqrt(-2 * math.log(_SEEN / case.n_sensors))
        present = tuple((snr > seen).nonzero()[:, 0].tolist()) or (int(snr.argmax()),)
        # Noise adds to the squares of amplitudes, but tells nothing of the frequency.
        energy = max(float((snr.square() - 2).clamp(min=0.0)[list(present)].sum()), 1.0)
        spread = math.sqrt(12 / energy) / (2 * math.pi * n)
        parameters = {"frequency": _limits(tone.frequency_hz, spread * case.scene.rate, "Hz")}
        for i in present:
            parameters[f"amplitude[{i}]"] = _limits(float(tone.amplitude[i]), float(sd[i]), case.scene.unit)
        largest = max(present, key=lambda i: float(tone.amplitude[i]))
        where = case.scene.named(present, "all sensors")
        return Finding(
            cls.name,
            tone,
            f"a tone at {tone.frequency_hz:.6g} Hz in {where}, of amplitude up to "
            f"{float(tone.amplitude[largest]):.3g} {case.scene.unit} (sensor {case.scene.sensors[largest]}), "
            f"that the simulation does not have; without a filter before sampling it may be one at "
            f"{case.scene.rate - tone.frequency_hz:.6g}, {case.scene.rate + tone.frequency_hz:.6g} .. Hz",
            line.p_value,
            present,
            parameters,
            levels=(level_of(f),),
            frequency_hz=tone.frequency_hz,
            gain=float(snr.square().sum()) / 2,
        )

    @classmethod
    def _fitted(cls, case: Case, frequency_hz: float, keep: Tensor) -> VibrationTone:
        """Least squares with the noise near the tone as weights, starting within half a bin of its frequency."""
        weights = 1 / density_near(case, frequency_hz / case.scene.rate)
        t = torch.arange(case.n_samples, dtype=torch.float64)[keep]
        signal = case.recording[:, keep]
        signal = signal - signal.mean(-1, keepdim=True)
        omega, middle = 2 * math.pi * frequency_hz / case.scene.rate, float(t.mean())
        for _ in range(_ROUNDS):
            angle = omega * t
            basis = torch.stack([angle.cos(), angle.sin()])
            gram = basis @ basis.mT
            at = torch.linalg.solve(gram, basis @ signal.mT)  # (2, sensor)
            quadrature = at[1][:, None] * basis[0] - at[0][:, None] * basis[1]  # slope of the phase, (sensor, time)
            slope = quadrature * (t - middle)
            slope = slope - (torch.linalg.solve(gram, basis @ slope.mT)).mT @ basis
            left = signal - at.mT @ basis
            step = (weights * (slope * left).sum(-1)).sum() / (weights * slope.square().sum(-1)).sum()
            omega += float(step.clamp(-1.0 / case.n_samples, 1.0 / case.n_samples))
        return cls(omega * case.scene.rate / (2 * math.pi), at[0], at[1])

    def refitted(self, case: Case, fold: int) -> VibrationTone:
        keep = estimation_samples(case.n_samples, fold)
        return self._fitted(case, self.frequency_hz, keep)

    def simulated(self, signal: Tensor, scene: Scene, generator: torch.Generator) -> Tensor:
        turn = 2 * math.pi * torch.rand((), generator=generator, dtype=torch.float64)
        return signal + self._path(signal.shape[-1], scene, float(turn))

    def removed(self, signal: Tensor, scene: Scene) -> Tensor:
        return signal - self._path(signal.shape[-1], scene)

    def explained(self, case: Case, generator: torch.Generator) -> Case:
        return case.less(self._path(case.n_samples, case.scene))

    def _path(self, n_samples: int, scene: Scene, turn: float = 0.0) -> Tensor:
        angle = 2 * math.pi * self.frequency_hz * scene.seconds(n_samples) + turn
        return self.cosine[:, None] * angle.cos() + self.sine[:, None] * angle.sin()


def density_near(case: Case, f: float) -> Tensor:
    """Noise of the recording around a line, without the line itself, per sample `(sensor,)`."""
    power, length = _tapered_power(case.recorded)
    apart = torch.cat([torch.arange(-_REACH, -_GUARD), torch.arange(_GUARD + 1, _REACH + 1)])
    places = f + apart / case.n_samples
    places = places[(places > 2.5 / case.n_samples) & (places < 0.5 - 0.5 / case.n_samples)]
    here = case.base.spectrum(torch.tensor([f], dtype=torch.float64))
    return (power[:, (places * length).round().long()] / case.base.spectrum(places) * here).mean(-1)


@remembered
def _tapered_power(side: Side) -> tuple[Tensor, int]:
    """Periodogram `(sensor, bin)` of a recording under a Hann taper, and the length it was padded to."""
    transform, length = hann_transform(side.signal[0])
    return transform.abs().square(), length


def _limits(value: float, sd: float, unit: str) -> Parameter:
    return Parameter(value, value - Z * sd, value + Z * sd, unit)
