"""Which spectral terms explain a recording, and in which sensors: joint selection by evidence.

Every class of physics competes by its whole family of forms and starts. It wins by evidence, the log likelihood of the
fit less what its numbers could have been before (Laplace), and not by how well it fits: a form that the catalogue only
approximates is still the nearest physics.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.components import (
    Common,
    CommonBump,
    Flicker,
    LowPass,
    Peak,
    Shift,
    Term,
    oscillation,
)
from gyrofuse.mismatch.likelihoods.filter_forms import FILTERS
from gyrofuse.mismatch.likelihoods.spectral import (
    Fit,
    Ratios,
    data_model,
    fit,
    log_gain,
    pieces,
    power_gains,
    prior_cost,
)
from gyrofuse.mismatch.stats.inclusion import included_sensors

FITS = 1e-3  # p value of what is left, from which a model counts as one that fits
_MOST = 4  # terms at once
_QUICK, _KEPT = 8, 4  # rounds of a first look; classes looked at closely
_NEW = 8.0  # nats of evidence that one more term has to bring
_PART = 4.0  # nats for each further part of the noise whose numbers are others
_NUMBER = 2.0  # nats for a number of a sensor: those of sensors that have it are alike
_SHARED = 5.0  # nats that correlations gain by what is said to be common, beyond chance
_IN_COMMON = 0.3  # of the largest share of a second sensor's power, for a band to show a source
_FEW = 0.2  # least factor of Bartlett's
_SEEN = 2.5  # standard deviations of a gain
_FORMS = 3  # of a filter, that are fitted
_BEHIND = 0.02  # of what the best term gains in a sensor, by which others may be behind
_HARDLY = 2.5  # number of a filter that changes the power at 0.45 of the rate by a third
_CLOSER, _BESIDE = 3, 4  # times that a corner is looked for more closely, and places on either side
_SAME = 0.05  # log power: below it a term leaves a band as it was
_MENDED = 0.05  # share of what terms explain that one more on their sensors has to add, where they overlap
_OWN = 0.02  # of a sensor's power in any band, beside what is common
_WIDTHS = (0.06, 0.15, 0.35)  # half width of a bump over its centre
_HEIGHTS = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0)  # of a bump over the noise at its centre
_LOWEST = 16  # cycles per record: bumps below are colour
_CORNERS = 8  # of common AR1s to start from


class Choice(NamedTuple):
    """Terms that were chosen.

    Attributes:
        best: Their joint fit; None where no term pays.
        mended: Whether a further term would pay that only mends the form of these.
    """

    best: Fit | None
    mended: bool


def best_terms(data: Ratios, *, differ: bool) -> Choice:
    """The terms of most evidence, one at least of what does differ, each in the sensors that take part."""
    best: Fit | None = None
    value, mended = -math.inf if differ else 0.0, False
    for _ in range(_MOST):
        now = list(best.terms) if best else []
        tried = [_varied(data, _pruned(data, f)) for f in _likeliest(data, now)]
        tried = [f for f in tried if evidence(data, f) > value]
        earned = [f for f in tried if best is None or _earned(data, best, f, f.terms[-1])]
        mended = len(earned) < len(tried)
        if not earned:
            break
        best = max(earned, key=lambda f: evidence(data, f))
        value = max(evidence(data, best), 0.0)
    while best is not None and len(best.terms) > 1:
        fewer = []
        for gone in best.terms:
            rest = _pruned(data, fit(data, [_freed(data, t) for t in best.terms if t is not gone]))
            # Of terms that stand for another one's form together, the one that was found first may be one too many.
            mends = evidence(data, rest) <= value and not _earned(data, rest, best, gone)
            if mends or evidence(data, rest) > value:
                fewer.append((rest, mends))
        if not fewer:
            break
        best, mends = max(fewer, key=lambda entry: evidence(data, entry[0]))
        value, mended = evidence(data, best), mended or mends
    if best is not None and data.n_sensors > 1:
        for i, term in enumerate(best.terms):
            if not isinstance(term, Common):
                best = _of_partakers(data, best, i)
    return Choice(best, mended)


def evidence(data: Ratios, found: Fit) -> float:
    """Log likelihood less what terms, their numbers' prior widths (Laplace) and their sensors cost, nats."""
    return found.gain - prior_cost(found.terms) - _width(found) - sum(_cost(data, t) for t in found.terms)


