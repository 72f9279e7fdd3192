"""Which spectral shapes make a simulation's spectra those of a recording, jointly by evidence, and their rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.decisions import NEW_TERM_NATS
from gyrofuse.mismatch.detectors.lines.chirps import swept
from gyrofuse.mismatch.detectors.slow.hysteresis import strongest_relay
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation, oscillation_of
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import common_source
from gyrofuse.mismatch.detectors.spectra.shape_scan import shape_p_value
from gyrofuse.mismatch.detectors.variance.noise_level import modulation, variance_p_value
from gyrofuse.mismatch.likelihoods.component_choice import (
    FITS,
    best_bump,
    best_terms,
    candidates,
    cost_of,
    filter_starts,
)
from gyrofuse.mismatch.likelihoods.components import Common, CommonBump, Flicker, LowPass, Peak, PowerLaw, Shift, Term
from gyrofuse.mismatch.likelihoods.spectral import Fit, Ratios, data_model, fit, fitness, log_gain, power_gains
from gyrofuse.mismatch.likelihoods.spectral_data import ratios, ratios_around
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.mismatch.stats.multiplicity import sidak

_RIVAL = 5.0  # nats
_ALIKE = 2.0  # nats between forms of a filter that are both likely
_FAR = 20.0  # nats behind after a first look that are not made up
_QUICK = 8  # rounds of it
_LARGELY = 0.9  # of the discrepancy, explained by terms that may be named though their form is not the true one
_PLACES = 16.0  # classes and places that compete
_ORDER = {"scale": 0, "add": 1, "filter": 2}  # a filter acts on what was added, levels are those of the noise alone
_PLAIN = 25.0  # nats
_ALONE = 8.0  # nats that a term has to bring by itself
_CLEAN = 8  # bins
_LITTLE = 0.1  # of what the term that would be missed most explains
_SLOW = 64  # cycles per record
_BROAD = 3.0  # half widths
_SHARED = 5.0  # standard deviations of a second gain, which power and correlation tell, that chance does not give
_SHARP, _NARROW = 0.1, (0.02, 0.04, 0.08)  # the same, below which bands are too wide for it, and of it there
_FINE, _NARROWEST = 24, 0.005  # bands in an octave for those, and the least that they show
_STEEPER, _FLICKER = 4.0, 0.15  # nats that another slope gains, and distance from 1 of flicker noise's
_UNBENT = 0.1  # cycles per sample, up to which means over samples and what is folded change noise by less than a fifth
_PLAINLY = 2.0  # nats by which slower noise is rather flicker noise than of the slope of all
_UNSTEADY = 0.01  # p value of either sign of a level that may change
_OFF = 0.25  # logarithm by which a centre from wide bands may be off
_ENOUGH = 50.0  # ordinates, to look for the shape of a spectrum
_BENT = 0.05  # log power: where what has another form changed a band, what is left there is its form


Form = tuple[LowPass, tuple[Tensor, Tensor]]


class Shape(NamedTuple):
    """A shape that was chosen.

    Attributes:
        term: It, its numbers those of the joint fit.
        company: The others of that fit.
        sd: Standard deviations of its local `(number, sensor)` and shared numbers; NaN where not free.
        sd_alone: Of its local numbers, all others held.
        gain: Nats that it adds to the others, without what its numbers cost.
        p_value: Of the same, for all the shapes that compete.
        alternatives: Mechanisms that explain as much in its place.
        frequency: Where it acts most, cycles per sample.
        levels: Wavelet levels where it shows.
        forms: Other forms of a filter that explain about as much, as `term` and `sd`.
        explained: Share of the discrepancy of powers beyond chance that all terms of the fit explain, in the sensors
            that have any of them.
        fits: Whether what they leave is no more than chance; else the form is another one.
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


@derived
def leading_shape(comparison: Comparison) -> Shape | None:
    """Of the shapes that together explain the spectra the one that acts first; None where they do not.

    Nor where one is flicker noise of another slope.
    """
    return _searched(comparison)


