"""Discrepancy of wavelet cross-covariances between recording and simulation, on blocks that are held out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, held_out_blocks
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.wavelets.covariance import wavelet_cross_covariance

_FARTHER = 1.5  # times the discrepancy: 587 arrays with effects that were repaired had at most 1.2
_FEWEST_SIMULATED = 8  # blocks of a simulation, for their scatter to be known
_SHORTEST = 8  # a block is so many times as long as its longest wavelet
EXPLAINED = 2.0  # discrepancy per degree of freedom, where noise alone gives 1, above which something is left


@derived
def mean_discrepancy(comparison: Comparison) -> float:
    """Mean of the discrepancies of all folds: 1 is what noise alone gives."""
    return sum(discrepancy_of_fold(comparison, fold) for fold in range(N_FOLDS)) / N_FOLDS


def discrepancy_of_fold(comparison: Comparison, fold: int) -> float:
    """Squared difference of wavelet cross-covariances over its variance, mean over levels and pairs of sensors.

    Args:
        comparison: Recording and simulation; all blocks of the simulation are used, which give the variance as well.
        fold: Number of the fold, whose blocks of the recording are compared.
    """
    blocks = _cut(
        held_out_blocks(_steady(comparison.observed)[0], fold), _length(comparison)
    )  # (sensor, block, piece, time)
    observed = _block_moments(blocks.flatten(1, 2))
    reference = _reference_moments(comparison)
    n_observed, n_reference = len(observed), len(reference)
    variance = reference.var(0) * (1 / n_observed + 1 / n_reference)
    # The variance is itself estimated, as in Student's distribution.
    expected = (n_reference - 1) / (n_reference - 3)
    return float(((observed.mean(0) - reference.mean(0)).square() / variance).mean()) / expected


class Differences(NamedTuple):
    """Moments of a recording's blocks less their means in a simulation.

    Attributes:
        blocks: `(block, moment)`.
        chance: Variance of the simulation's means, `(moment,)`.
    """

    blocks: Tensor
    chance: Tensor


def differences_of_fold(comparison: Comparison, fold: int) -> Differences:
    """Those of the blocks that a fold holds out."""
    blocks = _cut(held_out_blocks(_steady(comparison.observed)[0], fold), _length(comparison))
    reference = _reference_moments(comparison)
    return Differences(_block_moments(blocks.flatten(1, 2)) - reference.mean(0), reference.var(0) / len(reference))


def paired_discrepancy(folds: Sequence[Differences]) -> float:
    """Discrepancy by the scatter of the recording's own blocks, each held out once; 1 is what noise alone gives.

    Where what is left of a recording is louder at some times than at others, as in flight, blocks of a steady
    simulation say too little of how far chance takes its mean. The variance is estimated, as in Student's distribution.
    """
    apart = torch.cat([fold.blocks for fold in folds])
    n = len(apart)
    variance = apart.var(0) / n + folds[0].chance
    return float((apart.mean(0).square() / variance).mean()) * (n - 3) / (n - 1)


def leads_away(start: Comparison, comparison: Comparison, by_fold: tuple[Mechanism, ...], g: torch.Generator) -> bool:
    """Whether a simulation with one mechanism more is farther from the recording than it was, or than it came.

    On the blocks that each fold holds out, and beside spectral lines that both have: filters act on those as well, and
    tones have mechanisms of their own. Likelihoods are those of the noise's smooth spectrum: where the simulation has a
    peak of its own, which that does not have, another one beside it seems to score much, and doubles it. A level that
    jumps seems to be noise that is louder at times.

    Args:
        start: Recording and simulation as they came.
        comparison: The same as far as explained.
        by_fold: Mechanism with the numbers that each fold leaves.
        g: Source of the random numbers of what is applied to the simulation.
    """
    if not any(effect.changes_noise for effect in by_fold):
        return False
    repaired = (_without_lines(effect.repair(comparison, g)) for effect in by_fold)
    after = sum(discrepancy_of_fold(one, fold) for fold, one in enumerate(repaired)) / N_FOLDS
    before = min(mean_discrepancy(_without_lines(start)), mean_discrepancy(_without_lines(comparison)))
    return _is_farther(after, before)


def is_farther(made: Comparison, before: Comparison) -> bool:
    """Whether a simulation is farther from the recording than before, with its lines."""
    return _is_farther(mean_discrepancy(made), mean_discrepancy(before))


def _is_farther(after: float, before: float) -> bool:
    return after > _FARTHER * max(before, 1.0)


def discrepancy_left(comparison: Comparison, after: float) -> TestResult | None:
    """The discrepancy as a test result where much of it is left beside known spectral lines; else None.

    Args:
        comparison: Recording and simulation after all repairs.
        after: Discrepancy on the blocks held out.
    """
    if comparison.reference.lines:  # whose power hardly scatters from block to block: it would stand out by little
        comparison = _without_lines(comparison)
        after = mean_discrepancy(comparison)
    if not after > EXPLAINED:
        return None
    moments = _reference_moments(comparison)
    observed = _block_moments(_cut(_steady(comparison.observed)[0], _length(comparison)))
    apart = (observed.mean(0) - moments.mean(0)).square() / moments.var(0)
    by_level = apart.view(_levels_of(_length(comparison)), -1).mean(-1)
    levels = tuple(int(j) + 1 for j in (by_level > by_level.max() / 2).nonzero()[:, 0])
    return TestResult(
        "discrepancy",
        discrepancy_p_value(comparison, after),
        f"wavelet cross-covariances on blocks held out differ by {after:.2f} times what noise alone gives, most of all "
        f"at {'level' if len(levels) == 1 else 'levels'} {', '.join(map(str, levels))}",
        sensors=tuple(range(comparison.n_sensors)),
        levels=levels,
    )


def discrepancy_p_value(comparison: Comparison, discrepancy: float) -> float:
    """p value of a discrepancy that is one in the mean, from the law of F.

    Degrees of freedom are those of correlated squares, `m^2 / tr R^2` with `R` the correlations of the `m` moments of
    the simulation's blocks (Satterthwaite, Biometrics Bulletin 2, 1946). That mean is of four folds; it is taken for
    that of one, which errs on the side of chance.
    """
    moments = _reference_moments(comparison)
    n_reference, n_moments = moments.shape
    together = torch.corrcoef(moments.mT).nan_to_num().square().sum()
    return float(stats.f.sf(discrepancy, n_moments**2 / float(together), n_reference - 1))


def _without_lines(comparison: Comparison) -> Comparison:
    """Both sides without the spectral lines that the simulation has."""
    if not comparison.reference.lines:
        return comparison
    observed, reference = (
        replace(side, signal=side.noise, lines=()) for side in (comparison.observed, comparison.reference)
    )
    return replace(comparison, observed=observed, reference=reference)


@derived
def _steady(side: Records) -> Tensor:
    """Records `(record, sensor, time)` without a course of the level that both sides are known to have.

    Blocks of it are compared with those of all other times.
    """
    return side.steadied(side.signal)


@derived
def _reference_moments(comparison: Comparison) -> Tensor:
    """Moments of all blocks of the simulation, as long as those that are compared, `(block, moment)`."""
    return _block_moments(_cut(_steady(comparison.reference), _length(comparison))).flatten(0, 1)


def _length(comparison: Comparison) -> int:
    """Samples of a block: fewer where a short simulation would not have enough of them to show their scatter."""
    return min(comparison.n_samples // N_JUDGED, comparison.reference.signal.shape[-1] // _FEWEST_SIMULATED)


def _cut(signal: Tensor, length: int) -> Tensor:
    """Pieces of a length, `(..., time)` -> `(..., piece, time)`."""
    return signal[..., : signal.shape[-1] // length * length].unflatten(-1, (-1, length))


def _levels_of(length: int) -> int:
    """Wavelet levels of a block that long."""
    return int(math.log2(length / _SHORTEST))


def _block_moments(blocks: Tensor) -> Tensor:
    """Wavelet cross-covariances `(..., block, moment)` of blocks `(..., sensor, block, time)`."""
    n_levels = _levels_of(blocks.shape[-1])
    wccv = wavelet_cross_covariance(blocks.movedim(-2, -3), n_levels)  # (..., block, level, sensor, sensor)
    pairs = torch.triu_indices(wccv.shape[-1], wccv.shape[-1])
    return wccv[..., pairs[0], pairs[1]].flatten(-2)
