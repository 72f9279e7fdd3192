"""Samples read twice: a bus that is faster than the sensor, or a value that was not ready."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.values import repeated, repeats
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Parameter
from gyrofuse.mismatch.mechanisms.values.dead_band import DeadBand
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_TOGETHER = 0.5  # share of the repeats that all have at once, beyond chance


@dataclass(frozen=True, eq=False)
class StuckSamples(Mechanism):
    """`y_t = y_{t-1}` with probability `p`, else `x_t`: more repeats than the values' own resolution makes.

    On a lattice they are counted against those of the rounded simulation.

    Attributes:
        probability: `(sensor,)`.
        by_chance: `(sensor,)`, of a repeat without the mechanism.
        together: Whether all the sensors concerned repeat at the same time.
    """

    name: ClassVar[str] = "stuck_samples"
    likelihood: ClassVar[str] = "values"
    separated_by: ClassVar[str] = "counters or timestamps of the samples"
    stage: ClassVar[int] = 3
    probability: OfSensors
    by_chance: OfSensors
    together: bool

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found = repeats(comparison)
        p_values = [sidak(float(p), comparison.n_sensors) for p in found.p_values]
        band = DeadBand.detect_and_fit(comparison, level)  # puts out its value several times running as well
        sensors = tuple(i for i, p in enumerate(p_values) if p <= level and (band is None or i not in band.sensors))
        if not sensors:
            return None
        effect = cls._estimated(comparison, sensors, torch.ones(comparison.n_samples, dtype=torch.bool))
        parameters = {}
        same = repeated(comparison.recording)
        for i in sensors:
            value = float(effect.probability[i])
            own = float(found.share[i])
            runs = run_lengths(same[i])
            # Samples that repeat one after the other are one event.
            clustered = float(runs.square().sum() / runs.sum()) if len(runs) else 1.0
            spread = math.sqrt(own * (1 - own) * clustered / found.n)
            sd = math.hypot(float(found.sd[i]), spread) / (1 - float(effect.by_chance[i]))
            parameters[f"probability[{i}]"] = Parameter(value, max(value - Z * sd, 0.0), min(value + Z * sd, 1.0), "")
        where = comparison.info.named(sensors, "all sensors")
        largest = max(sensors, key=lambda i: float(effect.probability[i]))
        jointly = " at the same time" if effect.together else ""
        return Finding(
            cls.name,
            effect,
            f"samples repeat the one before{jointly} in {where}, with a probability of up to "
            f"{float(effect.probability[largest]):.3g} (sensor {comparison.info.sensors[largest]}), "
            f"where the simulation has {float(effect.by_chance[largest]):.2g}",
            min(p_values),
            sensors,
            parameters,
            levels=(1,),
            gain=float(effect._scores(comparison).sum()),
        )

    @classmethod
    def _estimated(cls, comparison: Comparison, sensors: tuple[int, ...], keep: Tensor) -> StuckSamples:
        same = repeated(comparison.recording)[:, keep]
        chance = repeats(comparison).expected.clamp(max=0.999)
        share = same.to(torch.float64).mean(-1)
        concerned = torch.zeros(comparison.n_sensors, dtype=torch.bool)
        concerned[list(sensors)] = True
        probability = torch.where(concerned, ((share - chance) / (1 - chance)).clamp(min=0), 0.0)
        at = list(sensors)
        jointly = float(same[at].all(0).to(torch.float64).mean() - share[at].prod())
        together = len(at) > 1 and jointly > _TOGETHER * float(probability[at].min())
        return cls(probability, chance, together)

    def fit_without(self, comparison: Comparison, fold: int) -> StuckSamples:
        keep = estimation_samples(comparison.n_samples, fold)
        return self._estimated(comparison, tuple(self.probability.nonzero()[:, 0].tolist()), keep)

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        repeats = repeated(comparison.recording)[sensor].nonzero()[:, 0]
        first = int(repeats[0]) - 20 if len(repeats) else 0
        pictures.samples(ax, comparison, sensor, first, 60)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        n = signal.shape[-1]
        draws = (*signal.shape[:-2], 1, n) if self.together else signal.shape
        held = torch.rand(draws, generator=generator, dtype=torch.float64) < self.probability[:, None]
        held[..., 0] = False
        source = torch.where(held, 0, torch.arange(n)).cummax(-1).values
        return signal.gather(-1, source)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison), fold).sum((0, -1))

    def _scores(self, comparison: Comparison) -> Tensor:
        """Log likelihood ratio of each sample's being a repeat or not, `(sensor, time)`."""
        # A simulation without any repeats does not say that they are impossible.
        chance = self.by_chance.clamp(min=0.5 / comparison.reference.signal[:, 0].numel())
        stuck = chance + self.probability * (1 - chance)
        stuck = stuck.clamp(max=1 - 1e-9)
        yes, no = (stuck / chance).log(), ((1 - stuck) / (1 - chance)).log()
        scores = torch.where(repeated(comparison.recording), yes[:, None], no[:, None])
        return torch.where(self.probability[:, None] > 0, scores, 0.0)


def run_lengths(true: Tensor) -> Tensor:
    """Lengths of the runs of true entries of `(time,)`, `(run,)`."""
    edges = torch.nn.functional.pad(true.to(torch.int8), (1, 1)).diff().nonzero()[:, 0]
    return edges.diff()[::2].to(torch.float64)
