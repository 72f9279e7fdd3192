"""Cross-spectra of a recording and its simulation, additive over the blocks that are held out.

Both sides are cut into blocks of one length, so that resolution and leakage are the same. Below the lowest band of a
block stand the DCT-II ordinates of whole records, dealt to the blocks, and so they do next to half the rate, where the
edges of filters are steeper than blocks can show: there under a light taper, as the kink that either end of a record
would be to them is all that stop bands have, the same in all ordinates. The whole recording, the blocks that a fold
keeps and those that it holds out are the same sums over another set of blocks; the reference is held out with them, as
its own chance would otherwise be in what is fitted and in what judges the fit.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.likelihoods.band_powers import N_PLACES, DeepBands, Groups
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED
from gyrofuse.mismatch.signals.psd import Bands, cross_spectra, degrees_of_freedom, light_taper, taper_window
from gyrofuse.mismatch.signals.records import Records

# Bins of a block: the lowest band. The four tapers reach two bins down, and below one bin what is slower leaks in.
_FIRST_BIN = 4
# Bins of a band at least: the powers of neighbouring bands then correlate by 0.12 (white noise, 6000 blocks).
_NARROWEST = 6
_PER_OCTAVE = 6  # bands: a third of an octave holds two, as narrow as smooth spectra need
_WIDEST = 0.02  # cycles per sample: a band where filters cut off is to show their slope
_SHARE_OF_END = 3  # bands are a third of the distance to half the rate at most: digital filters have zeros there
_FEWEST_AT_END = 24  # ordinates of a whole record in a band there, which have no tapers
_PER_BIN = 4  # frequencies in a bin at which the window of the tapers is laid out
_SLOW_PER_OCTAVE = 4  # groups of ordinates: slow noise has no structure finer than that


@dataclass(frozen=True, eq=False)
class BlockBands(DeepBands):
    """Bands of blocks, which show in each what their tapers let in from the others as well.

    Next to a filter's edge, in its stop band and at its zeros that is most of the power.

    Attributes:
        seen: What each place adds to a band, `(place, band)`; its columns add up to one.
    """

    seen: Tensor

    @classmethod
    def of_blocks(cls, bins: Bands, record: int, below: Groups, beyond: Groups) -> BlockBands:
        """Bands of the bins of blocks between groups of ordinates of a record."""
        own = DeepBands.of(bins, record, below, beyond)
        seen = torch.block_diag(*[torch.full((N_PLACES, 1), 1 / N_PLACES, dtype=torch.float64)] * len(own.dof))
        first = len(below)
        seen[:, first : first + len(bins.dof)] = _let_in(bins, own.places).mT
        return cls(own.n_samples, own.edges, own.frequency, own.dof, own.deep, own.beyond, seen)

    def mean_of(self, density: Tensor) -> Tensor:
        return density @ self.seen


class Spectra(NamedTuple):
    """Sums of cross-products of complex ordinates, and how many there are.

    Attributes:
        products: `(part, band, sensor, sensor)`, complex; a part is a block of the recording, or a fold's of the
            reference.
        dof: Independent complex ordinates, `(part, band)`.
    """

    products: Tensor
    dof: Tensor

    def mean(self, parts: Tensor) -> tuple[Tensor, Tensor]:
        """Cross-spectral matrices `(band, sensor, sensor)` and ordinates `(band,)` of some parts `(part,)`."""
        dof = self.dof[parts].sum(0)
        return self.products[parts].sum(0) / dof.clamp(min=1e-300)[:, None, None], dof


class Compared(NamedTuple):
    """A recording and its reference in the same bands.

    Attributes:
        bands: They, below and above them groups of ordinates of the whole record.
        observed: By block, 32 parts.
        reference: By the fold that holds it out, 4 parts.
    """

    bands: DeepBands
    observed: Spectra
    reference: Spectra


@derived
def block_spectra(comparison: Comparison) -> Compared:
    """Both sides of a case."""
    observed, reference = (
        _of_side(comparison.observed, comparison.n_samples),
        _of_side(comparison.reference, comparison.n_samples),
    )
    folds = torch.arange(len(observed.dof)) % N_FOLDS
    parts = [(reference.products[folds == k].sum(0), reference.dof[folds == k].sum(0)) for k in range(N_FOLDS)]
    return Compared(
        compared_bands(comparison.n_samples),
        observed,
        Spectra(torch.stack([p for p, _ in parts]), torch.stack([d for _, d in parts])),
    )


@functools.lru_cache(maxsize=8)
def block_bands(length: int) -> Bands:
    """Bands of a block of so many samples, up to where they would be wider than half the rate is near."""
    last = length // 2 - _SHARE_OF_END * _NARROWEST
    edges = [_FIRST_BIN]
    while last - edges[-1] >= 2 * _NARROWEST:
        a = edges[-1]
        wide = min(a * (2 ** (1 / _PER_OCTAVE) - 1), _WIDEST * length, (length / 2 - a) / _SHARE_OF_END)
        edges.append(a + max(round(wide), _NARROWEST))
    edges.append(last)
    lower, upper = (torch.tensor(ends, dtype=torch.float64) for ends in (edges[:-1], edges[1:]))
    dof = torch.tensor([degrees_of_freedom(b - a) for a, b in itertools.pairwise(edges)], dtype=torch.float64)
    return Bands(length, tuple(edges), (lower * (upper - 1)).sqrt() / length, dof)


@functools.lru_cache(maxsize=1)
def slow_groups() -> Groups:
    """DCT-II ordinates of a record below its blocks' lowest band: single at the bottom, then a quarter octave each."""
    end = round(2 * N_JUDGED * (_FIRST_BIN - 0.5))
    edges = [1]
    while edges[-1] < end:
        edges.append(min(max(edges[-1] + 1, round(edges[-1] * 2 ** (1 / _SLOW_PER_OCTAVE))), end))
    return tuple(tuple(range(a, b)) for a, b in itertools.pairwise(edges))


