"""Spectra of records against structures: the number of spectral lines, and the likelihood of each noise.

The orthonormal DCT-II and its bands are those of the spectral refinement. Lines are taken out of a record once, its
bands are summed once, and all structures are fitted to these few numbers.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from copy import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.transforms import ramp_ordinates
from gyrofuse.fitting.moments.search import with_alternating
from gyrofuse.fitting.spectral.bands import BandSpectrum, Bins
from gyrofuse.fitting.spectral.search import maximise, uncertainty
from gyrofuse.fitting.spectral.tones import NoiseSpectrum, Tones, find_tones, line_p_value
from gyrofuse.fitting.spectral.whittle import LEAST_COUNT, ordinates_left
from gyrofuse.fitting.structure import ModelStructure, new_shape
from gyrofuse.noise.processes import AR1, Process, QuantizationNoise, RandomWalk, WhiteNoise

# Gain in nats below which a fit needs no further step: criteria that differ by nats are compared.
_ENOUGH = 1e-3


@dataclass(frozen=True, eq=False)
class NoiseFit:
    """Maximum of the likelihood of a structure without sinusoids.

    Attributes:
        linear: Linear parameters `p`, `(item, process)`, with the squared slope of a drift.
        shape: Nonlinear parameters `x = atanh phi`, `(item, AR1)`.
        slope: Slope of the drift, `(item,)`; 0 without one.
        slope_sd: Standard error of the slope, `(item,)`.
        log_likelihood: Log likelihood, `(item,)`, nats.
    """

    linear: Tensor
    shape: Tensor
    slope: Tensor
    slope_sd: Tensor
    log_likelihood: Tensor


def gathered(parts: list[tuple[Tensor, Spectra]]) -> Spectra:
    """Spectra of all items; where several parts hold an item, those of the last."""
    whole = copy(parts[0][1])
    n_items = int(torch.cat([places for places, _ in parts]).max()) + 1
    for name in ("energy", "cross", "count"):
        values = whole.energy.new_empty(n_items, whole.energy.shape[-1])
        for places, part in parts:
            values[places] = getattr(part, name)
        setattr(whole, name, values)
    return whole


def summed(bins: Bins, values: Tensor) -> Tensor:
    """Sums over bins, `(item, bin)`, of values at ordinates, `(item, k)`."""
    return torch.stack([values[:, a:b].sum(-1) for a, b in itertools.pairwise(bins.edges)], -1)


class Spectra:
    """Banded spectra of records, with the bands of a ramp beside them.

    Args:
        series: `(item, time)`, finite.
        tones: Spectral lines of every item, which are subtracted.
    """

    def __init__(self, series: Tensor, tones: Tones | None = None) -> None:
        self.bins = Bins(series.shape[-1], series.device)
        shown = ramp_ordinates(self.bins.n_samples, series.device)[None]
        energy, cross = [], []
        for values in ordinates_left(series, tones, None):
            energy.append(summed(self.bins, values.square()))
            cross.append(summed(self.bins, values * shown))
        self.energy, self.cross = torch.cat(energy), torch.cat(cross)  # (item, bin)
        self.ramp = summed(self.bins, shown.square())  # (1, bin)
        count = self.bins.count.expand(len(series), -1)
        if tones is not None:
            count = count - self.bins.taken_by(tones.beta, tones.phase)
        self.count = count.clamp(min=LEAST_COUNT)

    def part(self, items: Tensor) -> Spectra:
        """Spectra of some items."""
        some = copy(self)
        some.energy, some.cross, some.count = self.energy[items], self.cross[items], self.count[items]
        return some

    def fit(self, structure: ModelStructure, linear: Tensor, shape: Tensor) -> NoiseFit:
        """Maximum of the likelihood next to `p` and `x`; the slope of a drift is solved for."""
        noise = BandSpectrum(structure)
        ramp_at = _drifts(structure)
        p, x = linear[:, noise.which], shape
        size = self.energy.sum(-1, keepdim=True) / self.count.sum(-1, keepdim=True)
        p = torch.where((p.sum(-1, keepdim=True) > 0) & p.isfinite().all(-1, keepdim=True), p, size)
        energy = self.energy
        slope = slope_sd = size.new_zeros(len(p))
        # Slope and noise depend on each other: twice each.
        for _ in range(2 if ramp_at else 1):
            if ramp_at:
                slope, slope_sd, energy = self.without_ramp(noise.variances(self.bins, p, x))
            p, x, _ = maximise(energy, self.count, self.bins, noise, p, x, enough=_ENOUGH)
        variance = noise.variances(self.bins, p, x)
        if ramp_at:
            slope, slope_sd, energy = self.without_ramp(variance)
        log_likelihood = -(self.bins.count * (2 * math.pi * variance).log() + energy / variance).sum(-1) / 2
        whole = linear.clone()
        whole[:, noise.which] = p
        whole[:, ramp_at] = slope.square()[:, None]
        whole, x = structure.ordered(whole, x)
        return NoiseFit(whole, x, slope, slope_sd, log_likelihood)

    def without_ramp(self, variance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Slope by weighted least squares, its standard error, and the power without the drift."""
        information = (self.ramp / variance).sum(-1)
        slope = (self.cross / variance).sum(-1) / information
        energy = self.energy - 2 * slope[:, None] * self.cross + slope.square()[:, None] * self.ramp
        return slope, information.rsqrt(), energy.clamp(min=torch.finfo(energy.dtype).tiny)

    def variances(self, structure: ModelStructure, fit: NoiseFit) -> Tensor:
        """Variances of the ordinates of the noise without its drift, `(item, bin)`."""
        noise = BandSpectrum(structure)
        return noise.variances(self.bins, fit.linear[:, noise.which], fit.shape)

    def covariance(self, structure: ModelStructure, fit: NoiseFit) -> tuple[Tensor, Tensor]:
        """Covariance of `(ln p, x)` `(item, unknown, unknown)` and the `sd` of `p` off its edge `(item, process)`."""
        noise = BandSpectrum(structure)
        own, edge = uncertainty(self.count, self.bins, noise, fit.linear[:, noise.which], fit.shape)
        n_linear = structure.n_linear
        whole = own.new_zeros(len(own), *(n_linear + len(structure.nonlinear),) * 2)
        place = torch.tensor([*noise.which, *range(n_linear, whole.shape[-1])], device=own.device)
        whole[:, place[:, None], place] = own
        edges = own.new_zeros(len(own), n_linear)
        edges[:, noise.which] = edge
        for k in _drifts(structure):
            whole[:, k, k] = (2 * fit.slope_sd / fit.slope).square()
            edges[:, k] = 2 * fit.slope.abs() * fit.slope_sd
        return whole, edges

    def widened(self, parent: ModelStructure, fit: NoiseFit, structure: ModelStructure) -> tuple[Tensor, Tensor]:
        """Start for a structure with one process more: the smaller one's maximum, the new process without variance.

        A further nonlinear parameter starts where the score, the slope of the likelihood by the variance of its process
        over its standard deviation, is largest.
        """
        linear = fit.linear.new_zeros(len(fit.linear), structure.n_linear)
        shape = fit.shape.new_zeros(len(fit.shape), len(structure.nonlinear))
        kinds = [type(p) for p in structure.processes]
        seen: Counter[type] = Counter()
        for k, process in enumerate(parent.processes):
            kind = type(process)
            linear[:, [i for i, other in enumerate(kinds) if other is kind][seen[kind]]] = fit.linear[:, k]
            seen[kind] += 1
        at = new_shape(parent, structure)
        shape[:, [i for i in range(len(structure.nonlinear)) if i != at]] = fit.shape
        if at is not None:
            k = structure.nonlinear[at]
            shape[:, at], linear[:, k] = self._best_shape(parent, fit, structure.processes[k])
        return linear, shape

    def _best_shape(self, parent: ModelStructure, fit: NoiseFit, process: Process) -> tuple[Tensor, Tensor]:
        """`x` and the variance of a further process that raise the likelihood fastest, both `(item,)`."""
        noise = BandSpectrum(parent)
        p, x = fit.linear[:, noise.which], fit.shape
        columns, slopes, _ = noise.columns(self.bins, x)
        variance = (columns @ p[..., None])[..., 0]
        energy = self.without_ramp(variance)[2] if _drifts(parent) else self.energy
        root = (self.count / 2).sqrt()[..., None] / variance[..., None]
        moving = slopes * p[:, None, noise.moving]
        there = torch.cat([p > 0, p[:, noise.moving] > 0], -1)[:, None]
        known = torch.cat([columns, moving], -1) * root * there
        known = known / known.norm(dim=-2, keepdim=True).clamp(min=1e-300)
        # Columns of zeros come last: in their places the basis has vectors that mean nothing.
        first = there.sort(descending=True)
        basis = torch.linalg.qr(known.take_along_dim(first.indices, -1))[0] * first.values
        grid = _grid(type(process), self.bins.n_samples).to(p)
        shapes = process.unit_band_variance(self.bins, grid).value.mT * root  # (item, bin, grid)
        new = shapes - basis @ (basis.mT @ shapes)
        misfit = (self.count / 2).sqrt() * (energy / self.count / variance - 1)
        gradient, information = (new.mT @ misfit[..., None])[..., 0], new.square().sum(-2)
        score = gradient * information.clamp(min=1e-300).rsqrt()
        best = score.argmax(-1, keepdim=True)
        start = (gradient / information.clamp(min=1e-300)).gather(-1, best)[:, 0].clamp(min=0)
        return grid[best[:, 0]], start


