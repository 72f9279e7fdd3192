"""Likelihood of a recording's cross-spectra given those of a reference, and the joint fit of spectral terms by it.

In a band with `d` ordinates of the recording and `s` of the reference the ratio `r` of a sensor's powers is F
distributed around `m`, what a model makes of the reference's power. With `q = r / m`

    log L(m) / L(1) = -d log m - (d + s) [log(1 + d q / s) - log(1 + d r / s)],
    score in log m:   d s (q - 1) / (s + d q),      information:  d s / (d + s + 1).

The reference's spectrum is a nuisance that drops out of the ratio; an exact one is `s` without bound, which makes this
Whittle's likelihood. What sensors share is told by their correlation matrices, Wishart's law given the powers,

    -c [log det G + tr G^-1 K],   G of the model, K of the recording,

with `c = d` where the reference's sensors are independent, so that nothing about it is estimated, else `d s / (d + s)`.
Powers of sensors that share noise vary together: they count as often as a band has independent ones (a composite
likelihood of the powers with weights that make its mean right; Varin, Reid and Firth, 2011).

A reference drawn from a model that was itself fitted has fewer ordinates than it shows (see
`Records.effective_samples`); its parameters' covariance `C` and the spectrum's slopes `J` would enter as one more term
that scales the reference's noise by `exp(J x)`, `x` with precision `C^-1`, in every hypothesis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.likelihoods.coherence_law import smooth_coherence
from gyrofuse.mismatch.likelihoods.components import Common, Term
from gyrofuse.mismatch.likelihoods.reference_spectrum import Ground

# Share of the reference's power that is added to both sides of a ratio, -40 dB: below that leakage of the tapers and
# the rounding of converters tell of themselves.
FLOOR = 1e-4
_EXACT = 1e12  # ordinates of a reference whose spectrum is known
_ROUNDS, _ENOUGH = 40, 0.01  # of scoring, and nats that one more has to gain
_STEP = 1e-4  # of differences, in units of the number
_LEAST = 1e-100  # information, so that its inverse is a number
_NOTHING = 1e-9  # of the largest information: a direction that the data say nothing about
_INDEPENDENT = 1e-9  # of coherences: nothing


@dataclass(frozen=True, eq=False)
class Ratios:
    """What is to be explained.

    Attributes:
        ground: Noise of the reference.
        observed: Cross-spectra of the recording over the reference's powers, `(band, sensor, sensor)`.
        expected: Coherences of the reference, `(band, sensor, sensor)`.
        d, s: Complex ordinates of both, `(band,)`; `s` is 0 where there is no reference.
        usable: Which powers count, 0 or 1, `(band, sensor)`.
        paired: What correlations are worth, `(band,)`.
        together: Sensors whose ratios vary with that of each, `(band, sensor)`: itself, and others by the square of
            their correlation.
    """

    ground: Ground
    observed: Tensor
    expected: Tensor
    d: Tensor
    s: Tensor
    usable: Tensor
    paired: Tensor
    together: Tensor

    @classmethod
    def of(
        cls,
        ground: Ground,
        observed: tuple[Tensor, Tensor],
        reference: tuple[Tensor, Tensor],
        expected: Tensor,
        usable: Tensor,
        independent: bool = False,
    ) -> Ratios:
        """From cross-spectral matrices and ordinates of both sides.

        Args:
            ground: Noise of the reference.
            observed: Matrices `(band, sensor, sensor)` and ordinates `(band,)`.
            reference: Powers `(band, sensor)` and ordinates.
            expected: Coherences of the reference.
            usable: Which powers count, `(band, sensor)`.
            independent: Whether the reference's sensors share nothing.
        """
        (matrices, d), (power, s) = observed, reference
        known = (s > 0).to(d.dtype)
        size = torch.where(known[:, None] > 0, power.clamp(min=1e-300), ground.mean.mT).rsqrt()
        worth = known * (d if independent else d * s / (d + s).clamp(min=1e-300))
        ratios = matrices * (size[:, :, None] * size[:, None, :])
        # The variance of a log ratio is 1 / d + 1 / s, and what two have in common of either is a squared coherence.
        seen, share = smooth_coherence(_correlations(matrices), d), s / (d + s).clamp(min=1e-300)
        alike = share[:, None, None] * seen.abs().square() + (1 - share[:, None, None]) * expected.abs().square()
        together = alike.sum(-1).clamp(min=1.0)
        return cls(ground, ratios, expected, d, s, usable * known[:, None], worth * usable.amin(-1), together)

    @property
    def n_sensors(self) -> int:
        return self.observed.shape[-1]

    @property
    def ratio(self) -> Tensor:
        """Of powers, floored, `(band, sensor)`."""
        return floored(self.observed.diagonal(dim1=-2, dim2=-1).real)

    @property
    def worth(self) -> Tensor:
        """Information on a power in `log m`, `(band,)`."""
        return self.d * self.s / (self.d + self.s + 1)

    @property
    def share(self) -> Tensor:
        """What a power counts, `(band, sensor)`: less where sensors share noise."""
        return self.usable / self.together

    @property
    def alike(self) -> bool:
        """Whether the reference's sensors are independent, so that no filter changes a correlation."""
        return float((self.expected - torch.eye(self.n_sensors)).abs().max()) < _INDEPENDENT

    @property
    def n_ordinates(self) -> float:
        """What all bands of a sensor are worth."""
        return float((self.worth * self.usable.amax(-1)).sum())

    def without(self, cells: Tensor) -> Ratios:
        """With powers `(band, sensor)` left out."""
        return replace(self, usable=self.usable * ~cells)


