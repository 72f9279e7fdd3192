"""What a reference's spectra may be off by as a whole: levels that vary by themselves, numbers of a fitted model.

Log powers of a sensor move by `A y` with normal `y` of variance one, `A` the columns of `rows`. In the units of the
score, `B = sqrt(w) A` with the information `w` of a log power, and with `B = Q S V'` (singular values) the likelihood
of a model `m`, integrated over `y` to second order around the best `y` of no difference (Laplace), is

    log L(m) + |T Q' z(m)|^2 / 2,   T^2 = S^2 / (1 + S^2),   z = (score in log m) / sqrt(w),

up to a constant: the information of a ratio of powers does not depend on the model. Numbers that nothing else is known
of have `S` without bound. Then `m` counts by what lies outside of all that they can make.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectral import Ratios, power_gains, power_scores
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
        return (self.data.share * self.data.worth[:, None]).mT.sqrt()

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
    def best(self) -> Ratios:
        """The data with the reference's powers where the nuisance fits them best if nothing else differs."""
        rounds = 10
        q, s = self.directions
        y, move = torch.zeros_like(s), torch.zeros_like(self.weight)
        for _ in range(rounds):
            score = (q * self._scores(self.data, move)[..., None]).sum(1)
            y = y + s.square() / (1 + s.square()) * (score - torch.where(s > 0, y / s.square().clamp(min=1e-300), 0.0))
            move = (q @ y[..., None])[..., 0] / self.weight.clamp(min=1e-300)
        size = (-move / 2).clamp(-30, 30).exp().mT
        return replace(self.data, observed=self.data.observed * size[:, :, None] * size[:, None, :])

    def gains(self, log_factors: Tensor) -> Tensor:
        """Log likelihood of powers changed by factors `(..., sensor, band)` over none, `(..., sensor)`, nats."""
        gains = power_gains(self.best, log_factors.exp().mT).sum(-2)
        q, s = self.directions
        if not q.shape[-1]:
            return gains
        nothing, moved = (
            torch.einsum("sbk,...sb->...sk", q, self._scores(self.best, x))
            for x in (torch.zeros_like(self.weight), log_factors)
        )
        return gains + (s.square() / (1 + s.square()) * (moved - nothing).square()).sum(-1) / 2

    def _scores(self, data: Ratios, log_factors: Tensor) -> Tensor:
        """`z`, `(..., sensor, band)`."""
        return (data.share * power_scores(data, log_factors.exp().mT)).mT / self.weight.clamp(min=1e-300)


def chi_square_p_value(nuisance: Nuisance, expected: Tensor) -> float:
    """p value of the errors that would suit the recording, for errors that are expected (score test).

    All sensors together, or one alone.

    Args:
        nuisance: Directions and data.
        expected: Log powers by independent errors of unit variance, `(sensor, band, error)`.
    """
    q, _ = nuisance.directions
    scores = torch.einsum("sbk,sb->sk", q, nuisance._scores(nuisance.data, torch.zeros_like(nuisance.weight)))
    moved = torch.einsum("sbk,sb,sbe->ske", q, nuisance.weight, expected)
    there = q.any(1)  # (sensor, direction)

    def p_value(own: Tensor) -> float:
        rows, z = moved[own], scores[own]
        covariance = torch.eye(len(z), dtype=z.dtype) + rows @ rows.mT
        return float(stats.chi2.sf(float(z @ torch.linalg.solve(covariance, z)), max(len(z), 1)))

    sensors = torch.eye(len(there), dtype=torch.bool)[..., None]
    alone = [p_value(there & one) for one in sensors]
    return sidak(min(p_value(there), sidak(min(alone), len(alone))), 2) if len(alone) > 1 else alone[0]
