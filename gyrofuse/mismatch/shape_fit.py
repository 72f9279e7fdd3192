"""Joint fit of spectral shapes to what the cross-spectra of a recording are to those of a simulation.

In every band `R` and `S` are the cross-spectral matrices of `d` and `s` ordinates. With `Q` their ratio, sensor by
sensor, its model is `M = H (A C A + X) H`: `C` the coherence of the simulation, `A` other levels, `X` what is
added, over the noise of the simulation, `H` filters. Its likelihood is Whittle's,

    -w (log det M + tr M^-1 Q),   w = d s / (d + s),

where the diagonal of `Q` is first moved so that one band alone gains what the law of F gives it. Where the sensors of
the simulation are independent, so that its coherences are known, those of the recording are worth `d`: the likelihood
of both correlation matrices is added `d - w` times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.base import Base
from gyrofuse.mismatch.shape_bands import Deep
from gyrofuse.mismatch.shape_ground import Ground
from gyrofuse.mismatch.shape_law import equivalent, equivalent_moments, smooth_coherence
from gyrofuse.mismatch.shape_terms import Common, Term

_ROUNDS, _ENOUGH = 25, 0.01
_STEP = 1e-4
_NOTHING = 1e-9  # of the largest information


@dataclass(frozen=True, eq=False)
class Ratios:
    """What is to be explained.

    Attributes:
        ground: Noise of the simulation.
        observed: `Q`, `(band, sensor, sensor)`.
        expected: `C`, `(band, sensor, sensor)`.
        worth: `w`, `(band,)`; 0 leaves a band out.
        sides: `R`, powers of the simulation `(band, sensor)`, `d` and `s`.
        mean: Of `equivalent` powers where nothing differs, `(band,)`.
        extra: What coherences are worth beyond powers, `(band,)`.
        level: Powers over those of the simulation where the law of F is taken, `(band, sensor)`.
    """

    ground: Ground
    observed: Tensor
    expected: Tensor
    worth: Tensor
    sides: tuple[Tensor, Tensor, Tensor, Tensor]
    mean: Tensor
    extra: Tensor
    level: Tensor

    @classmethod
    def of(
        cls,
        ground: Ground,
        sides: tuple[Tensor, Tensor, Tensor, Tensor],
        expected: Tensor,
        usable: Tensor,
        independent: bool = False,
    ) -> Ratios:
        spectra, _, d, s = sides
        mean, worth = equivalent_moments(d, s)
        worth = worth * usable * (s > 0)
        extra = (d - worth).clamp(min=0) * (worth > 0) * independent
        one = torch.ones_like(ground.mean.mT)
        return cls(ground, spectra, expected, worth, (*sides[:2], d, s), mean, extra, one).centred(one)

    def centred(self, level: Tensor) -> Ratios:
        """With the law of F taken at powers `(band, sensor)` over those of the simulation."""
        spectra, power, d, s = self.sides
        own = spectra.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300)
        wanted = level * equivalent(own / power / level, d[:, None], s[:, None]) / self.mean[:, None]
        # Where nothing is simulated ratios have no size.
        scale = (torch.where((self.worth > 0)[:, None], wanted, 1.0) / own).sqrt()
        return replace(self, observed=spectra * (scale[:, :, None] * scale[:, None, :]), level=level)

    def off(self, level: Tensor) -> float:
        """Largest factor, either way, by which other powers `(band, sensor)` are off its own where it is worth any."""
        return float((self.level / level).log().abs()[self.worth > 0].max().exp())

    @property
    def n_sensors(self) -> int:
        return self.observed.shape[-1]

    @property
    def penalty(self) -> float:
        """Nats for each free number."""
        return math.log(max(float(self.worth.sum()), 2.0)) / 2


def ratios(both: Deep, base: Base, usable: Tensor, independent: bool) -> Ratios:
    """Compare two sides; `usable` `(band,)` leaves bands out, `independent` are the sensors of the simulation."""
    power = both.simulated.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300)
    size = power.rsqrt()
    expected = smooth_coherence(both.simulated * (size[:, :, None] * size[:, None, :]), both.s)
    if independent:
        expected = torch.eye(expected.shape[-1], dtype=expected.dtype).expand_as(expected)
    sides = both.recorded, power, both.d, both.s
    return Ratios.of(Ground(base, both.bands), sides, expected, usable, independent)


class Fit(NamedTuple):
    """Shapes with their best numbers.

    Attributes:
        terms: Shapes.
        gain: Log likelihood over that of no difference, nats.
        covariance: Of all free numbers.
        places: Rows of the covariance of each term's numbers, local then shared; -1 for those that are not free.
        model: `M`, `(band, sensor, sensor)`.
    """

    terms: tuple[Term, ...]
    gain: float
    covariance: Tensor
    places: tuple[Tensor, ...]
    model: Tensor

    @property
    def n_free(self) -> int:
        return sum(int((place >= 0).sum()) for place in self.places)

    def sd(self, term: int) -> tuple[Tensor, Tensor]:
        """Standard deviations of a term's local `(number, sensor)` and shared numbers; NaN where not free."""
        places, own = self.places[term], self.terms[term]
        variance = self.covariance.diagonal()
        sd = torch.where(places >= 0, variance[places.clamp(min=0)].clamp(min=0).sqrt(), math.nan)
        n = own.local.numel()
        return sd[:n].view_as(own.local), sd[n:]

    def sd_given_shared(self, term: int) -> Tensor:
        """Those of the local numbers were the shared ones known: whether a sensor has it need not wait for a width."""
        places, own = self.places[term], self.terms[term]
        n = own.local.numel()
        free, shared = places[:n][places[:n] >= 0], places[n:]
        across = self.covariance[free][:, shared]
        known = across @ torch.linalg.pinv(self.covariance[shared][:, shared], hermitian=True)
        variance = self.covariance.diagonal()[free] - (known * across).sum(-1)
        sd = torch.full((n,), math.nan, dtype=torch.float64)
        sd[places[:n] >= 0] = variance.clamp(min=0).sqrt()
        return sd.view_as(own.local)