def floored(ratio: Tensor) -> Tensor:
    """Ratios of powers with the floor in both."""
    return (ratio + FLOOR) / (1 + FLOOR)


def power_gains(data: Ratios, m: Tensor) -> Tensor:
    """Log likelihood of models of power over none, `(..., band, sensor)`, nats.

    Args:
        data: What is to be explained.
        m: Power over that of the reference, `(..., band, sensor)`.
    """
    d, s, r = data.d[:, None], data.s.clamp(min=1e-300)[:, None], data.ratio
    m = floored(m)
    odds = d * r / s
    return data.share * ((d + s) * (odds.log1p() - (odds / m).log1p()) - d * m.log())


def power_scores(data: Ratios, m: Tensor) -> Tensor:
    """Slope of the log likelihood of powers `(..., band, sensor)` in their logarithms, without their shares."""
    d, s = data.d[:, None], data.s[:, None]
    q = data.ratio / floored(m)
    return d * s * (q - 1) / (s + d * q).clamp(min=1e-300)


def log_gain(data: Ratios, model: Tensor, *, paired: bool = True) -> Tensor:
    """Log likelihood of a model `(band, sensor, sensor)` over none, `(band,)`, nats."""
    gain = power_gains(data, model.diagonal(dim1=-2, dim2=-1).real).sum(-1)
    if paired and bool((data.paired > 0).any()):
        matrices = _correlations(data.observed)
        gain = gain + _wishart(_correlations(model), matrices, data.paired)
        gain = gain - _wishart(data.expected, matrices, data.paired)
    return gain


def _wishart(model: Tensor, observed: Tensor, worth: Tensor) -> Tensor:
    root, bad = torch.linalg.cholesky_ex(model)
    inside = torch.cholesky_solve(observed, root).diagonal(dim1=-2, dim2=-1).real.sum(-1)
    determinant = 2 * root.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).log().sum(-1)
    score = (-(worth * (determinant + inside))).nan_to_num(nan=-math.inf).masked_fill(bad > 0, -math.inf)
    return score.masked_fill(worth == 0, 0.0)


class Fitness(NamedTuple):
    """How well a model fits the powers.

    Attributes:
        p_value: Of the deviance, chi-square in units of each cell's own mean.
        excess: Deviance beyond what chance makes, nats, `(sensor,)`.
    """

    p_value: float
    excess: Tensor


