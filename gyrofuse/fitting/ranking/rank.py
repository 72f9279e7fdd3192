"""Which noise processes made a record: compositions ranked by the likelihood of its spectrum."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import fields, replace

import torch
from torch import Tensor

from gyrofuse._base.checks import (
    check_confidence_level,
    check_floating,
    check_length,
    check_n_levels,
    check_signal,
    largest_level,
)
from gyrofuse._base.results import ConfidenceInterval, numbered
from gyrofuse.fitting.gmwm import _given, fit_gmwm
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.ranking import candidates as compositions
from gyrofuse.fitting.ranking.result import RankResult
from gyrofuse.fitting.ranking.table import by_moments, by_spectrum
from gyrofuse.fitting.spectral.tones import FEWEST_SAMPLES
from gyrofuse.io.recording import Recording
from gyrofuse.noise.estimation import EstimatedFrom
from gyrofuse.noise.processes import Model


def rank_models(
    signal: Tensor | Recording,
    candidates: Sequence[Model | str] | None = None,
    *,
    n_levels: int | None = None,
    n_samples: int | None = None,
    max_tones: int = 3,
    line_level: float = 0.001,
    confidence_level: float = 0.95,
    fit: bool = True,
) -> RankResult:
    """Rank compositions of noise processes by how well they explain every sensor.

    The number of sinusoids comes first, by tests of the largest spectral line against the fitted noise; the noise
    without them follows, by the criterion of Hannan and Quinn, `-2 ln L + 3 p ln ln T` with the spectral (Whittle)
    likelihood `L`: of `p` parameters each one too many gains that much in less than 1 % of records, while `ln T`, the
    charge of BIC, passes over weak processes of long records. Of wavelet variances alone, `-2 ln L` is
    `r' V^-1 r + ln det V` with `r = nu - nu(theta)`.

    Beside it stands the wavelet variance information criterion, `WVIC = r' V^-1 r + 2 tr(cov(nu, nu(theta)) V^-1)`,
    whose second term is twice the number of parameters; it keeps some processes too many.

    A candidate whose fit amounts to a smaller one that explains the record as well is redundant and not chosen;
    candidates within a factor of 7 of the best in penalised likelihood, or that have its spectrum, are named as
    equivalent.

    Args:
        signal: `(..., sensor, time)`, or a `Recording`; an item with missing or infinite samples is not ranked, as its
            spectrum asks for a whole record: give the longest stretch without, `Recording.longest_whole`. With
            `n_samples` given a wavelet variance `(..., level, sensor)` of records that long.
        candidates: Models without values or formulas such as `"WN + AR1"`; by default sums of WN, QN, up to three
            AR1s, RW and DR, with as many sinusoids as there are lines. They are tried from one process on, for
            every sensor the extensions of its three best, as long as one of them gains; in the end also those next to
            the best, with a process less, or with WN, QN, RW or two of them in the place of an AR1.
        n_levels: Number of levels J of the wavelet variance; by default all that hold two windows side by side.
        n_samples: Length of the record behind a wavelet variance.
        max_tones: Most sinusoids looked for by default; none in wavelet variances, which hardly know frequencies.
        line_level: Probability that noise alone shows a line.
        confidence_level: Of the intervals of the best fits.
        fit: Fit the best model of every sensor in full, for `RankResult.best`.

    Returns:
        The table, the choice and its fit for every sensor.

    Raises:
        TypeError: `signal` is not a floating point tensor or a `Recording`, or candidates are no models.
        ValueError: Bad candidates or options, `n_samples` of what is no wavelet variance, too few samples, or no item
            that can be ranked.

    References:
        [V] sections III and IV; E. J. Hannan, B. G. Quinn, Journal of the Royal Statistical Society B 41, 1979.
    """
    check_confidence_level(confidence_level)
    if not 0 < line_level < 1:
        raise ValueError(f"`line_level`: expected a probability between 0 and 1 such as 0.001, got {line_level!r}")
    if isinstance(max_tones, bool) or not isinstance(max_tones, int) or max_tones < 0:
        raise ValueError(f"`max_tones`: expected a whole number >= 0, got {max_tones!r}")
    recording = signal if isinstance(signal, Recording) else None
    values = signal.signal if isinstance(signal, Recording) else signal
    wanted = None if candidates is None else compositions.read_candidates(candidates)
    from_signal = n_samples is None
    if n_samples is None:
        check_signal("signal", values)
        length = values.shape[-1]
        if length < FEWEST_SAMPLES:
            raise ValueError(f"`signal`: expected at least {FEWEST_SAMPLES} samples, got {length}; record longer")
        levels = check_n_levels(n_levels, length) if n_levels is not None else largest_level(length) - 1
        items = values.detach().reshape(-1, length)
        batch = tuple(values.shape[:-1])
        usable = items.sum(-1, dtype=torch.float64).isfinite() & (items != items[:, :1]).any(-1)
    else:
        check_floating("signal", values)
        length = check_length(n_samples, recorded=recording is not None)
        values = _given(values, length, n_levels)
        levels = values.shape[-2]
        items = values.detach().mT.reshape(-1, levels).to(torch.float64)
        batch = (*values.shape[:-2], values.shape[-1])
        usable = (items.isfinite() & (items > 0)).all(-1)
    if not bool(usable.all()):
        _report(usable, from_signal)
    largest = max(wanted or [[]], key=lambda kinds: compositions.n_unknown(kinds, held=from_signal))
    if (size := compositions.n_unknown(largest, held=from_signal)) > levels:
        raise ValueError(
            f"`candidates`: expected at most as many parameters as the {levels} levels, got {size} in "
            f"{compositions.name_of(largest)}; record longer or leave it out"
        )
    if from_signal:
        table = by_spectrum(items[usable], wanted, levels, max_tones, line_level)
    else:
        table = by_moments(items[usable], wanted, length)
    sensors = tuple(recording.sensors if recording else numbered(batch[-1]))
    best: list[GMWMResult | None] = [None] * len(items)
    places = usable.nonzero()[:, 0]
    for c in table.choice.unique().tolist() if fit else ():
        which = places[table.choice == c]
        model = compositions.composition(table.kinds[c], held=True)  # its processes in the order of the table
        whole = _fitted(items[which], Model(list(model.processes)), levels, n_samples, confidence_level)
        # With the sinusoids in the model, not taken out: one J test for the table and the fit.
        table.p_value[table.choice == c, c] = whole.p_value[:, 0]
        for i, place in enumerate(which.tolist()):
            own = (sensors[place % batch[-1]],)
            best[place] = _one_of(whole, i, own, recording)
    return RankResult.build(
        table=table,
        usable=usable,
        batch=batch,
        best=tuple(best),
        n_samples=length,
        from_signal=from_signal,
        sensors=sensors,
        axes=recording.axes if recording else (),
    )


def _fitted(items: Tensor, model: Model, levels: int, n_samples: int | None, confidence_level: float) -> GMWMResult:
    """Full fits of one model, `(item, 1, parameter)`."""
    if n_samples is None:
        return fit_gmwm(items[:, None], model, n_levels=levels, refine=True, confidence_level=confidence_level)
    return fit_gmwm(items[..., None], model, n_samples=n_samples, confidence_level=confidence_level)


def _one_of(whole: GMWMResult, i: int, sensors: tuple[str, ...], recording: Recording | None) -> GMWMResult:
    """The fit of one sensor."""
    own = {f.name: getattr(whole, f.name) for f in fields(whole)}
    own |= {name: value[i] for name, value in own.items() if isinstance(value, Tensor)}
    interval = ConfidenceInterval(*(limit[i] for limit in whole.confidence_interval))
    known = recording is not None and recording.unit != "unknown"
    return replace(
        whole,
        **own
        | {
            "model": whole.model.with_params(
                own["params"], estimated_from=EstimatedFrom(whole.n_samples, own["param_cov"])
            ),
            "confidence_interval": interval,
            "remarks": (whole.remarks[i],),
            "sensors": sensors,
            "rate": recording.rate if recording else None,
            "unit": recording.unit if recording and known else None,
        },
    )


def _report(usable: Tensor, from_signal: bool) -> None:
    """Say how many items cannot be ranked."""
    what = (
        "expected records that vary and have no missing samples or infinite ones (of records with gaps give a stretch "
        "without, or the wavelet variance and `n_samples`)"
        if from_signal
        else "expected wavelet variances that are finite and > 0 at every level"
    )
    n = int((~usable).sum())
    message = f"`signal`: {what}, got {n} of {len(usable)} others"
    if n == len(usable):
        raise ValueError(f"{message}; leave them out")
    warnings.warn(f"{message}; they are not ranked", stacklevel=3)
