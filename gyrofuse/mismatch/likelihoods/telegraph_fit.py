"""The best two levels, and the best Gaussian process in their place, of sensors whose spectra have a Lorentzian more.

A telegraph and an Ornstein-Uhlenbeck process of the same variance and time constant have the same spectrum. Spectra
show whether there is one of them, and how long the blocks have to be; likelihoods of block means (`telegraph`) which.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.telegraph import (
    Array,
    Background,
    Spacing,
    backgrounds,
    gaussian_values,
    switching_values,
)
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold
from gyrofuse.noise.processes import AR1

_SEARCHING, _FINAL = 48, 192  # paths that are followed: of each trial, and of the values that are compared
_FEWEST_BLOCKS = 2.0  # blocks in a time constant, at least: longer ones average the levels away
_STENCIL = (0.15, 0.35)  # half widths of a stencil in log half step and log dwells, halved where likelihoods are steep
_NEAR = 3.0  # nats below the largest value, over which a likelihood is a parabola


class Excess(NamedTuple):
    """Lorentzians that the simulation's spectra lack.

    Attributes:
        gain: Log likelihood ratio, nats, `(sensor,)`.
        sd: Standard deviation of the process, `(sensor,)`.
        tau: Time constant of it, samples, `(sensor,)`.
    """

    gain: Tensor
    sd: Tensor
    tau: Tensor


class Numbers(NamedTuple):
    """Half step in the unit of the signal, mean dwells in samples."""

    half: float
    up: float
    down: float


class Means(NamedTuple):
    """Block means of one sensor.

    Attributes:
        y: Block means, `(block,)`.
        background: Noise in which two levels would stand.
        plain: Log likelihood of that alone, `(judged,)`.
        block: Samples in one.
        spacing: Where they lie.
    """

    y: Array
    background: Background
    plain: Array
    block: int
    spacing: Spacing

    @classmethod
    def of(cls, comparison: Comparison, sensor: int, tau: float) -> Means | None:
        """Means over 2.5 blocks in a time constant in samples; `None` where a sample is too long for that.

        Of the judged parts of a long record the beginnings, as many blocks as there may be.
        """
        block = 2 ** max(math.floor(math.log2(tau / 2.5)), 0)
        if tau < _FEWEST_BLOCKS * block:
            return None
        part, most = comparison.n_samples // N_JUDGED, 2048  # samples; blocks in all
        run = min(part // block, most // N_JUDGED)
        apart = part if part // block > run else run * block
        spacing = Spacing(run, 1 + apart / block - run)

        def means_of(signal: Tensor) -> Tensor:
            """Block means `(..., block)` of a signal `(..., time)`."""
            parts = signal[..., : N_JUDGED * apart].unflatten(-1, (N_JUDGED, apart))
            return parts[..., : run * block].unflatten(-1, (run, block)).mean(-1).flatten(-2)

        y = _beside_channels(comparison, means_of(comparison.recording[sensor]), means_of).numpy()
        background = backgrounds(comparison.base, block)[sensor]
        return cls(y, background, _noise_alone(y, background, spacing), block, spacing)

    def switching(self, theta: Array, n_paths: int) -> Array:
        """Log likelihood ratios of two levels to the noise alone, `(trial, judged)`.

        Args:
            theta: Logarithms of half step and dwells in blocks, `(trial, 3)`.
            n_paths: Number of paths that are followed.
        """
        half, up, down = np.exp(theta.T)
        return _judged(switching_values(self.y, self.background, half, up, down, n_paths, self.spacing)) - self.plain

    def gaussian(self, theta: Array) -> Array:
        """Log likelihood ratios of a Gaussian process, likewise, of logarithms of sd and time constant in blocks."""
        sd, tau = np.exp(theta.T)
        return _judged(gaussian_values(self.y, self.background, sd, tau, self.spacing)) - self.plain

    def numbers(self, theta: Array) -> Numbers:
        """Half step and dwells from their logarithms."""
        half, up, down = np.exp(theta).tolist()
        return Numbers(half, up * self.block, down * self.block)


def _beside_channels(comparison: Comparison, means: Tensor, means_of: Callable[[Tensor], Tensor]) -> Tensor:
    """Block means `(block,)` without a line on those of the channels: a course that follows one is no jump."""
    most = 8  # rows
    rows = [v.to(torch.float64).reshape(-1, v.shape[-1]) for v in comparison.info.channels.values()]
    if not rows or sum(map(len, rows)) > most or min(v.shape[-1] for v in rows) < comparison.n_samples:
        return means
    courses = means_of(torch.cat(rows)[:, : comparison.n_samples])
    courses = courses - courses.mean(-1, keepdim=True)
    if not bool(courses.isfinite().all()):
        return means
    return means - courses.mT @ torch.linalg.lstsq(courses.mT, (means - means.mean())[:, None]).solution[:, 0]


class TwoLevels(NamedTuple):
    """Fit of one sensor.

    Attributes:
        means: Block means that it was fitted to.
        theta: Logarithms of half step and dwells in blocks: of all judged blocks, then without each fold,
            `(1 + fold, 3)`.
        values: Log likelihood ratios to the noise alone, `(1 + fold, judged)`.
        rival: Log likelihood ratios of the best Gaussian process, `(judged,)`.
        log_sd: Standard deviations of the first row of `theta`.
    """

    means: Means
    theta: Array
    values: Array
    rival: Array
    log_sd: tuple[float, ...]

    @property
    def over(self) -> float:
        """Log likelihood ratio to the rival."""
        return float(self._leads.sum())

    @property
    def lasts(self) -> bool:
        """Whether it is likelier than the rival without the two judged blocks that are most so."""
        return bool(self._leads[:-2].sum() > 0)

    @property
    def momentary(self) -> bool:
        """Whether the two judged blocks that are most for it have 8 nats: one event, not many."""
        return bool(self._leads[-2:].sum() > 8.0)

    @property
    def _leads(self) -> Array:
        """Log likelihood ratios to the rival in each judged block, sorted."""
        return np.sort(self.values[0] - self.rival)

    @property
    def resolved(self) -> bool:
        """Whether dwells are longer than blocks, and 16 of them in the record, or 6 where these are plain."""
        plain = 30.0  # nats
        fewest = 6.0 if self.over > plain else 16.0
        return bool(len(self.means.y) / np.exp(self.theta[0, 1:]).mean() >= fewest) and not self.fast

    @property
    def fast(self) -> bool:
        """Whether blocks are too long for it."""
        return self.tau < _FEWEST_BLOCKS * self.means.block

    @property
    def tau(self) -> float:
        """Time constant, samples."""
        return float(self.means.block / np.exp(-self.theta[0, 1:]).sum())

    @property
    def best(self) -> Numbers:
        """Estimates from all judged blocks."""
        return self.means.numbers(self.theta[0])

    def without(self, fold: int) -> Numbers:
        """Estimates without the blocks that a fold holds out."""
        return self.means.numbers(self.theta[1 + fold])


@derived
def excess(comparison: Comparison) -> Excess:
    """The most likely Lorentzian of each sensor, from powers in bands, of recording and simulation alike.

    Sizes by Fisher scoring, for 16 time constants from 4 samples to a 32nd of the record: longer ones have few
        switches.
    """
    bands, power = comparison.bands, comparison.observed.power
    d, s = bands.dof, comparison.reference.dof
    dof = d * s / (d + s).clamp(min=1e-9)
    ground = bands.mean_of(comparison.base.spectrum(bands.nodes))
    times = torch.logspace(math.log10(4.0), math.log10(comparison.n_samples / 32), 16, dtype=torch.float64)
    phi = (-1 / times).exp()[:, None]
    shape = bands.mean_of(AR1._spectrum(bands.nodes, phi, 1 - phi.square()))[:, None]  # (time, 1, band)
    model = ground.expand(len(times), -1, -1)
    for _ in range(20):
        weight = dof / model.square()
        size = (weight * shape * (power - ground)).sum(-1, keepdim=True)
        size = (size / (weight * shape.square()).sum(-1, keepdim=True)).clamp(min=0)
        model = ground + size * shape
    gain = (dof * (power / ground - power / model - (model / ground).log())).sum(-1)
    best, at = gain.max(0)
    return Excess(best, size[..., 0].gather(0, at[None])[0].sqrt(), times[at])


@derived
def two_levels(comparison: Comparison) -> dict[int, TwoLevels]:
    """Fits of the sensors that have such an excess of 6 nats, by their positions."""
    found = excess(comparison)
    fits = {}
    for i in (found.gain > 6.0).nonzero()[:, 0].tolist():
        fit = _in_fit_blocks(comparison, i, float(found.sd[i]), float(found.tau[i]))
        if fit is not None:
            fits[i] = fit
    return fits


def _in_fit_blocks(comparison: Comparison, sensor: int, sd: float, tau: float) -> TwoLevels | None:
    """Fit of one sensor, in shorter blocks where levels turn out to change faster than its spectrum had it."""
    found = _fitted(comparison, sensor, sd, tau)
    if found is None or not found.fast:
        return found
    return _fitted(comparison, sensor, sd, found.tau) or found


def scores(comparison: Comparison, sensor: int, numbers: Numbers) -> Array:
    """Log likelihood ratio to the noise alone of each judged block of a sensor, `(judged,)`.

    Args:
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        numbers: Half step and dwells.
    """
    fit = two_levels(comparison).get(sensor)
    means = fit.means if fit else Means.of(comparison, sensor, 1 / (1 / numbers.up + 1 / numbers.down))
    if means is None:
        return np.zeros(N_JUDGED)
    theta = np.log([numbers.half, numbers.up / means.block, numbers.down / means.block])
    if fit:
        known = np.abs(fit.theta - theta).max(-1) < 1e-9
        if known.any():
            return np.asarray(fit.values[known.argmax()])
    return np.asarray(means.switching(theta[None], _FINAL)[0])


def _fitted(comparison: Comparison, sensor: int, sd: float, tau: float) -> TwoLevels | None:
    """Fit of one sensor from the numbers of its Lorentzian; `None` where the rival is plainly likelier.

    That is 5 nats after the first trials, and none after a wide stencil around the best of them.
    """
    means = Means.of(comparison, sensor, tau)
    if means is None:
        return None
    start, rival = _best_gaussian(means, np.log([sd, tau / means.block]))
    # Noise of another shape, such as flicker, is no Lorentzian: a Gaussian process with the recording's own spectrum.
    own = backgrounds(comparison.observed.base, means.block, 8)[sensor]
    rival = max(rival, _noise_alone(means.y, own, means.spacing) - means.plain, key=np.sum)
    trials = np.concatenate([_first_trials(*np.exp(start)), _apart(means.y)])
    values = means.switching(trials, _SEARCHING)
    for (size, times), least in (((0.25, 0.6), -5.0), (_STENCIL, 0.0)):
        if values.sum(-1).max() < rival.sum() + least:
            return None
        trials, values = _with_stencil(means, trials, values, size, times)
    trials, values = _closer(means, trials, values)
    used = [np.ones(N_JUDGED), *((~in_fold(N_JUDGED, fold)).numpy().astype(float) for fold in range(N_FOLDS))]
    vertices, covariances = zip(*(vertex(trials, values @ weights) for weights in used), strict=True)
    theta = np.stack(vertices)
    log_sd = tuple(np.sqrt(covariances[0].diagonal()).tolist())
    return TwoLevels(means, theta, means.switching(theta, _FINAL), rival, log_sd)


def _with_stencil(means: Means, trials: Array, values: Array, size: float, times: float) -> tuple[Array, Array]:
    """Trials and values with those of a stencil around the best: centre, faces and corners of a box."""
    corners = list(itertools.product((-1.0, 1.0), repeat=3))
    faces = [tuple(sign * float(i == j) for j in range(3)) for i in range(3) for sign in (-1, 1)]
    more = trials[values.sum(-1).argmax()] + np.array([(0.0, 0.0, 0.0), *faces, *corners]) * [size, times, times]
    return np.concatenate([trials, more]), np.concatenate([values, means.switching(more, _SEARCHING)])


def _closer(means: Means, trials: Array, values: Array) -> tuple[Array, Array]:
    """With further stencils around the best until it stays and those beside it are near enough for a parabola.

    Of strong jumps the likelihood is a narrow peak, which the first stencils hardly meet.
    """
    size, times = _STENCIL
    for _ in range(16):
        last = values.sum(-1)[-15:]  # of the last stencil
        steep = last[0] - last[1:7].reshape(3, 2).max(-1) > 2 * _NEAR  # from the centre to the better of two faces
        moved = last.argmax() > 0 and last.max() > last[0] + _NEAR
        if not moved and not steep.any():
            break
        if not moved:
            size, times = (width / 2 if s else width for width, s in ((size, steep[0]), (times, steep[1:].any())))
        trials, values = _with_stencil(means, trials, values, size, times)
    return trials, values


def _best_gaussian(means: Means, start: Array) -> tuple[Array, Array]:
    """Logarithms of sd and time constant (blocks) of the rival, and the values of its judged blocks, by grid search."""
    theta, score = start, np.zeros(N_JUDGED)
    for width in (0.7, 0.35, 0.35, 0.15):
        grid = theta + width * np.array(list(itertools.product((-1.0, 0.0, 1.0), (-2.0, -1.0, 0.0, 1.0, 2.0))))
        values = means.gaussian(grid)
        best = values.sum(-1).argmax()
        theta, score = grid[best], values[best]
    return theta, score


def _first_trials(sd: float, tau: float) -> Array:
    """Half step and dwells of processes with that variance, and time constants about it, `(trial, 3)`."""
    shares = ((0.2, 0.7), (0.2, 1.5), (0.35, 1.0), (0.5, 0.7), (0.5, 1.5), (0.65, 1.0), (0.8, 0.7), (0.8, 1.5))
    rows = [(sd / (2 * math.sqrt(p * (1 - p))), c * tau / (1 - p), c * tau / p) for p, c in shares]
    return np.log(rows)


def _apart(y: Array) -> Array:
    """Half step and dwells of means `(block,)` that lie around two levels, `(1, 3)`, by 2-medians."""
    middle = (y.max() + y.min()) / 2
    for _ in range(10):
        middle = (np.median(y[y >= middle]) + np.median(y[y < middle])) / 2
    above = y >= middle
    half = (np.median(y[above]) - np.median(y[~above])) / 2
    runs = max(int(np.count_nonzero(np.diff(above))), 1) / 2
    return np.log([[half, above.sum() / runs, (~above).sum() / runs]])


def vertex(trials: Array, value: Array) -> tuple[Array, Array]:
    """Vertex of the parabola through values `(trial,)` near the largest one, and inverse of its curvature.

    Never farther from it than the wide stencil reaches: no trial supports a parabola there.
    """
    top = trials[value.argmax()]
    x = trials - top
    root = np.exp((value - value.max()) / (2 * _NEAR))[:, None]
    pairs = list(itertools.combinations_with_replacement(range(3), 2))
    design = np.column_stack([np.ones(len(x)), x, *(x[:, i] * x[:, j] for i, j in pairs)])
    fitted = np.linalg.lstsq(root * design, root[:, 0] * value, rcond=None)[0]
    curvature = np.zeros((3, 3))
    for c, (i, j) in zip(fitted[4:], pairs, strict=True):
        curvature[i, j] += c
        curvature[j, i] += c
    eigen, axes = np.linalg.eigh(-curvature)
    eigen = np.maximum(eigen, 0.05)  # flatter, limits would be wider than a factor of 6000
    step = axes @ ((axes.T @ fitted[1:4]) / eigen)
    return top + np.clip(step, [-0.25, -0.6, -0.6], [0.25, 0.6, 0.6]), axes @ np.diag(1 / eigen) @ axes.T


def _noise_alone(y: Array, background: Background, spacing: Spacing) -> Array:
    """Log likelihoods of the background alone, `(judged,)`."""
    return _judged(gaussian_values(y, background, np.zeros(1), np.ones(1), spacing))[0]


def _judged(values: Array) -> Array:
    """Sums over judged blocks, `(trial, block)` -> `(trial, judged)`."""
    return np.asarray(values.reshape(len(values), N_JUDGED, -1).sum(-1))
