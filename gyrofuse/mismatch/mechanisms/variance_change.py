"""Noise that is louder, or quieter, for a while."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.episodes import episodes_of, onset_limits, two_level_scores
from gyrofuse.mismatch.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.impulses import levelled, variance_p_value, variance_p_values
from gyrofuse.mismatch.mechanism import Finding, Mechanism, Parameter, Z

_SLOWER = 65  # samples: what varies more slowly is not louder


@dataclass(frozen=True, eq=False)
class VarianceChange(Mechanism):
    """`sd_t = sqrt(factor) sd` within episodes, for what is faster than 65 samples.

    Looks like heavy tails; its loud samples lie together.

    Attributes:
        episodes: Starts and stops, s after the first sample.
        factor: `(sensor,)`, of the variance within; 1 where a sensor does not change.
    """

    name: ClassVar[str] = "variance_change"
    happened_once: ClassVar[bool] = True
    episodes: tuple[tuple[float, float], ...]
    factor: Tensor

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        p_values, p_value = variance_p_values(case), variance_p_value(case)
        if p_value > level:
            return None
        white = levelled(case)
        found = episodes_of(white, p_values)
        if found is None:
            return None
        rate = case.scene.rate
        effect = cls(tuple((e.start / rate, e.stop / rate) for e in found.episodes), found.factor)
        sensors = tuple((found.factor != 1).nonzero()[:, 0].tolist())
        first = found.episodes[0]
        log_ratios = found.log_ratios(white)
        parameters = {
            "start": _time(first.start, onset_limits(log_ratios, first, rising=True), rate),
            "stop": _time(first.stop, onset_limits(log_ratios, first, rising=False), rate),
        }
        inside = sum(e.stop - e.start for e in found.episodes)
        for i in sensors:
            reach = math.exp(Z * math.sqrt(2 / inside + 2 / max(case.n_samples - inside, 1)))
            value = float(found.factor[i])
            parameters[f"factor[{i}]"] = Parameter(value, value / reach, value * reach, "")
        gain = float(two_level_scores(white, found.factor, found.inside(case.n_samples)).sum())
        largest = max(sensors, key=lambda i: abs(math.log(float(found.factor[i]))))
        where = case.scene.named(sensors, "all sensors")
        more = f" and {len(found.episodes) - 1} more times" if len(found.episodes) > 1 else ""
        return Finding(
            cls.name,
            effect,
            f"the noise's variance is {float(found.factor[largest]):.3g} times the rest (sensor "
            f"{case.scene.sensors[largest]}) from {first.start / rate:.6g} s "
            f"to {first.stop / rate:.6g} s{more} in {where}",
            p_value,
            sensors,
            parameters,
            levels=(1,),
            alternatives=("spikes",) if max(e.stop - e.start for e in found.episodes) < 8 else (),
            time_s=first.start / rate,
            gain=gain,
        )

    def refitted(self, case: Case, fold: int) -> VarianceChange:
        keep = estimation_samples(case.n_samples, fold)
        squares = levelled(case)[:, keep].square()
        inside = self._inside(case.n_samples, case.scene.rate)[keep]
        if not bool(inside.any()) or bool(inside.all()):
            return self
        factor = squares[:, inside].mean(-1) / squares[:, ~inside].mean(-1)
        return VarianceChange(self.episodes, torch.where(self.factor != 1, factor, 1.0))

    def simulated(self, signal: Tensor, scene: Scene, generator: torch.Generator) -> Tensor:
        reach = min(_SLOWER, signal.shape[-1] // 2 * 2 - 1)
        flat = signal.flatten(0, -2)[:, None]
        padded = torch.nn.functional.pad(flat, (reach // 2, reach // 2), mode="reflect")
        fast = signal - avg_pool1d(padded, reach, 1)[:, 0].reshape(signal.shape)
        inside = self._inside(signal.shape[-1], scene.rate)
        return signal + (self.factor.sqrt() - 1)[:, None] * fast * inside

    def gains(self, case: Case, fold: int) -> Tensor:
        inside = self._inside(case.n_samples, case.scene.rate)
        return held_out_blocks(two_level_scores(levelled(case), self.factor, inside), fold).sum((0, -1))

    def _inside(self, n_samples: int, rate: float) -> Tensor:
        within = torch.zeros(n_samples, dtype=torch.bool)
        for start, stop in self.episodes:
            within[round(start * rate) : round(stop * rate)] = True
        return within


def _time(at: int, limits: tuple[int, int], rate: float) -> Parameter:
    return Parameter(at / rate, limits[0] / rate, limits[1] / rate, "s")
