"""Cross-spectra of a recording and of its reference in the same bands: the data of every likelihood of spectra.

Both sides are cut into blocks of one length, so that resolution and leakage are the same. Below the lowest band of a
block stand the DCT-II ordinates of whole records, dealt to the blocks. So they do next to half the rate, where the
edges of filters are steeper than blocks resolve: there under a light taper, since the step from a record's last sample
to its first would otherwise be all the power of a stop band. The whole recording, the blocks that a fold keeps and
those that it holds out are the same sums over another set of blocks. The reference is held out with them: its chance
would otherwise be both in what is fitted and in what judges the fit.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.decisions import CERTAIN
from gyrofuse.mismatch.likelihoods.spectra.coherence import smooth_coherence
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios, exact
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum, fit_base, let_in
from gyrofuse.mismatch.signals.psd import (
    N_NODES,
    Bands,
    cross_spectra,
    degrees_of_freedom,
    light_taper,
    narrow_bands,
    taper_window,
)
from gyrofuse.mismatch.signals.records import Records

Groups = tuple[tuple[int, ...], ...]  # cosine ordinates of a record, by the band that they are in

# Bins of a block: the lowest band. The four tapers reach two bins down, and below one bin slower noise leaks in.
_FIRST_BIN = 4
# Bins of a band at least: the powers of neighbouring bands then correlate by 0.12 (white noise, 6000 blocks).
_NARROWEST = 6
_CHANGED = 0.05  # log power: a filter of another form than the recording's leaves errors where it changed more


@dataclass(frozen=True, eq=False)
class BlockBands(Bands):
    """Bands of a block's bins, and below and above them groups of cosine ordinates of a whole record.

    Next to a filter's edge, in its stop band and at its zeros most of a band's power leaks in from other bands.

    Attributes:
        below, beyond: Frequencies whose mean stands for a group of ordinates, `(group, frequency)`.
        response: What each frequency adds to a band, `(frequency, band)`; its columns add up to one.
    """

    below: Tensor
    beyond: Tensor
    response: Tensor

    @classmethod
    def of(cls, bins: Bands, n_samples: int, below: Groups, beyond: Groups) -> BlockBands:
        """Bands between groups of ordinates.

        Args:
            bins: Bands of a block.
            n_samples: Length of the whole record.
            below, beyond: Groups of its ordinates.
        """
        low, high = _nodes(below, n_samples), _nodes(beyond, n_samples)
        frequency = torch.cat([low.log().mean(-1).exp(), bins.frequency, high.log().mean(-1).exp()])
        counts = [torch.tensor([len(group) / 2 for group in groups], dtype=torch.float64) for groups in (below, beyond)]
        dof = torch.cat([counts[0], bins.dof, counts[1]])
        own = torch.block_diag(*[torch.full((N_NODES, 1), 1 / N_NODES, dtype=torch.float64)] * len(dof))
        bands = cls(bins.n_samples, bins.edges, frequency, dof, low, high, own)
        first = len(below)
        own[:, first : first + len(bins.dof)] = _tapers_response(bins, bands.nodes).mT
        return bands

    @property
    def nodes(self) -> Tensor:
        return torch.cat([self.below.flatten(), super().nodes, self.beyond.flatten()])

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        nodes = self.nodes.unflatten(-1, (-1, N_NODES))
        beside = (nodes[:, 1] - nodes[:, 0]) / 2
        return nodes[:, 0] - beside, nodes[:, -1] + beside

    def mean_of(self, density: Tensor) -> Tensor:
        return density @ self.response


def _nodes(groups: Groups, n_samples: int) -> Tensor:
    """Frequencies whose mean stands for a group of ordinates, cycles per sample, `(group, frequency)`."""
    share = torch.arange(N_NODES, dtype=torch.float64).add(0.5) / N_NODES
    ends = torch.tensor([(g[0] - 0.5, g[-1] + 0.5) for g in groups], dtype=torch.float64).view(-1, 2)
    return (ends[:, :1] + ends.diff() * share) / (2 * n_samples)


class Spectra(NamedTuple):
    """Sums of cross-products of complex ordinates, and how many there are.

    Attributes:
        products: Sums, `(part, band, sensor, sensor)`, complex; a part is a block of the recording, or a fold of the
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
        bands: Bands of both.
        observed: Spectra of the recording by block, 32 parts.
        reference: Spectra of the reference by the fold that holds them out, 4 parts.
        steady: Share of the ordinates that powers are known from where the reference's come and go, `(band,)`.
    """

    bands: BlockBands
    observed: Spectra
    reference: Spectra
    steady: Tensor


@derived
def block_spectra(comparison: Comparison) -> Compared:
    """Cross-spectra of both sides of a comparison."""
    observed, reference = (_spectra(side, comparison.n_samples) for side in (comparison.observed, comparison.reference))
    folds = Spectra(*(part.unflatten(0, (-1, N_FOLDS)).sum(0) for part in reference))
    bands = compared_bands(comparison.n_samples)
    return Compared(bands, observed, folds, comparison.reference.steady_shares(bands))


@derived
def reference_noise(comparison: Comparison) -> NoiseSpectrum:
    """Noise of the reference as a sum of simple spectra, down to the slowest ordinates."""
    both = block_spectra(comparison)
    matrices, s = both.reference.mean(torch.ones(N_FOLDS, dtype=torch.bool))
    return fit_base(matrices.diagonal(dim1=-2, dim2=-1).real.mT, both.bands, comparison.n_samples, s)


@derived
def analog_noise(comparison: Comparison) -> NoiseSpectrum:
    """The same before the converter."""
    base = reference_noise(comparison)
    if comparison.rounding is None:
        return base
    most = 0.999  # of the white noise
    white = base.coefficients[:, 0] - comparison.rounding.minimum(most * base.coefficients[:, 0])
    return replace(base, coefficients=torch.cat([white[:, None], base.coefficients[:, 1:]], 1))


def _ground(comparison: Comparison) -> Ground:
    """The simulation's noise before the converter, and what that adds."""
    bands = block_spectra(comparison).bands
    # Slower than the narrow bands that show what simple spectra lack, that of the slow ordinates.
    f, slow = bands.nodes, bands.nodes < float(narrow_bands(comparison.n_samples).frequency[0])
    shown = torch.where(slow, reference_noise(comparison).spectrum(f), comparison.reference.density(f))
    return Ground(analog_noise(comparison), bands, shown, comparison.rounding)


