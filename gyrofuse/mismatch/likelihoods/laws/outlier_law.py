"""Law of standardised values among which a few are outliers: in each sensor by itself, or in several at once.

A value is normal of sd `scale`, but with probability `rate` moved by a height of either sign with some spread. Outliers
of several sensors at once (a shock) share their times, and with it their rate.

References:
    Dempster, Laird and Rubin, Maximum likelihood from incomplete data via the EM algorithm, JRSS B 39 (1977), 1.
    Louis, Finding the observed information matrix when using the EM algorithm, JRSS B 44 (1982), 226.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize, special
from torch import Tensor

from gyrofuse.mismatch.stats.limits import Z

_RATIO, _RATIO_SD = (
    0.2,
    0.8,
)  # of spread to height beforehand: median, and sd of its logarithm, a factor of five at 2 sd

Array = NDArray[np.float64]
_Law = Callable[..., Array]


class Outliers(NamedTuple):
    """`z` is normal of sd `scale`, but with probability `rate` moved by `height`, of either sign, with sd `spread`.

    Attributes:
        rate: Probability of an outlier.
        height, spread: Mean and sd of their modulus, in sd of the noise as it was estimated.
        scale: Standard deviation of what is no outlier: a robust estimate of it is half a per cent off, which many
            faint outliers would have to make up for. rate_limits, amplitude_limits: 95 % limits of `rate` and
            `amplitude`.
    """

    rate: float
    height: float
    spread: float
    scale: float = 1.0
    rate_limits: tuple[float, float] = (math.nan, math.nan)
    amplitude_limits: tuple[float, float] = (math.nan, math.nan)

    @classmethod
    def none(cls) -> Outliers:
        """The law of noise without outliers."""
        return cls(0.0, 0.0, 0.0)

    @property
    def amplitude(self) -> float:
        """Root mean square of the outliers."""
        return math.hypot(self.height, self.spread)

    def scaled(self, z: Tensor) -> Outliers:
        """The law with the most likely scale for values `(time,)`, all else as it is; three rounds of EM settle it."""
        law = self
        for _ in range(3):
            plain = 1 - law.posterior(z)
            law = law._replace(scale=float(((plain * z.square()).sum() / plain.sum()).sqrt()))
        return law

    def times(self, factor: float) -> Outliers:
        """The law of values so many times as large."""
        height, spread, scale = (factor * size for size in (self.height, self.spread, self.scale))
        low, high = self.amplitude_limits
        return Outliers(self.rate, height, spread, scale, self.rate_limits, (factor * low, factor * high))

    def posterior(self, z: Tensor) -> Tensor:
        """Probability that each value is an outlier."""
        if self.rate <= 0:
            return torch.zeros_like(z)
        return torch.exp(math.log(self.rate) + _moved(z, self) - mixture(z, self))


def mixture(z: Tensor, law: Outliers) -> Tensor:
    """Log density of `z` under the law."""
    plain = gaussian(z, law.scale**2)
    return torch.logaddexp(math.log1p(-law.rate) + plain, math.log(max(law.rate, 1e-300)) + _moved(z, law))


def free_gaussian(z: Tensor) -> Tensor:
    """Log density of `z` under a normal law of its own variance."""
    return gaussian(z, z.square().mean())


def gaussian(z: Tensor, variance: Tensor | float) -> Tensor:
    """Log density of a normal law of mean zero."""
    variance = torch.as_tensor(variance, dtype=z.dtype)
    return -z.square() / (2 * variance) - (2 * math.pi * variance).log() / 2


def _moved(z: Tensor, law: Outliers) -> Tensor:
    """Log density of outliers."""
    variance = law.scale**2 + law.spread**2
    return torch.logaddexp(gaussian(z - law.height, variance), gaussian(z + law.height, variance)) - math.log(2)


class Sample:
    """Moduli of values, of which the many small ones are counted in 600 bins, with the likelihood of laws of outliers.

    A few outliers a little above the noise hardly determine how far their moduli spread, and with a wide spread they
    may be any number of faint ones. Beforehand the spread is held to be a fifth of the height within a factor of five.

    Args:
        z: Values, `(time,)`.
    """

    def __init__(self, z: Tensor) -> None:
        size, (bulk, bins) = z.abs(), (6.0, 600)  # a bin of 0.01 sd is narrow against any law
        counts = torch.histc(size[size < bulk], bins, 0.0, bulk)
        centres = (torch.arange(bins, dtype=torch.float64) + 0.5) * (bulk / bins)
        large = size[size >= bulk]
        self.values, self.counts = torch.cat([centres, large]), torch.cat([counts, torch.ones_like(large)])
        self.n = float(self.counts.sum())
        self._values, self._counts = self.values.numpy(), self.counts.numpy()

    def deviance(self, theta: Sequence[float] | Array) -> tuple[float, Array]:
        """Minus the log likelihood of `law_of(theta)` and the log prior density of its spread, nats, and their slopes.

        By expectation over which values are outliers, and on which side (Fisher's identity).
        """
        law, v = law_of(list(theta)), self._values
        q = (law.spread / law.height) ** 2
        plain, moved = law.scale**2, law.scale**2 + law.spread**2
        up, down = (v - law.height) ** 2 / (2 * moved), (v + law.height) ** 2 / (2 * moved)
        hit = np.logaddexp(-up, -down) - math.log(8 * math.pi * moved) / 2
        spared = -(v**2) / (2 * plain) - math.log(2 * math.pi * plain) / 2
        mixed = np.logaddexp(math.log1p(-law.rate) + spared, math.log(law.rate) + hit)
        weight = self._counts * np.exp(math.log(law.rate) + hit - mixed)
        upper = weight * special.expit(down - up)
        number = float(weight.sum())
        number_plain = self.n - number
        by_height = float((2 * upper - weight) @ v - number * law.height) / moved
        by_moved = (float(upper @ up + (weight - upper) @ down) - number / 2) / moved
        by_plain = (float((self._counts - weight) @ v**2) / (2 * plain) - number_plain / 2) / plain
        spread = 2 * law.spread**2 * by_moved
        slopes = np.array(
            [
                number - number_plain * law.rate / (1 - law.rate),
                law.height * by_height + spread,
                (spread - q * law.height * by_height) / (1 + q),
                2 * plain * (by_moved + by_plain),
            ]
        )
        off = (math.log(q) / 2 - math.log(_RATIO)) / _RATIO_SD
        slopes[2] -= off / _RATIO_SD
        return off**2 / 2 - float(self._counts @ mixed), -slopes


def law_of(theta: Sequence[float]) -> Outliers:
    """The law of log rate, log amplitude, log of spread over height, log scale."""
    rate, amplitude, ratio, scale = (math.exp(v) for v in theta)
    height = amplitude / math.hypot(1.0, ratio)
    return Outliers(rate, height, ratio * height, scale)


def bounds_of(n: float) -> list[tuple[float, float]]:
    """Bounds of the numbers of `law_of` for `n` values: a fifth of an outlier to a third of all; 5 % of the scale."""
    return [(math.log(0.2 / n), math.log(0.3)), (math.log(0.3), math.log(1e4)), (math.log(0.01), 1.0), (-0.05, 0.05)]


def fitted(z: Tensor) -> Outliers:
    """Most likely rate, height, spread and scale of values `(time,)`.

    Started from the values beyond 3, 4 and 6 sd: many faint outliers, some, and few large ones.
    """
    sample = Sample(z)
    values, counts, n = sample.values, sample.counts, sample.n
    starts = []
    for level, least in ((3.0, 3.0), (4.0, 6.0), (6.0, 8.0)):
        beyond = values > level
        number = float(counts[beyond].sum())
        height = float((counts * values)[beyond].sum()) / number if level == 6.0 and number else least
        starts.append([math.log(max(number, 1.0) / n), math.log(height), math.log(_RATIO), 0.0])
    runs = [_minimised(sample.deviance, start, bounds_of(n), slopes=True) for start in starts]
    return law_of(min(runs, key=lambda run: float(run.fun)).x.tolist())


def _minimised(
    deviance: Callable[..., Any], start: Sequence[float], bounds: Sequence[tuple[float, float]], *, slopes: bool = False
) -> optimize.OptimizeResult:
    """The least of a function, which gives its slopes as well or has them taken by differences."""
    return optimize.minimize(deviance, start, method="L-BFGS-B", jac=slopes, bounds=bounds, options={"maxiter": 60})


def clustered(white: Tensor) -> bool:
    """Whether outliers of `(sensor, time)` lie together, as those of loud episodes do.

    Six of ten values beyond 3.5 sd have another one beyond 2.5 sd 2 to 9 samples off: of white noise two of ten have.
    """
    steps = torch.arange(2, 10)
    near = int(steps[-1])
    for row in white.abs():
        events = (row > 3.5).nonzero()[:, 0]
        events = events[(events >= near) & (events < len(row) - near)]
        if len(events) < 4:
            continue
        around = row[events[:, None] + torch.cat([-steps, steps])]
        if float((around.amax(-1) > 2.5).to(torch.float64).mean()) > 0.6:
            return True
    return False


def shock_scores(z: Tensor, laws: list[Outliers]) -> Tensor:
    """Log likelihood ratio of shocks to standard normal values, `(time,)`: sensors of a rate above 0 are hit at once.

    Args:
        z: Values, `(sensor, time)`.
        laws: Law of each sensor; the largest rate is that of the shocks.
    """
    rate = max(law.rate for law in laws)
    return torch.logaddexp(torch.tensor(math.log1p(-rate), dtype=z.dtype), math.log(rate) + _moved_together(z, laws))


def shock_posterior(z: Tensor, laws: list[Outliers]) -> Tensor:
    """Probability that each sample of `(sensor, time)` is hit, `(time,)`."""
    return torch.exp(math.log(max(law.rate for law in laws)) + _moved_together(z, laws) - shock_scores(z, laws))


def _moved_together(z: Tensor, laws: list[Outliers]) -> Tensor:
    """Log density of hit samples over that of standard normal ones, `(time,)`."""
    hit = ((row, law) for row, law in zip(z, laws, strict=True) if law.rate > 0)
    return sum((_moved(row, law) - gaussian(row, 1.0) for row, law in hit), torch.zeros_like(z[0]))


def fitted_shock(z: Tensor, start: list[Outliers], rounds: int) -> list[Outliers]:
    """Maximum likelihood of shocks by expectation and maximisation, with 95 % limits from the scores.

    Args:
        z: Values, `(sensor, time)`.
        start: Laws to start from; sensors of rate 0 are not hit.
        rounds: Number of rounds of EM.
    """
    laws, hit = list(start), [i for i, law in enumerate(start) if law.rate > 0]
    for _ in range(rounds):
        weight = shock_posterior(z, laws)
        total = float(weight.sum())
        if total < 1e-9:  # none is hit together with all others
            break
        for i in hit:
            law, row = laws[i], z[i]
            height = float((weight * row * torch.tanh(law.height * row / (1 + law.spread**2))).sum()) / total
            excess = float((weight * row.square()).sum()) / total - height**2 - 1
            spread = math.sqrt(max(excess, 0.05**2))  # floor, sd: the law stays smooth in it
            laws[i] = Outliers(min(max(total / z.shape[-1], 1e-9), 0.5), height, spread)
    return _with_limits(z, laws, hit)


def _with_limits(z: Tensor, laws: list[Outliers], hit: list[int]) -> list[Outliers]:
    """Laws of shocks with limits from the covariance of the scores (Louis), normal in the logarithms."""
    weight, rate = shock_posterior(z, laws), laws[hit[0]].rate
    scores = [(weight - rate) / (1 - rate)]  # with respect to log rate, heights, variances
    for i in hit:
        h, v, row = laws[i].height, 1 + laws[i].spread ** 2, z[i]
        signed = row * torch.tanh(h * row / v)
        scores += [weight * (signed - h) / v, weight * (row.square() - 2 * h * signed + h**2 - v) / (2 * v**2)]
    score = torch.stack(scores)
    covariance = torch.linalg.pinv(score @ score.mT, hermitian=True)

    def limits(value: float, log_sd: float) -> tuple[float, float]:
        reach = math.exp(min(Z * log_sd, 50.0))
        return value / reach, value * reach

    result = list(laws)
    for k, i in enumerate(hit):
        law = laws[i]
        # amplitude^2 = height^2 + v - 1
        gradient = torch.tensor([law.height, 0.5], dtype=torch.float64) / law.amplitude
        own = covariance[1 + 2 * k : 3 + 2 * k, 1 + 2 * k : 3 + 2 * k]
        result[i] = law._replace(
            rate_limits=limits(rate, math.sqrt(float(covariance[0, 0]))),
            amplitude_limits=limits(law.amplitude, math.sqrt(float(gradient @ own @ gradient)) / law.amplitude),
        )
    return result
