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

_BULK = 2.5  # values below it are counted in a histogram
_BINS = 250
_EVENT, _COMPANY = 3.5, 2.5  # sd
_NEAR = (2, 9)  # samples on either side
_CLUSTERED = 0.6  # share of events that have company
_OFF = 0.05  # logarithm, by which the sd of the noise may be wrong
_ROUNDS = 3
_FLAT = 2.0  # times what the number of events alone says

_Law = Callable[..., NDArray[np.float64]]


class Outliers(NamedTuple):
    """`z` is normal of sd `scale`, but with probability `rate` moved by `height`, of either sign, with sd `spread`.

    Attributes:
        rate: Probability.
        height, spread: In sd of the noise as it was estimated.
        rate_sd, amplitude_sd: Standard errors of `rate` and `amplitude`.
        scale: Sd of what is no outlier: a robust estimate of it is half a per cent off, which many faint outliers
            would have to make up for.
    """

    rate: float
    height: float
    spread: float
    rate_sd: float = math.nan
    amplitude_sd: float = math.nan
    scale: float = 1.0

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
        sizes = (self.height, self.spread, self.amplitude_sd, self.scale)
        height, spread, amplitude_sd, scale = (factor * size for size in sizes)
        return Outliers(self.rate, height, spread, self.rate_sd, amplitude_sd, scale)

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


def fitted(z: Tensor) -> Outliers:
    """Maximum likelihood in `log rate`, `log height`, `log spread`, `log scale`, and limits from its curvature."""
    z, counts = _condensed(z.abs())
    n = float(counts.sum())

    def deviance(theta: list[float]) -> float:
        law = _law_of(theta)
        return -float((counts * mixture(z, law)).sum())

    bounds = [(math.log(0.2 / n), math.log(0.3)), (math.log(0.3), math.log(1e4)), (math.log(0.05), math.log(1e4))]
    bounds += [(-_OFF, _OFF)]
    starts = [
        (max(float(counts[z > level].sum()), 1.0) / n, height)
        for level, height in ((3.0, 3.0), (4.0, 6.0), (6.0, float(z[z > 6].mean()) if bool((z > 6).any()) else 8.0))
    ]
    runs = [
        optimize.minimize(
            deviance,
            [math.log(rate), math.log(height), math.log(0.3 * height), 0.0],
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 60},
        )
        for rate, height in starts
    ]
    best = min(runs, key=lambda run: float(run.fun))
    law = _law_of(best.x)
    rate, spread = law.rate, law.spread
    rate_sd, amplitude_sd = _spread_of(z, counts, list(best.x))
    # One or two events have no curvature to speak of: no more than twice what their number says.
    most = _FLAT / math.sqrt(max(rate * n, 1.0))
    rate_sd, amplitude_sd = min(rate_sd, most * rate), min(amplitude_sd, most * math.hypot(spread, 1.0))
    return law._replace(rate_sd=rate_sd, amplitude_sd=amplitude_sd)


def _law_of(theta: Sequence[float]) -> Outliers:
    rate, height, spread, scale = (math.exp(v) for v in theta)
    return Outliers(min(rate, 0.5), height, spread, scale=scale)


def heavy_tailed(z: Tensor) -> float:
    """Log likelihood of noise that is heavy-tailed throughout over a normal law, of its own variance each.

    The better of Student's law and of a normal plus a Laplace variable, scale and shape fitted.
    """
    z, counts = _condensed(z.abs())
    x, weight = z.numpy(), counts.numpy()
    plain = float((counts * _weighted_gaussian(z, counts)).sum())
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


def _condensed(size: Tensor) -> tuple[Tensor, Tensor]:
    """Moduli and how often: the many small ones by a histogram."""
    bulk = size < _BULK
    counts = torch.histc(size[bulk], _BINS, 0.0, _BULK)
    centres = (torch.arange(_BINS, dtype=torch.float64) + 0.5) * (_BULK / _BINS)
    large = size[~bulk]
    return torch.cat([centres, large]), torch.cat([counts, torch.ones_like(large)])


def _spread_of(z: Tensor, counts: Tensor, theta: Sequence[float]) -> tuple[float, float]:
    """Standard errors of rate and amplitude by the information in the scores, differentiated numerically."""
    law = _law_of(theta)
    step, slopes = 1e-4, []
    for k in range(len(theta)):
        moved = [_law_of([v + sign * step * (j == k) for j, v in enumerate(theta)]) for sign in (1.0, -1.0)]
        slopes.append((mixture(z, moved[0]) - mixture(z, moved[1])) / (2 * step))
    scores = torch.stack(slopes)
    information = (scores * counts) @ scores.mT
    covariance = torch.linalg.pinv(information, hermitian=True)
    amplitude = law.amplitude
    gradient = torch.tensor([0.0, law.height**2 / amplitude, law.spread**2 / amplitude, 0.0], dtype=torch.float64)
    return law.rate * math.sqrt(float(covariance[0, 0])), math.sqrt(float(gradient @ covariance @ gradient))