def _drifts(structure: ModelStructure) -> list[int]:
    return [k for k, p in enumerate(structure.processes) if p.deterministic]


def _grid(kind: type[Process], n_samples: int) -> Tensor:
    """`x` of a further process: time constants from 1/3 sample to the record, and some that alternate."""
    shortest, ratio, alternating = 1 / 3, 1.6, (-0.3, -0.6, -0.8, -0.9, -0.97)
    n = math.ceil(math.log(n_samples / shortest) / math.log(ratio))
    constants = shortest * ratio ** torch.arange(n, dtype=torch.float64)
    return with_alternating(kind, kind.from_time_scale(constants), alternating)


@dataclass(frozen=True, eq=False)
class Lines:
    """Spectral lines decided on.

    Attributes:
        n_sinusoids: How many were taken out, `(item,)`.
        n_found: How many stand out of the noise, one more than the most allowed at most, `(item,)`.
        rest: Records without them, `(item, time)`, float64.
        spectra: Of the records without them.
    """

    n_sinusoids: Tensor
    n_found: Tensor
    rest: Tensor
    spectra: Spectra


def decide_lines(series: Tensor, allowed: list[int], alpha: float, ramp: bool) -> Lines:
    """Take lines out of records one after the other, as long as the largest is more than noise.

    Before each test the noise is fitted to the record without the line in question, so that a line does not hide
    itself in a spectrum that rises with it.

    Args:
        series: `(item, time)`, finite and not constant.
        allowed: Numbers of tones; of these the largest not above the number found, or else the smallest.
        alpha: Probability that each test takes noise for a line.
        ramp: Whether records may have one, which would hide tones of few cycles.
    """
    rest = series.to(torch.float64).clone()
    searched = detrended(rest) if ramp else rest.clone()
    clean = searched.clone()
    parts = []
    n_sinusoids = torch.zeros(len(series), dtype=torch.long, device=series.device)
    n_found = torch.zeros_like(n_sinusoids)
    todo = torch.arange(len(series), device=series.device)
    density: NoiseSpectrum | None = None
    for k in range(1, max(allowed) + 2):
        tones = find_tones(searched[todo], k, density)
        part = Spectra(series[todo], tones)
        noise, fit = _reference(part)
        p_value = line_p_value(clean[todo], _density(noise, fit.linear, fit.shape))
        n_found[todo[p_value < alpha]] = k
        line = (p_value < alpha) | (k <= min(allowed))
        todo = todo[line]
        if not len(todo) or k > max(allowed):
            break
        density = _density(noise, fit.linear[line], fit.shape[line])
        wave = tones.waveform(series.shape[-1])[line]
        clean[todo] = searched[todo] - wave
        if k in allowed:
            n_sinusoids[todo] = k
            rest[todo] = series[todo] - wave
            parts.append((todo, part.part(line)))
    plain = (n_sinusoids == 0).nonzero()[:, 0]
    if len(plain):
        parts.insert(0, (plain, Spectra(rest[plain])))
    return Lines(n_sinusoids, n_found, rest, gathered(parts))


