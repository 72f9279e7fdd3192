"""Which spectral shapes make a simulation's spectra those of a recording: chosen by BIC, jointly, and their rivals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.bumps import oscillation_of
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import corrected
from gyrofuse.mismatch.filter_forms import FILTERS
from gyrofuse.mismatch.folds import estimation_samples
from gyrofuse.mismatch.pooled import common_source
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.shape_bands import N_SLOW, Groups, deep, deep_base, in_blocks, narrow_bands, slow_fold
from gyrofuse.mismatch.shape_fit import Fit, Ratios, data_model, fair_gain, fit, log_score, ratios
from gyrofuse.mismatch.shape_scan import bump_start, scanned
from gyrofuse.mismatch.shape_terms import Bump, Common, CommonBump, Flicker, LowPass, Shift, Term
from gyrofuse.mismatch.side import Side
from gyrofuse.mismatch.witnesses import level_of

_MOST = 4  # shapes at once
_RIVAL = 5.0  # nats
_ALIKE = 2.0  # nats between forms of a filter that are both likely
_QUICK, _FAR, _KEPT = 6, 20.0, 3  # rounds of a first look; nats behind that are not made up; shapes looked at closely
_DOUBT = 1e-3  # p value of what is left by shapes that may be named
_SMALL = 0.1  # share of what there was to explain that may be left all the same
_PLACES = 16.0  # shapes and places that compete
_NEW = 8.0  # nats that a shape costs beside its numbers
_NUMBER = 2.0  # nats for a number of a sensor: those of sensors that have it are alike
_TOUCH = 0.1
_ORDER = {"scale": 0, "add": 1, "filter": 2}  # a filter acts on what was added, levels are those of the noise alone
_PLAIN = 25.0  # nats
_ALONE = 8.0  # nats that a shape has to bring by itself
_PER_OCTAVE = 4
_CLEAN = 8  # bins
_BROAD = 3.0  # half widths
_FORMS = 3  # of filters
_WIDTHS = (0.06, 0.15, 0.35)  # half width of a bump over its centre
_SHARP, _NARROW = 0.1, (0.02, 0.04, 0.08)  # the same, below which bands are too wide for it, and of it there
_FINE, _NARROWEST = 24, 0.005  # bands in an octave for those, and the least that they show
_OFF = 0.25  # logarithm by which a centre from wide bands may be off
_CORNER_BINS = (4.0, 0.3)  # corners of common AR1s to start from: bins, cycles per sample


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
    """Of the shapes that together explain the spectra the one that acts first; None where they do not."""
    return _searched(case)


def _like_switching(term: Term) -> bool:
    """Whether a sensor that jumps between two levels may have that spectrum: more power below some frequency.

    Where jumps can be told from Gaussian noise, they were before spectra were looked at.
    """
    if isinstance(term, Common):
        return False
    if isinstance(term, Bump):
        centre, width = term.shared.exp().tolist()
        return bool(centre < _BROAD * width)
    if isinstance(term, Shift):
        return bool((term.local[1:] > 0).any())
    return isinstance(term, Flicker)


def _like_missing(term: Term, data: Ratios) -> bool:
    """Whether it may be an AR1 of sensors of which the simulation has none whose numbers could be other ones."""
    lacking = term.free.any(0) & ~data.ground.matters[1]
    return _like_switching(term) and not isinstance(term, Shift) and bool(lacking.any())


def chosen_shape(case: Case, name: str, level: float) -> Shape | None:
    """The first shape, if it is that one and at p below `level`; narrow bumps that are plain come before it."""
    bump = oscillation_of(case)
    if name != "resonance" and bump is not None and bump.stretch.p_value <= level and bump.nats > _PLAIN:
        return None
    best = leading_shape(case)
    return best if best is not None and best.term.name == name and best.p_value <= level else None


def compared(case: Case, per_octave: int = _PER_OCTAVE) -> Ratios:
    """Spectra of a case, without bands that hold a line which is not explained."""
    wanted = narrow_bands(case.n_samples, per_octave)
    both = deep(case, Side(case.recorded.signal, wanted), Side(case.simulated.signal, wanted))
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
    block = run_length(keep)
    recorded = case.recording[:, keep].unflatten(-1, (-1, block)).movedim(1, 0)
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
    scan = scanned(case)
    p_seen = 1.0 if scan is None else scan.p_value
    data, chosen = _chosen(data, differ=p_seen < _DOUBT)
    if chosen is None or not _convincing(data, chosen):
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
    rivals = {
        rival.name
        for rival in _candidates(data, others)
        if rival.name != term.name and _as_good(data, [*others, rival], chosen, whole)
    }
    if _like_switching(term):
        rivals.add("random_telegraph")
    if _like_missing(term, data):
        rivals.add("parameter_shift")
    score = (log_score(data, data_model(data, [term])) - log_score(data, data.expected)).clamp(min=0)
    frequency = data.ground.bands.frequency
    told, sd = seen[first]
    return Shape(
        told,
        tuple(others),
        sd,
        gain - _cost(data, term),
        p,
        tuple(sorted(rivals)),
        float(frequency[score.argmax()]),
        tuple(sorted({level_of(float(f)) for f in frequency[score > 0.05 * score.sum()]})),
        _forms(data, term, others, chosen.gain),
    )


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
    quick = fit(data, terms, _QUICK)
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


def _chosen(data: Ratios, *, differ: bool) -> tuple[Ratios, Fit | None]:
    """Shapes added one at a time while BIC falls, then taken away while it falls; one at least of what does differ."""
    best: Fit | None = None
    value = -math.inf if differ else 0.0
    for _ in range(_MOST):
        now = list(best.terms) if best else []
        quick = [fit(data, [*now, c], _QUICK) for c in _candidates(data, now)]
        kept = {*sorted(quick, key=lambda f: -f.gain)[:_KEPT], *sorted(quick, key=lambda f: -_value(data, f))[:_KEPT]}
        tried = [_varied(data, _pruned(data, fit(data, f.terms))) for f in kept]
        top = max(tried, key=lambda f: _value(data, f), default=None)
        if top is None or _value(data, top) <= value:
            break
        data = data.centred(top.model.diagonal(dim1=-2, dim2=-1).real)
        best = fit(data, top.terms)
        value = max(_value(data, best), 0.0)
    while best is not None and len(best.terms) > 1:
        fewer = [[_freed(data, t) for t in best.terms if t is not gone] for gone in best.terms]
        top = max((_pruned(data, fit(data, terms)) for terms in fewer), key=lambda f: _value(data, f))
        if _value(data, top) <= value:
            break
        best, value = top, _value(data, top)
    return data, best


def _value(data: Ratios, found: Fit) -> float:
    """Log likelihood less what shapes and their numbers cost."""
    return found.gain - sum(_cost(data, t) + _NEW for t in found.terms)


def _cost(data: Ratios, term: Term) -> float:
    """Of a shape's numbers, nats; a common source's phase is no number."""
    own = int(term.free.sum()) - (isinstance(term, Common) and term.turned)
    return _NUMBER * own + data.penalty * len(term.shared)


def _freed(data: Ratios, term: Term) -> Term:
    """With numbers for every sensor again: what another shape took over may be its own."""
    if isinstance(term, Common):
        return term
    if isinstance(term, Shift):
        return replace(term, free=Shift.start(data.ground).free & term.parts[:, None])
    least = term.local.amax(-1, keepdim=True) * _TOUCH
    return replace(term, free=torch.ones_like(term.free), local=torch.where(term.free, term.local, least))


def _pruned(data: Ratios, found: Fit) -> Fit:
    """Without numbers of single sensors that do not differ from none, as far as it pays."""
    best = found
    for threshold in (1.0, 2.0, _least_t(data.n_sensors)):
        terms: list[Term] = []
        changed = False
        for i, term in enumerate(found.terms):
            if isinstance(term, Common):
                terms.append(term)
                continue
            t = torch.where(term.free, (term.local / found.sd_given_shared(i)).abs().nan_to_num(nan=0.0), 0.0)
            keep = term.free & ((t >= threshold) | (t == t.max()))
            changed |= bool((keep != term.free).any())
            terms.append(replace(term, free=keep, local=torch.where(keep, term.local, 0.0)))
        if changed:
            found = fit(data, terms)
            best = max(best, found, key=lambda f: _value(data, f))
    return best


def _varied(data: Ratios, found: Fit) -> Fit:
    """With the last shape's forms tried as well, if it is a common source."""
    *others, last = found.terms
    if type(last) is not Common:
        return found
    forms = [[*others, form] for form in last.variants() if (form.turned, form.inside) != (last.turned, last.inside)]
    # A part is no more than the whole.
    possible = [form for form in forms if bool(log_score(data, data_model(data, form)).isfinite().all())]
    return max([found, *(fit(data, form) for form in possible)], key=lambda f: _value(data, f))


