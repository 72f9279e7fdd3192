"""The hierarchy of an answer: which share of a discrepancy each repair takes away, and what is left."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.selection.discrepancy import EXPLAINED


class Share(NamedTuple):
    """What one repair takes away of a discrepancy, where all before it are in.

    Attributes:
        name: Of the mechanism.
        identified: Whether it is physics with a name, and not a curve that stands for what is not understood.
        discrepancy: Per degree of freedom with this repair and all before it; 1 is what noise alone gives.
        share: What it took away, of what lay above noise alone before any repair; below 0 where it took away nothing.
    """

    name: str
    identified: bool
    discrepancy: float
    share: float


def shares_of(before: float, effects: Sequence[Mechanism], after: Sequence[float]) -> tuple[Share, ...]:
    """Shares of the effects in the order of their repair; none where there is little to share beside noise alone.

    Args:
        before: Discrepancy without repair.
        effects: In order.
        after: Discrepancies once each of them is repaired.
    """
    if before <= EXPLAINED:
        return ()
    left = [before, *after]
    return tuple(
        Share(effect.name, effect.identified, left[k + 1], (left[k] - left[k + 1]) / (before - 1))
        for k, effect in enumerate(effects)
    )
