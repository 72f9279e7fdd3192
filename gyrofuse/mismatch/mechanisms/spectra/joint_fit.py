"""Which spectral shapes make a simulation's spectra those of a recording, jointly by evidence, and their rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.decisions import CERTAIN, NATS_AS_GOOD, NATS_PER_NUMBER, NEW_TERM_NATS
from gyrofuse.mismatch.detectors.moving.chirps import swept
from gyrofuse.mismatch.detectors.slow.hysteresis import strongest_relay
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation, oscillation_of
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import common_source
from gyrofuse.mismatch.detectors.spectra.shape_scan import shape_p_value
from gyrofuse.mismatch.detectors.variance.level_spread import level_variance
from gyrofuse.mismatch.detectors.variance.noise_level import modulation, variance_p_value
from gyrofuse.mismatch.likelihoods.spectra.choice import best_terms, cost_of
from gyrofuse.mismatch.likelihoods.spectra.common_sources import CommonBump
from gyrofuse.mismatch.likelihoods.spectra.components import Peak, Term
from gyrofuse.mismatch.likelihoods.spectra.data import ratios, ratios_around
from gyrofuse.mismatch.likelihoods.spectra.fit import Fit, data_model, fit, powers
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios, fitness, log_gain, power_gains
from gyrofuse.mismatch.likelihoods.spectra.starts import best_bump, candidates, other_forms
from gyrofuse.mismatch.mechanisms.spectra.slopes.any_slope import with_its_slope
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold
from gyrofuse.mismatch.stats.multiplicity import e_value_of, sidak
from gyrofuse.mismatch.stats.segments import runs_of

# Share of the discrepancy that terms have to explain to be named though their form is not quite the recording's: of
# twenty-one filters of other forms than the catalogue's they explained 95 % at least.
_LARGELY = 0.9
_ORDER = ("undo", "scale", "add", "filter")  # a filter acts on what was added, levels are those of the noise alone
_QUICK, _FAR = 8, 20.0  # rounds of a fit that only ranks, and nats behind after them that are not made up
_SHARP = 0.1  # half width of a peak over its centre, below which bands of blocks are too wide for it


Form = tuple[Term, tuple[Tensor, Tensor]]


class Shape(NamedTuple):
    """A shape that was chosen.

    Attributes:
        term: Component with the numbers of the joint fit.
        company: The others of that fit.
        sd: Standard deviations of its local `(number, sensor)` and shared numbers; NaN where not free.
        sd_alone: Of its local numbers, all others held.
        gain: Nats that it adds to the others, without what its numbers cost.
        p_value: Of the same, for all the shapes that compete.
        alternatives: Mechanisms that explain as much instead.
        frequency: Where it acts most, cycles per sample.
        levels: Wavelet levels where it shows.
        forms: Other forms of the same that explain about as much, as `term` and `sd`.
        explained: Share of the discrepancy of powers beyond chance that all terms of the fit explain, in the sensors
            that have any of them.
        fits: Whether what they leave is no more than chance; else the form is another one.
        alone: Whether the company adds next to nothing.
    """

    term: Term
    company: tuple[Term, ...]
    sd: tuple[Tensor, Tensor]
    sd_alone: Tensor
    gain: float
    p_value: float
    alternatives: tuple[str, ...]
    frequency: float
    levels: tuple[int, ...]
    forms: tuple[Form, ...]
    explained: float
    fits: bool
    alone: bool


def _in_sensors_of(term: Term, rival: Term) -> Term:
    """A rival in the sensors that take part."""
    if term.coherent or rival.coherent:
        return rival
    free = rival.free & term.free.any(0)
    return rival.only(free) if bool(free.any()) else rival


def chosen_shape(comparison: Comparison, name: str, level: float) -> Shape | None:
    """The first shape, if it is that one and at p below `level`; narrow bumps that it leaves plain come before it."""
    best = leading_shape(comparison)
    if best is None or best.term.name != name or best.p_value > level:
        return None
    peak = oscillation_of(comparison)
    plain = peak is not None and peak.stretch.p_value <= level and peak.nats > 3 * NEW_TERM_NATS
    if best.fits and peak is not None and peak.width > _SHARP * peak.centre:  # bands would show it
        plain = False
    if peak is not None and plain and name != "resonance" and _stands_out(comparison, best, peak):
        return None
    if swept(comparison, best.gain, level):
        return None
    # A loop that a temperature draws is no noise, however slow.
    slow = 64  # cycles per record
    relay = strongest_relay(comparison) if best.frequency * comparison.n_samples < slow else None
    return best if relay is None or relay.p_value > level else None


def _stands_out(comparison: Comparison, best: Shape, peak: Oscillation) -> bool:
    """Whether a peak is there beside shapes: without the filter, what bends around its corner has the same shape."""
    data, terms = ratios_around(comparison, peak.centre, 2 * peak.width), [best.term, *best.company]
    start = best_bump(data, terms, torch.tensor([[peak.centre, peak.width]], dtype=torch.float64)) if data else None
    if data is None or start is None:
        return False
    models = (powers(data_model(data, t)) for t in (terms, [*terms, start]))
    before, after = (float(power_gains(data, m).sum()) for m in models)
    return after - before > NEW_TERM_NATS


@derived
def compared(comparison: Comparison) -> Ratios:
    """Spectra of both sides that shapes are fitted to."""
    return _compared_in(comparison)


def _compared_in(comparison: Comparison, blocks: Tensor | None = None, folds: Tensor | None = None) -> Ratios:
    """The same of some blocks and folds; see `ratios`."""
    return ratios(comparison, blocks, folds, independent=_independent(comparison), formed=False)


def refit(comparison: Comparison, fold: int, term: Term, company: Sequence[Term] = ()) -> Term:
    """A term with its numbers estimated anew without what a fold holds out, together with those of its company.

    The simulation's blocks are held out as well: its chance is in the numbers that are judged.
    """
    data = _compared_in(comparison, ~in_fold(N_JUDGED, fold), torch.arange(N_FOLDS) != fold)
    return fit(data, [term, *company]).terms[0]


def _independent(comparison: Comparison) -> bool:
    """Whether the simulation's sensors have nothing of what those of the recording share."""
    source = common_source(comparison)
    return source is not None and source.independent


