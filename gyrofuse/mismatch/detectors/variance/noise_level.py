"""The level of the noise: whether it changes, within the recording or for a while from that of the simulation.

Three statistics of squares of whitened samples, cut at nine:

- Likelihood ratio of a stretch of another level than the rest, averaged over stretches and factors (`level_scan`).
- The same with the simulation's level for that of the rest.
- Spectrum of the squares (`modulation`): periods, slow changes and bursts.

Where the simulation is Gaussian and shows such a change itself, the recording's has to surpass it; elsewhere likelihood
ratios are tempered by how much its level varies (`level_spread`).
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
from gyrofuse.mismatch.stats.long_run_variance import chi_square_nodes
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_reference, p_value_from_e_value, sidak
from gyrofuse.mismatch.stats.segments import stretch_of


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
def whitened_recording(comparison: Comparison) -> Tensor:
    """The whitened recording, `(sensor, time)`."""
    return _white(comparison.observed)[0]


def clipped_squares(comparison: Comparison) -> Tensor:
    """Squares of the whitened recording, cut at nine, `(sensor, time)`."""
    return whitened_recording(comparison).square().clamp(max=SQUARE_CUT)


@derived
def own_spread(comparison: Comparison) -> LevelSpread:
    """How much the simulation's level varies."""
    return level_spread(_white(comparison.reference), gaussian_sensors(comparison.reference))


def correlations_of_squares(white: Tensor) -> Tensor:
    """Autocorrelations of squares that Gaussian samples `(sensor, time)` have which are still correlated.

    Behind a filter too steep to be whitened; `rho^2` where `rho` is beyond 4 sd of chance, at lags from 1 to 15,
    `(lag, sensor)`.
    """
    x = (white - white.mean(-1, keepdim=True)) / white.std(-1, keepdim=True)
    n = x.shape[-1]
    rho = torch.stack([torch.linalg.vecdot(x[..., lag:], x[..., :-lag]) for lag in range(1, 16)]) / n
    return torch.where(rho.abs() < 4.0 / math.sqrt(n), 0.0, rho.square())


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
    squares = clipped_squares(comparison)
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
    squares = clipped_squares(comparison)
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


@derived
def variance_p_value(comparison: Comparison) -> float:
    """p value that the noise level changes for a while: within the recording, and from the simulation's."""
    squares, gaussian = clipped_squares(comparison), math.isinf(own_spread(comparison).dof)
    within = _averaged(comparison, lambda w: scanned_levels(squares, None, w).log_ratio)
    if gaussian:
        within = p_value_beyond_reference(within, _scanned(comparison.reference).p_value)
    elif within <= CHANCE:  # a level that goes up and down with a period varies less in the long run than it does
        theirs = _white(comparison.reference).flatten(0, 1).square().clamp(max=SQUARE_CUT)
        times = len(theirs) // comparison.n_sensors
        own = _averaged(comparison, lambda w: scanned_levels(theirs, None, w.repeat(times)).log_ratio)
        within = min(within / own**1.5, 1.0) if own <= CHANCE else within  # half as much again is no chance
    compared = compared_levels(comparison)
    return sidak(min(within, 1.0 if compared is None else compared.p_value), 2)


@derived
def modulation(comparison: Comparison) -> Modulation:
    """The most conspicuous modulation of the noise level, with its p value beyond that of the simulation."""
    found = modulation_of(whitened_recording(comparison))
    if found.p_value > CHANCE:
        return found
    other = min(modulation_of(record).p_value for record in _white(comparison.reference))
    return found._replace(p_value=p_value_beyond_reference(found.p_value, other))


def modulation_of(white: Tensor) -> Modulation:
    """The most conspicuous modulation of whitened samples `(sensor, time)`."""
    return strongest_modulation(white.square().clamp(max=SQUARE_CUT), correlations_of_squares(white))


def variance_test(comparison: Comparison) -> TestResult:
    """Changes of the noise level within the recording: for a while, in bursts, slowly or with a period."""
    changed, wave, info = variance_p_value(comparison), modulation(comparison), comparison.info
    p_value = sidak(min(changed, wave.p_value), 2)
    if wave.p_value < changed:
        high = wave.high * info.rate
        how = f"with a frequency of {high:.5g} Hz" if wave.period else f"more slowly than {high:.3g} Hz"
        return TestResult(
            "variance",
            p_value,
            f"a noise level that goes up and down {how} in {info.named(wave.sensors, 'all sensors')}",
            sensors=wave.sensors,
            levels=(1,),
            frequency_hz=high if wave.period else None,
        )
    stretch = stretch_of(whitened_recording(comparison))
    sensors = tuple((stretch.factor != 1).nonzero()[:, 0].tolist())
    return TestResult(
        "variance",
        p_value,
        f"a noise level that changes in {info.named(sensors, 'all sensors together')}",
        sensors=sensors,
        levels=(1,),
        time_s=stretch.episodes[0].start / info.rate,
    )
