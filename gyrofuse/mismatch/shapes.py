"""Which spectral shapes make a simulation's spectra those of a recording: chosen by BIC, jointly, and their rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.bump_fit import oscillation_of
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import corrected
from gyrofuse.mismatch.folds import estimation_samples
from gyrofuse.mismatch.hysteresis import strongest_relay
from gyrofuse.mismatch.mechanism import Z
from gyrofuse.mismatch.noise_level import modulation, variance_p_value
from gyrofuse.mismatch.pooled import common_source
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.shape_bands import N_SLOW, Groups, deep, deep_base, in_blocks, narrow_bands, slow_fold
from gyrofuse.mismatch.shape_choice import QUICK, best_shapes, candidates, convincing, cost_of
from gyrofuse.mismatch.shape_fit import Fit, Ratios, data_model, fair_gain, fit, log_score, ratios
from gyrofuse.mismatch.shape_scan import bump_start, shape_p_value
from gyrofuse.mismatch.shape_terms import Bump, Common, CommonBump, Flicker, LowPass, PowerLaw, Shift, Term
from gyrofuse.mismatch.side import Side
from gyrofuse.mismatch.sweeps import swept
from gyrofuse.mismatch.witnesses import level_of

_RIVAL = 5.0  # nats
_ALIKE = 2.0  # nats between forms of a filter that are both likely
_FAR = 20.0  # nats behind after a first look that are not made up
_DOUBT = 1e-3  # p value of what is left by shapes that may be named
_PLACES = 16.0  # shapes and places that compete
_ORDER = {"scale": 0, "add": 1, "filter": 2}  # a filter acts on what was added, levels are those of the noise alone
_PLAIN = 25.0  # nats
_ALONE = 8.0  # nats that a shape has to bring by itself
_PER_OCTAVE = 4
_CLEAN = 8  # bins
_SLOW = 64  # cycles per record
_BROAD = 3.0  # half widths
_SHARED = 3.5  # standard deviations of a second gain that chance gives to none of the others
_SHARP, _NARROW = 0.1, (0.02, 0.04, 0.08)  # the same, below which bands are too wide for it, and of it there
_FINE, _NARROWEST = 24, 0.005  # bands in an octave for those, and the least that they show
_STEEPER, _FLICKER = 4.0, 0.15  # nats that another slope gains, and distance from 1 of flicker noise's
_UNSTEADY = 0.01  # p value of either sign of a level that may change
_FEWEST_SIMULATED = 2  # blocks of a simulation
_OFF = 0.25  # logarithm by which a centre from wide bands may be off


Form = tuple[LowPass, tuple[Tensor, Tensor]]


class Shape(NamedTuple):
    """A shape that was chosen.

    Attributes:
        term: It, its numbers those of the joint fit.
        company: The others of that fit.
        sd: Standard deviations of its local `(number, sensor)` and shared numbers; NaN where not free.
        gain: Nats that it adds to the others, without what its numbers cost.
        p_value: Of the same, for all the shapes that compete.
        alternatives: Mechanisms that explain as much in its place.
        frequency: Where it acts most, cycles per sample.
        levels: Wavelet levels where it shows.
        forms: Other forms of a filter that explain about as much, as `term` and `sd`.
    """

    term: Term
    company: tuple[Term, ...]
    sd: tuple[Tensor, Tensor]
    gain: float
    p_value: float
    alternatives: tuple[str, ...]
    frequency: float
    levels: tuple[int, ...]
    forms: tuple[Form, ...]


@remembered
def leading_shape(case: Case) -> Shape | None:
    """Of the shapes that together explain the spectra the one that acts first; None where they do not.

    Nor where one is flicker noise of another slope.
    """
    return _searched(case)


def _like_switching(term: Term, sd: Tensor) -> bool:
    """Whether a sensor that jumps between two levels may have that spectrum: more power below some frequency.

    Where jumps can be told from Gaussian noise, they were before spectra were looked at.
    """
    if isinstance(term, Common):  # of a source that one sensor alone surely has
        return term.kind == "ar1" and float(term.told(sd).topk(2).values[-1]) < _SHARED
    if isinstance(term, Bump):
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


def chosen_shape(case: Case, name: str, level: float) -> Shape | None:
    """The first shape, if it is that one and at p below `level`; narrow bumps that are plain come before it."""
    bump = oscillation_of(case)
    if name != "resonance" and bump is not None and bump.stretch.p_value <= level and bump.nats > _PLAIN:
        return None
    best = leading_shape(case)
    if best is None or best.term.name != name or best.p_value > level:
        return None
    if swept(case, best.gain, level):
        return None
    # A loop that a temperature draws is no noise, however slow.
    relay = strongest_relay(case) if best.frequency * case.n_samples < _SLOW else None
    return best if relay is None or relay.p_value > level else None


def compared(case: Case, per_octave: int = _PER_OCTAVE) -> Ratios:
    """Spectra of a case, without bands that hold a line which is not explained."""
    wanted = narrow_bands(case.n_samples, per_octave)
    both = deep(case, case.recorded.in_bands(wanted), case.simulated.in_bands(wanted))
    n_slow, usable = len(both.d) - len(wanted.dof), torch.ones_like(both.d)
    scale = case.simulated.signal.shape[-1] / case.n_samples
    if scale < 1:  # the lowest bins of short records hold what leaks from below
        usable[n_slow:] *= torch.tensor(wanted.edges[:-1]) * scale >= _CLEAN
    if case.line.p_value < _DOUBT:
        edges = torch.tensor(wanted.edges[1:-1], dtype=torch.float64) / case.n_samples
        place = torch.bucketize(torch.tensor(case.line.frequency, dtype=torch.float64), edges, right=True)
        usable[n_slow + place] = 0.0
    return ratios(both, deep_base(case), usable, _independent(case))


def refit(case: Case, fold: int, term: Term, company: Sequence[Term] = ()) -> Term:
    """A shape with its numbers estimated anew without what a fold holds out, together with those of its company."""
    keep = estimation_samples(case.n_samples, fold)
    run = run_length(keep)
    block = min(run, case.simulated.signal.shape[-1] // _FEWEST_SIMULATED)
    runs = case.recording[:, keep].unflatten(-1, (-1, run))[..., : run // block * block]
    recorded = runs.unflatten(-1, (-1, block)).flatten(1, 2).movedim(1, 0)
    simulated = in_blocks(case.simulated)[block]
    both = deep(case, Side(recorded, simulated.bands), simulated, _slow_without(fold))
    data = ratios(both, deep_base(case), torch.ones_like(both.d), _independent(case))
    found = fit(data, [term, *company])
    return fit(data.centred(found.model.diagonal(dim1=-2, dim2=-1).real), found.terms).terms[0]


def _slow_without(fold: int) -> Groups:
    """Slow ordinates that a fold does not hold out, in groups of an octave."""
    octaves = [range(2**j, min(2 ** (j + 1), N_SLOW + 1)) for j in range(N_SLOW.bit_length())]
    groups = (tuple(k for k in octave if slow_fold(k) != fold) for octave in octaves)
    return tuple(group for group in groups if group)


def _independent(case: Case) -> bool:
    """Whether the simulation's sensors have nothing of what those of the recording share."""
    source = common_source(case)
    return source is not None and source.independent


