"""Samples read twice: a bus that is faster than the sensor, or a value that was not ready."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CHANCE
from gyrofuse.mismatch.detectors.values.median_windows import median_windows
from gyrofuse.mismatch.detectors.values.ties import missing_recurrences
from gyrofuse.mismatch.detectors.values.values import repeats, repeats_so_far
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.values.rounding.dead_band import DeadBand
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.signals.prediction_errors import predicted
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak
from gyrofuse.mismatch.stats.segments import runs_of

_TOGETHER = 0.5  # share of the repeats that all have at once, beyond chance
_OFTEN = 1e-3  # probability of a repeat by chance, from which rows are not all the mechanism's
_LONG = 4.0  # mean length of rows of repeats, from which a sensor hangs


@dataclass(frozen=True, eq=False)
class StuckSamples(Mechanism):
    """`y_t = y_{t-1}` with probability `p`, else `x_t`: more repeats than the values' own resolution makes.

    On a lattice they are counted against those of the rounded simulation. Repeats come in rows, of one where every
    second sample is read twice, of many where a sensor hangs: a Markov chain with their mean length.

    Attributes:
        probability: `(sensor,)`.
        by_chance: `(sensor,)`, of a repeat without the mechanism.
        together: Whether all the sensors concerned repeat at the same time.
        row: Mean number of repeats one after the other, `(sensor,)`; `1 / (1 - p)` where it is empty.
        filler: Value that stands in the place of samples, `(sensor,)`, unit of the signal; empty where the last one is
            held. Without rows it stands for single ones.
    """

    name: ClassVar[str] = "stuck_samples"
    likelihood: ClassVar[str] = "values"
    separated_by: ClassVar[str] = "counters or timestamps of the samples"
    stage: ClassVar[int] = 3
    probability: OfSensors
    by_chance: OfSensors
    together: bool
    row: tuple[float, ...] = ()
    filler: tuple[float, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found = repeats(comparison)
        p_values = [sidak(float(p), comparison.n_sensors) for p in found.p_values]
        band = DeadBand.detect_and_fit(comparison, level)  # puts out its value several times running as well
        others = {*median_windows(comparison).within(level), *(() if band is None else band.sensors)}
        sensors = tuple(i for i, p in enumerate(p_values) if p <= level and i not in others)
        if not sensors:
            return cls._filled_in(comparison, level, tuple(others))
        effect = cls._estimated(comparison, sensors, torch.ones(comparison.n_samples, dtype=torch.bool))
        parameters = {}
        for i in sensors:
            value = float(effect.probability[i])
            own = float(found.share[i])
            runs = run_lengths(found.same[i])
            # Samples that repeat one after the other are one event.
            clustered = float(runs.square().sum() / runs.sum()) if len(runs) else 1.0
            spread = math.sqrt(own * (1 - own) * clustered / found.n)
            sd = math.hypot(float(found.sd[i]), spread) / (1 - float(effect.by_chance[i]))
            parameters[f"probability[{i}]"] = Parameter.around(value, Z * sd, "", least=0.0, most=1.0)
        where, longest = comparison.info.named(sensors, "all sensors"), max(effect.row)
        hangs = f", {longest:.0f} times one after the other" if longest > _LONG else ""
        largest = max(sensors, key=lambda i: float(effect.probability[i]))
        jointly = " at the same time" if effect.together else ""
        unit = comparison.info.measure
        what = "samples repeat the one before"
        if effect.filler:
            values = sorted({f"{effect.filler[i]:.6g}" for i in sensors})
            what = f"samples are {' and '.join(values)} {unit}, which stands in their place"
        return effect.found(
            f"{what}{hangs}{jointly} in {where}, with a probability of up to "
            f"{float(effect.probability[largest]):.3g} (sensor {comparison.info.sensors[largest]}), "
            f"where the simulation has {float(effect.by_chance[largest]):.2g}",
            min(p_values),
            sensors,
            parameters,
            levels=(1,),
            gain=float(effect._scores(comparison).sum()),
        )

    @classmethod
    def _filled_in(cls, comparison: Comparison, level: float, but_for: tuple[int, ...]) -> Finding | None:
        """A value that stands for single samples, as where a read failed; it recurs, and others do not."""
        found = {
            i: pair for i, pair in missing_recurrences(comparison).items() if pair[1] <= level and i not in but_for
        }
        if not found:
            return None
        p, info, n = comparison.n_sensors, comparison.info, comparison.n_samples
        sensors, filler, chance = tuple(sorted(found)), [0.0] * p, torch.zeros(p, dtype=torch.float64)
        for i, (value, _) in found.items():
            filler[i], chance[i] = value.value, value.expected / n
        concerned = torch.zeros(p, dtype=torch.float64)
        concerned[list(sensors)] = 1.0
        whole = torch.ones(n, dtype=torch.bool)
        effect = cls(concerned, chance, False, (), tuple(filler))._with_share(comparison, whole)
        parameters = {}
        for i in sensors:
            share = float(effect.probability[i])
            reach = Z * math.sqrt(share * (1 - share) / n)
            parameters[f"probability[{i}]"] = Parameter.around(share, reach, "", least=0.0, most=1.0)
        largest = max(sensors, key=lambda i: float(effect.probability[i]))
        values = sorted({f"{filler[i]:.6g}" for i in sensors})
        return effect.found(
            f"single samples are {' and '.join(values)} {info.measure}, which stands in their place"
            f"{' at the same time' if effect.together else ''} in {info.named(sensors, 'all sensors')}, with a "
            f"probability of up to {float(effect.probability[largest]):.3g} (sensor {info.sensors[largest]})",
            min(pair[1] for pair in found.values()),
            sensors,
            parameters,
            levels=(1,),
            gain=float(effect._scores(comparison).sum()),
        )

    def _with_share(self, comparison: Comparison, keep: Tensor) -> StuckSamples:
        """With the share of the samples to keep that a value stands for."""
        held = self._held(comparison)[:, keep]
        share = torch.where(self.probability > 0, held.to(torch.float64).mean(-1), 0.0)
        at = self.probability.nonzero()[:, 0].tolist()
        return replace(self, probability=share, together=at_once(held[at], share[at]))

    @property
    def _single(self) -> bool:
        """Whether a value stands for single samples."""
        return bool(self.filler) and not self.row

    def _held(self, comparison: Comparison) -> Tensor:
        """Samples that are none of their own, `(sensor, time)`."""
        if not self._single:
            return repeats(comparison).same
        held = comparison.recording == torch.tensor(self.filler, dtype=torch.float64)[:, None]
        return held & (self.probability > 0)[:, None]

    @classmethod
    def _estimated(cls, comparison: Comparison, sensors: tuple[int, ...], keep: Tensor) -> StuckSamples:
        every = repeats(comparison).same
        same = every[:, keep]
        chance = repeats(comparison).expected.clamp(max=0.999)
        share = same.to(torch.float64).mean(-1)
        concerned = torch.zeros(comparison.n_sensors, dtype=torch.bool)
        concerned[list(sensors)] = True
        probability = torch.where(concerned, ((share - chance) / (1 - chance)).clamp(min=0), 0.0)
        at = list(sensors)
        together = at_once(same[at], probability[at])
        length = [
            _mean_row(row, float(c), float(p)) if p > 0 else 1.0
            for row, c, p in zip(every, chance, probability, strict=True)
        ]
        held = [comparison.recording[i][_long_rows(every[i], max(length[i], _LONG))[:, 0]] for i in at]
        filler = [_filler(values, held) for values in held]
        known = [value for value in filler if value is not None]
        put_out = dict(zip(at, known, strict=True)) if len(known) == len(at) else {}
        fills = tuple(put_out.get(i, 0.0) for i in range(comparison.n_sensors)) if put_out else ()
        return cls(probability, chance, together, tuple(length), fills)

    def fit_without(self, comparison: Comparison, fold: int) -> StuckSamples:
        keep = estimation_samples(comparison.n_samples, fold)
        if self._single:
            return self._with_share(comparison, keep)
        found = self._estimated(comparison, tuple(self.probability.nonzero()[:, 0].tolist()), keep)
        # Where it hung once or twice none may be left: half a row stands for what that says of how often it does.
        half = self._length / (2 * int(keep.sum()))
        seldom = (self.probability > 0) & (found.probability < half)
        probability = torch.where(seldom, half, found.probability)
        length = torch.where(seldom, self._length, found._length)
        return replace(found, probability=probability, row=tuple(length.tolist()))

    def is_seen(self, comparison: Comparison) -> bool:
        """Whether noise that was found later leaves values of few digits repeating as seldom as they did."""
        own = repeats(comparison).p_values[self.probability > 0]
        return self._single or sidak(float(own.min()), len(own)) <= CHANCE

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        if self._single:
            spread = float(comparison.recording[sensor].std())
            pictures.values(ax, comparison, sensor, self.filler[sensor], spread)
            return
        again = repeats(comparison).same[sensor].nonzero()[:, 0]
        first = int(again[0]) - 20 if len(again) else 0
        pictures.samples(ax, comparison, sensor, first, 60)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        n, records = signal.shape[-1], signal.reshape(-1, *signal.shape[-2:])
        held = taken_rows(records, self.probability, self._length, self.together, generator)
        held[..., 0] = False
        if self.filler:  # in the place of the first one of a row as well
            if not self._single:
                held |= torch.nn.functional.pad(held[..., 1:], (0, 1)) & (self.probability > 0)[:, None]
            values = torch.tensor(self.filler, dtype=signal.dtype)[:, None]
            return torch.where(held, values, records).view(signal.shape)
        source = torch.where(held, 0, torch.arange(n)).cummax(-1).values
        return records.gather(-1, source).view(signal.shape)

    @property
    def _length(self) -> Tensor:
        """Mean length of a row, `(sensor,)`."""
        if self.row:
            return torch.tensor(self.row, dtype=torch.float64)
        return 1 / (1 - self.probability.clamp(max=1 - 1e-9))

    def _hangs_beside_chance(self, sensor: int) -> bool:
        """Whether rows of repeats have to be longer than those of chance to be told from them."""
        return bool(self.row) and self.row[sensor] > _LONG and float(self.by_chance[sensor]) > _OFTEN

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """Where a sensor hangs for long, noise as simulated takes the place of what it puts out.

        Single samples are predicted from their neighbours.
        """
        if self._single:
            return comparison.with_recording(predicted(comparison.observed, self._held(comparison), generator))
        if max(self.row, default=0.0) <= _LONG:
            return self.apply_to_reference(comparison, generator)
        filled = comparison.recording.clone()
        for i in self.probability.nonzero()[:, 0].tolist():
            if self.row[i] > _LONG:
                longest = _longest_by_chance(comparison.n_samples, float(self.by_chance[i]))
                rows = [row for row in runs_of(repeats(comparison).same[i]).tolist() if row[1] - row[0] > longest]
                if self.filler:
                    rows = runs_of(comparison.recording[i] == self.filler[i]).tolist()
                fill_rows(filled[i], rows, comparison.reference.signal[0, i])
        return comparison.with_recording(filled)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison), fold).sum((0, -1))

    def _scores(self, comparison: Comparison) -> Tensor:
        """Log likelihood ratio of each sample's being a repeat or not, `(sensor, time)`."""
        # A simulation without any repeats does not say that they are impossible.
        chance = self.by_chance.clamp(min=0.5 / comparison.reference.signal[:, 0].numel())
        enter, leave = turns(self.probability, self._length)
        same = self._held(comparison)
        held = torch.zeros(same.shape, dtype=torch.float64)
        for i in self.probability.nonzero()[:, 0].tolist():
            seen = _longest_by_chance(len(same[i]), float(chance[i])) if self._hangs_beside_chance(i) else 1.0
            before = torch.nn.functional.pad(repeats_so_far(same[i])[:-1], (1, 0)) >= seen
            held[i] = torch.where(before, 1 - leave[i], enter[i] if seen == 1 else 0.0)
        chance = chance[:, None]
        stuck = (chance + held * (1 - chance)).clamp(min=1e-9, max=1 - 1e-9)
        scores = repeat_scores(same, stuck, chance)
        return torch.where(self.probability[:, None] > 0, scores, 0.0)


