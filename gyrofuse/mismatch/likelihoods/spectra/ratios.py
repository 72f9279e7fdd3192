"""Likelihood of a recording's cross-spectra given those of a reference, for any model of them.

In a band with `d` ordinates of the recording and `s` of the reference the ratio `r` of a sensor's powers is F
distributed around `m`, what a model makes of the reference's power. With `q = r / m`

    log L(m) / L(1) = -d log m - (d + s) [log(1 + d q / s) - log(1 + d r / s)],
    score in log m:   d s (q - 1) / (s + d q),      information:  d s / (d + s + 1).

The reference's spectrum is a nuisance that drops out of the ratio; an exact one is `s` without bound, which makes this
Whittle's likelihood. What sensors share shows in their correlation matrices, Wishart's law given the powers,

    -c [log det G + tr G^-1 K],   G of the model, K of the recording,

with `c = d` where the reference's sensors are independent, so that nothing about it is estimated, else `d s / (d + s)`.
Powers of sensors that share noise vary together: they count as often as a band has independent ones (a composite
likelihood of the powers with weights that make its mean right; Varin, Reid and Firth, 2011).

A reference drawn from a model that was itself fitted has fewer ordinates than it shows (`Records.n_records`). What the
errors of its numbers do to spectra is in `nuisance`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.coherence import smooth_coherence
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground

# Share of the reference's power that is added to both sides of a ratio, -40 dB: below that leakage of the tapers and
# the rounding of converters are what powers show.
FLOOR = 1e-4


@dataclass(frozen=True, eq=False)
class Ratios:
    """Cross-spectra of a recording over those of its reference, and how well they are known.

    Attributes:
        ground: Noise of the reference.
        observed: Cross-spectra of the recording over the reference's powers, `(band, sensor, sensor)`.
        expected: Coherences of the reference, `(band, sensor, sensor)`.
        d, s: Complex ordinates of both, `(band,)`; `s` is 0 where there is no reference.
        usable: Which powers count, 0 or 1, `(band, sensor)`.
        pair_dof: Complex ordinates of a correlation, `(band,)`; 0 where none counts.
        together: Sensors whose ratios vary with that of each, `(band, sensor)`: itself, and others by the square of
            their correlation.
        power: Powers of the reference, `(band, sensor)`.
    """

    ground: Ground
    observed: Tensor
    expected: Tensor
    d: Tensor
    s: Tensor
    usable: Tensor
    pair_dof: Tensor
    together: Tensor
    power: Tensor

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
        power = torch.where(known[:, None] > 0, power.clamp(min=1e-300), ground.whole.mT)
        size = power.rsqrt()
        pair_dof = known * (d if independent else d * s / (d + s).clamp(min=1e-300))
        ratios = matrices * (size[:, :, None] * size[:, None, :])
        # The variance of a log ratio is 1 / d + 1 / s, and what two have in common of either is a squared coherence.
        seen, share = smooth_coherence(correlations(matrices), d), s / (d + s).clamp(min=1e-300)
        alike = share[:, None, None] * seen.abs().square() + (1 - share[:, None, None]) * expected.abs().square()
        together = alike.sum(-1).clamp(min=1.0)
        return cls(ground, ratios, expected, d, s, usable * known[:, None], pair_dof * usable.amin(-1), together, power)

    @property
    def n_sensors(self) -> int:
        return self.observed.shape[-1]

    @cached_property
    def ratio(self) -> Tensor:
        """Ratios of powers, with the floor, `(band, sensor)`."""
        return floored(self.observed.diagonal(dim1=-2, dim2=-1).real)

    @cached_property
    def information(self) -> Tensor:
        """Information on a power in `log m`, `(band,)`."""
        return self.d * self.s / (self.d + self.s + 1)

    @cached_property
    def weight(self) -> Tensor:
        """Weight of a power, `(band, sensor)`: less than one where sensors share noise."""
        return self.usable / self.together

    @cached_property
    def independent(self) -> bool:
        """Whether the reference's sensors are independent, so that no filter changes a correlation."""
        return float((self.expected - torch.eye(self.n_sensors)).abs().max()) < 1e-9  # rounding

    @cached_property
    def odds(self) -> Tensor:
        """Ratios of sums of powers in place of means, `(band, sensor)`."""
        return self.d[:, None] * self.ratio / self.s.clamp(min=1e-300)[:, None]

    @cached_property
    def log_unchanged(self) -> Tensor:
        """Log likelihood of powers without a difference, `(band, sensor)`, weights not counted."""
        return (self.d + self.s.clamp(min=1e-300))[:, None] * self.odds.log1p()

    @cached_property
    def correlation(self) -> Tensor:
        """Correlation matrices of the recording, `(band, sensor, sensor)`."""
        return correlations(self.observed)

    @cached_property
    def log_correlated(self) -> Tensor:
        """Log likelihood of the correlations without a difference, `(band,)`."""
        return _wishart(self.expected, self.correlation, self.pair_dof)

    @property
    def n_ordinates(self) -> float:
        """Complex ordinates of all bands of a sensor together."""
        return float((self.information * self.usable.amax(-1)).sum())

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
    d, s = data.d[:, None], data.s.clamp(min=1e-300)[:, None]
    m = floored(m)
    return data.weight * (data.log_unchanged - (d + s) * (data.odds / m).log1p() - d * m.log())


def power_scores(data: Ratios, m: Tensor) -> Tensor:
    """Slope of the log likelihood of powers `(..., band, sensor)` in their logarithms, without their shares."""
    d, s = data.d[:, None], data.s[:, None]
    q = data.ratio / floored(m)
    return d * s * (q - 1) / (s + d * q).clamp(min=1e-300)


def log_gain(data: Ratios, model: Tensor, *, paired: bool = True) -> Tensor:
    """Log likelihood of a model `(band, sensor, sensor)` over none, `(band,)`, nats."""
    gain = power_gains(data, model.diagonal(dim1=-2, dim2=-1).real).sum(-1)
    if paired and bool((data.pair_dof > 0).any()):
        gain = gain + _wishart(correlations(model), data.correlation, data.pair_dof) - data.log_correlated
    return gain


def _wishart(model: Tensor, observed: Tensor, dof: Tensor) -> Tensor:
    root, bad = torch.linalg.cholesky_ex(model)
    inside = torch.cholesky_solve(observed, root).diagonal(dim1=-2, dim2=-1).real.sum(-1)
    determinant = 2 * root.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).log().sum(-1)
    score = (-(dof * (determinant + inside))).nan_to_num(nan=-math.inf).masked_fill(bad > 0, -math.inf)
    return score.masked_fill(dof == 0, 0.0)


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
    cells = data.weight
    total = float((cells * deviance / mean).sum())
    p_value = float(stats.chi2.sf(total, max(float(cells.sum()), 1.0)))
    return Fitness(p_value, (cells * (deviance - mean)).sum(0) / 2)


def correlations(matrices: Tensor) -> Tensor:
    """Matrices `(..., sensor, sensor)` over the roots of their diagonals."""
    size = matrices.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).rsqrt()
    return matrices * (size[..., :, None] * size[..., None, :])


def exact(d: Tensor) -> Tensor:
    """Ordinates of a reference whose spectrum is known, for a recording's `(band,)`: any number beyond all data."""
    return torch.full_like(d, 1e12)
