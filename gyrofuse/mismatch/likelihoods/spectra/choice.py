"""Which spectral terms explain a recording, and in which sensors: joint selection by evidence.

Every class of physics competes by its whole family of forms and starts. It wins by evidence, the log likelihood of the
fit less what its numbers could have been before (Laplace), and not by how well it fits: a form that the catalogue only
approximates is still the nearest physics.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD, NATS_PER_NUMBER, NEW_TERM_NATS
from gyrofuse.mismatch.likelihoods.spectra.common_sources import Common
from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.fit import Fit, data_model, fit, pieces, powers, prior_cost
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios, correlations, log_gain, power_gains
from gyrofuse.mismatch.likelihoods.spectra.starts import best_start, candidates, levels
from gyrofuse.mismatch.stats.inclusion import included_sensors

SURE_GAIN = 2.5  # standard deviations from zero of a sensor's gain that it surely has: 1 % by chance
_QUICK = 8  # rounds of a fit that only ranks starts: those that matter are followed to their end


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
    most_terms = 4
    for _ in range(most_terms):
        now = list(best.terms) if best else []
        likeliest = _likeliest(data, now)
        if differ and all(term.acts == "add" for term in now):
            likeliest += _levels_beside(data, now)
        tried = [_varied(data, _pruned(data, f)) for f in likeliest]
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
            rest = _pruned(data, fit(data, [t.everywhere(data.ground) for t in best.terms if t is not gone]))
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
            if not term.coherent:
                best = _in_included_sensors(data, best, i)
    return Choice(best, mended)


def evidence(data: Ratios, found: Fit) -> float:
    """Log likelihood less what terms, their numbers' prior widths (Laplace), forms and sensors cost, nats."""
    return found.gain - cost_of(found) - sum(NEW_TERM_NATS + t.form_cost(data.n_sensors) for t in found.terms)


def cost_of(found: Fit) -> float:
    """Cost of a fit's numbers alone, nats.

    That of their priors, and Laplace's `log det(1 + S I S) / 2`, `I` the information and `S` the standard deviations of
    the priors.
    """
    scales = []
    for term, rows in zip(found.terms, found.rows, strict=True):
        own = torch.cat([(term.local_sd * term.unit()).flatten(), torch.full_like(term.shared, term.shared_sd)])
        scales.append(own[rows >= 0])
    scale = torch.cat(scales)
    matrix = torch.eye(len(scale), dtype=scale.dtype) + scale[:, None] * found.information * scale
    return float(torch.linalg.slogdet(matrix)[1]) / 2 + prior_cost(found.terms)


def _likeliest(data: Ratios, company: list[Term]) -> list[Fit]:
    """One term more, of all classes: the fits of most evidence after a few rounds, followed to their end."""
    n_kept = 4  # by evidence, and the one of the largest gain
    quick = [fit(data, [*company, c], _QUICK) for c in candidates(data, company)]
    before = data_model(data, company)
    quick = [f for f in quick if math.isfinite(f.gain) and _coherent(data, before, f)]
    quick = _where_they_lead(data, before, quick)
    kept = {
        *sorted(quick, key=lambda f: -evidence(data, f))[:n_kept],
        *sorted(quick, key=lambda f: -f.gain)[:1],
    }
    return [_given_over(data, fit(data, f.terms)) for f in kept]


def _levels_beside(data: Ratios, company: list[Term]) -> list[Fit]:
    """Other levels and a filter, or noise on top at high frequencies, at once: one by one, an AR1 would stand for both.

    What a filter passes shows the level: below some frequency, one of a few that its corner may be above.
    """
    frequency, starts, n_fitted = data.ground.bands.frequency, list[list[Term]](), 8
    for below in (0.02, 0.05, 0.12):
        passed = (frequency > below / 4) & (frequency < below)
        for start in levels(data, passed) if bool(passed.any()) else ():
            terms = [*company, start]
            starts += [[*terms, filtered] for filtered in candidates(data, terms, beside_levels=True)]
    starts.sort(key=lambda terms: -float(power_gains(data, pieces(data, terms).power(data)).sum()))
    tried = [fit(data, terms, _QUICK) for terms in starts[:n_fitted]]
    likeliest = sorted((f for f in tried if math.isfinite(f.gain)), key=lambda f: -evidence(data, f))[:2]
    return [fit(data, f.terms) for f in likeliest]