def _width(found: Fit) -> float:
    """`log det(1 + S I S) / 2`, `I` the information and `S` the standard deviations of the priors."""
    scales = []
    for term, places in zip(found.terms, found.places, strict=True):
        own = torch.cat([(term.local_sd * term.unit()).flatten(), torch.full_like(term.shared, term.shared_sd)])
        scales.append(own[places >= 0])
    scale = torch.cat(scales)
    matrix = torch.eye(len(scale), dtype=scale.dtype) + scale[:, None] * found.information * scale
    return float(torch.linalg.slogdet(matrix)[1]) / 2


def _cost(data: Ratios, term: Term) -> float:
    """What is paid for a term beside its numbers: that it is one more, its form, and the choice of its sensors."""
    p, k = data.n_sensors, int(term.free.any(0).sum())
    cost = _NEW
    if isinstance(term, Shift):
        white, ar1, corner, walk = term.free.any(-1)
        cost += _PART * (int(white) + int(ar1 | corner) + int(walk) - 1)
    if isinstance(term, LowPass):
        cost += math.log(len(FILTERS))
    if isinstance(term, Common) and term.kind == "ar1":  # one that is too slow to show its corner is a walk
        cost += math.log(_CORNERS)
    if not isinstance(term, Common):
        cost += math.log(p) + math.lgamma(p + 1) - math.lgamma(k + 1) - math.lgamma(p - k + 1)
    return cost


def cost_of(found: Fit) -> float:
    """Of a fit's numbers alone, nats."""
    return _width(found) + prior_cost(found.terms)


def candidates(data: Ratios, company: Sequence[Term]) -> Iterator[Term]:
    """Terms to add to some, the best start of each in every sensor."""
    names = {t.name for t in company}
    ground = data.ground
    if "parameter_shift" not in names and bool(ground.matters.any()):
        starts = [best_start(data, company, family)[0] for family in Shift.starts(ground)]
        yield from starts
        # Two parts together, each from where it starts alone: from all at once the one may stay in the other's place.
        for one, other in itertools.combinations(starts, 2):
            if not bool((one.free & other.free).any()):
                yield replace(one, local=one.local + other.local, free=one.free | other.free)
    if "low_pass" not in names:
        yield from filter_starts(data, company)[:_FORMS]
    if "flicker" not in names:
        yield best_start(data, company, Flicker.starts(ground))[0]
    model = data_model(data, company)
    excess = data.observed - model
    peak = best_bump(data, company, _bump_places(data))
    if peak is not None:
        yield peak
    if data.n_sensors > 1:
        nothing = torch.zeros(0, dtype=torch.float64)
        if peak is not None:
            yield from CommonBump.starts(ground, excess, data.worth, "oscillation", peak.shared)
        for kind in ("white", "walk"):
            yield from Common.starts(ground, excess, data.worth, kind, nothing)
        f = ground.bands.frequency
        corners = torch.logspace(math.log10(8 * float(f[0])), math.log10(0.3), _CORNERS, dtype=torch.float64).log()
        starts_at = [Common.starts(ground, excess, data.worth, "ar1", c[None]) for c in corners]
        yield from max(starts_at, key=lambda s: float(log_gain(data, data_model(data, [*company, s[0]])).sum()))


def filter_starts(data: Ratios, company: Sequence[Term]) -> list[LowPass]:
    """Every form of a filter at its likeliest corners, the likeliest first.

    Corners are found closely, each sensor's by itself: of strong filters a coarse one would decide between the forms.
    """
    found: list[tuple[LowPass, float]] = []
    for kind in FILTERS:
        family = LowPass.starts(data.ground, kind)
        step = float(family.local[:2, 0, 0].diff())
        start, gain = best_start(data, company, family)
        for _ in range(_CLOSER):
            beside = torch.linspace(-step, step, 2 * _BESIDE + 1, dtype=torch.float64)[:, None, None]
            start, gain = best_start(data, company, replace(family, local=start.local + beside))
            step /= _BESIDE
        assert isinstance(start, LowPass)
        found.append((start, gain))
    return [start for start, _ in sorted(found, key=lambda entry: -entry[1])]


