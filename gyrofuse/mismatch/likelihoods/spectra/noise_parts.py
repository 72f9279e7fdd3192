"""The noise of a simulation where spectra are compared: what is white in it, its AR1s, and its walk."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum, ar1_time_constants, atom_spectra
from gyrofuse.mismatch.signals.psd import Bands
from gyrofuse.noise.processes import AR1

_UNSEEN = 0.02  # share of the noise where a part is largest, below which it is not known to be there or not
_CHANCE = 0.15  # share of the noise that an AR1 or a walk may have by chance in the spectrum of white noise


@dataclass(frozen=True, eq=False)
class Parts:
    """The noise of a simulation in three parts: what is white, AR1s, and a walk.

    Attributes:
        base: Spectrum of the noise.
        f: Frequencies, cycles per sample, `(node,)`.
    """

    base: NoiseSpectrum
    f: Tensor

    @cached_property
    def coefficients(self) -> tuple[Tensor, Tensor, Tensor]:
        """Of the parts, `(sensor, atom)`: together those of the base.

        AR1s with time constants of half a record over `pi` and more look like a walk in every band. Those below three
        samples count as white if they are less than a third of the white noise.
        """
        fastest, faint = 3.0, 0.3
        c = self.base.coefficients
        tau = torch.tensor((0.0, 0.0, *ar1_time_constants(self.base.n_samples), math.inf), dtype=c.dtype)
        walk = (tau >= self.base.n_samples / (2 * math.pi) / 2.2).expand_as(c)
        fast = ((tau < fastest) & (tau > 0)).expand_as(c)
        height = (c / (1 - torch.exp(-1 / tau.clamp(min=1e-9))).square())[:, fast[0]].sum(-1, keepdim=True)
        white = (tau == 0) | (fast & (height < faint * c[:, :1]))
        zero = torch.zeros_like(c)
        return torch.where(white, c, zero), torch.where(white | walk, zero, c), torch.where(walk, c, zero)

    @cached_property
    def densities(self) -> Tensor:
        """Of the parts, `(part, sensor, node)`."""
        return torch.stack(self.coefficients) @ atom_spectra(self.base.n_samples, self.f)

    @cached_property
    def _slowest(self) -> Tensor:
        """Density of every atom with coefficient one at one cycle per record, `(atom,)`."""
        return atom_spectra(self.base.n_samples, torch.tensor([1 / self.base.n_samples], dtype=self.f.dtype))[:, 0]

    @cached_property
    def growing_walk(self) -> Tensor:
        """Variance of the increments of a walk that grows, `(sensor,)`: of the one there is, or of one not seen.

        One that grew cannot be distinguished from one that came in: both are other numbers, and no physics left out.
        What stands for a walk by chance, or in short records, may level off; one that grew does not.
        """
        lacking = (_UNSEEN * self.base.coefficients - self.coefficients[2]) @ self._slowest
        return self.coefficients[2].sum(-1) + lacking.clamp(min=0) / self._slowest[-1]

    @cached_property
    def grown(self) -> Tensor:
        """Density of that walk, `(sensor, node)`."""
        return self.growing_walk[:, None] * atom_spectra(self.base.n_samples, self.f)[-1]

    @cached_property
    def unseen_white(self) -> Tensor:
        """Variance of white noise that records would not show below the rest, `(sensor,)`; 0 where they show it."""
        fastest = atom_spectra(self.base.n_samples, torch.tensor([0.5], dtype=self.f.dtype))[:, 0]
        return ((_UNSEEN * self.base.coefficients - self.coefficients[0]) @ fastest).clamp(min=0)

    @cached_property
    def unseen_ar1(self) -> tuple[float, Tensor]:
        """Inverse time constant of an AR1 that records would not show, and its plateaus `(sensor, 1)`.

        The plateau is 0 for sensors that have AR1s, more than chance would make of none from ten cycles per record on.
        Of a white simulation, noise with a memory is other numbers.
        """
        lowest, n_frequencies = 10, 60
        n, c = self.base.n_samples, self.base.coefficients
        middle = math.sqrt(0.5 / n)  # cycles per sample
        f = torch.logspace(math.log10(lowest / n), math.log10(0.5), n_frequencies, dtype=c.dtype)
        has = ((self.coefficients[1] @ atom_spectra(n, f)) / self.base.spectrum(f)).amax(-1, keepdim=True) > _CHANCE
        plateau = _UNSEEN * self.base.spectrum(torch.tensor([middle], dtype=c.dtype))
        return 2 * math.pi * middle, torch.where(has, 0.0, plateau)

    @cached_property
    def lacks(self) -> Tensor:
        """Which sensors show no more of a part than chance makes of none, `(part, sensor)`."""
        has_walk = self.coefficients[2] @ self._slowest > _CHANCE * (self.base.coefficients @ self._slowest)
        return torch.stack([self.unseen_white > 0, self.unseen_ar1[1][:, 0] > 0, ~has_walk])

    @cached_property
    def _corners(self) -> tuple[Tensor, Tensor]:
        """Inverse time constants `(atom, 1, 1)` of the AR1s that some sensor has, and plateaus `(atom, sensor, 1)`."""
        rate = 1 / torch.tensor(ar1_time_constants(self.base.n_samples), dtype=torch.float64)
        plateau = (self.coefficients[1][:, 2:-1] / (1 - torch.exp(-rate)).square()).mT
        has = (plateau > 0).any(-1)
        return rate[has][:, None, None], plateau[has][..., None]

    def moments(self) -> tuple[Tensor, Tensor]:
        """Variance of the AR1s together, and their corner, cycles per sample, `(sensor,)`, weighted by variance."""
        rate, plateau = (x[..., 0] for x in self._corners)  # (atom, 1), (atom, sensor)
        phi = torch.exp(-rate)
        variances = plateau * (1 - phi) / (1 + phi)
        total = variances.sum(0)
        return total, (variances * rate).sum(0) / total.clamp(min=1e-300) / (2 * math.pi)

    def shifted(self, log_factors: Tensor) -> Tensor:
        """Density with other numbers, `(..., sensor, node)`.

        Args:
            log_factors: Of the power of what is white, of the AR1s' plateaus, of their corners, and of the walk's
                increments, `(..., 4, sensor)`.
        """
        white, level, corner, walk = log_factors.clamp(-30, 30).exp()[..., None].unbind(-3)  # (..., sensor, 1)
        whites = white * self.densities[0] + (white - 1).clamp(min=0) * self.unseen_white[:, None]
        walks = walk.clamp(max=1) * self.densities[2] + (walk - 1).clamp(min=0) * self.grown
        slower, tiny = self.unseen_ar1
        phi = torch.exp(-corner * slower)
        new = (level - 1).clamp(min=0) * AR1._spectrum(self.f, phi, tiny * (1 - phi).square())
        # What chance makes of none is not to grow beside it.
        level, corner = (torch.where(tiny > 0, 1.0, x) for x in (level, corner))
        rate, plateau = self._corners
        phi = torch.exp(-corner[..., None, :, :] * rate)  # (..., atom, sensor, 1)
        coloured = AR1._spectrum(self.f, phi, plateau * (1 - phi).square()).sum(-3)
        return whites + level * coloured + new + walks


@dataclass(frozen=True, eq=False)
class Ground:
    """The noise of a simulation in bands.

    Attributes:
        base: Spectrum of the noise, as it comes to the converter.
        bands: Where spectra are compared.
        shown: Density of the noise as it left the converter, `(sensor, node)`, which may have stop bands and humps that
            no simple spectrum has; None where it is that of the base.
        rounding: Variance that the converters of both sides add at last, `(sensor,)`; None without.
    """

    base: NoiseSpectrum
    bands: Bands
    shown: Tensor | None = None
    rounding: Tensor | None = None

    @cached_property
    def nodes(self) -> Tensor:
        """Frequencies whose means stand for bands, cycles per sample, `(node,)`."""
        return self.bands.nodes

    @cached_property
    def parts(self) -> Parts:
        return Parts(self.base, self.nodes)

    @cached_property
    def density(self) -> Tensor:
        """Before the converter, `(sensor, node)`."""
        if self.shown is None:
            return self.parts.densities.sum(0)
        if self.rounding is None:
            return self.shown
        least = 1e-3
        return (self.shown - self.rounding[:, None]).maximum(least * self.shown)

    @cached_property
    def mean(self) -> Tensor:
        """`(sensor, band)`."""
        return self.bands.mean_of(self.density)

    @cached_property
    def whole(self) -> Tensor:
        """The same after the converter, `(sensor, band)`."""
        return self.mean if self.rounding is None or self.shown is None else self.bands.mean_of(self.shown)

    @cached_property
    def rounded(self) -> tuple[Tensor | float, Tensor | float]:
        """Shares of a power that came to the converter, and that it added, `(band, sensor)`."""
        if self.rounding is None:
            return 1.0, 0.0
        share = (self.mean / self.whole).mT
        return share, 1 - share

    @cached_property
    def matters(self) -> Tensor:
        """Which parts have a twentieth of the noise in some band, or may have come in anew, `(part, sensor)`."""
        white, coloured, walk = self.parts.densities
        possible = torch.stack([white, coloured, torch.maximum(walk, self.parts.grown)])
        matters = (self.bands.mean_of(possible) / self.mean).amax(-1) > 1 / 20
        matters[:2] |= self.parts.lacks[:2]
        return matters
