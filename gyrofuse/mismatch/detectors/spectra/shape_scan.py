"""A mean likelihood ratio over shapes of a difference, its size, and the sensors that have it.

Ratios of powers have normal scores `u`; a difference of log spectra `h` moves them by `h sqrt(w)`. Along
`t = h sqrt(w) / |h sqrt(w)|` each sensor has one number `z = t u`, normal with mean `a`. Over shapes, signs, sizes `a`
and shares `e` of the sensors that have it, the mean of

    prod_i (1 - e + e exp(a z_i - a^2 / 2))

has expectation one where nothing differs. The slowest ordinates, too few for normal scores, give their likelihood
ratio by the law of F.

Numbers of a model that was fitted to a record move all scores of a sensor together. Shapes are then weighed with
`x = V^-1 h sqrt(w)` for `a z - a^2/2` of `z = x u / |x|_V`, `a^2 = h sqrt(w) x`; with what of them lies outside the
parameters' tangent space, for components that the model lacks; and the parameters have a chi-square (`shape_errors`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple, cast

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.shape_errors import Errors, estimation_errors, parameters_p_value
from gyrofuse.mismatch.likelihoods.band_powers import Narrow, deep_base, narrow, slow
from gyrofuse.mismatch.likelihoods.components import oscillation
from gyrofuse.mismatch.likelihoods.filter_forms import filter_power, filter_strength
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.fitted_spectra import SpectralUncertainty
from gyrofuse.mismatch.stats.multiplicity import SHARES, e_values_by_share, p_value_from_e_value, sidak
from gyrofuse.noise.processes import AR1

_SIZES = (1.0, 1.6, 2.5, 4.0)
_CORNERS_PER_DECADE = 2
_FILTERS = (0.01, 0.04, 0.12, 0.35)  # corners, cycles per sample
_WIDTHS = (0.02, 0.06, 0.18)  # half width of a bump over its centre
_PLAIN = (0.1, 0.02, 0.1, 0.14)  # chances of white, blue, flicker noise and walks
_AR1S, _LEVELS, _FILTERED, _BUMPED = 0.16, 0.02, 0.16, 0.3
_WAYS = (0.6, 0.15, 0.25)  # up, down, either sensor by sensor
_LOWEST = 40.0  # bins: bumps below are colour
_COMMON = (0.12, 1.25)  # share of noise whose ratio exceeds one, and how it falls: drawn
_LOW = 6  # bands
_ROUNDS = 24
_LOOKS = 3  # at spectra beside a fitted model: beside its errors, outside of them, and at its parameters


class Shapes(NamedTuple):
    """What is looked for.

    Attributes:
        scores: By which they move scores, `(shape, sensor, band)`.
        slow: Logarithms of factors in the slowest bands, `(shape, sensor, band)`.
        log_chances: Of the shapes up, down, and either way sensor by sensor, `(3, shape)`.
    """

    scores: Tensor
    slow: Tensor
    log_chances: Tensor


class Scan(NamedTuple):
    """What was seen.

    Attributes:
        log_ratio: Of the mean over all.
        sensors: That have the likeliest.
        weight: Of the bands in it, `(band,)`; and whether it goes up.
        up: Whether powers are larger.
        bump: Centre and half width, cycles per sample, if it is one.
        looks: Of which it is the most surprising.
    """

    log_ratio: float
    sensors: tuple[int, ...]
    weight: Tensor
    up: bool
    peak: tuple[float, float] | None
    looks: int = 1

    @property
    def p_value(self) -> float:
        """That of a mean ratio; ratios of a few are more common than the law of large ones has it."""
        p = max(p_value_from_e_value(self.log_ratio), _COMMON[0] * math.exp(-_COMMON[1] * max(self.log_ratio, -1.0)))
        return p if self.looks == 1 else sidak(p, self.looks)


class Looks(NamedTuple):
    """Spectra against those of a model.

    Attributes:
        exact: As if its numbers were known.
        beside: Beside what they may be off.
        outside: What no numbers of its processes could make.
        parameters: p value of the parameters' chi-square.
    """

    exact: Scan
    beside: Scan
    outside: Scan
    parameters: float

    @property
    def p_value(self) -> float:
        """Of all that allows for what the numbers may be off."""
        looks = (self.beside.p_value, self.outside.p_value, self.parameters)
        return sidak(min(looks), _LOOKS)


def shape_test(comparison: Comparison) -> TestResult:
    """Smooth differences of power: coloured noise, levels, filters, modes, over all sensors that have them."""
    seen = scanned(comparison)
    if seen is None:
        return TestResult("shape", 1.0, "the simulation is too short to compare spectra with")
    frequency = narrow(comparison).frequency
    inside = frequency[seen.weight > 0.2 * seen.weight.max()]
    f = float((seen.weight * frequency.log()).sum().div(seen.weight.sum()).exp()) * comparison.info.rate
    return TestResult(
        "shape",
        shape_p_value(comparison),
        f"power is {'larger' if seen.up else 'smaller'} than the simulation's, most of all around {f:.3g} Hz, in "
        f"{comparison.info.named(seen.sensors, 'all sensors')}",
        sensors=seen.sensors,
        levels=tuple(sorted({level_of(float(x)) for x in inside})),
        frequency_hz=f,
    )


@derived
def scanned(comparison: Comparison) -> Scan | None:
    """The mean likelihood ratio of all shapes, and the likeliest; beside a fitted model's errors, if there are any."""
    looks = looked_at(comparison)
    if looks is not None:
        return min(looks.beside, looks.outside, key=lambda scan: scan.p_value)._replace(looks=_LOOKS)
    return _scan(comparison, _shapes(comparison, narrow(comparison))) if _enough(comparison) else None


