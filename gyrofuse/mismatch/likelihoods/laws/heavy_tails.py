"""Laws of noise that is heavy-tailed throughout: normal values whose variance is drawn anew for each.

With an inverse Gamma variance they are Student's; with one number plus an exponential variable they are the sum of a
normal and a Laplace variable.

References:
    Andrews and Mallows, Scale mixtures of normal distributions, JRSS B 36 (1974), 99.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import optimize, special, stats
from torch import Tensor

from gyrofuse.mismatch.likelihoods.laws.outlier_law import Array, Sample


class HeavyTails(NamedTuple):
    """A symmetric law.

    Attributes:
        laplace: Whether a Laplace variable is added to a normal one; else it is Student's.
        shape: Width of the Laplace variable over the standard deviation of the normal one, or degrees of freedom.
        scale: Standard deviation of the normal one, or scale of Student's.
    """

    laplace: bool
    shape: float
    scale: float

    @classmethod
    def fitted(cls, z: Tensor) -> HeavyTails:
        """The likelier one of values `(time,)`."""
        laws = [cls.of_kind(laplace, z) for laplace in (False, True)]
        return max(laws, key=lambda law: float(law.gains(z).sum()))

    @classmethod
    def of_kind(cls, laplace: bool, z: Tensor, shape: float | None = None) -> HeavyTails:
        """The likeliest one of a kind, or of a shape as well."""
        sample = Sample(z)
        x, weight = sample.values.numpy(), sample.counts.numpy()
        spread = float(np.sqrt(weight @ x**2 / weight.sum()))
        start, least, most = (0.5, 0.02, 50.0) if laplace else (6.0, 2.1, 1e4)
        if shape is not None:
            start = least = most = shape
        run = optimize.minimize(
            lambda theta: -float(weight @ cls(laplace, *np.exp(theta)).log_density(x)),
            [math.log(start), math.log(0.7 * spread)],
            method="L-BFGS-B",
            bounds=[(math.log(least), math.log(most)), (math.log(0.02 * spread), math.log(2 * spread))],
            options={"maxiter": 60},
        )
        return cls(laplace, *np.exp(run.x).tolist())

    def log_density(self, z: Array) -> Array:
        """At values."""
        if not self.laplace:
            return np.asarray(stats.t.logpdf(z / self.scale, self.shape)) - math.log(self.scale)
        sd, width, r = self.scale, self.shape * self.scale, 1 / self.shape
        up, down = -z / width + special.log_ndtr(z / sd - r), z / width + special.log_ndtr(-z / sd - r)
        return np.asarray(np.logaddexp(up, down)) + r * r / 2 - math.log(2 * width)

    def gains(self, z: Tensor) -> Tensor:
        """Log likelihood over a normal law of the values' own variance, `(time,)`, nats."""
        variance = float(z.square().mean())
        normal = -z.square() / (2 * variance) - math.log(2 * math.pi * variance) / 2
        return torch.from_numpy(self.log_density(z.numpy())) - normal

    def factors(self, like: Tensor, generator: torch.Generator) -> Tensor:
        """Standard deviations of each value, of mean square one, of a shape."""
        u = torch.rand(like.shape, generator=generator, dtype=torch.float64).clamp(min=1e-15)
        if self.laplace:
            drawn = 1 + 2 * self.shape**2 * -u.log()
            return (drawn / (1 + 2 * self.shape**2)).sqrt()
        gamma = torch.from_numpy(special.gammaincinv(self.shape / 2, u.numpy()))
        return ((self.shape - 2) / (2 * gamma)).sqrt()

    def log_shape_sd(self, z: Tensor) -> float:
        """Standard deviation of the logarithm of the shape, from the outer product of the scores of `(time,)`."""
        x, step, scores = z.numpy(), 1e-4, []
        for by in ((step, 0.0), (0.0, step)):
            ends = [
                HeavyTails(self.laplace, self.shape * math.exp(s * by[0]), self.scale * math.exp(s * by[1]))
                for s in (1, -1)
            ]
            scores.append((ends[0].log_density(x) - ends[1].log_density(x)) / (2 * step))
        products = np.array(scores) @ np.array(scores).T
        return math.sqrt(float(np.linalg.inv(products)[0, 0]))


def heavy_tailed(z: Tensor) -> float:
    """Log likelihood ratio of noise that is heavy-tailed throughout to a normal law, of its own variance each, nats."""
    return float(HeavyTails.fitted(z).gains(z).sum())
