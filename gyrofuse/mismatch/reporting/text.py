"""A diagnosis in sentences."""

from __future__ import annotations

import re
from collections import Counter

from gyrofuse._base.linalg import SingularCovarianceError
from gyrofuse._base.results import p_words, readable
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.reporting.benefit import Benefit
from gyrofuse.mismatch.reporting.judge import Judged
from gyrofuse.mismatch.reporting.outcome import Outcome
from gyrofuse.mismatch.selection.held_out import HeldOut
from gyrofuse.mismatch.selection.shares import Share

ALIKE = 0.01  # relative change of a variance that is not worth a word


def headline(outcome: Outcome) -> str:
    """What was found, and how much better the repaired simulation is, at a glance."""
    if not outcome.mismatch:
        return f"Nothing found: recording and simulation agree ({p_words(outcome.p_value)})."
    held_out = outcome.held_out
    gains = [f"{nats(score.value)} nats ({name})" for name, score in held_out.families.items()]
    likelier = f"Held-out data become likelier by {', '.join(gains)}; discrepancy" if gains else "Discrepancy"
    return f"Found: {found_words(outcome)}. {likelier} {held_out.before:.3g} -> {held_out.after:.3g} (1 = noise alone)."


def found_words(outcome: Outcome) -> str:
    """Names of the findings, each once, with how many there are."""
    counts = Counter(readable(f.mechanism) for f in outcome.findings)
    words = ", ".join(name if n == 1 else f"{n} x {name}" for name, n in counts.items())
    return words or "a difference that could not be named"


def complete_words(outcome: Outcome) -> list[str]:
    """That nothing is missing but numbers, where every finding is of that kind and no test sees anything else."""
    only_numbers = bool(outcome.findings) and all(f.effect.only_numbers for f in outcome.findings)
    return ["The physics is complete, the numbers were wrong."] if only_numbers and not outcome.unexplained else []


def verdict(outcome: Outcome) -> list[str]:
    """Say in sentences whether recording and simulation differ, by what, and what the repair is worth."""
    if not outcome.mismatch:
        most = min(outcome.evidence, key=lambda e: e.p_value)
        return [
            f"Recording and simulation agree: p = {outcome.p_value:.2g} if nothing is missing.",
            f"What surprises most among {len(outcome.evidence)} tests, {readable(most.test)}, is no more "
            f"than chance gives (p = {most.p_value:.2g}).",
            *outcome.notes,
            *(f"{words}." for words in judged_words(outcome)),
        ]
    sentences = [f"Recording and simulation differ: {p_words(outcome.p_value)} if nothing were missing."]
    if not any(f.identified for f in outcome.findings):
        sentences.append("What the simulation leaves out could not be named.")
    sentences += [f"{capital(f.sentence)}." for f in outcome.findings]
    sentences += complete_words(outcome)
    if outcome.held_out.families:
        sentences.append(
            "On data that no number was estimated from, the repaired simulation predicts the recording better: "
            f"{family_words(outcome.held_out)}."
        )
    left = ", ".join(readable(e.test) for e in outcome.unexplained)
    sentences.append(f"Unexplained, as seen by: {left}." if left else "After the repair no test sees a difference.")
    sentences += dict.fromkeys(effect.remark for effect in outcome.model.effects if effect.remark)
    judged = [f"{words}." for words in (*judged_words(outcome), *share_words(outcome))]
    return [*sentences, *outcome.notes, *judged, *fused_words(outcome)]


def otherwise_words(finding: Finding) -> str:
    """What its closest look-alike in the place of a finding says of its name; nothing where it has none."""
    rival = finding.instead
    if rival is None or finding.gain_without is None:
        return ""
    less = finding.gain_without - rival.gain
    start = f"closest look-alike of {readable(finding.mechanism)}: {readable(rival.mechanism)}, which in its place"
    size = f"by {nats(abs(less))} nats (standard deviation {nats(rival.sd)})"
    better = f"predicts held-out data {'worse' if less >= 0 else 'better'} {size}"
    if rival.beats(finding.gain_without):
        return f"{start} {better}: the name given here is in doubt"
    if rival.mechanism in finding.alternatives:
        return f"{start} {better}: these data do not tell which of the two it is"
    if rival.gain <= 0:
        return f"{start} explains nothing of the held-out data"
    return f"{start} {better}: it is ruled out"


def chance_words(p_value: float) -> str:
    """How often chance alone gives as small a p value: `1 of 250`."""
    certain, many = 1e-6, 0.1  # below which numbers mean nothing to readers, and from which tenths are said
    if p_value < certain:
        return "less than 1 of a million"
    if p_value >= many:
        return f"{round(10 * p_value)} of 10"
    return f"1 of {float(f'{1 / p_value:.2g}'):,.0f}".replace(",", " ")