def run_length(keep: Tensor) -> int:
    """Length of the shortest run of samples kept, of which the others are multiples."""
    return int(runs_of(keep).diff().min())


@derived
def leading_shape(comparison: Comparison) -> Shape | None:
    """Of the shapes that together explain the spectra the one that acts first; None where they do not.

    Nor where the first mends the form of what was found before.
    """
    data = compared(comparison)
    fewest = 50.0  # complex ordinates, to search for the shape of a spectrum
    if data.n_ordinates < fewest:
        return None
    p_seen = 1.0 if comparison.bent else shape_p_value(comparison)  # includes bands where a filter's form is off
    chosen, mended = best_terms(data, differ=p_seen < CERTAIN)
    if chosen is None:
        return None
    chosen = with_its_slope(data, chosen)
    fits, explained = _explained(data, chosen)
    fits &= not mended
    if not fits and explained < _LARGELY:
        return None
    wider = torch.ones(data.n_sensors, dtype=torch.float64) if fits else _overdispersion(data, chosen)
    seen = [_with_sd(comparison, chosen, i) for i in range(len(chosen.terms))]
    seen = [(term, (local * wider, shared * wider.max())) for term, (local, shared) in seen]
    found = [_found_before(term, data, comparison) for term, _ in seen]
    first, gain, alone = _first(data, chosen, [term for term, _ in seen], found, comparison.passed_over)
    if found[first] or chosen.terms[first].name in comparison.passed_over:
        return None
    term, others = chosen.terms[first], chosen.others(first)
    n_classes = 16.0  # classes and frequencies that compete
    p = sidak(float(stats.chi2.sf(2 * gain, term.n_free(data.ground))), n_classes)
    if not others and gain >= e_value_of(p_seen):  # all that the scan of shapes saw: a mean is not above the best
        p = min(p, p_seen)
    # The fit takes the simulation's numbers for exact, and noise for one whose level varies by Gaussian chance alone.
    if comparison.reference.uncertainty is not None or bool(level_variance(comparison).any()):
        p = max(p, _beside_errors(comparison, term, p_seen))
    score = log_gain(data, data_model(data, [term]), paired=term.coherent).clamp(min=0)
    frequency = data.ground.bands.frequency
    return Shape(
        term=seen[first][0],
        company=tuple(others),
        sd=seen[first][1],
        sd_alone=chosen.sd_alone(first),
        gain=gain - cost_of(chosen) / len(chosen.terms),
        p_value=p,
        alternatives=_rivals(comparison, data, chosen, first, seen[first][1]),
        frequency=float(frequency[score.argmax()]),
        levels=tuple(sorted({level_of(float(f)) for f in frequency[score > 0.05 * score.sum()]})),
        forms=_forms(data, term, others, chosen.gain),
        explained=explained,
        fits=fits,
        alone=alone,
    )