def fitness(data: Ratios, model: Tensor) -> Fitness:
    """Deviance of every power over its exact mean, `2 [(d+s) h(d+s) - d h(d) - s h(s)]`, `h(x) = psi(x) - log x`."""
    m = floored(model.diagonal(dim1=-2, dim2=-1).real)
    d, s = data.d[:, None], data.s.clamp(min=1e-9)[:, None]
    q = data.ratio / m
    deviance = 2 * ((d + s) * (torch.log1p(d / s * q) - torch.log1p(d / s)) - d * q.clamp(min=1e-300).log())

    def h(x: Tensor) -> Tensor:
        # Digammas of large numbers are their logarithms but for -1 / (2 x): the difference would be lost to rounding.
        return torch.where(x > 1e6, -0.5 / x, torch.digamma(x.clamp(max=1e6)) - x.clamp(max=1e6).log())

    mean = 2 * ((d + s) * h(d + s) - d * h(d) - s * h(s))
    cells = data.share
    total = float((cells * deviance / mean).sum())
    p_value = float(stats.chi2.sf(total, max(float(cells.sum()), 1.0)))
    return Fitness(p_value, (cells * (deviance - mean)).sum(0) / 2)


class Fit(NamedTuple):
    """Terms with their best numbers.

    Attributes:
        terms: They.
        gain: Log likelihood over that of no difference, nats, priors not counted.
        information: Of all free numbers, with their priors' precision.
        covariance: Its inverse.
        places: Rows of each term's numbers, local then shared; -1 for those that are not free.
        model: `(band, sensor, sensor)`.
    """

    terms: tuple[Term, ...]
    gain: float
    information: Tensor
    covariance: Tensor
    places: tuple[Tensor, ...]
    model: Tensor

    @property
    def power(self) -> Tensor:
        """Model of the ratios of powers, `(band, sensor)`."""
        return self.model.diagonal(dim1=-2, dim2=-1).real

    def sd(self, term: int) -> tuple[Tensor, Tensor]:
        """Standard deviations of a term's local `(number, sensor)` and shared numbers; NaN where not free."""
        places, own = self.places[term], self.terms[term]
        variance = self.covariance.diagonal()
        sd = torch.where(places >= 0, variance[places.clamp(min=0)].clamp(min=0).sqrt(), math.nan)
        n = own.local.numel()
        return sd[:n].view_as(own.local), sd[n:]

    def sd_alone(self, term: int) -> Tensor:
        """The same of local numbers with all others held; what is told of products alone has such ones as well."""
        places, own = self.places[term][: self.terms[term].local.numel()], self.terms[term]
        sd = self.information.diagonal()[places.clamp(min=0)].clamp(min=_LEAST).rsqrt()
        return torch.where(places >= 0, sd, math.nan).view_as(own.local)


def fit(data: Ratios, terms: Sequence[Term], rounds: int = _ROUNDS) -> Fit:
    """Fisher scoring of all free numbers together, from where the terms stand."""
    terms = tuple(term.within() for term in terms)
    paired = bool((data.paired > 0).any()) and (
        any(isinstance(t, Common) for t in terms) or not (data.alike or all(t.acts != "add" for t in terms))
    )
    free = torch.cat([torch.cat([t.free.flatten(), torch.ones(len(t.shared), dtype=torch.bool)]) for t in terms])
    where = torch.where(free, free.cumsum(0) - 1, -1)
    model, derivatives = linearised(data, terms)
    best = _value(data, model, terms, paired)
    damping, information = 1e-3, torch.eye(len(free), dtype=torch.float64)
    for _ in range(rounds if math.isfinite(best) else 1):
        vector = torch.cat([_vector(t) for t in terms])
        reach = torch.cat([torch.cat([t.local_reach().flatten(), t.reach()]) for t in terms])
        precision = torch.cat([_precision(t) for t in terms])
        full, slope = _power_slopes(data, model, derivatives)
        if paired:
            beside = _wishart_slopes(*_correlated(model, derivatives), _correlations(data.observed), data.paired)
            full, slope = full + beside[0], slope + beside[1]
        slope = slope - precision * vector
        information = full + precision.diag()
        if not (math.isfinite(best) and bool(information.isfinite().all()) and bool(slope.isfinite().all())):
            break
        low, high = (torch.cat([_bounds(t)[k] for t in terms]) for k in (0, 1))
        # A number at its bound that wants to go beyond stays there.
        active = free & ~((vector <= low) & (slope < 0)) & ~((vector >= high) & (slope > 0))
        accepted, gain = False, 0.0
        while damping < 1e8:
            step = _solved(information, slope, active, damping).clamp(-reach, reach)
            trial = _with_numbers(terms, vector + step)
            value = _value(data, data_model(data, trial), trial, paired)
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
    sizes = [t.local.numel() + len(t.shared) for t in terms]
    if not math.isfinite(best) or not bool(information.isfinite().all()):  # no start to go on from
        return Fit(terms, -math.inf, information, torch.zeros_like(information), where.split(sizes), model)
    scale = information.diagonal().clamp(min=_LEAST).rsqrt()
    # A common source's phase is nobody's: what has no information has no spread.
    inverse = torch.linalg.pinv(information * scale[:, None] * scale, rtol=_NOTHING, hermitian=True)
    covariance = inverse * scale[:, None] * scale
    if paired:
        # Powers that a model makes coherent vary together: the scores' own covariance stands between (Godambe).
        more = _power_covariance(data, model, derivatives) - _power_slopes(data, model, derivatives)[0]
        covariance = covariance + covariance @ more[free][:, free] @ covariance
    gain = float(log_gain(data, model, paired=paired).sum())
    return Fit(terms, gain, information, covariance, where.split(sizes), model)