@derived
def looked_at(comparison: Comparison) -> Looks | None:
    """Spectra against those of a model whose numbers may be off; None where there is no such model."""
    errors = estimation_errors(comparison)
    if errors is None or not _enough(comparison):
        return None
    shapes = _shapes(comparison, narrow(comparison))
    scans = (
        _scan(comparison, shapes),
        _scan(comparison, shapes, errors),
        _scan(comparison, shapes, errors, outside=True),
    )
    return Looks(*scans, parameters_p_value(comparison))


def shape_p_value(comparison: Comparison) -> float:
    """p value of all looks at shapes; 1 where there is nothing to compare."""
    looks, scan = looked_at(comparison), scanned(comparison)
    if looks is not None:
        return looks.p_value
    return 1.0 if scan is None else scan.p_value


def _enough(comparison: Comparison) -> bool:
    return float(narrow(comparison).worth.sum()) >= 10


def _scan(comparison: Comparison, looked_for: Shapes, errors: Errors | None = None, *, outside: bool = False) -> Scan:
    """Shapes weighed beside errors of the simulation's numbers, where given, or only by what lies outside of them."""
    data, below, weighed = narrow(comparison), slow(comparison), looked_for.scores
    scores = beside_levels(data.scores, _levels(comparison))
    if errors is not None:
        weighed = errors.outside(weighed) if outside else errors.beside(weighed)
        uncertainty = cast(SpectralUncertainty, comparison.reference.uncertainty)
        # The slowest ordinates are as far off as their parameters, and of these alone nothing lies outside.
        variance = uncertainty.variance(below.places.log().mean(-1).exp())
        below = below.beside(torch.full_like(variance, math.inf) if outside else variance)
    sizes = (looked_for.scores * weighed).sum(-1).clamp(min=0).sqrt()
    templates = weighed / weighed.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    z = independent(torch.einsum("hsb,sb->hs", templates, scores), templates, data, errors)
    apart = data.coherence[:_LOW].mean(0).sum(-1)  # powers of what sensors share go together
    up, down = (
        way * sizes * z - sizes.square() / 2 + below.log_ratios(way * looked_for.slow) / apart.clamp(min=1)
        for way in (1, -1)
    )
    ways = torch.stack([up, down, torch.logaddexp(up, down) - math.log(2)])  # (way, shape, sensor)
    log_ratios = e_values_by_share(ways.movedim(-1, 0)) + looked_for.log_chances  # (share, way, shape)
    share, way, shape = (int(i) for i in torch.unravel_index(log_ratios.argmax(), log_ratios.shape))
    own = torch.maximum(up, down)[shape] if way == 2 else ways[way, shape]
    sensors = tuple(int(i) for i in (own > math.log(1 / SHARES[share] - 1)).nonzero()[:, 0]) or (int(own.argmax()),)
    weight = templates[shape, list(sensors)].square().mean(0)
    rises = float((up - down)[shape, list(sensors)].sum()) > 0
    peaks = list(_bump_places(comparison.n_samples))
    n_shapes = len(templates) // len(_SIZES)
    place = shape % n_shapes - (n_shapes - len(peaks))  # bumps come last
    mean = float(log_ratios.flatten().logsumexp(0)) - math.log(len(SHARES))
    return Scan(mean, sensors, weight, rises, peaks[place] if place >= 0 else None)


