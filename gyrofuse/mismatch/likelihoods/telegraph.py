"""Likelihood of a level that jumps between two values, in the coloured noise of a simulation.

Block means of a sensor are

    y_k = a (s_k-1 + s_k) / 2 + sum_j x_jk + N(0, r),   s_k = +-1 with mean dwells `up` and `down`,

`s` the level at the end of a block, which switches anywhere in it, and `x` AR1s and a random walk that together have
the simulation's spectrum. Given the path `s` all is Gaussian, and the gains of Kalman's filter are the same for every
path. The likeliest paths are followed, each with the mean of `x` that belongs to it; after every block those that are
too many are drawn such that the likelihood stays unbiased. Filters that merge paths into one for each state forget how
background and level depend on each other, and with it most of what distinguishes two levels from a Gaussian process.

References:
    Fearnhead and Clifford, On-line inference for hidden Markov models via particle filters, JRSS B 65 (2003), 887.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from gyrofuse._base.nnls import nonnegative_least_squares
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum

Array = NDArray[np.float64]

_LARGEST = 1e4  # variance of the level at the start over that of the noise: a diffuse prior, without loss of digits


class Spacing(NamedTuple):
    """Runs of block means that follow each other, and what lies between the runs.

    Attributes:
        run: Blocks in a run.
        gap: From the last block of a run to the first of the next one, blocks; 1 where they follow each other, too.
    """

    run: int = 1
    gap: float = 1.0

    def before(self, k: int) -> float:
        """From the block before to block `k`, blocks."""
        return self.gap if k and k % self.run == 0 else 1.0


CLOSE = Spacing()  # blocks that all follow each other


class Background(NamedTuple):
    """Noise of one sensor's block means: white noise, AR1s, a random walk.

    Attributes:
        white: Variance `r`.
        phi: Coefficients of the AR1s, and 1 of the walk, `(part,)`.
        steps: Variances of their steps, `(part,)`.
        start: Variances at the start, `(part,)`.
    """

    white: float
    phi: Array
    steps: Array
    start: Array

    def steps_over(self, blocks: float) -> Array:
        """Variances of the steps over some blocks, `(part,)`."""
        rest = 1 - self.phi**2
        grown = np.where(rest > 0, (1 - self.phi ** (2 * blocks)) / np.where(rest > 0, rest, 1.0), blocks)
        return np.asarray(self.steps * grown)


def backgrounds(base: NoiseSpectrum, block: int, n_shaped: int = 4) -> list[Background]:
    """Background of each sensor: non-negative least squares of AR1s to the spectrum of block means.

    Args:
        base: Noise spectrum of samples.
        block: Samples of a block.
        n_shaped: Number of AR1s, of time constants from 1.5 blocks to 0.15 of the record, beside which a walk stands
            for longer ones.
    """
    n = base.n_samples // block
    f = np.geomspace(0.5 / n, 0.5, 120)  # cycles per block
    constants = np.geomspace(1.5, max(0.15 * n, 3.0), n_shaped)
    phi = np.exp(-1 / constants)
    shaped = (1 - phi[:, None] ** 2) / (1 - 2 * phi[:, None] * np.cos(2 * np.pi * f) + phi[:, None] ** 2)
    atoms = np.concatenate([np.ones((1, len(f))), shaped, 1 / (4 * np.sin(np.pi * f) ** 2)[None]])
    found = []
    for row in _density_of_means(base, f, block):
        relative = torch.from_numpy(atoms / row)
        white, *variances, walk = nonnegative_least_squares(relative @ relative.mT, relative.sum(-1)).tolist()
        variance = np.array(variances)
        steps = np.append(variance * (1 - phi**2), walk)
        # Differences of successive means say nothing of a noise that has no white part.
        white = max(float(white), 1e-6 * float(row.min()))
        start = np.append(variance, _LARGEST * (white + variance.sum()))
        found.append(Background(white, np.append(phi, 1.0), steps, start))
    return found


def _density_of_means(base: NoiseSpectrum, f: Array, block: int) -> Array:
    """Densities `(sensor, frequency)` of block means at `f` cycles per block, with what is folded down."""
    unfolded = (f[:, None] + np.arange(-(block // 2), block - block // 2)) / block  # cycles per sample
    passed = (np.sin(np.pi * unfolded * block) / (block * np.sin(np.pi * unfolded))) ** 2 / block
    folded = torch.from_numpy(np.abs((unfolded + 0.5) % 1 - 0.5).ravel())
    return np.asarray((base.spectrum(folded).numpy().reshape(-1, *unfolded.shape) * passed).sum(-1))


def _starting_level(y: Array) -> float:
    """Mean of the first block means, about which the level at the start is diffuse."""
    return float(y[:50].mean())


def gaussian_values(y: Array, background: Background, sd: Array, tau: Array, spacing: Spacing = CLOSE) -> Array:
    """Log likelihoods of an Ornstein-Uhlenbeck process in the background, `(trial, block)`, by Kalman's filter.

    Args:
        y: Block means, `(block,)`.
        background: Noise beside it.
        sd: Standard deviation of the process, `(trial,)`; 0 for none.
        tau: Time constant of it, blocks.
        spacing: Where the block means lie.
    """
    n_trials, parts = len(sd), len(background.phi) + 1

    def over(blocks: float) -> tuple[Array, Array, Array]:
        """Coefficients `(trial, part)`, their products, and variances of steps over some blocks."""
        own = np.exp(-blocks / tau)
        phi = np.column_stack([np.tile(background.phi**blocks, (n_trials, 1)), own])
        steps = np.column_stack([np.tile(background.steps_over(blocks), (n_trials, 1)), sd**2 * (1 - own**2)])
        return phi, phi[:, :, None] * phi[:, None], steps

    moves = {blocks: over(blocks) for blocks in {1.0, spacing.gap}}
    diagonal = np.arange(parts)
    p = np.zeros((n_trials, parts, parts))
    p[:, diagonal, diagonal] = np.column_stack([np.tile(background.start, (n_trials, 1)), sd**2])
    mean = np.zeros((n_trials, parts))
    mean[:, -2] = _starting_level(y)
    values = np.empty((n_trials, len(y)))
    for k, value in enumerate(y):
        phi, both, steps = moves[spacing.before(k)]
        mean, p = phi * mean, both * p
        p[:, diagonal, diagonal] += steps
        shared = p.sum(-1)
        s = shared.sum(-1) + background.white
        e = value - mean.sum(-1)
        values[:, k] = -(e**2 / s + np.log(s)) / 2
        gain = shared / s[:, None]
        mean = mean + gain * e[:, None]
        p = p - gain[:, :, None] * shared[:, None]
    return values


def switching_values(
    y: Array, background: Background, half: Array, up: Array, down: Array, n_paths: int, spacing: Spacing = CLOSE
) -> Array:
    """Log likelihoods of two levels in the background, `(trial, block)`.

    Args:
        y: Block means, `(block,)`.
        background: Noise beside them.
        half: Half the distance of the levels, `(trial,)`.
        up: Mean dwell in the upper one, blocks, `(trial,)`.
        down: Mean dwell in the lower one, likewise.
        n_paths: Number of paths that are followed.
        spacing: Where the block means lie.
    """
    gains, s = _filter(background, len(y), spacing)
    uniform = np.random.default_rng(0).random(len(y))  # the same for all trials, so that their values compare
    n_trials, n_parts = len(half), len(background.phi)
    # From one block's end to the next one's: who goes and comes back in between has not moved.
    rate = 1 / up + 1 / down

    def switched(blocks: float) -> tuple[Array, Array]:
        """Probabilities `(trial, 1)` of another level some blocks later, of the upper and of the lower one."""
        share = -np.expm1(-rate * blocks) / rate
        return (share / up)[:, None], (share / down)[:, None]

    leave, enter = switched(1.0)
    phi = {blocks: background.phi**blocks for blocks in {1.0, spacing.gap}}
    upper = np.tile([False, True], (n_trials, 1))
    weight = np.concatenate([leave, enter], 1) / (leave + enter)
    mean = np.zeros((n_trials, 2, n_parts))
    mean[..., -1] = _starting_level(y)
    values = np.empty((n_trials, len(y)))
    for k, value in enumerate(y):
        if (blocks := spacing.before(k)) > 1:  # the level may have moved where nobody looked
            out, back = switched(blocks - 1)
            unseen = weight * np.where(upper, out, back)
            weight, upper = np.concatenate([weight - unseen, unseen], 1), np.concatenate([upper, ~upper], 1)
            mean = np.concatenate([mean, mean], 1)
        n_before = upper.shape[1]
        mean = mean * phi[blocks]
        e = value - mean.sum(-1)
        level = np.where(upper, half[:, None], -half[:, None])
        moved = weight * np.where(upper, leave, enter)
        # Paths that stay, and those that move: half way on average, and anywhere between the levels.
        wider = np.concatenate([np.ones_like(e), np.broadcast_to(1 + half[:, None] ** 2 / (3 * s[k]), e.shape)], 1)
        left = np.concatenate([e - level, e], 1) / wider
        log_l = left**2 * wider * (-0.5 / s[k]) - np.log(wider) / 2
        largest = log_l.max(1, keepdims=True)
        weight = np.concatenate([weight - moved, moved], 1) * np.exp(log_l - largest)
        total = weight.sum(1, keepdims=True)
        values[:, k] = (largest + np.log(total * s[k] ** -0.5))[:, 0]
        weight /= total
        upper = np.concatenate([upper, ~upper], 1)
        kept = np.arange(upper.size).reshape(upper.shape)
        if 2 * n_before > n_paths:
            kept, weight = _thinned(weight, n_paths, float(uniform[k]))
        upper, left = upper.ravel()[kept], left.ravel()[kept]
        parent = kept % (2 * n_before) % n_before + n_before * np.arange(n_trials)[:, None]
        mean = mean.reshape(-1, n_parts)[parent] + gains[k] * left[..., None]
    return values


def _filter(background: Background, n: int, spacing: Spacing = CLOSE) -> tuple[Array, Array]:
    """Gains `(block, part)` of Kalman's filter and variances of its errors, `(block,)`: the same for all paths."""
    gains, variances = np.empty((n, len(background.phi))), np.empty(n)
    p, both = np.diag(background.start), background.phi[:, None] * background.phi
    moves = {blocks: (both**blocks, np.diag(background.steps_over(blocks))) for blocks in {1.0, spacing.gap}}
    for k in range(n):
        kept, step = moves[spacing.before(k)]
        p = kept * p + step
        shared = p.sum(-1)
        variances[k] = shared.sum() + background.white
        gains[k] = shared / variances[k]
        p = p - gains[k][:, None] * shared
    return gains, variances


