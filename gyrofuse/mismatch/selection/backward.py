"""Backward elimination: findings that others make needless go, and a name that loses to a rival is taken back.

Each finding is judged with all the others in: a wandering spectral line that was taken for several tones needs fewer
once its band is explained. Only what changes is estimated again.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import torch

from gyrofuse.mismatch.mechanisms.catalogue import named
from gyrofuse.mismatch.mechanisms.mechanism import Finding, repaired
from gyrofuse.mismatch.selection.alternatives import compare
from gyrofuse.mismatch.selection.discrepancy import is_farther, mean_discrepancy
from gyrofuse.mismatch.selection.forward import Selected
from gyrofuse.mismatch.selection.held_out import HeldOutScore, score_beneath, score_held_out
from gyrofuse.mismatch.selection.leftovers import beside_curves
from gyrofuse.mismatch.signals.comparison import Comparison


def eliminate(
    selected: list[Selected], comparison: Comparison, level: float, generator: torch.Generator
) -> tuple[list[Selected], Comparison]:
    """Drop findings that others make needless, and set those that stay against their rivals.

    What loses to a rival by more than chance takes the name of what is found in its place, or goes and is left as
    unexplained. So does a spectral line that another finding explains already.

    Args:
        selected: Findings in order.
        comparison: Recording and simulation with all of them repaired.
        level: Largest p value of a rival that takes a finding's place.
        generator: Source of the random numbers of what is applied to the simulation.

    Returns:
        Findings that stay, with their alternatives, and recording and simulation with all of them repaired.
    """
    swapped = renamed = False
    selected, comparison = _sizes_last(selected, comparison, generator)
    while True:
        selected, comparison, without = _pruned(selected, comparison, generator)
        found = []
        for one, (score, left) in zip(selected, without, strict=True):
            beside = [other.finding for other in selected if other is not one]
            found.append(one._replace(finding=compare(one.finding, score, left, beside)))
        beaten = None if swapped else _most_beaten([one.finding for one in found])
        better = None
        if beaten is not None:
            k, rival = beaten
            better = _with_rival(selected[k:], rival, without[k][1], level, generator)
        if beaten is not None and better is not None:
            swapped = True
            selected, comparison = _repaired(selected[:k], better, selected[k].before, generator)
        else:
            lost = _lost([one.finding for one in found], comparison)
            if not lost:
                return found, comparison
            names = set() if renamed else _names_instead([found[k].finding for k in lost])
            selected, comparison = _renamed(selected, lost, names, level, generator)
            renamed = True


def nearer(
    selected: list[Selected], start: Comparison, comparison: Comparison, generator: torch.Generator
) -> tuple[list[Selected], Comparison]:
    """Findings without those that together take the simulation away from the recording, the worst first.

    What changes noise was checked by itself, beside spectral lines that both sides have. Two findings of one line may
    undo it; and no other one that leaves the noise as it is was checked. Noise that was fitted to a recording with its
    tone agrees with it better than without: what a curve without a name mends leads nowhere.

    Args:
        selected: Findings in order.
        start: Recording and simulation as they came.
        comparison: The same with all of them repaired.
        generator: Source of the random numbers of what is applied to the simulation.
    """
    while selected and is_farther(comparison, start) and is_farther(beside_curves(comparison, generator), start):
        fewer = [
            [*selected[:k], *selected[k + 1 :]]
            for k, (finding, *_) in enumerate(selected)
            if not finding.effect.changes_noise or finding.effect.line_width(finding.parameters, start)
        ]
        made = [repaired(start, [one.finding.effect for one in some], generator) for some in fewer]
        left = [mean_discrepancy(one) for one in made]
        best = min(range(len(left)), key=left.__getitem__, default=0)
        if not left or not left[best] < mean_discrepancy(comparison):
            break
        selected, comparison = fewer[best], made[best]
    return selected, comparison


def same_line(first: Finding, second: Finding, comparison: Comparison) -> bool:
    """Whether two findings are one spectral line: closer than its width.

    A tone may stand on a resonance, whose width is none of its own.
    """
    if first.frequency_hz is None or second.frequency_hz is None:
        return False
    widths = [f.effect.line_width(f.parameters, comparison) for f in (first, second)]
    known = [width for width in widths if width is not None]
    if len(known) < 2 or not set(first.sensors) & set(second.sensors):
        return False
    width = min(known) if first.effect.broad or second.effect.broad else max(known)
    return abs(first.frequency_hz - second.frequency_hz) < width


def _lead_of_rival(finding: Finding) -> float | None:
    """Nats by which a rival is better, where that is more than chance; None where it is not."""
    rival, own = finding.instead, finding.gain_without
    return rival.gain - own if rival is not None and own is not None and rival.beats(own) else None


def _most_beaten(findings: list[Finding]) -> tuple[int, str] | None:
    """Position of the finding whose rival is better by the most nats, and the rival's name; None where none is.

    By more than chance. One search for a rival stands for all: that of each would find the same one again.
    """
    leads = [(lead, k) for k, f in enumerate(findings) if (lead := _lead_of_rival(f)) is not None]
    if not leads:
        return None
    _, k = max(leads)
    rival = findings[k].instead
    return None if rival is None else (k, rival.mechanism)


def _lost(findings: list[Finding], comparison: Comparison) -> list[int]:
    """Positions of findings that lose to a rival by more than chance, and of lines that another one explains."""
    twice = {
        k if (findings[k].held_out_gain or 0.0) < (findings[j].held_out_gain or 0.0) else j
        for j, k in itertools.combinations(range(len(findings)), 2)
        if same_line(findings[j], findings[k], comparison)
    }
    beaten = {k for k, f in enumerate(findings) if _lead_of_rival(f) is not None}
    return sorted(beaten | twice)


def _names_instead(findings: list[Finding]) -> set[str]:
    """Names of what may be found in the place of findings."""
    names = {f.instead.mechanism for f in findings if f.instead is not None}
    together = {name for kind in named(names) for name in kind.named_together}
    return names | together | {name for f in findings for name in f.effect.replaced_by}


def _renamed(
    selected: list[Selected], lost: list[int], names: set[str], level: float, generator: torch.Generator
) -> tuple[list[Selected], Comparison]:
    """The findings without those that lost, and with what is found under some names instead."""
    first, beaten = lost[0], tuple(sorted({selected[k].finding.mechanism for k in lost}))
    kept = [one.finding for k, one in enumerate(selected) if k > first and k not in lost]
    selected, comparison = _repaired(selected[:first], kept, selected[first].before, generator)
    kinds = named(names)
    for _ in lost:
        beside = replace(comparison, passed_over=beaten)
        found = [f for kind in kinds if (f := kind.detect_and_fit(beside, level)) is not None]
        for finding in sorted(found, key=lambda f: -f.gain):
            if score_held_out(comparison, finding.effect).confirms(finding.p_value):
                selected, comparison = _repaired(selected, [finding], comparison, generator)
                break
        else:
            break
    return selected, comparison


def _sizes_last(
    selected: list[Selected], comparison: Comparison, generator: torch.Generator
) -> tuple[list[Selected], Comparison]:
    """The findings with sizes of lines behind what changes noise: a filter found later changes lines as well."""
    findings = [one.finding for one in selected]
    noisy = [k for k, finding in enumerate(findings) if finding.effect.changes_noise]
    early = [k for k, finding in enumerate(findings) if finding.effect.sets_sizes and noisy and k < noisy[-1]]
    if not early:
        return selected, comparison
    first = early[0]
    rest = [finding for k, finding in enumerate(findings) if k > first and k not in early]
    selected, comparison = _repaired(selected[:first], rest, selected[first].before, generator)
    for k in early:
        if findings[k].effect.is_seen(comparison):
            selected, comparison = _repaired(selected, [findings[k]], comparison, generator)
    return selected, comparison


def _pruned(
    selected: list[Selected], comparison: Comparison, generator: torch.Generator
) -> tuple[list[Selected], Comparison, list[tuple[HeldOutScore, Comparison]]]:
    """What stays, the last judged first, each with its score where it alone is left out, and that comparison."""
    while True:
        kept: list[Finding] = []
        without: list[tuple[HeldOutScore, Comparison]] = []
        first = len(selected)  # that changes
        for k in reversed(range(len(selected))):
            one = selected[k]
            score, left = _left_out(one, kept, generator)
            if score.confirms(one.finding.p_value) and (left is one.before or one.finding.effect.is_seen(left)):
                kept.insert(0, one.finding)
                without.insert(0, (score, left))
            else:
                first = k
        if first == len(selected):
            return selected, comparison, without
        gone = [one.finding for one in selected if all(one.finding is not f for f in kept)]
        selected, comparison = _repaired(selected[:first], kept[first:], selected[first].before, generator, gone)


def _left_out(one: Selected, later: Sequence[Finding], generator: torch.Generator) -> tuple[HeldOutScore, Comparison]:
    """Score of a finding where all others are in, and that comparison.

    What the converter does is judged on the numbers as they came: whatever is taken off them hides it. So is what
    follows a channel beside lines without a cause, whose repair takes all that is in their band.
    """
    if one.finding.channel is not None:
        later = [f for f in later if not f.effect.additive or f.effect.line_width(f.parameters, one.before) is None]
    if one.finding.effect.stage or not later:
        return one.score, one.before
    left = repaired(one.before, later, generator)
    return score_beneath(left, one.finding.effect, [f.effect for f in later], one.before), left


def _repaired(
    selected: list[Selected],
    findings: Sequence[Finding],
    comparison: Comparison,
    generator: torch.Generator,
    gone: Sequence[Finding] = (),
) -> tuple[list[Selected], Comparison]:
    """The findings so far, and others after them, each repaired in turn; anew where one that had a part is gone."""
    selected = list(selected)
    for finding in findings:
        if any(other.effect.additive and set(other.sensors) & set(finding.sensors) for other in gone):
            finding = _found_again(finding, comparison)
        score = score_held_out(comparison, finding.effect)
        selected.append(Selected(replace(finding, held_out_gain=score.total), comparison, score))
        comparison = finding.repair(comparison, generator)
    return selected, comparison


def _found_again(finding: Finding, comparison: Comparison) -> Finding:
    """What is taken off a recording, with the numbers that it has there; as it was where it is not found again."""
    again = type(finding.effect).detect_and_fit(comparison, 1.0) if finding.effect.additive else None
    if again is None or again.mechanism != finding.mechanism or not set(again.sensors) & set(finding.sensors):
        return finding
    line = finding.frequency_hz is not None
    alike = same_line(again, finding, comparison) if line else again.time_s == finding.time_s
    return again if alike else finding


def _with_rival(
    selected: list[Selected], rival: str, left: Comparison, level: float, generator: torch.Generator
) -> list[Finding] | None:
    """Findings with a rival in the place of the first, if it is detected there, and holds.

    It comes last, after all that it was found beside. Later findings under its name, which may have mended what the
    first one did not fit, go with that if it scores as much alone.
    """
    first, *later = selected
    gone = [one for one in later if one.finding.mechanism == rival]
    rest = [one.finding for one in later if one not in gone]
    least = 0.0
    if gone:
        least = sum((one.score.total for one in gone), first.score.total)
        left = repaired(first.before, rest, generator)
    for kind in named([rival]):
        found = kind.detect_and_fit(left, level)
        if found is None:
            continue
        score = score_held_out(left, found.effect)
        if score.confirms(found.p_value) and score.total > least:
            return [*rest, found]
    return None
