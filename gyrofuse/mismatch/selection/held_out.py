"""Scores on data that a repair has not seen: each fold of blocks with numbers estimated from the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.slow_ordinates import slow_gains
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.selection.classifier import distinguishability
from gyrofuse.mismatch.selection.discrepancy import differences_of_fold, discrepancy_of_fold, paired_discrepancy
from gyrofuse.mismatch.selection.shares import Share, shares_of
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold, sd_of_sum
from gyrofuse.mismatch.stats.limits import Z

_ACCEPTED_SD = 1.0  # standard deviations of its own scatter over blocks: the rule of one standard error
_BEYOND_DOUBT = 1e-6  # p value of what is only asked not to be worse: many numbers cost much of what is held out


class HeldOutScore(NamedTuple):
    """Held-out log score of a mechanism over none, in its own likelihood.

    Attributes:
        likelihood: Family of the likelihood.
        blocks: Score of each block while it was held out, nats, `(block,)`.
        by_fold: Mechanism with the numbers that each fold leaves.
        in_sample: Score of all blocks with the numbers that were found, nats.
    """

    likelihood: str
    blocks: Tensor
    by_fold: tuple[Mechanism, ...]
    in_sample: float

    @property
    def total(self) -> float:
        return float(self.blocks.sum())

    @property
    def sd(self) -> float:
        """Standard deviation of the total, from the scatter of the blocks."""
        return sd_of_sum(self.blocks)

    def confirms(self, p_value: float) -> bool:
        """Whether a finding of that p value holds on the blocks held out (the rule of one standard error).

        Numbers that hold only beside those of other mechanisms do not pass.
        """
        least = 0.0 if p_value < _BEYOND_DOUBT else _ACCEPTED_SD * self.sd
        return self.in_sample > 0 and self.total > least


class FamilyScore(NamedTuple):
    """Held-out log score of all findings of one likelihood, nats, with 95 % limits."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, scores: Sequence[HeldOutScore]) -> FamilyScore:
        """The sum of scores, with the scatter of its blocks."""
        if not scores:
            return cls(0.0, 0.0, 0.0)
        total, reach = sum(s.total for s in scores), Z * sd_of_sum(torch.stack([s.blocks for s in scores]).sum(0))
        return cls(total, total - reach, total + reach)


