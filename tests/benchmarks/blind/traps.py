"""A charge trap: random telegraph noise, its spectrum, and what tells it from Gaussian noise of that spectrum."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from .analog import Base
from .likelihood import ar1_spectrum

Array = NDArray[np.float64]
BLOCKS = 6  # in the shorter dwell: the finest of what is told
PATHS = 200
RECORDS = 24
VAGUE = 1e4  # variance of the level at the start, in those of a block mean


class Trap(NamedTuple):
    """Mean dwells in the upper and in the lower state, in steps."""

    up: float
    down: float

    @property
    def variance(self) -> float:
        """Of states 0 and 1."""
        return self.up * self.down / (self.up + self.down) ** 2

    @property
    def rate(self) -> float:
        """Of forgetting, per step."""
        return 1 / self.up + 1 / self.down

    def spectrum(self, f: Array) -> Array:
        """Of states 0 and 1, per step: an AR1's."""
        return ar1_spectrum(f, math.exp(-self.rate), self.variance * -math.expm1(-2 * self.rate))

    def path(self, n: int, rng: np.random.Generator) -> Array:
        """States 0 and 1 over `n` steps."""
        first = int(rng.uniform() < self.up / (self.up + self.down))
        states = (np.arange(int(4 * n / (self.up + self.down)) + 60) + first) % 2
        edges = np.cumsum(rng.exponential(np.where(states == 1, self.up, self.down)))
        return states[np.searchsorted(edges, np.arange(n), side="right")].astype(float)


class Noise(NamedTuple):
    """Gaussian noise of block means: `white` variance, and relaxators of `phi`, `kicks` and `start` variances.

    A `phi` of one is a random walk.
    """

    white: float
    phi: Array
    kicks: Array
    start: Array

    @classmethod
    def of(cls, base: Base, sensor: int, block: int) -> Noise:
        """Of means over `block` samples, which relaxators hardly move within."""
        white = float(base.white[sensor]) / block
        stationary = base.variance[sensor] / (1 - base.phi[sensor] ** 2)
        phi = base.phi[sensor] ** block
        kicks = np.append(stationary * (1 - phi**2), block * base.walk[sensor])
        return cls(white, np.append(phi, 1.0), kicks, np.append(stationary, VAGUE * white))

    def beside(self, phi: float, variance: float) -> Noise:
        """With one more relaxator."""
        return Noise(
            self.white,
            np.append(self.phi, phi),
            np.append(self.kicks, variance * (1 - phi**2)),
            np.append(self.start, variance),
        )

    def records(self, count: int, n: int, rng: np.random.Generator) -> Array:
        """(record, block)."""
        total = math.sqrt(self.white) * rng.standard_normal((count, n))
        for phi, kick, start in zip(self.phi, self.kicks, self.start, strict=True):
            steps = math.sqrt(kick) * rng.standard_normal((count, n))
            steps[:, 0] += phi * math.sqrt(start) * rng.standard_normal(count)
            total += lfilter([1.0], [1.0, -phi], steps, axis=-1)
        return total

    def filter(self, n: int) -> Iterator[tuple[Array, float]]:
        """Gain and variance of the innovation of Kalman's filter, block after block: no data change them."""
        p = np.diag(self.start)
        for _ in range(n):
            p = self.phi[:, None] * p * self.phi + np.diag(self.kicks)
            variance = float(p.sum()) + self.white
            gain = p.sum(axis=1) / variance
            p = p - np.outer(gain, gain) * variance
            yield gain, variance

    def log_likelihood(self, y: Array) -> Array:
        """Of records (record, block): (record,)."""
        mean, total = np.zeros((len(y), len(self.phi))), np.zeros(len(y))
        for value, (gain, variance) in zip(y.T, self.filter(y.shape[1]), strict=True):
            mean *= self.phi
            error = value - mean.sum(axis=1)
            total -= (error**2 / variance + math.log(2 * math.pi * variance)) / 2
            mean += error[:, None] * gain
        return total


def log_likelihood(
    y: Array, noise: Noise, trap: Trap, step: float, rng: np.random.Generator, *, paths: int = PATHS
) -> Array:
    """Of a trap of known dwells (in blocks) and step in noise, of records (record, block): (record,).

    Once the states are known all is Gaussian. So many of their paths are followed, drawn anew by weight where there
    are more: an unbiased likelihood, and an exact one as long as there are not.
    """
    rows = np.arange(len(y))[:, None]
    share = np.array([trap.down, trap.up]) / (trap.up + trap.down)
    moves = -math.expm1(-trap.rate) * share[::-1]  # out of either state
    state = np.tile([0, 1], (len(y), 1))
    weight = np.tile(share, (len(y), 1))
    mean, total = np.zeros((*state.shape, len(noise.phi))), np.zeros(len(y))
    for value, (gain, variance) in zip(y.T, noise.filter(y.shape[1]), strict=True):
        mean *= noise.phi
        leave = moves[state]
        left = np.tile(value[:, None] - mean.sum(axis=-1), 2)
        parent = np.tile(np.arange(state.shape[1]), (len(y), 2))
        weight = np.concatenate([weight * (1 - leave), weight * leave], axis=1)
        state = np.concatenate([state, 1 - state], axis=1)
        error = left - step * (state - 0.5)
        exponent = -(error**2) / (2 * variance)
        top = exponent.max(axis=1, keepdims=True)
        weight = weight * np.exp(exponent - top)
        size = weight.sum(axis=1, keepdims=True)
        total += (top + np.log(size))[:, 0] - math.log(2 * math.pi * variance) / 2
        weight /= size
        if state.shape[1] > paths:
            kept = _drawn(weight, paths, rng)
            state, parent, error = state[rows, kept], parent[rows, kept], error[rows, kept]
            weight = np.full(state.shape, 1 / paths)
        mean = mean[rows, parent] + error[..., None] * gain
    return total


def _drawn(weight: Array, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Systematic draws (record, draw) in proportion to weights (record, path)."""
    at = (np.arange(count) + rng.uniform(size=(len(weight), 1))) / count
    ends = weight.cumsum(axis=1)
    ends[:, -1] = 1.0
    return np.stack([np.searchsorted(row, places) for row, places in zip(ends, at, strict=True)])


def beyond_its_twin(base: Base, sensor: int, n: int, trap: Trap, step: float, rng: np.random.Generator) -> float:
    """Divergence, nats, of a trap in a sensor's noise from Gaussian noise of the same spectrum, by simulation."""
    block = max(1, int(min(trap.up, trap.down) / BLOCKS))
    blocks = n // block
    coarse = Trap(trap.up / block, trap.down / block)
    noise = Noise.of(base, sensor, block)
    twin = noise.beside(math.exp(-coarse.rate), step**2 * coarse.variance)
    records = noise.records(RECORDS, blocks, rng)
    records += step * (np.stack([coarse.path(blocks, rng) for _ in records]) - 0.5)
    told = log_likelihood(records, noise, coarse, step, rng) - twin.log_likelihood(records)
    return float(told.mean())