def _least_t(n_sensors: int) -> float:
    return float(stats.norm.isf(0.005 / n_sensors))


def _convincing(data: Ratios, found: Fit) -> bool:
    """Whether what is left is no more than chance, or little of what there was."""
    p = data.n_sensors
    wide = data.worth >= 2 * p
    single = data.observed.diagonal(dim1=-2, dim2=-1).real
    fitted = found.model.diagonal(dim1=-2, dim2=-1).real
    w = data.worth[:, None]
    before = (w * (single - 1 - single.log()))[wide].sum()
    ratio = single / fitted
    left = float((w * (ratio - 1 - ratio.log()))[wide].sum())
    freedom = p * int(wide.sum())
    excess = left - freedom / 2
    return excess < _SMALL * (float(before) - freedom / 2) or float(stats.chi2.sf(2 * left, freedom)) > _DOUBT


def _candidates(data: Ratios, company: list[Term]) -> Iterator[Term]:
    """Shapes to add to some, with numbers to start from."""
    names = {t.name for t in company}
    ground = data.ground

    def score(terms: list[Term]) -> float:
        return float(log_score(data, data_model(data, terms)).sum())

    model = data_model(data, company)
    if "parameter_shift" not in names and bool(ground.matters.any()):
        yield from Shift.starts(ground)
        if bool(ground.matters[1].any()):
            yield max(Shift.moved(ground), key=lambda s: score([*company, s]))
    if "low_pass" not in names:
        filters = [s for kind in FILTERS for s in LowPass.starts(ground, kind)]
        best: dict[str, LowPass] = {}
        for start in sorted(filters, key=lambda s: -score([*company, s])):
            best.setdefault(start.kind, start)
        yield from list(best.values())[:_FORMS]
    if "flicker" not in names:
        yield Flicker.start(ground)
    excess = data.observed - model
    bump = _bump(data, model)
    if bump is not None:
        yield bump
        if data.n_sensors > 1:
            yield from CommonBump.starts(ground, excess, data.worth, "oscillation", bump.shared)
    if data.n_sensors > 1:
        nothing = torch.zeros(0, dtype=torch.float64)
        for kind in ("white", "walk"):
            yield from Common.starts(ground, excess, data.worth, kind, nothing)
        n = ground.bands.n_samples
        corners = torch.logspace(
            math.log10(_CORNER_BINS[0] / n), math.log10(_CORNER_BINS[1]), 8, dtype=torch.float64
        ).log()
        starts_at = [Common.starts(ground, excess, data.worth, "ar1", c[None]) for c in corners]
        yield from max(starts_at, key=lambda s: score([*company, s[0]]))


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


def _bump(data: Ratios, model: Tensor) -> Bump | None:
    """The bump that what is left is most like, of centres at the bands and widths up to a third of them."""
    bands = data.ground.bands
    centres = bands.frequency[bands.frequency * bands.n_samples > 16].tolist()
    starts = ((centre, share * centre) for centre in centres for share in _WIDTHS)
    return bump_start(data, model, starts, torch.ones(data.n_sensors, dtype=torch.bool))
