"""Sinusoid of random phase."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gyrofuse._base import units
from gyrofuse.noise.datasheet_units import DatasheetEntry, DatasheetUnits
from gyrofuse.noise.model import Parameter, SpectralLine
from gyrofuse.noise.processes.base import NON_NEGATIVE, Process, States, WhiteAndWalk, domain, matrix, sample_numbers


@dataclass(frozen=True, eq=False, repr=False)
class Sinusoid(Process):
    """Sinusoid `amplitude * sin(beta t + phase)` of uniform random phase.

    `nu = amplitude^2 (1 - cos(beta tau/2))^2 / (tau^2 (1 - cos beta))` (Voirol et al., lemma 1), written with
    squared sines, which keep its digits for small `beta` and near its zeros. Its spectrum is a line of power
    `amplitude^2 / 2`.

    Args:
        amplitude: Amplitude, signal, >= 0.
        beta: Angular frequency, rad per sample, in `(0, pi]`. Fits move it as `x = logit(beta / pi)`.
    """

    key = "sinusoid"
    symbol = "SIN"
    noun = "tone"
    repeatable = True
    scale_name = "amplitude"
    squared = True
    shape_name = "beta"
    gaussian = False
    has_line = True
    starts_per_octave = 3  # the wavelet variance of a sinusoid changes within a third of an octave
    amplitude: Parameter = field(default=None, metadata=NON_NEGATIVE)
    # pi rounded to float32 lies just above pi
    beta: Parameter = field(
        default=None, metadata=domain("a number in (0, pi]", lambda v: (v > 0) & (v <= math.pi * (1 + 1e-7)))
    )

    @staticmethod
    def to_unconstrained(value: Tensor) -> Tensor:
        return (value / torch.pi).logit()

    @staticmethod
    def from_unconstrained(x: Tensor) -> Tensor:
        return torch.pi * x.sigmoid()

    @staticmethod
    def unconstrained_slope(x: Tensor) -> Tensor:
        part = x.sigmoid()
        return torch.pi * part * (1 - part)

    @classmethod
    def from_time_scale(cls, time: Tensor) -> Tensor:
        return (2 / time).logit()

    @staticmethod
    def time_scales(longest: float) -> tuple[float, float]:
        # Periods: of more than four filters only a trend is seen, and the shortest is two samples.
        return 4 * longest, 2.01

    @staticmethod
    def unconstrained_limits(longest: float) -> tuple[float, float]:
        # A period of 16 filters; `beta = pi` to 2e-9.
        return math.log(1 / (8 * longest)), 20.0

    @staticmethod
    def _wavelet_variance(tau: Tensor, amplitude: Tensor, beta: Tensor) -> Tensor:
        ratio = torch.sin(beta * tau / 4) ** 2 / (tau * torch.sin(beta / 2))
        return 2 * (amplitude * ratio) ** 2

    @staticmethod
    def unit_wavelet_variance_slope(tau: Tensor, x: Tensor) -> Tensor:
        """Derivative of `2 r^2`, `r = sin(beta tau / 4)^2 / (tau sin(beta / 2))`, with respect to `x`."""
        part = x.sigmoid()
        half, angle = torch.pi * part / 2, torch.pi * part * tau / 4
        ratio = angle.sin().square() / (tau * half.sin())
        slope = angle.sin() * angle.cos() / (2 * half.sin()) - ratio * half.cos() / (2 * half.sin())
        return 4 * ratio * slope * torch.pi * part * (1 - part)

    @staticmethod
    def _spectrum(f: Tensor, amplitude: Tensor, beta: Tensor) -> Tensor:
        return torch.zeros_like(amplitude * beta * f)

    @staticmethod
    def _lines(amplitude: Tensor, beta: Tensor) -> tuple[SpectralLine, ...]:
        return (SpectralLine(beta[..., 0] / (2 * math.pi), amplitude[..., 0] ** 2 / 2),)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, amplitude: Tensor, beta: Tensor) -> Tensor:
        turn = torch.rand(*shape, 1, generator=generator, dtype=torch.float64, device=generator.device)
        return amplitude * torch.sin(beta * sample_numbers(n_samples, beta) + 2 * math.pi * turn)

    @staticmethod
    def _states(amplitude: Tensor, beta: Tensor) -> States:
        cos, sin = beta.cos(), beta.sin()
        zero, power = torch.zeros_like(amplitude), amplitude**2 / 2
        F = matrix([[cos, sin], [-sin, cos]])
        P0 = matrix([[power, zero], [zero, power]])
        return States(("sine", "cosine"), F, torch.zeros_like(F), P0, (1.0, 0.0))

    @staticmethod
    def _datasheet(sheet: DatasheetUnits, amplitude: float, beta: float) -> Iterator[DatasheetEntry]:
        yield DatasheetEntry("tone frequency", units.tone_frequency(beta, sheet.rate), "Hz")
        yield DatasheetEntry("tone amplitude", amplitude, sheet.unit)

    @staticmethod
    def _white_and_walk(rate: float, slow: float, amplitude: float, beta: float) -> WhiteAndWalk:
        return WhiteAndWalk(0.0, 0.0, f"left out; a tone of {units.tone_frequency(beta, rate):.6g} Hz")
