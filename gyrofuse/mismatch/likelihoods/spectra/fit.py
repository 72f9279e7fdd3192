"""Joint fit of spectral terms by Fisher scoring."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.common_sources import Common
from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.mismatch.likelihoods.spectra.ratios import (
    FLOOR,
    Ratios,
    correlations,
    log_gain,
    power_gains,
    power_scores,
)


class Fit(NamedTuple):
    """Terms with their best numbers.

    Attributes:
        terms: The terms.
        gain: Log likelihood over that of no difference, nats, priors not counted.
        information: Information on all free numbers, with their priors' precision.
        covariance: Their covariance.
        rows: Rows of each term's numbers in both, local then shared; -1 for those that are not free.
        model: Cross-spectra over the reference's powers, `(band, sensor, sensor)`.
    """

    terms: tuple[Term, ...]
    gain: float
    information: Tensor
    covariance: Tensor
    rows: tuple[Tensor, ...]
    model: Tensor

    @property
    def power(self) -> Tensor:
        """Model of the ratios of powers, `(band, sensor)`."""
        return powers(self.model)

    def others(self, term: int) -> list[Term]:
        """All terms but one."""
        return [*self.terms[:term], *self.terms[term + 1 :]]

    def sd(self, term: int) -> tuple[Tensor, Tensor]:
        """Standard deviations of a term's local `(number, sensor)` and shared numbers; NaN where not free."""
        rows, own = self.rows[term], self.terms[term]
        variance = self.covariance.diagonal()
        sd = torch.where(rows >= 0, variance[rows.clamp(min=0)].clamp(min=0).sqrt(), math.nan)
        n = own.local.numel()
        return sd[:n].view_as(own.local), sd[n:]

    def sd_alone(self, term: int) -> Tensor:
        """The same of local numbers if all others were known: of factors of a product, too, these are finite."""
        own = self.terms[term]
        rows = self.rows[term][: own.local.numel()]
        sd = self.information.diagonal()[rows.clamp(min=0)].clamp(min=1e-100).rsqrt()
        return torch.where(rows >= 0, sd, math.nan).view_as(own.local)


def powers(model: Tensor) -> Tensor:
    """Powers `(..., band, sensor)` of cross-spectra `(..., band, sensor, sensor)`."""
    return model.diagonal(dim1=-2, dim2=-1).real


def fit(data: Ratios, terms: Sequence[Term], rounds: int = 40) -> Fit:
    """Fisher scoring of all free numbers together (Levenberg and Marquardt's damping), from where the terms stand.

    Args:
        data: What is to be explained.
        terms: Terms at their starts.
        rounds: Rounds at most.
    """
    enough = 0.01  # nats that a further round has to gain
    terms = tuple(term.within() for term in terms)
    coherent, added = (any(x) for x in ((t.coherent for t in terms), (t.acts == "add" for t in terms)))
    turns = any(t.turns for t in terms)
    paired = bool((data.pair_dof > 0).any()) and (coherent or ((added or turns) and not data.independent))
    whole = paired or coherent  # else powers are all that is asked for

    def model_of(parts: Pieces) -> Tensor:
        return parts.model(data) if whole else parts.power(data)

    slopes_at = slopes_of_spectra if whole else slopes_of_powers

    def value_of(model: Tensor, terms: Sequence[Term]) -> float:
        gain = log_gain(data, model, paired=paired) if whole else power_gains(data, model)
        return float(gain.sum()) - prior_cost(terms)

    free = torch.cat([torch.cat([t.free.flatten(), torch.ones(len(t.shared), dtype=torch.bool)]) for t in terms])
    parts = pieces(data, terms)
    model = model_of(parts)
    derivatives, best = slopes_at(data, terms, parts, model), value_of(model, terms)
    damping, information = 1e-3, torch.eye(len(free), dtype=torch.float64)
    for _ in range(rounds if math.isfinite(best) else 1):
        vector = torch.cat([torch.cat([t.local.flatten(), t.shared]) for t in terms])
        limit = torch.cat([part.flatten() for t in terms for part in t.step_limit()])
        precision = torch.cat([_precision(t) for t in terms])
        information, slope = _power_slopes(data, *(_diagonals(model, derivatives) if whole else (model, derivatives)))
        if paired:
            beside = _wishart_slopes(*_correlated(model, derivatives), data.correlation, data.pair_dof)
            information, slope = information + beside[0], slope + beside[1]
        slope = slope - precision * vector
        information = information + precision.diag()
        if not (math.isfinite(best) and bool(information.isfinite().all()) and bool(slope.isfinite().all())):
            break
        low, high = (torch.cat([_bounds(t)[k] for t in terms]) for k in (0, 1))
        # A number at its bound that wants to go beyond stays there.
        active = free & ~((vector <= low) & (slope < 0)) & ~((vector >= high) & (slope > 0))
        accepted, gain = False, 0.0
        while damping < 1e8:
            step = _solved(information, slope, active, damping).clamp(-limit, limit)
            trial = _with_numbers(terms, vector + step)
            parts = pieces(data, trial)
            tried = model_of(parts)
            value = value_of(tried, trial)
            if value >= best:
                accepted, gain = True, value - best
                break
            damping *= 10
        if not accepted:
            break
        terms, model, best, damping = trial, tried, value, max(damping / 10, 1e-6)
        derivatives = slopes_at(data, terms, parts, model)
        if gain < enough:
            break
    if not whole:
        model = data_model(data, terms)
    information = information[free][:, free]
    rows = torch.where(free, free.cumsum(0) - 1, -1).split([t.local.numel() + len(t.shared) for t in terms])
    if not math.isfinite(best) or not bool(information.isfinite().all()):  # no start to go on from
        return Fit(terms, -math.inf, information, torch.zeros_like(information), rows, model)
    covariance = _inverse(information)
    if paired:
        # Powers that a model makes coherent vary together: the scores' own covariance stands between (Godambe).
        more = _power_covariance(data, model, derivatives) - _power_slopes(data, *_diagonals(model, derivatives))[0]
        covariance = covariance + covariance @ more[free][:, free] @ covariance
    gain = float(log_gain(data, model, paired=paired).sum())
    return Fit(terms, gain, information, covariance, rows, model)


