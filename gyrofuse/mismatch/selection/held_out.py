"""Confirmation on data that a repair has not seen: each fold of blocks with numbers estimated from the others."""

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
from gyrofuse.mismatch.mechanisms.remainder import Remainder
from gyrofuse.mismatch.selection.classifier import distinguishability
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, held_out_blocks, in_fold
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.wavelets.covariance import wavelet_cross_covariance

_ACCEPTED_T = 1.0
_FARTHER = 1.5  # times the discrepancy: 587 arrays with effects that were repaired had at most 1.2
_BEYOND_DOUBT = 1e-6
_FEWEST_SIMULATED = 8  # blocks of a simulation
_SHORTEST = 8  # a block is so many times as long as its longest wavelet
_EXPLAINED = 2.0  # discrepancy per degree of freedom, where noise alone gives 1, above which something is left


class Gain(NamedTuple):
    """Gain in log score of a mechanism.

    Attributes:
        blocks: Of each block while it was held out, nats, `(block,)`.
        refitted: The mechanism of each fold.
        as_found: Of all blocks with the numbers that were found, nats.
    """

    blocks: Tensor
    refitted: tuple[Mechanism, ...]
    as_found: float

    @property
    def total(self) -> float:
        return float(self.blocks.sum())

    @property
    def sd(self) -> float:
        return sd_of_sum(self.blocks)

    def confirms(self, p_value: float) -> bool:
        """Whether a finding of that p value holds on the blocks held out.

        By more than its own scatter; for what is beyond doubt where it was found it is enough not to be worse, since
        many numbers cost much of what is held out. Numbers that hold only in the company of others do not pass.
        """
        return self.as_found > 0 and self.total > (0.0 if p_value < _BEYOND_DOUBT else _ACCEPTED_T * self.sd)


class HeldOut(NamedTuple):
    """Agreement of recording and simulation on data that no number was estimated from.

    Attributes:
        before: Discrepancy of wavelet cross-covariances per degree of freedom; 1 is what noise alone gives.
        after: The same with the repaired simulation.
        gain: Log score of the repair, nats, with 95 % limits `low` and `high`.
        auc_before: Area under the ROC curve of a classifier that tells windows of the one from windows of the other;
            0.5 is guessing.
        auc_after: The same of the recording as it came and what the repaired simulation makes.
    """

    before: float
    after: float
    gain: float
    low: float
    high: float
    auc_before: float
    auc_after: float

    def to_dict(self) -> dict[str, object]:
        """Plain numbers, ready for JSON."""
        gain = {"value": self.gain, "low": self.low, "high": self.high}
        auc = {"before": self.auc_before, "after": self.auc_after}
        return {"before": self.before, "after": self.after, "gain": gain, "auc": auc}


def held_out_gain(comparison: Comparison, effect: Mechanism) -> Gain:
    """Gain in log score of one mechanism on every block, its numbers estimated without the block's fold."""
    refitted = tuple(effect.fit_without(comparison, fold) for fold in range(N_FOLDS))
    blocks = torch.empty(N_JUDGED, dtype=torch.float64)
    for fold, one in enumerate(refitted):
        blocks[in_fold(N_JUDGED, fold)] = one.held_out_scores(comparison, fold)
    as_found = sum(float(effect.held_out_scores(comparison, fold).sum()) for fold in range(N_FOLDS))
    return Gain(blocks, refitted, as_found)


def held_out(start: Comparison, gains: Sequence[Gain], generator: torch.Generator) -> HeldOut:
    """Agreement before and after all repairs, on blocks that their numbers were not estimated from.

    Args:
        start: Recording and simulation as they came.
        gains: Of the findings, in order.
        generator: Of what is built into the simulation.
    """
    total, reach = sum(gain.total for gain in gains), 0.0
    if gains:
        reach = Z * sd_of_sum(torch.stack([gain.blocks for gain in gains]).sum(0))
    before = after = [(discrepancy_of_fold(start, fold), distinguishability(start, fold)) for fold in range(N_FOLDS)]
    if gains:
        after = []
        for fold in range(N_FOLDS):
            repaired, effects = start, []
            for effect in (gain.refitted[fold] for gain in gains):
                if isinstance(effect, Remainder):  # of what this fold's numbers leave
                    effect = effect.fit_without(repaired, fold)
                repaired = effect.repair(repaired, generator)
                effects.append(effect)
            reference = start
            for effect in sorted(effects, key=lambda effect: effect.order):
                reference = effect.apply_to_reference(reference, generator)  # what was cleaned shows that it was
            after.append((discrepancy_of_fold(repaired, fold), distinguishability(reference, fold)))
    (d, auc), (d_after, auc_after) = (
        torch.tensor(folds, dtype=torch.float64).mean(0).tolist() for folds in (before, after)
    )
    return HeldOut(d, d_after, total, total - reach, total + reach, auc, auc_after)


