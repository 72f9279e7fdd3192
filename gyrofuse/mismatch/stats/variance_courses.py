"""A level of noise that changes bit by bit: one course up and down again, as far and as fast as the data ask for.

With `log v_i(t) = a_i + b_i c(t)` and a course `c` that all sensors share and that rises to one peak and falls from it,
either of which may be missing, scoring with means over blocks turns the likelihood `-(log v + e^2/v)/2` of squared
samples into least squares under an order, whose solution is exact. Where nothing changes such a course gains
`(1/2 + 1/3 + .. + 1/m)/2` nats on average for each order of `m` blocks, whatever its form.

References:
    Robertson, Wright and Dykstra, Order Restricted Statistical Inference, 1988: pool adjacent violators, section 1.2.
"""

from __future__ import annotations

import itertools
import math
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from scipy import fft
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.stats.segments import CHI2_MEDIAN, OUTLIER, course_scores

_STEEPEST = 3.0  # log variance, step of scoring: a start that is off by a factor of 20 still converges


class Course(NamedTuple):
    """A level that goes another way once.

    Attributes:
        share: Course from its lower end, 0, to its peak, 1, `(time,)`.
        base: Variance where the share is 0, `(sensor,)`.
        factor: Ratio of the variance at the peak to that, `(sensor,)`; 1 where a sensor does not change.
        log_factor_sd: Standard deviation of its logarithm, `(sensor,)`.
    """

    share: Tensor
    base: Tensor
    factor: Tensor
    log_factor_sd: Tensor

    @property
    def variance(self) -> Tensor:
        """Variance of each sample, `(sensor, time)`."""
        return self.base[:, None] * self.factor[:, None] ** self.share

    @property
    def alike(self) -> Course:
        """The course with one factor for all the sensors that change."""
        log_factor, concerned = self.factor.log(), self.factor != 1
        one = torch.where(concerned, log_factor[concerned].mean(), 0.0)
        return self._replace(base=self.base * ((log_factor - one) * self.share.mean()).exp(), factor=one.exp())


def course_score(white: Tensor, course: Course, weight: Tensor, episodes: int = 0) -> float:
    """Log likelihood ratio of a course to a steady level less Schwarz' price of its numbers and changes, nats.

    A number for each sensor that changes, or one for all of them; the starts and stops of episodes, or what a course
    gains by chance from an order on either side of any of its blocks.

    Args:
        white: Whitened recording, `(sensor, time)`.
        course: Course of the level.
        weight: Weight of a sample where levels vary by themselves, `(sensor,)`.
        episodes: Number of episodes that it consists of, where it changes at once.
    """
    n, each = white.shape[-1], int((course.factor != 1).sum())
    scores = (
        float(weight @ course_scores(white, one.variance).sum(-1)) - numbers / 2 * math.log(n)
        for one, numbers in ((course, each), (course.alike, 1))
    )
    return max(scores) - 2 * (episodes * math.log(n) if episodes else math.log(_n_blocks(n)))


def course_at_once(white: Tensor, inside: Tensor, concerned: Tensor) -> Course:
    """The course of episodes `(time,)` that some of the sensors `(sensor,)` have."""
    share = inside.to(white.dtype)
    base, log_factor, sd = fitted_levels(white.square(), share, concerned)
    return Course(share, base.exp(), log_factor.exp(), sd)


def course_of(white: Tensor, log_factor: Tensor) -> Course | None:
    """The likeliest course of whitened samples `(sensor, time)`, `None` where it does not change.

    Args:
        white: Whitened recording.
        log_factor: Logarithm of the change of each sensor, to begin with and up to a factor of all, `(sensor,)`; 0
            where it does not change.
    """
    size = log_factor.abs().max()
    if not float(size) > 0:
        return None
    found = [_likeliest(white, slope) for slope in (log_factor / size, -log_factor / size)]
    return max(
        (course for course in found if course is not None),
        key=lambda course: float(course_scores(white, course.variance).sum()),
        default=None,
    )


def waves_of(white: Tensor, log_factor: Tensor, weight: Tensor) -> tuple[Course, float] | None:
    """The likeliest course of up to eight waves, and its score as `course_score` has it; as `course_of`.

    Half waves are those of a cosine transform; each costs half the logarithm of the number of samples.
    """
    size, m, price = log_factor.abs().max(), _n_blocks(white.shape[-1]), math.log(white.shape[-1]) / 2
    found = list[tuple[Course, float]]()
    for half_waves in (4, 8, 16) if float(size) > 0 else ():
        if 2 * half_waves > m:
            break
        course = _likeliest(white, log_factor / size, half_waves)
        if course is not None:
            found.append((course, course_score(white, course, weight) + 2 * math.log(m) - half_waves * price))
    return max(found, key=lambda one: one[1], default=None)


