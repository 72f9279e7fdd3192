"""Diagnosis: witness, nominate, repair, confirm, and ask what would be otherwise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_n_samples
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.detectors.spectra.fit_verdict import KNOWN, FitVerdict, fit_verdict
from gyrofuse.mismatch.detectors.tests import TESTS, family_wise_p_value, run_tests
from gyrofuse.mismatch.mechanisms.catalogue import STAGES
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.remainder import Remainder
from gyrofuse.mismatch.mechanisms.slow_remainder import SlowRemainder
from gyrofuse.mismatch.mechanisms.spectra.spectral import Spectral
from gyrofuse.mismatch.mechanisms.values.quantization import Quantization
from gyrofuse.mismatch.mechanisms.values.unit_scale import UnitScale
from gyrofuse.mismatch.repair.inputs import Simulation, modelled, on_processor, prepared
from gyrofuse.mismatch.repair.noise_model import noise_of, noise_samples
from gyrofuse.mismatch.repair.reference_effects import with_own_effects
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.reporting.judge import checked_judge, judged
from gyrofuse.mismatch.reporting.report import MismatchReport
from gyrofuse.mismatch.selection.backward import Link, settled
from gyrofuse.mismatch.selection.held_out import discrepancy_left, held_out, held_out_gain, leads_away
from gyrofuse.mismatch.selection.null_replicates import FEWEST, twin_p_values
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.multiplicity import monte_carlo_p_value, sidak, sidak_level
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.model import Model

_LOOKED, _NAMED, _COMPARED, _CHECKED = 0.3, 0.65, 0.75, 0.9  # shares of the work that are done by then
_AFTER_REPAIRS = 0.1  # of the level: spectra are then compared at levels that repairs have estimated
# Witnesses of the law of single samples, which of values that hardly leave a step is none that they know.
_OF_SAMPLES = ("marginal", "spike", "jump", "variance")
_MOST, _OF_A_KIND = 20, 6  # findings: a recording that needs more is another instrument


def diagnose(
    recording: Recording | Tensor,
    simulation: Simulation,
    *,
    false_alarm: float = 0.01,
    rate: float | None = None,
    fitted_samples: int | None = None,
    twins: int = 0,
    judge: Recording | Tensor | None = None,
    generator: torch.Generator | None = None,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> MismatchReport:
    """Find where a recording and a simulation differ, and which physics the simulation left out.

    It is made in the processor's memory, to which whatever lies on another device is brought.

    Args:
        recording: What a real array gave; its auxiliary channels are used. A tensor is `(sensor, time)`.
        simulation: What a simulator gives for the same array: samples, of any length and without channels, or a noise
            model, one for all sensors, with batched parameters one for each, or an `ArrayModel`; a fit of any kind
            (`fit_gmwm`, `fit_array_gmwm`, `fit_gmwm_joint`, `rank_models`), which stands for its model; or a simulation
            that another diagnosis repaired (`report.model`), whose effects then count as known; what happened once (a
            step, an episode) does where the recording has it.
        false_alarm: Probability of a finding where nothing is missing.
        rate: Hz, for recordings given as tensors; 1 by default.
        fitted_samples: Samples of each sensor that a model was estimated from, where it does not know: models of fits
            do, and others count as known. Spectra are compared beside what such numbers may be off.
        twins: How many twins of the recording, in which nothing is missing, tell how surprising the witnesses are: they
            are resampled from the simulation's own innovations. By default none: the witnesses' own p values are held
            to. 50 or more cost so many times a look.
        judge: Another recording of the same device, in the same kind, of which nothing is estimated: it says how far
            the simulation is from it before and after the repair, and how far the recording itself (`judged`).
        generator: Source of the diagnosis's own random numbers: of a model's samples, and of what is built into the
            simulation. By default one with a fixed seed, so that a diagnosis can be repeated.
        progress: Is told what is looked at next, and the share of the work that is done: where something is missing
            there is more of it.

    Returns:
        Verdict, findings, held-out scores, and the repaired simulation.

    Raises:
        TypeError: Neither samples nor a model, or a judge of another kind than the recording.
        ValueError: Recording, simulation and judge do not fit each other, are too short, or constant.
    """
    if isinstance(false_alarm, bool) or not isinstance(false_alarm, Real) or not 0 < false_alarm < 1:
        raise ValueError(f"`false_alarm`: expected a number between 0 and 1 such as 0.01, got {false_alarm!r}")
    if check_n_samples("twins", twins) and twins < FEWEST:
        raise ValueError(f"`twins`: expected 0, or {FEWEST} or more, got {twins}; fewer cannot tell a tail")
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    level = sidak_level(false_alarm, len(TESTS))  # what would be a mismatch, had one witness alone said it
    recording, judge = on_processor(recording), on_processor(judge)
    simulation = on_processor(modelled(simulation, fitted_samples))
    given = prepared(recording, simulation, rate, generator)
    if judge is not None:
        judge = checked_judge(judge, recording, rate)
    start, own = with_own_effects(given, simulation, level, generator)
    model = RepairedModel(noise_of(simulation, _unrounded(start)), start.info, own, noise_samples(simulation))
    evidence = run_tests(start, lambda what, share: progress(what, _LOOKED * share))
    p_value = family_wise_p_value(evidence)
    if twins:
        p_value = monte_carlo_p_value(p_value, twin_p_values(start, twins, generator))
    if p_value > false_alarm:
        verdict = None if judge is None else judged(judge, recording, simulation, None, rate)
        return _reported(
            simulation,
            fit_verdict(start, level),
            mismatch=False,
            p_value=p_value,
            findings=(),
            unexplained=(),
            held_out=held_out(start, (), generator),
            model=model,
            evidence=evidence,
            evidence_after=evidence,
            recording=given.recording,
            comparison=start,
            repaired=start,
            judged=verdict,
        )
    comparison: Comparison = start
    links: list[Link] = []
    for number, stage in enumerate(STAGES):
        if len({i for link in links for i in link.finding.hides}) == start.n_sensors:
            break
        progress(", ".join(m.name for m in stage), _LOOKED + (_NAMED - _LOOKED) * number / len(STAGES))
        while len(links) < _MOST:
            found = [link.finding for link in links]
            open_ones = [m for m in stage if sum(f.mechanism == m.name for f in found) < _OF_A_KIND]
            asked = level * _AFTER_REPAIRS if links and stage is STAGES[-1] else level
            nominated = [
                f for f in (m.detect_and_fit(comparison, asked) for m in open_ones) if f and not _known(f, found)
            ]
            for finding in sorted(nominated, key=lambda f: -f.gain):
                gain = held_out_gain(comparison, finding.effect)
                if gain.confirms(finding.p_value) and not leads_away(start, comparison, gain, generator):
                    links.append(Link(replace(finding, held_out_gain=gain.total), comparison, gain))
                    comparison = finding.repair(comparison, generator)
                    break
            else:
                break
    progress("look-alikes", _NAMED)
    links, comparison = settled(links, comparison, level, generator)
    # Spectra as they were before a repair of theirs: what was found until then is no matter of the model's numbers.
    before = next((link.before for link in links if isinstance(link.finding.effect, Spectral)), comparison)
    findings = tuple(link.finding for link in links)
    gains = [link.gain for link in links]
    after = run_tests(comparison, lambda what, share: progress(what, _COMPARED + (_CHECKED - _COMPARED) * share))
    left = [e for e in after if sidak(e.p_value, len(evidence)) <= false_alarm]
    hidden = sorted({i for f in findings for i in f.hides})
    for finding in findings:
        if isinstance(finding.effect, UnitScale):
            own = tuple(e.in_unit(finding.effect.factor) if isinstance(e, Quantization) else e for e in own)
    effects = (*own, *(f.effect for f in findings))
    for unnamed in (SlowRemainder, Remainder):
        asking = [e.p_value for e in left if e.test in unnamed.asked_for_by]
        if not asking:
            continue
        remainder = unnamed.of(comparison).but_for(hidden)
        gain = held_out_gain(comparison, remainder)
        if gain.confirms(min(asking)) and not leads_away(start, comparison, gain, generator):
            comparison, effects = remainder.repair(comparison, generator), (*effects, remainder)
            gains.append(gain)
    if hidden:  # what was searched on had noise in their place; what is handed back has what was recorded
        comparison = start
        for effect in effects[len(own) :]:
            comparison = effect.repair(comparison, generator)
        after = run_tests(comparison)
        told = {*_OF_SAMPLES, *(e.test for e in left)}
        left += [e for e in after if sidak(e.p_value, len(evidence)) <= false_alarm and e.test not in told]
    judged_blocks = held_out(start, gains, generator)
    if not left and (much := discrepancy_left(comparison, judged_blocks.after)):
        left = [much]
    model = replace(model, effects=effects)
    verdict = None
    if judge is not None:
        progress("another recording", _CHECKED)
        verdict = judged(judge, recording, simulation, model, rate)
    return _reported(
        simulation,
        fit_verdict(before, level),
        mismatch=True,
        p_value=p_value,
        findings=findings,
        unexplained=tuple(left),
        held_out=judged_blocks,
        model=model,
        evidence=evidence,
        evidence_after=after,
        recording=given.recording,
        comparison=start,
        repaired=comparison,
        judged=verdict,
    )


def _reported(simulation: object, fit: FitVerdict | None, **found: Any) -> MismatchReport:
    """The report, with notes on what the simulation's numbers are taken for."""
    notes = () if fit is None else (fit.words,)
    if isinstance(simulation, Model | ArrayModel) and simulation.estimated_from is None:
        notes = (KNOWN,)
    return MismatchReport(fit=fit, notes=notes, **found)


def _unrounded(comparison: Comparison) -> Comparison:
    """The simulation before its own rounding, which a model of it does again."""
    if comparison.analog is comparison.reference.signal:
        return comparison
    return replace(comparison, reference=replace(comparison.reference, signal=comparison.analog))


def _known(finding: Finding, found: list[Finding]) -> bool:
    """Whether the same was found before: what its repair could not take away is not another one."""
    if finding.effect.place:  # a fact on the numbers of some sensors
        return any(f.mechanism == finding.mechanism and set(finding.sensors) <= set(f.sensors) for f in found)
    return any(
        (finding.mechanism, finding.sensors, finding.channel, finding.time_s, finding.frequency_hz)
        == (other.mechanism, other.sensors, other.channel, other.time_s, other.frequency_hz)
        for other in found
    )