def best_start(data: Ratios, company: Sequence[Term], family: Term) -> tuple[Term, float]:
    """Of starts `local` `(start, number, sensor)` the likeliest in each sensor beside others, and its gain, nats."""
    ground = data.ground
    factor, added, filters, common = pieces(data, company)
    passed, mean_of = common.diagonal(dim1=-2, dim2=-1).real, ground.bands.mean_of
    values = family.values(ground, family.local, family.shared)  # (start, sensor, place)
    if family.acts == "scale":
        powers = (factor * values * ground.density + added) * filters
    elif family.acts == "add":
        powers = (factor * ground.density + added + values) * filters
    else:
        powers = (factor * ground.density + added) * filters * values
    shared = passed * mean_of(filters).mT
    if family.acts == "filter":
        shared = shared * mean_of(values).mT
    gains = power_gains(data, (mean_of(powers) / ground.mean).mT + shared).sum(-2)  # (start, sensor)
    best = gains.argmax(0)
    local = family.local.gather(0, best[None, None].expand(1, *family.local.shape[1:]))[0]
    return replace(family, local=local), float(gains.amax(0).clamp(min=0).sum())


def best_bump(data: Ratios, company: Sequence[Term], places: Tensor) -> Peak | None:
    """The bump that what others leave is most like; None where nothing is left.

    Args:
        data: What is to be explained.
        company: The other terms.
        places: Centres and half widths `(place, 2)`, cycles per sample.
    """
    ground = data.ground
    _, _, filters, _ = pieces(data, company)
    before = data_model(data, company).diagonal(dim1=-2, dim2=-1).real  # (band, sensor)
    centre, width = places[:, 0, None], places[:, 1, None]
    profile = oscillation(ground.places, centre, width)  # (place of a bump, place)
    shown = ground.bands.mean_of(profile[:, None] * filters) / ground.mean  # (place, sensor, band)
    at = (shown / before.mT).amax(-1)  # highest over what there is, of variance one, (place, sensor)
    size = torch.tensor(_HEIGHTS, dtype=torch.float64)[:, None, None] / at.clamp(min=1e-300)
    powers = before + (size[..., None] * shown).transpose(-1, -2)
    gains = power_gains(data, powers).sum(-2) - power_gains(data, before).sum(-2)  # (height, place, sensor)
    height = gains.argmax(0)  # (place, sensor)
    own = gains.gather(0, height[None])[0]
    chosen = int(own.clamp(min=0).sum(-1).argmax())
    if not bool((own[chosen] > 0).any()):
        return None
    variance = size.gather(0, height[None])[0, chosen]
    least = torch.tensor(_HEIGHTS[0], dtype=torch.float64) / at[chosen]
    at_centre, half_width = places[chosen].tolist()
    return Peak.start(at_centre, half_width, torch.where(own[chosen] > 0, variance, least))


def _bump_places(data: Ratios) -> Tensor:
    """Centres at the bands and widths up to a third of them; both sides of a bump are to be seen."""
    f = data.ground.bands.frequency
    lowest = _LOWEST * 2 * float(f[0])
    places = torch.tensor([(c, w * c) for c in f.tolist() if c > lowest for w in _WIDTHS], dtype=torch.float64)
    return places[places[:, 0] + places[:, 1] < 0.5]


def _likeliest(data: Ratios, company: list[Term]) -> list[Fit]:
    """One term more, of all classes: the fits of most evidence after a first look, followed to their end."""
    quick = [fit(data, [*company, c], _QUICK) for c in candidates(data, company)]
    before = data_model(data, company)
    quick = [f for f in quick if math.isfinite(f.gain) and _coherent(data, before, f)]
    quick = _where_they_lead(data, before, quick)
    kept = {
        *sorted(quick, key=lambda f: -evidence(data, f))[:_KEPT],
        *sorted(quick, key=lambda f: -f.gain)[:1],
    }
    return [_given_over(data, fit(data, f.terms)) for f in kept]