class HeldOut(NamedTuple):
    """Agreement of recording and simulation on data that no number was estimated from.

    Attributes:
        before: Discrepancy of wavelet cross-covariances per degree of freedom; 1 is what noise alone gives.
        after: The same with the repaired simulation.
        gain: Sum of the log scores of all findings, nats, with 95 % limits `low` and `high`; likelihoods of several
            families are of different data, so that only the `families` have a meaning of their own.
        auc_before: Area under the ROC curve of a classifier that tells windows of the one from windows of the other;
            0.5 is guessing.
        auc_after: The same of the recording as it came and what the repaired simulation makes.
        families: Log score of the findings of each likelihood, by its name.
        paired: Where something follows a channel of the recording, the discrepancy after it by the scatter of the
            recording's own blocks; else None.
        shares: Of the discrepancy, in the order of the repairs.
    """

    before: float
    after: float
    gain: float
    low: float
    high: float
    auc_before: float
    auc_after: float
    families: dict[str, FamilyScore]
    paired: float | None = None
    shares: tuple[Share, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Plain numbers, ready for JSON."""
        gain = {"value": self.gain, "low": self.low, "high": self.high}
        auc = {"before": self.auc_before, "after": self.auc_after}
        families = {name: score._asdict() for name, score in self.families.items()}
        return {
            "before": self.before,
            "after": self.after,
            "paired": self.paired,
            "shares": [share._asdict() for share in self.shares],
            "gain": gain,
            "families": families,
            "auc": auc,
        }


def score_held_out(comparison: Comparison, effect: Mechanism) -> HeldOutScore:
    """Log score of one mechanism on every block, its numbers estimated without the block's fold.

    Args:
        comparison: Recording and simulation in which the mechanism was found.
        effect: Mechanism with its numbers.
    """
    by_fold = numbers_by_fold(comparison, effect)
    blocks = torch.empty(N_JUDGED, dtype=torch.float64)
    for fold, one in enumerate(by_fold):
        blocks[in_fold(N_JUDGED, fold)] = one.held_out_scores(comparison, fold)
    in_sample = sum(float(effect.held_out_scores(comparison, fold).sum()) for fold in range(N_FOLDS))
    return HeldOutScore(effect.likelihood, blocks, by_fold, in_sample)


def share_of_record(score: HeldOutScore, comparison: Comparison) -> float:
    """Share of the blocks that gain, by their effective number.

    Slow ordinates of the whole record are of no block: what is seen in them most of all has no share, and counts as 1.
    """
    gained = score.blocks.clone()
    for fold, one in enumerate(score.by_fold):
        gained[in_fold(N_JUDGED, fold)] -= slow_gains(comparison, one.spectra, fold)
    if float(gained.sum()) < score.total / 2:
        return 1.0
    gained = gained.clamp(min=0)
    return float(gained.sum().square() / gained.square().sum().clamp(min=1e-300)) / len(gained)


def numbers_by_fold(comparison: Comparison, effect: Mechanism) -> tuple[Mechanism, ...]:
    """A mechanism with the numbers that each fold leaves."""
    return tuple(effect.fit_without(comparison, fold) for fold in range(N_FOLDS))


def score_beneath(
    comparison: Comparison, effect: Mechanism, later: Sequence[Mechanism], before: Comparison
) -> HeldOutScore:
    """The same where later mechanisms are applied already, with the numbers of each fold without them.

    Args:
        comparison: Recording and simulation with the later ones.
        effect: Mechanism with its numbers.
        later: The later ones.
        before: Recording and simulation without them.
    """
    judged = effect.beneath(later, before)
    score = score_held_out(comparison, judged)
    return score if judged is effect else score._replace(by_fold=numbers_by_fold(before, effect))


def agreement(start: Comparison, scores: Sequence[HeldOutScore], generator: torch.Generator) -> HeldOut:
    """Agreement before and after all repairs, on blocks that their numbers were not estimated from.

    Args:
        start: Recording and simulation as they came.
        scores: Held-out scores of the findings, in order.
        generator: Source of the random numbers of what is applied to the simulation.
    """
    before = after = [(discrepancy_of_fold(start, fold), distinguishability(start, fold)) for fold in range(N_FOLDS)]
    paired, courses = [], torch.zeros(N_FOLDS, len(scores), dtype=torch.float64)
    if scores:
        after = []
        for fold in range(N_FOLDS):
            left, effects = start, list[Mechanism]()
            for k, score in enumerate(scores):
                effect = score.by_fold[fold]
                if effect.refit_after_others:
                    effect = effect.fit_without(left, fold)
                left = effect.repair(left, generator)
                courses[fold, k] = discrepancy_of_fold(left, fold)
                effects.append(effect)
            after.append((float(courses[fold, -1]), distinguishability(_simulated(start, effects, generator), fold)))
            if any(effect.follows for effect in effects):
                paired.append(differences_of_fold(left, fold))
    (d, auc), (d_after, auc_after) = (
        torch.tensor(folds, dtype=torch.float64).mean(0).tolist() for folds in (before, after)
    )
    families = {
        name: FamilyScore.of([s for s in scores if s.likelihood == name])
        for name in dict.fromkeys(s.likelihood for s in scores)
    }
    return HeldOut(
        d,
        d_after,
        *FamilyScore.of(scores),
        auc,
        auc_after,
        families,
        paired=paired_discrepancy(paired) if paired else None,
        shares=shares_of(d, [score.by_fold[0] for score in scores], courses.mean(0).tolist()),
    )


def _simulated(start: Comparison, effects: Sequence[Mechanism], generator: torch.Generator) -> Comparison:
    """The recording as it came beside a simulation with all effects: one that was cleaned shows that it was."""
    for effect in sorted(effects, key=lambda effect: effect.order):
        start = effect.apply_to_reference(start, generator)
    return start