def fit(data: Ratios, terms: Sequence[Term], rounds: int = _ROUNDS) -> Fit:
    """Fisher scoring of all free numbers together."""
    terms = tuple(term.within() for term in terms)
    free = torch.cat([torch.cat([t.free.flatten(), torch.ones(len(t.shared), dtype=torch.bool)]) for t in terms])
    where = torch.where(free, free.cumsum(0) - 1, -1)
    model, derivatives = linearised(data, terms)
    best = _score(data, model) - _penalty(terms)
    damping, information = 1e-3, torch.eye(len(free), dtype=torch.float64)
    for _ in range(rounds if math.isfinite(best) else 0):
        vector, reach = _numbers(terms), torch.cat([_reach(t) for t in terms])
        precision = torch.cat([_precision(t) for t in terms])  # another one on either side of 0
        full, slope = _curved(model, derivatives, data.observed, data.worth)
        if bool((data.extra > 0).any()):
            beside = _curved(*_correlated(model, derivatives), _correlations(data.observed), data.extra)
            full, slope = full + beside[0], slope + beside[1]
        slope = slope - precision * vector
        information = full + precision.diag()
        # A number at its bound that wants to go beyond stays there.
        bound = torch.cat([_lower(t) for t in terms])
        active = free & ~((vector <= bound) & (slope < 0))
        accepted, gain = False, 0.0
        while damping < 1e8:
            step = _solved(information, slope, active, damping).clamp(-reach, reach)
            trial = _with_numbers(terms, vector + step)
            value = _score(data, data_model(data, trial)) - _penalty(trial)
            if value >= best:
                accepted, gain = True, value - best
                break
            damping *= 10
        if not accepted:
            break
        terms, best, damping = trial, value, max(damping / 10, 1e-6)
        model, derivatives = linearised(data, terms)
        if gain < _ENOUGH:
            break
    information = information[free][:, free]
    scale = information.diagonal().clamp(min=1e-300).rsqrt()
    # A common source's phase is nobody's: what has no information has no spread.
    inverse = torch.linalg.pinv(information * scale[:, None] * scale, rtol=_NOTHING, hermitian=True)
    covariance = inverse * scale[:, None] * scale
    sizes = [t.local.numel() + len(t.shared) for t in terms]
    return Fit(terms, _score(data, model) - _score(data, data.expected), covariance, where.split(sizes), model)


def _curved(model: Tensor, derivatives: Tensor, observed: Tensor, worth: Tensor) -> tuple[Tensor, Tensor]:
    """Information `(number, number)` and slope `(number,)` of Whittle's likelihood."""
    inverse = torch.linalg.inv(model)
    left = inverse @ (observed - model) @ inverse
    moved = inverse @ derivatives  # (number, band, sensor, sensor)
    full = torch.einsum("kbij,lbji->kl", moved * worth[:, None, None], moved).real
    return full, torch.einsum("bij,kbji->k", left * worth[:, None, None], derivatives).real