def ratios(
    comparison: Comparison,
    blocks: Tensor | None = None,
    folds: Tensor | None = None,
    *,
    independent: bool = False,
    formed: bool = True,
) -> Ratios:
    """Cross-spectra of a recording over the reference's, without bands that hold an unexplained spectral line.

    Args:
        comparison: Recording and reference.
        blocks: Blocks of the recording to use, `(block,)`; all by default.
        folds: Folds of the reference to use, `(fold,)`; all by default.
        independent: Whether the reference's sensors are known to share nothing.
        formed: Whether to use bands that were changed by a repair whose form only approximates the recording's.
    """
    both = block_spectra(comparison)
    matrices, d = both.observed.mean(torch.ones(N_JUDGED, dtype=torch.bool) if blocks is None else blocks)
    reference, s = both.reference.mean(torch.ones(N_FOLDS, dtype=torch.bool) if folds is None else folds)
    usable = torch.ones(len(s), comparison.n_sensors, dtype=torch.float64)
    nodes = both.bands.nodes.unflatten(0, (len(s), -1))
    lowest, highest = nodes.amin(-1), nodes.amax(-1)
    reach = 2 * N_JUDGED / comparison.n_samples  # tapers of a block widen a line by two bins of a block
    if comparison.line.p_value < CERTAIN:
        line = comparison.line.frequency
        usable[(lowest > reach / 2) & (lowest - reach < line) & (line < highest + reach)] = 0.0
    usable[lowest < comparison.reference.slowest_seen] = 0.0
    for factor in () if formed else comparison.bent:
        changed = both.bands.mean_of(factor(both.bands.nodes))  # (sensor, band)
        usable[(changed.clamp(min=1e-300).log().abs() > _CHANGED).mT] = 0.0
    d, s = d * both.steady, s * both.steady
    ground = _ground(comparison)
    power = reference.diagonal(dim1=-2, dim2=-1).real
    size = torch.where(power > 0, power, ground.whole.mT).rsqrt()
    expected = torch.eye(comparison.n_sensors, dtype=reference.dtype).expand_as(reference)
    if not independent:
        expected = smooth_coherence(reference * (size[:, :, None] * size[:, None, :]), s)
    return Ratios.of(ground, (matrices, d), (power, s), expected, usable, independent)


