"""Signals of one side, the recording or the simulation, and what is derived from them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gyrofuse.mismatch.signals.fitted_spectra import SpectralUncertainty
from gyrofuse.mismatch.signals.known_lines import without_lines
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum, fit_base
from gyrofuse.mismatch.signals.psd import (
    N_NODES,
    Bands,
    between_bands,
    cross_spectra,
    degrees_of_freedom,
    drawn_towards,
    leaked,
    median_powers,
    narrow_bands,
    steady_shares,
)
from gyrofuse.mismatch.signals.variance_course import VarianceCourse

_ORDINATES = 40  # for each sensor, behind a matrix that is inverted
_BLOCK, _CUT = 32, 25.0  # samples of a level, and squares in means of them: an outlier is no level
_LEAST_BIN = 3  # of records shorter than the bands are for: below, they say nothing


@dataclass(frozen=True, eq=False)
class Records:
    """Signals of one side. What is derived is computed once, when it is first asked for.

    Attributes:
        signal: `(record, sensor, time)`.
        bands: Bands of frequency of the recording, for both sides.
        lines: Frequencies that the simulation has lines at, cycles per sample: no noise, and left out where noise is
            looked at.
        told_by: Samples of each sensor that the noise is known from, where they are fewer: those that a model, which
            these were drawn from, was estimated from.
        uncertainty: Of the model that these were drawn from, where its numbers were estimated.
        loud: Episodes that it is known to have.
        gaussian: Whether a Gaussian model made it.
        level_variance: Of the log of all power, which varies by itself beyond what Gaussian noise's does, `(sensor,)`.
    """

    signal: Tensor
    bands: Bands
    lines: tuple[float, ...] = ()
    effective_samples: float = math.inf
    uncertainty: SpectralUncertainty | None = None
    loud: tuple[VarianceCourse, ...] = ()
    gaussian: bool = False
    level_variance: Tensor | float = 0.0

    @property
    def n_records(self) -> float:
        """Records that tell of the noise."""
        n_records, _, n = self.signal.shape
        return min(n_records, self.effective_samples / n)

    @property
    def slowest_seen(self) -> float:
        """Frequency below which a model only continues what the record that it was fitted to shows above, 1/sample.

        Whether noise levels off there its parameters' covariance does not say: an AR1 that outlasts a record is a walk.
        """
        known = (
            self.effective_samples
            if self.uncertainty is None
            else min(self.effective_samples, self.uncertainty.n_samples)
        )
        return _LEAST_BIN / known

    def in_bands(self, bands: Bands) -> Records:
        """The noise in other bands."""
        return Records(self.steady, bands, effective_samples=self.effective_samples, uncertainty=self.uncertainty)

    @cached_property
    def noise(self) -> Tensor:
        """The signal without the simulation's lines."""
        return without_lines(self.signal, self.lines)

    @property
    def level(self) -> Tensor | float:
        """Variance of the noise in the episodes that it is known to have, `(sensor, time)`; 1 without any."""
        return math.prod((episodes.variance for episodes in self.loud), start=1.0)

    @cached_property
    def steady(self) -> Tensor:
        """The noise as it would be without episodes that it is known to have."""
        return self.steadied(self.noise)

    def steadied(self, noise: Tensor) -> Tensor:
        """Noise `(record, sensor, time)` of this side, without episodes that it is known to have."""
        for episodes in reversed(self.loud):
            noise = episodes.taken_off(noise)
        return noise

    @cached_property
    def spectra(self) -> Tensor:
        """Mean cross-spectral matrices of the records, `(band, sensor, sensor)`, per sample.

        Of noise of a steady level: power that comes at some times more than at others is known less well than `dof`
        says, which is of noise that is alike throughout.
        """
        return cross_spectra(self.steady, self.bands).mean(0)

    @cached_property
    def dof(self) -> Tensor:
        """Independent complex ordinates of each band, `(band,)`; 0 where records are too short."""
        scale = self.signal.shape[-1] / self.bands.n_samples
        if scale == 1:
            return self.n_records * self.bands.dof
        edges = [round(edge * scale) for edge in self.bands.edges]
        return torch.tensor(
            [
                self.n_records * degrees_of_freedom(max(b - a, 1)) if a >= _LEAST_BIN else 0.0
                for a, b in itertools.pairwise(edges)
            ],
            dtype=torch.float64,
        )

    @cached_property
    def evenness(self) -> Tensor:
        """Share of each band's ordinates that its power is known from, `(band,)`."""
        return self.even_share(self.bands.nodes.unflatten(-1, (-1, N_NODES))) * self._own_share

    @cached_property
    def _own_share(self) -> Tensor:
        """Share of each band's power that is its own, and not leakage, which bands side by side share, `(band,)`."""
        seen = 1e-5  # of the strongest band: tapers leak less
        faint = (self.power < seen * self.power.amax(-1, keepdim=True)).any(0)
        if not bool(faint.any()):
            return torch.ones(len(faint), dtype=self.power.dtype)
        n = self.bands.n_samples
        let_in = leaked(self.density((torch.arange(n // 2 + 1, dtype=torch.float64) / n).clamp(min=1 / n)), self.bands)
        share = (1 - let_in.mean(0) / self.power.mean(0).clamp(min=1e-300)).clamp(min=0.0).square()
        return torch.where(faint, share, 1.0)

    @cached_property
    def power_dof(self) -> Tensor:
        """What bands tell of powers beside what a level varies and a model's numbers may be off, `(sensor, band)`.

        Logarithms of powers vary by one over it.
        """
        varies = torch.as_tensor(self.level_variance).expand(self.signal.shape[-2])[:, None]
        if self.uncertainty is not None:
            varies = varies + self.uncertainty.variance(self.bands.frequency)
        dof = self.dof * self.evenness
        return dof / (1 + dof * varies) * (self.bands.frequency >= self.slowest_seen)

    @property
    def log_power(self) -> Tensor:
        """Unbiased logarithms of the densities, `(sensor, band)`."""
        dof = self.dof.clamp(min=1e-3)
        return self.power.log() - torch.digamma(dof) + dof.log()

    @property
    def coherence_dof(self) -> Tensor:
        """What bands tell of coherences, `(band,)`: less of noise that is loud in all sensors at the same times.

        And of a fitted array no more than the record it was fitted to.
        A fit smooths over bands, so that it is known at least as well. To first order it is known better in narrow
        bands, but where a matrix lacks rank, as those of slow noise often do, coherences are far from linear in it.
        """
        dof = self.dof * self.evenness / (1 + self._levels_alike)
        if self.uncertainty is None or not self.uncertainty.shares_noise:
            return dof
        n_records, _, n = self.signal.shape
        return dof * min(self.uncertainty.n_samples / (n_records * n), 1.0)

    @cached_property
    def _levels_alike(self) -> float:
        """Covariance of two sensors' levels over their means, of all pairs: by so much more coherences vary.

        Seen in squares of differences of samples: in means over short blocks, in which chance is every sensor's own,
        or, as where single samples are loud in all sensors at once, in these squares themselves, less what noise in
        common makes alike in them and twice what chance does.
        """
        p = self.signal.shape[-2]
        n = self.signal.shape[-1] // _BLOCK * _BLOCK
        if p < 2 or self.gaussian or n < 2 * _BLOCK:
            return 0.0
        steps = self.steady[..., :n].diff(append=self.steady[..., n - 1 : n])
        squares = steps.square()
        cut = squares.minimum(_CUT * squares.mean((0, -1))[:, None])
        block = _alike(cut.unflatten(-1, (-1, _BLOCK)).mean(-1))
        correlation = (steps @ steps.mT).mean(0)
        size = correlation.diagonal().clamp(min=1e-300).rsqrt()
        shared = 2 * (size[:, None] * correlation * size).square()
        single = _alike(squares)
        chance = single.std() / single.numel() ** 0.5
        noise = (shared.sum() - shared.trace()) / (p * (p - 1)) + 2 * chance
        return max(float(block.mean()), float(single.mean() - noise), 0.0)

    def steady_shares(self, wanted: Bands) -> Tensor:
        """Share of the ordinates of bands that their mean powers are known from, `(band,)`.

        Next to a band through which a line wanders it may go in another record.
        """
        if self.gaussian:
            return torch.ones_like(wanted.dof)
        own = steady_shares(self.steady, wanted)
        return torch.nn.functional.pad(own, (1, 1), value=1.0).unfold(0, 3, 1).amin(-1)

    @cached_property
    def power(self) -> Tensor:
        """Spectral densities per sample, `(sensor, band)`."""
        return self.spectra.diagonal(dim1=-1, dim2=-2).real.mT

    @cached_property
    def coherence(self) -> Tensor:
        """Complex coherences of the sensors, `(band, sensor, sensor)`."""
        size = self.power.mT.sqrt()
        return self.spectra / size[:, :, None] / size[:, None, :]

    @cached_property
    def base(self) -> NoiseSpectrum:
        """The noise as a sum of simple spectra."""
        return fit_base(self.power, self.bands, self.bands.n_samples, self.dof)

    @cached_property
    def ripple(self) -> Tensor:
        """Logarithms of the density over that of the base, in narrow bands, `(sensor, band)`, beyond chance.

        Simple spectra have no zeros, which averages have. By medians: lines are no noise.
        """
        narrow = narrow_bands(self.bands.n_samples)
        power, chance = median_powers(self.steady, narrow)
        apart = (power.clamp(min=1e-300) / narrow.mean_of(self.base.spectrum(narrow.nodes)).clamp(min=1e-300)).log()
        plain = 4.0  # times the variance of chance: of many bands some stand out
        known = chance.isfinite()
        if int(known.sum()) < 2:
            return torch.zeros_like(apart)
        chance = chance[known]
        apart = apart[:, known] + chance / 2  # mean of a logarithm, which chance makes less
        ripple = drawn_towards(apart, plain * chance, _smooth(apart, chance))
        # Where bands are too few to tell it goes on as in the next one: a high-pass has no floor below.
        place = torch.arange(len(known))
        return ripple[:, (place[:, None] - place[known]).abs().argmin(1)]

    def density(self, f: Tensor) -> Tensor:
        """Density per sample of base and ripple `(sensor, frequency)` at `f` cycles per sample."""
        return self.base.spectrum(f) * between_bands(self.ripple, narrow_bands(self.bands.n_samples).frequency, f).exp()

    def even_share(self, f: Tensor) -> Tensor:
        """Share of the ordinates at frequencies `(..., node)` that their mean power is known from, `(...)`.

        `(mean S)^2 / mean S^2`, of the sensor with the least: where a filter falls steeply, a few hold the power. All
        of them where it is nine tenths and more, as by the chance that ripple has.
        """
        density = self.density(f.flatten()).unflatten(-1, f.shape)  # (sensor, ..., node)
        share = (density.mean(-1).square() / density.square().mean(-1)).amin(0)
        return torch.where(share > 0.9, 1.0, share)

    def over(self, base: NoiseSpectrum) -> Tensor:
        """Cross-spectral matrices over the spectra of a base, to be inverted, `(band, sensor, sensor)`.

        Means over as many bands as it takes: an inverse from too few ordinates would be too large.
        """
        dof = self.bands.dof
        size = self.bands.mean_of(base.spectrum(self.bands.nodes)).mT.sqrt()  # (band, sensor)
        total = self.spectra / size[:, :, None] / size[:, None, :] * dof[:, None, None]
        wanted = min(_ORDINATES * self.signal.shape[-2], float(dof.sum()))
        smooth = []
        for b in range(len(dof)):
            low, high = b, b + 1
            while float(dof[low:high].sum()) < wanted and high - low < len(dof):
                low, high = max(low - 1, 0), min(high + 1, len(dof))
            # Sums of their own: a difference of sums from the first band on would lose what a filter holds back.
            smooth.append(total[low:high].sum(0) / dof[low:high].sum())
        return torch.stack(smooth)


def _smooth(values: Tensor, chance: Tensor) -> Tensor:
    """Course of values `(sensor, band)`: local parabolas, where these are more than chance, of variance `(band,)`."""
    beside, plain = min(8, (values.shape[-1] - 1) // 2), 2.0  # bands on either side; of the mean of squares
    x = torch.arange(-beside, beside + 1, dtype=values.dtype)
    design = torch.stack([torch.ones_like(x), x, x.square()], -1)[:, : min(beside, 2) + 1]
    weights = torch.linalg.pinv(design)[0]

    def pooled(rows: Tensor, weights: Tensor) -> Tensor:
        # Beyond an end they go on as they came, turned about what they are there.
        ends = [rows[:, :3].mean(-1, keepdim=True), rows[:, -3:].mean(-1, keepdim=True)]
        before, after = (
            2 * end - part
            for end, part in zip(
                ends, (rows[:, 1 : beside + 1].flip(-1), rows[:, -beside - 1 : -1].flip(-1)), strict=True
            )
        )
        whole = torch.cat([before, rows, after], -1) if beside else rows
        return torch.nn.functional.conv1d(whole[:, None], weights[None, None])[:, 0]

    smooth = pooled(values, weights)
    energy = pooled(smooth.square() / (chance * weights.square().sum()), torch.full_like(x, 1 / len(x)))
    return smooth * (1 - plain / energy.clamp(min=1e-9)).clamp(min=0.0)


def _alike(level: Tensor) -> Tensor:
    """Product of two sensors' levels `(record, sensor, time)` over their means, mean of all pairs, `(record, time)`."""
    p = level.shape[-2]
    relative = level / level.mean(-1, keepdim=True).clamp(min=1e-300) - 1
    return (relative.sum(-2).square() - relative.square().sum(-2)) / (p * (p - 1))