def _inverse(information: Tensor) -> Tensor:
    """Covariance; a direction with less than 1e-9 of the largest information, as a source's phase has, gets none."""
    scale = information.diagonal().clamp(min=1e-100).rsqrt()
    inverse = torch.linalg.pinv(information * scale[:, None] * scale, rtol=1e-9, hermitian=True)
    return inverse * scale[:, None] * scale


def _diagonals(model: Tensor, derivatives: Tensor) -> tuple[Tensor, Tensor]:
    """Powers `(band, sensor)` of a model, and their derivatives `(number, band, sensor)`."""
    return powers(model), powers(derivatives)


def _power_slopes(data: Ratios, m: Tensor, derivatives: Tensor) -> tuple[Tensor, Tensor]:
    """Information `(number, number)` and score `(number,)` of powers `(band, sensor)`."""
    moved = (derivatives / (m + FLOOR)).flatten(1)  # (number, band * sensor)
    score = (data.weight * power_scores(data, m)).flatten()
    information = (data.weight * data.information[:, None]).flatten()
    return (moved * information) @ moved.mT, moved @ score


def _power_covariance(data: Ratios, model: Tensor, derivatives: Tensor) -> Tensor:
    """Covariance of the scores of powers, `(number, number)`: squared coherences of the model are correlations."""
    m = model.diagonal(dim1=-2, dim2=-1).real
    moved = data.weight * derivatives.diagonal(dim1=-2, dim2=-1).real / (m + FLOOR)  # (number, band, sensor)
    alike = correlations(model).abs().square() * data.information[:, None, None]
    return torch.einsum("kbi,bij,lbj->kl", moved, alike, moved)


def _wishart_slopes(model: Tensor, derivatives: Tensor, observed: Tensor, dof: Tensor) -> tuple[Tensor, Tensor]:
    """Information and score of correlation matrices."""
    inverse = torch.linalg.inv_ex(model)[0]  # of one without an inverse no step is taken
    left = inverse @ (observed - model) @ inverse
    moved = inverse @ derivatives  # (number, band, sensor, sensor)
    full = torch.einsum("kbij,lbji->kl", moved * dof[:, None, None], moved).real
    return full, torch.einsum("bij,kbji->k", left * dof[:, None, None], derivatives).real


def _correlated(model: Tensor, derivatives: Tensor) -> tuple[Tensor, Tensor]:
    """Correlations of a model and their derivatives."""
    size = model.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300)
    rise = derivatives.diagonal(dim1=-2, dim2=-1).real / size / 2  # (number, band, sensor)
    own = correlations(model)
    moved = derivatives * (size.rsqrt()[:, :, None] * size.rsqrt()[:, None, :])
    return own, moved - own * (rise[..., :, None] + rise[..., None, :])


def data_model(data: Ratios, terms: Sequence[Term]) -> Tensor:
    """What terms make of the reference's cross-spectra over its powers, `(band, sensor, sensor)`."""
    return pieces(data, terms).model(data)