def _thinned(weight: Array, n_paths: int, uniform: float) -> tuple[NDArray[np.intp], Array]:
    """Positions of the paths that are kept among all `(trial, path)`, and their weights, `(trial, path)`.

    Weights above a threshold stay as they are; of the others as many as there is room for are drawn in proportion to
    their weights, evenly, and get the threshold (Fearnhead and Clifford, section 5).

    Args:
        weight: Weights of the paths, `(trial, path)`.
        n_paths: Number of paths to keep.
        uniform: Random number from 0 to 1, the start of the even draw.
    """
    rounding = 1e-6  # of a path, by which sums of weights may be off
    safe, n_safe = np.zeros(weight.shape, bool), np.zeros((len(weight), 1), int)
    while True:
        # Where all paths that are kept are above it, it is what the others have together: none of them is.
        limit = np.where(safe, 0.0, weight).sum(1, keepdims=True) / np.maximum(n_paths - n_safe, 1) + 1e-300
        safe = weight > limit
        now = safe.sum(1, keepdims=True)
        if (now == n_safe).all():
            break
        n_safe = now
    room = n_paths - n_safe
    drawn = np.minimum(np.where(safe, 0.0, weight / limit).cumsum(1), room - rounding)
    drawn[:, -1:] = room - rounding
    drawn = np.floor(drawn + (uniform * (1 - 2 * rounding) + rounding))
    taken = safe | (np.diff(drawn, axis=1, prepend=0.0) > 0)
    # Where fewer have any weight at all, some without make up the number.
    missing = n_paths - taken.sum(1, keepdims=True)
    taken |= ~taken & ((~taken).cumsum(1) <= missing)
    kept = np.flatnonzero(taken).reshape(len(weight), n_paths)
    return kept, np.maximum(weight, limit).ravel()[kept]