def _like_switching(term: Term, sd: Tensor) -> bool:
    """Whether a sensor that jumps between two levels may have that spectrum: more power below some frequency.

    Where jumps can be told from Gaussian noise, they were before spectra were looked at.
    """
    if isinstance(term, Common):  # of a source that one sensor alone surely has
        return term.kind == "ar1" and float(term.told(sd).topk(2).values[-1]) < _SHARED
    if isinstance(term, Peak):
        centre, width = term.shared.exp().tolist()
        return bool(centre < _BROAD * width)
    if isinstance(term, Shift):
        return bool((term.local[1:] > 0).any())
    return isinstance(term, Flicker)


def _louder(term: Term, sd: tuple[Tensor, Tensor]) -> bool:
    """Whether it is plainly more white noise: of noise that is louder at times the spectrum shows the mean."""
    return isinstance(term, Shift) and bool((term.local[0] > Z * sd[0][0]).any())


def _in_sensors_of(term: Term, rival: Term) -> Term:
    """A rival in the sensors that take part."""
    if isinstance(term, Common) or isinstance(rival, Common):
        return rival
    free = rival.free & term.free.any(0)
    return rival.only(free) if bool(free.any()) else rival


def chosen_shape(comparison: Comparison, name: str, level: float) -> Shape | None:
    """The first shape, if it is that one and at p below `level`; narrow bumps that it leaves plain come before it."""
    best = leading_shape(comparison)
    if best is None or best.term.name != name or best.p_value > level:
        return None
    peak = oscillation_of(comparison)
    plain = peak is not None and peak.stretch.p_value <= level and peak.nats > _PLAIN
    if peak is not None and plain and name != "resonance" and _stands_out(comparison, best, peak):
        return None
    if swept(comparison, best.gain, level):
        return None
    # A loop that a temperature draws is no noise, however slow.
    relay = strongest_relay(comparison) if best.frequency * comparison.n_samples < _SLOW else None
    return best if relay is None or relay.p_value > level else None


def _stands_out(comparison: Comparison, best: Shape, peak: Oscillation) -> bool:
    """Whether a peak is there beside shapes: what bends around a filter's corner looks like one without it."""
    data, terms = ratios_around(comparison, peak.centre, 2 * peak.width), [best.term, *best.company]
    start = best_bump(data, terms, torch.tensor([[peak.centre, peak.width]], dtype=torch.float64)) if data else None
    if data is None or start is None:
        return False
    models = (data_model(data, t).diagonal(dim1=-2, dim2=-1).real for t in (terms, [*terms, start]))
    before, after = (float(power_gains(data, m).sum()) for m in models)
    return after - before > NEW_TERM_NATS


def compared(comparison: Comparison, blocks: Tensor | None = None, folds: Tensor | None = None) -> Ratios:
    """Spectra of both sides that shapes are fitted to, of some blocks and folds; see `ratios`."""
    return ratios(comparison, blocks, folds, independent=_independent(comparison), formed=False)


def refit(comparison: Comparison, fold: int, term: Term, company: Sequence[Term] = ()) -> Term:
    """A term with its numbers estimated anew without what a fold holds out, together with those of its company.

    The simulation's blocks are held out as well: its chance is in the numbers that are judged.
    """
    data = compared(comparison, ~in_fold(N_JUDGED, fold), torch.arange(N_FOLDS) != fold)
    return fit(data, [term, *company]).terms[0]


def _independent(comparison: Comparison) -> bool:
    """Whether the simulation's sensors have nothing of what those of the recording share."""
    source = common_source(comparison)
    return source is not None and source.independent


def run_length(keep: Tensor) -> int:
    """Length of the shortest run of samples kept, of which the others are multiples."""
    edges = torch.nn.functional.pad(keep.to(torch.int8), (1, 1)).diff().nonzero()[:, 0]
    return int(edges.diff()[::2].min())