def _explained(data: Ratios, chosen: Fit) -> tuple[bool, float]:
    """Whether what is left is no more than chance, and the share of the discrepancy that terms explain.

    In the sensors that have any of them: what differs in others has another cause.
    """
    nothing, left = fitness(data, data.expected), fitness(data, chosen.model)
    concerned = torch.stack([t.free.any(0) for t in chosen.terms]).any(0)
    before, after = (float(f.excess[concerned].clamp(min=0).sum()) for f in (nothing, left))
    # Where sensors share what they had before, powers have nothing to explain.
    explained = 1 - after / max(before, 1e-9) if nothing.p_value <= CERTAIN else 1.0
    return left.p_value > CERTAIN, explained


def _overdispersion(data: Ratios, chosen: Fit) -> Tensor:
    """Factors of standard deviations `(sensor,)` where a form is not quite the recording's: quasi-likelihood's."""
    dof = data.weight.sum(0).clamp(min=1.0)
    return (1 + 2 * fitness(data, chosen.model).excess.clamp(min=0) / dof).sqrt()


def _found_before(term: Term, data: Ratios, comparison: Comparison) -> bool:
    """Whether a filter of its name acts already where this one acts most, in all of its sensors: it mends that form.

    The recording's filter is another one than that of the simulation, which was undone.
    """
    plain, has = 0.1, term.free.any(0)  # log power
    if term.acts not in ("filter", "undo"):
        return False
    where = term.values(data.ground, term.local, term.shared).log().abs().argmax(-1)
    for name, factor in comparison.filters:
        done = factor(data.ground.nodes[where]).diagonal().log()[has]
        if name == term.name and bool(((done < -plain) | ((done > plain) & (term.acts == "undo"))).all()):
            return True
    return False


def _first(
    data: Ratios, chosen: Fit, terms: list[Term], found_before: list[bool], passed_over: Sequence[str]
) -> tuple[int, float, bool]:
    """The term that acts first, what it adds to the log likelihood of the others, nats, and whether they add little.

    Not one that gains nothing by itself unless others need it, nor the little that was left for beside a common source
    or a mode, or, less yet, beside a filter. Where one mends the form of a filter that was found before, what is added
    may as well: other filters come first. So do others than those that do not hold.
    """
    losses, next_to_nothing = [chosen.gain], 0.01
    if len(terms) > 1:
        losses = [chosen.gain - max(fit(data, chosen.others(i)).gain, 0.0) for i in range(len(terms))]
    most = max(range(len(terms)), key=lambda i: losses[i])

    def rank(i: int) -> tuple[bool, bool, bool, int, float]:
        mends = found_before[i] or (any(found_before) and terms[i].acts != "filter")
        alone = float(log_gain(data, data_model(data, [terms[i]])).sum())
        faint = losses[i] < losses[most] * (next_to_nothing if terms[most].acts == "filter" else 0.1)
        needed = losses[i] > losses[most] / 10
        idle = faint or (alone < NEW_TERM_NATS and not needed)
        return terms[i].name in passed_over, idle, mends, _ORDER.index(terms[i].acts), -alone

    first = min(range(len(terms)), key=rank)
    alone = all(losses[i] < next_to_nothing * losses[first] for i in range(len(terms)) if i != first)
    return first, max(losses[first], 0.0), alone