def _where_they_lead(data: Ratios, before: Tensor, tried: list[Fit]) -> list[Fit]:
    """Fits with one term more, each in the sensors that no other term explains much better.

    Sensors may lack different physics: what is right in one would stand for something else in the next.
    """
    nothing = power_gains(data, before.diagonal(dim1=-2, dim2=-1).real).sum(0)
    own = [f for f in tried if not isinstance(f.terms[-1], Common)]
    gains = [power_gains(data, f.power).sum(0) - nothing - _NUMBER * f.terms[-1].free.sum(0) for f in own]
    if not gains:
        return tried
    top = torch.stack(gains).amax(0)
    behind = (_BEHIND * top).clamp(min=_NEW)
    found = [f for f in tried if isinstance(f.terms[-1], Common)]
    for f, gain in zip(own, gains, strict=True):
        term = f.terms[-1]
        has = term.free.any(0)
        leads = has & (gain >= top - behind)
        if bool((leads == has).all()):
            found.append(f)
        elif bool(leads.any()):
            found.append(fit(data, [*f.terms[:-1], term.only(term.free & leads)], _QUICK))
    return found


def _given_over(data: Ratios, found: Fit) -> Fit:
    """With the other terms taken off the sensors of the last one, where that has more evidence.

    What came first may have stood for it there, and both together stay near where they started from.
    """
    *others, last = found.terms
    if not others or isinstance(last, Common):
        return found
    mine = last.free.any(0) & (_shares(data, found)[-1] > _NUMBER * last.free.sum(0))
    fewer = [t if isinstance(t, Common) else t.only(t.free & ~mine) for t in others]
    if not bool(mine.any()) or not all(bool(t.free.any()) for t in fewer):
        return found
    start = best_start(data, fewer, LowPass.starts(data.ground, last.kind))[0] if isinstance(last, LowPass) else last
    tried = fit(data, [*fewer, start.only(last.free) if isinstance(last, LowPass) else last])
    return max(found, tried, key=lambda f: evidence(data, f))


def _coherent(data: Ratios, before: Tensor, after: Fit) -> bool:
    """Whether sensors share what a common source gives them: powers alone are had from noise of their own.

    Numbers of gains follow chance, by half a nat each where many ordinates have the source, by more in few of them
    (Bartlett's factor of independence, at most fivefold); twice that is asked for.
    """
    term = after.terms[-1]
    if not isinstance(term, Common):
        return True
    gained = after.gain - float((log_gain(data, before) + power_gains(data, after.power).sum(-1)).sum())
    gained += float(power_gains(data, before.diagonal(dim1=-2, dim2=-1).real).sum())
    source = data.ground.bands.mean_of(term.shape(data.ground, term.shared))  # (band,)
    share = term.local.square().sum(0) * source[:, None] / (data.ground.mean.mT * after.power)
    second = share.topk(2).values[:, -1]
    has = second > _IN_COMMON * second.max()
    few = (2 * data.n_sensors + 11) / (6 * float(data.d[has].sum()) + 1e-9)
    return gained > _SHARED + float(term.free[:, 1:].sum()) / max(1 - few, _FEW)


def _earned(data: Ratios, before: Fit, after: Fit, term: Term) -> bool:
    """Whether a term that was added is physics of its own, and does not mend the form of those that it stands beside.

    Where the form of a filter, or of noise on top, is one that the catalogue only approximates, whatever bends a
    spectrum mends it. What is left in bands that all of them leave as they were is no matter of their form; elsewhere a
    term has to add a share of what they explain. Other levels of what the simulation has keep its form.
    """
    if isinstance(term, Common):  # which correlations tell
        return True
    formed = [t.free.any(0) for t in before.terms if not isinstance(t, Shift)]
    touched = torch.stack([torch.zeros_like(term.free[0]), *formed]).any(0) & term.free.any(0)
    if not bool(touched.any()):
        return True
    gained = power_gains(data, after.power) - power_gains(data, before.power)
    apart = (before.power.log().abs() < _SAME) | ~touched
    return float((gained * apart).sum()) > _NEW or after.gain - before.gain > _MENDED * before.gain


