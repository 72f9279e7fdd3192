"""Matern process of order 3/2, the critically damped second-order Gauss-Markov process."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn.functional import softplus

from gyrofuse._base import units
from gyrofuse.noise.datasheet_units import DatasheetEntry, DatasheetUnits
from gyrofuse.noise.dct_bands import BandVariance, DCTBands
from gyrofuse.noise.model import Parameter
from gyrofuse.noise.processes.ar1_recursion import ar1_recursion
from gyrofuse.noise.processes.base import NON_NEGATIVE, Process, States, WhiteAndWalk, domain, matrix, normal
from gyrofuse.noise.processes.haar_kernel import compared_halves, sum_before, within_halves
from gyrofuse.noise.processes.random_walk import RandomWalk
from gyrofuse.noise.processes.white_noise import WhiteNoise


@dataclass(frozen=True, eq=False, repr=False)
class Matern32(Process):
    """Second-order Gauss-Markov process, critically damped (Matern 3/2), sampled: smooth where an AR1 is rough.

    Its autocovariance is `variance (1 + a k) phi^k` with `a = -ln phi`; in continuous time white noise through two
    low-pass filters of time constant `1 / a`.

    Args:
        phi: Decay over one sample `exp(-1 / time constant)`, the double pole of the sampled process, strictly between
            0 and 1. Fits move it as `x = logit(phi) / 2`.
        variance: Variance of the process itself, signal^2, >= 0; an AR1 has that of its innovations.

    References:
        A. Gelb (ed.), Applied Optimal Estimation, table 2.2-1; C. E. Rasmussen, C. K. I. Williams, Gaussian Processes
        for Machine Learning, equation (4.17).
    """

    key = "matern32"
    symbol = "GM2"
    noun = "second-order Gauss-Markov process"
    repeatable = True
    shape_name = "phi"
    stand_ins = (WhiteNoise, RandomWalk)
    short_limit = WhiteNoise
    memoryless = 0.01  # successive samples have a correlation of 0.056
    phi: Parameter = field(
        default=None, metadata=domain("a number strictly between 0 and 1", lambda v: (v > 0) & (v < 1))
    )
    variance: Parameter = field(default=None, metadata=NON_NEGATIVE)

    @staticmethod
    def to_unconstrained(value: Tensor) -> Tensor:
        return value.logit() / 2

    @staticmethod
    def from_unconstrained(x: Tensor) -> Tensor:
        return (2 * x).sigmoid()

    @staticmethod
    def unconstrained_slope(x: Tensor) -> Tensor:
        return 2 * (2 * x).sigmoid() * (-2 * x).sigmoid()

    @staticmethod
    def unconstrained_limits(longest: float) -> tuple[float, float]:
        # Time constants of an eighth of a sample, white noise, and of 16 filters, a trend to all of them.
        return -math.log(math.expm1(8)) / 2, -math.log(math.expm1(1 / (16 * longest))) / 2

    @staticmethod
    def _wavelet_variance(tau: Tensor, phi: Tensor, variance: Tensor) -> Tensor:
        """By the recursion of `haar_kernel`.

        The mean of `phi^l` over the lags `l` between the halves of a window is `e^-w`, and the mean of `l phi^l` that
        times the mean lag, which the weights `phi^l` give: a lag is 1 and twice a sum of `2^k b_k`, `2^k < h`, with
        independent bits of probability `1 / (1 + phi^-(2^k))`. Hence `between = e^-w (1 + v)`, `v = a mean lag`.
        """
        decay, half = -phi.log(), tau / 2
        log_mean, mean_lag = _lags(decay, half)
        w, v = decay - log_mean, decay * mean_lag
        y = (decay * half / 2).clamp(max=1.0)  # where the complement counts it is small
        # v - w, each term of one sign: ln cosh y - y tanh y
        excess = 2 * sum_before(torch.log1p(2 * (y / 2).sinh().square()) - y * y.tanh())
        not_between = torch.special.gammainc(torch.full_like(w, 2.0), w) - torch.exp(-w) * excess
        return variance * compared_halves(half, torch.exp(-w) * (1 + v), not_between, decay * half < 0.5)

    @staticmethod
    def unit_wavelet_variance_slope(tau: Tensor, x: Tensor) -> Tensor:
        """Derivative with respect to `x`: that of the autocovariance with respect to `a` is `-a l^2 phi^l`."""
        decay, half = softplus(-2 * x), tau / 2
        log_mean, mean_lag = _lags(decay, half)
        bit = (-decay * half).sigmoid()
        squared_lag = mean_lag.square() + 2 * sum_before(half.square() * bit * (1 - bit))
        between = -decay * torch.exp(log_mean - decay) * squared_lag
        return (within_halves(half, between) - between) / 2 * -2 * (-2 * x).sigmoid()

    @staticmethod
    def _spectrum(f: Tensor, phi: Tensor, variance: Tensor) -> Tensor:
        return variance * _density(-phi.log(), torch.sin(math.pi * f) ** 2)

    @classmethod
    def unit_band_variance(cls, bands: DCTBands, x: Tensor | None) -> BandVariance:
        """Exact value and slope; the curvature is that of a process without ends.

        As the autocovariance is `(1 + a phi d/dphi) phi^k`, so is the variance of an ordinate that operator on the one
        of a stationary `AR1` of variance 1, `(1 - phi^2) / D - (4 c^2 / T) K`, with `K = A (1 -+ phi^T)`, `-` for even
        and `+` for odd `k`, and `A = sinh(a/2)^2 / (4 (sinh(a/2)^2 + s^2)^2)`. As `a l^2 phi^l` is what the
        autocovariance loses with `a`, its derivative is `-a` times the second derivative of that with respect to `a`.
        """
        assert x is not None
        decay = softplus(-2 * x)[:, None, None]
        phi, loss, s2, n = torch.exp(-decay), -torch.expm1(-decay), bands.sine_squared, bands.n_samples
        half, sinh = loss.square() / (4 * phi), loss * (1 + phi) / (2 * phi)  # sinh(a/2)^2, sinh a
        cosh, total = 1 + 2 * half, half + s2
        bend = s2 * (3 - 2 * s2) - (1 - 2 * s2) * half
        loss_rate = sinh * bend / (4 * total**3)  # minus the second derivative of (1 - phi^2) / D
        loss_slope = (cosh * bend - sinh**2 * (1 - 2 * s2) / 2) / (4 * total**3) - 3 * sinh**2 * bend / (8 * total**4)
        # A and 1 -+ phi^T, each with its first two derivatives with respect to ln phi
        a = half / (4 * total**2), -sinh * (s2 - half) / (8 * total**3)
        a_second = cosh * (s2 - half) / (8 * total**3) + sinh**2 * (half - 2 * s2) / (8 * total**4)
        fading = bands.sign * torch.exp(-decay * n)
        first = a[1] * (1 - fading) - a[0] * n * fading
        second = a_second * (1 - fading) - 2 * a[1] * n * fading - a[0] * n**2 * fading
        value = _density(decay, s2) - bands.ends * (a[0] * (1 - fading) + decay * first)
        slope = decay * (loss_rate + bands.ends * second)
        moved, moved_slope = -2 * loss, 4 * phi * loss  # da / dx and its derivative
        curvature = (loss_rate + decay * loss_slope) * moved**2 + slope * moved_slope
        return BandVariance(bands.mean_of(value), bands.mean_of(slope * moved), bands.mean_of(curvature))

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, phi: Tensor, variance: Tensor) -> Tensor:
        """Exact: the sum of the two states is an AR1, and drives the first one, see `_states`."""
        decay = -phi.log()
        own, both, shared = _innovations(decay, phi)
        first, second = normal(n_samples, shape, generator), normal(n_samples, shape, generator)
        summed = both.sqrt() * first
        moved = shared / both.sqrt() * first + (own - shared.square() / both).sqrt() * second
        # stationary from the first sample on, with independent states of variance 1
        start = torch.stack([first[..., 0] + second[..., 0], first[..., 0]])
        summed = ar1_recursion(torch.cat([start[0, ..., None], summed[..., 1:]], -1), phi[..., 0])
        driven = phi * decay * summed[..., :-1] + moved[..., 1:]
        return variance.sqrt() * ar1_recursion(torch.cat([start[1, ..., None], driven], -1), phi[..., 0])

    @staticmethod
    def _states(phi: Tensor, variance: Tensor) -> States:
        """The process and its derivative times the time constant, which are independent and of one variance."""
        decay = -phi.log()
        own, both, shared = _innovations(decay, phi)
        cross = shared - own
        F = phi[..., None, None] * matrix([[1 + decay, decay], [-decay, 1 - decay]])
        Q = variance[..., None, None] * matrix([[own, cross], [cross, both - own - 2 * cross]])
        P0 = torch.diag_embed(variance[..., None].expand(*variance.shape, 2))
        return States(("", "derivative"), F, Q, P0, (1.0, 0.0))

    @staticmethod
    def _datasheet(sheet: DatasheetUnits, phi: float, variance: float) -> Iterator[DatasheetEntry]:
        yield DatasheetEntry("2nd-order Gauss-Markov time", units.correlation_time(phi, sheet.rate), "s")
        yield sheet.bias("2nd-order Gauss-Markov sigma", math.sqrt(variance))

    @staticmethod
    def _white_and_walk(rate: float, slow: float, phi: float, variance: float) -> WhiteAndWalk:
        time, decay = units.correlation_time(phi, rate), -math.log(phi)
        if time >= slow:
            # the least random walk whose spectrum is nowhere below, they touch at f = rate a / (2 pi)
            return WhiteAndWalk(0.0, variance * decay, f"time constant {time:.4g} s, below a random walk and in it")
        white = variance * (1 - phi**2 + 2 * decay * phi) / (1 - phi) ** 2
        words = f"time constant {time:.4g} s, its density at frequency 0 in the noise density"
        return WhiteAndWalk(white, 0.0, words)


def _lags(decay: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithm of the mean of `phi^(l - 1)` over lags `l` between halves of a window, and their weighted mean."""
    log_mean = 2 * sum_before(torch.log1p(torch.expm1(-decay * half) / 2))
    return log_mean, 1 + 2 * sum_before(half * (-decay * half).sigmoid())


