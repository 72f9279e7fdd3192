"""Powers of both sides from the slowest ordinate up, in narrow bands, as normal scores of their ratios."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum, fit_base
from gyrofuse.mismatch.signals.psd import Bands, bands, degrees_of_freedom
from gyrofuse.mismatch.signals.records import Records

Groups = tuple[tuple[int, ...], ...]  # cosine ordinates of the slowest bands
SLOW: Groups = ((1, 2), (3, 4), (5, 6, 7, 8))
_FIRST_BIN = 5  # tapers reach two bins down
_PER_OCTAVE = 24
_WIDTH = 5  # bins
N_PLACES = 8  # frequencies that stand for a band
N_SLOW = 3 * N_JUDGED - 1  # cosine ordinates of a record that its blocks do not show
_CLEAN = 8  # bins of short records, below which they hold what leaks from below


class Narrow(NamedTuple):
    """Both sides in narrow bands.

    Attributes:
        scores: Of the ratio of powers, normal where nothing differs, `(sensor, band)`; 0 where nothing is known.
        worth: `d s / (d + s)`, `(band,)`.
        together: Correlation of a band's score with the next one's, `(band - 1,)`.
        coherence: Squared coherences of both sides, without what chance gives, `(band, sensor, sensor)`.
        places: Frequencies whose mean stands for a band, cycles per sample, `(band, place)`.
    """

    scores: Tensor
    worth: Tensor
    together: Tensor
    coherence: Tensor
    places: Tensor

    @property
    def frequency(self) -> Tensor:
        """Of the bands, cycles per sample."""
        return self.places.log().mean(-1).exp()


class Slow(NamedTuple):
    """Both sides below the narrow bands, in few ordinates.

    Attributes:
        ratio: Of powers over the simulation's noise, `(sensor, band)`, F distributed where nothing differs.
        d, s: Complex ordinates of both, `(band,)`; `s` is 0 where nothing is simulated. Of a model whose numbers may be
            off `s` is less, `(sensor, band)`.
        places: As of narrow bands.
    """

    ratio: Tensor
    d: Tensor
    s: Tensor
    places: Tensor

    def beside(self, variance: Tensor) -> Slow:
        """Where log spectra of the simulation may be off, with a variance `(sensor, band)`."""
        return self._replace(s=torch.where(self.s > 0, 1 / (1 / self.s + variance), 0.0))

    def log_ratios(self, log_factors: Tensor) -> Tensor:
        """Log likelihood ratio of powers that are larger by factors `(..., sensor, band)`, `(..., sensor)`."""
        odds = self.d * self.ratio / self.s.clamp(min=1e-9)
        gain = (self.d + self.s) * (odds.log1p() - (odds * torch.exp(-log_factors)).log1p()) - self.d * log_factors
        return torch.where(self.s > 0, gain, 0.0).sum(-1)


@dataclass(frozen=True, eq=False)
class DeepBands(Bands):
    """Bands of bins, and below and above them those of cosine ordinates of a record.

    Attributes:
        deep, beyond: Places of the latter.
    """

    deep: Tensor
    beyond: Tensor

    @classmethod
    def of(cls, bins: Bands, record: int, groups: Groups = SLOW, beyond: Groups = ()) -> DeepBands:
        """Bands of bins between groups of ordinates of a record."""
        below, above = _places(groups, record), _places(beyond, record)
        frequency = torch.cat([below.log().mean(-1).exp(), bins.frequency, above.log().mean(-1).exp()])
        dof = torch.cat([_dof(groups), bins.dof, _dof(beyond)])
        return cls(bins.n_samples, bins.edges, frequency, dof, below.flatten(), above.flatten())

    @property
    def places(self) -> Tensor:
        return torch.cat([self.deep, super().places, self.beyond])


def _places(groups: Groups, record: int) -> Tensor:
    """Frequencies whose mean stands for a group of ordinates, cycles per sample, `(group, place)`."""
    share = torch.arange(N_PLACES, dtype=torch.float64).add(0.5) / N_PLACES
    ends = torch.tensor([(g[0] - 0.5, g[-1] + 0.5) for g in groups], dtype=torch.float64).view(-1, 2)
    return (ends[:, :1] + ends.diff() * share) / (2 * record)


class Deep(NamedTuple):
    """Both sides in bands that go down to the slowest ordinates.

    Attributes:
        bands: They.
        recorded, simulated: Cross-spectral matrices, `(band, sensor, sensor)`.
        d, s: Complex ordinates of both, `(band,)`.
    """

    bands: DeepBands
    observed: Tensor
    reference: Tensor
    d: Tensor
    s: Tensor


def deep(comparison: Comparison, observed: Records, reference: Records, groups: Groups = SLOW) -> Deep:
    """Two sides in bands of bins, with groups of ordinates of the case's whole records in front."""
    return Deep(
        DeepBands.of(reference.bands, comparison.n_samples, groups),
        torch.cat([_slow_spectra(comparison.observed, groups), observed.spectra]),
        torch.cat([_slow_spectra(comparison.reference, groups), reference.spectra]),
        torch.cat([_dof(groups), observed.dof]),
        torch.cat([_simulated_dof(comparison.reference, groups), reference.dof]),
    )