def _searched(comparison: Comparison) -> Shape | None:
    data = compared(comparison)
    if data.n_ordinates < _ENOUGH:
        return None
    p_seen = 1.0 if comparison.bent else shape_p_value(comparison)  # which looks where a filter's form is off as well
    chosen, mended = best_terms(data, differ=p_seen < FITS)
    if chosen is None or _falls_otherwise(data, chosen):
        return None
    nothing, left = fitness(data, data.expected), fitness(data, chosen.model)
    fits = left.p_value > FITS and not mended
    # Where no term has a part, what differs has another cause.
    concerned = torch.stack([t.free.any(0) for t in chosen.terms]).any(0)
    excess = [float(f.excess[concerned].clamp(min=0).sum()) for f in (left, nothing)]
    # Where sensors share what they had before, powers have nothing to explain.
    explained = 1 - excess[0] / max(excess[1], 1e-9) if nothing.p_value <= FITS else 1.0
    if not fits and explained < _LARGELY:
        return None
    seen = [_told(comparison, chosen, i) for i in range(len(chosen.terms))]

    losses = (
        [chosen.gain - max(fit(data, _others(chosen, i)).gain, 0.0) for i in range(len(seen))] if seen[1:] else [0.0]
    )
    most = max(range(len(seen)), key=lambda i: losses[i])

    def place(i: int) -> tuple[bool, int, float]:
        term, _ = seen[i]
        alone = float(log_gain(data, data_model(data, [term])).sum())
        # What a little was left for beside a common source or a mode is not to come before it.
        little = seen[most][0].acts != "filter" and losses[i] < _LITTLE * losses[most]
        return alone < _ALONE or little, _ORDER[term.acts], -alone

    first = min(range(len(seen)), key=place)
    term, others = chosen.terms[first], _others(chosen, first)
    gain = chosen.gain
    if others:
        rest = fit(data, others)
        gain -= max(rest.gain, 0.0)
    p = sidak(float(stats.chi2.sf(2 * max(gain, 0.0), _freedom(data, term))), _PLACES)
    if not others:  # it is all that differs
        p = min(p, p_seen)
    if comparison.reference.uncertainty is not None:  # the fit above takes the simulation's numbers for exact
        p = max(p, _beside_errors(comparison, term, p_seen))
    rivals = {
        rival.name
        for rival in candidates(data, others)
        if rival.name != term.name and _as_good(data, [*others, _in_sensors_of(term, rival)], chosen)
    }
    if _like_switching(term, chosen.sd_alone(first)):
        rivals.add("random_telegraph")
    if _louder(term, seen[first][1]) and min(modulation(comparison).p_value, variance_p_value(comparison)) < _UNSTEADY:
        rivals.add("variance_change")
    score = power_gains(data, data_model(data, [term]).diagonal(dim1=-2, dim2=-1).real).sum(-1)
    if isinstance(term, Common):
        score = log_gain(data, data_model(data, [term]))
    score = score.clamp(min=0)
    frequency = data.ground.bands.frequency
    told, sd = seen[first]
    return Shape(
        told,
        tuple(others),
        sd,
        chosen.sd_alone(first),
        gain - cost_of(chosen) / len(chosen.terms),
        p,
        tuple(sorted(rivals)),
        float(frequency[score.argmax()]),
        tuple(sorted({level_of(float(f)) for f in frequency[score > 0.05 * score.sum()]})),
        _forms(data, term, others, chosen.gain),
        explained,
        fits,
    )


def _beside_errors(comparison: Comparison, term: Term, p_seen: float) -> float:
    """Least p value of a shape beside what numbers of a fitted simulation may be off."""
    source = common_source(comparison) if isinstance(term, Common) else None
    return p_seen if source is None else min(p_seen, source.p_value)


def _falls_otherwise(data: Ratios, chosen: Fit) -> bool:
    """Whether what flicker noise was chosen for falls by another power of frequency: that has no name."""
    for i, term in enumerate(chosen.terms):
        if isinstance(term, Flicker):
            terms = [*_others(chosen, i), PowerLaw.like(term, data.ground)]
            found = fit(data, terms)
            slope = float(found.terms[-1].shared)
            if found.gain <= chosen.gain + _STEEPER or abs(slope - 1) <= _FLICKER:
                continue
            if not _only_bent(data, terms, slope):
                return True
    return False


