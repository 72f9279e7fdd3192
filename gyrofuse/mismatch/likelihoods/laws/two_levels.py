"""Law of values of two standard deviations, sample by sample."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy import special
from torch import Tensor

from gyrofuse.mismatch.likelihoods.laws.outlier_law import gaussian
from gyrofuse.mismatch.signals.prediction_errors import median_sd


class TwoLevels(NamedTuple):
    """Normal values of two standard deviations.

    Attributes:
        share: Probability of the larger one; 0 of values that have one.
        small, large: Standard deviations.
    """

    share: float
    small: float
    large: float

    @classmethod
    def normal(cls) -> TwoLevels:
        """The law of standard normal values."""
        return cls(0.0, 1.0, 1.0)

    def log_densities(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Joint log densities of values with either standard deviation."""
        return (
            math.log1p(-self.share) + gaussian(z, self.small**2),
            math.log(self.share) + gaussian(z, self.large**2),
        )

    def gains(self, z: Tensor) -> Tensor:
        """Log likelihood over a normal law of the values' own variance, `(time,)`, nats; none beyond it."""
        within = self.within(z)
        gains = torch.logaddexp(*self.log_densities(z)) - gaussian(z, z[within].square().mean())
        return torch.where(within, gains, 0.0)

    def within(self, z: Tensor) -> Tensor:
        """Values `(time,)` that it has more often than once in a hundred such records."""
        least = 0.01
        return z.abs() < self.of_normal_score(-float(special.ndtri(least / 2 / len(z))))

    @classmethod
    def fitted(cls, z: Tensor) -> TwoLevels:
        """Likeliest law of values `(time,)`, without those that lie beyond it."""
        rounds, law = 3, cls._likeliest(z)
        for _ in range(rounds):
            within = law.within(z)
            if bool(within.all()):
                break
            law = cls._likeliest(z[within])
        return law

    @classmethod
    def _likeliest(cls, z: Tensor) -> TwoLevels:
        """By expectation and maximisation (Dempster, Laird and Rubin, 1977)."""
        quick, squares = median_sd(z), z.square()
        law = cls(0.1, float(quick), float((squares.mean() / 0.1).sqrt().maximum(2 * quick)))
        for _ in range(200):
            small, large = law.log_densities(z)
            hit = torch.sigmoid(large - small)
            share = float(hit.mean().clamp(1e-6, 1 - 1e-6))
            sds = [float(((w * squares).sum() / w.sum()).sqrt()) for w in (1 - hit, hit)]
            last, law = law, cls(share, *sds)
            if abs(math.log(law.share / last.share)) + abs(math.log(law.large / last.large)) < 1e-7:
                break
        return law

    def scaled_to(self, z: Tensor) -> TwoLevels:
        """The same share and ratio with the likeliest scale of values `(time,)`."""
        law, rounds = self, 50
        for _ in range(rounds if self.share else 0):
            small, large = law.log_densities(z)
            hit = torch.sigmoid(large - small)
            square = ((1 - hit) * (z / law.small).square() + hit * (z / law.large).square()).mean()
            law = law._replace(small=law.small * float(square.sqrt()), large=law.large * float(square.sqrt()))
        return law

    def standard_deviations(self, z: Tensor) -> tuple[float, float]:
        """Of the log odds of the share and of the log ratio, from the outer product of the scores of `(time,)`."""
        at = (math.log(self.share / (1 - self.share)), math.log(self.small), math.log(self.large / self.small))
        step = 1e-4

        def moved(number: int, by: float) -> Tensor:
            odds, small, ratio = (value + by * (k == number) for k, value in enumerate(at))
            law = TwoLevels(1 / (1 + math.exp(-odds)), math.exp(small), math.exp(small + ratio))
            return torch.logaddexp(*law.log_densities(z))

        scores = torch.stack([(moved(k, step) - moved(k, -step)) / (2 * step) for k in range(3)])
        variance = torch.linalg.inv(scores @ scores.mT).diagonal()
        return float(variance[0].sqrt()), float(variance[2].sqrt())

    def normal_scores(self, z: Tensor) -> Tensor:
        """Standard normal values that are as unlikely as values of the law, `(time,)`."""
        if not self.share:
            return z
        small, large = (torch.special.log_ndtr(-z.abs() / sd) for sd in (self.small, self.large))
        log_tail = torch.logaddexp(math.log1p(-self.share) + small, math.log(self.share) + large)
        return torch.from_numpy(-special.ndtri_exp(log_tail.numpy())).copysign(z)

    def of_normal_score(self, score: float) -> float:
        """The value that is as unlikely as a standard normal one: the inverse of `normal_scores`."""
        if not self.share:
            return score
        values = torch.linspace(0, self.large * max(abs(score) + 1, 1), 4096, dtype=torch.float64)
        return math.copysign(float(np.interp(abs(score), self.normal_scores(values), values)), score)
