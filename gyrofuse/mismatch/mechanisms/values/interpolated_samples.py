"""Lost samples whose place a straight line fills, from the last one that came to the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.straight_lines import straight_lines
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.values.stuck_samples import (
    StuckSamples,
    at_once,
    fill_rows,
    repeat_scores,
    run_lengths,
    taken_rows,
)
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak
from gyrofuse.mismatch.stats.segments import runs_of


@dataclass(frozen=True, eq=False)
class InterpolatedSamples(Mechanism):
    """`y_t` on the line from the last sample before a gap to the first one after it: packets that were lost.

    Noise does not lie on a line to the last digit. Gaps come at random times, by a Markov chain.

    Attributes:
        probability: Share of the samples that lie on such lines, `(sensor,)`.
        row: Mean number of lost samples one after the other, `(sensor,)`; 1 in those that lost none.
        by_chance: Probability of a sample on a line without the mechanism, `(sensor,)`.
        together: Whether all the sensors concerned lose samples at the same time.
    """

    name: ClassVar[str] = StuckSamples.name
    likelihood: ClassVar[str] = StuckSamples.likelihood
    separated_by: ClassVar[str] = StuckSamples.separated_by
    stage: ClassVar[int] = StuckSamples.stage
    probability: OfSensors
    row: OfSensors
    by_chance: OfSensors
    together: bool

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        lines, info, n = straight_lines(comparison), comparison.info, comparison.n_samples
        p_values = [sidak(float(p), comparison.n_sensors) for p in lines.p_values]
        sensors = tuple(i for i, p in enumerate(p_values) if p <= level)
        if not sensors:
            return None
        effect = cls._estimated(comparison, sensors, torch.ones(n, dtype=torch.bool))
        parameters = {}
        for i in sensors:
            share, lengths = float(effect.probability[i]), run_lengths(lines.inside[i])
            reach = Z * float(lengths.square().sum().sqrt()) / n  # each gap comes or does not
            parameters[f"probability[{i}]"] = Parameter.around(share, reach, "", least=0.0, most=1.0)
        largest = max(sensors, key=lambda i: float(effect.probability[i]))
        jointly = " at the same time" if effect.together else ""
        return effect.found(
            f"samples lie on straight lines between others, as where lost ones were filled in, "
            f"{float(effect.row[largest]):.3g} one after the other{jointly} in {info.named(sensors, 'all sensors')}, "
            f"{100 * float(effect.probability[largest]):.3g} % of them (sensor {info.sensors[largest]})",
            min(p_values),
            sensors,
            parameters,
            levels=(1,),
            gain=float(effect._scores(comparison).sum()),
        )

    @classmethod
    def _estimated(cls, comparison: Comparison, sensors: tuple[int, ...], keep: Tensor) -> InterpolatedSamples:
        lines = straight_lines(comparison)
        concerned = torch.zeros(comparison.n_sensors, dtype=torch.bool)
        concerned[list(sensors)] = True
        probability = torch.where(concerned, lines.inside[:, keep].to(torch.float64).mean(-1), 0.0)
        row = torch.ones_like(probability)
        for i in sensors:
            row[i] = run_lengths(lines.inside[i]).mean()
        at = list(sensors)
        return cls(probability, row, lines.by_chance, at_once(lines.inside[at][:, keep], probability[at]))

    def fit_without(self, comparison: Comparison, fold: int) -> InterpolatedSamples:
        keep = estimation_samples(comparison.n_samples, fold)
        return self._estimated(comparison, tuple(self.probability.nonzero()[:, 0].tolist()), keep)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        rows = runs_of(straight_lines(comparison).inside[sensor])
        pictures.samples(ax, comparison, sensor, int(rows[0, 0]) - 20 if len(rows) else 0, 60)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        records = signal.reshape(-1, *signal.shape[-2:])
        lost = taken_rows(records, self.probability, self.row, self.together, generator)
        lost[..., 0] = lost[..., -1] = False
        at = torch.arange(signal.shape[-1])
        before = torch.where(lost, 0, at).cummax(-1).values
        after = torch.where(lost, len(at), at).flip(-1).cummin(-1).values.flip(-1)
        share = (at - before).to(signal.dtype) / (after - before).clamp(min=1)
        ends = (records.gather(-1, before), records.gather(-1, after))
        return torch.where(lost, torch.lerp(*ends, share), records).view(signal.shape)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """Noise as simulated takes the place of what was filled in: what is left is noise that nothing is lost of."""
        filled = comparison.recording.clone()
        for i in self.probability.nonzero()[:, 0].tolist():
            rows = runs_of(straight_lines(comparison).inside[i]).tolist()
            fill_rows(filled[i], rows, comparison.reference.signal[0, i])
        return comparison.with_recording(filled)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison), fold).sum((0, -1))

    def _scores(self, comparison: Comparison) -> Tensor:
        """Log likelihood ratio of each sample's being on a line or not, `(sensor, time)`."""
        chance = self.by_chance.clamp(min=0.5 / comparison.reference.signal[:, 0].numel())[:, None]
        inside = straight_lines(comparison).inside
        expected = (chance + self.probability[:, None] * (1 - chance)).clamp(min=1e-9, max=1 - 1e-9)
        scores = repeat_scores(inside, expected, chance)
        return torch.where(self.probability[:, None] > 0, scores, 0.0)