def _rivals(
    comparison: Comparison, data: Ratios, chosen: Fit, first: int, sd: tuple[Tensor, Tensor]
) -> tuple[str, ...]:
    """Mechanisms that explain as much as the first term, by name."""
    term, others = chosen.terms[first], chosen.others(first)
    rivals = {
        rival.name
        for rival in candidates(data, others)
        if rival.name != term.name and _as_good(data, [*others, _in_sensors_of(term, rival)], chosen)
    }
    # Jumps between two levels that differ from Gaussian noise were found before spectra were fitted.
    if term.rises_below(chosen.sd_alone(first)):
        rivals.add("random_telegraph")
    # Of noise that is louder at times the spectrum shows the mean: plainly more white noise.
    if term.louder(sd[0]):
        unsteady = 0.01  # p value of either test of a level that changes
        if min(modulation(comparison).p_value, variance_p_value(comparison)) < unsteady:
            rivals.add("variance_change")
    return tuple(sorted(rivals))


def _beside_errors(comparison: Comparison, term: Term, p_seen: float) -> float:
    """Least p value of a shape beside what numbers of a fitted simulation may be off."""
    source = common_source(comparison) if term.coherent else None
    return p_seen if source is None else min(p_seen, source.p_value)


def _with_sd(comparison: Comparison, chosen: Fit, i: int) -> tuple[Term, tuple[Tensor, Tensor]]:
    """A shape and standard deviations of its numbers; of sharp peaks by narrower bands."""
    term = chosen.terms[i]
    if isinstance(term, Peak | CommonBump) and float(term.shared.diff()) < math.log(_SHARP):
        closer = _closer(comparison, term, chosen.others(i))
        if bool(closer[1][1].isfinite().all()):  # else there are too few bands next to zero
            return closer
    return term, chosen.sd(i)


def _forms(data: Ratios, term: Term, others: list[Term], gain: float) -> tuple[Form, ...]:
    """Other forms of a term that are about as likely."""
    forms = [replace(form, free=term.free) for form in other_forms(data, term, others)]
    fits = [f for form in forms if (f := fit(data, [*others, form], _QUICK)).gain > gain - _FAR]
    fits = [fit(data, f.terms) for f in fits]
    return tuple((f.terms[-1], f.sd(-1)) for f in fits if f.gain > gain - NATS_PER_NUMBER)


def _as_good(data: Ratios, terms: list[Term], chosen: Fit) -> bool:
    """Whether terms gain about as much as those chosen, a nat less for each number that they do without (Akaike).

    Those that are far from it after a few rounds are not followed.
    """
    quick = fit(data, terms, _QUICK)
    least = chosen.gain - NATS_AS_GOOD - max(len(chosen.information) - len(quick.information), 0)
    return quick.gain > least - _FAR and fit(data, quick.terms).gain > least


def _closer(comparison: Comparison, term: Peak | CommonBump, others: list[Term]) -> tuple[Term, tuple[Tensor, Tensor]]:
    """A peak that is no wider than bands are, fitted in narrow cells, and standard deviations of its numbers."""
    centre, width = term.shared.exp().tolist()
    data = ratios_around(comparison, centre, 2 * width)
    if data is None:
        return term, (torch.full_like(term.local, math.nan), torch.full_like(term.shared, math.nan))
    bands = data.ground.bands
    narrowest = 1.5 / comparison.n_samples / centre
    reach = max(2 * width, float(bands.frequency[1] - bands.frequency[0]))  # of a peak within a cell, one beside it
    places = [
        (float(f), share * width)
        for f in bands.frequency
        if abs(float(f) - centre) < reach
        for share in (0.3, 0.6, 1.0)
    ]
    start = best_bump(data, others, torch.tensor(places, dtype=torch.float64))
    if start is None:
        start = Peak.start(centre, width, term.variance)
    local = start.local * term.free.any(0)
    if isinstance(term, CommonBump):
        excess = data.observed - data_model(data, others)
        common = CommonBump.start(data.ground, excess, data.information, "oscillation", start.shared)
        local = common.local * term.free
    found = fit(data, [*others, replace(term, local=local, shared=start.shared, narrowest=narrowest)])
    return found.terms[-1], found.sd(-1)
