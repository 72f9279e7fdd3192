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
from gyrofuse.mismatch.witnesses import level_of

_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class VibrationTone(Mechanism):
    """`x_i(t) = cosine_i cos(2 pi f t) + sine_i sin(2 pi f t)` in every sensor `i`.

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
        present = (
            tuple((snr > math.sqrt(-2 * math.log(0.01 / case.n_sensors))).nonzero()[:, 0].tolist()) or line.sensors
        )
        spread = math.sqrt(24 / (n**3 * float((tone.amplitude.square() / noise).sum()))) / (2 * math.pi)
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
            "that the simulation does not have",
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
    n = case.n_samples
    centre = round(f * n)
    reach = torch.cat([torch.arange(-24, -3), torch.arange(4, 25)])
    bins = (centre + reach)[(centre + reach > 2) & (centre + reach < n // 2)]
    t = torch.arange(n, dtype=torch.float64)
    transform = torch.fft.rfft(
        (case.recording - case.recording.mean(-1, keepdim=True)) * torch.hann_window(n, dtype=t.dtype)
    )
    power = transform[:, bins].abs().square() / (n * 3 / 8)
    shape = case.base.spectrum(bins / n)
    here = case.base.spectrum(torch.tensor([f], dtype=torch.float64))[:, 0]
    return (power / shape).mean(-1) * here


def _limits(value: float, sd: float, unit: str) -> Parameter:
    return Parameter(value, value - Z * sd, value + Z * sd, unit)