def sd_of_sum(blocks: Tensor) -> float:
    """Standard deviation of a sum over blocks, from their scatter."""
    return float(blocks.std()) * math.sqrt(len(blocks))


def leads_away(start: Comparison, comparison: Comparison, gain: Gain, generator: torch.Generator) -> bool:
    """Whether a simulation with one mechanism more is farther from the recording than it was, or than it came.

    On the blocks that each fold holds out, and beside lines that both have: filters act on those as well, and tones
    have mechanisms of their own. Likelihoods are those of the noise's smooth spectrum: where the simulation has a hump
    of its own, which that does not have, another one beside it seems to gain much, and doubles it. A level that jumps
    seems to be noise that is louder at times.

    Args:
        start: Recording and simulation as they came.
        comparison: As far as explained.
        gain: Of the mechanism.
        generator: Of what is built into the simulation.
    """
    if not any(effect.changes_noise for effect in gain.refitted):
        return False
    repaired = (_noise(effect.repair(comparison, generator)) for effect in gain.refitted)
    after = sum(discrepancy_of_fold(one, fold) for fold, one in enumerate(repaired)) / N_FOLDS
    before = min(mean_discrepancy(_noise(start)), mean_discrepancy(_noise(comparison)))
    return after > _FARTHER * max(before, 1.0)


def discrepancy_left(comparison: Comparison, after: float) -> TestResult | None:
    """What wavelet cross-covariances say where much of their difference is left, beside known lines; else None.

    Args:
        comparison: Recording and simulation after all repairs.
        after: Discrepancy on the blocks held out.
    """
    if (
        comparison.reference.lines
    ):  # whose power hardly scatters from block to block: the smallest error would stand out
        comparison = _noise(comparison)
        after = mean_discrepancy(comparison)
    if not after > _EXPLAINED:
        return None
    moments = _simulated_moments(comparison)
    observed = _block_moments(_cut(comparison.recording, _length(comparison)))
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
    moments = _simulated_moments(comparison)
    n_simulated, n_moments = moments.shape
    together = torch.corrcoef(moments.mT).nan_to_num().square().sum()
    return float(stats.f.sf(discrepancy, n_moments**2 / float(together), n_simulated - 1))


def _noise(comparison: Comparison) -> Comparison:
    """Without the lines that the simulation has."""
    if not comparison.reference.lines:
        return comparison
    observed, reference = (
        replace(side, signal=side.noise, lines=()) for side in (comparison.observed, comparison.reference)
    )
    return replace(comparison, observed=observed, reference=reference)


@derived
def mean_discrepancy(comparison: Comparison) -> float:
    """Of all blocks of the recording, by folds."""
    return sum(discrepancy_of_fold(comparison, fold) for fold in range(N_FOLDS)) / N_FOLDS


def discrepancy_of_fold(comparison: Comparison, fold: int) -> float:
    """Squared difference of wavelet cross-covariances over its variance, mean over levels and pairs of sensors.

    On the blocks of the recording that a fold holds out, against all of the simulation, which also tell the variance.
    """
    blocks = _cut(held_out_blocks(comparison.recording, fold), _length(comparison))  # (sensor, block, piece, time)
    observed = _block_moments(blocks.flatten(1, 2))
    reference = _simulated_moments(comparison)
    n_recorded, n_simulated = len(observed), len(reference)
    variance = reference.var(0) * (1 / n_recorded + 1 / n_simulated)
    # The variance is itself estimated, as in Student's distribution.
    expected = (n_simulated - 1) / (n_simulated - 3)
    return float(((observed.mean(0) - reference.mean(0)).square() / variance).mean()) / expected


@derived
def _simulated_moments(comparison: Comparison) -> Tensor:
    """Of all blocks of the simulation, as long as those that are judged, `(block, moment)`."""
    return _block_moments(_cut(comparison.reference.signal, _length(comparison))).flatten(0, 1)


def _length(comparison: Comparison) -> int:
    """Samples of a block: fewer where a short simulation would not have enough of them to tell their scatter."""
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