def _correlations(matrices: Tensor) -> Tensor:
    size = matrices.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).rsqrt()
    return matrices * (size[..., :, None] * size[..., None, :])


def _correlated(model: Tensor, derivatives: Tensor) -> tuple[Tensor, Tensor]:
    """Correlations of a model and their derivatives."""
    size = model.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300)
    rise = derivatives.diagonal(dim1=-2, dim2=-1).real / size / 2  # (number, band, sensor)
    own = _correlations(model)
    moved = derivatives * (size.rsqrt()[:, :, None] * size.rsqrt()[:, None, :])
    return own, moved - own * (rise[..., :, None] + rise[..., None, :])


def data_model(data: Ratios, terms: Sequence[Term]) -> Tensor:
    """`M`, `(band, sensor, sensor)`."""
    return _composed(data, *_pieces(data, terms))


def _pieces(data: Ratios, terms: Sequence[Term]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Factors on the noise, densities added, factors on everything `(sensor, place)`; common sources."""
    ground = data.ground
    one = torch.ones_like(ground.density)
    factor, added, filters, common = one, torch.zeros_like(one), one, torch.zeros_like(data.expected)
    for term in terms:
        if isinstance(term, Common):
            g = torch.complex(*term.local)
            source = term.acting(g[:, None] * g.conj())
            common = common + _relative(ground, term.shape(ground, term.shared)) * source
            continue
        values = term.values(ground, term.local, term.shared)
        if term.acts == "scale":
            factor = factor * values
        elif term.acts == "add":
            added = added + values
        else:
            filters = filters * values
    return factor, added, filters, common


def _composed(data: Ratios, factor: Tensor, added: Tensor, filters: Tensor, common: Tensor) -> Tensor:
    """`M` of factors and densities `(..., sensor, place)`, and of common sources."""
    ground, mean_of = data.ground, data.ground.bands.mean_of
    size = (mean_of(factor * filters * ground.density) / ground.mean).clamp(min=0).sqrt().mT
    extra = (mean_of(added * filters) / ground.mean).mT
    passed = mean_of(filters).clamp(min=0).sqrt().mT
    own = data.expected * (size[..., :, None] * size[..., None, :]) + torch.diag_embed(extra)
    return own + common * (passed[..., :, None] * passed[..., None, :])


def _relative(ground: Ground, density: Tensor) -> Tensor:
    """Density `(..., place)` of a source over the noise of pairs of sensors, `(..., band, sensor, sensor)`."""
    level = ground.mean.mT.rsqrt()
    return ground.bands.mean_of(density)[..., None, None] * (level[:, :, None] * level[:, None, :])


def linearised(data: Ratios, terms: Sequence[Term]) -> tuple[Tensor, Tensor]:
    """Model and its derivatives `(number, band, sensor, sensor)` with respect to every number, free or not."""
    ground, pieces = data.ground, _pieces(data, terms)
    factor, added, filters, common = pieces
    model = _composed(data, *pieces)
    slopes = []
    for term in terms:
        if isinstance(term, Common):
            slopes.append(_common_derivatives(data, term, filters))
            continue
        n_local, p = term.local.shape
        n = n_local + len(term.shared)
        step = _STEP * torch.ones(n, dtype=torch.float64)
        step[:n_local] *= _size(term)
        turn = torch.diag(step)
        local = term.local + turn[:, :n_local, None].expand(n, n_local, p)
        value = term.values(ground, term.local, term.shared)
        moved = term.values(ground, local, term.shared + turn[:, n_local:])
        if term.acts == "scale":
            changed = _composed(data, factor / value * moved, added, filters, common)
        elif term.acts == "add":
            changed = _composed(data, factor, added - value + moved, filters, common)
        else:
            changed = _composed(data, factor, added, filters / value * moved, common)
        slope = (changed - model) / step[:, None, None, None]
        # A number of one sensor acts on its row and column: half the effect that moving all together has on a pair.
        share = torch.eye(p, dtype=torch.float64)
        share = (share[:, :, None] + share[:, None, :]) / 2  # (sensor, row, column)
        own = slope[:n_local, None] * share[:, None]
        slopes.append(torch.cat([own.flatten(0, 1), slope[n_local:]]))
    return model, torch.cat(slopes)


def _size(term: Term) -> Tensor:
    """Natural size of a term's local numbers `(number,)`, for differences."""
    if term.acts != "add":
        return torch.ones(len(term.local), dtype=torch.float64)
    return term.local.abs().amax(-1).clamp(min=1e-30)


def _common_derivatives(data: Ratios, term: Common, filters: Tensor) -> Tensor:
    g = torch.complex(*term.local)
    ground = data.ground
    passed = ground.bands.mean_of(filters).clamp(min=0).sqrt().mT
    through = passed[:, :, None] * passed[:, None, :]
    row = torch.eye(len(g), dtype=g.dtype)[:, :, None] * g.conj()  # e_i g^H
    parts = term.acting(torch.cat([row + row.mH, 1j * row + (1j * row).mH]))  # (number, sensor, sensor)
    source = _relative(ground, term.shape(ground, term.shared)) * through
    slopes = parts[:, None] * source
    for turn in _STEP * torch.eye(len(term.shared), dtype=torch.float64):
        moved = _relative(ground, term.shape(ground, term.shared + turn)) * through
        slopes = torch.cat([slopes, ((moved - source) / _STEP * term.acting(g[:, None] * g.conj()))[None]])
    return slopes


def log_score(data: Ratios, model: Tensor) -> Tensor:
    """Whittle's log likelihood of each band, `(band,)`."""
    score = _whittle(model, data.observed, data.worth)
    if bool((data.extra > 0).any()):
        score = score + _whittle(_correlations(model), _correlations(data.observed), data.extra)
    return score


def fair_gain(data: Ratios, model: Tensor) -> float:
    """Log likelihood over that of no difference, nats, where neither is favoured.

    The law of F is taken at the powers of each: taken at those of one, the other would be held to ratios of which few
    ordinates make far too much.
    """

    def score(matrices: Tensor) -> float:
        own = data.centred(matrices.diagonal(dim1=-2, dim2=-1).real)
        seen = own.observed.diagonal(dim1=-2, dim2=-1).real
        best = torch.where((data.worth > 0)[:, None], data.worth[:, None] * (seen.log() + 1), 0.0)
        return float(log_score(own, matrices).sum() + best.sum())

    return score(model) - score(data.expected)


def _whittle(model: Tensor, observed: Tensor, worth: Tensor) -> Tensor:
    root, bad = torch.linalg.cholesky_ex(model)
    inside = torch.cholesky_solve(observed, root).diagonal(dim1=-2, dim2=-1).real.sum(-1)
    determinant = 2 * root.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).log().sum(-1)
    score = (-(worth * (determinant + inside))).nan_to_num(nan=-math.inf).masked_fill(bad > 0, -math.inf)
    return score.masked_fill(worth == 0, 0.0)


