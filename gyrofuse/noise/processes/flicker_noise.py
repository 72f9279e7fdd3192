"""Flicker noise, the bias instability of IEEE Std 952."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.transforms import fast_length
from gyrofuse.noise.datasheet_units import DatasheetEntry, DatasheetUnits
from gyrofuse.noise.dct_bands import BandVariance, DCTBands
from gyrofuse.noise.model import Parameter
from gyrofuse.noise.processes.base import NON_NEGATIVE, Process, States, WhiteAndWalk, normal


@dataclass(frozen=True, eq=False, repr=False)
class FlickerNoise(Process):
    """Flicker noise (bias instability): the spectrum is `variance / |2 sin(pi f)|`, near `variance / (2 pi f)`.

    It is the fractional noise ARFIMA(0, 1/2, 0). With the odd harmonic numbers `O_n = sum_{m=1}^n 1 / (2m - 1)`
    the generalised autocovariance is `-(2/pi) variance O_k`, and with `h = tau/2`

        nu = variance / pi (2 (O_2h - O_h) + (4 O_h - O_2h) / (8 h^2)),

    which goes to `variance ln 2 / pi`: the Allan deviation is flat at `sqrt(2 ln 2 / pi) B` with the bias instability
    `B = sqrt(variance)`, whatever the sampling rate. The variance of a sample is infinite, that of all differences is
    finite: no Haar wavelet sees what is slower than the record.

    Args:
        variance: Variance of the innovations, and square of the bias instability, signal^2, >= 0.

    References:
        J. R. M. Hosking, Fractional differencing, Biometrika 68, 1981; IEEE Std 952, annex C.
    """

    key = "flicker_noise"
    symbol = "FN"
    noun = "flicker noise"
    variance: Parameter = field(default=None, metadata=NON_NEGATIVE)

    @staticmethod
    def _wavelet_variance(tau: Tensor, variance: Tensor) -> Tensor:
        half = tau / 2
        one, two = _odd_harmonic(half), _odd_harmonic(tau)
        return variance / math.pi * (2 * (two - one) + (4 * one - two) / (8 * half**2))

    @staticmethod
    def _spectrum(f: Tensor, variance: Tensor) -> Tensor:
        return variance / (2 * torch.sin(math.pi * f).abs())

    @classmethod
    def unit_band_variance(cls, bands: DCTBands, x: Tensor | None) -> BandVariance:
        """Exact to 1e-12: `u_k = (2/pi)/s (pi/4 - (-1)^k a - odd/(2Ts)) + (atanh(c)/c/2 - (-1)^k b) / (pi T)`.

        `E y_k^2 = sum_l g(l) ((1 - |l|/T) cos(w l) - sin(w |l|) / (T sin w))`, `w = pi k/T`, with the generalised
        autocovariance `g`; summed by parts, sums of `sin` and `cos` of `(2m - 1) w/2` over `2m - 1` are left, up to
        `m = T`. Without their ends they are `pi/4` and `atanh(c)/2`, and the ends are

            a = s/2 int_0^inf e^(-2T t) cosh t / (sinh^2 t + s^2) dt,   b = 1/2 int ... sinh t / ...
        """
        n, sine = bands.n_samples, bands.sine_squared.sqrt()
        cosine = (1 - bands.sine_squared).sqrt()
        nodes, weights = (torch.from_numpy(v).to(sine) for v in np.polynomial.laguerre.laggauss(32))
        t = (nodes / (2 * n))[:, None, None]
        weight = weights[:, None, None] / (4 * n) / (t.sinh().square() + bands.sine_squared)
        a, b = sine * (weight * t.cosh()).sum(0), (weight * t.sinh()).sum(0)
        odd = (1 - bands.sign) / 2
        value = 2 / (math.pi * sine) * (math.pi / 4 - bands.sign * a - odd / (2 * n * sine))
        return BandVariance(bands.mean_of(value + (cosine.atanh() / cosine / 2 - bands.sign * b) / (math.pi * n)))

    @staticmethod
    def _path(n_samples: int, shape: torch.Size, generator: torch.Generator, variance: Tensor) -> Tensor:
        """All differences have their exact law; the level, of infinite variance, has mean 0 over two path lengths.

        A circle of twice the length on which the generalised autocovariance falls from either side: it is convex, so
        that no eigenvalue but that of the mean is negative, and the mean is set to 0.
        """
        size = fast_length(2 * n_samples)
        around = torch.arange(size, dtype=torch.float64, device=generator.device)
        covariance = -2 / math.pi * _odd_harmonic(torch.minimum(around, size - around))
        eigenvalues = torch.fft.rfft(covariance).real.clamp(min=0)
        eigenvalues[0] = 0.0
        path = torch.fft.irfft(torch.fft.rfft(normal(size, shape, generator)) * eigenvalues.sqrt(), size)
        return variance.sqrt() * path[..., :n_samples]

    @staticmethod
    def _states(variance: Tensor) -> States:
        """AR1s, one for each factor of 4 in time constant up to 4e6 samples, and a random walk for all slower ones.

        The autocovariance is exactly `(2/pi) variance int_0^inf phi(y)^k dy` with `phi = tanh(y)^2`: this is the
        midpoint rule, which gives the spectrum within 0.4 % from 2e-6 and 2 % from 2e-7 cycles per sample on.
        """
        spacing, n_ar1s = math.log(2), 12
        share = 2 / math.pi * spacing
        decay = [math.tanh((i + 0.5) * spacing) ** 2 for i in range(n_ar1s)]
        F = torch.diag_embed(variance.new_tensor([*decay, 1.0]).expand(*variance.shape, -1))
        # 1 - phi^2 = 8 e^(-2y) for slow ones, whose integral is that of all that is left
        walk = 2 / math.pi * 4 * math.exp(-2 * n_ar1s * spacing)
        innovations = variance.new_tensor([*(share * (1 - phi**2) for phi in decay), walk])
        start = variance.new_tensor([*(share for _ in decay), 0.0])
        Q, P0 = (torch.diag_embed(variance[..., None] * size) for size in (innovations, start))
        return States((*(f"ar1_{i + 1}" for i in range(n_ar1s)), "walk"), F, Q, P0, (1.0,) * (n_ar1s + 1))

    @staticmethod
    def _datasheet(sheet: DatasheetUnits, variance: float) -> Iterator[DatasheetEntry]:
        yield sheet.bias_instability(math.sqrt(variance))

    @staticmethod
    def _white_and_walk(rate: float, slow: float, variance: float) -> WhiteAndWalk:
        # nu of the walk, variance tau / 12 with tau = 2 slow rate, is that of flicker noise
        walk = 6 * variance * math.log(2) / (math.pi * slow * rate)
        return WhiteAndWalk(0.0, walk, f"in the random walk, as one with its Allan deviation at {slow:g} s")


def _odd_harmonic(n: Tensor) -> Tensor:
    """`sum_{m=1}^n 1 / (2m - 1)`."""
    return (torch.digamma(n + 0.5) - torch.digamma(n.new_tensor(0.5))) / 2
