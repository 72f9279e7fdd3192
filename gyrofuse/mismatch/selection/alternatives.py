"""Alternatives of a finding: rivals in the catalogue, fitted in its place on the same blocks.

Only those are set against a finding whose log score is a likelihood of the same data, so that the difference says which
is likelier: slow paths on whitened differences of block means, spectra and what is taken off a recording by Whittle's
likelihood, outliers by laws of single samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gyrofuse._base.results import readable
from gyrofuse.mismatch.mechanisms.catalogue import named
from gyrofuse.mismatch.mechanisms.finding_parts import Alternative
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.selection.held_out import HeldOutScore, score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison

_AS_GOOD_SD, _AS_GOOD_NATS = 2.0, 3.0  # differences of held-out scores that are chance: standard deviations, and nats


def rivals_of(finding: Finding, comparison: Comparison) -> list[Mechanism]:
    """Rivals fitted in the place of a finding.

    Of rivals that are found in spectra alone, whose scores in sample are of the same data, the best stands for all.

    Args:
        finding: Finding whose effect declares its `rivals`.
        comparison: Recording and simulation with all other findings explained.
    """
    fitted = [rival for kind in named(finding.effect.rivals) if (rival := kind.fit_in_place_of(finding, comparison))]
    fitted = [rival for rival in fitted if rival.effect.name not in (finding.effect.name, finding.mechanism)]
    spectral = [rival for rival in fitted if rival.effect.of_spectra]
    best = max(spectral, key=lambda rival: rival.score, default=None)
    return [rival.effect for rival in fitted if not rival.effect.of_spectra or rival is best]


def compare(finding: Finding, score: HeldOutScore, comparison: Comparison, beside: Sequence[Finding]) -> Finding:
    """A finding with its score where all others are in, its best rival, and the names that explain it as well.

    Args:
        finding: Finding.
        score: Its held-out score where it alone is left out.
        comparison: Recording and simulation with all other findings explained.
        beside: The other findings.
    """
    found = replace(finding, gain_without=score.total)
    alike = finding.effect.explained_by_others(comparison, finding, beside)
    own, alone = finding.effect.as_compared(comparison), score
    if own is not finding.effect:
        # Whether there is any is a matter of the noise that would be without; which it is, of the noise beside it.
        alone = score_held_out(comparison, own)
    rivals = [(score_held_out(comparison, r), r) for r in rivals_of(replace(finding, effect=own), comparison)]
    if rivals:
        best, effect = max(rivals, key=lambda rival: rival[0].total)
        less = alone.total - best.total
        sd = own.score_difference_sd(alone.blocks, effect, best.blocks, comparison)
        found = replace(found, instead=Alternative(effect.name, score.total - less, sd))
        if less < score.total and less < max(_AS_GOOD_SD * sd, _AS_GOOD_NATS):
            alike += (effect.name,)
    alternatives = tuple(dict.fromkeys((*finding.alternatives, *alike)))
    sentence = finding.sentence
    if alternatives and finding.identified:  # else it says so itself
        sentence += f"; these data do not tell it apart from {', '.join(map(readable, alternatives))}"
    return replace(found, alternatives=alternatives, sentence=sentence)