class Pieces(NamedTuple):
    """What terms do to the noise, in the order in which it is done.

    Attributes:
        factor: Factors on the noise, `(..., sensor, node)`.
        added: Densities added.
        filters: Factors on everything.
        common: Cross-spectra of common sources over the reference's powers, `(band, sensor, sensor)`; None without.
        values: What each term does, in the order of the terms; of a common source its cross-spectra.
        turn: What filters turn everything by, complex of size one, `(band, sensor)`; None without such a filter. Steps
            of a fit hold it, as powers tell most of what they are.
    """

    factor: Tensor
    added: Tensor
    filters: Tensor
    common: Tensor | None = None
    values: tuple[Tensor, ...] = ()
    turn: Tensor | None = None

    def with_term(self, acts: str, values: Tensor, instead: Tensor | float | None = None) -> Pieces:
        """With one more term that acts in some way; or with other `values` of one that is there, `instead`."""
        if acts == "add":
            return self._replace(added=self.added - (0.0 if instead is None else instead) + values)
        divisor = 1.0 if instead is None else instead
        if acts == "scale":
            return self._replace(factor=self.factor / divisor * values)
        if acts == "undo":  # the noise is what the reference was before its filter
            least = 1e-9
            return self._replace(factor=self.factor * ((torch.as_tensor(divisor) + least) / (values + least)))
        return self._replace(filters=self.filters * (values / torch.as_tensor(divisor).clamp(min=1e-300)))

    def model(self, data: Ratios) -> Tensor:
        """Cross-spectra over the reference's powers, `(..., band, sensor, sensor)`."""
        ground, mean_of = data.ground, data.ground.bands.mean_of
        size = (mean_of(self.factor * self.filters * ground.density) / ground.mean).clamp(min=0).sqrt().mT
        share, last = ground.rounded
        extra = (mean_of(self.added * self.filters) / ground.mean).mT * share + last * (1 - size.square())
        own = data.expected * (size[..., :, None] * size[..., None, :]) * self._turned() + torch.diag_embed(extra)
        return own if self.common is None else own + self.common * self.passed(ground)

    def passed(self, ground: Ground) -> Tensor:
        """Factors of filters on cross-spectra, `(..., band, sensor, sensor)`."""
        gain = ground.bands.mean_of(self.filters).clamp(min=0).sqrt().mT
        return gain[..., :, None] * gain[..., None, :] * self._turned()

    def _turned(self) -> Tensor | float:
        """Factors of size one on cross-spectra, `(band, sensor, sensor)`."""
        return 1.0 if self.turn is None else self.turn[:, :, None] * self.turn[:, None, :].conj()

    def power(self, data: Ratios) -> Tensor:
        """Powers over the reference's, `(..., band, sensor)`."""
        ground, mean_of = data.ground, data.ground.bands.mean_of
        share, last = ground.rounded
        own = (mean_of((self.factor * ground.density + self.added) * self.filters) / ground.mean).mT
        own = own * share + last
        if self.common is None:
            return own
        return own + powers(self.common) * mean_of(self.filters).mT


def pieces(data: Ratios, terms: Sequence[Term]) -> Pieces:
    """What terms do to the reference's noise."""
    ground = data.ground
    one = torch.ones_like(ground.density)
    found, values = Pieces(one, torch.zeros_like(one), one), list[Tensor]()
    for term in terms:
        if isinstance(term, Common):
            made = _relative(ground, term.shape(ground, term.shared)) * term.matrix()
            found = found._replace(common=made if found.common is None else found.common + made)
        else:
            made = term.values(ground, term.local, term.shared)
            found = found.with_term(term.acts, made)
        values.append(made)
    if any(term.turns for term in terms):
        f = ground.bands.frequency
        turns = [term.turn(f).mT for term in terms if term.turns]
        found = found._replace(turn=torch.stack(turns).prod(0))
    return found._replace(values=tuple(values))


def _relative(ground: Ground, density: Tensor) -> Tensor:
    """Density `(..., node)` of a source over the noise of pairs of sensors, `(..., band, sensor, sensor)`."""
    level = ground.whole.mT.rsqrt()
    return ground.bands.mean_of(density)[..., None, None] * (level[:, :, None] * level[:, None, :])


def slopes_of_spectra(data: Ratios, terms: Sequence[Term], parts: Pieces, model: Tensor) -> Tensor:
    """Derivatives `(number, band, sensor, sensor)` of a model with respect to the numbers of its terms."""
    slopes = [
        _common_slopes(data.ground, term, parts)
        if isinstance(term, Common)
        else _slopes(data, term, value, parts, model)
        for term, value in zip(terms, parts.values, strict=True)
    ]
    return torch.cat(slopes)


def slopes_of_powers(data: Ratios, terms: Sequence[Term], parts: Pieces, power: Tensor) -> Tensor:
    """Derivatives `(number, band, sensor)` of powers of a model without common sources."""
    own = torch.eye(data.n_sensors, dtype=torch.float64)[:, None]  # (sensor of the number, 1, sensor)
    slopes = []
    for term, value in zip(terms, parts.values, strict=True):
        slope = _differences(data, term, value, parts, Pieces.power, power)
        n_local = len(term.local)
        slopes.append(torch.cat([(slope[:n_local, None] * own).flatten(0, 1), slope[n_local:]]))
    return torch.cat(slopes)