def run_length(keep: Tensor) -> int:
    """Length of the shortest run of samples kept, of which the others are multiples."""
    edges = torch.nn.functional.pad(keep.to(torch.int8), (1, 1)).diff().nonzero()[:, 0]
    return int(edges.diff()[::2].min())


def _searched(case: Case) -> Shape | None:
    data = compared(case)
    if float(data.worth.sum()) < 50:
        return None
    p_seen = shape_p_value(case)
    data, chosen = best_shapes(data, differ=p_seen < _DOUBT)
    if chosen is None or not convincing(data, chosen) or _falls_otherwise(data, chosen):
        return None
    seen = [_told(case, chosen, i) for i in range(len(chosen.terms))]
    nothing = float(log_score(data, data.expected).sum())

    def place(i: int) -> tuple[bool, int, float]:
        term, _ = seen[i]
        alone = float(log_score(data, data_model(data, [term])).sum()) - nothing
        return alone < _ALONE, _ORDER[term.acts], -alone

    first = min(range(len(seen)), key=place)
    term, others = chosen.terms[first], _others(chosen, first)
    whole = fair_gain(data, chosen.model)
    gain = whole - (max(_fairly(data, others), 0.0) if others else 0.0)
    p = corrected(float(stats.chi2.sf(2 * max(gain, 0.0), _freedom(data, term))), _PLACES)
    if not others:  # it is all that differs
        p = min(p, p_seen)
    if case.simulated.uncertainty is not None:  # the fit above takes the simulation's numbers for exact
        p = max(p, _beside_errors(case, term, p_seen))
    rivals = {
        rival.name
        for rival in candidates(data, others)
        if rival.name != term.name and _as_good(data, [*others, _in_sensors_of(term, rival)], chosen, whole)
    }
    if _like_switching(term, seen[first][1][0]):
        rivals.add("random_telegraph")
    if _louder(term, seen[first][1]) and min(modulation(case).p_value, variance_p_value(case)) < _UNSTEADY:
        rivals.add("variance_change")
    score = (log_score(data, data_model(data, [term])) - log_score(data, data.expected)).clamp(min=0)
    frequency = data.ground.bands.frequency
    told, sd = seen[first]
    return Shape(
        told,
        tuple(others),
        sd,
        gain - cost_of(data, term),
        p,
        tuple(sorted(rivals)),
        float(frequency[score.argmax()]),
        tuple(sorted({level_of(float(f)) for f in frequency[score > 0.05 * score.sum()]})),
        _forms(data, term, others, chosen.gain),
    )


