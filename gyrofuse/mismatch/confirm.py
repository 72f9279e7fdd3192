"""Confirmation on data that a repair has not seen: each fold of blocks with numbers estimated from the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.classifier import distinguishability
from gyrofuse.mismatch.evidence import Evidence
from gyrofuse.mismatch.folds import N_FOLDS, N_JUDGED, held_out_blocks, in_fold
from gyrofuse.mismatch.mechanism import Mechanism, Z
from gyrofuse.mismatch.remainder import Remainder
from gyrofuse.mismatch.remembered import remembered
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


def held_out_gain(case: Case, effect: Mechanism) -> Gain:
    """Gain in log score of one mechanism on every block, its numbers estimated without the block's fold."""
    refitted = tuple(effect.refitted(case, fold) for fold in range(N_FOLDS))
    blocks = torch.empty(N_JUDGED, dtype=torch.float64)
    for fold, one in enumerate(refitted):
        blocks[in_fold(N_JUDGED, fold)] = one.gains(case, fold)
    as_found = sum(float(effect.gains(case, fold).sum()) for fold in range(N_FOLDS))
    return Gain(blocks, refitted, as_found)


def held_out(start: Case, gains: Sequence[Gain], generator: torch.Generator) -> HeldOut:
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
                    effect = effect.refitted(repaired, fold)
                repaired = effect.explained(repaired, generator)
                effects.append(effect)
            simulated = start
            for effect in sorted(effects, key=lambda effect: effect.order):
                simulated = effect.built_into(simulated, generator)  # what was cleaned shows that it was
            after.append((discrepancy_of_fold(repaired, fold), distinguishability(simulated, fold)))
    (d, auc), (d_after, auc_after) = (
        torch.tensor(folds, dtype=torch.float64).mean(0).tolist() for folds in (before, after)
    )
    return HeldOut(d, d_after, total, total - reach, total + reach, auc, auc_after)


def sd_of_sum(blocks: Tensor) -> float:
    """Standard deviation of a sum over blocks, from their scatter."""
    return float(blocks.std()) * math.sqrt(len(blocks))


def leads_away(start: Case, case: Case, gain: Gain, generator: torch.Generator) -> bool:
    """Whether a simulation with one mechanism more is farther from the recording than it was, or than it came.

    On the blocks that each fold holds out, and beside lines that both have: filters act on those as well, and tones
    have mechanisms of their own. Likelihoods are those of the noise's smooth spectrum: where the simulation has a hump
    of its own, which that does not have, another one beside it seems to gain much, and doubles it. A level that jumps
    seems to be noise that is louder at times.

    Args:
        start: Recording and simulation as they came.
        case: As far as explained.
        gain: Of the mechanism.
        generator: Of what is built into the simulation.
    """
    if not any(effect.changes_noise for effect in gain.refitted):
        return False
    repaired = (_noise(effect.explained(case, generator)) for effect in gain.refitted)
    after = sum(discrepancy_of_fold(one, fold) for fold, one in enumerate(repaired)) / N_FOLDS
    before = min(mean_discrepancy(_noise(start)), mean_discrepancy(_noise(case)))
    return after > _FARTHER * max(before, 1.0)


def discrepancy_left(case: Case, after: float) -> Evidence | None:
    """What wavelet cross-covariances say where much of their difference is left, beside known lines; else None.

    Args:
        case: Recording and simulation after all repairs.
        after: Discrepancy on the blocks held out.
    """
    if case.simulated.lines:  # whose power hardly scatters from block to block: the smallest error would stand out
        case = _noise(case)
        after = mean_discrepancy(case)
    if not after > _EXPLAINED:
        return None
    moments = _simulated_moments(case)
    recorded = _block_moments(_cut(case.recording, _length(case)))
    apart = (recorded.mean(0) - moments.mean(0)).square() / moments.var(0)
    by_level = apart.view(_levels_of(_length(case)), -1).mean(-1)
    levels = tuple(int(j) + 1 for j in (by_level > by_level.max() / 2).nonzero()[:, 0])
    return Evidence(
        "discrepancy",
        discrepancy_p_value(case, after),
        f"wavelet cross-covariances on blocks held out differ by {after:.2f} times what noise alone gives, most of all "
        f"at {'level' if len(levels) == 1 else 'levels'} {', '.join(map(str, levels))}",
        sensors=tuple(range(case.n_sensors)),
        levels=levels,
    )


def discrepancy_p_value(case: Case, discrepancy: float) -> float:
    """p value of a discrepancy that is one in the mean, from the law of F.

    Degrees of freedom are those of correlated squares, `m^2 / tr R^2` with `R` the correlations of the `m` moments of
    the simulation's blocks (Satterthwaite, Biometrics Bulletin 2, 1946). That mean is of four folds; it is taken for
    that of one, which errs on the side of chance.
    """
    moments = _simulated_moments(case)
    n_simulated, n_moments = moments.shape
    together = torch.corrcoef(moments.mT).nan_to_num().square().sum()
    return float(stats.f.sf(discrepancy, n_moments**2 / float(together), n_simulated - 1))


def _noise(case: Case) -> Case:
    """Without the lines that the simulation has."""
    if not case.simulated.lines:
        return case
    recorded, simulated = (replace(side, signal=side.noise, lines=()) for side in (case.recorded, case.simulated))
    return replace(case, recorded=recorded, simulated=simulated)


@remembered
def mean_discrepancy(case: Case) -> float:
    """Of all blocks of the recording, by folds."""
    return sum(discrepancy_of_fold(case, fold) for fold in range(N_FOLDS)) / N_FOLDS


def discrepancy_of_fold(case: Case, fold: int) -> float:
    """Squared difference of wavelet cross-covariances over its variance, mean over levels and pairs of sensors.

    On the blocks of the recording that a fold holds out, against all of the simulation, which also tell the variance.
    """
    blocks = _cut(held_out_blocks(case.recording, fold), _length(case))  # (sensor, block, piece, time)
    recorded = _block_moments(blocks.flatten(1, 2))
    simulated = _simulated_moments(case)
    n_recorded, n_simulated = len(recorded), len(simulated)
    variance = simulated.var(0) * (1 / n_recorded + 1 / n_simulated)
    # The variance is itself estimated, as in Student's distribution.
    expected = (n_simulated - 1) / (n_simulated - 3)
    return float(((recorded.mean(0) - simulated.mean(0)).square() / variance).mean()) / expected


@remembered
def _simulated_moments(case: Case) -> Tensor:
    """Of all blocks of the simulation, as long as those that are judged, `(block, moment)`."""
    return _block_moments(_cut(case.simulated.signal, _length(case))).flatten(0, 1)


def _length(case: Case) -> int:
    """Samples of a block: fewer where a short simulation would not have enough of them to tell their scatter."""
    return min(case.n_samples // N_JUDGED, case.simulated.signal.shape[-1] // _FEWEST_SIMULATED)


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
