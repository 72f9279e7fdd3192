"""The level of the noise: whether it changes, within the recording or for a while from that of the simulation.

Four statistics of whitened samples, over the level that recording and simulation both have:

- Range of the CUSUM of squares, in each sensor and in all together: Kuiper's law, studentised where the simulation is
  not Gaussian.
- Autocorrelation of the squares at lags up to 15 (bursts): a standard normal sum, or the simulation's own.
- Likelihood ratio of a stretch of another level, averaged (`stats.level_scan`), alone and with the simulation's level.
- Spectrum of the squares (`modulation`).

Where the simulation is Gaussian and shows such a change itself, the recording's has to surpass it; elsewhere laws take
their variance from it (`level_spread`).

References:
    Inclan and Tiao, Use of cumulative sums of squares for retrospective detection of changes of variance, JASA 89
    (1994), 913.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CERTAIN, CHANCE
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.variance.level_spread import LevelSpread, level_spread
from gyrofuse.mismatch.detectors.variance.modulation import Modulation, strongest_modulation
from gyrofuse.mismatch.detectors.variance.normality import SQUARE_CUT, gaussian_sensors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.level_scan import LevelScan, Reference, other_level, scanned_levels
from gyrofuse.mismatch.stats.local_level import local_level
from gyrofuse.mismatch.stats.long_run_variance import (
    LAGS,
    chi_square_nodes,
    clustering_p_value,
    kuiper_p_value,
    studentised_range_p_value,
)
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_reference, p_value_from_e_value, sidak
from gyrofuse.mismatch.stats.segments import episodes_of, two_level_scores

_BLOCK = 128  # samples of a mean of the CUSUM: short against any change that it is to find


class Levels(NamedTuple):
    """The recording's level beside the simulation's.

    Attributes:
        reference: Level of the simulation.
        scan: Scan for a stretch of the recording with another level than the rest and the simulation.
        throughout: Logarithm of the mean likelihood ratio of another level throughout, nats.
        p_value: p value of the scan, where a stretch is likelier than another level throughout; else 1.
    """

    reference: Reference
    scan: LevelScan
    throughout: float
    p_value: float


def _white(side: Records) -> Tensor:
    """Whitened records `(record, sensor, time)`, none of them nearer to zero than rounding leaves known.

    Else a run of values on one step would be a quiet stretch.
    """
    expected = left_out(side)
    return expected.white.sign() * expected.white.abs().maximum(expected.grain[..., None])


@derived
def _scanned(side: Records) -> LevelScan:
    """Scan of all the records, in which the level would change at the same times."""
    return scanned_levels(_white(side).flatten(0, 1).square().clamp(max=SQUARE_CUT))


@derived
def level_profile(comparison: Comparison) -> Tensor | None:
    """Variance in episodes that both sides have, `(sensor, time)`; `None` without such.

    A level that changes at the same times in both fits the recording better where it lies than moved around in it by
    any of 64 shifts; two that vary by themselves do so once in 64.
    """
    white, n = _white(comparison.reference), comparison.n_samples
    if white.shape[-1] != n or _scanned(comparison.reference).p_value > CERTAIN:
        return None
    found = episodes_of(white.flatten(0, 1))
    if found is None:
        return None
    factor = found.factor.view(white.shape[:-1]).log().mean(0).exp()
    inside, observed = found.inside(n), _white(comparison.observed)[0].clamp(-3.0, 3.0)
    fits = [float(two_level_scores(observed, factor, inside.roll(k * n // 64)).sum()) for k in range(64)]
    return torch.where(inside, factor[:, None], 1.0) if fits[0] == max(fits) else None


def _levelled(comparison: Comparison, white: Tensor) -> Tensor:
    """Whitened samples `(..., sensor, time)` over the level that recording and simulation both have."""
    profile = level_profile(comparison)
    return white if profile is None else white / profile.sqrt()


@derived
def levelled(comparison: Comparison) -> Tensor:
    """Whitened recording `(sensor, time)` over the level that the simulation has there."""
    return _levelled(comparison, _white(comparison.observed)[0])


def levelled_squares(comparison: Comparison) -> Tensor:
    """Its squares, cut at nine, `(sensor, time)`."""
    return levelled(comparison).square().clamp(max=SQUARE_CUT)


def _levelled_simulation(comparison: Comparison) -> Tensor:
    """Whitened simulation `(record, sensor, time)`, likewise."""
    return _levelled(comparison, _white(comparison.reference))


@derived
def own_spread(comparison: Comparison) -> LevelSpread:
    """How much the simulation's level varies, beside a course that the recording has as well."""
    return level_spread(_levelled_simulation(comparison), gaussian_sensors(comparison.reference))


