"""Criteria of all candidates for many records, and the choice."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.results import counted
from gyrofuse.fitting.ranking import candidates as structures
from gyrofuse.fitting.ranking.candidates import Key, Kinds
from gyrofuse.fitting.ranking.moments import Moments
from gyrofuse.fitting.ranking.search import EQUIVALENT, MomentSearch, SpectralSearch
from gyrofuse.fitting.ranking.spectra import Lines, decide_lines
from gyrofuse.noise.processes import Drift, Sinusoid
from gyrofuse.wavelets.covariance import wavelet_variance
from gyrofuse.wavelets.intervals import chi_square_tail


@dataclass(frozen=True, eq=False)
class Entry:
    """Fit of a candidate to some of the records.

    Attributes:
        kinds: Its processes.
        items: Indices of the records, `(item,)`.
        criterion: Criterion, `(item,)`, less is better.
        wvic: Wavelet variance information criterion, `(item,)`.
        p_value: P value of the J test at the parameters of greatest likelihood, `(item,)`.
        simpler: ModelStructure with fewer parameters that the fit amounts to, and why; None where there is none.
        fitted: Fitted variances of bins or levels, `(item, bin)`.
    """

    kinds: Kinds
    items: Tensor
    criterion: Tensor
    wvic: Tensor
    p_value: Tensor
    simpler: list[tuple[Kinds, str] | None]
    fitted: Tensor


@dataclass(frozen=True, eq=False)
class Table:
    """Candidates against records.

    Attributes:
        kinds: Processes of the candidates.
        criterion: Criterion, `(item, candidate)`; NaN where a candidate has another number of sinusoids.
        wvic: Wavelet variance information criterion, the same.
        p_value: P value of the J test, the same.
        reasons: Reason why a candidate is redundant, or was not compared, `[item][candidate]`.
        redundant: Whether a candidate is redundant, `(item, candidate)`.
        equivalent: Whether a candidate is equivalent to the chosen one, and not it, `(item, candidate)`.
        choice: Index of the chosen candidate, `(item,)`.
        wvic_choice: Index of the candidate with the smallest WVIC, `(item,)`.
        n_sinusoids: Number of sinusoids subtracted, `(item,)`; None where none were searched.
        n_lines: Number of significant spectral lines, at most one more than candidates have sinusoids, the same.
    """

    kinds: list[Kinds]
    criterion: Tensor
    wvic: Tensor
    p_value: Tensor
    reasons: list[list[str | None]]
    redundant: Tensor
    equivalent: Tensor
    choice: Tensor
    wvic_choice: Tensor
    n_sinusoids: Tensor | None
    n_lines: Tensor | None


def by_spectrum(
    series: Tensor, wanted: list[Kinds] | None, levels: int, max_sinusoids: int, line_alpha: float
) -> Table:
    """Rank candidates by the spectral likelihood.

    Args:
        series: Records `(item, time)`.
        wanted: Processes of the candidates; None for all.
        levels: Number of levels J of the wavelet variance.
        max_sinusoids: Largest number of sinusoids, where all candidates are tried.
        line_alpha: Probability that noise alone shows a spectral line.
    """
    n_samples = series.shape[-1]
    if wanted is None:
        # A level is left for a noise.
        noises, allowed = structures.all_noises(levels), list(range(min(max_sinusoids, levels - 1) + 1))
    else:
        noises = [_without_sinusoids(kinds) for kinds in wanted]
        allowed = sorted({_n_sinusoids(kinds) for kinds in wanted})
    ramp = any(kind.deterministic for kinds in noises for kind in kinds)
    lines = decide_lines(series, allowed, line_alpha, ramp)
    moments = Moments(wavelet_variance(lines.rest, levels).mT.to(torch.float64), n_samples)
    searching = wanted is None
    if wanted is None:
        wanted = [[*kinds, *[Sinusoid] * n] for n in lines.n_sinusoids.unique().tolist() for kinds in noises]
    search = SpectralSearch(lines.spectra)
    search.run(noises, searching)
    entries: dict[Key, Entry] = {}
    for key, kinds in {structures.key_of(k): k for k in noises}.items():
        if key not in search.fits:
            continue
        structure, items, fit = search.found(key)
        spectra = lines.spectra.part(items)
        own = moments.part(items).near(structure, fit.linear, fit.shape)
        there = moments.part(items).against(structure, fit.linear, fit.shape, *spectra.covariance(structure, fit))
        estimates = there.estimates
        entries[key] = Entry(
            kinds=kinds,
            items=items,
            criterion=search.criterion(key)[items],
            wvic=own.objective + 2 * own.active,
            p_value=there.p_value,
            simpler=structures.simplified(structure, estimates.params, estimates.covariance, n_samples),
            fitted=spectra.variances(structure, fit),
        )
    placed = []
    for kinds in wanted:
        tones: Kinds = [Sinusoid] * _n_sinusoids(kinds)
        entry = entries.get(structures.key_of(_without_sinusoids(kinds)))
        if entry is not None:
            which = (lines.n_sinusoids[entry.items] == len(tones)).nonzero()[:, 0]
            if len(which) or not searching:
                simpler = [s and ([*s[0], *tones], s[1]) for s in entry.simpler]
                fits_in = structures.n_unknown(kinds, held=True) <= levels
                placed.append(_part(entry, kinds, which if fits_in else which[:0], simpler))
    table = _tabulated(placed, lines.spectra.bins.count, len(series), lines)
    _set_aside(table, lines, None if searching else max(allowed), levels)
    return table


def _set_aside(table: Table, lines: Lines, most: int | None, levels: int) -> None:
    """Say why candidates were not compared: those for other sinusoids, at most so many, where any were given."""
    for own, n_sinusoids, n_found in zip(
        table.reasons, lines.n_sinusoids.tolist(), lines.n_found.tolist(), strict=True
    ):
        for c, kinds in enumerate(table.kinds):
            n, size = _n_sinusoids(kinds), structures.n_unknown(kinds, held=True)
            if n == n_sinusoids and size > levels:
                own[c] = f"{size} parameters, but {counted(levels, 'level')}"
            elif n != n_sinusoids and most is not None:
                found = ("at least " if n_found > most else "") + counted(n_found, "line")
                own[c] = f"the spectrum has {found}, the model {n or 'none'}"


def by_moments(variance: Tensor, wanted: list[Kinds] | None, n_samples: int) -> Table:
    """Rank candidates by the likelihood of wavelet variances.

    Args:
        variance: Wavelet variances `(item, level)`.
        wanted: Processes of the candidates; None for all.
        n_samples: Length of the records.
    """
    n_items, levels = variance.shape
    moments = Moments(variance, n_samples)
    search = MomentSearch(moments)
    noises = structures.all_noises(levels) if wanted is None else wanted
    search.run(noises, wanted is None)
    entries = []
    for kinds in noises:
        key = structures.key_of(kinds)
        if key not in search.fits:
            continue
        structure, items, fit = search.found(key)
        estimates = moments.part(items).estimates(structure, fit)
        entries.append(
            Entry(
                kinds=kinds,
                items=items,
                criterion=search.criterion(key)[items],
                wvic=fit.objective + 2 * fit.active,
                p_value=chi_square_tail(fit.objective, levels - fit.active),
                simpler=structures.simplified(structure, estimates.params, estimates.covariance, n_samples),
                fitted=structure.wavelet_variance(moments.tau, fit.linear, fit.shape),
            )
        )
    return _tabulated(entries, moments.observations, n_items, None)


def _part(entry: Entry, kinds: Kinds, items: Tensor, simpler: list[tuple[Kinds, str] | None]) -> Entry:
    return Entry(
        kinds,
        entry.items[items],
        entry.criterion[items],
        entry.wvic[items],
        entry.p_value[items],
        [simpler[i] for i in items.tolist()],
        entry.fitted[items],
    )


def _tabulated(entries: list[Entry], count: Tensor, n_items: int, lines: Lines | None) -> Table:
    empty = entries[0].criterion.new_full((n_items, len(entries)), torch.nan)
    criterion, wvic, p_value = empty.clone(), empty.clone(), empty.clone()
    for c, entry in enumerate(entries):
        for whole, own in ((criterion, entry.criterion), (wvic, entry.wvic), (p_value, entry.p_value)):
            whole[entry.items, c] = own
    place = {structures.key_of(entry.kinds): c for c, entry in enumerate(entries)}
    redundant = torch.zeros(n_items, len(entries), dtype=torch.bool, device=empty.device)
    reasons: list[list[str | None]] = [[None] * len(entries) for _ in range(n_items)]
    for c, entry in enumerate(entries):
        for i, simpler in zip(entry.items.tolist(), entry.simpler, strict=True):
            other = place.get(structures.key_of(simpler[0])) if simpler else None
            if simpler and other is not None and bool(criterion[i, other] <= criterion[i, c] + EQUIVALENT):
                redundant[i, c], reasons[i][c] = True, simpler[1]
    choice = criterion.masked_fill(redundant, torch.inf).nan_to_num(nan=torch.inf).argmin(-1)
    equivalent = _equivalent(entries, criterion, redundant, choice, count)
    sizes = torch.tensor([float(len(entry.kinds)) for entry in entries]).to(wvic)
    # A process without variance does not change WVIC: a thousandth a process chooses the smallest.
    wvic_choice = (wvic + 1e-3 * sizes).nan_to_num(nan=torch.inf).argmin(-1)
    kinds = [entry.kinds for entry in entries]
    found = (None, None) if lines is None else (lines.n_sinusoids, lines.n_found)
    return Table(kinds, criterion, wvic, p_value, reasons, redundant, equivalent, choice, wvic_choice, *found)


def _equivalent(entries: list[Entry], criterion: Tensor, redundant: Tensor, choice: Tensor, count: Tensor) -> Tensor:
    """Whether a candidate has a criterion as good as the best, or its spectrum by other processes."""
    best = criterion.gather(-1, choice[:, None])
    near = (criterion <= best + EQUIVALENT) & ~redundant
    same = torch.zeros_like(near)
    for b in choice.unique().tolist():
        which = choice == b
        chosen = entries[b]
        spectrum = chosen.fitted.new_full((len(choice), chosen.fitted.shape[-1]), torch.nan)
        spectrum[chosen.items] = chosen.fitted
        for c, entry in enumerate(entries):
            if (Drift in entry.kinds) != (Drift in chosen.kinds) or len(entry.kinds) > len(chosen.kinds):
                continue  # a ramp shows in no spectrum; any other has that of a larger one
            ratio = entry.fitted / spectrum[entry.items]
            # Kullback-Leibler divergence: the mean log-likelihood ratio of the two spectra, in nats.
            apart = (count / 2 * (ratio - 1 - ratio.log())).sum(-1)
            same[entry.items, c] |= which[entry.items] & (apart < 0.5)
    found = near | same
    return found.scatter(-1, choice[:, None], False)


def _n_sinusoids(kinds: Kinds) -> int:
    return kinds.count(Sinusoid)


def _without_sinusoids(kinds: Kinds) -> Kinds:
    return [kind for kind in kinds if kind is not Sinusoid]