def _score(data: Ratios, model: Tensor) -> float:
    return float(log_score(data, model).sum())


def _precision(term: Term) -> Tensor:
    own = torch.zeros_like(term.local)
    if term.prior_sd:
        below, above = torch.tensor([term.prior_sd, term.prior_sd_above or term.prior_sd], dtype=torch.float64)
        own = torch.where(term.local > 0, above[:, None], below[:, None]) ** -2
    return torch.cat([own.flatten(), torch.zeros_like(term.shared)])


def _penalty(terms: Sequence[Term]) -> float:
    return sum(float((_precision(t) * _vector(t).square()).sum()) / 2 for t in terms)


def _lower(term: Term) -> Tensor:
    return torch.cat([torch.full_like(term.local, term.lower).flatten(), torch.full_like(term.shared, -math.inf)])


def _reach(term: Term) -> Tensor:
    return torch.cat([torch.full_like(term.local, math.inf).flatten(), term.reach()])


def _vector(term: Term) -> Tensor:
    return torch.cat([term.local.flatten(), term.shared])


def _numbers(terms: Sequence[Term]) -> Tensor:
    return torch.cat([_vector(t) for t in terms])


def _with_numbers(terms: Sequence[Term], vector: Tensor) -> tuple[Term, ...]:
    sizes = [t.local.numel() + len(t.shared) for t in terms]
    return tuple(
        replace(t, local=own[: t.local.numel()].view_as(t.local), shared=own[t.local.numel() :]).within()
        for t, own in zip(terms, vector.split(sizes), strict=True)
    )


def _solved(information: Tensor, slope: Tensor, active: Tensor, damping: float) -> Tensor:
    step = torch.zeros_like(slope)
    if bool(active.any()):
        own = information[active][:, active]
        scale = own.diagonal().clamp(min=1e-300).rsqrt()
        own = own * scale[:, None] * scale + (damping + 1e-9) * torch.eye(len(scale), dtype=scale.dtype)
        step[active] = torch.linalg.solve_ex(own, slope[active] * scale)[0] * scale
    return step