def _power_slopes(data: Ratios, model: Tensor, derivatives: Tensor) -> tuple[Tensor, Tensor]:
    """Information `(number, number)` and score `(number,)` of powers."""
    m = model.diagonal(dim1=-2, dim2=-1).real
    moved = (derivatives.diagonal(dim1=-2, dim2=-1).real / (m + FLOOR)).flatten(1)  # (number, band * sensor)
    score = (data.share * power_scores(data, m)).flatten()
    worth = (data.share * data.worth[:, None]).flatten()
    return (moved * worth) @ moved.mT, moved @ score


def _power_covariance(data: Ratios, model: Tensor, derivatives: Tensor) -> Tensor:
    """Covariance of the scores of powers, `(number, number)`: squared coherences of the model are correlations."""
    m = model.diagonal(dim1=-2, dim2=-1).real
    moved = data.share * derivatives.diagonal(dim1=-2, dim2=-1).real / (m + FLOOR)  # (number, band, sensor)
    alike = _correlations(model).abs().square() * data.worth[:, None, None]
    return torch.einsum("kbi,bij,lbj->kl", moved, alike, moved)


def _wishart_slopes(model: Tensor, derivatives: Tensor, observed: Tensor, worth: Tensor) -> tuple[Tensor, Tensor]:
    """The same of correlation matrices."""
    inverse = torch.linalg.inv_ex(model)[0]  # of one without an inverse no step is taken
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
    """What terms make of the reference's cross-spectra over its powers, `(band, sensor, sensor)`."""
    return _composed(data, *pieces(data, terms))


def pieces(data: Ratios, terms: Sequence[Term]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
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
    """The model of factors and densities `(..., sensor, place)`, and of common sources."""
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
    ground, parts = data.ground, pieces(data, terms)
    factor, added, filters, common = parts
    model = _composed(data, *parts)
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
            others = filters / value.clamp(min=1e-300)
            changed = _composed(data, factor, added, others * moved, common)
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


def _value(data: Ratios, model: Tensor, terms: Sequence[Term], paired: bool) -> float:
    return float(log_gain(data, model, paired=paired).sum()) - prior_cost(terms)


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
    free = torch.full_like(term.shared, math.inf)
    return (
        torch.cat([torch.full_like(term.local, term.lower).flatten(), -free]),
        torch.cat([torch.full_like(term.local, term.upper).flatten(), free]),
    )


def _vector(term: Term) -> Tensor:
    return torch.cat([term.local.flatten(), term.shared])


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


def exact(d: Tensor) -> Tensor:
    """Ordinates of a reference whose spectrum is known, for a recording's `(band,)`."""
    return torch.full_like(d, _EXACT)
