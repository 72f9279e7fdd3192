"""The level of the noise: whether it changes, by itself or compared with that of the simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.variance.level_spread import LevelSpread, level_spread
from gyrofuse.mismatch.detectors.variance.modulation import Modulation, strongest_modulation
from gyrofuse.mismatch.detectors.variance.normality import SQUARE_CUT, gaussian_sensors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.brownian_range import kuiper_p_value, studentised_range_p_value
from gyrofuse.mismatch.stats.clustering import LAGS, clustering_p_value
from gyrofuse.mismatch.stats.level_scan import LevelScan, Reference, other_level, scanned_levels
from gyrofuse.mismatch.stats.local_level import local_level
from gyrofuse.mismatch.stats.long_run_variance import chi_square_nodes
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_reference, p_value_from_e_value, sidak
from gyrofuse.mismatch.stats.segments import episodes_of, two_level_scores

_NOTHING = 0.05  # p value of what need not be compared
LEVEL_CUT = SQUARE_CUT  # squares: as where it is asked whether levels vary by themselves
_BLOCK = 128
_CHANGES = 1.62  # range of a stationary CUSUM that one in ten exceeds
_CORRELATED = 4.0  # standard deviations of an autocorrelation that chance does not give
_ANOTHER = 0.01  # p value of a level that the simulation does not have
_PLACES = 64  # around the record, at which a course of the level is tried: by chance one in so many fits best
_UNSTEADY = 1e-4  # p value of a simulation's level that changes


class Levels(NamedTuple):
    """What the simulation's level tells of the recording's.

    Attributes:
        reference: The simulation's level.
        scan: For a stretch of the recording that has another level than the rest and the simulation.
        throughout: Log of the mean likelihood ratio of another level throughout, nats.
        p_value: Of the scan, where a stretch is likelier than another level throughout; else 1.
    """

    reference: Reference
    scan: LevelScan
    throughout: float
    p_value: float


def _squares(white: Tensor) -> Tensor:
    """`min(e^2, 9)` of whitened records `(..., sensor, time)`, and last of all their sum over the sensors."""
    squares = white.square().clamp(max=LEVEL_CUT)
    return torch.cat([squares, _standardised(squares).sum(-2, keepdim=True)], -2)


def _ranges(squares: Tensor, excess: Tensor | float = 1.0) -> Tensor:
    """Range of the CUSUM of `(..., time)` in blocks over its sd: Kuiper's, of a Brownian bridge.

    Args:
        squares: Of whitened samples.
        excess: Long-run variance of such squares over that of independent ones, `(...,)`.
    """
    blocks = squares[..., : squares.shape[-1] // _BLOCK * _BLOCK].unflatten(-1, (-1, _BLOCK)).mean(-1)
    # From first differences, which bursts raise; chance must not lower it below that of independent samples.
    least = squares.std(-1) * (torch.as_tensor(excess, dtype=squares.dtype) / _BLOCK).sqrt()
    sd = (blocks.diff(dim=-1).square().mean(-1) / 2).sqrt().maximum(least)
    path = (blocks - blocks.mean(-1, keepdim=True)).cumsum(-1)
    return (path.amax(-1) - path.amin(-1)) / (sd * math.sqrt(blocks.shape[-1]))


def _white(side: Records) -> Tensor:
    """Whitened records `(record, sensor, time)`, none of them nearer to zero than rounding leaves known.

    Else a run of values on one step would be a quiet stretch.
    """
    expected = left_out(side)
    return expected.white.sign() * expected.white.abs().maximum(expected.grain[..., None])


@derived
def _scanned(side: Records) -> LevelScan:
    """Scan of all the records, in which the level would change at the same times."""
    return scanned_levels(_white(side).flatten(0, 1).square().clamp(max=LEVEL_CUT))


@derived
def level_profile(comparison: Comparison) -> Tensor | None:
    """Variance of the noise that the simulation gives each sample, `(sensor, time)`; None where it has no such course.

    A level that changes at the same times in both, by one course, fits the recording better where it lies than moved
    around in it; two that vary by themselves do not.
    """
    if (
        comparison.reference.signal.shape[-1] != comparison.n_samples
        or _scanned(comparison.reference).p_value > _UNSTEADY
    ):
        return None
    white = _white(comparison.reference)
    found = episodes_of(white.flatten(0, 1), torch.zeros(white[..., 0].numel() + 1, dtype=torch.float64))
    if found is None:
        return None
    factor = found.factor.view(white.shape[:-1]).log().mean(0).exp()
    inside, observed = found.inside(comparison.n_samples), _white(comparison.observed)[0].clamp(-3.0, 3.0)
    moved = (inside.roll(place * comparison.n_samples // _PLACES) for place in range(_PLACES))
    fits = torch.stack([two_level_scores(observed, factor, there).sum() for there in moved])
    return torch.where(inside, factor[:, None], 1.0) if int(fits.argmax()) == 0 else None


@derived
def own_spread(comparison: Comparison) -> LevelSpread:
    """How much the simulation's level varies, beside a course that the recording has as well."""
    return level_spread(_simulated_white(comparison), gaussian_sensors(comparison.reference))