def ratios_around(comparison: Comparison, frequency: float, width: float, beside: float = 0.0) -> Ratios | None:
    """Cross-spectra of a recording over the reference's noise in narrow cells around a frequency; None without room.

    Args:
        comparison: Recording and reference.
        frequency: Middle, cycles per sample.
        width: Width of four cells, cycles per sample.
        beside: How far away its coherence is looked up, where it is not to be what the simulation has there; likewise.
    """
    n, narrowest, most = comparison.n_samples, 5, 24  # bins of a cell, which tapers fill; cells on either side
    cell, centre = max(round(width * n / 4), narrowest), round(frequency * n)
    count = min(most, (centre - 3) // cell, (n // 2 - 4 - centre) // cell)
    if count < 6:
        return None
    edges = tuple(centre + cell * k for k in range(-count, count + 1))
    ends = torch.tensor(edges, dtype=torch.float64)
    dof = torch.full((2 * count,), degrees_of_freedom(cell), dtype=torch.float64)
    cells = Bands(n, edges, (ends[:-1] + ends[1:] - 1) / 2 / n, dof)
    # Where a filter of another form was built in, what comes through its stop band is no bump.
    simple = beside or comparison.bent
    ground = Ground(comparison.base, cells, None if simple else comparison.reference.density(cells.nodes))
    away = frequency + (beside if frequency + beside < 0.48 else -beside)
    band = int((comparison.bands.frequency - away).abs().argmin())
    coherence = smooth_coherence(comparison.reference.coherence, comparison.reference.dof)[band]
    matrices = cross_spectra(comparison.observed.steady, ground.bands).mean(0)
    known = ground.mean.mT, exact(dof)
    return Ratios.of(
        ground, (matrices, dof), known, coherence.expand(2 * count, -1, -1), torch.ones_like(ground.mean.mT)
    )


@functools.lru_cache(maxsize=8)
def block_bands(length: int) -> Bands:
    """Bands of a block: six an octave, at most 0.02 cycles per sample and a third of the distance to half the rate.

    Smooth spectra need no more than six bands an octave. A wider band would hide the slope of a filter that cuts off,
    and next to half the rate digital filters have zeros. The ordinates of all bands together are those of one band as
    wide as all: neighbours share some.

    Args:
        length: Samples of a block.
    """
    per_octave, widest, end_share = 6, 0.02, 3
    last = length // 2 - end_share * _NARROWEST
    edges = [_FIRST_BIN]
    while last - edges[-1] >= 2 * _NARROWEST:
        a = edges[-1]
        wide = min(a * (2 ** (1 / per_octave) - 1), widest * length, (length / 2 - a) / end_share)
        edges.append(a + max(round(wide), _NARROWEST))
    edges.append(last)
    lower, upper = (torch.tensor(ends, dtype=torch.float64) for ends in (edges[:-1], edges[1:]))
    dof = torch.tensor([degrees_of_freedom(b - a) for a, b in itertools.pairwise(edges)], dtype=torch.float64)
    dof *= degrees_of_freedom(edges[-1] - edges[0]) / dof.sum()
    return Bands(length, tuple(edges), (lower * (upper - 1)).sqrt() / length, dof)


def slow_groups() -> Groups:
    """DCT-II ordinates of a record below its blocks' lowest band: single at the bottom, then a quarter octave each."""
    per_octave, end = 4, round(2 * N_JUDGED * (_FIRST_BIN - 0.5))
    edges = [1]
    while edges[-1] < end:
        edges.append(min(max(edges[-1] + 1, round(edges[-1] * 2 ** (1 / per_octave))), end))
    return tuple(tuple(range(a, b)) for a, b in itertools.pairwise(edges))


def fast_groups(n_samples: int) -> Groups:
    """DCT-II ordinates of a record above its blocks' highest band, each a third of the distance to half the rate.

    A group has 24 ordinates at least, which know its power to 30 %.
    """
    end_share, fewest = 3, 24
    length = n_samples // N_JUDGED
    edges = [round(2 * n_samples * (block_bands(length).edges[-1] - 0.5) / length)]
    while n_samples - edges[-1] >= 2 * fewest:
        edges.append(edges[-1] + max((n_samples - edges[-1]) // end_share, fewest))
    edges[-1] = n_samples
    return tuple(tuple(range(a, b)) for a, b in itertools.pairwise(edges))


@functools.lru_cache(maxsize=8)
def compared_bands(n_samples: int) -> BlockBands:
    """Bands in which recordings of so many samples are compared."""
    return BlockBands.of(block_bands(n_samples // N_JUDGED), n_samples, slow_groups(), fast_groups(n_samples))


def _tapers_response(bins: Bands, nodes: Tensor) -> Tensor:
    """What each frequency adds to the bands of blocks by the window of their tapers, `(band, frequency)`.

    A node stands for all frequencies that are nearer to it than to another one. Those next to zero are left out: a
    block's mean is subtracted.
    """
    n, per_bin = bins.n_samples, 4  # frequencies in a bin, at which the window is laid out
    window = torch.fft.rfft(taper_window(n, per_bin))
    inside = torch.zeros(len(bins.dof), per_bin * n, dtype=torch.float64)
    for band, (first, end) in enumerate(itertools.pairwise(bins.edges)):
        inside[band, per_bin * first : per_bin * end : per_bin] = 1.0
    around = torch.fft.irfft(torch.fft.rfft(inside) * window, n=per_bin * n)
    half = per_bin * n // 2
    weights = around[:, : half + 1] + torch.nn.functional.pad(around[:, half + 1 :].flip(-1), (1, 1))
    frequency = torch.arange(half + 1, dtype=torch.float64) / (per_bin * n)
    weights = weights * (frequency >= 0.5 / n)
    nearest = torch.bucketize(frequency, (nodes[1:] + nodes[:-1]) / 2)
    shares = torch.zeros(len(weights), len(nodes), dtype=torch.float64).index_add_(1, nearest, weights)
    return shares / shares.sum(-1, keepdim=True)


def _spectra(side: Records, n_samples: int) -> Spectra:
    """Spectra of a side by the 32 blocks that its samples, or its ordinates, belong to."""
    noise = side.steady
    length, (n_records, p, n) = n_samples // N_JUDGED, noise.shape
    bands, below, beyond = block_bands(length), slow_groups(), fast_groups(n_samples)
    first, end = len(below), len(below) + len(bands.dof)
    products = torch.zeros(N_JUDGED, end + len(beyond), p, p, dtype=torch.complex128)
    dof = torch.zeros(N_JUDGED, end + len(beyond), dtype=torch.float64)
    for record in noise:
        blocks = record[:, : n // length * length].unflatten(-1, (-1, length)).movedim(1, 0)
        of_block = torch.arange(len(blocks)) % N_JUDGED
        products[:, first:end].index_add_(0, of_block, cross_spectra(blocks, bands) * bands.dof[:, None, None])
        dof[:, first:end].index_add_(0, of_block, bands.dof.expand(len(blocks), -1))
        taper = light_taper(n) * math.sqrt(n)
        tapered = (record - record.mean(-1, keepdim=True)) * taper
        for start, groups, signal, weight in (
            (0, below, record, 0.5),  # a real ordinate is half a complex one
            (end, beyond, tapered, 0.5 / float(taper.pow(4).mean())),
        ):
            # A record of another length has its ordinates at other frequencies.
            edges = torch.tensor([g[0] - 0.5 for g in groups] + [groups[-1][-1] + 0.5], dtype=torch.float64)
            lowest, highest = (float(edge) * n / n_samples for edge in (edges[0], edges[-1]))
            k = torch.arange(max(math.ceil(lowest), 1), min(math.floor(highest) + 1, n))
            band = torch.bucketize(k * (n_samples / n), edges, right=True) - 1
            y = cosine_ordinates(signal)[:, k].mT
            at, inside = (k % N_JUDGED)[band >= 0], band >= 0
            cross = (y[:, :, None] * y[:, None, :])[inside].to(products.dtype) * weight
            products.index_put_((at, start + band[inside]), cross, accumulate=True)
            dof.index_put_((at, start + band[inside]), torch.full((len(at),), weight).to(dof), accumulate=True)
    # Less than one where a model was estimated from fewer samples, and where a few ordinates hold a band's power.
    known = side.n_records / n_records * _evenness(side, bands, beyond, n_samples)
    return Spectra(products * known[:, None, None], dof * known)


def _evenness(side: Records, bands: Bands, beyond: Groups, n_samples: int) -> Tensor:
    """Share of the ordinates that powers are known from, in slow groups, bands of blocks and fast groups."""
    of_bands = side.even_share(bands.nodes.unflatten(-1, (-1, N_NODES))) * _unleaked_share(side, bands)
    of_groups = [side.even_share(torch.tensor(group, dtype=torch.float64) / (2 * n_samples))[None] for group in beyond]
    return torch.cat([_own_share(side, n_samples), of_bands, *of_groups])


def _unleaked_share(side: Records, bands: Bands) -> Tensor:
    """Share of the ordinates of blocks' bands that is their own, and not what their ends let in, `(band,)`.

    That is one complex number of each block, which all bands share that it reaches.
    """
    response, density = _tapers_response(bands, bands.nodes), side.density(bands.nodes)
    nodes = bands.nodes.unflatten(-1, (-1, N_NODES))
    reach = 3 / bands.n_samples  # of tapers
    near = (bands.nodes > nodes[:, :1] - reach) & (bands.nodes < nodes[:, -1:] + reach)  # (band, frequency)
    let_in = (1 - density @ (response * near).mT / (density @ response.mT)).amax(0)  # (band,)
    return 1 / (1 + let_in.square() * bands.dof * let_in.square().sum())


def _own_share(side: Records, n_samples: int) -> Tensor:
    """Share of the ordinates of slow groups that is their own, and not what a record's ends let in, `(group,)`.

    These are the same two numbers in all of them, and most of a group where noise has next to nothing slow.
    """
    n = side.signal.shape[-1]
    middle = torch.tensor([sum(group) / len(group) for group in slow_groups()], dtype=torch.float64) / (2 * n_samples)
    f = torch.logspace(math.log10(1 / n), math.log10(0.5), 1000, dtype=torch.float64)
    own = side.density(middle.clamp(min=1 / n))  # (sensor, group)
    return (own / own.maximum(3 * let_in(f, side.density(f), middle, n))).square().amin(0)