@derived
def variance_p_values(comparison: Comparison) -> Tensor:
    """Smaller p values of the CUSUM's range and of bursts, in each sensor and in all together, `(sensor + 1,)`."""
    white, other = levelled(comparison), _levelled_simulation(comparison)
    if bool(gaussian_sensors(comparison.reference).all()):
        rows = zip(_gaussian_p_values(white), _gaussian_p_values(other[0]), strict=True)
        p_values = torch.tensor([p_value_beyond_reference(*pair) for pair in rows], dtype=torch.float64).view(2, -1)
    else:
        spread = own_spread(comparison)
        ranges = _ranges(_with_sum(white), spread.excess).tolist()
        own, reference = (_with_sum(v / local_level(v).sqrt()) for v in (white, other))
        pairs = zip(own, reference.movedim(1, 0), strict=True)
        p_values = torch.tensor(
            [
                [studentised_range_p_value(r, spread.dof) for r in ranges],
                [clustering_p_value(x[None], y) for x, y in pairs],
            ],
            dtype=torch.float64,
        )
    return 1 - (1 - p_values.amin(0)).square()


def _gaussian_p_values(white: Tensor) -> list[float]:
    """p values for Gaussian noise `(sensor, time)`: of ranges in each sensor and in all together, then of bursts."""
    squares = _with_sum(white)
    bursts = torch.special.ndtr(-_clustering(squares, white))
    return [
        *map(kuiper_p_value, _ranges(squares, torch.ones(len(squares), dtype=white.dtype)).tolist()),
        *bursts.tolist(),
    ]


def _with_sum(white: Tensor) -> Tensor:
    """`min(e^2, 9)` of whitened samples `(..., sensor, time)`, and last of all their standardised sum."""
    squares = white.square().clamp(max=SQUARE_CUT)
    return torch.cat([squares, _standardised(squares).sum(-2, keepdim=True)], -2)


def _standardised(values: Tensor) -> Tensor:
    return (values - values.mean(-1, keepdim=True)) / values.std(-1, keepdim=True)