def _only_bent(data: Ratios, terms: list[Term], slope: float) -> bool:
    """Whether noise of a power law, the last term, falls as `1/f` well below the rate, and not by the slope of it all.

    Next to the rate any noise is bent by how it is sampled: means over samples lose some of it, and what lies above
    half the rate is folded onto it. Where it is far above the rest, that alone makes for another slope.
    """
    below = fit(data.without((data.ground.bands.frequency > _UNBENT)[:, None]), terms)
    told, sd = float(below.terms[-1].shared), float(below.sd(-1)[1])
    return (slope - told) ** 2 - (1 - told) ** 2 > 2 * _PLAINLY * sd**2


def _others(chosen: Fit, i: int) -> list[Term]:
    return [t for j, t in enumerate(chosen.terms) if j != i]


def _told(comparison: Comparison, chosen: Fit, i: int) -> tuple[Term, tuple[Tensor, Tensor]]:
    """A shape and standard deviations of its numbers; bumps as narrower bands tell them."""
    term = chosen.terms[i]
    if isinstance(term, Peak | CommonBump) and float(term.shared.diff()) < math.log(_SHARP):
        return _closer(comparison, term, _others(chosen, i))
    return term, chosen.sd(i)


def _forms(data: Ratios, term: Term, others: list[Term], gain: float) -> tuple[Form, ...]:
    """Other forms of a filter that are about as likely."""
    if not isinstance(term, LowPass):
        return ()
    forms = [replace(form, free=term.free) for form in filter_starts(data, others) if form.kind != term.kind]
    fits = [f for form in forms if (f := fit(data, [*others, form], _QUICK)).gain > gain - _FAR]
    fits = [fit(data, f.terms) for f in fits]
    return tuple((t, f.sd(-1)) for f in fits if f.gain > gain - _ALIKE and isinstance(t := f.terms[-1], LowPass))


def _as_good(data: Ratios, terms: list[Term], chosen: Fit) -> bool:
    """Whether terms gain about as much as those chosen, a nat less for each number that they do without (Akaike).

    Those that are far from it after a few rounds are not followed.
    """
    quick = fit(data, terms, _QUICK)
    least = chosen.gain - _RIVAL - max(len(chosen.information) - len(quick.information), 0)
    return quick.gain > least - _FAR and fit(data, quick.terms).gain > least


def _freedom(data: Ratios, term: Term) -> int:
    """Numbers that could have been free."""
    p = data.n_sensors
    if isinstance(term, Shift):
        return int(Shift.start(data.ground).free[term.parts].sum())
    if isinstance(term, Common):
        return (2 * p - 1 if term.turned else p) + 2 * len(term.shared)
    return term.local.numel() + 2 * len(term.shared)


def _alone(term: CommonBump) -> Peak:
    """A common bump's powers, as bumps of each sensor's own."""
    centre, width = term.shared.exp().tolist()
    return Peak.start(centre, width, term.local.square().sum(0))


def _closer(comparison: Comparison, term: Peak | CommonBump, others: list[Term]) -> tuple[Term, tuple[Tensor, Tensor]]:
    """A peak that is no wider than bands are, fitted in narrow cells, and standard deviations of its numbers."""
    centre, width = term.shared.exp().tolist()
    data = ratios_around(comparison, centre, 2 * width)
    if data is None:
        return term, (torch.full_like(term.local, math.nan), torch.full_like(term.shared, math.nan))
    bands = data.ground.bands
    narrowest = 1.5 / comparison.n_samples / centre
    places = [
        (float(f), share * width)
        for f in bands.frequency
        if abs(float(f) - centre) < 2 * width
        for share in (0.3, 0.6, 1.0)
    ]
    start = best_bump(data, others, torch.tensor(places, dtype=torch.float64))
    if start is None:
        start = term if isinstance(term, Peak) else _alone(term)
    local = start.local * term.free.any(0)
    if isinstance(term, CommonBump):
        excess = data.observed - data_model(data, others)
        common = CommonBump.start(data.ground, excess, data.worth, "oscillation", start.shared)
        local = common.local * term.free
    found = fit(data, [*others, replace(term, local=local, shared=start.shared, narrowest=narrowest)])
    return found.terms[-1], found.sd(-1)
