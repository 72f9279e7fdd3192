"""Parametric bootstrap: draws of the moments of the last levels from a model of the noise.

The combined covariance `A = sum_j omega_j Gamma_j` of a record `X` of block means is the quadratic form `X Q X'` with a
kernel `Q` over time that large scales make smooth: a few dozen directions in time carry it. In these the components
`Theta_k` of a pilot model have small matrices `K_k`. Both components are diagonal in one basis of the sensors, so that
resamples of `A`, joint over levels and sensors and of the exact finite-sample law, take one Cholesky factor of the size
of the directions for each sensor.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.linalg import oriented_eigh
from gyrofuse.wavelets.covariance import wavelet_products
from gyrofuse.wavelets.lag_sums import block_mean_covariances
from gyrofuse.wavelets.pilot import Pilot, components_of_memories


def resample_combined(
    pilot: Pilot, scale_weights: Tensor, n_samples: int, n_resamples: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Resamples of `A`, of the levels that the pilot was fitted to.

    Every item of a batch gets the same draws, so that it does not matter what it is batched with.

    Args:
        pilot: A model fitted to the arrays, batch `(item,)`.
        scale_weights: `(level,)`; scale weights of levels that the pilot was not fitted to do not matter.
        n_samples: Length of each resampled record.
        n_resamples: Number of resamples.
        generator: Source of randomness, on the CPU.

    Returns:
        `(item, resample, sensor, sensor)` and their expectation `(item, sensor, sensor)`, signal^2.
    """
    omega = tuple(scale_weights[pilot.first_level :].tolist())
    n_sensors = pilot.theta.shape[-1]
    found = _directions(n_samples, pilot.first_level, omega, pilot.time_constants)
    most = max(directions.within.shape[-1] for directions in found)  # the same draws whatever the memory
    normal = torch.randn(n_sensors, n_resamples, most, generator=generator, dtype=pilot.theta.dtype)
    normal = normal.to(pilot.theta.device)
    resamples = pilot.theta.new_empty(len(pilot.theta), n_resamples, n_sensors, n_sensors)
    expected = pilot.theta.new_empty(len(pilot.theta), n_sensors, n_sensors)
    for memory in pilot.memory.unique().tolist():
        # One item after the other: its draws fit the cache.
        for item in (pilot.memory == memory).nonzero():
            resamples[item], expected[item] = _draw(found[memory], pilot.theta[item], normal)
    return resamples, expected