def _ranges(squares: Tensor, excess: Tensor) -> Tensor:
    """Range of the CUSUM of `(row, time)` in blocks over its sd: that of a Brownian bridge.

    Args:
        squares: Squares of whitened samples, `(row, time)`.
        excess: Long-run variance of such squares over that of independent ones, `(row,)`.
    """
    blocks = squares[..., : squares.shape[-1] // _BLOCK * _BLOCK].unflatten(-1, (-1, _BLOCK)).mean(-1)
    # From first differences, which bursts raise; chance must not lower it below that of independent samples.
    least = squares.std(-1) * (excess / _BLOCK).sqrt()
    sd = (blocks.diff(dim=-1).square().mean(-1) / 2).sqrt().maximum(least)
    path = (blocks - blocks.mean(-1, keepdim=True)).cumsum(-1)
    return (path.amax(-1) - path.amin(-1)) / (sd * math.sqrt(blocks.shape[-1]))


def _clustering(squares: Tensor, white: Tensor) -> Tensor:
    """Standard normal sum of the autocorrelations of squares at short lags, `(sensor + 1,)`.

    Beyond those that Gaussian samples have which are still correlated.

    Args:
        squares: Squares and last of all their sum, `(sensor + 1, time)`.
        white: Samples, `(sensor, time)`.
    """
    n, of_samples = squares.shape[-1], correlations_of_squares(white).sum(0)
    # The sum of standardised squares has the mean of the correlations of its sensors.
    expected = torch.cat([of_samples, of_samples.mean(-1, keepdim=True)])
    return math.sqrt(n / LAGS) * (_autocorrelations(squares).sum(0) - expected)


def correlations_of_squares(white: Tensor) -> Tensor:
    """Autocorrelations of squares that Gaussian samples `(sensor, time)` have which are still correlated.

    Behind a filter too steep to be whitened; `rho^2` where `rho` is beyond 4 sd of chance, `(lag, sensor)`.
    """
    rho = _autocorrelations(white)
    return torch.where(rho.abs() < 4.0 / math.sqrt(white.shape[-1]), 0.0, rho.square())


def _autocorrelations(values: Tensor) -> Tensor:
    """Autocorrelations of `(..., time)` at lags from one to `LAGS`, `(lag, ...)`."""
    x = _standardised(values)
    lags = [torch.linalg.vecdot(x[..., lag:], x[..., :-lag]) for lag in range(1, LAGS + 1)]
    return torch.stack(lags) / x.shape[-1]


def _averaged(comparison: Comparison, log_ratio: Callable[[Tensor], float]) -> float:
    """p value of a mean likelihood ratio that depends on the weight of a sample, averaged over the weight's law."""
    spread = own_spread(comparison)
    if math.isinf(spread.dof):
        return p_value_from_e_value(log_ratio(spread.weight))
    factors, shares = chi_square_nodes(spread.dof)
    return sum(
        share * p_value_from_e_value(log_ratio((factor * spread.weight).clamp(max=1)))
        for factor, share in zip(factors.tolist(), shares.tolist(), strict=True)
    )


@derived
def compared_levels(comparison: Comparison) -> Levels | None:
    """The level of the recording beside that of the simulation; `None` where that has none that is steady."""
    reference, weight = _reference(comparison), own_spread(comparison).weight
    own = _scanned(comparison.reference).p_value
    if reference is None or own < CERTAIN:
        return None
    squares = levelled_squares(comparison)
    scan = scanned_levels(squares, reference, weight)
    throughout = other_level(comparison.n_samples, reference, weight)
    if scan.log_ratio <= throughout:
        return Levels(reference, scan, throughout, 1.0)
    p_value = _averaged(comparison, lambda w: scanned_levels(squares, reference, w).log_ratio)
    return Levels(reference, scan, throughout, p_value_beyond_reference(p_value, own))


def level_between(comparison: Comparison, inside: Tensor) -> Reference | None:
    """The simulation's level, where the recording has it outside of episodes `(time,)`; `None` where it has another."""
    compared = compared_levels(comparison)
    if compared is None or bool(inside.all()):
        return None
    squares = levelled_squares(comparison)
    outside = squares[:, ~inside].mean(-1) / squares.mean(-1)
    sd = math.sqrt(2 / int((~inside).sum()) + 2 / compared.reference.n_samples)
    z = (outside / compared.reference.level).log() / sd
    chi2 = (own_spread(comparison).weight * z.square()).sum()
    agrees = torch.special.gammaincc(torch.tensor(len(z) / 2, dtype=z.dtype), chi2 / 2)
    return compared.reference if float(agrees) > 0.01 else None  # one true level in a hundred is not recognised


def _reference(comparison: Comparison) -> Reference | None:
    """The simulation's level over that of the recording: of their spectra, on average over all frequencies."""
    observed, reference = comparison.observed, comparison.reference
    both = (observed.dof > 0) & (reference.dof > 0)
    if not bool(both.any()):
        return None
    weight, ratio = observed.dof * both, reference.log_power - observed.log_power
    level = (torch.where(both, ratio, 0.0) @ weight / weight.sum()).exp()
    known = reference.n_records * reference.signal.shape[-1]
    if reference.uncertainty is not None:  # a model's level is known as well as from the record it was fitted to
        known = min(known, reference.uncertainty.n_samples)
    return Reference(level, known)


def variance_p_value(comparison: Comparison) -> float:
    """p value that the noise level changes in one sensor or all, or by little in several.

    The latter once within the recording, and once for a while from the simulation's level.
    """
    each = variance_p_values(comparison)
    squares = levelled_squares(comparison)
    several = _averaged(comparison, lambda w: scanned_levels(squares, None, w).log_ratio)
    if math.isinf(own_spread(comparison).dof) and level_profile(comparison) is None:
        several = p_value_beyond_reference(several, _scanned(comparison.reference).p_value)
    compared = compared_levels(comparison)
    beside = 1.0 if compared is None else compared.p_value
    return sidak(min(sidak(float(each.min()), len(each)), several, beside), 3)


@derived
def modulation(comparison: Comparison) -> Modulation:
    """The most conspicuous modulation of the noise level, with its p value beyond that of the simulation."""
    found = modulation_of(levelled(comparison))
    if found.p_value > CHANCE:
        return found
    other = min(modulation_of(record).p_value for record in _levelled_simulation(comparison))
    return found._replace(p_value=p_value_beyond_reference(found.p_value, other))


def modulation_of(white: Tensor) -> Modulation:
    """The most conspicuous modulation of whitened samples `(sensor, time)`."""
    return strongest_modulation(white.square().clamp(max=SQUARE_CUT), correlations_of_squares(white))


def variance_test(comparison: Comparison) -> TestResult:
    """Changes of the noise level within the recording: once, in bursts, slowly or with a period."""
    changed, wave = variance_p_value(comparison), modulation(comparison)
    p_value = sidak(min(changed, wave.p_value), 2)
    if wave.p_value < changed:
        high = wave.high * comparison.info.rate
        how = f"with a frequency of {high:.5g} Hz" if wave.period else f"more slowly than {high:.3g} Hz"
        return TestResult(
            "variance",
            p_value,
            f"a noise level that goes up and down {how} in {comparison.info.named(wave.sensors, 'all sensors')}",
            sensors=wave.sensors,
            levels=(1,),
            frequency_hz=high if wave.period else None,
        )
    worst = int(variance_p_values(comparison).argmin())
    every = worst == comparison.n_sensors
    squares = levelled_squares(comparison)
    path = _standardised(squares.mean(0) if every else squares[worst]).cumsum(-1)
    onset = min(int(path.argmin()), int(path.argmax())) + 1
    where = "all sensors together" if every else f"sensor {comparison.info.sensors[worst]}"
    return TestResult(
        "variance",
        p_value,
        f"a noise level that changes in {where}",
        sensors=tuple(range(comparison.n_sensors)) if every else (worst,),
        levels=(1,),
        time_s=onset / comparison.info.rate,
    )
