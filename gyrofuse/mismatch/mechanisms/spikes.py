"""Isolated outliers: shocks that all sensors feel, or errors of a bus, one sensor at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.episodes import episodes_of, two_level_scores
from gyrofuse.mismatch.evidence import corrected
from gyrofuse.mismatch.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.impulses import left_out, levelled, spike_p_values, variance_p_values
from gyrofuse.mismatch.mechanism import Finding, Mechanism, Parameter, Z
from gyrofuse.mismatch.outliers import Outliers, clustered, fitted, free_gaussian, mixture, simultaneous

_HOUR = 3600.0
_ALIKE = 5.0  # nats
_PLAIN = 5.0  # sd: outliers that can be taken off one by one
_PRESENT = 4.0  # nats
_ISOLATED = 0.03  # more frequent ones are another law of the noise


@dataclass(frozen=True, eq=False)
class Spikes(Mechanism):
    """`y_t = x_t + a_t` at isolated samples, `a_t` of either sign, of modulus `height` with some `spread`.

    Looks like white noise; the tails of what is left of a sample when all others have spoken tell them apart. Loud
    episodes have such tails too, but their outliers lie together.

    Attributes:
        rate: Of spikes, for a sample, `(sensor,)`; 0 where there are none.
        height, spread: Mean and sd of their modulus, unit of the signal, `(sensor,)`.
        together: Whether the sensors concerned are hit at the same time: a shock.
    """

    name: ClassVar[str] = "spikes"
    rate: Tensor
    height: Tensor
    spread: Tensor
    together: bool

    @property
    def amplitude(self) -> Tensor:
        """Root mean square of the spikes, `(sensor,)`."""
        return torch.hypot(self.height, self.spread)

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        p_values = spike_p_values(case)
        p_value = corrected(float(p_values.min()), len(p_values))
        if p_value > level:
            return None
        z = left_out(case.recorded).z[0]
        laws = [fitted(row) for row in z]
        gains = [float((mixture(row, law) - free_gaussian(row)).sum()) for row, law in zip(z, laws, strict=True)]
        hit = tuple(i for i, gain in enumerate(gains) if gain > _PRESENT and float(p_values[i]) < 0.05)
        if any(laws[i].rate > _ISOLATED for i in hit):
            return None
        if not hit or clustered(levelled(case)[list(hit)]):
            return None
        gain = sum(gains[i] for i in hit)
        rival = _louder(case)
        if rival > gain + _ALIKE:
            return None
        effect = cls._of(case, hit, laws, simultaneous(z, hit))
        parameters = {}
        for i in hit:
            per_hour = case.scene.rate * _HOUR
            law, scale = laws[i], float(left_out(case.recorded).sd[0, i])
            parameters[f"rate[{i}]"] = _limits(law.rate * per_hour, law.rate_sd * per_hour, "1/h")
            parameters[f"amplitude[{i}]"] = _limits(law.amplitude * scale, law.amplitude_sd * scale, case.scene.unit)
        alternatives = [
            name
            for name, alike in (
                ("variance_change", rival > gain - _ALIKE),
                ("parameter_shift", gain < _ALIKE),
            )
            if alike
        ]
        largest = max(hit, key=lambda i: float(effect.amplitude[i]))
        where = case.scene.named(hit, "all sensors")
        how = "at the same time, as shocks do" if effect.together else "not at the same time, as errors of a bus are"
        return Finding(
            cls.name,
            effect,
            f"isolated outliers in {where}{', ' + how if len(hit) > 1 else ''}: "
            f"{parameters[f'rate[{largest}]'].value:.3g} an hour of {float(effect.amplitude[largest]):.3g} "
            f"{case.scene.unit} in sensor {case.scene.sensors[largest]}",
            p_value,
            hit,
            parameters,
            levels=(1,),
            alternatives=tuple(alternatives),
            time_s=int(z[largest].abs().argmax()) / case.scene.rate,
            gain=gain,
        )

    @classmethod
    def _of(cls, case: Case, hit: tuple[int, ...], laws: list[Outliers], together: bool) -> Spikes:
        rows = [laws[i] if i in hit else Outliers.none() for i in range(case.n_sensors)]
        rate, height, spread = (
            torch.tensor([getattr(row, name) for row in rows], dtype=torch.float64)
            for name in ("rate", "height", "spread")
        )
        sd = left_out(case.recorded).sd[0]
        return cls(rate, height * sd, spread * sd, together)

    def refitted(self, case: Case, fold: int) -> Spikes:
        keep = estimation_samples(case.n_samples, fold)
        z = left_out(case.recorded).z[0]
        hit = tuple(self.rate.nonzero()[:, 0].tolist())
        return self._of(case, hit, [fitted(row[keep]) for row in z], self.together)

    def simulated(self, signal: Tensor, scene: Scene, generator: torch.Generator) -> Tensor:
        def draw(kind: str, shape: tuple[int, ...]) -> Tensor:
            source = torch.rand if kind == "even" else torch.randn
            return source(shape, generator=generator, dtype=torch.float64)

        rate = self.rate[:, None]
        when = (*signal.shape[:-2], 1, signal.shape[-1]) if self.together else tuple(signal.shape)
        at = draw("even", when) < (rate.amax() if self.together else rate)
        sign = torch.where(draw("even", tuple(signal.shape)) < 0.5, -1.0, 1.0)
        size = self.height[:, None] + self.spread[:, None] * draw("normal", tuple(signal.shape))
        return signal + torch.where(at & (rate > 0), sign * size, 0.0)

    def removed(self, signal: Tensor, scene: Scene) -> Tensor:
        """Samples that are outliers more likely than not are predicted from all others."""
        case = Case.of(scene, signal, signal[None])
        expected = left_out(case.recorded)
        return torch.where(self._outliers(case), signal - expected.error[0], signal)

    def explained(self, case: Case, generator: torch.Generator) -> Case:
        expected = left_out(case.recorded)
        plain = self.amplitude >= _PLAIN * expected.sd[0]
        if not bool(plain[self.rate > 0].all()):
            return super().explained(case, generator)
        noise = torch.randn(case.recording.shape, generator=generator, dtype=torch.float64) * expected.sd[0][:, None]
        predicted = case.recording - expected.error[0] + noise
        return case.with_recording(torch.where(self._outliers(case), predicted, case.recording))

    def gains(self, case: Case, fold: int) -> Tensor:
        z = left_out(case.recorded).z[0]
        scores = torch.zeros_like(z)
        for i, law in enumerate(self._laws(case)):
            if law.rate > 0:
                scores[i] = mixture(z[i], law) - free_gaussian(z[i])
        return held_out_blocks(scores, fold).sum((0, -1))

    def _laws(self, case: Case) -> list[Outliers]:
        sd = left_out(case.recorded).sd[0]
        numbers = torch.stack([self.rate, self.height / sd, self.spread / sd], -1).tolist()
        return [Outliers(*row) for row in numbers]

    def _outliers(self, case: Case) -> Tensor:
        """Samples that are outliers more likely than not, `(sensor, time)`."""
        z = left_out(case.recorded).z[0]
        return torch.stack([law.posterior(row) > 0.5 for row, law in zip(z, self._laws(case), strict=True)])


def _louder(case: Case) -> float:
    """What an episode of louder noise would gain, nats."""
    white = levelled(case)
    found = episodes_of(white, variance_p_values(case))
    return 0.0 if found is None else float(two_level_scores(white, found.factor, found.inside(case.n_samples)).sum())


def _limits(value: float, sd: float, unit: str) -> Parameter:
    reach = math.exp(min(Z * sd / max(value, 1e-300), 50.0))
    return Parameter(value, value / reach, value * reach, unit)
