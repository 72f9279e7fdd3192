"""Random telegraph noise: a trap that is filled and emptied moves the rate between two levels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.folds import N_JUDGED, in_fold
from gyrofuse.mismatch.impulses import kurtosis_p_values
from gyrofuse.mismatch.mechanism import Finding, Mechanism, Parameter, Z
from gyrofuse.mismatch.switching import (
    Best,
    Stretches,
    best_gaussian,
    best_switching,
    gaussian_scores,
    stretches,
    switching_scores,
)
from gyrofuse.mismatch.witnesses import power_tails

Array = NDArray[np.float64]

_SUSPECT = 0.01
_PRESENT = 5.0  # nats over the Gaussian rival
_LEFT_OUT = 4  # stretches
_FEWEST_SWITCHES = 8.0  # fewer are steps
_SHORTEST = 8.0  # samples on one level: shorter, two codes of a converter look like two levels


@dataclass(frozen=True, eq=False)
class RandomTelegraph(Mechanism):
    """`y_t = x_t + half_step s_t`, `s_t = +-1` with exponential dwells of mean `up` and `down`.

    Has the spectrum of an AR1; two levels instead of a normal law tell them apart, which takes
    `half_step^2 dwell / S > 2` or so.

    Attributes:
        half_step: `(sensor,)`, unit of the signal; 0 where there is none.
        up, down: Mean dwells in the upper and the lower level, s, `(sensor,)`.
    """

    name: ClassVar[str] = "random_telegraph"
    half_step: Tensor
    up: Tensor
    down: Tensor

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        suspects = _suspects(case)
        if not suspects:
            return None
        data, every = stretches(case, suspects), torch.ones(N_JUDGED, dtype=torch.bool)
        two, rival = best_switching(data, every), best_gaussian(data, every)
        over = _without_best(data, two, rival)
        dwell = torch.from_numpy(two.theta[:, 1:]).exp()
        switches = data.n_blocks / dwell.mean(-1)
        long = dwell.amin(-1) * data.block > _SHORTEST
        present = [
            k for k in range(len(suspects)) if over[k] > _PRESENT and switches[k] > _FEWEST_SWITCHES and bool(long[k])
        ]
        if not present:
            return None
        n = case.n_sensors
        # A likelihood ratio exceeds x with probability 1/x at most, whatever the rival.
        log_p = min(math.log(n) - max(over[k] for k in present), n * math.log(2) - sum(over[k] for k in present))
        p_value = math.exp(min(log_p, 0.0))
        if p_value > level:
            return None
        effect = cls._of(case, [suspects[k] for k in present], two.theta[present], data.block)
        sensors, second = tuple(suspects[k] for k in present), data.block / case.scene.rate
        parameters = {}
        for k in present:
            i = suspects[k]
            for j, (name, scale, unit) in enumerate(
                (("half_step", 1.0, case.scene.unit), ("dwell_up", second, "s"), ("dwell_down", second, "s"))
            ):
                value = scale * math.exp(two.theta[k, j])
                reach = math.exp(min(Z * math.sqrt(two.covariance[k, j, j]), 50.0))
                parameters[f"{name}[{i}]"] = Parameter(value, value / reach, value * reach, unit)
        largest = max(sensors, key=lambda i: float(effect.half_step[i]))
        where = case.scene.named(sensors, "all sensors")
        plain = gaussian_scores(data, 0 * two.theta[:, :1], 1 + 0 * two.theta[:, :1]).sum((1, 2))
        return Finding(
            cls.name,
            effect,
            f"the rate jumps between two levels in {where}: {2 * float(effect.half_step[largest]):.3g} "
            f"{case.scene.unit} apart in sensor {case.scene.sensors[largest]}, "
            f"staying {float(effect.up[largest]):.3g} s "
            f"in the upper and {float(effect.down[largest]):.3g} s in the lower one on average",
            p_value,
            sensors,
            parameters,
            levels=_levels(effect, sensors, case.scene.rate),
            gain=float(sum(two.value[k] - plain[k] for k in present)),
        )

    @classmethod
    def _of(cls, case: Case, sensors: list[int], theta: object, block: int) -> RandomTelegraph:
        numbers = torch.zeros(3, case.n_sensors, dtype=torch.float64)
        numbers[1:] = 1.0
        numbers[:, sensors] = torch.as_tensor(theta).exp().mT
        numbers[1:, sensors] *= block / case.scene.rate
        return cls(*numbers)

    def refitted(self, case: Case, fold: int) -> RandomTelegraph:
        sensors = self.half_step.nonzero()[:, 0].tolist()
        data = stretches(case, tuple(sensors))
        return self._of(case, sensors, best_switching(data, ~in_fold(N_JUDGED, fold)).theta, data.block)

    def simulated(self, signal: Tensor, scene: Scene, generator: torch.Generator) -> Tensor:
        n = signal.shape[-1]
        records = signal.reshape(-1, len(self.half_step), n).clone()
        for i in self.half_step.nonzero()[:, 0].tolist():
            up, down = float(self.up[i]) * scene.rate, float(self.down[i]) * scene.rate
            for record in records:
                record[i] += float(self.half_step[i]) * _path(n, up, down, generator)
        return records.reshape(signal.shape)

    def gains(self, case: Case, fold: int) -> Tensor:
        sensors = tuple(self.half_step.nonzero()[:, 0].tolist())
        data = stretches(case, sensors)
        at = list(sensors)
        block = data.block / case.scene.rate
        half, up, down = (v[at, None].numpy() for v in (self.half_step, self.up / block, self.down / block))
        gain = switching_scores(data, half, up, down) - gaussian_scores(data, 0 * half, 1 + 0 * half)
        return torch.from_numpy(gain.sum((0, 1)))[in_fold(N_JUDGED, fold)]


def _without_best(data: Stretches, two: Best, rival: Best) -> Array:
    """Log likelihood over the Gaussian rival, `(sensor,)`, without the best stretches: steps show in a few."""
    half, up, down = np.exp(two.theta.T)[..., None]
    sd, tau = np.exp(rival.theta.T)[..., None]
    scores = switching_scores(data, half, up, down)[:, 0]
    over = scores - gaussian_scores(data, sd, tau)[:, 0]
    rest = np.argsort(np.argsort(over, axis=-1), axis=-1) < N_JUDGED - _LEFT_OUT
    return np.asarray((scores * rest).sum(-1) - best_gaussian(data, torch.from_numpy(rest)).value)


def _suspects(case: Case) -> tuple[int, ...]:
    """Sensors with wavelet coefficients that are not normal, or more power than the simulation's somewhere."""
    tails = kurtosis_p_values(case)
    odd = tails.amin(0) * len(tails) < _SUSPECT
    power = power_tails(case).nan_to_num(nan=1.0).masked_fill(case.recorded.power < case.simulated.power, 1.0)
    odd |= power.amin(-1) * power.shape[-1] < _SUSPECT
    return tuple(odd.nonzero()[:, 0].tolist())


def _levels(effect: RandomTelegraph, sensors: tuple[int, ...], rate: float) -> tuple[int, ...]:
    """Wavelet levels as long as the dwells."""
    dwells = [float(v[i]) * rate for v in (effect.up, effect.down) for i in sensors]
    return tuple(sorted({max(round(math.log2(max(d, 2.0))), 1) for d in dwells}))


def _path(n: int, up: float, down: float, generator: torch.Generator) -> Tensor:
    """A telegraph `(time,)` of values +-1, stationary."""
    mean = torch.tensor([up, down], dtype=torch.float64)
    first = int(torch.rand((), generator=generator, dtype=torch.float64) >= up / (up + down))
    ends: list[Tensor] = []
    total, state = 0.0, first
    while total < n:
        draws = torch.empty(64, dtype=torch.float64).exponential_(generator=generator)
        stays = draws * mean[(torch.arange(64) + state) % 2]
        ends.append(total + stays.cumsum(0))
        total = float(ends[-1][-1])
    switches = torch.searchsorted(torch.cat(ends), torch.arange(n, dtype=torch.float64), right=True)
    return 1.0 - 2.0 * ((switches + first) % 2)
