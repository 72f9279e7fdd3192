"""Forward selection: the strongest finding of each stage is repaired, and the stage is searched again."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import NamedTuple

import torch

from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.mechanisms.catalogue import AGAIN, STAGES
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, repaired
from gyrofuse.mismatch.selection.discrepancy import leads_away
from gyrofuse.mismatch.selection.held_out import HeldOutScore, numbers_by_fold, score_held_out, share_of_record
from gyrofuse.mismatch.selection.residue import is_left_of_form
from gyrofuse.mismatch.signals.comparison import Comparison

_MOST, _MOST_OF_A_KIND = 20, 6  # findings: a recording that needs more is another instrument


class Selected(NamedTuple):
    """A finding, and what it was found in.

    Attributes:
        finding: Finding with its held-out score.
        before: Recording and simulation in which it was found.
        score: Its held-out score there.
    """

    finding: Finding
    before: Comparison
    score: HeldOutScore


def select(
    start: Comparison,
    level: float,
    generator: torch.Generator,
    progress: Callable[[str, float], None],
    but_for: Collection[type[Mechanism]] = (),
) -> tuple[list[Selected], Comparison]:
    """Findings in the order in which they were found, and recording and simulation with all of them repaired.

    A finding is taken if it scores on the blocks held out, and if the simulation that has it is no farther from the
    recording than before. Of the findings of a stage the one that explains most is taken first.

    Args:
        start: Recording and simulation as they came.
        level: Largest p value of a finding.
        generator: Source of the random numbers of what is applied to the simulation.
        progress: Function of what is searched for, and of the share of the stages that are done.
        but_for: Mechanisms that are not searched for.
    """
    stages = [tuple(kind for kind in stage if kind not in but_for) for stage in STAGES]
    comparison, selected = start, list[Selected]()
    for number, stage in enumerate(stages):
        if len({i for one in selected for i in one.finding.hides}) == start.n_sensors:
            break
        progress(", ".join(kind.name for kind in stage), number / len(stages))
        before = len(selected)
        comparison = _exhausted(stage, selected, start, comparison, level, generator)
        if number in AGAIN and len(selected) > before:
            comparison = _exhausted(stages[AGAIN[number]], selected, start, comparison, level, generator)
    return selected, comparison


def _exhausted(
    stage: tuple[type[Mechanism], ...],
    selected: list[Selected],
    start: Comparison,
    comparison: Comparison,
    level: float,
    generator: torch.Generator,
) -> Comparison:
    """Recording and simulation with all of a stage repaired; what is found is added to what was."""
    while len(selected) < _MOST:
        best = _best_of_stage(stage, selected, start, comparison, level, generator)
        if best is None:
            break
        selected.append(best)
        comparison = best.finding.repair(comparison, generator)
    return comparison


def _best_of_stage(
    stage: tuple[type[Mechanism], ...],
    selected: list[Selected],
    start: Comparison,
    comparison: Comparison,
    level: float,
    generator: torch.Generator,
) -> Selected | None:
    """The finding of a stage that explains most among those that hold; None without one."""
    known = [one.finding for one in selected]
    found = []
    for kind in stage:
        if sum(f.mechanism == kind.name for f in known) >= _MOST_OF_A_KIND:
            continue
        finding = kind.detect_and_fit(comparison, level * kind.level_after_repairs if known else level)
        if finding is not None and not is_known(finding, known):
            found.append(finding)
    # What follows a channel has a cause that is known to be there: of equals it comes first.
    for finding in sorted(found, key=lambda f: -f.gain - NATS_AS_GOOD * (f.channel is not None)):
        if selected and finding.effect.of_spectra and is_left_of_form(finding.effect, start, comparison):
            continue
        score = _held(finding, finding.effect, start, comparison, generator)
        if score is None:
            score = _held_in_company(finding, start, comparison, generator)
        if score is not None:
            return Selected(replace(finding, held_out_gain=score.total), comparison, score)
    failed = sorted({f.mechanism for f in found if f.effect.of_spectra} - {*comparison.passed_over})
    if not failed:
        return None
    # What is fitted beside what does not hold may well do.
    spectral = tuple(kind for kind in stage if kind.of_spectra)
    beside = replace(comparison, passed_over=(*comparison.passed_over, *failed))
    again = _best_of_stage(spectral, selected, start, beside, level, generator)
    return None if again is None else again._replace(before=comparison)


def _held(
    finding: Finding, effect: Mechanism, start: Comparison, comparison: Comparison, generator: torch.Generator
) -> HeldOutScore | None:
    """Score of a finding's effect on the blocks held out; None where it does not hold there, or leads away."""
    score, steady = score_held_out(comparison, effect), 0.2  # share of the record in which what never changes is seen
    if effect.of_spectra and share_of_record(score, comparison) < steady:  # what a pulse left, or an episode
        return None
    if score.confirms(finding.p_value) and not leads_away(start, comparison, score.by_fold, generator):
        return score
    return None


def _held_in_company(
    finding: Finding, start: Comparison, comparison: Comparison, generator: torch.Generator
) -> HeldOutScore | None:
    """Its score beside what it was found with, where these hold together: each by itself may lead away."""
    alone, company = finding.effect.with_company(comparison)
    if not company:
        return None
    beneath, beside = finding.effect.beneath(company, comparison), repaired(comparison, company, generator)
    judged = alone if beneath is finding.effect else beneath
    score = _held(finding, judged, start, beside, generator)
    if score is None:
        return None
    if judged is beneath:
        score = score._replace(by_fold=numbers_by_fold(comparison, finding.effect))
    gained, beside = 0.0, finding.effect.repair(comparison, generator)
    for effect in company:
        gained += score_held_out(beside, effect).total
        beside = effect.repair(beside, generator)
    return score if gained > 0 else None


def is_known(finding: Finding, known: list[Finding]) -> bool:
    """Whether the same was found before: what its repair could not take away is not another one."""
    if finding.effect.stage:  # a fact on the numbers of some sensors
        return any(f.mechanism == finding.mechanism and set(finding.sensors) <= set(f.sensors) for f in known)
    return any(
        (finding.mechanism, finding.sensors, finding.channel, finding.time_s, finding.frequency_hz)
        == (other.mechanism, other.sensors, other.channel, other.time_s, other.frequency_hz)
        for other in known
    )
