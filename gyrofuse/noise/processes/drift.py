"""Drift, a deterministic ramp."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gyrofuse.noise.datasheet_units import DatasheetEntry, DatasheetUnits
from gyrofuse.noise.model import Parameter
from gyrofuse.noise.processes.base import Process, States, WhiteAndWalk, domain, matrix, sample_numbers


@dataclass(frozen=True, eq=False, repr=False)
class Drift(Process):
    """Deterministic ramp `slope * t` (rate ramp): `nu = slope^2 tau^2 / 16`.

    Args:
        slope: Slope, signal per sample, of either sign.
    """

    key = "drift"
    symbol = "DR"
    noun = "drift"
    scale_name = "slope"
    squared = True
    gaussian = False
    deterministic = True
    slope: Parameter = field(default=None, metadata=domain("a finite number", torch.isfinite))

    @staticmethod
    def _wavelet_variance(tau: Tensor, slope: Tensor) -> Tensor:
        return (slope * tau / 4) ** 2

    @staticmethod
    def _spectrum(f: Tensor, slope: Tensor) -> Tensor:
        return torch.zeros_like(slope * f)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, slope: Tensor) -> Tensor:
        return (slope * sample_numbers(n_samples, slope)).expand(*shape, n_samples)

    @staticmethod
    def _states(slope: Tensor) -> States:
        zero, one = torch.zeros_like(slope), torch.ones_like(slope)
        F = matrix([[one, one], [zero, one]])
        none = torch.zeros_like(F)
        return States(("", "slope"), F, none, none, (1.0, 0.0), torch.stack([zero, slope], -1))

    @staticmethod
    def _datasheet(sheet: DatasheetUnits, slope: float) -> Iterator[DatasheetEntry]:
        yield sheet.ramp(slope)

    @staticmethod
    def _white_and_walk(rate: float, slow: float, slope: float) -> WhiteAndWalk:
        return WhiteAndWalk(0.0, 0.0, "left out; a ramp is not noise")