def independent(z: Tensor, templates: Tensor, data: Narrow, errors: Errors | None = None) -> Tensor:
    """Numbers of sensors `(shape, sensor)`, apart and of variance one: powers of what sensors share go together."""
    cover = torch.einsum("hib,hjb,bij->hij", templates, templates, data.coherence)
    beside = torch.einsum("hib,hib,b->hi", templates[..., 1:], templates[..., :-1], data.together)
    variance = (1 + 2 * beside).clamp(min=0.5)
    cover = cover - torch.diag_embed(cover.diagonal(dim1=-1, dim2=-2))
    if errors is not None:
        alone, moved = variance, errors.covariance(templates)
        variance = variance + moved.diagonal(dim1=-1, dim2=-2)
        moved = moved - torch.diag_embed(moved.diagonal(dim1=-1, dim2=-2))
        ratio, size = (alone / variance).sqrt(), variance.rsqrt()
        cover = cover * ratio[..., :, None] * ratio[..., None, :] + moved * size[..., :, None] * size[..., None, :]
    values, vectors = torch.linalg.eigh(cover + torch.eye(z.shape[-1], dtype=z.dtype))
    root = (vectors * values.clamp(min=0.05).rsqrt()[..., None, :]) @ vectors.mT
    return (root @ (z / variance.sqrt())[..., None])[..., 0]


def _shapes(comparison: Comparison, data: Narrow) -> Shapes:
    """Templates of all shapes, with their chances."""
    n, below = comparison.n_samples, slow(comparison)
    places = torch.cat([below.places, data.places])
    ground = deep_base(comparison).spectrum(places.flatten()).unflatten(-1, places.shape)  # (sensor, band, place)
    worth = torch.cat([below.d * below.s / (below.d + below.s), data.worth])
    colour = torch.stack([(density / ground).mean(-1) for density in _densities(n, places)])
    colour = torch.cat([colour, torch.ones_like(colour[:1])])
    filters = torch.stack(
        [-filter_power("sampled", filter_strength("sampled", torch.tensor(c)), places).log() for c in _FILTERS]
    )
    filters = filters.mean(-1)[:, None].expand(-1, len(ground), -1)
    peaks, chances = _bumps(n, places, ground)
    count = torch.tensor([len(colour), len(filters), len(peaks)])
    log_chances = torch.full((3, int(count.sum())), -math.inf, dtype=torch.float64)
    of_colour, of_filters, of_bumps = log_chances.split(count.tolist(), -1)
    n_ar1s = len(colour) - len(_PLAIN) - 1
    own = torch.tensor([*_PLAIN, *([_AR1S / n_ar1s] * n_ar1s), _LEVELS], dtype=torch.float64)
    of_colour[:] = (torch.tensor(_WAYS, dtype=torch.float64)[:, None] * own).log()
    of_filters[1] = math.log(_FILTERED / len(filters))
    of_bumps[0] = (_BUMPED * chances).log()
    weak = torch.cat([filters, peaks])
    length = (worth * weak.square()).sum(-1, keepdim=True).sqrt()
    moved = torch.cat([torch.cat([_grown(colour, worth, size), weak * (size / length)]) for size in _SIZES])
    shown = moved[..., len(below.d) :] * data.worth.sqrt()
    return Shapes(
        beside_levels(shown, _levels(comparison)),
        moved[..., : len(below.d)],
        log_chances.repeat(1, len(_SIZES)) - math.log(len(_SIZES)),
    )


