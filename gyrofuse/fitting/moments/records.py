"""Design of a sample of wavelet variances: lengths and levels of its records, and the estimator."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.checks import check_floating, check_length, largest_level
from gyrofuse._base.deprecation import warn_deprecated
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.io.recording import Recording
from gyrofuse.noise.processes import Model


@dataclass(frozen=True)
class SampleDesign:
    """One record, or several whose wavelet variances are pooled: averaged with as many coefficients as each has.

    Attributes:
        lengths: Samples T of each record.
        levels: Levels that each of them adds to, at least one of them to all.
        efficiency: Efficiency of robust wavelet variances; 1 for the classic ones.
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
        """Degrees of freedom `(level,)` of white noise, three for each non-overlapping window."""
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
            model: Model with parameters `(...)`.
            excess_kurtosis: Excess kurtosis of its white noise, a number or `(...)`; for the classic wavelet variance
                only.
        """
        same: dict[tuple[int, int], Tensor] = {}
        for length, levels in zip(self.lengths, self.levels, strict=True):
            if (length, levels) not in same:
                same[length, levels] = moment_covariance(
                    model, length, levels, excess_kurtosis=excess_kurtosis, efficiency=self.efficiency
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
        """Weight of each record in the mean, `(record, level)`."""
        counts = self._counts
        return counts / counts.sum(0)

    def _whole(self, values: Tensor) -> Tensor:
        """Zeros at the levels, last of the dimensions, that a record does not have."""
        return torch.nn.functional.pad(values, (0, self.n_levels - values.shape[-1]))


def check_wavelet_variance(wavelet_variance: Tensor, n_samples: int, n_levels: int | None) -> Tensor:
    """A wavelet variance `(..., level, sensor)` with `n_levels` of its levels.

    Args:
        wavelet_variance: What was given.
        n_samples: Length of the records behind it.
        n_levels: Number of levels; all by default.

    Raises:
        TypeError: Not a floating point tensor.
        ValueError: Shape of a signal, more levels than the records have, or fewer than `n_levels`.
    """
    shape, most = tuple(check_floating("wavelet_variance", wavelet_variance).shape), largest_level(n_samples)
    if shape[-1:] == (n_samples,):
        raise ValueError(
            f"`wavelet_variance`: expected a wavelet variance (..., level, sensor), got shape {shape}, that of a "
            f"signal of {n_samples} samples; give the signal to the function for signals, or sensors one by one"
        )
    if len(shape) < 2 or not 1 <= shape[-2] <= most:
        raise ValueError(
            f"`wavelet_variance`: expected a wavelet variance (..., level, sensor) of at most {most} levels for "
            f"{n_samples} samples, got shape {shape}; for a signal there is a function of its own"
        )
    if n_levels is not None and not 1 <= n_levels <= shape[-2]:
        raise ValueError(f"`n_levels`: expected 1 to {shape[-2]}, the levels given, got {n_levels}")
    return wavelet_variance[..., :n_levels, :]


def deprecate_moments(signal: Tensor | Recording, n_samples: int, function: str, stacklevel: int = 3) -> None:
    """Warn that a function for signals was given moments and the length of the records behind them.

    Args:
        signal: What it was given.
        n_samples: Length.
        function: Name of the function, whose twin for moments ends in `_moments`.
        stacklevel: Frames between the warning and the line that called the function.

    Raises:
        ValueError: `signal` is a recording, or `n_samples` no length.
    """
    check_length(n_samples, recorded=isinstance(signal, Recording))
    warn_deprecated(f"argument `n_samples` of {function}", f"{function}_moments", stacklevel=stacklevel)
