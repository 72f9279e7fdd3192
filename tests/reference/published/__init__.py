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


@functools.cache
def series() -> Array:
    """4096 samples of white noise, AR(1), random walk and a sinusoid."""
    drive, memory, a = g(2, 4096), np.empty(4096), 0.0
    for t, e in enumerate(drive):
        memory[t] = a = 0.95 * a + 0.2 * e
    t = np.arange(1, 4097)
    return g(1, 4096) + memory + 0.02 * np.cumsum(g(3, 4096)) + 0.5 * np.sin(0.35 * t + 1)


@functools.cache
def array() -> Array:
    """4096 samples of four sensors: white noise, random walks of their own and one of all (sensor, time)."""
    common = 0.03 * np.cumsum(g(30, 4096))
    sizes = zip([1, 1.5, 0.8, 2], [0.02, 0.01, 0.04, 0.005], strict=True)
    return np.stack([s * g(10 + i, 4096) + q * np.cumsum(g(20 + i, 4096)) + common for i, (s, q) in enumerate(sizes)])
