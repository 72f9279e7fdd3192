"""Transforms of a record, and what a tone shows in them.

The orthonormal DCT-II `y_k = sqrt(2/T) sum_t x_t cos(pi k (t + 1/2) / T)` diagonalises white noise and random walks;
the side lobes of a Hann taper die out within a few dozen bins. On the clock `u` that is 0 in the middle of the record
both see a tone through the Dirichlet kernel `D(x) = sin(T x / 2) / sin(x / 2)`.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

# Bins over which the taper's width matters.
LOW_BINS = 64


def cosine_ordinates(signal: Tensor) -> Tensor:
    """Orthonormal DCT-II `(item, k)` of records `(item, time)`, without the mean: its ordinate 0 is 0.

    One transform of the even samples followed by the odd ones backwards (Makhoul, 1980). Lengths with a large prime
    factor take some ten times as long.
    """
    n = signal.shape[-1]
    if not len(signal):
        return signal
    signal = signal - signal.mean(-1, keepdim=True)
    spectrum = torch.fft.rfft(torch.cat([signal[:, ::2], signal[:, 1::2].flip(-1)], -1))
    k = torch.arange(spectrum.shape[-1], dtype=torch.float64, device=signal.device)
    spectrum *= torch.polar(torch.full_like(k, math.sqrt(2 / n)), -math.pi / (2 * n) * k)
    values = torch.cat([spectrum.real, -spectrum.imag[:, 1 : (n + 1) // 2].flip(-1)], -1)
    values[:, 0] = 0.0
    return values


def ramp_ordinates(n: int, device: torch.device | None = None) -> Tensor:
    """Orthonormal DCT-II `(k,)` of the ramp `0, 1, ..., n - 1` without its mean.

    `-sqrt(2/n) cos(w) / (2 sin(w)^2)` with `w = pi k / (2 n)` at odd `k`, nothing at even ones.
    """
    w = math.pi / (2 * n) * torch.arange(1, n, 2, dtype=torch.float64, device=device)
    shown = torch.zeros(n, dtype=torch.float64, device=device)
    shown[1::2] = w.cos() / w.sin().square() * -math.sqrt(1 / (2 * n))
    return shown


def tone_in_cosines(beta: Tensor, k: Tensor, n: int) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """DCT-II coefficients `k` of `cos(beta u)` and `sin(beta u)`, and their derivatives with respect to `beta`.

    `sum_u e^(i beta u) cos(omega u + pi k/2) = (e^(i pi k/2) D(beta + omega) + e^(-i pi k/2) D(beta - omega)) / 2`.
    """
    omega = math.pi / n * k
    quarter = torch.remainder(k, 4)
    scale = math.sqrt(1 / (2 * n))
    even = scale * ((quarter == 0).to(k) - (quarter == 2).to(k))  # cos(pi k/2)
    odd = scale * ((quarter == 1).to(k) - (quarter == 3).to(k))  # sin(pi k/2)
    above, above_slope = dirichlet(beta + omega, n)
    below, below_slope = dirichlet(beta - omega, n)
    slopes = even * (above_slope + below_slope), odd * (above_slope - below_slope)
    return even * (above + below), odd * (above - below), slopes


def dirichlet(x: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """`D(x) = sin(n x/2) / sin(x/2)` and its derivative, for `-2 pi < x < 2 pi`."""
    z = n / 2 * x
    near = z.abs() < 1e-2
    half = torch.where(near, 1.0, x / 2)
    over = 1 / torch.sin(half)
    value = torch.sin(z) * over
    slope = (n * torch.cos(z) - torch.cos(half) * over * torch.sin(z)) * over / 2
    value = torch.where(near, n * (1 - z.square() / 6), value)
    return value, torch.where(near, -n * n / 2 * z * (1 / 3 - z.square() / 30), slope)


def tone_in_hann(x: Tensor, n: int) -> Tensor:
    """Transform of the Hann taper on the centred clock, `sum_u (1 + cos(2 pi u/n))/2 cos(x u)`."""
    shift = 2 * math.pi / n
    # Whole turns would leave the Dirichlet kernel's domain; for even n they change its sign.
    turns = torch.round(x / (2 * math.pi))
    x = x - 2 * math.pi * turns
    sign = 1.0 if n % 2 else 1 - 2 * torch.remainder(turns, 2)
    side = (dirichlet(x - shift, n)[0] + dirichlet(x + shift, n)[0]) / 4
    return sign * (dirichlet(x, n)[0] / 2 + side)


def squared_modulus(values: Tensor) -> Tensor:
    """`|z|^2` of complex values, without the root that `abs` takes: several times as fast."""
    return values.real.square().addcmul_(values.imag, values.imag)


def fast_length(n: int) -> int:
    """Smallest even length >= n with the factors 2, 3 and 5 only: a prime one can be a hundred times slower."""
    best = 1 << max((n - 1).bit_length(), 1)
    five = 1
    while five < best:
        three = five
        while three < best:
            two = max(-(-n // three) - 1, 0).bit_length()
            best = min(best, three << max(two, 1))
            three *= 3
        five *= 5
    return best


@functools.lru_cache(maxsize=16)
def taper_kernel(n_samples: int, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and weights `(bin, frequency)` that turn a density into the mean periodogram of the lowest bins.

    The taper looks at `S` over two bins to either side, over which a steep spectrum bends; a mean removed with the
    taper's weights takes the frequency 0 out.
    """
    per_bin = 8
    n_low = min(LOW_BINS, length // 4)
    g = (np.arange((n_low + 8) * per_bin) + 0.5) / per_bin  # cycles in the record
    g = g[g < n_samples / 2]
    k = np.arange(1, n_low + 1)[:, None] * (n_samples / length)

    def shape(v: np.ndarray) -> np.ndarray:
        near = np.abs(np.abs(v) - 1) < 1e-9
        return np.where(near, 0.5, np.sinc(v) / np.where(near, 1.0, 1 - v**2))

    seen = [(shape(k - sign * g) - shape(k) * shape(g)) ** 2 for sign in (1, -1)]
    kernel = (seen[0] + seen[1]) / (1.5 * per_bin)
    return g / n_samples, kernel