@derived
def _levels(comparison: Comparison) -> Tensor:
    """By what a sd of the levels that vary by themselves moves scores, `(sensor, band, level)`.

    Fast and slow noise have levels of their own, which may go together or not.
    """
    data, base = narrow(comparison), deep_base(comparison)
    fast = (base.fast().spectrum(data.frequency) / base.spectrum(data.frequency)).clamp(max=1)
    sd = torch.as_tensor(comparison.reference.level_variance, dtype=torch.float64).sqrt().expand(len(fast))
    return torch.stack([fast, 1 - fast], -1) * data.worth.sqrt()[:, None] * sd[:, None, None]


def beside_levels(values: Tensor, levels: Tensor) -> Tensor:
    """Scores whose levels vary by themselves, as independent ones of variance one.

    Args:
        values: `(..., sensor, band)`, of covariance `V = 1 + U U'`.
        levels: `U`, `(sensor, band, level)`.

    Returns:
        `V^(-1/2)` times them.
    """
    directions, size, _ = torch.linalg.svd(levels, full_matrices=False)
    along = torch.einsum("...sb,sbl->...sl", values, directions) * (1 - (1 + size.square()).rsqrt())
    return values - torch.einsum("sbl,...sl->...sb", directions, along)


def _densities(n_samples: int, f: Tensor) -> Tensor:
    """White, blue, flicker, walk and AR1s of corners two a decade, `(shape, 1, band, place)`."""
    sine = torch.sin(math.pi * f).square()
    decades = math.log10(0.3 * n_samples / 3)
    corners = 0.3 * 10 ** (-torch.arange(int(decades * _CORNERS_PER_DECADE) + 1) / _CORNERS_PER_DECADE)
    phi = torch.exp(-2 * math.pi * corners.to(f.dtype))[:, None, None]
    coloured = AR1._spectrum(f, phi, (1 - phi).square())
    return torch.cat([torch.stack([torch.ones_like(f), sine, 1 / f, 1 / sine]), coloured])[:, None]


def _grown(relative: Tensor, worth: Tensor, size: float) -> Tensor:
    """Logarithms `log(1 + c x)` of what comes on top, of a length, `(shape, sensor, band)`."""
    scaled = relative / relative.amax(-1, keepdim=True).clamp(min=1e-300)
    low = torch.full_like(relative[..., :1], -30.0)
    high = -low
    for _ in range(_ROUNDS):
        middle = (low + high) / 2
        short = (worth * torch.log1p(middle.exp() * scaled).square()).sum(-1, keepdim=True) < size**2
        low, high = torch.where(short, middle, low), torch.where(short, high, middle)
    return torch.log1p(low.exp() * scaled)


def _bump_places(n_samples: int) -> Iterator[tuple[float, float]]:
    """Centres half a width apart, and half widths."""
    for share in _WIDTHS:
        step = math.log1p(share)
        for k in range(int(math.log(0.49 * n_samples / _LOWEST) / step)):
            centre = 0.49 * math.exp(-step * k)
            yield centre, share * centre


def _bumps(n_samples: int, places: Tensor, ground: Tensor) -> tuple[Tensor, Tensor]:
    """Bumps `(shape, sensor, band)` and their chances: widths have equal ones."""
    centre, width = torch.tensor(list(_bump_places(n_samples)), dtype=torch.float64).mT[:, :, None, None]
    density = oscillation(places, centre, width)
    _, kind, count = (width / centre).flatten().round(decimals=9).unique(return_inverse=True, return_counts=True)
    return (density[:, None] / ground).mean(-1), 1 / count[kind].to(torch.float64) / len(_WIDTHS)
