"""Which spectral shapes explain ratios of spectra, and which sensors have them.

Shapes are added while BIC falls, then taken away, from all that may start; each is then given to the sensors that have
about as much of it as others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.filter_forms import FILTERS
from gyrofuse.mismatch.partakers import partakers
from gyrofuse.mismatch.shape_fit import Fit, Ratios, data_model, fit, log_score
from gyrofuse.mismatch.shape_scan import bump_start
from gyrofuse.mismatch.shape_terms import Bump, Common, CommonBump, Flicker, LowPass, Shift, Term

_MOST = 4  # shapes at once
_PASSES, _AGAIN = 3, 3.0  # looks for them, and factor on a power that calls for another one
QUICK, _KEPT = 6, 3  # rounds of a first look; shapes looked at closely
_DOUBT = 1e-3  # p value of what is left by shapes that may be named
_SMALL = 0.1  # share of what there was to explain that may be left all the same
_NEW = 8.0  # nats that a shape costs beside its numbers
_NUMBER = 2.0  # nats for a number of a sensor: those of sensors that have it are alike
_PART = 4.0  # nats for each further part of the noise whose numbers are others
_OWN = 0.02  # of a sensor's power in any band, beside what is common
_TOUCH = 0.1
_FORMS = 3  # of filters
_WIDTHS = (0.06, 0.15, 0.35)  # half width of a bump over its centre
_CORNER_BINS = (4.0, 0.3)  # corners of common AR1s to start from: bins, cycles per sample


def best_shapes(data: Ratios, *, differ: bool) -> tuple[Ratios, Fit | None]:
    """The shapes that BIC prefers, one at least of what does differ, each in the sensors that take part.

    Of powers that are far from those of the simulation the law of F at the latter makes too much or too little: shapes
    are looked for again at the powers that were found, until they stay about there.
    """
    best: Fit | None = None
    for _ in range(_PASSES):
        before = data.level
        data, best = _grown(data, differ=differ)
        if best is None or data.off(before) < _AGAIN:
            break
    if best is not None and data.n_sensors > 1:
        for i, term in enumerate(best.terms):
            if not isinstance(term, Common):
                best = _of_partakers(data, best, i)
    return data, best


def _grown(data: Ratios, *, differ: bool) -> tuple[Ratios, Fit | None]:
    """Shapes added one at a time while BIC falls, then taken away while it falls."""
    best: Fit | None = None
    value = -math.inf if differ else 0.0
    for _ in range(_MOST):
        now = list(best.terms) if best else []
        quick = [fit(data, [*now, c], QUICK) for c in candidates(data, now)]
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


def _of_partakers(data: Ratios, found: Fit, i: int) -> Fit:
    """With one of the shapes in the sensors that have about as much of it as others, and in no other."""

    def with_shape(fitted: Fit, term: Term) -> list[Term]:
        return [*fitted.terms[:i], term, *fitted.terms[i + 1 :]]

    term = found.terms[i]
    whole = fit(data, with_shape(found, _freed(data, term)))
    every = whole.terms[i]
    statistic = torch.full((data.n_sensors,), -1.0, dtype=torch.float64)
    for sensor in every.free.any(0).nonzero()[:, 0].tolist():
        others = torch.arange(data.n_sensors) != sensor
        without = fit(data, with_shape(whole, every.only(every.free & others)), QUICK)
        statistic[sensor] = 2 * max(whole.gain - without.gain, 0.0)
    if not bool((statistic > 0).any()):
        return found
    which = partakers(statistic, int(every.free.sum(0).max())).which
    # Those it was not seen in get all of its numbers.
    free = torch.where(term.free.any(0), term.free, every.free) & which
    if bool((free == term.free).all()):
        return found
    return fit(data, with_shape(found, replace(term, local=every.local).only(free)))


def _value(data: Ratios, found: Fit) -> float:
    """Log likelihood less what shapes, their numbers and kinds of numbers cost."""
    shifted = [t.free.any(-1) for t in found.terms if isinstance(t, Shift)]
    kinds = sum(int(white) + int(ar1 | corner) + int(walk) - 1 for white, ar1, corner, walk in shifted)
    return found.gain - sum(cost_of(data, t) + _NEW for t in found.terms) - _PART * kinds


def cost_of(data: Ratios, term: Term) -> float:
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
            terms.append(term.only(keep))
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
    fits = [found, *(f for form in possible if _regular(f := fit(data, form)))]
    return max(fits, key=lambda f: _value(data, f))


def _regular(found: Fit) -> bool:
    """Whether sensors keep something of their own: a few ordinates lie in a plane, where a likelihood has no bound."""
    size = found.model.diagonal(dim1=-2, dim2=-1).real.rsqrt()
    correlation = found.model * (size[:, :, None] * size[:, None, :])
    return float(torch.linalg.eigvalsh(correlation)[:, 0].min()) > _OWN


def _least_t(n_sensors: int) -> float:
    return float(stats.norm.isf(0.005 / n_sensors))


def convincing(data: Ratios, found: Fit) -> bool:
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


def candidates(data: Ratios, company: list[Term]) -> Iterator[Term]:
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


def _bump(data: Ratios, model: Tensor) -> Bump | None:
    """The bump that what is left is most like, of centres at the bands and widths up to a third of them."""
    bands = data.ground.bands
    centres = bands.frequency[bands.frequency * bands.n_samples > 16].tolist()
    starts = ((centre, share * centre) for centre in centres for share in _WIDTHS)
    return bump_start(data, model, starts, torch.ones(data.n_sensors, dtype=torch.bool))