@derived
def deep_base(comparison: Comparison) -> NoiseSpectrum:
    """The simulation's noise, as its slowest ordinates have it as well."""
    both = deep(comparison, *_sides(comparison))
    return fit_base(both.reference.diagonal(dim1=-2, dim2=-1).real.mT, both.bands, comparison.n_samples, both.s)


@derived
def _sides(comparison: Comparison) -> tuple[Records, Records]:
    """Both sides in narrow bands."""
    scale = comparison.reference.signal.shape[-1] / comparison.n_samples
    fine = narrow_bands(comparison.n_samples, least=math.ceil(_WIDTH / scale))
    return comparison.observed.in_bands(fine), comparison.reference.in_bands(fine)


@derived
def narrow(comparison: Comparison) -> Narrow:
    """Recording and simulation in narrow bands."""
    observed, reference = _sides(comparison)
    fine, scale = observed.bands, comparison.reference.signal.shape[-1] / comparison.n_samples
    clean = scale == 1 or torch.tensor(fine.edges[:-1]) * scale >= _CLEAN
    d, s = fine.dof, reference.dof * clean * (fine.frequency >= comparison.reference.slowest_seen)
    total = (d + reference.dof)[:, None, None]
    both = (d[:, None, None] * observed.coherence + reference.dof[:, None, None] * reference.coherence) / total
    return Narrow(
        normal_scores(observed.power, reference.power, d, s),
        d * s / (d + s),
        neighbours(fine.edges),
        ((both.abs().square() - 1 / total) / (1 - 1 / total)).clamp(min=0),
        fine.places.unflatten(0, (len(d), -1)),
    )


@derived
def slow(comparison: Comparison) -> Slow:
    """Recording and simulation in the slowest bands."""
    last = SLOW[-1][-1]
    noise = deep_base(comparison).spectrum(torch.arange(1, last + 1, dtype=torch.float64) / (2 * comparison.n_samples))
    one, other = (
        _means(slow_ordinates(side)[..., :last].square().mean(0) / noise, SLOW)
        for side in (comparison.observed, comparison.reference)
    )
    places = DeepBands.of(comparison.bands, comparison.n_samples).deep.unflatten(0, (-1, N_PLACES))
    seen = places.amin(-1) >= comparison.reference.slowest_seen
    return Slow(one / other, _dof(SLOW), _simulated_dof(comparison.reference, SLOW) * seen, places)


@derived
def slow_ordinates(side: Records) -> Tensor:
    """Cosine ordinates that blocks which are judged do not show, `(record, sensor, ordinate)`, from the first."""
    records = side.steady
    return cosine_ordinates(records.flatten(0, 1))[:, 1 : N_SLOW + 1].clone().unflatten(0, records.shape[:2])


def _slow_spectra(side: Records, groups: Groups) -> Tensor:
    """Cross-spectral matrices `(band, sensor, sensor)` of groups of ordinates."""
    y = slow_ordinates(side)[..., : groups[-1][-1]]
    return _means((y[:, :, None] * y[:, None]).mean(0), groups).permute(2, 0, 1).to(torch.complex128)


def _means(values: Tensor, groups: Groups) -> Tensor:
    """Means of values `(..., ordinate)` over groups."""
    return torch.stack([values[..., [k - 1 for k in group]].mean(-1) for group in groups], -1)


