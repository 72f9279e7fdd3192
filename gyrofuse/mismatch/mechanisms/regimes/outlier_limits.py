"""Limits of rate and amplitude of outliers, from the likelihood of each with all else at its best.

Its curvature would not do: the likelihood of a few outliers a little above the noise falls off steeply towards fewer
and larger ones, and hardly at all towards many faint ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from scipy import optimize
from torch import Tensor

from gyrofuse.mismatch.likelihoods.laws.outlier_law import Array, Outliers, Sample, bounds_of
from gyrofuse.mismatch.stats.limits import Z

_STEP, _LONGER = 0.15, 1.5  # of the way outwards: first, logarithm, and each next over the one before
_NEAR = 0.02  # logarithm


def with_limits(z: Tensor, law: Outliers) -> Outliers:
    """With limits of a law that was fitted to values `(time,)`."""
    sample = Sample(z)
    best = [math.log(law.rate), math.log(law.amplitude), math.log(law.spread / law.height), math.log(law.scale)]
    rate, amplitude = (_limits(sample, best, k) for k in (0, 1))
    return law._replace(rate_limits=rate, amplitude_limits=amplitude)


def _limits(sample: Sample, best: list[float], k: int) -> tuple[float, float]:
    """Where the likelihood of number `k`, all others at their best, is as far below its maximum as 95 % allow."""
    bounds = bounds_of(sample.n)
    others = [j for j in range(len(best)) if j != k]
    most = sample.deviance(best)[0] + Z**2 / 2

    def excess_from(rest: list[float]) -> Callable[[float], float]:
        def excess(value: float) -> float:
            def deviance(theta: Array) -> tuple[float, Array]:
                total, slopes = sample.deviance([*theta[:k], value, *theta[k:]])
                return total, slopes[others]

            run = optimize.minimize(deviance, rest, method="L-BFGS-B", jac=True, bounds=[bounds[j] for j in others])
            rest[:] = run.x
            return float(run.fun) - most

        return excess

    low, high = (math.exp(_crossing(excess_from([best[j] for j in others]), best[k], end)) for end in bounds[k])
    return low, high


def _crossing(excess: Callable[[float], float], start: float, end: float) -> float:
    """Where `excess` rises above zero on the way from `start`, where it is below, to `end`; that if nowhere."""
    inner, step = start, math.copysign(_STEP, end - start)
    while inner != end:
        outer = inner + step if abs(step) < abs(end - inner) else end
        if excess(outer) > 0:
            while abs(outer - inner) > _NEAR:
                middle = (inner + outer) / 2
                inner, outer = (inner, middle) if excess(middle) > 0 else (middle, outer)
            return outer
        inner, step = outer, _LONGER * step
    return end
