"""Which noise processes made a record: structures ranked by the likelihood of its spectrum."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse._base.checks import (
    check_confidence_level,
    check_n_levels,
    check_positive_integer,
    largest_level,
)
from gyrofuse._base.deprecation import renamed_arguments
from gyrofuse._base.results import numbered
from gyrofuse.fitting.gmwm import fit_gmwm, fit_gmwm_moments
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.moments.records import check_wavelet_variance, deprecate_moments
from gyrofuse.fitting.ranking import candidates as structures
from gyrofuse.fitting.ranking.candidates import Kinds
from gyrofuse.fitting.ranking.result import RankResult
from gyrofuse.fitting.ranking.table import Table, by_moments, by_spectrum
from gyrofuse.fitting.spectral.tones import FEWEST_SAMPLES
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import KnownSignal, as_recording
from gyrofuse.noise.processes import Model


@renamed_arguments(max_tones="max_sinusoids", line_level="line_alpha")
def rank_models(
    signal: Tensor | Recording,
    candidates: Sequence[Model | str] | None = None,
    *,
    n_levels: int | None = None,
    max_sinusoids: int = 3,
    line_alpha: float = 0.001,
    confidence_level: float = 0.95,
    fit: bool = True,
    n_samples: int | None = None,
) -> RankResult:
    """Rank structures of noise processes by how well they explain every sensor.

    The number of sinusoids comes first, by tests of the largest spectral line against the fitted noise; the noise
    without them follows, by the criterion of Hannan and Quinn, `-2 ln L + 3 p ln ln T` with the spectral (Whittle)
    likelihood `L` and `p` parameters. The penalty `p ln T` of BIC misses weak processes of long records.

    Beside it stands the wavelet variance information criterion, `WVIC = r' V^-1 r + 2 tr(cov(nu, nu(theta)) V^-1)` with
    `r = nu - nu(theta)`, whose second term is twice the number of parameters; it keeps some processes too many.

    A candidate whose fit amounts to a smaller one that explains the record as well is redundant and not chosen;
    candidates within a factor of 7 of the best in penalised likelihood, or that have its spectrum, are named as
    equivalent.

    Args:
        signal: Signal `(..., sensor, time)`, or a `Recording`; an item with missing or infinite samples is not ranked,
            as its spectrum needs a whole record: give the longest stretch without, `Recording.longest_whole`.
        candidates: Models without values or formulas such as `"WN + AR1"`; by default sums of WN, QN, up to three
            AR1s, RW and DR, with as many sinusoids as there are spectral lines. The search starts from one process,
            extends the three best of every size for every sensor as long as one of them gains, and ends with those next
            to the best: with a process less, or with WN, QN, RW or two of them in the place of an AR1.
        n_levels: Number of levels J of the wavelet variance; by default all that hold two non-overlapping windows.
        max_sinusoids: Largest number of sinusoids in the default candidates.
        line_alpha: Probability that noise alone shows a spectral line.
        confidence_level: Probability that an interval of the best fits holds the true value.
        fit: Whether to fit the best model of every sensor in full, for `RankResult.best`.
        n_samples: Deprecated; see `rank_models_moments`.

    Returns:
        The table, the choice and its fit for every sensor.

    Raises:
        TypeError: `signal` is not a floating point tensor or a `Recording`, or candidates are no models.
        ValueError: Bad candidates or options, too few samples, or no item that can be ranked.

    References:
        [V] sections III and IV; E. J. Hannan, B. G. Quinn, Journal of the Royal Statistical Society B 41, 1979.
    """
    check_confidence_level(confidence_level)
    if not 0 < line_alpha < 1:
        raise ValueError(f"`line_alpha`: expected a probability between 0 and 1 such as 0.001, got {line_alpha!r}")
    if isinstance(max_sinusoids, bool) or not isinstance(max_sinusoids, int) or max_sinusoids < 0:
        raise ValueError(f"`max_sinusoids`: expected a whole number >= 0, got {max_sinusoids!r}")
    wanted = None if candidates is None else structures.read_candidates(candidates)
    if n_samples is not None:
        deprecate_moments(signal, n_samples, "rank_models", stacklevel=4)
        return rank_models_moments(
            signal,  # type: ignore[arg-type]
            n_samples,
            candidates,
            n_levels=n_levels,
            confidence_level=confidence_level,
            fit=fit,
        )
    known = as_recording(signal)
    length = known.values.shape[-1]
    if length < FEWEST_SAMPLES:
        raise ValueError(f"`signal`: expected at least {FEWEST_SAMPLES} samples, got {length}; record longer")
    levels = check_n_levels(n_levels, length) if n_levels is not None else largest_level(length) - 1
    items = known.values.detach().reshape(-1, length)
    usable = items.sum(-1, dtype=torch.float64).isfinite() & (items != items[:, :1]).any(-1)
    if not bool(usable.all()):
        what = (
            "`signal`: expected records that vary and have no missing samples or infinite ones (of records with gaps "
            "give a stretch without, or the wavelet variance to rank_models_moments)"
        )
        _report(what, usable)
    _check_sizes(wanted, levels, held=True)
    table = by_spectrum(items[usable], wanted, levels, max_sinusoids, line_alpha)

    def fitted(which: Tensor, model: Model) -> GMWMResult:
        signals = items[which][:, None]
        return fit_gmwm(signals, model, n_levels=levels, refine=True, confidence_level=confidence_level)

    batch = tuple(known.values.shape[:-1])
    return _ranked(table, usable, batch, known, length, fitted if fit else None, from_signal=True)


def rank_models_moments(
    wavelet_variance: Tensor,
    n_samples: int,
    candidates: Sequence[Model | str] | None = None,
    *,
    n_levels: int | None = None,
    confidence_level: float = 0.95,
    fit: bool = True,
) -> RankResult:
    """Rank structures of noise processes for wavelet variances whose signals are not at hand; see `rank_models`.

    `-2 ln L` is then `r' V^-1 r + ln det V` with `r = nu - nu(theta)`. Wavelet variances hardly determine frequencies,
    so that there are no sinusoids among the default candidates.

    Args:
        wavelet_variance: `(..., level, sensor)`, signal^2, as `wavelet_variance` returns it.
        n_samples: Length of the records behind it.
        candidates: As for `rank_models`.
        n_levels: Number of levels J; by default all that are given.
        confidence_level: Probability that an interval of the best fits holds the true value.
        fit: Whether to fit the best model of every sensor in full, for `RankResult.best`.

    Returns:
        The table, the choice and its fit for every sensor.

    Raises:
        TypeError: `wavelet_variance` is not a floating point tensor, or candidates are no models.
        ValueError: No wavelet variance of records that long, bad candidates, or no item that can be ranked.
    """
    check_confidence_level(confidence_level)
    wanted = None if candidates is None else structures.read_candidates(candidates)
    n_samples = check_positive_integer("n_samples", n_samples)
    values = check_wavelet_variance(wavelet_variance, n_samples, n_levels).detach().to(torch.float64)
    *batch, levels, n_sensors = values.shape
    items = values.mT.reshape(-1, levels)
    usable = (items.isfinite() & (items > 0)).all(-1)
    if not bool(usable.all()):
        _report("`wavelet_variance`: expected wavelet variances that are finite and > 0 at every level", usable)
    _check_sizes(wanted, levels, held=False)
    table = by_moments(items[usable], wanted, n_samples)

    def fitted(which: Tensor, model: Model) -> GMWMResult:
        return fit_gmwm_moments(items[which][..., None], n_samples, model, confidence_level=confidence_level)

    known = KnownSignal(wavelet_variance, numbered(n_sensors))
    return _ranked(table, usable, (*batch, n_sensors), known, n_samples, fitted if fit else None, from_signal=False)


def _check_sizes(wanted: list[Kinds] | None, levels: int, held: bool) -> None:
    """Refuse candidates with more parameters than levels."""
    largest = max(wanted or [[]], key=lambda kinds: structures.n_unknown(kinds, held))
    if (size := structures.n_unknown(largest, held)) > levels:
        raise ValueError(
            f"`candidates`: expected at most as many parameters as the {levels} levels, got {size} in "
            f"{structures.name_of(largest)}; record longer or leave it out"
        )


def _ranked(
    table: Table,
    usable: Tensor,
    batch: tuple[int, ...],
    known: KnownSignal,
    n_samples: int,
    fitted: Callable[[Tensor, Model], GMWMResult] | None,
    from_signal: bool,
) -> RankResult:
    """Fit the chosen candidate of every sensor, by `fitted` of items and a model, and put all into their places."""
    best: list[GMWMResult | None] = [None] * len(usable)
    places = usable.nonzero()[:, 0]
    for c in table.choice.unique().tolist():
        if fitted is None:
            break
        which = places[table.choice == c]
        model = structures.structure_of(table.kinds[c], held=True)  # its processes in the order of the table
        whole = fitted(which, Model(list(model.processes)))
        # With the sinusoids in the model, not taken out: one J test for the table and the fit.
        table.p_value[table.choice == c, c] = whole.p_value[:, 0]
        for i, place in enumerate(which.tolist()):
            sensors = (known.sensors[place % batch[-1]],)
            best[place] = replace(whole[i], sensors=sensors, rate=known.rate, unit=known.unit)
    return RankResult.build(
        table=table,
        usable=usable,
        batch=batch,
        best=tuple(best),
        n_samples=n_samples,
        from_signal=from_signal,
        sensors=known.sensors,
        axes=known.axes,
    )


def _report(what: str, usable: Tensor) -> None:
    """Raise or warn about items that cannot be ranked."""
    n = int((~usable).sum())
    message = f"{what}, got {n} of {len(usable)} others"
    if n == len(usable):
        raise ValueError(f"{message}; leave them out")
    warnings.warn(f"{message}; they are not ranked", stacklevel=4)
