"""Noise processes of rate sensors: one class, one equation; they compose with `+` into a model.

Haar wavelet variances `nu` are those of level `j`, filter length `tau = 2**j`; frequencies `f` are in cycles
per sample. The formulas are those of Voirol et al., Accounting for Vibration Noise in Stochastic Measurement
Errors, appendix C.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gyrofuse._base.random import ar1_recursion
from gyrofuse.noise.model import Model, Parameter, Process, SpectralLine, domain

__all__ = [
    "AR1",
    "Drift",
    "Model",
    "Process",
    "QuantizationNoise",
    "RandomWalk",
    "Sinusoid",
    "SpectralLine",
    "WhiteNoise",
]

_NON_NEGATIVE = domain("a finite number >= 0", lambda v: v >= 0)
_STATIONARY = domain("a number strictly between -1 and 1", lambda v: v.abs() < 1)
_FINITE = domain("a finite number", torch.isfinite)
# pi rounded to float32 lies just above pi
_ANGLE = domain("a number in (0, pi]", lambda v: (v > 0) & (v <= math.pi * (1 + 1e-7)))


@dataclass(frozen=True, eq=False, repr=False)
class WhiteNoise(Process):
    """White noise (angle random walk): `nu = variance / tau`.

    Args:
        variance: signal^2, >= 0.
    """

    key = "white_noise"
    symbol = "WN"
    variance: Parameter = field(default=None, metadata=_NON_NEGATIVE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, variance: Tensor) -> Tensor:
        return variance / tau

    @staticmethod
    def _spectrum(f: Tensor, variance: Tensor) -> Tensor:
        return variance * torch.ones_like(f)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, variance: Tensor) -> Tensor:
        return variance.sqrt() * _normal(n_samples, shape, generator)


@dataclass(frozen=True, eq=False, repr=False)
class QuantizationNoise(Process):
    """Quantisation of the integrated angle, the first difference of white noise: `nu = 6 variance / tau^2`.

    Args:
        variance: Of the angle's white noise (`q2`), signal^2, >= 0; the process has variance `2 q2` and
            autocovariance `-q2` at lag 1.
    """

    key = "quantization_noise"
    symbol = "QN"
    variance: Parameter = field(default=None, metadata=_NON_NEGATIVE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, variance: Tensor) -> Tensor:
        return 6 * variance / tau**2

    @staticmethod
    def _spectrum(f: Tensor, variance: Tensor) -> Tensor:
        return 4 * variance * torch.sin(math.pi * f) ** 2

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, variance: Tensor) -> Tensor:
        return variance.sqrt() * _normal(n_samples + 1, shape, generator).diff(dim=-1)


@dataclass(frozen=True, eq=False, repr=False)
class AR1(Process):
    """First-order autoregression (Gauss-Markov): `x_t = phi x_{t-1} + e_t`, stationary.

    Its autocovariance is `variance / (1 - phi^2) phi^k`.

    Args:
        phi: Strictly between -1 and 1.
        variance: Of the innovations `e_t`, signal^2, >= 0.
    """

    key = "ar1"
    symbol = "AR1"
    repeatable = True
    phi: Parameter = field(default=None, metadata=_STATIONARY)
    variance: Parameter = field(default=None, metadata=_NON_NEGATIVE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, phi: Tensor, variance: Tensor) -> Tensor:
        return variance / ((1 - phi) * (1 + phi)) * haar_kernel(phi, tau)

    @staticmethod
    def _spectrum(f: Tensor, phi: Tensor, variance: Tensor) -> Tensor:
        # |1 - phi e^{-i omega}|^2 in a form that keeps its digits near phi = 1 and f = 0
        return variance / ((1 - phi) ** 2 + 4 * phi * torch.sin(math.pi * f) ** 2)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, phi: Tensor, variance: Tensor) -> Tensor:
        innovations = variance.sqrt() * _normal(n_samples, shape, generator)
        innovations[..., :1] /= ((1 - phi) * (1 + phi)).sqrt()  # stationary from the first sample on
        return ar1_recursion(innovations, phi[..., 0])


@dataclass(frozen=True, eq=False, repr=False)
class Drift(Process):
    """Deterministic ramp `slope * t`: `nu = slope^2 tau^2 / 16`.

    Args:
        slope: signal per sample, of either sign.
    """

    key = "drift"
    symbol = "DR"
    slope: Parameter = field(default=None, metadata=_FINITE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, slope: Tensor) -> Tensor:
        return (slope * tau / 4) ** 2

    @staticmethod
    def _spectrum(f: Tensor, slope: Tensor) -> Tensor:
        return torch.zeros_like(slope * f)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, slope: Tensor) -> Tensor:
        return (slope * _time(n_samples, slope)).expand(*shape, n_samples)


@dataclass(frozen=True, eq=False, repr=False)
class RandomWalk(Process):
    """Sum of white increments (rate random walk): `nu = variance (tau^2 + 2) / (12 tau)`.

    Args:
        variance: Of the increments, signal^2, >= 0.
    """

    key = "random_walk"
    symbol = "RW"
    variance: Parameter = field(default=None, metadata=_NON_NEGATIVE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, variance: Tensor) -> Tensor:
        return variance * (tau**2 + 2) / (12 * tau)

    @staticmethod
    def _spectrum(f: Tensor, variance: Tensor) -> Tensor:
        return variance / (4 * torch.sin(math.pi * f) ** 2)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, variance: Tensor) -> Tensor:
        return (variance.sqrt() * _normal(n_samples, shape, generator)).cumsum(-1)


@dataclass(frozen=True, eq=False, repr=False)
class Sinusoid(Process):
    """Tone `amplitude * sin(beta t + phase)` of uniform random phase.

    `nu = amplitude^2 (1 - cos(beta tau/2))^2 / (tau^2 (1 - cos beta))` (Voirol et al., lemma 1), written with
    squared sines, which keep its digits for small `beta` and near its zeros. Its spectrum is a line of power
    `amplitude^2 / 2`.

    Args:
        amplitude: signal, >= 0.
        beta: Angular frequency, rad per sample, in `(0, pi]`.
    """

    key = "sinusoid"
    symbol = "SIN"
    repeatable = True
    amplitude: Parameter = field(default=None, metadata=_NON_NEGATIVE)
    beta: Parameter = field(default=None, metadata=_ANGLE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, amplitude: Tensor, beta: Tensor) -> Tensor:
        ratio = torch.sin(beta * tau / 4) ** 2 / (tau * torch.sin(beta / 2))
        return 2 * (amplitude * ratio) ** 2

    @staticmethod
    def _spectrum(f: Tensor, amplitude: Tensor, beta: Tensor) -> Tensor:
        return torch.zeros_like(amplitude * beta * f)

    @staticmethod
    def _lines(amplitude: Tensor, beta: Tensor) -> tuple[SpectralLine, ...]:
        return (SpectralLine(beta[..., 0] / (2 * math.pi), amplitude[..., 0] ** 2 / 2),)

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, amplitude: Tensor, beta: Tensor) -> Tensor:
        turn = torch.rand(*shape, 1, generator=generator, dtype=torch.float64, device=generator.device)
        return amplitude * torch.sin(beta * _time(n_samples, beta) + 2 * math.pi * turn)


def haar_kernel(z: Tensor, tau: Tensor) -> Tensor:
    """Haar wavelet variance of a process with autocovariance `z^k`, `k >= 0`, to rounding.

    The closed form `[tau (1 - z^2) - 2 z (3 - 4 z^h + z^tau)] / (tau (1 - z))^2`, `h = tau/2`, cancels to
    third order near `z = 1`. Compare the halves of a window instead: with `within` the mean correlation
    inside a half and `between` that of one half with the other, `nu = (within - between)/2`. Doubling the
    window gives `within <- (within + between)/2`, and `between = z m^2` with `m = (1 - z^h)/(h (1 - z))`.
    While `z^h` is near 1, the complements to 1 obey the same recursion. Both are sums of terms of one sign.

    Args:
        z: `(..., 1)`, real between -1 and 1, or complex with `|z| < 1`: the wavelet variance of the
            autocovariance `Re sum_i b_i z_i^k` is the same combination of kernels.
        tau: `(level,)`, all of 2, 4, .. in order.

    Returns:
        `(..., level)`.
    """
    half = tau / 2
    log_z = z.log() if z.is_complex() else z.abs().clamp(min=1e-300).log()
    loss = torch.where(half == 1, 1 - z, -torch.expm1(half * log_z))  # 1 - z^h; h is even beyond the first
    log_m = _sum_before(torch.log1p(-loss / 2))  # m_2h = m_h (1 + z^h)/2
    between = z * torch.exp(2 * log_m)
    within = (1 + _sum_before(half * between)) / half
    not_between = (1 - z) - z * torch.expm1(2 * log_m)
    not_within = _sum_before(half * not_between) / half
    correlated = (z.real > 0.5) & (loss.abs() < 0.5)
    return torch.where(correlated, not_between - not_within, within - between) / 2


def haar_kernel_slope(z: Tensor, tau: Tensor) -> Tensor:
    """Derivative of `haar_kernel` by real `z`, by the same recursion, `(..., level)`."""
    half = tau / 2
    power = torch.where(half == 1, z, torch.exp(half * z.abs().clamp(min=1e-300).log()))  # z^h
    loss = 1 - power
    loss_slope = -half * torch.where(z == 0, (half == 1).to(z), power / torch.where(z == 0, 1.0, z))
    log_m = _sum_before(torch.log1p(-loss / 2))
    log_m_slope = _sum_before(-loss_slope / (2 - loss))
    between_slope = torch.exp(2 * log_m) * (1 + 2 * z * log_m_slope)
    within_slope = _sum_before(half * between_slope) / half
    return (within_slope - between_slope) / 2


def _sum_before(terms: Tensor) -> Tensor:
    """Sum of the terms before each, along the last dimension."""
    return torch.nn.functional.pad(terms[..., :-1].cumsum(-1), (1, 0))


def _normal(n_samples: int, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """Standard normal `(*shape, time)`."""
    return torch.randn(*shape, n_samples, generator=generator, dtype=torch.float64, device=generator.device)


def _time(n_samples: int, like: Tensor) -> Tensor:
    """Sample numbers 1, 2, .. `n_samples`."""
    return torch.arange(1, n_samples + 1, dtype=torch.float64, device=like.device)