def share_words(outcome: Outcome) -> list[str]:
    """One sentence on what carries the discrepancy: physics with names, curves without, and what is left."""
    before, shares, where = judged_shares(outcome)
    if not shares:
        return []
    named = 100 * sum(share.share for share in shares if share.identified)
    unnamed = 100 * sum(share.share for share in shares if not share.identified)
    left = 100 - named - unnamed
    known = f", curves without a name {unnamed:.3g} %" if any(not share.identified for share in shares) else ""
    rest = f"{left:.3g} % is left" if left > 0 else "nothing is left: it is closer than noise alone is on average"
    if min(named, unnamed) < 0:
        rest += " (below 0 %: these repairs by themselves take the simulation further away, and others make up for it)"
    return [
        f"Of the discrepancy above noise alone, {before - 1:.3g} {where}, mechanisms with names carry {named:.3g} %"
        f"{known}; {rest}"
    ]


def judged_shares(outcome: Outcome) -> tuple[float, tuple[Share, ...], str]:
    """Discrepancy before any repair, what each takes away, and where: on the judge where there is one."""
    if outcome.judged is not None:
        return outcome.judged.before, outcome.judged.shares, "on the other recording"
    return outcome.held_out.before, outcome.held_out.shares, "on data held out"


def fused_words(outcome: Outcome) -> list[str]:
    """One sentence on what the virtual gyro gains by the correction, where any can be made."""
    gained = benefit_of(outcome)
    if gained is None:
        return []
    factor, start = gained.factor, "Fused for long averaging times, the corrected recording gives a virtual gyro"
    if abs(factor - 1) < ALIKE:
        return [f"{start} as good as before, within {100 * ALIKE:g} % of its wavelet variance."]
    if factor > 1:
        return [f"{start} with {factor:.3g} times less wavelet variance."]
    return [f"{start} with {1 / factor:.3g} times more wavelet variance."]


def judged_words(outcome: Outcome) -> list[str]:
    """One sentence on what another recording says of the repair, where one was given."""
    return [] if outcome.judged is None else judge_words(outcome.judged, outcome.mismatch)


def judge_words(judged: Judged, mismatch: bool) -> list[str]:
    """One sentence on what another recording says of a repair.

    Args:
        judged: Its verdict.
        mismatch: Whether there was anything to repair.
    """
    j = judged
    if not mismatch:
        verdict = "there was nothing to repair"
    else:
        verdict = "the repair helps there" if j.helps else "the repair does not help there"
    lacks = f" without what follows {' and '.join(j.lacks)}, which it has not," if j.lacks else ""
    return [
        f"On another recording, which no number was estimated from,{lacks} the discrepancy is {j.before:.2f} before "
        f"and {j.after:.2f} after repair, and {j.repeatability:.2f} with the recording itself in the place of the "
        f"simulation (1 = noise alone); a classifier tells them apart with an area under the curve of "
        f"{j.auc_before:.2f} before, {j.auc_after:.2f} after and {j.auc_repeatability:.2f} (0.5 = guessing): {verdict}"
    ]


def benefit_of(outcome: Outcome) -> Benefit | None:
    """What the correction does for the virtual gyro; None where nothing is taken off, or there are no weights."""
    sidak = outcome.model.correct(outcome.recording)
    if outcome.comparison.n_sensors < 2 or bool((sidak == outcome.recording).all()):
        return None
    try:
        return outcome.benefit()
    except SingularCovarianceError:
        return None


def nats(value: float) -> str:
    """A log score in digits."""
    return f"{value:.1f}" if abs(value) < 1000 else f"{value:.0f}"


def parameter_words(name: str, sensors: tuple[str, ...]) -> str:
    """Name of a parameter for readers: `amplitude[0]` is the amplitude in the first sensor."""
    words = name.replace("_", " ")
    match = re.fullmatch(r"(.*?)\[([\d, ]+)\]", words)
    if match is None:
        return words
    places = [int(place) for place in match[2].split(",")]
    if max(places) >= len(sensors):
        return words
    return f"{match[1]}, sensor{'s' if len(places) > 1 else ''} {', '.join(sensors[i] for i in places)}"


def capital(sentence: str) -> str:
    """With a capital first letter and no full stop."""
    return sentence[:1].upper() + sentence[1:].rstrip(".")


def typeset(sentence: str) -> str:
    """With arrows that no line is broken in."""
    return sentence.replace("->", "→")


def family_words(held_out: HeldOut) -> str:
    """Held-out log scores, likelihood by likelihood: each is of data of its own, and they are not added up."""
    words = [
        f"{name} by {nats(score.value)} nats (95 % interval {nats(score.low)} to {nats(score.high)})"
        for name, score in held_out.families.items()
    ]
    return ", ".join(words) or "none, as nothing was repaired"


def paired_words(held_out: HeldOut) -> str:
    """The discrepancy by the recording's own scatter, where something follows a channel."""
    return "" if held_out.paired is None else f"{held_out.paired:.2f} by the scatter of the recording's own blocks, "
