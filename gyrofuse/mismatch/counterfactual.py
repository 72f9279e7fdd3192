"""What would be without a finding, or with its best look-alike instead; findings that others make needless go.

Each is judged with all the others in: a wandering spur that was taken for several tones needs fewer once its band is
explained. Only what changes is estimated anew.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch

from gyrofuse.mismatch.case import Case, block_means
from gyrofuse.mismatch.confirm import Gain, held_out_gain, sd_of_sum
from gyrofuse.mismatch.look_alikes import happened_instead, look_alikes
from gyrofuse.mismatch.mechanism import Finding, Instead, Mechanism
from gyrofuse.mismatch.mechanisms import STAGES
from gyrofuse.mismatch.mechanisms.not_identifiable import NOT_IDENTIFIABLE
from gyrofuse.mismatch.slow_effect import SlowEffect
from gyrofuse.mismatch.slow_scans import slow_look
from gyrofuse.mismatch.telling import mechanism_words

_AS_GOOD_SD, _AS_GOOD = 1.0, 3.0  # differences of gains that are chance: in standard deviations, and in nats


class Link(NamedTuple):
    """A finding, and the case that it explains.

    Attributes:
        finding: It.
        before: What it was found in.
        gain: Its gain there.
    """

    finding: Finding
    before: Case
    gain: Gain


class Settled(NamedTuple):
    """Findings that stay, and what is left.

    Attributes:
        links: In the order in which they were found.
        case: With all of them explained.
    """

    links: list[Link]
    case: Case


def settled(links: list[Link], case: Case, level: float, generator: torch.Generator) -> Settled:
    """Drop findings that others make needless, and set those that stay against their look-alikes.

    Args:
        links: Findings in order.
        case: With all of them explained.
        level: Largest p value of a look-alike that takes a finding's place.
        generator: Of what is built into simulations.
    """
    swapped = False
    while True:
        links, case, judged = _pruned(links, case, generator)
        found = []
        for k, (link, (gain, left)) in enumerate(zip(links, judged, strict=True)):
            told = _compared(link.finding, gain, left, [other.finding for other in links if other is not link])
            better = None if swapped else _better(links[k:], told, left, level, generator)
            if better is not None:
                swapped = True
                links, case = _relinked(links[:k], better, link.before, generator)
                break
            found.append(link._replace(finding=told))
        else:
            return Settled(found, case)


def _pruned(
    links: list[Link], case: Case, generator: torch.Generator
) -> tuple[list[Link], Case, list[tuple[Gain, Case]]]:
    """What stays, the last first to be judged, with the gain of each where it alone is left out, and that case."""
    while True:
        kept: list[Finding] = []
        judged: list[tuple[Gain, Case]] = []
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
            return links, case, judged
        links, case = _relinked(links[:first], kept[first:], links[first].before, generator)


def _without(link: Link, later: list[Finding], generator: torch.Generator) -> tuple[Gain, Case]:
    """Gain of a finding where all others are in, and that case.

    What the converter does is judged on the numbers as they came: whatever is taken off them hides it.
    """
    if link.finding.effect.place or not later:
        return link.gain, link.before
    left = link.before
    for other in later:
        left = other.explained(left, generator)
    return held_out_gain(left, link.finding.effect), left


def _relinked(
    links: list[Link], findings: list[Finding], case: Case, generator: torch.Generator
) -> tuple[list[Link], Case]:
    """The links, and findings after them, each explained in turn."""
    links = list(links)
    for finding in findings:
        gain = held_out_gain(case, finding.effect)
        links.append(Link(replace(finding, held_out_gain=gain.total), case, gain))
        case = finding.explained(case, generator)
    return links, case


def _compared(finding: Finding, gain: Gain, left: Case, beside: list[Finding]) -> Finding:
    """A finding beside others, with what would be without it, and with its best look-alike."""
    told = replace(finding, gain_without=gain.total)
    alike = happened_instead(left, finding, beside)
    rivals = [(held_out_gain(left, effect), effect) for effect in look_alikes(left, finding)]
    if rivals:
        best, effect = max(rivals, key=lambda rival: rival[0].total)
        less, sd = gain.total - best.total, _spread(left, finding.effect, gain, effect, best)
        told = replace(told, instead=Instead(effect.name, best.total, sd))
        if best.total > 0 and less < max(_AS_GOOD_SD * sd, _AS_GOOD):
            alike += (effect.name,)
    alternatives = tuple(dict.fromkeys((*finding.alternatives, *alike)))
    sentence = finding.sentence
    if alternatives and finding.mechanism != NOT_IDENTIFIABLE:  # which says so itself
        sentence += f"; these data do not tell it apart from {', '.join(map(mechanism_words, alternatives))}"
    return replace(told, alternatives=alternatives, sentence=sentence)


def _better(
    links: list[Link], told: Finding, left: Case, level: float, generator: torch.Generator
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
            left = other.explained(left, generator)
    for mechanism in (m for stage in STAGES for m in stage if m.name == told.instead.mechanism):
        found = mechanism.nominate(left, level)
        if found is None:
            continue
        gain = held_out_gain(left, found.effect)
        if gain.confirms(found.p_value) and gain.total > least:
            return [*rest, found]
    return None


def _spread(case: Case, effect: Mechanism, gain: Gain, other: Mechanism, gain_of_other: Gain) -> float:
    """Standard deviation of the difference of two gains.

    From its scatter over blocks; what is slow has no blocks of its own, and the gains of two paths differ with the
    standard deviation of their distance in units of the noise.
    """
    if isinstance(effect, SlowEffect) and isinstance(other, SlowEffect):
        paths = [e.removed(case.recording, case.scene) for e in (effect, other)]
        covariance = slow_look(case).noise.covariance(effect.log_factors).diff(dim=-1).diff(dim=-2)
        difference = block_means(paths[0] - paths[1]).diff()[..., None]
        return float(torch.linalg.solve_triangular(torch.linalg.cholesky(covariance), difference, upper=False).norm())
    return sd_of_sum(gain.blocks - gain_of_other.blocks)
