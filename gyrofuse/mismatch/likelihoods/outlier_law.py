"""Law of standardised values among which a few are outliers, and how these lie in time and over sensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize, special, stats
from torch import Tensor

_BULK = 6.0  # values below it are counted in a histogram
_BINS = 600
_EVENT, _COMPANY = 3.5, 2.5  # sd
_NEAR = (2, 9)  # samples on either side
_CLUSTERED = 0.6  # share of events that have company
_OFF = 0.05  # logarithm, by which the sd of the noise may be wrong
_ROUNDS = 3
_RATIO, _RATIO_SD = 0.2, 0.8  # of spread to height beforehand: median, and sd of its logarithm

_Law = Callable[..., NDArray[np.float64]]


class Outliers(NamedTuple):
    """`z` is normal of sd `scale`, but with probability `rate` moved by `height`, of either sign, with sd `spread`.

    Attributes:
        rate: Probability.
        height, spread: In sd of the noise as it was estimated.
        rate_limits, amplitude_limits: Of `rate` and `amplitude`, 95 %.
        scale: Sd of what is no outlier: a robust estimate of it is half a per cent off, which many faint outliers
            would have to make up for.
    """

    rate: float
    height: float
    spread: float
    scale: float = 1.0
    rate_limits: tuple[float, float] = (math.nan, math.nan)
    amplitude_limits: tuple[float, float] = (math.nan, math.nan)

    @classmethod
    def none(cls) -> Outliers:
        return cls(0.0, 0.0, 0.0)

    @property
    def amplitude(self) -> float:
        return math.hypot(self.height, self.spread)

    def scaled(self, z: Tensor) -> Outliers:
        """With the most likely scale for values, all else as it is."""
        law = self
        for _ in range(_ROUNDS):
            plain = 1 - law.posterior(z)
            law = law._replace(scale=float(((plain * z.square()).sum() / plain.sum()).sqrt()))
        return law

    def times(self, factor: float) -> Outliers:
        """Of values so many times as large."""
        height, spread, scale = (factor * size for size in (self.height, self.spread, self.scale))
        low, high = self.amplitude_limits
        return Outliers(self.rate, height, spread, scale, self.rate_limits, (factor * low, factor * high))

    def posterior(self, z: Tensor) -> Tensor:
        """Probability of each value's being an outlier."""
        if self.rate <= 0:
            return torch.zeros_like(z)
        return torch.exp(math.log(self.rate) + _moved(z, self) - mixture(z, self))


def mixture(z: Tensor, law: Outliers) -> Tensor:
    """Log density of `z` under the law."""
    plain = -(z / law.scale).square() / 2 - math.log(2 * math.pi * law.scale**2) / 2
    return torch.logaddexp(math.log1p(-law.rate) + plain, math.log(max(law.rate, 1e-300)) + _moved(z, law))


def free_gaussian(z: Tensor) -> Tensor:
    """Log density of `z` under a normal law of its own variance."""
    return _weighted_gaussian(z, torch.ones_like(z))


def _weighted_gaussian(z: Tensor, counts: Tensor) -> Tensor:
    variance = (counts * z.square()).sum() / counts.sum()
    return -z.square() / (2 * variance) - (2 * math.pi * variance).log() / 2


class Sample:
    """Moduli of values, of which the many small ones are counted in bins, with the likelihood of laws of outliers.

    How far moduli of outliers spread is hardly told by a few that stand little above the noise, and with a wide spread
    they may be any number of faint ones. Beforehand it is held to be a fifth of the height within a factor of five.
    """

    def __init__(self, z: Tensor) -> None:
        size = z.abs()
        bulk = size < _BULK
        counts = torch.histc(size[bulk], _BINS, 0.0, _BULK)
        centres = (torch.arange(_BINS, dtype=torch.float64) + 0.5) * (_BULK / _BINS)
        large = size[~bulk]
        self.values, self.counts = torch.cat([centres, large]), torch.cat([counts, torch.ones_like(large)])
        self.n = float(self.counts.sum())

    def deviance(self, law: Outliers) -> float:
        """Minus the log likelihood, nats, and minus the log of what is held of the spread beforehand."""
        beforehand = (math.log(law.spread / law.height / _RATIO) / _RATIO_SD) ** 2 / 2
        return beforehand - float((self.counts * mixture(self.values, law)).sum())