def _draw(directions: _Directions, theta: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    within = torch.from_numpy(directions.within).to(theta)  # K_k: (component, direction, direction)
    total = torch.einsum("kaa->k", within)
    expected = torch.einsum("k,nkio->nio", total, theta)
    # In this basis of the sensors every component is diagonal, and the signals along it are independent.
    root = _root(expected)
    half = torch.linalg.solve_triangular(root, theta[:, 0], upper=False)
    share, turn = oriented_eigh(total[0] * torch.linalg.solve_triangular(root, half.mT, upper=False))
    basis = root @ turn
    share = torch.stack([share, 1 - share], -1).clamp(min=0)  # of each component: (item, sensor, component)
    joint = torch.einsum("nsk,kab->nsab", share, within / total[:, None, None])
    drawn = normal[..., : within.shape[-1]] @ _root(joint).mT  # (item, sensor, resample, direction)
    drawn = drawn.transpose(-3, -2).contiguous()
    products = basis[:, None] @ (drawn @ drawn.mT) @ basis[:, None].mT
    # The directions kept are scaled up to the variance of all directions.
    size = theta.diagonal(dim1=-2, dim2=-1).sum(-1)  # (item, component)
    kept, whole = (
        torch.einsum("nk,km,nm->n", size, torch.from_numpy(inner).to(size), size)
        for inner in (directions.kept, directions.whole)
    )
    moved = (whole / kept).sqrt()[:, None, None, None] * (products - expected[:, None])
    expected = expected + torch.einsum("k,nkio->nio", torch.from_numpy(directions.rest).to(theta), theta)
    return expected[:, None] + moved, expected


def _root(matrix: Tensor) -> Tensor:
    """Cholesky factor; a relative 1e-12 on the diagonal keeps directions of hardly any variance regular."""
    size = matrix.diagonal(dim1=-2, dim2=-1)
    return torch.linalg.cholesky(matrix + torch.diag_embed(1e-12 * size + 1e-14 * size.amax(-1, keepdim=True)))


class _Directions(NamedTuple):
    """Few directions in time, for one memory.

    Attributes:
        within: Matrices `K_k`, `(component, direction, direction)`.
        rest: Sum of the diagonals over the other directions, `(component,)`.
        kept: Inner products of the matrices, `(component, component)`.
        whole: The same with all directions.
    """

    within: np.ndarray
    rest: np.ndarray
    kept: np.ndarray
    whole: np.ndarray


@functools.lru_cache(maxsize=16)
def _directions(
    n_samples: int, first_level: int, omega: tuple[float, ...], time_constants: tuple[float, ...]
) -> list[_Directions]:
    """The directions that matter, by memory."""
    block = 2**first_level
    n_blocks = n_samples // block
    kernel = _kernel(n_blocks, omega)
    values, vectors = np.linalg.eigh(kernel)
    root = vectors * np.sqrt(values.clip(min=0))  # Q = root root'
    lag = np.abs(np.arange(n_blocks)[:, None] - np.arange(n_blocks))
    half = root - root.mean(0)  # the kernel does not see a constant: nor does rounding
    covariances = block_mean_covariances(block, n_blocks, time_constants)
    components = np.stack([half.T @ covariance[lag] @ half for covariance in covariances])
    return [_few(components[pair]) for pair in components_of_memories()]


def _few(within: np.ndarray, held_fraction: float = 0.5, fewest: int = 24) -> _Directions:
    """The directions that hold most of the variance of every component, of matrices `K_k` in all directions.

    Args:
        within: `(component, direction, direction)`.
        held_fraction: Fraction of the variance of each quadratic form that the directions hold at least; the rest is
            made up for by a factor.
        fewest: Number of directions at least, which give the law of the quadratic form its shape.
    """
    total = within.trace(axis1=1, axis2=2)
    # Each of them may turn out to be the largest.
    _, vectors = np.linalg.eigh((within / total[:, None, None]).sum(0))
    turned = vectors.T[::-1] @ within @ vectors[:, ::-1]
    # The variance of a quadratic form is that of its squared entries: as many directions as hold most of it.
    held = (turned**2).cumsum(1).cumsum(2).diagonal(axis1=1, axis2=2)  # (component, direction)
    n = max(int((held < held_fraction * held[:, -1:]).any(0).sum()) + 1, fewest)
    reduced = turned[:, :n, :n]
    kept, whole = (np.einsum("kab,mab->km", x, x) for x in (reduced, turned))
    return _Directions(reduced, total - reduced.trace(axis1=1, axis2=2), kept, whole)


def _kernel(n_blocks: int, omega: tuple[float, ...]) -> np.ndarray:
    """`Q = sum_j omega_j / N_j sum_n w_jn w_jn'` over the windows `n` of each level, in blocks."""
    kernel = np.zeros((n_blocks, n_blocks))
    for level, weight in enumerate(omega):
        half = 2**level
        if weight == 0 or n_blocks < 2 * half:
            continue
        window = np.zeros((n_blocks - 2 * half + 1, n_blocks))
        rows = np.arange(len(window))[:, None]
        window[rows, rows + np.arange(half)] = -1 / (2 * half)
        window[rows, rows + half + np.arange(half)] = 1 / (2 * half)
        kernel += weight / len(window) * window.T @ window
    return kernel


def resample_wccv(pilot: Pilot, first_level: int, n_resamples: int, generator: torch.Generator) -> Tensor:
    """Resamples of the wavelet cross-covariance of the last levels, joint over levels and sensors.

    Recordings are drawn as means over blocks of `2**first_level` samples, two of which make a window of the first
    level. Every item of a batch gets the same draws.

    Args:
        pilot: A model fitted to the arrays, batch `(item,)`.
        first_level: Lowest level to draw (counted from 0), at least the pilot's own.
        n_resamples: Number of resamples.
        generator: Source of randomness, on the CPU.

    Returns:
        `(item, resample, level, sensor, sensor)`, signal^2, levels from `first_level` on.
    """
    n_levels = pilot.n_levels - first_level
    roots = _block_roots(pilot.n_samples, first_level, pilot.time_constants)  # (component, block, block)
    n_items, n_components, n_sensors = pilot.theta.shape[:3]
    normal = torch.randn(
        n_components, n_resamples, n_sensors, roots.shape[-1], generator=generator, dtype=pilot.theta.dtype
    )
    resamples = pilot.theta.new_empty(n_items, n_resamples, n_levels, n_sensors, n_sensors)
    members = components_of_memories()
    for memory in pilot.memory.unique().tolist():
        root = roots[members[memory]].to(pilot.theta)
        paths = normal.to(pilot.theta) @ root.mT[:, None]  # unit noise: (component, resample, sensor, block)
        for item in (pilot.memory == memory).nonzero().flatten().tolist():
            values, vectors = oriented_eigh(pilot.theta[item])
            mix = vectors * values.clamp(min=0).sqrt()[:, None, :]  # (component, sensor, sensor)
            sums, counts = wavelet_products((mix[:, None] @ paths).sum(0), n_levels)
            resamples[item] = sums / counts
    return resamples


@functools.lru_cache(maxsize=8)
def _block_roots(n_samples: int, first_level: int, time_constants: tuple[float, ...]) -> Tensor:
    """Factors `R` `(component, block, block)`: `R z` is a record of block means up to a constant, `z` unit white noise.

    A random walk has no covariance, but its increments have; so have all others.
    """
    block = 2**first_level
    n_blocks = n_samples // block
    covariances = block_mean_covariances(block, n_blocks + 1, time_constants)
    mirrored = np.concatenate([covariances[:, 1:2], covariances], 1)  # lags -1, 0, 1, ...
    increments = 2 * mirrored[:, 1:-1] - mirrored[:, :-2] - mirrored[:, 2:]
    lag = np.abs(np.arange(n_blocks)[:, None] - np.arange(n_blocks))
    return _root(torch.from_numpy(increments[:, lag])).cumsum(-2)