def _likeliest(white: Tensor, slope: Tensor, half_waves: int = 0) -> Course | None:
    """The likeliest course to a peak at which each sensor is louder by so much, `(sensor,)`, up to a factor.

    Or the likeliest one of so many half waves.
    """
    ordered = partial(_smoothed, half_waves=half_waves) if half_waves else _unimodal
    squares, n = white.square(), white.shape[-1]
    size, concerned = n // _n_blocks(n), slope != 0
    blocks = squares[:, : n // size * size].unflatten(-1, (-1, size))
    level = (blocks.median(-1).values / CHI2_MEDIAN).clamp(min=1e-12).log()
    stairs = ordered((slope @ (level - level.mean(-1, keepdim=True)) / slope.square().sum()).numpy())
    rounds = 6
    course = None
    for number in range(rounds):
        if stairs.max() == stairs.min():
            return None
        pooled = stairs
        if number and not half_waves:  # where the change is known
            pooled = _without_end_spikes(stairs, size / 2 * float(slope.square().sum()))
        beyond = np.array([stairs.max() - pooled.max(), pooled.min() - stairs.min()]) / (pooled.max() - pooled.min())
        stairs = pooled
        stairs = (stairs - stairs.min()) / (stairs.max() - stairs.min())
        c = torch.from_numpy(stairs)
        at, values = (np.arange(len(stairs)) + 0.5, stairs) if half_waves else _knots(stairs)
        share = torch.from_numpy(np.interp(np.arange(n) + 0.5, size * np.array(at), values))
        base, slope, sd = fitted_levels(squares, share, concerned)
        # The course's own range is known from its highest and its lowest level alone, all sensors together; where it
        # ends between the pooled level and the spike is as likely anywhere.
        blocks_at = [len(c) / half_waves] * 2 if half_waves else [float((c == end).sum()) for end in (0.0, 1.0)]
        ends = 2 * sum(1 / (size * k) for k in blocks_at) / slope.square().sum().clamp(min=1e-12)
        sd = (sd.square() + slope.square() * (ends + float((beyond**2).sum()) / 12)).sqrt()
        course = Course(share, base.exp(), slope.exp(), sd)
        if number < rounds - 1:
            variance = (base[:, None] + slope[:, None] * c).exp()[..., None]
            excess = ((blocks / variance).clamp(max=OUTLIER) - 1).mean(-1)
            step = (slope @ excess / slope.square().sum().clamp(min=1e-12)).clamp(-_STEEPEST, _STEEPEST)
            stairs = ordered((c + step / slope.abs().max().clamp(min=1.0)).numpy())
    return course


def _without_end_spikes(stairs: np.ndarray, information: float) -> np.ndarray:
    """Stairs `(block,)` whose highest and lowest level are not those of a few blocks by chance.

    The extreme levels of an ordered fit are too extreme (Robertson et al., 1988, section 1.6). Each is pooled with the
    next one as long as that costs less than two numbers gain by chance.

    Args:
        stairs: Ordered fit.
        information: Of a block on its level, nats^-1 doubled.
    """
    for sign in (1, -1):
        while True:
            edges = [0, *(np.flatnonzero(np.diff(stairs)) + 1).tolist(), len(stairs)]
            if len(edges) < 4:
                break
            k = int(np.argmax(sign * stairs[edges[:-1]]))
            beside = [j for j in (k - 1, k + 1) if 0 <= j < len(edges) - 1]
            other = max(beside, key=lambda j: sign * stairs[edges[j]])
            low, high = min(k, other), max(k, other)
            n, m = edges[k + 1] - edges[k], edges[other + 1] - edges[other]
            apart = stairs[edges[k]] - stairs[edges[other]]
            if information / 2 * n * m / (n + m) * apart**2 > 2 * NATS_PER_NUMBER:
                break
            stairs = stairs.copy()
            stairs[edges[low] : edges[high + 1]] = (n * stairs[edges[k]] + m * stairs[edges[other]]) / (n + m)
    return stairs


def fitted_levels(squares: Tensor, share: Tensor, concerned: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Log variances where a course is 0, their change to where it is 1, and sds of the change, `(sensor,)` each.

    Fisher scoring; a sample has the information one half of a log variance.

    Args:
        squares: Squares of whitened samples, `(sensor, time)`.
        share: Course, `(time,)`.
        concerned: Sensors that change, `(sensor,)`.
    """
    design = torch.stack([torch.ones_like(share), share])
    inverse = torch.linalg.inv(design @ design.mT / 2)
    base = (squares.median(-1).values / CHI2_MEDIAN).clamp(min=1e-300).log()
    change = torch.zeros_like(base)
    for _ in range(12):  # linear convergence behind the cut of outliers
        variance = (base[:, None] + change[:, None] * share).exp()
        score = ((squares / variance).clamp(max=OUTLIER) - 1) / 2 @ design.mT
        steps = (inverse @ score.mT).clamp(-_STEEPEST, _STEEPEST)
        base, change = base + steps[0], torch.where(concerned, change + steps[1], 0.0)
    return base, change, inverse[1, 1].sqrt().expand(len(squares))


def levels_above(squares: Tensor, share: Tensor, concerned: Tensor, steady: Tensor) -> tuple[Tensor, Tensor]:
    """Log variances above one that is `steady` `(sensor,)` where a course is 0, and their change; as `fitted_levels`.

    Of variances `steady + exp(base + change c)`, beginning without what is steady.
    """
    base, change, _ = fitted_levels(squares, share, concerned)
    ends = torch.stack([base, base + change]).exp()
    low, high = (ends - steady).maximum(0.1 * ends).log()
    base, change = low, high - low
    c = torch.stack([torch.ones_like(share), share])
    for _ in range(25):
        own = (base[:, None] + change[:, None] * share).exp()
        variance = own + steady[:, None]
        score = ((squares / variance).clamp(max=OUTLIER) - 1) / 2 * own / variance @ c.mT
        information = torch.einsum("at,bt,st->sab", c, c, (own / variance).square()) / 2
        steps = torch.linalg.solve(information, score).clamp(-_STEEPEST, _STEEPEST)
        base, change = base + steps[:, 0], torch.where(concerned, change + steps[:, 1], 0.0)
    return base, change


def _n_blocks(n: int) -> int:
    """Number of blocks of a course of `n` samples: 128, of 16 samples at least, and two at least."""
    return max(min(128, n // 16), 2)


def _unimodal(values: np.ndarray) -> np.ndarray:
    """The nearest sequence to `(block,)` that rises to a peak and falls from it, by least squares."""

    ends = range(len(values) + 1)
    fits = (np.concatenate([_isotonic(values[:k]), _isotonic(values[k:][::-1])[::-1]]) for k in ends)
    return min(fits, key=lambda fit: float(((fit - values) ** 2).sum()))


def _smoothed(values: np.ndarray, half_waves: int) -> np.ndarray:
    """A sequence `(block,)` with the first terms of its cosine transform alone."""
    terms = fft.dct(values, norm="ortho")
    terms[half_waves + 1 :] = 0.0
    return np.asarray(fft.idct(terms, norm="ortho"))


def _isotonic(values: np.ndarray) -> np.ndarray:
    """The nearest sequence that does not fall, by least squares: adjacent violators are pooled."""
    means: list[float] = []
    counts: list[int] = []
    for value in values.tolist():
        mean, count = value, 1
        while means and means[-1] >= mean:
            n = counts.pop()
            mean, count = (mean * count + means.pop() * n) / (count + n), count + n
        means.append(mean)
        counts.append(count)
    return np.repeat(means, counts)


def _knots(stairs: np.ndarray) -> tuple[list[float], list[float]]:
    """Knots in blocks and values of a line through stairs `(block,)`: flat where a stair is longer than the next."""
    edges = [0, *(np.flatnonzero(np.diff(stairs)) + 1).tolist(), len(stairs)]
    lengths = [b - a for a, b in itertools.pairwise(edges)]
    at, values = [0.0], [float(stairs[0])]
    for edge, before, after in zip(edges[1:-1], lengths[:-1], lengths[1:], strict=True):
        reach = min(before, after) / 2
        at += [edge - reach, edge + reach]
        values += [float(stairs[edge - 1]), float(stairs[edge])]
    return [*at, float(len(stairs))], [*values, float(stairs[-1])]