def _simulated_white(comparison: Comparison) -> Tensor:
    """Whitened simulation `(record, sensor, time)` over the level that both sides have."""
    profile = level_profile(comparison)
    white = _white(comparison.reference)
    return white if profile is None else white / profile.sqrt()


@derived
def levelled(comparison: Comparison) -> Tensor:
    """Whitened recording `(sensor, time)` over the noise level that the simulation has there."""
    profile = level_profile(comparison)
    white = _white(comparison.observed)[0]
    return white if profile is None else white / profile.sqrt()


@derived
def variance_p_values(comparison: Comparison) -> Tensor:
    """p values that the noise level changes, in each sensor and in all together, `(sensor + 1,)`.

    Once for episodes, from the range of the CUSUM, once for bursts, from the autocorrelation of the squares.
    """
    white, other = levelled(comparison), _simulated_white(comparison)
    squares, reference = _squares(white), _squares(other)
    spread = own_spread(comparison)
    if bool(gaussian_sensors(comparison.reference).all()):
        wander = (_ranges(reference).amax(0) / _CHANGES).clamp(min=1.0)
        heavy = (_clustering(reference[0], other[0]) - 2.5).clamp(min=0)
        if level_profile(comparison) is not None:
            wander, heavy = torch.ones_like(wander), torch.zeros_like(heavy)
        episodes = torch.tensor([kuiper_p_value(float(r)) for r in _ranges(squares) / wander], dtype=torch.float64)
        bursts = torch.special.ndtr(heavy - _clustering(squares, white))
    else:
        reach = _ranges(squares, spread.excess).tolist()
        episodes = torch.tensor([studentised_range_p_value(r, spread.dof) for r in reach], dtype=torch.float64)
        own, reference = (_squares(v / local_level(v).sqrt()) for v in (white, other))
        pairs = zip(own, reference.movedim(1, 0), strict=True)
        bursts = torch.tensor([clustering_p_value(x[None], y) for x, y in pairs], dtype=torch.float64)
    both = torch.minimum(episodes, bursts)
    return 1 - (1 - both).square()


def _averaged(comparison: Comparison, log_ratio: Callable[[Tensor], float]) -> float:
    """p value of a log mean likelihood ratio that depends on the weight of a sample, over what may be its value."""
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
    """The level of the recording beside that of the simulation; None where that has none that is steady."""
    reference, weight = _reference(comparison), own_spread(comparison).weight
    own = _scanned(comparison.reference).p_value
    if reference is None or own < _UNSTEADY:
        return None
    squares = levelled(comparison).square().clamp(max=LEVEL_CUT)
    scan = scanned_levels(squares, reference, weight)
    throughout = other_level(comparison.n_samples, reference, weight)
    if scan.log_ratio <= throughout:
        return Levels(reference, scan, throughout, 1.0)
    p_value = _averaged(comparison, lambda w: scanned_levels(squares, reference, w).log_ratio)
    return Levels(reference, scan, throughout, p_value_beyond_reference(p_value, own))


def level_between(comparison: Comparison, inside: Tensor) -> Reference | None:
    """The simulation's level, where the recording has it outside of episodes `(time,)`; None where it has another."""
    compared = compared_levels(comparison)
    if compared is None or bool(inside.all()):
        return None
    squares = levelled(comparison).square().clamp(max=LEVEL_CUT)
    outside = squares[:, ~inside].mean(-1) / squares.mean(-1)
    z = (outside / compared.reference.level).log() / math.sqrt(2 / int((~inside).sum()) + 2 / compared.reference.worth)
    chi2 = (own_spread(comparison).weight * z.square()).sum()
    agrees = torch.special.gammaincc(torch.tensor(len(z) / 2, dtype=z.dtype), chi2 / 2)
    return compared.reference if float(agrees) > _ANOTHER else None


