"""Look-alikes of a finding: what else in the catalogue could stand in its place, fitted as if it did.

Only those are set against a finding whose log score means the same, so that the difference says which is likelier:
slow effects on whitened differences of block means, spectra and what is taken off a recording by Whittle's likelihood,
outliers by laws of single samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import torch

from gyrofuse.mismatch.detectors.slow.scans import MOST_STEPS, slow_look, steps_one_by_one
from gyrofuse.mismatch.likelihoods.component_choice import best_start, filter_starts
from gyrofuse.mismatch.likelihoods.components import Common, Flicker, LowPass, Shift, Term
from gyrofuse.mismatch.likelihoods.spectral import Fit, fit
from gyrofuse.mismatch.mechanisms.catalogue import STAGES
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.signals.channel_gain import ChannelGain
from gyrofuse.mismatch.mechanisms.signals.slow_effect import SlowEffect
from gyrofuse.mismatch.mechanisms.signals.step import Step
from gyrofuse.mismatch.mechanisms.signals.temperature import TemperatureDrift
from gyrofuse.mismatch.mechanisms.signals.tone import VibrationTone, line_near
from gyrofuse.mismatch.mechanisms.signals.warm_up import WarmUpTransient
from gyrofuse.mismatch.mechanisms.spectra.common_source import CommonMode
from gyrofuse.mismatch.mechanisms.spectra.flicker import FlickerNoise
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import compared
from gyrofuse.mismatch.mechanisms.spectra.low_pass import LowPassFilter, strengths
from gyrofuse.mismatch.mechanisms.spectra.oscillation import Mode
from gyrofuse.mismatch.mechanisms.spectra.parameter_change import ParameterShift
from gyrofuse.mismatch.mechanisms.spectra.resonance import Resonance
from gyrofuse.mismatch.mechanisms.spectra.wandering_tone import DriftingTone
from gyrofuse.mismatch.signals.comparison import Comparison

_ANY = 1.0  # p value: look-alikes need not be surprising
_NARROWEST = 1.5  # bins: half width of a bump in the place of a line
_REACH = 2.0  # half widths in which a line is looked for in the place of a bump
_ROUNDS = 8
_NUMBER = 2.0  # nats for each number of a sensor
_RED = (ParameterShift, FlickerNoise, CommonMode)
_MAY_BE, _AS_MUCH = 0.1, 5.0  # p value, and nats below
_SIZES = -3, 6, 200  # of a random walk: decades of its variance, and how many are tried


def look_alikes(comparison: Comparison, finding: Finding) -> list[Mechanism]:
    """What could stand in the place of a finding, with numbers from the case in which it is left out.

    Args:
        comparison: With all other findings in.
        finding: It.
    """
    effect = finding.effect
    found: list[Mechanism] = []
    for kinds, rivals in _RIVALS:
        if isinstance(effect, kinds):
            found += rivals(comparison, finding)
    found += _nominated(comparison, _NOMINATED.get(effect.name, ()))
    return [rival for rival in found if rival.name not in (effect.name, finding.mechanism)]


def happened_instead(comparison: Comparison, finding: Finding, beside: Sequence[Finding] = ()) -> tuple[str, ...]:
    """What happened once and gains as much as a finding of more slow noise does: a step is red noise as well.

    So are several steps; and what happened more than once in its sensors by the findings `beside` is like a walk.
    """
    if not isinstance(finding.effect, _RED):
        return ()
    scans = slow_look(comparison).scans
    once = [s.family.name for s in scans if s.p_value < _MAY_BE and s.gain > finding.gain - _AS_MUCH]
    happened = [
        f.mechanism
        for f in beside
        if f.effect.happened_once and isinstance(f.effect, SlowEffect) and set(f.sensors) & set(finding.sensors)
    ]
    if not _slow_noise(finding.effect):
        return tuple(dict.fromkeys(once))
    again = [name for name in happened if happened.count(name) > 1]
    noise = max(finding.gain, _of_walks(comparison, finding))
    steps = [Step.name] if _of_steps(comparison, finding) > noise - _AS_MUCH else []
    return tuple(dict.fromkeys((*once, *again, *steps)))


def _of_walks(comparison: Comparison, finding: Finding) -> float:
    """Nats of random walks in a finding's sensors, of one source or one each, in the ordinates that tell of steps."""
    look, effect = slow_look(comparison), finding.effect
    if isinstance(effect, CommonMode):
        gains = effect.gain.real[None]
    else:
        gains = torch.eye(comparison.n_sensors, dtype=torch.float64)[list(finding.sensors)]
    weighted = gains[:, :, None] / look.noise.own  # (source, sensor, ordinate)
    walk = look.noise.parts[0, -1]
    size = torch.logspace(*_SIZES, dtype=torch.float64)[:, None, None]
    # Its variance over the noise's, and what is seen of it over the noise: (size, source, ordinate).
    over = size * ((gains[:, :, None] * weighted).sum(1) * walk)
    seen = size * ((weighted * look.y).sum(1).square() * walk)
    return float((((seen / (1 + over) - over.log1p()).sum(-1) / 2).amax(0) - 1).sum())


