"""How much the level of noise varies by itself, which a change of the recording's level has to surpass.

Squares of Gaussian noise of a steady level have the long-run variance `2 m^2`, `m` their mean. Where a simulation's
have more, `L`, means over stretches vary as if a sample counted for `2 m^2 / L`: log likelihood ratios of levels are
tempered by that, as for overdispersed counts. Levels of sensors that vary together count as fewer than they are.

References:
    McCullagh and Nelder, Generalized Linear Models, 1989, section 9.2.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.decisions import CHANCE
from gyrofuse.mismatch.detectors.variance.normality import SQUARE_CUT, gaussian_sensors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.level_scan import WINDOW, local_level
from gyrofuse.mismatch.stats.long_run_variance import long_run_variance


class LevelSpread(NamedTuple):
    """How much the level varies by itself.

    Attributes:
        weight: Weight of a sample in a log likelihood ratio, `(sensor,)`; 1 where the noise is Gaussian.
        dof: Degrees of freedom with which it is known.
    """

    weight: Tensor
    dof: float


def level_spread(white: Tensor, gaussian: Tensor) -> LevelSpread:
    """How much the level of a simulation varies, from the long-run variance of its squares cut at nine.

    Args:
        white: Whitened records, `(record, sensor, time)`.
        gaussian: Sensors that are Gaussian noise of a steady level, `(sensor,)`.
    """
    n_sensors = white.shape[1]
    if bool(gaussian.all()):
        return LevelSpread(torch.ones(n_sensors, dtype=white.dtype), math.inf)
    squares = white.square().clamp(max=SQUARE_CUT)
    spread = _SquareSpread.of(squares)
    value = spread.value.maximum(squares.var((0, -1)))
    weight = torch.where(gaussian, 1.0, (2 * squares.mean((0, -1)).square() / value).clamp(max=1))
    return LevelSpread(weight / spread.alike, float(spread.dof[~gaussian].min()))


class _SquareSpread(NamedTuple):
    """Long-run variances of squares, `(sensor,)`, their degrees of freedom, `(sensor,)`, and that of their mean.

    `alike` is the variance of the standardised mean over that of independent sensors, 1 at least.
    """

    value: Tensor
    dof: Tensor
    alike: float

    @classmethod
    def of(cls, squares: Tensor) -> _SquareSpread:
        """Estimates from `(record, sensor, time)`."""
        rows = [long_run_variance(squares[:, i]) for i in range(squares.shape[1])]
        value, dof = torch.tensor(rows, dtype=torch.float64).mT
        together = long_run_variance((squares / value.sqrt()[:, None]).sum(1)).value / len(rows)
        return cls(value, dof, max(together, 1.0))


def with_spread(comparison: Comparison, noise_samples: int = 0) -> Comparison:
    """The comparison with the number of samples that its simulation's powers are as certain as.

    Args:
        comparison: Recording and simulation.
        noise_samples: Samples of each sensor that the simulation was estimated from; 0 where it is no estimate.
    """
    side = comparison.reference
    effective_samples = min(noise_samples or math.inf, _effective_samples(side))
    varies = _log_power_variance(comparison.observed, side)
    return replace(comparison, reference=replace(side, effective_samples=effective_samples, level_variance=varies))


def _log_power_variance(observed: Records, reference: Records) -> Tensor:
    """Variance of the log ratio of recorded to simulated power beyond that of Gaussian noise, `(sensor,)`.

    All frequencies go up and down together by it: `(L/m^2 - 2)(1/n + 1/n')`, with `L` the upper limit of the long-run
    variance of squares, of the side on which it is larger; 0 where the simulation is Gaussian. Where sensors' levels
    vary together it counts for each of them as for all.
    """
    gaussian = gaussian_sensors(reference)
    if bool(gaussian.all()):
        return torch.zeros(len(gaussian), dtype=torch.float64)
    relative = torch.stack([_relative_variance(side)[1] for side in (observed, reference)]).amax(0)
    n = reference.signal.shape[0] * reference.signal.shape[-1]
    return (relative - 2).clamp(min=0) * (1 / n + 1 / reference.bands.n_samples) * ~gaussian


@derived
def level_variance(comparison: Comparison) -> Tensor:
    """Variance of the log of a sensor's whole power by chance beyond that of Gaussian noise, `(sensor,)`.

    That of the simulation, and of a Gaussian one that of what is left of the recording, where that is beyond doubt: a
    few outliers that stay unexplained, or noise that is heavy-tailed throughout, hold power that another stretch does
    not have.
    """
    known = torch.as_tensor(comparison.reference.level_variance, dtype=torch.float64).expand(comparison.n_sensors)
    gaussian = gaussian_sensors(comparison.observed)
    if bool(known.any()) or bool(gaussian.all()):
        return known
    least, relative = _relative_variance(comparison.observed)
    return (relative - 2).clamp(min=0) / comparison.n_samples * (~gaussian & (least > 2))


def _relative_variance(side: Records) -> tuple[Tensor, Tensor]:
    """Limits of the long-run variance of squares over their squared mean, lower and upper, `(sensor,)` each."""
    squares = left_out(side).white.square()
    spread = _SquareSpread.of(squares)
    value = spread.value * spread.alike / squares.mean((0, -1)).square()
    dof = spread.dof.numpy()
    upper, lower = (spread.dof / torch.from_numpy(stats.chi2.ppf(p, dof)) for p in (CHANCE, 1 - CHANCE))
    return lower * value, upper * value


@derived
def _effective_samples(side: Records) -> float:
    """Samples of noise of a steady level whose power in a band is as certain as that of this side.

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


def level_lasts(z: Tensor) -> bool:
    """Whether the level of values `(time,)` lasts over neighbouring samples, as in episodes: then it is none of these.

    By the correlations of the log moduli, which outliers hardly move, at distances of 1 to 9 samples: of one of them,
    or of all together, as where jumps or knocks take some samples each.
    """
    log_size = z.abs().clamp(min=1e-3 * float(z.abs().median())).log()
    log_size = log_size - log_size.mean()
    lags = [float((log_size[k:] * log_size[:-k]).mean() / log_size.square().mean()) for k in range(1, 10)]
    n, one, all_of_them = len(z), 0.1, 0.02  # a tenth: less than a seventh of the samples would last
    return max(lags) > max(one, 4 / math.sqrt(n)) or sum(lags) / 9 > max(all_of_them, 4 / math.sqrt(9 * n))
