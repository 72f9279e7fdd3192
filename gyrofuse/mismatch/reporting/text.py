"""A diagnosis in sentences."""

from __future__ import annotations

import re

from gyrofuse._base.linalg import SingularCovarianceError
from gyrofuse._base.results import p_words
from gyrofuse.mismatch.mechanisms.mechanism import Finding, readable
from gyrofuse.mismatch.mechanisms.remainder import Remainder
from gyrofuse.mismatch.mechanisms.slow_remainder import SlowRemainder
from gyrofuse.mismatch.reporting.benefit import Benefit
from gyrofuse.mismatch.reporting.outcome import Outcome

ALIKE = 0.01  # relative change of a variance that is not worth a word

# What tells a mechanism from its look-alikes, beyond the recording at hand.
SEPARATED_BY = {
    "vibration_tone": "a longer recording: the line gets as narrow as one over its length",
    "drifting_tone": "a longer recording, over which the frequency moves by more than its own width",
    "resonance": "a longer recording: the envelope of noise through a resonance is Rayleigh distributed",
    "quadratic_coupling": "acceleration recorded along with the rates",
    "low_pass": "a higher sampling rate, or the response to a known motion",
    "quantization": "the values as the converter gives them, before filters and averages",
    "clipping": "the full scale of the sensor, or a recording at another level",
    "stuck_samples": "counters or timestamps of the samples",
    "spikes": "more events, or a second sensor on the same supply",
    "variance_change": "a longer recording with more than one change",
    "random_telegraph": "a longer recording with more switches",
    "step": "a longer recording on either side",
    "temperature_drift": "a recording with temperature, over a temperature that goes up and down",
    "warm_up_transient": "a second recording from power-on, and one of the warm device",
    "flicker": "a recording ten times as long",
    "g_sensitivity": "acceleration recorded along with the rates, in several attitudes",
    "common_mode": "one sensor mounted apart, or on another supply",
    "scale_factor": "a recording on a table that turns at known rates",
    "clock_skew": "timestamps of each sensor, or a known motion that all of them feel",
    "not_identifiable": "the same under another motion, at another sampling rate, or with another channel",
    "parameter_shift": "a longer recording, or one of the same device under other conditions",
}


def verdict(outcome: Outcome) -> list[str]:
    """Say in sentences whether recording and simulation differ, by what, and what the repair is worth."""
    if not outcome.mismatch:
        most = min(outcome.evidence, key=lambda e: e.p_value)
        return [
            f"Recording and simulation agree: p = {outcome.p_value:.2g} if nothing is missing.",
            f"What surprises most among {len(outcome.evidence)} witnesses, {readable(most.test)}, is no more "
            f"than chance gives (p = {most.p_value:.2g}).",
            *outcome.notes,
            *(f"{words}." for words in judged_words(outcome)),
        ]
    sentences = [f"Recording and simulation differ: {p_words(outcome.p_value)} if nothing were missing."]
    if all(f.mechanism == "not_identifiable" for f in outcome.findings):
        sentences.append("What the simulation leaves out could not be named.")
    sentences += [f"{capital(f.sentence)}." for f in outcome.findings]
    h = outcome.held_out
    if outcome.findings:
        sentences.append(
            "On data that no number was estimated from, the repaired simulation predicts the recording better by "
            f"{nats(h.gain)} nats (95 % interval {nats(h.low)} to {nats(h.high)})."
        )
    left = ", ".join(readable(e.test) for e in outcome.unexplained)
    sentences.append(f"Unexplained, as seen by: {left}." if left else "After the repair no witness sees a difference.")
    if any(isinstance(effect, Remainder) for effect in outcome.model.effects):
        sentences.append(
            "So that the repaired simulation has the recording's spectra all the same, the noise of each sensor passes "
            "a filter that stands for no physics."
        )
    if any(isinstance(effect, SlowRemainder) for effect in outcome.model.effects):
        sentences.append("A slow course that is left in this recording is taken off it; it stands for no physics.")
    judged = [f"{words}." for words in judged_words(outcome)]
    return [*sentences, *outcome.notes, *judged, *fused_words(outcome)]


def otherwise_words(finding: Finding) -> str:
    """What would be with its best look-alike in the place of a finding; nothing where it has none."""
    if finding.instead is None or finding.gain_without is None:
        return ""
    less, sd = finding.gain_without - finding.instead.gain, finding.instead.sd
    start = f"instead of {readable(finding.mechanism)}: {readable(finding.instead.mechanism)}"
    alike = "cannot be told from it, and " if finding.instead.mechanism in finding.alternatives else ""
    if finding.instead.beats(finding.gain_without):
        alike = "is likelier, and "
    more = f"{nats(abs(less))} nats {'less' if less >= 0 else 'more'}"
    return f"{start} {alike}would gain {more} (held out, standard deviation {nats(sd)})"


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
    j = outcome.judged
    if j is None:
        return []
    if not outcome.mismatch:
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
