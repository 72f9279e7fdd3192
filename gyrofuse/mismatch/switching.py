"""Likelihoods of block means of a Gaussian process where another one might switch between two values.

It stands on a wandering background `b_k = b_{k-1} + N(0, q)` seen in white noise of variance `r`, and is an
Ornstein-Uhlenbeck process of any variance and time constant (Kalman's filter). The record is cut into as many stretches
as there are blocks to judge; each filter starts one stretch earlier.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gyrofuse.mismatch.base import Base
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.folds import N_JUDGED

Array = NDArray[np.float64]

_MOST_BLOCKS = 128  # of a stretch
_FAR = 8  # blocks, over which the background's steps are told
_LARGEST = 1e4
_MAD = 0.6744897501960817


class Stretches(NamedTuple):
    """Block means of some sensors, with the noise they stand in.

    Attributes:
        means: `(sensor, stretch, block)`, each stretch preceded by the one before; NaN before the first.
        noise, steps: Variances `r` and `q`, `(sensor,)`.
        block: Samples in one.
    """

    means: Array
    noise: Array
    steps: Array
    block: int

    @property
    def n_blocks(self) -> int:
        """Of the whole record."""
        return self.means.shape[1] * self.means.shape[2] // 2


def stretches(case: Case, sensors: tuple[int, ...]) -> Stretches:
    """Block means of sensors of the recording."""
    length = case.n_samples // N_JUDGED
    n = min(_MOST_BLOCKS, length)
    block = length // n
    x = case.recording[list(sensors), : length * N_JUDGED].unflatten(-1, (N_JUDGED, length))
    own = x[..., : n * block].unflatten(-1, (n, block)).mean(-1).numpy()
    before = np.concatenate([np.full_like(own[:, :1], np.nan), own[:, :-1]], axis=1)
    near, far = (_variogram(case.base, block, lag)[list(sensors)] for lag in (1, _FAR))
    steps = np.maximum((far - near) / (_FAR - 1), 1e-9 * near)
    differences = np.median(np.abs(np.diff(own, axis=-1)), axis=(1, 2)) / _MAD
    noise = np.maximum((differences**2 - steps) / 2, 0.05 * near)
    return Stretches(np.concatenate([before, own], axis=-1), noise, steps, block)


def _variogram(base: Base, block: int, lag: int) -> Array:
    """Mean square difference of block means `lag` blocks apart, `(sensor,)`, from the spectrum."""
    low = np.geomspace(1e-3 / base.n_samples, 0.05 / (block * lag), 200)
    f = np.concatenate([low, np.arange(0.05 / (block * lag), 0.5, 0.05 / (block * lag))[1:]])
    seen = (np.sin(np.pi * f * block) / (block * np.sin(np.pi * f))) ** 2 * 4 * np.sin(np.pi * f * block * lag) ** 2
    density = base.spectrum(torch.from_numpy(f)).numpy()
    return 2 * np.asarray(np.trapezoid(density * seen, f))


def gaussian_scores(data: Stretches, sd: Array, tau: Array) -> Array:
    """Log likelihood of an Ornstein-Uhlenbeck process, `(sensor, trial, stretch)`.

    Args:
        data: Block means.
        sd: Of the process, `(sensor, trial)`; 0 for none.
        tau: Its time constant, blocks.
    """
    y, r, q = data.means[:, None], data.noise[:, None, None], data.steps[:, None, None]
    shape = (*sd.shape, y.shape[2])
    phi, variance = np.exp(-1 / tau[..., None]), sd[..., None] ** 2
    own, level = np.zeros(shape), np.broadcast_to(np.nanmean(y, axis=-1), shape).copy()
    p_own = np.broadcast_to(variance, shape).copy()
    p_level = np.broadcast_to(_LARGEST * (r + variance), shape).copy()
    p_both, total = np.zeros(shape), np.zeros(shape)
    for k in range(y.shape[-1]):
        value = y[..., k]
        own, p_own, p_both = phi * own, phi**2 * p_own + (1 - phi**2) * variance, phi * p_both
        p_level = p_level + q
        seen = np.isfinite(value)
        value = np.where(seen, value, 0.0)
        g_own, g_level = p_own + p_both, p_level + p_both
        s = g_own + g_level + np.where(seen, r, 1e12 * r)
        e = value - own - level
        if k >= y.shape[-1] // 2:
            total -= 0.5 * (e**2 / s + np.log(s))
        own, level = own + g_own * e / s, level + g_level * e / s
        p_own, p_level, p_both = p_own - g_own**2 / s, p_level - g_level**2 / s, p_both - g_own * g_level / s
    return total


class Best(NamedTuple):
    """Maximum of a likelihood.

    Attributes:
        theta: Logarithms of the parameters, `(sensor, parameter)`.
        value: Log likelihood, `(sensor,)`.
        covariance: Of `theta`, from the curvature, `(sensor, parameter, parameter)`.
    """

    theta: Array
    value: Array
    covariance: Array


def best_gaussian(data: Stretches, stretch: Tensor) -> Best:
    """Sd and time constant of the largest likelihood on the stretches `([sensor,] stretch)` that may be used."""
    chosen = _columns(stretch)

    def score(theta: Array) -> Array:
        sd, tau = np.exp(np.moveaxis(theta, -1, 0))
        return np.asarray((gaussian_scores(data, sd, tau) * chosen).sum(-1))

    return _climbed(score, _grid(data), (0.5, 0.3, 0.15, 0.1))


def _columns(stretch: Tensor) -> Array:
    """Weights of the scores `(sensor, trial, stretch)`."""
    return np.asarray(stretch.reshape(-1, 1, stretch.shape[-1]).numpy(), dtype=float)


def _grid(data: Stretches) -> Array:
    """Trials `(sensor, trial, parameter)`: sizes by factors of 2, times by factors of 2."""
    sizes = 0.1 * 2.0 ** np.arange(8)
    n_times = max(int(math.log2(data.n_blocks / 12 / 3)), 2)
    times = 3 * 2.0 ** np.arange(n_times)
    trials = np.array(list(itertools.product(sizes, times)))
    grid = np.log(trials)[None].repeat(len(data.noise), axis=0)
    grid[..., 0] += np.log(np.sqrt(data.noise))[:, None]
    return grid


def _climbed(score: object, grid: Array, steps: tuple[float, ...]) -> Best:
    """From the best of a grid by stencils of shrinking width, to the vertex of the last one's parabola."""
    assert callable(score)
    values = score(grid)
    rows = np.arange(len(grid))
    theta = grid[rows, values.argmax(-1)]
    stencil = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=grid.shape[-1])))
    design = _quadratic(stencil)
    n = grid.shape[-1]
    covariance = np.zeros((len(grid), n, n))
    value = values.max(-1)
    for step in steps:
        values = score(theta[:, None] + step * stencil)
        fit = np.linalg.lstsq(design, values.T, rcond=None)[0]  # (coefficient, sensor)
        moved = np.empty_like(theta)
        for i in range(len(grid)):
            slope, curvature = fit[1 : 1 + n, i], _curvature(fit[1 + n :, i], n)
            eigen, axes = np.linalg.eigh(-curvature)
            eigen = np.maximum(eigen, 1e-3)
            moved[i] = np.clip(axes @ ((axes.T @ slope) / eigen), -1.5, 1.5)
            covariance[i] = step**2 * axes @ np.diag(1 / eigen) @ axes.T
        best = values.argmax(-1)
        vertex = theta + step * moved
        at_vertex = score(vertex[:, None])[:, 0]
        better = at_vertex > values[rows, best]
        theta = np.where(better[:, None], vertex, theta + step * stencil[best])
        value = np.where(better, at_vertex, values[rows, best])
    return Best(theta, value, covariance)


def _quadratic(x: Array) -> Array:
    pairs = itertools.combinations_with_replacement(range(x.shape[1]), 2)
    columns = [np.ones(len(x)), *x.T, *(x[:, i] * x[:, j] for i, j in pairs)]
    return np.stack(columns, axis=1)


def _curvature(coefficients: Array, n: int) -> Array:
    matrix = np.zeros((n, n))
    for value, (i, j) in zip(coefficients, itertools.combinations_with_replacement(range(n), 2), strict=True):
        matrix[i, j] += value
        matrix[j, i] += value
    return matrix