def _of_partakers(data: Ratios, found: Fit, i: int) -> Fit:
    """With one of the terms in the sensors that have about as much of it as others, and in no other."""

    def with_term(fitted: Fit, term: Term) -> list[Term]:
        return [*fitted.terms[:i], term, *fitted.terms[i + 1 :]]

    term = found.terms[i]
    whole = fit(data, with_term(found, _freed(data, term)))
    every = whole.terms[i]
    statistic = torch.full((data.n_sensors,), -1.0, dtype=torch.float64)
    for sensor in every.free.any(0).nonzero()[:, 0].tolist():
        others = torch.arange(data.n_sensors) != sensor
        without = fit(data, with_term(whole, every.only(every.free & others)), _QUICK)
        statistic[sensor] = 2 * max(whole.gain - without.gain, 0.0)
    if not bool((statistic > 0).any()):
        return found
    which = included_sensors(statistic, int(every.free.sum(0).max())).which
    # Those it was not seen in get all of its numbers.
    free = torch.where(term.free.any(0), term.free, every.free) & which
    if bool((free == term.free).all()):
        return found
    return fit(data, with_term(found, replace(term, local=every.local).only(free)))


def _freed(data: Ratios, term: Term) -> Term:
    """With numbers for every sensor again: what another term took over may be its own."""
    if isinstance(term, Common):
        return term
    if isinstance(term, Shift):
        return replace(term, free=Shift.start(data.ground).free & term.parts[:, None])
    every = torch.ones_like(term.free)
    if isinstance(term, LowPass):  # from a filter that hardly shows
        return replace(term, free=every, local=torch.where(term.free, term.local, _HARDLY))
    least = term.local.amax(-1, keepdim=True) / 10
    return replace(term, free=every, local=torch.where(term.free, term.local, least))


def _pruned(data: Ratios, found: Fit) -> Fit:
    """Without the numbers of sensors, and then without single ones, that gain less than they cost."""
    best = found
    while True:
        shares = _shares(data, best)
        options = []
        for i, share in enumerate(shares):
            term = best.terms[i]
            has = term.free.any(0)
            if isinstance(term, Common) or int(has.sum()) < 2:
                continue
            weak = has & (share < _NUMBER * term.free.sum(0)) & (share < share[has].max())
            if bool(weak.any()):
                options.append((i, term.only(term.free & ~weak)))
        if not options:
            break
        changed = dict(options)
        fewer = fit(data, [changed.get(i, t) for i, t in enumerate(best.terms)])
        if evidence(data, fewer) <= evidence(data, best):
            break
        best = fewer
    for i, term in enumerate(best.terms):
        if not isinstance(term, Shift):
            continue
        t = (term.local / best.sd(i)[0]).abs().nan_to_num(nan=0.0)
        for least in (1.0, 2.0, 3.0):
            keep = term.free & ((t >= least) | (t == t.max()))
            if bool((keep != term.free).any()):
                fewer = fit(data, [*best.terms[:i], term.only(keep), *best.terms[i + 1 :]])
                best = max(best, fewer, key=lambda f: evidence(data, f))
        break
    return best


def _shares(data: Ratios, found: Fit) -> list[Tensor]:
    """What each term gains in each sensor, the others as they are, `(sensor,)`, nats."""
    whole = power_gains(data, found.power).sum(0)
    shares = []
    for i in range(len(found.terms)):
        rest = [t for j, t in enumerate(found.terms) if j != i]
        shares.append(whole - power_gains(data, data_model(data, rest).diagonal(dim1=-2, dim2=-1).real).sum(0))
    return shares


def _varied(data: Ratios, found: Fit) -> Fit:
    """With the last term's forms tried as well, if it is a common source."""
    *others, last = found.terms
    if type(last) is not Common:
        return found
    told = last.told(found.sd_alone(-1))
    seen = (told >= _SEEN) | (told >= told.topk(2).values[-1])
    every = last.variants(data.ground, seen)
    other = [form for form in every if (form.turned, form.inside) != (last.turned, last.inside)]
    forms = [[*others, form] for form in other]
    # A part is no more than the whole.
    possible = [form for form in forms if bool(log_gain(data, data_model(data, form)).isfinite().all())]
    fits = [found, *(f for form in possible if keeps_own(f := fit(data, form)))]
    return max(fits, key=lambda f: evidence(data, f))


def keeps_own(found: Fit) -> bool:
    """Whether sensors keep something of their own: a few ordinates lie in a plane, where a likelihood has no bound."""
    size = found.power.rsqrt()
    correlation = found.model * (size[:, :, None] * size[:, None, :])
    return float(torch.linalg.eigvalsh(correlation)[:, 0].min()) > _OWN