def _beside_errors(case: Case, term: Term, p_seen: float) -> float:
    """Least p value of a shape beside what numbers of a fitted simulation may be off."""
    source = common_source(case) if isinstance(term, Common) else None
    return p_seen if source is None else min(p_seen, source.p_value)


def _falls_otherwise(data: Ratios, chosen: Fit) -> bool:
    """Whether what flicker noise was chosen for falls by another power of frequency: that has no name."""
    for i, term in enumerate(chosen.terms):
        if isinstance(term, Flicker):
            found = fit(data, [*_others(chosen, i), PowerLaw.like(term, data.ground)])
            if found.gain > chosen.gain + _STEEPER and abs(float(found.terms[-1].shared) - 1) > _FLICKER:
                return True
    return False


def _others(chosen: Fit, i: int) -> list[Term]:
    return [t for j, t in enumerate(chosen.terms) if j != i]


def _told(case: Case, chosen: Fit, i: int) -> tuple[Term, tuple[Tensor, Tensor]]:
    """A shape and standard deviations of its numbers; bumps as narrower bands tell them."""
    term = chosen.terms[i]
    if isinstance(term, Bump | CommonBump) and float(term.shared.diff()) < math.log(_SHARP):
        return _closer(case, term, _others(chosen, i))
    return term, chosen.sd(i)


def _forms(data: Ratios, term: Term, others: list[Term], gain: float) -> tuple[Form, ...]:
    """Other forms of a filter that are about as likely."""
    if not isinstance(term, LowPass):
        return ()
    fits = [fit(data, [*others, form]) for form in term.others()]
    return tuple((t, f.sd(-1)) for f in fits if f.gain > gain - _ALIKE and isinstance(t := f.terms[-1], LowPass))


def _as_good(data: Ratios, terms: list[Term], chosen: Fit, gain: float) -> bool:
    """Whether shapes gain about as much as those chosen, a nat less for each number that they do without (Akaike).

    Those that are far from it after a few rounds are not followed.
    """
    quick = fit(data, terms, QUICK)
    least = gain - _RIVAL - max(chosen.n_free - quick.n_free, 0)
    near = quick.gain > chosen.gain - _FAR or fair_gain(data, quick.model) > least + _RIVAL - _FAR
    return near and _fairly(data, quick.terms) > least


def _fairly(data: Ratios, terms: Sequence[Term]) -> float:
    """Gain of shapes with the numbers that suit them best where the law of F is taken at their own powers."""
    own = data.centred(fit(data, terms).model.diagonal(dim1=-2, dim2=-1).real)
    return fair_gain(data, fit(own, terms).model)


def _freedom(data: Ratios, term: Term) -> int:
    """Numbers that could have been free."""
    p = data.n_sensors
    if isinstance(term, Shift):
        return int(Shift.start(data.ground).free[term.parts].sum())
    if isinstance(term, Common):
        return (2 * p - 1 if term.turned else p) + 2 * len(term.shared)
    return term.local.numel() + 2 * len(term.shared)


def _closer(case: Case, term: Bump | CommonBump, others: list[Term]) -> tuple[Term, tuple[Tensor, Tensor]]:
    """A bump that is no wider than bands are, from narrower ones, and standard deviations of its numbers."""
    data = compared(case, _FINE)
    model = data_model(data, others)
    seen, frequency = term.shared[0].exp(), data.ground.bands.frequency
    centres = frequency[(frequency / seen).log().abs() < _OFF].tolist()
    starts = ((centre, share * centre) for centre in centres for share in _NARROW)
    start = bump_start(data, model, starts, term.free.any(0)) or term
    local = start.local
    if isinstance(term, CommonBump):
        common = CommonBump.start(data.ground, data.observed - model, data.worth, "oscillation", start.shared)
        local = common.local * term.free
    found = fit(data, [*others, replace(term, local=local, shared=start.shared, narrowest=_NARROWEST)])
    return found.terms[-1], found.sd(-1)