_STEP = 1e-4  # of differences, in units of a number: the root of rounding errors, and more


def _slopes(data: Ratios, term: Term, value: Tensor, parts: Pieces, model: Tensor) -> Tensor:
    """Derivatives `(number, band, sensor, sensor)` with respect to the numbers of a term of that value."""
    n_local, p = term.local.shape
    slope = _differences(data, term, value, parts, Pieces.model, model)
    # A number of one sensor acts on its row and column: half the effect that moving all together has on a pair.
    share = torch.eye(p, dtype=torch.float64)
    share = (share[:, :, None] + share[:, None, :]) / 2  # (sensor, row, column)
    return torch.cat([(slope[:n_local, None] * share[:, None]).flatten(0, 1), slope[n_local:]])


def _differences(
    data: Ratios, term: Term, value: Tensor, parts: Pieces, made: Callable[[Pieces, Ratios], Tensor], here: Tensor
) -> Tensor:
    """Of what is `made` of the pieces and is `here`, over steps of each number that is free in some sensor, else 0.

    A local number moves in all sensors.
    """
    n_local, p = term.local.shape
    step = torch.full((n_local + len(term.shared),), _STEP, dtype=torch.float64)
    if term.acts == "add":
        step[:n_local] *= term.local.abs().amax(-1).clamp(min=1e-30)
    free = torch.cat([term.free.any(-1), torch.ones(len(term.shared), dtype=torch.bool)])
    turn = torch.diag(step)[free]
    local = term.local + turn[:, :n_local, None].expand(-1, n_local, p)
    moved = term.values(data.ground, local, term.shared + turn[:, n_local:])
    difference = made(parts.with_term(term.acts, moved, value), data) - here
    slopes = torch.zeros(len(step), *here.shape, dtype=here.dtype)
    slopes[free] = difference / step[free].view(-1, *(1 for _ in here.shape))
    return slopes


def _common_slopes(ground: Ground, term: Common, parts: Pieces) -> Tensor:
    """The same of a common source: gains have derivatives, shared numbers differences."""
    passed = parts.passed(ground)
    source = _relative(ground, term.shape(ground, term.shared)) * passed
    slopes = term.derivatives()[:, None] * source
    for turn in _STEP * torch.eye(len(term.shared), dtype=torch.float64):
        moved = _relative(ground, term.shape(ground, term.shared + turn)) * passed
        slopes = torch.cat([slopes, ((moved - source) / _STEP * term.matrix())[None]])
    return slopes


def _precision(term: Term) -> Tensor:
    """Of the priors of a term's numbers, local then shared: that of a normal law with the same slope."""
    own = torch.zeros_like(term.local)
    if (scale := term.prior()) is not None:
        own = 2 / (scale.square() + term.local.square())
    return torch.cat([own.flatten(), torch.zeros_like(term.shared)])


def prior_cost(terms: Sequence[Term]) -> float:
    """`log(1 + (x / scale)^2)` of every local number with a scale: a heavy tail, so that strong effects cost little."""
    total = 0.0
    for term in terms:
        if (scale := term.prior()) is not None:
            total += float(torch.log1p((term.local / scale).square()).sum())
    return total


def _bounds(term: Term) -> tuple[Tensor, Tensor]:
    """Lowest and highest values of a term's numbers, local then shared."""
    free = torch.full_like(term.shared, math.inf)
    return (
        torch.cat([torch.full_like(term.local, term.lower).flatten(), -free]),
        torch.cat([torch.full_like(term.local, term.upper).flatten(), free]),
    )


def _with_numbers(terms: Sequence[Term], vector: Tensor) -> tuple[Term, ...]:
    sizes = [t.local.numel() + len(t.shared) for t in terms]
    return tuple(
        replace(t, local=own[: t.local.numel()].view_as(t.local), shared=own[t.local.numel() :]).within()
        for t, own in zip(terms, vector.split(sizes), strict=True)
    )


def _solved(information: Tensor, slope: Tensor, active: Tensor, damping: float) -> Tensor:
    """Damped step of the numbers that may move; the others' is 0."""
    step = torch.zeros_like(slope)
    if bool(active.any()):
        own = information[active][:, active]
        scale = own.diagonal().clamp(min=1e-300).rsqrt()
        own = own * scale[:, None] * scale + (damping + 1e-9) * torch.eye(len(scale), dtype=scale.dtype)
        step[active] = torch.linalg.solve_ex(own, slope[active] * scale)[0] * scale
    return step
