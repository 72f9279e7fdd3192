"""Cross-spectral matrices of arrays in bands of frequency, by sine multitapers.

One transform of twice the length gives `K` eigencoefficients at every bin of the record,

    y_k(m) = (X(m - k/2) - X(m + k/2)) / sqrt(2 T),   k = 1 .. K,

(Riedel and Sidorenko, 1995). Bands are a quarter of an octave wide and never narrower than the tapers, so that
neighbours are all but uncorrelated.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import torch
from scipy import stats
from torch import Tensor

from gyrofuse._base.transforms import fast_length, squared_modulus

_TAPERS = 4  # an even number
_PER_OCTAVE = 4
N_NODES = 8  # frequencies whose mean stands for the mean over a band
_FIRST_BIN = 3  # below, positive and negative frequencies overlap


@dataclass(frozen=True, eq=False)
class Bands:
    """Bands of a record's bins.

    Attributes:
        n_samples: T.
        edges: First bin of each band, and the bin after the last.
        frequency: Geometric mean of each band's ends, cycles per sample, `(band,)`.
        dof: Independent complex ordinates of a band's mean, `(band,)`: the squared mean over the variance
            of a power is `dof`.
    """

    n_samples: int
    edges: tuple[int, ...]
    frequency: Tensor
    dof: Tensor

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """Lower and upper ends, cycles per sample, `(band,)` each."""
        edges = (torch.tensor(self.edges, dtype=torch.float64) - 0.5) / self.n_samples
        return edges[:-1], edges[1:]

    def mean_of(self, density: Tensor) -> Tensor:
        """Means over the bands of values `(..., node)` at `nodes`."""
        return density.unflatten(-1, (-1, N_NODES)).mean(-1)

    @property
    def nodes(self) -> Tensor:
        """Frequencies `(band * node,)`, cycles per sample, whose mean stands for the mean over a band."""
        edges = torch.tensor(self.edges, dtype=torch.float64)
        share = (torch.arange(N_NODES, dtype=torch.float64) + 0.5) / N_NODES
        bins = edges[:-1, None] - 0.5 + (edges.diff())[:, None] * share
        return (bins / self.n_samples).flatten()


@functools.lru_cache(maxsize=8)
def bands(n_samples: int, widest: int | None = None) -> Bands:
    """Bands for records of `n_samples`, 32 at least; of so many bins at most, where given."""
    last = (n_samples - _TAPERS) // 2  # the bin after the last one
    edges = [_FIRST_BIN]
    while edges[-1] < last:
        octave = math.ceil(edges[-1] * 2 ** (1 / _PER_OCTAVE))
        end = octave if widest is None else min(octave, edges[-1] + widest)
        edges.append(max(edges[-1] + _TAPERS + 1, end))
    edges[-1] = last
    if len(edges) > 2 and edges[-1] - edges[-2] <= _TAPERS:
        del edges[-2]
    lower, upper = (torch.tensor(ends, dtype=torch.float64) for ends in (edges[:-1], edges[1:]))
    dof = torch.tensor([degrees_of_freedom(int(w)) for w in upper - lower], dtype=torch.float64)
    return Bands(n_samples, tuple(edges), (lower * (upper - 1)).sqrt() / n_samples, dof)


def narrow_bands(n_samples: int) -> Bands:
    """Bands of a 512th of the rate at most, or of 24 bins where these are wider."""
    return bands(n_samples, max(n_samples // 512, 24))


def between_bands(values: Tensor, frequency: Tensor, f: Tensor) -> Tensor:
    """Values `(..., band)` with middles at `frequency`, linear in log frequency at `f`, level beyond the ends."""
    x, at = f.clamp(frequency[0], frequency[-1]).log(), frequency.log()
    right = torch.searchsorted(at, x).clamp(1, len(at) - 1)
    share = (x - at[right - 1]) / (at[right] - at[right - 1])
    return torch.lerp(values[..., right - 1], values[..., right], share.to(values.dtype))


def drawn_towards(values: Tensor, chance: Tensor, middle: Tensor | float) -> Tensor:
    """Values, real or complex, drawn towards a middle by as much as chance, a variance, explains of their distance."""
    apart = values - middle
    kept = (1 - chance / apart.abs().square().clamp(min=1e-300)).clamp(min=0.0)
    return middle + torch.where(kept > 0, kept * apart, 0.0)


def cross_spectra(signal: Tensor, wanted: Bands) -> Tensor:
    """Cross-spectral matrices per sample `(..., band, sensor, sensor)`, complex, of `(..., sensor, time)`.

    The signal may be as long as `wanted.n_samples` or not: bands keep their frequencies.
    """
    n = signal.shape[-1]
    # The mean of what the taper leaves: after a high-pass that of all samples is what the ends have by chance.
    taper = smooth_ends(n)
    centred = signal - (signal @ taper / taper.sum())[..., None]
    transform = torch.fft.rfft(centred * taper, n=2 * n)
    matrices, scale = [], n / wanted.n_samples
    # Half bins around each bin, `(..., sensor, bin, half bin)`, from the first one that has so many below it.
    first_whole, last = _TAPERS // 2, (n - _TAPERS) // 2
    around = transform.unfold(-1, 2 * _TAPERS + 1, 2)
    for first, end in itertools.pairwise(wanted.edges):
        a = min(max(round(first * scale), _FIRST_BIN), last - 1)  # of a short signal the last bands share a bin
        b = min(max(round(end * scale), a + 1), last)
        own = around[..., a - first_whole : b - first_whole, :]
        y = (own[..., :_TAPERS] - own[..., _TAPERS + 1 :].flip(-1)).flatten(-2)  # (..., sensor, bin * taper)
        matrices.append(y @ y.mH / (2 * n * y.shape[-1]))
    return torch.stack(matrices, -3)


@functools.lru_cache(maxsize=8)
def smooth_ends(n: int) -> Tensor:
    """Factors `(n,)` that take the ends of a record down to nothing, with all derivatives, in a 32nd of it each.

    Sine tapers have a kink at either end: of what a steep filter holds back 60 dB and more they would show the leakage
    alone. They weigh the ends by little as it is, so that of the level 0.01 % of the first taper is lost, and 0.15 % of
    the fourth.
    """
    m = n // 32
    if m < 8:
        return torch.ones(n, dtype=torch.float64)
    return _planck_taper(n, m)


def taper_window(n_samples: int, per_bin: int) -> Tensor:
    """Mean of the tapers' squared transforms at distances from a bin, `(distance,)`, which go round at the rate.

    The taper of `y_k` is `2 sin(pi k t / T) / sqrt(2 T)`.

    Args:
        n_samples: T.
        per_bin: Distances in a bin.
    """
    t = torch.arange(n_samples, dtype=torch.float64) / n_samples
    k = torch.arange(1, _TAPERS + 1, dtype=torch.float64)[:, None]
    tapers = 2 * torch.sin(math.pi * k * t) / math.sqrt(2 * n_samples) * smooth_ends(n_samples)
    transform = torch.fft.fft(tapers, n=per_bin * n_samples)
    return (transform.real.square() + transform.imag.square()).mean(0)


def leaked(density: Tensor, wanted: Bands) -> Tensor:
    """Power in bands that tapers let in from outside of their own bandwidth, `(sensor, band)`, per sample.

    Args:
        density: Of the bins of a record from 0 to half the rate, `(sensor, bin)`.
        wanted: Bands of records of that length.
    """
    n = wanted.n_samples
    window = taper_window(n, 1) / n
    reach = _TAPERS
    window[: reach + 1] = 0.0
    window[-reach:] = 0.0
    both = torch.cat([density, density[:, 1 : n - density.shape[-1] + 1].flip(-1)], -1)  # as many bins as samples
    let_in = torch.fft.irfft(torch.fft.rfft(both) * torch.fft.rfft(window), n=n).clamp(min=0.0)
    return torch.stack([let_in[:, a:b].mean(-1) for a, b in itertools.pairwise(wanted.edges)], -1)


@functools.lru_cache(maxsize=1024)
def degrees_of_freedom(width: int) -> float:
    """Of the mean over `width` bins and all tapers, from the covariances of white noise's eigencoefficients.

    `X` at distances of `d` half bins has the covariance `c_d`: 1 at 0, 0 at even `d`, `2 / (i pi d)` at odd ones.
    """
    far = min(width, 64)
    k = torch.arange(1, _TAPERS + 1, dtype=torch.float64)
    apart = torch.arange(-far + 1, far, dtype=torch.float64)

    def c(d: Tensor) -> Tensor:
        odd = torch.remainder(d, 2) == 1
        return torch.where(odd, 2 / (math.pi * torch.where(odd, d, 1.0)), 0.0) * -1j + (d == 0)

    step, one, other = 2 * apart[:, None, None], k[:, None], k
    covariance = (c(step - one + other) - c(step - one - other) - c(step + one + other) + c(step + one - other)) / 2
    energy = covariance.abs().square().sum((-1, -2))
    weight = width - apart.abs()
    return float((_TAPERS * width) ** 2 / (weight * energy).sum())


def median_powers(records: Tensor, wanted: Bands) -> tuple[Tensor, Tensor]:
    """Densities per sample `(sensor, band)` from medians of ordinates, which lines hardly move, and their variance.

    A median of exponential ordinates is `ln 2` of their mean, and `2.1 / m` the variance of its logarithm for `m`
    independent ones; under the taper every second one is.

    Args:
        records: `(record, sensor, time)`.
        wanted: Bands.

    Returns:
        The densities, and the variance of their logarithms by chance, `(band,)`: infinite where nothing is known.
    """
    n = records.shape[-1]
    transform, length = hann_transform(records * smooth_ends(n))
    power = (transform.real.square() + transform.imag.square()).movedim(1, 0)  # (sensor, record, bin)
    scale, levels, chance = length / wanted.n_samples, [], []
    for first, end in itertools.pairwise(wanted.edges):
        own = power[..., round(first * scale) : round(end * scale)].flatten(1)
        count = own.shape[-1]
        independent = count * n / length / 2
        if independent < 4:
            levels.append(own.new_ones(len(power)))
            chance.append(math.inf)
            continue
        # Of an odd number the middle one lies higher than the lower of two in the middle of an even one.
        usual = math.log(2) * (1 + 1.2 / count * (count % 2))
        levels.append(own.median(-1).values / usual)
        chance.append(2.1 / independent)
    return torch.stack(levels, -1), torch.tensor(chance, dtype=torch.float64)


def steady_shares(records: Tensor, wanted: Bands) -> Tensor:
    """Share of the ordinates of bands that their mean powers are known from, `(band,)`.

    A line that wanders through a band gives it power on some visits: these count, and not ordinates. Means of a band's
    power over parts of a record vary then by more than those of Gaussian noise, by a factor `F`; where that is no
    chance the share is one over it. Changes of the level of all bands together are left out.

    Args:
        records: `(record, sensor, time)`.
        wanted: Bands.
    """
    parts, fewest, rare, low = 18, 64, 1e-4, 0.1  # of a record; bins; by chance; quantile of an estimate of `F`
    n_records, p, n = records.shape
    taper, shares = light_taper(n), torch.ones_like(wanted.dof)
    transform = torch.fft.rfft((records - records.mean(-1, keepdim=True)) * taper)
    whole = slice(1, -1)  # parts that the taper leaves as they are
    bins = [(max(round(a * n), 1), round(b * n)) for a, b in zip(*(e.tolist() for e in wanted.ends), strict=True)]
    wide = [k for k, (a, b) in enumerate(bins) if b - a >= fewest]
    if not wide:
        return shares
    courses = []
    for a, b in (bins[k] for k in wide):
        envelope = torch.fft.ifft(transform[..., a:b], n=-(-(b - a) // parts) * parts)
        power = squared_modulus(envelope).unflatten(-1, (parts, -1)).mean(-1)[..., whole]
        courses.append(power / power.mean(-1, keepdim=True).clamp(min=1e-300))
    course = torch.stack(courses, -1)  # (record, sensor, part, band)
    if len(wide) > 4:
        course = course / course.median(-1, keepdim=True).values
    course = course / course.mean(-2, keepdim=True).clamp(min=1e-300)
    ordinates = torch.tensor([bins[k][1] - bins[k][0] for k in wide], dtype=torch.float64)
    dof = parts - 3  # of a record: a mean is subtracted
    excess = course.var(-2).sum(0) * dof * ordinates / parts  # chi-square, (sensor, band)
    # Means of few ordinates are no normal variables: their variance scatters by their kurtosis as well.
    spread = 1 + 3 * dof / ordinates
    dof *= n_records
    certain = excess > spread * torch.from_numpy(stats.chi2.isf(rare / (p * len(wide)), dof / spread.numpy()))
    apart = course - course.mean(-2, keepdim=True)
    follows = sum((apart[..., k:, :] * apart[..., :-k, :]).sum((0, -2)) for k in (1, 2))
    longer = (1 + 2 * torch.as_tensor(follows) / apart.square().sum((0, -2)).clamp(min=1e-300)).clamp(min=1)
    factor = torch.where(certain, longer * excess / float(stats.chi2.ppf(low, dof)), 1.0)
    shares[wide] = 1 / factor.amax(0)
    return shares


def hann_transform(signal: Tensor) -> tuple[Tensor, int]:
    """Transform of the signal under a Hann taper of mean square 1, over `sqrt(T)`, and the length it was padded to.

    Its squares have the spectral density as expectation.
    """
    n = signal.shape[-1]
    taper = torch.hann_window(n, periodic=True, dtype=signal.dtype) * math.sqrt(8 / 3)
    length = fast_length(n)
    return torch.fft.rfft((signal - signal.mean(-1, keepdim=True)) * taper, n=length) / math.sqrt(n), length


def light_taper(n: int) -> Tensor:
    """For whitened samples `(n,)`, of squares that sum to one: one that holds back what is red costs half of them."""
    tapered = 0.12  # share of the record under its ends: spectral lines leak as far as twenty bins
    taper = _planck_taper(n, round(n * tapered / 2))
    return taper / taper.square().sum().sqrt()


def _planck_taper(n: int, m: int) -> Tensor:
    """Factors `(n,)`, ones but at the `m` samples of either end, where they fall with all derivatives.

    McKechan, Robinson and Sathyaprakash, Classical and Quantum Gravity 27 (2010), 084020.
    """
    x = torch.arange(1, m + 1, dtype=torch.float64) / (m + 1)
    ramp = torch.sigmoid(1 / (1 - x) - 1 / x)
    return torch.cat([ramp, torch.ones(n - 2 * m, dtype=torch.float64), ramp.flip(0)])