@functools.lru_cache(maxsize=8)
def fast_groups(n_samples: int) -> Groups:
    """DCT-II ordinates of a record above its blocks' highest band, each a third of the distance to half the rate."""
    length = n_samples // N_JUDGED
    edges = [round(2 * n_samples * (block_bands(length).edges[-1] - 0.5) / length)]
    while n_samples - edges[-1] >= 2 * _FEWEST_AT_END:
        edges.append(edges[-1] + max((n_samples - edges[-1]) // _SHARE_OF_END, _FEWEST_AT_END))
    edges[-1] = n_samples
    return tuple(tuple(range(a, b)) for a, b in itertools.pairwise(edges))


@functools.lru_cache(maxsize=8)
def compared_bands(n_samples: int) -> BlockBands:
    """Bands in which recordings of so many samples are compared."""
    bins = block_bands(n_samples // N_JUDGED)
    return BlockBands.of_blocks(bins, n_samples, slow_groups(), fast_groups(n_samples))


def _let_in(bins: Bands, places: Tensor) -> Tensor:
    """What each place adds to the bands of blocks, `(band, place)`, by the window of their tapers.

    A place stands for all frequencies that are nearer to it than to another one. Those next to zero are left out, for a
    block's mean is taken off.
    """
    n = bins.n_samples
    window = torch.fft.rfft(taper_window(n, _PER_BIN))
    inside = torch.zeros(len(bins.dof), _PER_BIN * n, dtype=torch.float64)
    for band, (first, end) in enumerate(itertools.pairwise(bins.edges)):
        inside[band, _PER_BIN * first : _PER_BIN * end : _PER_BIN] = 1.0
    around = torch.fft.irfft(torch.fft.rfft(inside) * window, n=_PER_BIN * n)
    half = _PER_BIN * n // 2
    weights = around[:, : half + 1] + torch.nn.functional.pad(around[:, half + 1 :].flip(-1), (1, 1))
    frequency = torch.arange(half + 1, dtype=torch.float64) / (_PER_BIN * n)
    weights = weights * (frequency >= 0.5 / n)
    nearest = torch.bucketize(frequency, (places[1:] + places[:-1]) / 2)
    shares = torch.zeros(len(weights), len(places), dtype=torch.float64).index_add_(1, nearest, weights)
    return shares / shares.sum(-1, keepdim=True)


def _of_side(side: Records, n_samples: int) -> Spectra:
    """A side by the 32 blocks that its samples, or the place of its ordinates, belong to."""
    noise = side.steady
    length, (n_records, p, n) = n_samples // N_JUDGED, noise.shape
    bands, below, beyond = block_bands(length), slow_groups(), fast_groups(n_samples)
    first, end = len(below), len(below) + len(bands.dof)
    products = torch.zeros(N_JUDGED, end + len(beyond), p, p, dtype=torch.complex128)
    dof = torch.zeros(N_JUDGED, end + len(beyond), dtype=torch.float64)
    for record in noise:
        blocks = record[:, : n // length * length].unflatten(-1, (-1, length)).movedim(1, 0)
        place = torch.arange(len(blocks)) % N_JUDGED
        products[:, first:end].index_add_(0, place, cross_spectra(blocks, bands) * bands.dof[:, None, None])
        dof[:, first:end].index_add_(0, place, bands.dof.expand(len(blocks), -1))
        taper = light_taper(n) * math.sqrt(n)
        tapered = (record - record.mean(-1, keepdim=True)) * taper
        for start, groups, seen, worth in (
            (0, below, record, 0.5),  # a real ordinate is half a complex one
            (end, beyond, tapered, 0.5 / float(taper.pow(4).mean())),
        ):
            # A record of another length has its ordinates at other frequencies.
            edges = torch.tensor([g[0] - 0.5 for g in groups] + [groups[-1][-1] + 0.5], dtype=torch.float64)
            lowest, highest = (float(edge) * n / n_samples for edge in (edges[0], edges[-1]))
            k = torch.arange(max(math.ceil(lowest), 1), min(math.floor(highest) + 1, n))
            band = torch.bucketize(k * (n_samples / n), edges, right=True) - 1
            y = cosine_ordinates(seen)[:, k].mT
            at, inside = (k % N_JUDGED)[band >= 0], band >= 0
            cross = (y[:, :, None] * y[:, None, :])[inside].to(products.dtype) * worth
            products.index_put_((at, start + band[inside]), cross, accumulate=True)
            dof.index_put_((at, start + band[inside]), torch.full((len(at),), worth).to(dof), accumulate=True)
    told = side.n_records / n_records  # less than it shows, where a model was estimated from fewer samples
    return Spectra(products * told, dof * told)