def _reference(comparison: Comparison) -> Reference | None:
    """The simulation's level over that of the recording: of their spectra, on average over all frequencies."""
    observed, reference = comparison.observed, comparison.reference
    both = (observed.dof > 0) & (reference.dof > 0)
    worth = observed.dof * both
    if not bool(both.any()):
        return None
    ratio = reference.log_power - observed.log_power
    level = (torch.where(both, ratio, 0.0) @ worth / worth.sum()).exp()
    known = reference.n_records * reference.signal.shape[-1]
    if reference.uncertainty is not None:  # a model's level is known as well as from the record it was fitted to
        known = min(known, reference.uncertainty.n_samples)
    return Reference(level, known)


def variance_p_value(comparison: Comparison) -> float:
    """p value that the noise level changes anywhere: in one sensor or all, or by little in several.

    The latter once within the recording, and once from the simulation's level for a while.
    """
    each = variance_p_values(comparison)
    p_value = sidak(float(each.min()), len(each))
    squares = levelled(comparison).square().clamp(max=LEVEL_CUT)
    several = _averaged(comparison, lambda w: scanned_levels(squares, None, w).log_ratio)
    if math.isinf(own_spread(comparison).dof) and level_profile(comparison) is None:
        several = p_value_beyond_reference(several, _scanned(comparison.reference).p_value)
    compared = compared_levels(comparison)
    return sidak(min(p_value, several, 1.0 if compared is None else compared.p_value), 3)


@derived
def modulation(comparison: Comparison) -> Modulation:
    """The most conspicuous modulation of the noise level that the simulation does not have."""
    found = modulation_of(levelled(comparison))
    if found.p_value > _NOTHING:
        return found
    records = _simulated_white(comparison)
    other = min(modulation_of(record).p_value for record in records)
    return found._replace(p_value=p_value_beyond_reference(found.p_value, other))


def modulation_of(white: Tensor) -> Modulation:
    """Of whitened samples `(sensor, time)`."""
    return strongest_modulation(white.square().clamp(max=LEVEL_CUT), correlations_of_squares(white))


def correlations_of_squares(white: Tensor) -> Tensor:
    """Autocorrelations of squares that Gaussian samples `(sensor, time)` have which are still correlated.

    Behind a filter too steep to be whitened; `rho^2` where `rho` is more than chance gives, `(lag, sensor)`.
    """
    rho = _autocorrelations(white)
    return torch.where(rho.abs() < _CORRELATED / math.sqrt(white.shape[-1]), 0.0, rho.square())


def _standardised(values: Tensor) -> Tensor:
    return (values - values.mean(-1, keepdim=True)) / values.std(-1, keepdim=True)


def _clustering(squares: Tensor, white: Tensor) -> Tensor:
    """Standard normal sum of the autocorrelations of squares at short lags, `(sensor + 1,)`.

    Beyond those that Gaussian samples have which are still correlated.

    Args:
        squares: `(sensor + 1, time)`, of the sum last.
        white: `(sensor, time)`.
    """
    n, of_squares = squares.shape[-1], _autocorrelations(squares)
    of_samples = correlations_of_squares(white).sum(0)
    # The sum of standardised squares has the mean of what its sensors have.
    expected = torch.cat([of_samples, of_samples.mean(-1, keepdim=True)])
    return math.sqrt(n / LAGS) * (of_squares.sum(0) - expected)


def _autocorrelations(values: Tensor) -> Tensor:
    """Of `(..., time)` at lags from one, `(lag, ...)`."""
    x = _standardised(values)
    lags = [torch.linalg.vecdot(x[..., lag:], x[..., :-lag]) for lag in range(1, LAGS + 1)]
    return torch.stack(lags) / x.shape[-1]


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
    p_values = variance_p_values(comparison)
    worst = int(p_values.argmin())
    every = worst == comparison.n_sensors
    squares = levelled(comparison).square().clamp(max=LEVEL_CUT)
    blocks = avg_pool1d(squares.mean(0, keepdim=True) if every else squares[worst : worst + 1], _BLOCK)[0]
    path = (blocks - blocks.mean()).cumsum(-1)
    onset = min(int(path.argmin()), int(path.argmax())) + 1
    where = "all sensors together" if every else f"sensor {comparison.info.sensors[worst]}"
    return TestResult(
        "variance",
        p_value,
        f"a noise level that changes in {where}",
        sensors=tuple(range(comparison.n_sensors)) if every else (worst,),
        levels=(1,),
        time_s=onset * _BLOCK / comparison.info.rate,
    )