def law_of(theta: Sequence[float]) -> Outliers:
    """Of log rate, log amplitude, log of spread over height, log scale."""
    rate, amplitude, ratio, scale = (math.exp(v) for v in theta)
    height = amplitude / math.hypot(1.0, ratio)
    return Outliers(rate, height, ratio * height, scale)


def bounds_of(n: float) -> list[tuple[float, float]]:
    """Within which numbers of `law_of` are looked for, of `n` values."""
    return [(math.log(0.2 / n), math.log(0.3)), (math.log(0.3), math.log(1e4)), (math.log(0.01), 1.0), (-_OFF, _OFF)]


def fitted(z: Tensor) -> Outliers:
    """Most likely rate, height, spread and scale."""
    sample = Sample(z)
    values, counts, n = sample.values, sample.counts, sample.n
    starts = []
    for level, least in ((3.0, 3.0), (4.0, 6.0), (6.0, 8.0)):
        beyond = values > level
        number = float(counts[beyond].sum())
        height = float((counts * values)[beyond].sum()) / number if level == 6.0 and number else least
        starts.append([math.log(max(number, 1.0) / n), math.log(height), math.log(_RATIO), 0.0])
    runs = [
        optimize.minimize(
            lambda theta: sample.deviance(law_of(theta)),
            start,
            method="L-BFGS-B",
            bounds=bounds_of(n),
            options={"maxiter": 60},
        )
        for start in starts
    ]
    return law_of(min(runs, key=lambda run: float(run.fun)).x)


def heavy_tailed(z: Tensor) -> float:
    """Log likelihood of noise that is heavy-tailed throughout over a normal law, of its own variance each.

    The better of Student's law and of a normal plus a Laplace variable, scale and shape fitted.
    """
    sample = Sample(z)
    x, weight = sample.values.numpy(), sample.counts.numpy()
    plain = float((sample.counts * _weighted_gaussian(sample.values, sample.counts)).sum())
    best = -math.inf
    for law, start, bounds in (
        (_student, (20.0, 1.0), ((2.1, 1e4), (0.3, 2.0))),
        (_normal_laplace, (0.3, 0.95), ((0.02, 2.0), (0.05, 2.0))),
    ):

        def deviance(theta: NDArray[np.float64], law: _Law = law) -> float:
            return -float((weight * law(x, *np.exp(theta))).sum())

        run = optimize.minimize(deviance, np.log(start), method="L-BFGS-B", bounds=np.log(bounds))
        best = max(best, -float(run.fun) - plain)
    return best


def _student(z: NDArray[np.float64], freedom: float, scale: float) -> NDArray[np.float64]:
    return np.asarray(stats.t.logpdf(z / scale, freedom)) - math.log(scale)


def _normal_laplace(z: NDArray[np.float64], width: float, sd: float) -> NDArray[np.float64]:
    """Density of `sd` times a normal plus `width` times a Laplace variable."""
    r = sd / width
    up, down = -z / width + special.log_ndtr(z / sd - r), z / width + special.log_ndtr(-z / sd - r)
    return np.asarray(np.logaddexp(up, down)) + r * r / 2 - math.log(2 * width)


def clustered(white: Tensor) -> bool:
    """Whether outliers of `(sensor, time)` lie together, as those of loud episodes do."""
    near = _NEAR[1]
    for row in white.abs():
        events = (row > _EVENT).nonzero()[:, 0]
        events = events[(events >= near) & (events < len(row) - near)]
        if len(events) < 4:
            continue
        steps = torch.arange(_NEAR[0], near + 1)
        around = row[events[:, None] + torch.cat([-steps, steps])]
        if float((around.amax(-1) > _COMPANY).to(torch.float64).mean()) > _CLUSTERED:
            return True
    return False


def _moved(z: Tensor, law: Outliers) -> Tensor:
    variance = law.scale**2 + law.spread**2
    up, down = -(z - law.height).square() / (2 * variance), -(z + law.height).square() / (2 * variance)
    return torch.logaddexp(up, down) - math.log(2) - math.log(2 * math.pi * variance) / 2
