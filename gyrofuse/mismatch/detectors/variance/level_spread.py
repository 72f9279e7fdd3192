"""How much the level of a simulation's noise varies by itself: what a change of the recording's has to surpass.

Squares of Gaussian noise of a steady level have the long-run variance `2 m^2`, `m` their mean. Where a simulation's
have more, `L`, means over stretches vary as if a sample counted for `2 m^2 / L`: log likelihood ratios of levels are
tempered by that, as for overdispersed counts (McCullagh and Nelder, Generalized Linear Models, 1989, section 9.2).
Levels of sensors that go together are fewer than they are.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.normality import SQUARE_CUT, gaussian_sensors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.local_level import WINDOW, local_level
from gyrofuse.mismatch.stats.long_run_variance import long_run_variance

_SURE = 0.05  # of chi-square: a long-run variance may be larger than estimated by what that allows


class LevelSpread(NamedTuple):
    """Of squares cut at nine.

    Attributes:
        excess: Their long-run variance over that of independent ones, in each sensor and in the sum, `(sensor + 1,)`.
        weight: What a sample counts for in a log likelihood ratio, `(sensor,)`; 1 where the noise is Gaussian.
        dof: Degrees of freedom with which both are known.
    """

    excess: Tensor
    weight: Tensor
    dof: float


def level_spread(white: Tensor, gaussian: Tensor) -> LevelSpread:
    """Of whitened records `(record, sensor, time)`.

    Args:
        white: Of the simulation.
        gaussian: Which sensors are Gaussian noise of a steady level.
    """
    n_sensors = white.shape[1]
    if bool(gaussian.all()):
        one = torch.ones(n_sensors + 1, dtype=white.dtype)
        return LevelSpread(one, one[:-1], math.inf)
    squares = white.square().clamp(max=SQUARE_CUT)
    mean, variance = squares.mean((0, -1)), squares.var((0, -1))
    rows = [long_run_variance(squares[:, i]) for i in range(n_sensors)]
    values = torch.tensor([row.value for row in rows], dtype=white.dtype).maximum(variance)
    weight = torch.where(gaussian, 1.0, (2 * mean.square() / values).clamp(max=1))
    standardised = (squares - mean[:, None]) / variance[:, None].sqrt()
    together = long_run_variance(standardised.sum(1))
    alike = (values / variance).sum() / max(together.value, 1e-300)  # below 1 where levels go together
    sum_excess = together.value / float(standardised.sum(1).var())
    excess = torch.cat([torch.where(gaussian, 1.0, values / variance), torch.tensor([max(sum_excess, 1.0)])])
    dof = min([together.dof, *(row.dof for i, row in enumerate(rows) if not gaussian[i])])
    return LevelSpread(excess, weight * alike.clamp(max=1), dof)


def with_spread(comparison: Comparison, noise_samples: int = 0) -> Comparison:
    """The case with what its simulation tells of how far powers vary by themselves.

    Args:
        comparison: Recording and simulation.
        noise_samples: Of each sensor that the simulation was estimated from; 0 where it is no estimate.
    """
    side = comparison.reference
    effective_samples = min(noise_samples or math.inf, known_samples(side))
    varies = level_variance(comparison.observed, side)
    return replace(comparison, reference=replace(side, effective_samples=effective_samples, level_variance=varies))


def level_variance(observed: Records, reference: Records) -> Tensor:
    """Variance of the logarithm of the ratio of recorded to simulated power beyond that of Gaussian noise, `(sensor,)`.

    All frequencies go up and down together by it: `(L/m^2 - 2)(1/n + 1/n')`, with `L` the long-run variance of squares,
    of the side on which it is larger and as large as it may be; 0 where the simulation is Gaussian. Where sensors'
    levels go together it counts for each of them as for all.
    """
    gaussian = gaussian_sensors(reference)
    variance = torch.zeros(len(gaussian), dtype=torch.float64)
    if bool(gaussian.all()):
        return variance
    both = torch.stack([_power_variance(side, gaussian) for side in (observed, reference)]).amax(0)
    n = reference.signal.shape[0] * reference.signal.shape[-1]
    return (both - 2).clamp(min=0) * (1 / n + 1 / reference.bands.n_samples) * ~gaussian


def _power_variance(side: Records, gaussian: Tensor) -> Tensor:
    """Long-run variance of squares, as large as it may be, over their squared mean, `(sensor,)`."""
    squares = left_out(side).white.square()
    rows = [long_run_variance(squares[:, i]) for i in range(len(gaussian))]
    values = torch.tensor([row.value for row in rows], dtype=torch.float64)
    sure = torch.tensor([row.dof / float(stats.chi2.ppf(_SURE, row.dof)) for row in rows], dtype=torch.float64)
    together = long_run_variance((squares / values.sqrt()[:, None]).sum(1)).value / len(rows)
    return sure * values / squares.mean((0, -1)).square() * max(together, 1.0)


@derived
def known_samples(side: Records) -> float:
    """Samples of noise of a steady level that tell a band's power as well as these.

    Power that comes at some times more than at others is the mean of fewer: `n / (1 + c^2)` with `c` the coefficient of
    variation of the local level; that of the recording, with as many fewer, is counted here as well.
    """
    n_records, _, n = side.signal.shape
    gaussian = gaussian_sensors(side)
    if bool(gaussian.all()):
        return math.inf
    level = local_level(left_out(side).white[:, ~gaussian])
    by_chance = 2 / WINDOW
    spread = max(float(level.var(-1).mean(0).max()) - by_chance, 0.0)
    return n_records * n / (1 + spread * (1 + n_records * n / side.bands.n_samples))
