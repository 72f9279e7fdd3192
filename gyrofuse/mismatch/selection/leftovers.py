"""What is left of a slow course and of the spectra once nothing with a name is found any more."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.mechanisms.catalogue import UNNAMED
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.selection.discrepancy import is_farther, leads_away
from gyrofuse.mismatch.selection.held_out import HeldOutScore, score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison


class Leftovers(NamedTuple):
    """Effects without a name that predict the blocks held out.

    Attributes:
        effects: Effects in the order in which they were repaired.
        scores: Held-out scores of each.
        comparison: Recording and simulation with all of them repaired.
    """

    effects: tuple[Mechanism, ...]
    scores: tuple[HeldOutScore, ...]
    comparison: Comparison


def repair_leftovers(
    start: Comparison,
    comparison: Comparison,
    unexplained: Sequence[TestResult],
    hidden: Sequence[int],
    generator: torch.Generator,
) -> Leftovers:
    """Repair what tests still see, so that the repaired simulation agrees with the recording there as well.

    Args:
        start: Recording and simulation as they came.
        comparison: The same with all findings repaired.
        unexplained: Results of tests that still see a difference.
        hidden: Positions of sensors in which nothing else can be seen, which are left as they are.
        generator: Source of the random numbers of what is applied to the simulation.
    """
    effects: tuple[Mechanism, ...] = ()
    scores: tuple[HeldOutScore, ...] = ()
    for kind in UNNAMED:
        p_values = [result.p_value for result in unexplained if result.test in kind.asked_for_by]
        if not p_values:
            continue
        effect = kind.left_over(comparison).but_for(hidden)
        score = score_held_out(comparison, effect)
        if not score.confirms(min(p_values)) or leads_away(start, comparison, score.by_fold, generator):
            continue
        made = effect.repair(comparison, generator)
        if is_farther(made, comparison):  # beside the simulation's lines, which what has no name filters as well
            continue
        effects, scores, comparison = (*effects, effect), (*scores, score), made
    return Leftovers(effects, scores, comparison)


def beside_curves(comparison: Comparison, generator: torch.Generator) -> Comparison:
    """Recording and simulation with all that is left of the spectra repaired, whether tests see it or not."""
    for kind in UNNAMED:
        if not kind.additive:
            comparison = kind.left_over(comparison).repair(comparison, generator)
    return comparison
