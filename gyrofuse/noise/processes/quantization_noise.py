"""Quantisation noise."""

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
class QuantizationNoise(Process):
    """Quantisation of the integrated angle, the first difference of white noise: `nu = 6 variance / tau^2`.

    Args:
        variance: Variance of the angle's white noise (`q2`), signal^2, >= 0; the process has variance `2 q2` and
            autocovariance `-q2` at lag 1.
    """

    key = "quantization_noise"
    symbol = "QN"
    noun = "quantisation noise"
    white_integral = True
    variance: Parameter = field(default=None, metadata=NON_NEGATIVE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, variance: Tensor) -> Tensor:
        return 6 * variance / tau**2

    @staticmethod
    def _spectrum(f: Tensor, variance: Tensor) -> Tensor:
        return 4 * variance * torch.sin(math.pi * f) ** 2

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, variance: Tensor) -> Tensor:
        return variance.sqrt() * normal(n_samples + 1, shape, generator).diff(dim=-1)

    @classmethod
    def unit_band_variance(cls, bands: DCTBands, x: Tensor | None) -> BandVariance:
        """`4 s^2 + 4 c^2 / T`: exact, as the covariance is that of second differences and more at the two ends."""
        return BandVariance(bands.mean_of(4 * bands.sine_squared + bands.ends))

    @staticmethod
    def _states(variance: Tensor) -> States:
        # e_k - e_{k-1} and -e_k: the second is what the next sample takes back
        zero, one = torch.zeros_like(variance), torch.ones_like(variance)
        F = matrix([[zero, one], [zero, zero]])
        Q = matrix([[variance, -variance], [-variance, variance]])
        P0 = matrix([[2 * variance, -variance], [-variance, variance]])
        return States(("", "carried"), F, Q, P0, (1.0, 0.0))

    @staticmethod
    def _datasheet(sheet: DatasheetUnits, variance: float) -> Iterator[DatasheetEntry]:
        yield sheet.quantization(variance)

    @staticmethod
    def _white_and_walk(rate: float, slow: float, variance: float) -> WhiteAndWalk:
        return WhiteAndWalk(0.0, 0.0, "left out; it has no density at frequency 0")
