"""First-order autoregression."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gyrofuse._base import units
from gyrofuse.noise.datasheet_units import DatasheetEntry, DatasheetUnits
from gyrofuse.noise.dct_bands import BandVariance, DCTBands
from gyrofuse.noise.model import Parameter
from gyrofuse.noise.processes.ar1_recursion import ar1_recursion
from gyrofuse.noise.processes.base import NON_NEGATIVE, Process, States, WhiteAndWalk, domain, matrix, normal
from gyrofuse.noise.processes.haar_kernel import SMALLEST, haar_kernel, haar_kernel_slope
from gyrofuse.noise.processes.quantization_noise import QuantizationNoise
from gyrofuse.noise.processes.random_walk import RandomWalk
from gyrofuse.noise.processes.white_noise import WhiteNoise


@dataclass(frozen=True, eq=False, repr=False)
class AR1(Process):
    """First-order autoregression (first-order Gauss-Markov): `x_t = phi x_{t-1} + e_t`, stationary.

    Its autocovariance is `variance / (1 - phi^2) phi^k`.

    Args:
        phi: Correlation of successive samples, strictly between -1 and 1. Fits move it as `x = atanh phi`.
        variance: Variance of the innovations `e_t`, signal^2, >= 0.
    """

    key = "ar1"
    symbol = "AR1"
    spellings = ("gm",)
    noun = "AR1"
    repeatable = True
    shape_name = "phi"
    alternates = True
    stand_ins = (WhiteNoise, QuantizationNoise, RandomWalk)
    short_limit = WhiteNoise
    long_limit = RandomWalk
    phi: Parameter = field(default=None, metadata=domain("a number strictly between -1 and 1", lambda v: v.abs() < 1))
    variance: Parameter = field(default=None, metadata=NON_NEGATIVE)

    @staticmethod
    def to_unconstrained(value: Tensor) -> Tensor:
        return value.atanh()

    @staticmethod
    def from_unconstrained(x: Tensor) -> Tensor:
        return x.tanh()

    @staticmethod
    def unconstrained_slope(x: Tensor) -> Tensor:
        return 1 - x.tanh().square()

    @staticmethod
    def unconstrained_limits(longest: float) -> tuple[float, float]:
        # phi = -0.995, and a time constant of 64 filters, a random walk to all of them.
        return -3.0, math.atanh(math.exp(-1 / (64 * longest)))

    @staticmethod
    def _wavelet_variance(tau: Tensor, phi: Tensor, variance: Tensor) -> Tensor:
        return variance / ((1 - phi) * (1 + phi)) * haar_kernel(phi, tau)

    @staticmethod
    def unit_wavelet_variance_slope(tau: Tensor, x: Tensor) -> Tensor:
        """Derivative of `G(phi) / (1 - phi^2)` with respect to `x`: `G' + 2 phi G / (1 - phi^2)`."""
        phi = x.tanh()
        value, slope = haar_kernel(phi, tau), haar_kernel_slope(phi, tau)
        return slope + 2 * phi * value / ((1 - phi) * (1 + phi))

    @staticmethod
    def _spectrum(f: Tensor, phi: Tensor, variance: Tensor) -> Tensor:
        # |1 - phi e^{-i omega}|^2 in a form that keeps its digits near phi = 1 and f = 0
        return variance / ((1 - phi) ** 2 + 4 * phi * torch.sin(math.pi * f) ** 2)

    @classmethod
    def unit_band_variance(cls, bands: DCTBands, x: Tensor | None) -> BandVariance:
        """Exact value and slope; the curvature is that of a process without ends.

        The inverse covariance is that of a process on a circle of mirror images, whose eigenvalues are
        `D = (1 - phi)^2 + 4 phi s^2`, and something at the two ends; by the matrix inversion lemma
        `u_k = 1/D - (4 c^2 / T) h / D^2`, `h = phi (1 - phi) (1 -+ phi^T) / (1 + phi)`, `-` for even and `+` for odd
        `k`.
        """
        assert x is not None
        z = x.tanh()[:, None, None]  # (item, 1, 1)
        n, sign = bands.n_samples, bands.sign
        size = z.abs().clamp(min=SMALLEST).log()
        odd_power = -1.0 if n % 2 else 1.0
        before = torch.exp((n - 1) * size) * torch.where(z < 0, -odd_power, 1.0)  # phi^(T-1)
        mirrored, mirrored_slope = 1 - sign * before * z, -sign * n * before
        edge = z * (1 - z) / (1 + z)
        edge_slope = (1 - 2 * z - z.square()) / (1 + z).square()
        h, h_slope = edge * mirrored, edge_slope * mirrored + edge * mirrored_slope
        d, d_slope = (1 - z).square() + 4 * z * bands.sine_squared, 4 * bands.sine_squared - 2 * (1 - z)
        value = (1 - bands.ends * h / d) / d
        slope = (-d_slope - bands.ends * (h_slope - 2 * h * d_slope / d)) / d.square()
        inside = (1 - z) * (1 + z)  # d phi / dx
        curvature = (2 * d_slope.square() / d - 2) / d.square() * inside.square() - 2 * z * inside * slope
        return BandVariance(bands.mean_of(value), bands.mean_of(slope * inside), bands.mean_of(curvature))

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, phi: Tensor, variance: Tensor) -> Tensor:
        innovations = variance.sqrt() * normal(n_samples, shape, generator)
        innovations[..., :1] /= ((1 - phi) * (1 + phi)).sqrt()  # stationary from the first sample on
        return ar1_recursion(innovations, phi[..., 0])

    @staticmethod
    def _states(phi: Tensor, variance: Tensor) -> States:
        stationary = variance / ((1 - phi) * (1 + phi))
        return States(("",), matrix([[phi]]), matrix([[variance]]), matrix([[stationary]]), (1.0,))

    @staticmethod
    def _datasheet(sheet: DatasheetUnits, phi: float, variance: float) -> Iterator[DatasheetEntry]:
        if phi > 0:
            yield DatasheetEntry("Gauss-Markov correlation time", units.correlation_time(phi, sheet.rate), "s")
        yield sheet.bias("Gauss-Markov deviation", (variance / ((1 - phi) * (1 + phi))) ** 0.5)

    @staticmethod
    def _white_and_walk(rate: float, slow: float, phi: float, variance: float) -> WhiteAndWalk:
        time = units.correlation_time(phi, rate) if phi > 0 else 0.0
        words = f"correlation time {time:.4g} s" if phi > 0 else "no correlation time"
        if time >= slow:
            return WhiteAndWalk(0.0, variance, f"{words}, its innovations in the random walk")
        return WhiteAndWalk(variance / (1 - phi) ** 2, 0.0, f"{words}, its density at frequency 0 in the noise density")
