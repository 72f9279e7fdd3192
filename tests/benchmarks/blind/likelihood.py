"""Spectra on the grid of the DCT-II, and what they make of a likelihood ratio.

The orthonormal DCT-II diagonalises white noise and random walk exactly and slow AR1 noise nearly. Its first coefficient
(the mean) is left out, so that a constant bias tells nothing. All figures are in nats.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, irfft, rfft
from scipy.optimize import brentq

Array = NDArray[np.float64]


class OutOfReachError(ValueError):
    """An effect cannot have that size, or not on that array: there is no such case."""


def within(name: str, size: float, most: float, unit: str) -> None:
    """Make sure that an effect is of a size that some sensor has.

    Raises:
        OutOfReachError: It is larger.
    """
    if not abs(size) <= most:
        raise OutOfReachError(f"`nats`: expected {name} of at most {most:g} {unit}".rstrip() + f", got {abs(size):.3g}")


def grid(n_samples: int) -> Array:
    """Frequencies k/(2T) of the DCT-II in cycles per sample, without the mean."""
    return np.arange(1, n_samples) / (2 * n_samples)


def coefficients(signal: Array) -> Array:
    """Orthonormal DCT-II of (..., time) without the mean."""
    return dct(signal, norm="ortho", axis=-1)[..., 1:]


def ar1_spectrum(f: Array, phi: float | Array, variance: float | Array) -> Array:
    """Two-sided spectrum per sample of an AR1 process with innovation `variance`."""
    return variance / (1 - 2 * phi * np.cos(2 * np.pi * f) + phi**2)


def folded(fine: Array, factor: int) -> Array:
    """Spectrum after averaging over `factor` fine samples and keeping one.

    `fine` is the two-sided spectrum of the oversampled signal at the frequencies i/(2 n factor), i = 0 .. n factor;
    the answer is on the grid i/(2n), i = 0 .. n.
    """
    n = (len(fine) - 1) // factor
    nu = np.arange(len(fine)) / (2 * (len(fine) - 1))
    with np.errstate(invalid="ignore"):
        gain = np.where(nu == 0, 1.0, (np.sin(np.pi * factor * nu) / (factor * np.sin(np.pi * nu))) ** 2)
    kept = fine * gain / factor
    index = np.arange(n + 1)
    total = np.zeros(n + 1)
    for k in range(factor):
        image = index + 2 * n * k
        image = np.where(image > n * factor, 2 * n * factor - image, image)  # the spectrum is even about Nyquist
        total += kept[image]
    return total


def expected_power(spectrum: Array) -> Array:
    """Expected squares of the coefficients of a stationary process, whose spectrum is known at i/(2n), i = 0 .. n.

    With autocovariance r and theta = pi k/n it is sum_m r_m [(1 - m/n) cos(m theta) - sin(m theta)/(n sin theta)], over
    m from -n to n: the spectrum itself where r is short.
    """
    n = len(spectrum) - 1
    r = irfft(spectrum)[:n]
    r[1:] *= 2
    lags = np.arange(n)
    cosines = rfft(r * (1 - lags / n), 2 * n).real[1:n]
    sines = -rfft(r, 2 * n).imag[1:n]
    return cosines - sines / (n * np.sin(np.pi * np.arange(1, n) / n))


def whitened_energy(signal: Array, spectrum: Array) -> Array:
    """m' V^-1 m of each sensor: (sensor,)."""
    return (coefficients(signal) ** 2 / spectrum).sum(axis=-1)


def shape_llr(recording: Array, signal: Array, spectrum: Array) -> float:
    """Log likelihood ratio of a known signal in Gaussian noise."""
    m = coefficients(signal) / spectrum
    return float((coefficients(recording) * m).sum() - (coefficients(signal) * m).sum() / 2)


def divergence(after: Array, before: Array) -> Array:
    """Kullback-Leibler divergence of each sensor, 1/2 sum (r - 1 - log r), r = after/before: (sensor,)."""
    r = after / before
    return (r - 1 - np.log(r)).sum(axis=-1) / 2


def comparison(after: Array, before: Array, share: float) -> Array:
    """What two records, one of each spectrum, tell of their difference: nats of each sensor, (sensor,).

    The second is `share` times as long as the first; an endless one tells its spectrum, and this is `divergence`.
    """
    if math.isinf(share):
        return divergence(after, before)
    r = after / before
    both = 1 + (r - 1) / (1 + share)
    return ((1 + share) * np.log(both) - np.log(r)).sum(axis=-1) / 2


def spectral_llr(recording: Array, after: Array, before: Array) -> float:
    """Log likelihood ratio of two Gaussian laws of known spectra."""
    power = coefficients(recording) ** 2
    return float((power / before - power / after - np.log(after / before)).sum() / 2)


def quadratic_null(ratio: Array) -> tuple[float, float, float]:
    """First three cumulants, without the effect, of sum 1/2 [e^2 (1 - 1/ratio) - log ratio], e standard normal."""
    c = 1 - 1 / ratio
    return float((c - np.log(ratio)).sum() / 2), float((c**2).sum() / 2), float((c**3).sum())


def solve(
    nats: float, expected: Callable[[float], float], low: float, high: float, *, tolerance: float = 1e-8
) -> float:
    """Size between `low` and `high` at which the rising function `expected` reaches `nats`, to a relative tolerance.

    Raises:
        OutOfReachError: It does not reach them there.
    """
    ends = [expected(low) - nats, expected(high) - nats]
    if ends[0] > 0 or ends[1] < 0:
        raise OutOfReachError(f"`nats`: expected between {ends[0] + nats:.3g} and {ends[1] + nats:.3g}, got {nats}")
    return math.exp(brentq(lambda x: expected(math.exp(x)) - nats, math.log(low), math.log(high), xtol=tolerance))


def distinct_nats(after: Array, before: Array, directions: list[Array]) -> float:
    """Nats by which a spectrum differs from the nearest one that free base parameters can reach.

    1/4 sum over the T-1 coefficients of (log after/before)^2, once the logarithmic derivatives of the base's parameters
    are projected out; summed over sensors. Below five nats the two cannot be told apart.
    """
    total = 0.0
    for sensor in range(len(before)):
        d = np.log(after[sensor] / before[sensor])
        basis = np.stack([direction[sensor] for direction in directions])
        fitted = np.linalg.lstsq(basis @ basis.T, basis @ d, rcond=None)[0] @ basis
        total += float(((d - fitted) ** 2).sum() / 4)
    return total
