"""White noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gyrofuse.noise.datasheet_units import DatasheetEntry, DatasheetUnits
from gyrofuse.noise.model import Parameter
from gyrofuse.noise.processes.base import NON_NEGATIVE, Process, WhiteAndWalk, normal


@dataclass(frozen=True, eq=False, repr=False)
class WhiteNoise(Process):
    """White noise (angle random walk): `nu = variance / tau`.

    Args:
        variance: Variance, signal^2, >= 0.
    """

    key = "white_noise"
    symbol = "WN"
    noun = "white noise"
    white = True
    variance: Parameter = field(default=None, metadata=NON_NEGATIVE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, variance: Tensor) -> Tensor:
        return variance / tau

    @staticmethod
    def _spectrum(f: Tensor, variance: Tensor) -> Tensor:
        return variance * torch.ones_like(f)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, variance: Tensor) -> Tensor:
        return variance.sqrt() * normal(n_samples, shape, generator)

    @staticmethod
    def _datasheet(sheet: DatasheetUnits, variance: float) -> Iterator[DatasheetEntry]:
        yield from ()  # white noise of all processes is one entry

    @staticmethod
    def _white_and_walk(rate: float, slow: float, variance: float) -> WhiteAndWalk:
        return WhiteAndWalk(variance, 0.0, "in the noise density")
