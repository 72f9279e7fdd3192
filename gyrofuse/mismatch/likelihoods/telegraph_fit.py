"""The best two levels, and the best Gaussian process in their place, of sensors whose spectra have a Lorentzian more.

A telegraph and an Ornstein-Uhlenbeck process of the same variance and time constant have the same spectrum. Spectra
tell whether there is one of them, and how long the blocks have to be; likelihoods of block means tell which.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.telegraph import Array, Background, backgrounds, gaussian_values, switching_values
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, in_fold
from gyrofuse.noise.processes import AR1

_TIMES = 16
_LONGEST = 1 / 32  # time constants, share of the record: longer, there are too few switches
_SHORTEST = 4.0  # samples
_SCORING = 20
_SHAPED = 8  # AR1s of the rival with the recording's spectrum
_LOUD = 6.0  # nats of a Lorentzian, for two levels to be tried
_SEARCHING, _JUDGING = 48, 192  # paths that are followed
_BLOCKS = (2.0, 2.5)  # in a time constant: no fewer, and enough
_MOST_BLOCKS = 2048  # in the record
_HOPELESS = (-5.0, 0.0)  # nats over the rival after each look
_WIDTHS = ((0.25, 0.6), (0.15, 0.35))  # of stencils: size, times
_SPLITS = 10  # rounds
_LOOKS, _POINTS = 16, 15  # further ones at most, and trials of each
_NEAR = 3.0  # nats, over which values count for the parabola
_SAME = 1e-9
_MOMENTS, _EVENT = 2, 8.0  # judged blocks, and nats in them
_FEWEST_SWITCHES = 16.0
_LEAST = 0.05  # curvature of a parabola


class Excess(NamedTuple):
    """Lorentzians that the simulation's spectra lack.

    Attributes:
        gain: Nats, for records as long as they are, `(sensor,)`.
        sd: Of the process, `(sensor,)`.
        tau: Its time constant, samples, `(sensor,)`.
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
        y: They, `(block,)`.
        background: Noise that they stand in.
        plain: Log likelihood of it alone, `(judged,)`.
        block: Samples in one.
    """

    y: Array
    background: Background
    plain: Array
    block: int

    def switching(self, theta: Array, n_paths: int) -> Array:
        """Log likelihoods over the noise alone `(trial, judged)` of logarithms of half steps and dwells in blocks."""
        half, up, down = np.exp(theta.T)
        return _judged(switching_values(self.y, self.background, half, up, down, n_paths)) - self.plain

    def gaussian(self, theta: Array) -> Array:
        """The same of logarithms of sd and time constant in blocks."""
        sd, tau = np.exp(theta.T)
        return _judged(gaussian_values(self.y, self.background, sd, tau)) - self.plain

    def numbers(self, theta: Array) -> Numbers:
        """From logarithms."""
        half, up, down = np.exp(theta).tolist()
        return Numbers(half, up * self.block, down * self.block)


class TwoLevels(NamedTuple):
    """Fit of one sensor.

    Attributes:
        means: What it was fitted to.
        theta: Logarithms of half step and dwells (blocks): of all judged blocks, then without each
            fold, `(1 + fold, 3)`.
        values: Log likelihoods over the noise alone, `(1 + fold, judged)`.
        rival: The same of the best Gaussian process, `(judged,)`.
        log_sd: Standard deviations of the first row of `theta`.
    """

    means: Means
    theta: Array
    values: Array
    rival: Array
    log_sd: tuple[float, ...]

    @property
    def over(self) -> float:
        """Log likelihood over the rival."""
        return float(self.values[0].sum() - self.rival.sum())

    @property
    def lasts(self) -> bool:
        """Whether it is over the rival for more than a moment."""
        return bool(self._leads[:-_MOMENTS].sum() > 0)

    @property
    def momentary(self) -> bool:
        """Whether a moment has more of it than chance would give one."""
        return bool(self._leads[-_MOMENTS:].sum() > _EVENT)

    @property
    def _leads(self) -> Array:
        """Over the rival in each judged block, sorted."""
        return np.sort(self.values[0] - self.rival)

    @property
    def resolved(self) -> bool:
        """Whether dwells are between blocks and a few steps."""
        slow = len(self.means.y) / np.exp(self.theta[0, 1:]).mean() < _FEWEST_SWITCHES
        return not slow and not self.fast

    @property
    def fast(self) -> bool:
        """Whether blocks are too long for it."""
        return self.tau < _BLOCKS[0] * self.means.block

    @property
    def tau(self) -> float:
        """Time constant, samples."""
        return float(self.means.block / np.exp(-self.theta[0, 1:]).sum())

    @property
    def best(self) -> Numbers:
        return self.means.numbers(self.theta[0])

    def without(self, fold: int) -> Numbers:
        """Estimated without what a fold holds out."""
        return self.means.numbers(self.theta[1 + fold])


@derived
def excess(comparison: Comparison) -> Excess:
    """The most likely Lorentzian of each sensor, from powers in bands, of recording and simulation alike."""
    bands = comparison.bands
    d, s = bands.dof, comparison.reference.dof
    worth = d * s / (d + s).clamp(min=1e-9)
    ground = bands.mean_of(comparison.base.spectrum(bands.nodes))
    times = torch.logspace(
        math.log10(_SHORTEST), math.log10(comparison.n_samples * _LONGEST), _TIMES, dtype=torch.float64
    )
    phi = (-1 / times).exp()[:, None]
    shape = bands.mean_of(AR1._spectrum(bands.nodes, phi, 1 - phi.square()))[:, None]  # (time, 1, band)
    power = comparison.observed.power
    size = torch.zeros(_TIMES, comparison.n_sensors, 1, dtype=torch.float64)
    for _ in range(_SCORING):
        model = ground + size * shape
        weight = worth / model.square()
        size = (weight * shape * (power - ground)).sum(-1, keepdim=True) / (weight * shape.square()).sum(
            -1, keepdim=True
        )
        size = size.clamp(min=0)
    model = ground + size * shape
    gain = (worth * (power / ground - power / model - (model / ground).log())).sum(-1)
    best, at = gain.max(0)
    return Excess(best, size[..., 0].gather(0, at[None])[0].sqrt(), times[at])


@derived
def two_levels(comparison: Comparison) -> dict[int, TwoLevels]:
    """Fits of the sensors that have such an excess, by their places."""
    found = excess(comparison)
    loud = [i for i in range(comparison.n_sensors) if float(found.gain[i]) > _LOUD]
    fits = (_in_fit_blocks(comparison, i, float(found.sd[i]), float(found.tau[i])) for i in loud)
    return {i: fit for i, fit in zip(loud, fits, strict=True) if fit is not None}


def _in_fit_blocks(comparison: Comparison, sensor: int, sd: float, tau: float) -> TwoLevels | None:
    """Of one sensor, in shorter blocks where levels turn out to change faster than its spectrum had it."""
    found = _fitted(comparison, sensor, sd, tau)
    if found is None or not found.fast:
        return found
    return _fitted(comparison, sensor, sd, found.tau) or found


def scores(comparison: Comparison, sensor: int, numbers: Numbers) -> Array:
    """Log likelihood over the noise alone of each judged block of a sensor, `(judged,)`."""
    fit = two_levels(comparison).get(sensor)
    means = fit.means if fit else _means(comparison, sensor, 1 / (1 / numbers.up + 1 / numbers.down))
    if means is None:
        return np.zeros(N_JUDGED)
    theta = np.log([numbers.half, numbers.up / means.block, numbers.down / means.block])
    if fit:
        known = np.abs(fit.theta - theta).max(-1) < _SAME
        if known.any():
            return np.asarray(fit.values[known.argmax()])
    return np.asarray(means.switching(theta[None], _JUDGING)[0])


def _means(comparison: Comparison, sensor: int, tau: float) -> Means | None:
    """Block means for a time constant in samples; None where they would be too many."""
    enough = 2 ** max(math.floor(math.log2(tau / _BLOCKS[1])), 0)
    block = max(enough, comparison.n_samples // _MOST_BLOCKS)
    if tau < _BLOCKS[0] * block:
        return None
    per_judged = comparison.n_samples // N_JUDGED // block
    y = comparison.recording[sensor, : N_JUDGED * per_judged * block].unflatten(-1, (-1, block)).mean(-1).numpy()
    background = backgrounds(comparison.base, block)[sensor]
    return Means(y, background, _judged(gaussian_values(y, background, np.zeros(1), np.ones(1)))[0], block)


def _fitted(comparison: Comparison, sensor: int, sd: float, tau: float) -> TwoLevels | None:
    """Of one sensor, from the numbers of its Lorentzian; None where there is no hope."""
    means = _means(comparison, sensor, tau)
    if means is None:
        return None
    start, rival = _best_gaussian(means, np.log([sd, tau / means.block]))
    # Noise of another shape, such as flicker, is no Lorentzian: a Gaussian process with the recording's own spectrum.
    own = backgrounds(comparison.observed.base, means.block, _SHAPED)[sensor]
    shaped = _judged(gaussian_values(means.y, own, np.zeros(1), np.ones(1)))[0] - means.plain
    rival = max(rival, shaped, key=np.sum)
    trials = np.concatenate([_first_trials(*np.exp(start)), _apart(means.y)])
    values = means.switching(trials, _SEARCHING)
    for widths, least in zip(_WIDTHS, _HOPELESS, strict=True):
        total = values.sum(-1)
        if total.max() < rival.sum() + least:
            return None
        more = trials[total.argmax()] + _stencil(*widths)
        trials, values = np.concatenate([trials, more]), np.concatenate([values, means.switching(more, _SEARCHING)])
    trials, values = _closer(means, trials, values)
    used = [np.ones(N_JUDGED), *((~in_fold(N_JUDGED, fold)).numpy().astype(float) for fold in range(N_FOLDS))]
    vertices, covariances = zip(*(vertex(trials, values @ weights) for weights in used), strict=True)
    theta = np.stack(vertices)
    log_sd = tuple(np.sqrt(covariances[0].diagonal()).tolist())
    return TwoLevels(means, theta, means.switching(theta, _JUDGING), rival, log_sd)


def _closer(means: Means, trials: Array, values: Array) -> tuple[Array, Array]:
    """With further trials around the best until it stays and those beside it are near enough for a parabola.

    Of strong jumps the likelihood is a narrow peak, which the first look hardly meets.
    """
    size, times = _WIDTHS[-1]
    for _ in range(_LOOKS):
        total = values.sum(-1)
        last = total[-_POINTS:]
        here, beside = last[0], last[1:7].reshape(3, 2).max(-1)  # of the last centre, and of the better of two faces
        moved = last.argmax() > 0 and last.max() > here + _NEAR
        steep = here - beside > 2 * _NEAR
        if not moved and not steep.any():
            break
        if not moved:
            size, times = (width / 2 if s else width for width, s in ((size, steep[0]), (times, steep[1:].any())))
        more = trials[total.argmax()] + _stencil(size, times)
        trials, values = np.concatenate([trials, more]), np.concatenate([values, means.switching(more, _SEARCHING)])
    return trials, values


def _best_gaussian(means: Means, start: Array) -> tuple[Array, Array]:
    """Logarithms of sd and time constant (blocks) of the rival, and the values of its judged blocks."""
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
    """Half step and dwells of means `(block,)` that lie around two levels, `(1, 3)`: of loud jumps what is plain."""
    middle = (y.max() + y.min()) / 2
    for _ in range(_SPLITS):
        middle = (np.median(y[y >= middle]) + np.median(y[y < middle])) / 2
    above = y >= middle
    half = (np.median(y[above]) - np.median(y[~above])) / 2
    runs = max(int(np.count_nonzero(np.diff(above))), 1) / 2
    return np.log([[half, above.sum() / runs, (~above).sum() / runs]])


def _stencil(size: float, times: float) -> Array:
    """Centre, faces and corners of a box, `(trial, 3)`."""
    corners = list(itertools.product((-1.0, 1.0), repeat=3))
    faces = [tuple(sign * float(i == j) for j in range(3)) for i in range(3) for sign in (-1, 1)]
    return np.array([(0.0, 0.0, 0.0), *faces, *corners]) * [size, times, times]


def vertex(trials: Array, value: Array) -> tuple[Array, Array]:
    """Vertex of the parabola through values `(trial,)` near the largest one, and inverse of its curvature.

    Never farther than the trials reach: beyond, a parabola tells nothing.
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
    eigen = np.maximum(eigen, _LEAST)
    step = axes @ ((axes.T @ fitted[1:4]) / eigen)
    reach = np.array([_WIDTHS[0][0], _WIDTHS[0][1], _WIDTHS[0][1]])
    return top + np.clip(step, -reach, reach), axes @ np.diag(1 / eigen) @ axes.T


def _judged(values: Array) -> Array:
    """Sums over judged blocks, `(trial, block)` -> `(trial, judged)`."""
    return np.asarray(values.reshape(len(values), N_JUDGED, -1).sum(-1))