def _density(decay: Tensor, s2: Tensor) -> Tensor:
    """Spectral density of the process of variance 1, for `s2 = sin(pi f)^2`, in a form that keeps its digits.

    `sum_k (1 + a |k|) phi^|k| cos(2 pi f k)` with `D = (1 - phi)^2 + 4 phi s^2` is
    `((1 - phi)^2 (1 - phi^2 + 2 a phi) + 4 phi s^2 (1 - phi^2 - a (1 + phi^2))) / D^2`.
    """
    phi, loss = torch.exp(-decay), -torch.expm1(-decay)
    square = (decay**2).clamp(max=1.0)
    series = 1 + square / 10 * (1 + square / 28 * (1 + square / 54 * (1 + square / 88)))
    bend = torch.where(  # 1 - phi^2 - a (1 + phi^2), of order a^3
        decay < 0.3, -2 / 3 * phi * decay**3 * series, loss * (1 + phi) - decay * (1 + phi**2)
    )
    power = loss**2 * (loss * (1 + phi) + 2 * decay * phi) + 4 * phi * s2 * bend
    return power / (loss**2 + 4 * phi * s2) ** 2


def _innovations(decay: Tensor, phi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Innovations for variance 1: variance of the first state's, of that of the sum of both, and their covariance."""
    own = torch.special.gammainc(torch.full_like(decay, 3.0), 2 * decay)  # 1 - phi^2 (1 + 2 a + 2 a^2)
    return own, -2 * torch.expm1(-2 * decay), own + 2 * (decay * phi) ** 2
