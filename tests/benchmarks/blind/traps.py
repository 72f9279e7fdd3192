"""A charge trap: random telegraph noise, and the oracle that knows its rates but not its path."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from .likelihood import solve

Array = NDArray[np.float64]
ORDER = 4  # of the autoregression that stands for the noise of block means
MAX_BLOCKS = 2048
FINE = 8  # steps of a simulated path in a block


def telegraph(n: int, up: float, down: float, rng: np.random.Generator) -> Array:
    """States 0 and 1 over `n` steps; mean dwells `up` in state 1 and `down` in state 0, in steps."""
    first = int(rng.uniform() < up / (up + down))
    states = (np.arange(int(4 * n / (up + down)) + 60) + first) % 2
    edges = np.cumsum(rng.exponential(np.where(states == 1, up, down)))
    return states[np.searchsorted(edges, np.arange(n), side="right")].astype(float)


class TrapOracle:
    """Likelihood of a trap of known dwells in Gaussian noise, by the forward algorithm on block means.

    The noise of the block means is an autoregression of order `ORDER` with the right first autocovariances, so the
    chain remembers `ORDER + 1` states. A switch inside a block is put to its edge (blocks are a twelfth of a dwell).
    """

    def __init__(self, spectrum: Array, n: int, up: float, down: float) -> None:
        self.block = max(1, int(min(up, down) / 12), -(-n // MAX_BLOCKS))
        self.blocks = n // self.block
        f = np.arange(1, n) / (2 * n)
        mean_gain = (np.sin(np.pi * f * self.block) / (self.block * np.sin(np.pi * f))) ** 2
        lags = np.arange(ORDER + 1) * self.block
        r = np.array([np.sum(spectrum * mean_gain * np.cos(2 * np.pi * f * lag)) / n for lag in lags])
        self.prediction = solve_toeplitz(r[:-1], r[1:])
        self.innovation = float(r[0] - self.prediction @ r[1:])
        leave = 1 - math.exp(-self.block * (1 / up + 1 / down))
        to_up, to_down = leave * up / (up + down), leave * down / (up + down)
        self.transition = np.array([[1 - to_up, to_up], [to_down, 1 - to_down]])
        self.up_share = up / (up + down)
        self.up, self.down = up, down

    def block_means(self, signal: Array) -> Array:
        """(..., time) to (..., block)."""
        kept = signal[..., : self.blocks * self.block]
        return kept.reshape(*signal.shape[:-1], self.blocks, self.block).mean(axis=-1)

    def _whiten(self, values: Array) -> Array:
        return lfilter(np.concatenate([[1.0], -self.prediction]), [1.0], values, axis=-1)[..., ORDER:]

    def llr(self, means: Array, step: Array | float) -> Array:
        """Log likelihood ratio of (replication, block) against the noise alone; the states lie at +-`step`/2.

        `step` may differ between the replications.
        """
        residual = self._whiten(means) / math.sqrt(self.innovation)  # (replication, block)
        bits = (np.arange(2 ** (ORDER + 1))[:, None] >> np.arange(ORDER, -1, -1)) & 1  # newest state first
        unit = (bits - 0.5) @ np.concatenate([[1.0], -self.prediction]) / math.sqrt(self.innovation)
        level = np.broadcast_to(step, len(means))[:, None] * unit  # (replication, state)
        share = np.where(bits == 1, self.up_share, 1 - self.up_share)[:, -1]  # the oldest, then the chain forwards
        for k in range(ORDER, 0, -1):
            share = share * self.transition[bits[:, k], bits[:, k - 1]]
        count = len(means)
        exponent = level * (residual.T[:, :, None] - level / 2)  # (block, replication, state)
        top = exponent.max(axis=2, keepdims=True)
        # no path is quite impossible, lest steps much too large leave none
        likelihood = np.exp(np.maximum(exponent - top, -300.0)).reshape(len(exponent), count, 2, 2, -1)
        forward = self.transition.T[None, :, :, None]  # (-, s_t, s_{t-1}, -)
        weight = np.broadcast_to(share, (count, len(share))).reshape(count, 2, 2, -1) * likelihood[0]
        scales = np.empty((len(exponent), count))
        for t in range(len(exponent)):
            if t:
                paths = weight.reshape(count, 1, 2, -1, 2).sum(axis=-1)  # (replication, -, s_{t-1}, older)
                weight = paths * forward * likelihood[t]
            scales[t] = weight.sum(axis=(1, 2, 3))
            weight = weight / scales[t][:, None, None, None]
        return np.log(scales).sum(axis=0) + top[:, :, 0].sum(axis=0)

    def step_for(self, nats: float, unit: float, quiet: Array, rng: np.random.Generator) -> float:
        """Step at which the trap tells itself from noise as well as a Gaussian effect of so many nats.

        The ratio is not quite that of the laws, since the noise is not quite an autoregression, so that its mean says
        nothing. How far it moves does: `(E1 - E0)^2 / (2 Var0)`, which is the divergence where the ratio is normal.

        Args:
            nats: Asked for.
            unit: Steps are looked for between 1e-3 and 20 of it.
            quiet: Block means of noise alone, (replication, block); paths are drawn for each, the same for all steps.
            rng: Of the paths.
        """
        up, down = FINE * self.up / self.block, FINE * self.down / self.block
        fine = np.stack([telegraph(FINE * self.blocks, up, down, rng) for _ in quiet])
        paths = fine.reshape(len(quiet), self.blocks, FINE).mean(axis=-1) - 0.5

        def told(step: float) -> float:
            ratio = self.llr(np.concatenate([quiet, quiet + step * paths]), step)
            without, with_trap = ratio[: len(quiet)], ratio[len(quiet) :]
            return float((with_trap.mean() - without.mean()) ** 2 / (2 * without.var(ddof=1)))

        return solve(nats, told, 1e-3 * unit, 20 * unit, tolerance=1e-2)