def _dof(groups: Groups) -> Tensor:
    """Complex ordinates that groups of a record are worth."""
    return torch.tensor([len(group) / 2 for group in groups], dtype=torch.float64)


def _simulated_dof(side: Records, groups: Groups) -> Tensor:
    """Of all records of a side; none of shorter ones."""
    return _dof(groups) * side.n_records * (side.signal.shape[-1] == side.bands.n_samples)


@functools.lru_cache(maxsize=8)
def narrow_bands(n_samples: int, per_octave: int = _PER_OCTAVE, least: int = _WIDTH) -> Bands:
    """A 24th of an octave wide, and no narrower than tapers are, of the shorter records if there are any."""
    last = bands(n_samples).edges[-1]
    edges = [_FIRST_BIN]
    while (end := max(edges[-1] + least, math.ceil(edges[-1] * 2 ** (1 / per_octave)))) + least <= last:
        edges.append(end)
    edges.append(last)
    lower, upper = (torch.tensor(ends, dtype=torch.float64) for ends in (edges[:-1], edges[1:]))
    dof = torch.tensor([degrees_of_freedom(int(w)) for w in upper - lower], dtype=torch.float64)
    return Bands(n_samples, tuple(edges), (lower * (upper - 1)).sqrt() / n_samples, dof)


@functools.lru_cache(maxsize=8)
def neighbours(edges: tuple[int, ...]) -> Tensor:
    """Correlations of powers of neighbouring bands: from what both together are worth."""
    widths = [b - a for a, b in itertools.pairwise(edges)]

    def one(a: int, b: int) -> float:
        da, db, both = degrees_of_freedom(a), degrees_of_freedom(b), degrees_of_freedom(a + b)
        return ((a + b) ** 2 / both - a**2 / da - b**2 / db) / (2 * a * b) * math.sqrt(da * db)

    return torch.tensor([one(a, b) for a, b in itertools.pairwise(widths)], dtype=torch.float64)


def normal_scores(one: Tensor, other: Tensor, d: Tensor, s: Tensor) -> Tensor:
    """Of ratios of powers `(sensor, band)`: F distributed where nothing differs; 0 where there is nothing."""
    law = stats.f(2 * d.numpy(), 2 * s.clamp(min=1e-9).numpy())
    ratio = (one / other).numpy()
    above, below = torch.from_numpy(law.sf(ratio)), torch.from_numpy(law.cdf(ratio))
    size = torch.special.ndtri(torch.minimum(above, below).clamp(1e-300, 0.5)).abs()
    return torch.where(s > 0, torch.where(above < below, size, -size), 0.0).nan_to_num(nan=0.0)


def slow_gains(comparison: Comparison, spectra: Callable[[Tensor, Tensor], Tensor], fold: int) -> Tensor:
    """Gain in log score of the slow ordinates that a fold holds out, dealt to its blocks, `(block,)`, nats.

    Args:
        comparison: Recording and simulation without the mechanism.
        spectra: What the mechanism makes of the simulation's cross-spectra.
        fold: Which one.
    """
    gains = torch.zeros(N_JUDGED // N_FOLDS, dtype=torch.float64)
    if comparison.reference.signal.shape[-1] < comparison.n_samples:
        return gains
    k = torch.arange(1 + fold, N_SLOW + 1, N_FOLDS)
    y = slow_ordinates(comparison.observed)[0, :, k - 1].mT  # (ordinate, sensor)
    f = k.to(y.dtype) / (2 * comparison.n_samples)
    plain = torch.diag_embed(deep_base(comparison).spectrum(f).mT).to(torch.complex128)
    gain = _log_score(y, spectra(plain, f).real) - _log_score(y, plain.real)
    return gains.index_add(0, torch.arange(len(k)) % len(gains), gain)


def _log_score(y: Tensor, matrices: Tensor) -> Tensor:
    """Log likelihood of ordinates `(ordinate, sensor)` of cross-spectra."""
    root = torch.linalg.cholesky(matrices)
    white = torch.linalg.solve_triangular(root, y[..., None], upper=False)
    return -white.square().sum((-1, -2)) / 2 - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
