"""Smooth density of the noise under spectral lines, from the periodogram itself."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.transforms import LOW_BINS

# Smallest distance from the highest frequency, as a share of it, that widths of bands and the coordinate go down to.
_TOP = 1 / 32


def smooth_background(power: Tensor, coordinates: Tensor, first: int, last: int) -> tuple[Tensor, Tensor]:
    """Smooth log density under a periodogram, and the variance of that estimate.

    Medians of bands, whose logs a spline smooths; straight lines over `frequency_coordinate` between the bands.

    Args:
        power: `(item, bin)`, the bins from 1 up to half the transform's length.
        coordinates: `frequency_coordinate` of each bin, `(bin,)`.
        first: First bin of the lowest band.
        last: Last bin of the highest band.

    Returns:
        Log density `(item, bin)` and its variance `(bin,)`, which is that of `1 / variance` ordinates.
    """
    highest = power.shape[-1]
    smoother = _smoother(first, last, highest)
    matrix, at = (torch.from_numpy(v).to(power) for v in (smoother.matrix, smoother.coordinates))
    centre = at[1:-1]
    logs = power.new_empty(len(power), len(smoother.edges))
    for b, (low, high) in enumerate(smoother.edges):
        logs[:, b] = _log_of_median(power[:, low - 1 : high - 1 : _stride(high - low)])
    smooth = logs @ matrix.T  # (item, point)
    for _ in range(2):
        # Where a band spans octaves, once more without the slope.
        for b, (low, high) in enumerate(smoother.edges):
            if low > LOW_BINS:
                break
            bins = coordinates[low - 1 : high - 1]
            slope = (smooth[:, b + 2] - smooth[:, b]) / (at[b + 2] - at[b])
            tilt = torch.exp(slope[:, None] * (bins - centre[b]))
            logs[:, b] = _log_of_median(power[:, low - 1 : high - 1] / tilt)
        smooth = logs @ matrix.T
    # Straight lines between the points; the variance goes with them as one more item.
    corners = torch.cat([smooth, torch.from_numpy(smoother.variance).to(power)[None]])
    slopes = corners.diff(dim=-1) / at.diff()
    lines = power.new_empty(len(corners), highest)
    cuts = [0, *torch.searchsorted(coordinates, at[1:-1]).tolist(), highest]
    for b, (low, high) in enumerate(itertools.pairwise(cuts)):
        offset = corners[:, b] - slopes[:, b] * at[b]
        torch.addcmul(offset[:, None], slopes[:, b, None], coordinates[None, low:high], out=lines[:, low:high])
    return lines[:-1], lines[-1]


def _stride(n_bins: int) -> int:
    """Stride of the ordinates in the median of a band, of which a thousand know it to some 5 %."""
    return max(n_bins // 2**10, 1)


def _log_of_median(ordinates: Tensor) -> Tensor:
    """Log of the mean of exponential ordinates `(item, bin)`, by their median."""
    n = ordinates.shape[-1]
    rank = (n + 1) // 2
    # Mean of that order statistic of n unit exponentials, ln 2 for many.
    expected = sum(1 / i for i in range(n - rank + 1, n + 1)) if n < 100 else math.log(2)
    return (ordinates.kthvalue(rank, dim=-1).values / expected).log()


def frequency_coordinate(k: Tensor, highest: int) -> Tensor:
    """Coordinate of the background: log frequency, at high frequencies rather the log distance from the highest."""
    return k.log() - ((1 + _TOP) * highest - k).log()


@dataclass(frozen=True, eq=False)
class _Smoother:
    """Linear smoother of the logs of bands.

    Attributes:
        edges: First bin of each band and the one after its last.
        coordinates: `frequency_coordinate` `(point,)` of the lowest bin, the middles of the bands, the highest bin.
        matrix: `(point, band)`.
        variance: Of the smoothed log, `(point,)`.
    """

    edges: list[tuple[int, int]]
    coordinates: np.ndarray
    matrix: np.ndarray
    variance: np.ndarray


@functools.lru_cache(maxsize=16)
def _smoother(first: int, last: int, highest: int) -> _Smoother:
    """Smoothing spline: minimises `sum_b (y_b - s_b)^2 / v_b + integral (s'')^2 / q` over `frequency_coordinate`."""
    # Bands of at least six bins and of a fraction of their frequency, or of the distance from the highest one.
    fewest_bins, fraction = 6, 0.18
    # Intensity of the white noise that the curvature of the background is in log frequency: between white noise and a
    # random walk the squared curvature reaches 1 within an octave.
    intensity = 0.3
    # Variance of the log of the median of n neighbouring Hann ordinates, times n: twice that of independent ones, which
    # every other one nearly is.
    median_variance = 2 / math.log(2) ** 2
    edges = []
    low = first
    while low <= last:
        distance = max(min(low, highest - low), highest * _TOP)
        high = low + max(fewest_bins, math.ceil(fraction * min(low, distance)))
        if last + 1 - high < max(fewest_bins, (high - low) // 2):
            high = last + 1
        edges.append((low, high))
        low = high
    middles = [(a + b - 1) / 2 if a > LOW_BINS else float(np.exp(np.log(np.arange(a, b)).mean())) for a, b in edges]
    x = frequency_coordinate(torch.tensor([1.0, *middles, float(highest)], dtype=torch.float64), highest).numpy()
    gap = np.diff(x)
    curvature = np.zeros((len(x) - 2, len(x)))
    for i in range(len(x) - 2):
        width = (gap[i] + gap[i + 1]) / 2
        row = np.array([1 / gap[i], -1 / gap[i] - 1 / gap[i + 1], 1 / gap[i + 1]]) / width
        curvature[i, i : i + 3] = row * math.sqrt(width)
    n_bins = np.array([b - a for a, b in edges])
    variance = np.array([median_variance * (1 if _stride(n) == 1 else 0.5) / (n / _stride(n)) for n in n_bins.tolist()])
    data = np.zeros((len(x), len(edges)))
    data[1:-1] = np.diag(1 / variance)
    precision = curvature.T @ curvature / intensity + np.pad(np.diag(1 / variance), 1)
    covariance = np.linalg.inv(precision)
    return _Smoother(edges, x, covariance @ data, covariance.diagonal().copy())
