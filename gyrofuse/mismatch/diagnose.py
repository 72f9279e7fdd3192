"""Diagnosis: test, search forward, repair, eliminate backward, and report what is left."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_n_samples, repeatable_generator
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.fit_verdict import KNOWN, fit_verdict
from gyrofuse.mismatch.detectors.tests import TESTS, family_wise_p_value, run_tests
from gyrofuse.mismatch.detectors.variance.rest import rest_words
from gyrofuse.mismatch.mechanisms.mechanism import Context, Mechanism, repaired
from gyrofuse.mismatch.repair.inputs import Simulation, modelled, on_processor, prepared, same_data_words
from gyrofuse.mismatch.repair.noise_model import noise_of, noise_samples
from gyrofuse.mismatch.repair.reference_effects import with_own_effects
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.reporting.judge import checked_judge, judged
from gyrofuse.mismatch.reporting.report import MismatchReport
from gyrofuse.mismatch.selection.backward import eliminate, nearer
from gyrofuse.mismatch.selection.discrepancy import discrepancy_left
from gyrofuse.mismatch.selection.forward import Selected, select
from gyrofuse.mismatch.selection.held_out import HeldOut, agreement
from gyrofuse.mismatch.selection.leftovers import repair_leftovers
from gyrofuse.mismatch.selection.null_replicates import FEWEST, twin_p_values
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.stats.multiplicity import monte_carlo_p_value, sidak, sidak_level
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.model import Model

_TESTED, _FOUND, _ELIMINATED, _COMPARED = 0.3, 0.65, 0.75, 0.9  # shares of the work that are done by then
# Tests of the law of single samples, none of which is known of values that hardly leave one quantisation step.
_OF_SAMPLES = ("marginal", "spike", "jump", "variance")


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
            step, an episode) does where the recording has it. One that draws sessions stands for samples of all.
        false_alarm: Probability of a finding where nothing is missing.
        rate: Hz, for recordings given as tensors; 1 by default.
        fitted_samples: Samples of each sensor that a model was estimated from, where it does not know: models of fits
            do, and others count as known. Spectra are compared beside what such numbers may be off.
        twins: Number of null replicates, pairs of recording and simulation in which nothing is missing, that calibrate
            the family-wise p value: they are resampled from the simulation's own innovations. By default none: the p
            values of the tests are taken as they are. 50 or more cost so many times all tests.
        judge: Another recording of the same device, in the same kind, of which nothing is estimated: it says how far
            the simulation is from it before and after the repair, and how far the recording itself (`judged`).
        generator: Source of the diagnosis's own random numbers: of a model's samples, and of what is built into the
            simulation. By default one with a fixed seed, so that a diagnosis can be repeated.
        progress: Function of what is searched next, and of the share of the work that is done; where something is
            missing there is more work.

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
    generator = repeatable_generator(generator)
    level = sidak_level(false_alarm, len(TESTS))  # p value of one test that makes a mismatch of all
    recording, judge = on_processor(recording), on_processor(judge)
    simulation = on_processor(modelled(simulation, recording, fitted_samples))
    given = prepared(recording, simulation, rate, generator)
    if judge is not None:
        judge = checked_judge(judge, recording, rate)
    if twice := same_data_words(given, judge):
        warnings.warn(twice, stacklevel=2)
    start, own = with_own_effects(given, simulation, level, generator)
    model = RepairedModel(noise_of(simulation, _unrounded(start)), start.info, own, noise_samples(simulation))
    before = run_tests(start, lambda what, share: progress(what, _TESTED * share))
    p_value = family_wise_p_value(before)
    if twins:
        p_value = monte_carlo_p_value(p_value, twin_p_values(start, twins, generator))

    def report(made: RepairedModel | None, **found: Any) -> MismatchReport:
        verdict = (
            None
            if judge is None
            else judged(judge, [recording], simulation, [] if made is None else [made], rate, len(own))
        )
        fitted = isinstance(simulation, Model | ArrayModel) and simulation.estimated_from is None
        words = KNOWN if fitted else "" if found["fit"] is None else found["fit"].words
        return MismatchReport(
            p_value=p_value,
            evidence=before,
            recording=given.recording,
            comparison=start,
            model=made or model,
            judged=verdict,
            notes=tuple(
                note
                for note in (twice, rest_words(given), words, "" if found["mismatch"] else _told(found["held_out"]))
                if note
            ),
            **found,
        )

    if p_value > false_alarm:
        return report(
            None,
            mismatch=False,
            findings=(),
            unexplained=(),
            held_out=agreement(start, (), generator),
            evidence_after=before,
            repaired=start,
            fit=fit_verdict(start, level),
        )
    selected, comparison = _searched(start, level, generator, progress)
    found = [one.finding for one in selected]
    findings = tuple(
        replace(f, context=Context(start, tuple(other.effect for other in found if other is not f))) for f in found
    )
    # Spectra as they were before a repair of theirs: what was found until then is no matter of the model's numbers.
    spectra = next((one.before for one in selected if one.finding.effect.of_spectra), comparison)
    after = run_tests(comparison, lambda what, share: progress(what, _ELIMINATED + (_COMPARED - _ELIMINATED) * share))
    unexplained = _significant(after, false_alarm)
    hidden = sorted({i for f in findings for i in f.hides})
    for finding in findings:
        own = finding.effect.left_of(own)
    left = repair_leftovers(start, comparison, unexplained, hidden, generator)
    comparison, effects = left.comparison, (*(f.effect for f in findings), *left.effects)
    if hidden:
        comparison = repaired(start, effects, generator)  # with what was recorded in the sensors that were hidden
        after = run_tests(comparison)
        seen = {*_OF_SAMPLES, *(result.test for result in unexplained)}
        unexplained += [result for result in _significant(after, false_alarm) if result.test not in seen]
    held_out = agreement(start, [*(one.score for one in selected), *left.scores], generator)
    if not unexplained and (much := discrepancy_left(comparison, held_out.after)):
        unexplained = [much]
    if judge is not None:
        progress("another recording", _COMPARED)
    of_samples = [effect for effect in effects if effect.of_samples]
    if of_samples:
        bare = _unrounded(repaired(start, of_samples, generator))
        model = replace(model, noise=noise_of(simulation, bare))
    return report(
        replace(model, effects=(*own, *(effect for effect in effects if not effect.of_samples))),
        mismatch=True,
        findings=findings,
        unexplained=tuple(unexplained),
        held_out=held_out,
        evidence_after=after,
        repaired=comparison,
        fit=fit_verdict(spectra, level),
    )


def _told(held_out: HeldOut) -> str:
    """What is said where a classifier sees what no test does."""
    surely = 0.8  # area under its curve
    if held_out.auc_before < surely:
        return ""
    return (
        f"A classifier tells the two apart all the same (area under the curve {held_out.auc_before:.2f}, 0.5 = "
        "guessing), by something that no test is made for: compare which values occur, and how often."
    )


def _significant(results: tuple[TestResult, ...], false_alarm: float) -> list[TestResult]:
    """Results of tests that see a difference."""
    return [result for result in results if sidak(result.p_value, len(results)) <= false_alarm]


def _searched(
    start: Comparison, level: float, generator: torch.Generator, progress: Callable[[str, float], None]
) -> tuple[list[Selected], Comparison]:
    """Findings that hold together, and recording and simulation with all of them repaired.

    What turns out to lead the simulation away may have stood in another one's place: it is searched once more without.
    """
    but_for: frozenset[type[Mechanism]] = frozenset()
    while True:
        selected, comparison = select(
            start, level, generator, lambda what, share: progress(what, _TESTED + (_FOUND - _TESTED) * share), but_for
        )
        progress("alternatives", _FOUND)
        selected, comparison = eliminate(selected, comparison, level, generator)
        kept, comparison = nearer(selected, start, comparison, generator)
        gone = {type(one.finding.effect) for one in selected} - {type(one.finding.effect) for one in kept}
        if but_for or not gone:
            return kept, comparison
        but_for = frozenset(gone)


def _unrounded(comparison: Comparison) -> Comparison:
    """The simulation before its own rounding, which a model of it does again."""
    if comparison.analog is comparison.reference.signal:
        return comparison
    return replace(comparison, reference=replace(comparison.reference, signal=comparison.analog))