def repeat_scores(same: Tensor, expected: Tensor, chance: Tensor) -> Tensor:
    """Log likelihood ratio of repeats `(sensor, time)` that have a probability, over the one that chance has."""
    return torch.where(same, (expected / chance).log(), ((1 - expected) / (1 - chance)).log())


def turns(probability: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Probabilities that a row of a mean length begins with a sample, and that it ends before the next, `(sensor,)`."""
    p = probability.clamp(max=1 - 1e-9)
    length = length.clamp(min=1.0).maximum(p / (1 - p))  # no more rows than samples between them
    return (p / (1 - p) / length).clamp(max=1.0), 1 / length


def taken_rows(
    records: Tensor, probability: Tensor, length: Tensor, together: bool, generator: torch.Generator
) -> Tensor:
    """Rows of samples of `(record, sensor, time)` that are none of their own, drawn by a Markov chain.

    Args:
        records: Signals.
        probability: Share of the samples, `(sensor,)`.
        length: Mean length of a row, `(sensor,)`.
        together: Whether all sensors that have such rows have them at the same time.
        generator: Source of randomness.
    """
    taken = torch.zeros(records.shape, dtype=torch.bool)
    enter, leave = turns(probability, length)
    largest = int(probability.argmax())
    for record in taken:
        for i in probability.nonzero()[:, 0].tolist():
            if not together or i == largest:
                record[i] = _rows(records.shape[-1], float(enter[i]), float(leave[i]), generator)
        if together:
            record[probability > 0] = record[largest].clone()
    return taken


def run_lengths(true: Tensor) -> Tensor:
    """Lengths of the runs of true entries of `(time,)`, `(run,)`."""
    return runs_of(true).diff()[:, 0].to(torch.float64)


def at_once(held: Tensor, probability: Tensor) -> bool:
    """Whether several sensors `(sensor, time)` put out none of their own at the same time, beyond chance."""
    jointly = float(held.all(0).to(torch.float64).mean() - held.to(torch.float64).mean(-1).prod())
    return len(held) > 1 and jointly > _TOGETHER * float(probability.min())


def _long_rows(same: Tensor, long: float) -> Tensor:
    """First and last samples of the rows of repeats `(time,)` beyond half a length, `(row, 2)`."""
    rows = runs_of(same)
    return rows[rows.diff()[:, 0] > long / 2]


def _filler(values: Tensor, of_all: list[Tensor]) -> float | None:
    """The value that nearly all rows `(row,)` of a sensor hold; None where they hold their own, or are too few.

    Args:
        values: Of the rows of this sensor.
        of_all: Of those of each sensor.
    """
    fewest, nearly_all = 3, 0.9
    own, counts = values.unique(return_counts=True)
    if not len(own) or int(counts.max()) <= nearly_all * len(values):
        return None
    value = own[counts.argmax()]
    return float(value) if sum(int((rows == value).sum()) for rows in of_all) >= fewest else None


def _rows(n: int, enter: float, leave: float, generator: torch.Generator) -> Tensor:
    """Rows of repeats of a Markov chain with two states, `(time,)`."""
    cycle = 1 / enter + 1 / leave
    count = 16 + int(2 * n / cycle)
    held = torch.zeros(n, dtype=torch.bool)
    at = -int(float(torch.rand((), generator=generator, dtype=torch.float64)) * cycle)
    while at < n:
        gaps, lengths = (
            1 + (u.log() / math.log1p(-min(p, 1 - 1e-12))).floor().clamp(max=n)
            for u, p in zip(torch.rand(2, count, generator=generator, dtype=torch.float64), (enter, leave), strict=True)
        )
        ends = at + (gaps + lengths).cumsum(0)
        change = torch.zeros(n + 1, dtype=torch.int64)
        for place, sign in ((ends - lengths, 1), (ends, -1)):
            change.index_add_(0, place.clamp(0, n).long(), torch.full((count,), sign))
        held |= change[:-1].cumsum(0) > 0
        at = int(ends[-1])
    return held


def _mean_row(same: Tensor, chance: float, probability: float) -> float:
    """Mean length of the rows of repeats `(time,)`: of those beyond chance, where these are most of what is.

    Where chance repeats samples as well, shorter rows are taken for those of independent repeats.
    """
    lengths = run_lengths(same)
    long = lengths[lengths > _longest_by_chance(len(same), chance)]
    if float(long.sum()) > (float(lengths.sum()) - chance * len(same)) / 2:
        return float(long.mean()) if len(long) else 1.0
    return float(lengths.mean()) if chance < _OFTEN and len(lengths) else 1 / (1 - min(probability, 0.999))


def _longest_by_chance(n: int, chance: float) -> float:
    """Length of a row of repeats that chance exceeds in one recording of a thousand."""
    return max(_LONG, math.log(1e3 * n) / -math.log(max(chance, 1e-12)))


def fill_rows(signal: Tensor, rows: list[list[int]], simulated: Tensor) -> None:
    """Put simulated noise, from the mean before to that after, in the place of rows of samples `(time,)`.

    Args:
        signal: Recording, `(time,)`, which is changed.
        rows: First samples of the rows, and those after their last ones.
        simulated: Simulation, `(time,)`.
    """
    near = 16  # samples of a mean
    whole = signal.clone()
    for a, b in rows:
        n = b - a
        at = near + a % max(len(simulated) - n - 2 * near, 1)
        place = torch.arange(at, at + n) % len(simulated)
        (low, high), (before, after) = (
            (part[max(first - near, 0) : first], part[last : last + near])
            for part, first, last in ((simulated, at, at + n), (whole, a - 1, b))
        )
        ends = [
            float(there.mean() if len(there) else whole.mean()) - float(own.mean() if len(own) else simulated.mean())
            for own, there in ((low, before), (high, after))
        ]
        signal[a:b] = simulated[place] + torch.linspace(ends[0], ends[1], n, dtype=signal.dtype)
