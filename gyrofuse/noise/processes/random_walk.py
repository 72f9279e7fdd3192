"""Random walk."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gyrofuse.noise.datasheet_units import DatasheetEntry, DatasheetUnits
from gyrofuse.noise.dct_bands import BandVariance, DCTBands
from gyrofuse.noise.model import Parameter
from gyrofuse.noise.processes.base import NON_NEGATIVE, Process, States, WhiteAndWalk, matrix, normal


@dataclass(frozen=True, eq=False, repr=False)
class RandomWalk(Process):
    """Sum of white increments (rate random walk): `nu = variance (tau^2 + 2) / (12 tau)`.

    Args:
        variance: Variance of the increments, signal^2, >= 0.
    """

    key = "random_walk"
    symbol = "RW"
    noun = "random walk"
    variance: Parameter = field(default=None, metadata=NON_NEGATIVE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, variance: Tensor) -> Tensor:
        return variance * (tau**2 + 2) / (12 * tau)

    @staticmethod
    def _spectrum(f: Tensor, variance: Tensor) -> Tensor:
        return variance / (4 * torch.sin(math.pi * f) ** 2)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, variance: Tensor) -> Tensor:
        return (variance.sqrt() * normal(n_samples, shape, generator)).cumsum(-1)

    @classmethod
    def unit_band_variance(cls, bands: DCTBands, x: Tensor | None) -> BandVariance:
        """`1 / (4 s^2)`: exact, and that of the spectrum."""
        return BandVariance(bands.mean_of(0.25 / bands.sine_squared))

    @staticmethod
    def _states(variance: Tensor) -> States:
        one = matrix([[torch.ones_like(variance)]])
        return States(("",), one, matrix([[variance]]), torch.zeros_like(one), (1.0,))

    @staticmethod
    def _datasheet(sheet: DatasheetUnits, variance: float) -> Iterator[DatasheetEntry]:
        yield from sheet.walk(variance)

    @staticmethod
    def _white_and_walk(rate: float, slow: float, variance: float) -> WhiteAndWalk:
        return WhiteAndWalk(0.0, variance, "in the random walk")