def detrended(series: Tensor) -> Tensor:
    """Without the straight line of least squares."""
    time = torch.linspace(-1, 1, series.shape[-1], dtype=series.dtype, device=series.device)
    slope = (series @ time) / time.square().sum()
    return series - series.mean(-1, keepdim=True) - slope[:, None] * time


def _reference(spectra: Spectra) -> tuple[BandSpectrum, NoiseFit]:
    """A noise that follows nearly any smooth spectrum: white and quantisation noise, a random walk and two AR1s."""
    parent = ModelStructure((WhiteNoise(), QuantizationNoise(), RandomWalk()), True)
    start = (spectra.energy / spectra.count).mean(-1, keepdim=True)
    linear = start.expand(-1, parent.n_linear).clone()
    fit = spectra.fit(parent, linear, linear[:, :0])
    for _ in range(2):
        structure = ModelStructure((*parent.processes, AR1()), True)
        parent, fit = structure, spectra.fit(structure, *spectra.widened(parent, fit, structure))
    return BandSpectrum(parent), fit


def reference_density(spectra: Spectra) -> NoiseSpectrum:
    """Density of a noise that follows nearly any smooth spectrum, fitted to records without their lines."""
    noise, fit = _reference(spectra)
    return _density(noise, fit.linear, fit.shape)


def _density(noise: BandSpectrum, linear: Tensor, shape: Tensor) -> NoiseSpectrum:
    return lambda f: noise.density(f, linear, shape)
