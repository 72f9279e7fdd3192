"""Lengths of records and how their wavelet variances were estimated: what the covariance of these depends on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.fitting.moments.robust_covariance import robust_moment_covariance
from gyrofuse.noise.processes import Model


@dataclass(frozen=True)
class Records:
    """One record, or several whose wavelet variances are pooled: averaged with as many coefficients as each has.

    Attributes:
        lengths: Samples T of each record.
        levels: Levels that each of them adds to, at least one of them to all.
        efficiency: Of robust wavelet variances; 1 for the classic ones.
    """

    lengths: tuple[int, ...]
    levels: tuple[int, ...]
    efficiency: float = 1.0

    @property
    def n_levels(self) -> int:
        """Levels J of the pooled wavelet variance."""
        return max(self.levels)

    @property
    def longest(self) -> int:
        """Samples of the longest record."""
        return max(self.lengths)

    @property
    def tau(self) -> Tensor:
        """Filter lengths `(level,)`."""
        return torch.exp2(torch.arange(1, self.n_levels + 1, dtype=torch.float64))

    @property
    def observations(self) -> Tensor:
        """Degrees of freedom `(level,)` of white noise, three for each window side by side."""
        return (3 * self._counts.sum(0) / self.tau).clamp(min=1)

    @property
    def _counts(self) -> Tensor:
        """Coefficients `M_j`, `(record, level)`."""
        length, used = (torch.tensor(values, dtype=torch.float64)[:, None] for values in (self.lengths, self.levels))
        level = torch.arange(1, self.n_levels + 1)
        return torch.where(level <= used, length - self.tau + 1, 0.0)

    def pooled(self, variances: list[Tensor]) -> Tensor:
        """Mean of the wavelet variances `(..., level)` of the records, as many levels as each has."""
        shares = self._shares.to(variances[0].device)
        return sum(
            (
                self._whole(variance * share[: variance.shape[-1]])
                for variance, share in zip(variances, shares, strict=True)
            ),
            start=torch.zeros((), dtype=torch.float64, device=shares.device),
        )

    def covariances(self, model: Model, excess_kurtosis: Tensor | float = 0.0) -> list[Tensor]:
        """Covariance of the wavelet variances of each record under a model, `(..., level, level)`.

        Args:
            model: With parameters `(...)`.
            excess_kurtosis: Of its white noise, a number or `(...)`; for the classic wavelet variance only.
        """
        same: dict[tuple[int, int], Tensor] = {}
        for length, levels in zip(self.lengths, self.levels, strict=True):
            if (length, levels) not in same:
                same[length, levels] = (
                    moment_covariance(model, length, levels, excess_kurtosis=excess_kurtosis)
                    if self.efficiency == 1
                    else robust_moment_covariance(model, length, levels, efficiency=self.efficiency)
                )
        return [same[key] for key in zip(self.lengths, self.levels, strict=True)]

    def covariance(self, model: Model) -> Tensor:
        """Covariance of the pooled wavelet variances under a model, `(..., level, level)`."""
        parts = self.covariances(model)
        if len(parts) == 1:
            return parts[0]
        shares = self._shares.to(parts[0].device)
        total = torch.zeros((), dtype=torch.float64, device=shares.device)
        for part, share in zip(parts, shares, strict=True):
            own = share[: part.shape[-1]]
            total = total + self._whole(self._whole(own[:, None] * own * part).mT).mT
        return total

    @property
    def _shares(self) -> Tensor:
        """What each record adds to the mean, `(record, level)`."""
        counts = self._counts
        return counts / counts.sum(0)

    def _whole(self, values: Tensor) -> Tensor:
        """Zeros at the levels, last of the dimensions, that a record does not have."""
        return torch.nn.functional.pad(values, (0, self.n_levels - values.shape[-1]))