def _of_steps(comparison: Comparison, finding: Finding) -> float:
    """Nats of several steps in a finding's sensors, less what their places and sizes gain by chance."""
    score, gram = (products[list(finding.sensors)] for products in slow_look(comparison).of_steps)
    cost = math.log(score.shape[-1]) + len(score)
    _, _, told = steps_one_by_one(score, gram, 2 * cost, MOST_STEPS)
    return sum(told) / 2 - cost * len(told)


def _slow_noise(effect: Mechanism) -> bool:
    """Whether it is noise of low frequencies: of a simulation's parts all but the white one."""
    if isinstance(effect, ParameterShift):
        return bool((effect.log_factors[1:] != 0).any())
    return isinstance(effect, FlickerNoise) or (isinstance(effect, CommonMode) and effect.kind != "white")


def _nominated(comparison: Comparison, names: tuple[str, ...]) -> Iterator[Mechanism]:
    """Mechanisms that find themselves, whatever their p value."""
    for mechanism in (m for stage in STAGES for m in stage if m.name in names):
        found = mechanism.detect_and_fit(comparison, _ANY)
        if found is not None:
            yield found.effect


def _slow(comparison: Comparison, finding: Finding) -> Iterator[Mechanism]:
    """Other paths of the same sensors in the same noise."""
    effect = finding.effect
    assert isinstance(effect, SlowEffect)
    kinds: tuple[type[Step | WarmUpTransient | TemperatureDrift], ...] = (Step, WarmUpTransient, TemperatureDrift)
    for scan in slow_look(comparison).scans:
        for kind in kinds:
            if kind.name == scan.family.name:
                rival = kind.of(scan, comparison.info.rate, finding.sensors)
                yield replace(rival, log_factors=effect.log_factors)


def _shapes(comparison: Comparison, finding: Finding) -> list[Mechanism]:
    """The shape of the same sensors' spectra that gains most, less what its numbers cost."""
    data = compared(comparison)
    if not data.n_ordinates:
        return []
    ground, nothing = data.ground, torch.zeros(0, dtype=torch.float64)
    own = torch.zeros(comparison.n_sensors, dtype=torch.bool)
    own[list(finding.sensors)] = True
    terms: list[Term] = [best_start(data, [], Flicker.starts(ground))[0], filter_starts(data, [])[0]]
    if bool(ground.matters.any()):
        terms.append(best_start(data, [], Shift.starts(ground)[0])[0])
    if comparison.n_sensors > 1:
        terms.append(Common.starts(ground, data.observed - data.expected, data.worth, "white", nothing)[0])
    tried: list[Fit] = []
    for term in terms:
        if finding.effect.name == term.name:
            continue
        free = term.free if isinstance(term, Common) else term.free & own
        if not bool(free.any()):
            continue
        tried.append(fit(data, [term.only(free)], _ROUNDS))
    best = max(tried, key=lambda f: f.gain - _NUMBER * len(f.information), default=None)
    return [] if best is None else [_of_term(comparison, best.terms[0])]


def _of_term(comparison: Comparison, term: Term) -> Mechanism:
    if isinstance(term, Shift):
        return ParameterShift(comparison.base, term.local)
    if isinstance(term, Flicker):
        return FlickerNoise(term.local[0])
    if isinstance(term, LowPass):
        return LowPassFilter(term.kind, strengths(term))
    assert isinstance(term, Common)
    return CommonMode(term.kind, 0.0, torch.complex(*term.local), comparison.base, term.inside)


def _bump(comparison: Comparison, finding: Finding) -> list[Mechanism]:
    """Noise as narrow as the record can show, in the place of a tone."""
    tone = finding.effect
    assert isinstance(tone, VibrationTone)
    gain = torch.complex(tone.cosine, -tone.sine) / math.sqrt(2)
    return [Resonance(Mode(tone.frequency_hz / comparison.info.rate, _NARROWEST / comparison.n_samples, gain, True))]


def _tone(comparison: Comparison, finding: Finding) -> list[Mechanism]:
    """A tone at the highest place of a bump."""
    effect = finding.effect
    assert isinstance(effect, Resonance | DriftingTone)
    mode = effect.mode
    return [
        VibrationTone.at(comparison, line_near(comparison, mode.centre, _REACH * mode.width) * comparison.info.rate)
    ]


_Maker = Callable[[Comparison, Finding], Iterable[Mechanism]]
_RIVALS: tuple[tuple[tuple[type[Mechanism], ...], _Maker], ...] = (
    ((SlowEffect,), _slow),
    ((ParameterShift, LowPassFilter, FlickerNoise, CommonMode, Resonance, ChannelGain), _shapes),
    ((VibrationTone,), _bump),
    ((Resonance, DriftingTone), _tone),
)
# Those that are found without the finding's help.
_NOMINATED = {
    "g_sensitivity": ("quadratic_coupling", "scale_factor"),
    "quadratic_coupling": ("g_sensitivity", "scale_factor"),
    "scale_factor": ("g_sensitivity", "quadratic_coupling"),
    "common_mode": ("g_sensitivity",),
    "spikes": ("variance_change",),
    "variance_change": ("spikes",),
}