def _where_they_lead(data: Ratios, before: Tensor, tried: list[Fit]) -> list[Fit]:
    """Fits with one term more, each in the sensors that no other term explains much better.

    Sensors may lack different physics: what is right in one would stand for something else in the next.
    """
    nothing = power_gains(data, powers(before)).sum(0)
    own = [f for f in tried if not f.terms[-1].coherent]
    gains = [power_gains(data, f.power).sum(0) - nothing - NATS_PER_NUMBER * f.terms[-1].free.sum(0) for f in own]
    if not gains:
        return tried
    top = torch.stack(gains).amax(0)
    behind = (0.02 * top).clamp(min=NEW_TERM_NATS)  # of strong effects also by two hundredths: forms are not exact
    found = [f for f in tried if f.terms[-1].coherent]
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
    if not others or last.coherent:
        return found
    mine = last.free.any(0) & (_shares(data, found)[-1] > NATS_PER_NUMBER * last.free.sum(0))
    fewer = [t if t.coherent else t.only(t.free & ~mine) for t in others]
    if not bool(mine.any()) or not all(bool(t.free.any()) for t in fewer):
        return found
    grid = last.grid(data.ground)
    start = last if grid is None else best_start(data, pieces(data, fewer), grid)[0].only(last.free)
    tried = fit(data, [*fewer, start])
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
    gained += float(power_gains(data, powers(before)).sum())
    source = data.ground.bands.mean_of(term.shape(data.ground, term.shared))  # (band,)
    share = term.variance * source[:, None] / (data.ground.whole.mT * after.power)
    second = share.topk(2).values[:, -1]
    has = second > 0.3 * second.max()  # bands that show the source in two sensors
    few = (2 * data.n_sensors + 11) / (6 * float(data.d[has].sum()) + 1e-9)
    return gained > NATS_AS_GOOD + float(term.free[:, 1:].sum()) / max(1 - few, 0.2)


def _earned(data: Ratios, before: Fit, after: Fit, term: Term) -> bool:
    """Whether a term that was added is physics of its own, and does not mend the form of those that it stands beside.

    Where the form of a filter, or of noise on top, is one that the catalogue only approximates, whatever bends a
    spectrum mends it. What is left in bands that all of them leave as they were is no matter of their form; elsewhere a
    term has to add a twentieth of what they explain. Other levels of what the simulation has keep its form.
    """
    unchanged = 0.05  # log power of a band
    if term.coherent:  # correlations show it
        return True
    formed = [t.free.any(0) for t in before.terms if t.acts != "scale"]
    touched = torch.stack([torch.zeros_like(term.free[0]), *formed]).any(0) & term.free.any(0)
    if not bool(touched.any()):
        return True
    gained = power_gains(data, after.power) - power_gains(data, before.power)
    apart = (before.power.log().abs() < unchanged) | ~touched
    return float((gained * apart).sum()) > NEW_TERM_NATS or after.gain - before.gain > before.gain / 20


def _in_included_sensors(data: Ratios, found: Fit, i: int) -> Fit:
    """With one of the terms in the sensors that have about as much of it as others, and in no other."""

    def with_term(fitted: Fit, term: Term) -> list[Term]:
        return [*fitted.terms[:i], term, *fitted.terms[i + 1 :]]

    term = found.terms[i]
    whole = fit(data, with_term(found, term.everywhere(data.ground)))
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


def _pruned(data: Ratios, found: Fit) -> Fit:
    """Without the numbers of sensors, and then without single ones, that gain less than they cost."""
    best = found
    while True:
        shares = _shares(data, best)
        options = []
        for i, share in enumerate(shares):
            term = best.terms[i]
            has = term.free.any(0)
            if term.coherent or int(has.sum()) < 2:
                continue
            weak = has & (share < NATS_PER_NUMBER * term.free.sum(0)) & (share < share[has].max())
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
        if not term.apart:
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
        shares.append(whole - power_gains(data, powers(data_model(data, rest))).sum(0))
    return shares


def _varied(data: Ratios, found: Fit) -> Fit:
    """With the last term's forms tried as well, if it is a common source."""
    *others, last = found.terms
    if not isinstance(last, Common):
        return found
    t = last.t_values(found.sd_alone(-1))
    seen = (t >= SURE_GAIN) | (t >= t.topk(2).values[-1])
    forms = [[*others, form] for form in last.variants(data.ground, seen)]
    # A part is no more than the whole.
    possible = [form for form in forms if bool(log_gain(data, data_model(data, form)).isfinite().all())]
    fits = [found, *(f for form in possible if keeps_own(f := fit(data, form)))]
    return max(fits, key=lambda f: evidence(data, f))


def keeps_own(found: Fit) -> bool:
    """Whether sensors keep a fiftieth of their own: a few ordinates lie in a plane, where a likelihood has no bound."""
    return float(torch.linalg.eigvalsh(correlations(found.model))[:, 0].min()) > 1 / 50
