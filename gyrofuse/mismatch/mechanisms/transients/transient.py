"""What comes and goes: signals of a time and a place, which are taken off the recording and drawn anew elsewhere."""

from __future__ import annotations

from typing import ClassVar

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.likelihoods.noise_near import noise_along
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED
from gyrofuse.mismatch.signals.lines import whitened


class Transient(Mechanism):
    """A path that lies in one block of the recording, or in few, so that no other block tells its numbers.

    Every fourth sample is held out instead. The scores of four blocks together stand for one.
    """

    likelihood: ClassVar[str] = "transients"
    additive: ClassVar[bool] = True

    def path(self, n_samples: int, rate: float) -> Tensor:
        """What was found in the recording, `(sensor, time)`."""
        raise NotImplementedError

    def path_along(self, info: RecordingInfo, n_samples: int) -> Tensor:
        """The same in a recording with these channels, which by default it does not follow."""
        return self.path(n_samples, info.rate)

    def drawn(self, n_samples: int, rate: float, generator: torch.Generator) -> Tensor:
        """The same at other times, for one record, `(sensor, time)`."""
        raise NotImplementedError

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        records = signal.reshape(-1, *signal.shape[-2:])
        drawn = [record + self.drawn(signal.shape[-1], info.rate, generator) for record in records]
        return torch.stack(drawn).view_as(signal)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        white = comparison.white
        taken = whitened(self.path_along(comparison.info, comparison.n_samples), comparison.base)
        gains = held_out_sums(white * taken - taken.square() / 2, fold)
        return in_fours((gains / noise_along(taken, white - taken).clamp(min=1e-300)).sum(0))

    def gained(self, comparison: Comparison, numbers: int) -> float:
        """Log likelihood ratio in sample less what so many numbers cost, nats: which course it is, it says as well."""
        path = self.path_along(comparison.info, comparison.n_samples)
        return path_gain(comparison, path) - NATS_PER_NUMBER * numbers

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        return signal - self.path_along(info, signal.shape[-1])

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        return comparison.subtract(self.path_along(comparison.info, comparison.n_samples))

    def apply_elsewhere(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """It comes at other times there."""
        return self.apply_to_reference(comparison, generator)


def path_gain(comparison: Comparison, path: Tensor) -> float:
    """Log likelihood ratio of a path `(sensor, time)` to none, nats."""
    taken = whitened(path, comparison.base)
    return float((comparison.white * taken - taken.square() / 2).sum())


def hourly(count: int, duration_s: float) -> Parameter:
    """Events an hour with 95 % limits, of as many in so many seconds (Poisson)."""
    hours = duration_s / 3600
    low, high = (float(stats.chi2.ppf(q, 2 * (count + more))) / 2 / hours for q, more in ((0.025, 0), (0.975, 1)))
    return Parameter(count / hours, low, high, "1/h")


def often_words(count: int, often: Parameter) -> str:
    """Words of how often events come, where they are enough to say."""
    fewest = 5
    return f", {often.value:.3g} an hour" if count >= fewest else ""


def held_out_sums(gains: Tensor, fold: int) -> Tensor:
    """Sums of gains `(..., time)` over the samples of each block that a fold holds out, `(..., N_JUDGED)`."""
    n = gains.shape[-1]
    block = n // N_JUDGED
    return (gains * ~kept_of(n, fold))[..., : N_JUDGED * block].unflatten(-1, (N_JUDGED, block)).sum(-1)


def in_fours(scores: Tensor) -> Tensor:
    """Scores `(N_JUDGED,)` of four blocks together, which stand for one, as every fourth sample is held out."""
    return scores.view(N_JUDGED // N_FOLDS, N_FOLDS).sum(-1)


def kept_of(n_samples: int, fold: int) -> Tensor:
    """Samples that a fold does not hold out, `(time,)`."""
    return torch.arange(n_samples) % N_FOLDS != fold
