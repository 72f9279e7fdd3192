"""What would be without a finding, or with its best look-alike instead; findings that others make needless go.

Each is judged with all the others in: a wandering spur that was taken for several tones needs fewer once its band is
explained. Only what changes is estimated anew.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple

import torch

from gyrofuse.mismatch.detectors.slow.scans import slow_look
from gyrofuse.mismatch.mechanisms.catalogue import STAGES
from gyrofuse.mismatch.mechanisms.mechanism import Alternative, Finding, Mechanism, Parameter, readable
from gyrofuse.mismatch.mechanisms.not_identifiable import NOT_IDENTIFIABLE
from gyrofuse.mismatch.mechanisms.signals.slow_effect import SlowEffect
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone
from gyrofuse.mismatch.mechanisms.spectra.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.wandering_tone import DriftingTone
from gyrofuse.mismatch.selection.alternatives import happened_instead, look_alikes
from gyrofuse.mismatch.selection.held_out import Gain, held_out_gain, sd_of_sum
from gyrofuse.mismatch.signals.comparison import Comparison, block_means

_AS_GOOD_SD, _AS_GOOD = 2.0, 3.0  # differences of gains that are chance: in standard deviations, and in nats


class Link(NamedTuple):
    """A finding, and the case that it explains.

    Attributes:
        finding: It.
        before: What it was found in.
        gain: Its gain there.
    """

    finding: Finding
    before: Comparison
    gain: Gain


class Settled(NamedTuple):
    """Findings that stay, and what is left.

    Attributes:
        links: In the order in which they were found.
        comparison: With all of them explained.
    """

    links: list[Link]
    comparison: Comparison


def settled(links: list[Link], comparison: Comparison, level: float, generator: torch.Generator) -> Settled:
    """Drop findings that others make needless, and set those that stay against their look-alikes.

    A name is earned: what loses to a look-alike by more than chance takes the name of what is found in its place, or
    goes and is left to be told as unexplained. So does a line that another finding tells already.

    Args:
        links: Findings in order.
        comparison: With all of them explained.
        level: Largest p value of a look-alike that takes a finding's place.
        generator: Of what is built into simulations.
    """
    swapped = renamed = False
    while True:
        links, comparison, judged = _pruned(links, comparison, generator)
        found = []
        for k, (link, (gain, left)) in enumerate(zip(links, judged, strict=True)):
            told = _compared(link.finding, gain, left, [other.finding for other in links if other is not link])
            better = None if swapped else _better(links[k:], told, left, level, generator)
            if better is not None:
                swapped = True
                links, comparison = _relinked(links[:k], better, link.before, generator)
                break
            found.append(link._replace(finding=told))
        else:
            unearned = _unearned([link.finding for link in found], comparison)
            if not unearned:
                return Settled(found, comparison)
            names = set() if renamed else _in_their_place([found[k].finding for k in unearned])
            links, comparison = _renamed(links, unearned, names, level, generator)
            renamed = True


def _unearned(findings: list[Finding], comparison: Comparison) -> list[int]:
    """Positions of findings that lose to a look-alike by more than chance, and of lines that another one tells."""
    twice = {
        k if _strength(findings[k]) < _strength(findings[j]) else j
        for j, k in itertools.combinations(range(len(findings)), 2)
        if same_line(findings[j], findings[k], comparison)
    }
    beaten = {
        k
        for k, f in enumerate(findings)
        if f.instead is not None and f.gain_without is not None and f.instead.beats(f.gain_without)
    }
    return sorted(beaten | twice)


def _strength(finding: Finding) -> float:
    return finding.held_out_gain or 0.0


def same_line(first: Finding, second: Finding, comparison: Comparison) -> bool:
    """Whether two findings are of one line: closer than its width, for a tone that the record shows or its wander has.

    A tone may stand on a resonance, whose width is none of its own.
    """
    if first.frequency_hz is None or second.frequency_hz is None:
        return False
    widths = [_line_width(f.effect, f.parameters, comparison) for f in (first, second)]
    if None in widths or not set(first.sensors) & set(second.sensors):
        return False
    both = any(isinstance(f.effect, Resonance) for f in (first, second))
    width = (min if both else max)(width for width in widths if width is not None)
    return abs(first.frequency_hz - second.frequency_hz) < width


def _line_width(effect: Mechanism, parameters: dict[str, Parameter], comparison: Comparison) -> float | None:
    """Half width of a line, Hz; None of what is none."""
    if isinstance(effect, Resonance | DriftingTone):
        return effect.mode.width * comparison.info.rate
    if isinstance(effect, VibrationTone):
        limits = parameters["frequency"]
        return max((limits.high - limits.low) / 2, comparison.info.rate / comparison.n_samples)
    return None


def _in_their_place(findings: list[Finding]) -> set[str]:
    """Names of what may be found in the place of findings: bumps are named by whether their envelope is steady."""
    names = {f.instead.mechanism for f in findings if f.instead is not None}
    peaks = {Resonance.name, DriftingTone.name}
    return names | peaks if names & peaks or any(isinstance(f.effect, VibrationTone) for f in findings) else names


def _renamed(
    links: list[Link], unearned: list[int], names: set[str], level: float, generator: torch.Generator
) -> tuple[list[Link], Comparison]:
    """The links without some of them, and with what is found of those names instead."""
    first = unearned[0]
    kept = [link.finding for k, link in enumerate(links) if k > first and k not in unearned]
    links, comparison = _relinked(links[:first], kept, links[first].before, generator)
    kinds = [m for stage in STAGES for m in stage if m.name in names]
    for _ in unearned:
        found = [f for f in (kind.detect_and_fit(comparison, level) for kind in kinds) if f is not None]
        for finding in sorted(found, key=lambda f: -f.gain):
            if held_out_gain(comparison, finding.effect).confirms(finding.p_value):
                links, comparison = _relinked(links, [finding], comparison, generator)
                break
        else:
            break
    return links, comparison


def _pruned(
    links: list[Link], comparison: Comparison, generator: torch.Generator
) -> tuple[list[Link], Comparison, list[tuple[Gain, Comparison]]]:
    """What stays, the last first to be judged, with the gain of each where it alone is left out, and that case."""
    while True:
        kept: list[Finding] = []
        judged: list[tuple[Gain, Comparison]] = []
        first = len(links)  # that changes
        for k in reversed(range(len(links))):
            link = links[k]
            gain, left = _without(link, kept, generator)
            if gain.confirms(link.finding.p_value):
                kept.insert(0, link.finding)
                judged.insert(0, (gain, left))
            else:
                first = k
        if first == len(links):
            return links, comparison, judged
        links, comparison = _relinked(links[:first], kept[first:], links[first].before, generator)


def _without(link: Link, later: list[Finding], generator: torch.Generator) -> tuple[Gain, Comparison]:
    """Gain of a finding where all others are in, and that case.

    What the converter does is judged on the numbers as they came: whatever is taken off them hides it.
    """
    if link.finding.effect.place or not later:
        return link.gain, link.before
    left = link.before
    for other in later:
        left = other.repair(left, generator)
    return held_out_gain(left, link.finding.effect), left


def _relinked(
    links: list[Link], findings: list[Finding], comparison: Comparison, generator: torch.Generator
) -> tuple[list[Link], Comparison]:
    """The links, and findings after them, each explained in turn."""
    links = list(links)
    for finding in findings:
        gain = held_out_gain(comparison, finding.effect)
        links.append(Link(replace(finding, held_out_gain=gain.total), comparison, gain))
        comparison = finding.repair(comparison, generator)
    return links, comparison


def _compared(finding: Finding, gain: Gain, left: Comparison, beside: list[Finding]) -> Finding:
    """A finding beside others, with what would be without it, and with its best look-alike."""
    told = replace(finding, gain_without=gain.total)
    alike = happened_instead(left, finding, beside)
    own, alone = finding.effect, gain
    if isinstance(own, SlowEffect):
        # Whether there is any is a matter of the noise that would be without; which it is, of the noise beside it.
        own = own.beside_it(left)
        alone = held_out_gain(left, own)
    rivals = [(held_out_gain(left, rival), rival) for rival in look_alikes(left, replace(finding, effect=own))]
    if rivals:
        best, effect = max(rivals, key=lambda rival: rival[0].total)
        less, sd = alone.total - best.total, _spread(left, own, alone, effect, best)
        told = replace(told, instead=Alternative(effect.name, gain.total - less, sd))
        if less < gain.total and less < max(_AS_GOOD_SD * sd, _AS_GOOD):
            alike += (effect.name,)
    alternatives = tuple(dict.fromkeys((*finding.alternatives, *alike)))
    sentence = finding.sentence
    if alternatives and finding.mechanism != NOT_IDENTIFIABLE:  # which says so itself
        sentence += f"; these data do not tell it apart from {', '.join(map(readable, alternatives))}"
    return replace(told, alternatives=alternatives, sentence=sentence)


def _better(
    links: list[Link], told: Finding, left: Comparison, level: float, generator: torch.Generator
) -> list[Finding] | None:
    """Findings with a look-alike in the place of the first, if it is better by more than chance, there, and holds.

    It comes last, after all that it was found beside. Later findings under its name, which may have mended what the
    first one did not fit, go with that if it does as much alone.
    """
    if told.instead is None or told.gain_without is None:
        return None
    if not told.instead.beats(told.gain_without):
        return None
    first, *later = links
    gone = [link for link in later if link.finding.mechanism == told.instead.mechanism]
    rest = [link.finding for link in later if link not in gone]
    least = 0.0
    if gone:
        least = sum((link.gain.total for link in gone), first.gain.total)
        left = first.before
        for other in rest:
            left = other.repair(left, generator)
    for mechanism in (m for stage in STAGES for m in stage if m.name == told.instead.mechanism):
        found = mechanism.detect_and_fit(left, level)
        if found is None:
            continue
        gain = held_out_gain(left, found.effect)
        if gain.confirms(found.p_value) and gain.total > least:
            return [*rest, found]
    return None


def _spread(comparison: Comparison, effect: Mechanism, gain: Gain, other: Mechanism, gain_of_other: Gain) -> float:
    """Standard deviation of the difference of two gains.

    From its scatter over blocks; what is slow has no blocks of its own, and the gains of two paths differ with the
    standard deviation of their distance in units of the noise.
    """
    if isinstance(effect, SlowEffect) and isinstance(other, SlowEffect):
        paths = [e.remove(comparison.recording, comparison.info) for e in (effect, other)]
        covariance = slow_look(comparison).noise.covariance(effect.log_factors).diff(dim=-1).diff(dim=-2)
        difference = block_means(paths[0] - paths[1]).diff()[..., None]
        return float(torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), difference, upper=False).norm())
    return sd_of_sum(gain.blocks - gain_of_other.blocks)
