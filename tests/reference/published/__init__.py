"""Numbers that others published or that other software gave, each file with its source, and the inputs they belong to.

The inputs come from a 32-bit linear congruential generator, exact in float64, so that any language makes the same.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@functools.cache
def table(name: str) -> dict:
    """Contents of a file of this folder, without its ending."""
    return json.loads((Path(__file__).parent / f"{name}.json").read_text())


def g(seed: int, n: int) -> Array:
    """Uniform numbers of mean 0 and variance 1: s <- (1664525 s + 1013904223) mod 2^32, sqrt(12) (s / 2^32 - 0.5)."""
    states = []
    for _ in range(n):
        seed = (1664525 * seed + 1013904223) % 2**32
        states.append(seed)
    return np.sqrt(12.0) * (np.array(states) / 2**32 - 0.5)


def ar1(phi: float, drive: Array) -> Array:
    """The recursion `x <- phi x + e` from 0 over the last axis of the innovations."""
    out, x = np.empty_like(drive), np.zeros(drive.shape[:-1])
    for t in range(drive.shape[-1]):
        out[..., t] = x = phi * x + drive[..., t]
    return out


@functools.cache
def series() -> Array:
    """4096 samples of white noise, AR(1), random walk and a sinusoid."""
    tone = 0.5 * np.sin(0.35 * np.arange(1, 4097) + 1)
    return g(1, 4096) + ar1(0.95, 0.2 * g(2, 4096)) + 0.02 * np.cumsum(g(3, 4096)) + tone


@functools.cache
def array() -> Array:
    """4096 samples of four sensors: white noise, random walks of their own and one of all (sensor, time)."""
    common = 0.03 * np.cumsum(g(30, 4096))
    sizes = zip([1, 1.5, 0.8, 2], [0.02, 0.01, 0.04, 0.005], strict=True)
    return np.stack([s * g(10 + i, 4096) + q * np.cumsum(g(20 + i, 4096)) + common for i, (s, q) in enumerate(sizes)])


@functools.cache
def memories(n: int, n_samples: int) -> Array:
    """Series of AR(1) of memory 0.8 with innovations of variance 1 (n, n_samples)."""
    return ar1(0.8, np.stack([g(100 + i, n_samples) for i in range(n)]))
