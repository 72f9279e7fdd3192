"""What a reference's spectra may be off by as a whole: levels that vary by themselves, numbers of a fitted model.

Log powers of a sensor move by `A y` with normal `y` of variance one, `A` the columns of `rows`. In units of the score,
`sqrt(w) A = Q S V'` (singular values) with the information `w` of a log power. Around the best `y` of no difference a
difference `h` of log powers is compensated best by

    h' = h - w^-1/2 Q T Q' w^1/2 h,   T = S^2 / (1 + S^2),

and has the likelihood of `h'` with the prior's of the change of `y` (profile likelihood; the information of a ratio of
powers does not depend on the model, so that Laplace's approximation of the integral is the same but for a constant).
Numbers that nothing else is known of have `S` without bound: `h` counts by what lies outside of all that they can make.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios, power_gains, power_scores
from gyrofuse.mismatch.stats.multiplicity import sidak


@dataclass(frozen=True, eq=False)
class Nuisance:
    """Directions in which log powers of the reference are uncertain, and the data that they are uncertain in.

    Attributes:
        data: Ratios of powers.
        rows: Log powers by independent errors of unit variance, `(sensor, band, error)`.
    """

    data: Ratios
    rows: Tensor

    @cached_property
    def weight(self) -> Tensor:
        """Root of the information on log powers, `(sensor, band)`."""
        return (self.data.weight * self.data.information[:, None]).mT.sqrt()

    @cached_property
    def directions(self) -> tuple[Tensor, Tensor]:
        """`Q`, `(sensor, band, direction)`, and `S`, `(sensor, direction)`; both 0 beyond their number."""
        tolerance = 1e-8  # of the largest singular value: rounding leaves 1e-15, processes that are alike somewhat more
        moved = self.weight[..., None] * self.rows
        size = moved.norm(dim=1).amax(-1, keepdim=True).clamp(min=1e-300)  # (sensor, 1)
        directions, strength, _ = torch.linalg.svd(moved / size[..., None], full_matrices=False)
        there = strength > tolerance * strength[:, :1].clamp(min=1e-300)
        return directions * there[:, None], strength * size * there

    @cached_property
    def best(self) -> tuple[Ratios, Tensor]:
        """The data over the best nuisance if nothing else differs, and its size along `Q`, `(sensor, direction)`."""
        rounds = 10  # of scoring
        q, s = self.directions
        size, moved = torch.zeros_like(s), torch.zeros_like(self.weight)
        for _ in range(rounds):
            pull = torch.where(s > 0, size / s.square().clamp(min=1e-300), 0.0)
            size = size + s.square() / (1 + s.square()) * (torch.einsum("sbk,sb->sk", q, self.scores(moved)) - pull)
            moved = self._log_powers(size)
        root = (-moved / 2).clamp(-30, 30).exp().mT
        return replace(self.data, observed=self.data.observed * root[:, :, None] * root[:, None, :]), size

    def gains(self, log_factors: Tensor) -> Tensor:
        """Log likelihood of powers changed by factors `(..., sensor, band)` over none, `(..., sensor)`, nats."""
        (data, size), (q, s) = self.best, self.directions
        along = torch.einsum("sbk,...sb->...sk", q, self.weight * log_factors)
        change = -s.square() / (1 + s.square()) * along
        gains = power_gains(data, (log_factors + self._log_powers(change)).exp().mT).sum(-2)
        prior = torch.where(s > 0, change * (change + 2 * size) / s.square().clamp(min=1e-300), 0.0)
        return gains - prior.sum(-1) / 2

    def scores(self, log_factors: Tensor) -> Tensor:
        """Scores in log power over the roots of their information, `(sensor, band)`, at powers changed by factors."""
        return (self.data.weight * power_scores(self.data, log_factors.exp().mT)).mT / self.weight.clamp(min=1e-300)

    def _log_powers(self, size: Tensor) -> Tensor:
        """Log powers `(..., sensor, band)` by a size `(..., sensor, direction)` along `Q`."""
        moved = torch.einsum("sbk,...sk->...sb", self.directions[0], size)
        return torch.where(self.weight > 0, moved / self.weight.clamp(min=1e-300), 0.0)


def chi_square_p_value(nuisance: Nuisance, expected: Tensor) -> float:
    """p value of the errors that would suit the recording, for errors that are expected (score test).

    All sensors together, or one alone.

    Args:
        nuisance: Directions and data.
        expected: Log powers by independent errors of unit variance, `(sensor, band, error)`.
    """
    q, _ = nuisance.directions
    scores = torch.einsum("sbk,sb->sk", q, nuisance.scores(torch.zeros_like(nuisance.weight)))
    moved = torch.einsum("sbk,sb,sbe->ske", q, nuisance.weight, expected)
    there = q.any(1)  # (sensor, direction)

    def p_value(own: Tensor) -> float:
        rows, z = moved[own], scores[own]
        covariance = torch.eye(len(z), dtype=z.dtype) + rows @ rows.mT
        return float(stats.chi2.sf(float(z @ torch.linalg.solve(covariance, z)), max(len(z), 1)))

    sensors = torch.eye(len(there), dtype=torch.bool)[..., None]
    alone = [p_value(there & one) for one in sensors]
    return sidak(min(p_value(there), sidak(min(alone), len(alone))), 2) if len(alone) > 1 else alone[0]
