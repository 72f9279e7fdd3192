"""Likelihood ratio of a smooth difference of power, averaged over its shape, size, sign and sensors.

The ratios of powers in bands follow the law of F (`likelihoods.spectra.ratios`). A shape is noise on top (white, blue,
flicker noise, a walk, AR1s, a peak), another level of everything, or a filter. Its size is what the deviance grows by
if it is weak, in standard deviations; its sign is up, down, or either sensor by sensor. Each sensor has the likelihood
ratio `E_i`; any share `e` of them may have the shape,

    prod_i (1 - e + e E_i),

which has expectation one where nothing differs, and so has the mean over all: an e-value (Vovk and Wang, Annals of
Statistics, 2021). Its p value is that of `stats.multiplicity`, 1/(20 x) for a mean of x: of 240 nulls of 4096 samples,
with 1, 3 and 6 sensors, half of them coherent, the mean exceeded 1 in eleven, 2 in two and 20 in one. Nuisance, levels
that vary by themselves and numbers of a fitted model, is profiled (`likelihoods.spectra.nuisance`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.variance.level_spread import level_variance
from gyrofuse.mismatch.likelihoods.spectra.components import oscillation
from gyrofuse.mismatch.likelihoods.spectra.data import ratios
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import filter_power, filter_strength
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.mismatch.likelihoods.spectra.nuisance import Nuisance, chi_square_p_value
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.stats.multiplicity import SHARES, e_values_by_share, p_value_from_e_value, sidak
from gyrofuse.noise.processes import AR1

# Standard deviations of a weak shape: from what many sensors together show to what exceeds every band.
_SIZES = 2.0 ** torch.arange(6, dtype=torch.float64)
_FREE = 1e6  # standard deviation of a log power by numbers of which nothing is known
_FEWEST = 10.0  # complex ordinates of a whole spectrum, below which there is nothing to compare


class Shapes(NamedTuple):
    """Differences of log power that are scanned.

    Attributes:
        log_factors: Differences, `(shape, sensor, band)`.
        log_prior: Logarithms of probabilities, `(shape,)`; classes of shapes have equal ones.
    """

    log_factors: Tensor
    log_prior: Tensor


class Scan(NamedTuple):
    """The averaged likelihood ratio and the likeliest shape.

    Attributes:
        log_ratio: Logarithm of the average.
        sensors: Sensors that have the likeliest shape.
        weight: Its deviance by band, `(band,)`.
        frequency: Middles of the bands, cycles per sample, `(band,)`.
        up: Whether powers are larger than the reference's.
    """

    log_ratio: float
    sensors: tuple[int, ...]
    weight: Tensor
    frequency: Tensor
    up: bool

    @property
    def p_value(self) -> float:
        """Bound on the probability of such an average where nothing differs."""
        return p_value_from_e_value(self.log_ratio)


class FittedScans(NamedTuple):
    """Spectra against those of a model whose numbers were fitted to another record.

    Attributes:
        exact: Scan as if the numbers were known.
        outside: Scan of what no numbers of the model's processes could make.
        parameters: p value of the numbers that would suit the recording (chi-square).
    """

    exact: Scan
    outside: Scan
    parameters: float

    @property
    def p_value(self) -> float:
        """p value of what allows for errors of the numbers."""
        return sidak(min(self.outside.p_value, self.parameters), 2)


def shape_test(comparison: Comparison) -> TestResult:
    """Smooth differences of power: coloured noise, levels, filters, modes, over all sensors that have them."""
    found = scanned(comparison)
    if found is None:
        return TestResult("shape", 1.0, "the simulation is too short to compare spectra with")
    inside = found.frequency[found.weight > 0.2 * found.weight.max()]
    log_frequency = (found.weight * found.frequency.log()).sum() / found.weight.sum()
    f = float(log_frequency.exp()) * comparison.info.rate
    return TestResult(
        "shape",
        shape_p_value(comparison),
        f"power is {'larger' if found.up else 'smaller'} than the simulation's, most of all around {f:.3g} Hz, in "
        f"{comparison.info.named(found.sensors, 'all sensors')}",
        sensors=found.sensors,
        levels=tuple(sorted({level_of(float(x)) for x in inside})),
        frequency_hz=f,
    )


@derived
def scanned(comparison: Comparison) -> Scan | None:
    """Scan of all shapes, by what no numbers of a fitted model can make; None where there is nothing to compare."""
    fitted = fitted_scans(comparison)
    if fitted is not None:
        return fitted.outside
    data = ratios(comparison)
    return _scan(Nuisance(data, _levels(comparison, data.ground)), comparison) if data.n_ordinates >= _FEWEST else None


@derived
def fitted_scans(comparison: Comparison) -> FittedScans | None:
    """Scans of spectra against those of a fitted model; None where the reference is none."""
    uncertainty, data = comparison.reference.uncertainty, ratios(comparison)
    if uncertainty is None or data.n_ordinates < _FEWEST:
        return None
    levels, f = _levels(comparison, data.ground), data.ground.bands.frequency
    rows = uncertainty.rows(f)
    sizes = rows.norm(dim=1, keepdim=True).clamp(min=1e-300)
    parameters = Nuisance(data, _FREE * rows / sizes)
    return FittedScans(
        _scan(Nuisance(data, levels), comparison),
        _scan(replace(parameters, rows=torch.cat([levels, parameters.rows], -1)), comparison),
        chi_square_p_value(parameters, torch.cat([levels, rows @ uncertainty.root], -1)),
    )


def shape_p_value(comparison: Comparison) -> float:
    """p value of all scans of shapes; 1 where there is nothing to compare."""
    fitted, scan = fitted_scans(comparison), scanned(comparison)
    if fitted is not None:
        return fitted.p_value
    return 1.0 if scan is None else scan.p_value


def _scan(nuisance: Nuisance, comparison: Comparison) -> Scan:
    data, shapes = nuisance.data, _shapes(nuisance.data, comparison.n_samples)
    up, down = (nuisance.gains(sign * shapes.log_factors) for sign in (1, -1))
    signs = torch.stack([up, down, torch.logaddexp(up, down) - math.log(2)])  # (sign, shape, sensor)
    log_ratios = e_values_by_share(signs.movedim(-1, 0)) + shapes.log_prior  # (share, sign, shape)
    # torch.unravel_index would load sympy, a second and a half.
    share, sign, shape = (int(i) for i in np.unravel_index(int(log_ratios.argmax()), log_ratios.shape))
    own = torch.maximum(up, down)[shape] if sign == 2 else signs[sign, shape]
    sensors = tuple(int(i) for i in (own > math.log(1 / SHARES[share] - 1)).nonzero()[:, 0]) or (int(own.argmax()),)
    which = list(sensors)
    weight = (nuisance.weight * shapes.log_factors[shape])[which].square().mean(0)
    log_mean = float(log_ratios.flatten().logsumexp(0)) - math.log(len(SHARES) * len(signs))
    return Scan(
        log_mean,
        sensors,
        weight,
        data.ground.bands.frequency,
        float((up - down)[shape, which].sum()) > 0,
    )


def _levels(comparison: Comparison, ground: Ground) -> Tensor:
    """Log powers by what levels vary by themselves, `(sensor, band, error)`.

    Fast and slow noise have levels of their own, which may go together or not.
    """
    fast = (ground.base.fast().spectrum(ground.bands.frequency) / ground.base.spectrum(ground.bands.frequency)).clamp(
        max=1
    )
    sd = level_variance(comparison).sqrt()
    return torch.stack([fast, 1 - fast], -1) * sd[:, None, None]


def _shapes(data: Ratios, n_samples: int) -> Shapes:
    """All shapes in all sizes."""
    ground, f = data.ground, data.ground.nodes
    sine, mean_of = torch.sin(math.pi * f).square(), ground.bands.mean_of
    phi = torch.exp(-2 * math.pi * _corners(n_samples))[:, None]
    added = [
        *(density[None] for density in (torch.ones_like(f), sine, 1 / f, 1 / sine)),
        AR1._spectrum(f, phi, (1 - phi).square()),
        oscillation(f, *_peaks(n_samples).mT[..., None]),
    ]
    relative = mean_of(torch.cat(added))[:, None] / ground.whole  # (shape, sensor, band)
    corners = torch.tensor([0.01, 0.04, 0.12, 0.35], dtype=torch.float64)
    passed = filter_power("sampled", filter_strength("sampled", corners), f)
    filtered = (ground.whole - ground.mean + mean_of(ground.density * passed[:, None])) / ground.whole
    information = (data.information[:, None] * data.usable).mT

    def unit(weak: Tensor) -> Tensor:
        length = (information * weak.square()).sum(-1, keepdim=True).sqrt()
        return weak / length.clamp(min=1e-300)

    sizes = _SIZES[:, None, None, None]
    linear = torch.cat([unit(filtered.log()), unit(torch.ones_like(filtered[:1]))])
    log_factors = torch.cat([sizes * linear, torch.log1p(sizes * unit(relative))], 1)  # (size, shape, sensor, band)
    counts = torch.tensor([len(filtered), 1, *(len(part) for part in added)])
    prior = -(counts * len(counts) * len(_SIZES)).to(torch.float64).log().repeat_interleave(counts)
    return Shapes(log_factors.flatten(0, 1), prior.repeat(len(_SIZES)))


def _corners(n_samples: int) -> Tensor:
    """Corners of AR1s, two a decade from 0.3 cycles per sample to three cycles per record."""
    count = int(2 * math.log10(0.1 * n_samples)) + 1
    return 0.3 * 10 ** (-torch.arange(count, dtype=torch.float64) / 2)


def _peaks(n_samples: int) -> Tensor:
    """Centres half a width apart and half widths, cycles per sample, `(peak, 2)`.

    Half widths are 6 and 18 % of the centre: narrower ones have their own scan. Below 40 cycles per record a peak could
    not be told from an AR1.
    """
    found = []
    for share in (0.06, 0.18):
        step = math.log1p(share)
        count = int(math.log(0.49 * n_samples / 40) / step)
        centre = 0.49 * torch.exp(-step * torch.arange(count, dtype=torch.float64))
        found.append(torch.stack([centre, share * centre], -1))
    return torch.cat(found)
