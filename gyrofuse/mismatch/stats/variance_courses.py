"""A level of noise that changes bit by bit: one course up and down again, as far and as fast as the data ask for.

A squared sample of variance `v` has the log likelihood `-(log v + e^2/v)/2`. With `log v_i(t) = a_i + b_i c(t)` and a
course `c` that all sensors share and that rises to one peak and falls from it, either of which may be missing, scoring
with means over blocks turns it into least squares under an order, whose solution is exact (pool adjacent violators;
Robertson, Wright and Dykstra, Order Restricted Statistical Inference, 1988). What such a course gains where nothing
changes has the mean `(1/2 + 1/3 + .. + 1/m)/2` for each order of `m` blocks, whatever is left open of how it runs.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

_BLOCKS, _FEWEST = 128, 16  # of a record, and samples of a block
_ROUNDS = 6
_NEWTON = 12
_CUTS = 3
_CUT = 25.0  # squares in units of the level: an outlier is no change
_MEDIAN = 0.4549364231195724  # of chi2_1
_STEEPEST = 3.0  # of a step of scoring, log variance


class Course(NamedTuple):
    """A level that goes another way once.

    Attributes:
        share: Of the way from the lower end of the course to its peak, `(time,)`, from 0 to 1.
        base: Variance where the share is 0, `(sensor,)`.
        factor: Of the variance at the peak to that, `(sensor,)`; 1 where a sensor takes no part.
        log_factor_sd: Of its logarithm, `(sensor,)`.
    """

    share: Tensor
    base: Tensor
    factor: Tensor
    log_factor_sd: Tensor

    @property
    def variance(self) -> Tensor:
        """`(sensor, time)`."""
        return course_variance(self.share, self.base, self.factor)

    @property
    def alike(self) -> Course:
        """With one factor for all the sensors that take part."""
        log_factor, concerned = self.factor.log(), self.factor != 1
        one = torch.where(concerned, log_factor[concerned].mean(), 0.0)
        return self._replace(base=self.base * ((log_factor - one) * self.share.mean()).exp(), factor=one.exp())


def course_variance(share: Tensor, base: Tensor, factor: Tensor) -> Tensor:
    """`(sensor, time)`."""
    return base[:, None] * factor[:, None] ** share


def course_scores(white: Tensor, variance: Tensor) -> Tensor:
    """Log likelihood of a variance that is known but for its size against a steady one, `(sensor, time)`.

    Args:
        white: Whitened samples, `(sensor, time)`.
        variance: Of each, up to a factor of each sensor, likewise.
    """
    squares, size = white.square(), (white.square() / variance).median(-1, keepdim=True).values / _MEDIAN
    for _ in range(_CUTS):
        size = _cut(squares / variance, size).mean(-1, keepdim=True)
    variance = size * variance
    squares = _cut(squares, variance)
    one = squares.mean(-1, keepdim=True)
    return (squares / one - squares / variance - (variance / one).log()) / 2


def worth_of_course(white: Tensor, course: Course, weight: Tensor, episodes: int = 0) -> float:
    """Log likelihood ratio of a course over a steady level less what its numbers and places cost, nats.

    A number for each sensor, or for all of them one; the starts and stops of episodes, or what a course gains by chance
    that follows an order on either side of any of its blocks.

    Args:
        white: Whitened recording, `(sensor, time)`.
        course: It.
        weight: What a sample counts for, `(sensor,)`.
        episodes: How many it consists of, where it changes at once.
    """
    n, each = white.shape[-1], int((course.factor != 1).sum())
    worth = (
        float(weight @ course_scores(white, one.variance).sum(-1)) - numbers / 2 * math.log(n)
        for one, numbers in ((course, each), (course.alike, 1))
    )
    return max(worth) - 2 * (episodes * math.log(n) if episodes else math.log(_n_blocks(n)))


def course_at_once(white: Tensor, inside: Tensor, concerned: Tensor) -> Course:
    """The course of episodes `(time,)` that some of the sensors `(sensor,)` have."""
    share = inside.to(white.dtype)
    base, log_factor, sd = fitted_levels(white.square(), share, concerned)
    return Course(share, base.exp(), log_factor.exp(), sd)


def course_of(white: Tensor, log_factor: Tensor) -> Course | None:
    """The likeliest course of whitened samples `(sensor, time)`, `None` where it does not change.

    Args:
        white: Whitened recording.
        log_factor: By what each sensor changes, to begin with and up to a factor, `(sensor,)`; 0 where it does not.
    """
    size = log_factor.abs().max()
    if not float(size) > 0:
        return None
    found = [_with_peak(white, slope) for slope in (log_factor / size, -log_factor / size)]
    return max(
        (course for course in found if course is not None),
        key=lambda course: float(course_scores(white, course.variance).sum()),
        default=None,
    )


def _with_peak(white: Tensor, slope: Tensor) -> Course | None:
    """The likeliest course to a peak at which each sensor is louder by so much, `(sensor,)`, up to a factor."""
    squares, n = white.square(), white.shape[-1]
    size, concerned = n // _n_blocks(n), slope != 0
    blocks = squares[:, : n // size * size].unflatten(-1, (-1, size))
    level = (blocks.median(-1).values / _MEDIAN).clamp(min=1e-12).log()
    level = level - level.mean(-1, keepdim=True)
    stairs = _unimodal(slope @ level / slope.square().sum())
    course = None
    for number in range(_ROUNDS):
        if max(stairs) == min(stairs):
            return None
        c = (torch.tensor(stairs, dtype=white.dtype) - min(stairs)) / (max(stairs) - min(stairs))
        share = _samples_of(c, size, n)
        base, slope, sd = fitted_levels(squares, share, concerned)
        course = Course(share, base.exp(), slope.exp(), sd)
        if number < _ROUNDS - 1:
            variance = (base[:, None] + slope[:, None] * c).exp()[..., None]
            excess = (_cut(blocks, variance) / variance - 1).mean(-1)
            step = (slope @ excess / slope.square().sum().clamp(min=1e-12)).clamp(-_STEEPEST, _STEEPEST)
            stairs = _unimodal(c + step / slope.abs().max().clamp(min=1.0))
    return course


def fitted_levels(squares: Tensor, share: Tensor, concerned: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Log variances where a course is 0, what they are more where it is 1, and sds of the latter, `(sensor,)` each.

    Args:
        squares: Of whitened samples, `(sensor, time)`.
        share: The course, `(time,)`.
        concerned: Sensors that have it, `(sensor,)`.
    """
    design = torch.stack([torch.ones_like(share), share])
    # Information of one number of a log variance is half a sample.
    inverse = torch.linalg.inv(design @ design.mT / 2)
    numbers = torch.stack([squares.mean(-1).clamp(min=1e-300).log(), torch.zeros(len(squares), dtype=squares.dtype)])
    numbers[0] = (squares.median(-1).values / _MEDIAN).clamp(min=1e-300).log()
    for _ in range(_NEWTON):
        variance = (numbers.mT @ design).exp()
        score = (_cut(squares, variance) / variance - 1) / 2 @ design.mT
        numbers = numbers + (inverse @ score.mT).clamp(-_STEEPEST, _STEEPEST)
        numbers[1] = torch.where(concerned, numbers[1], 0.0)
    sd = inverse[1, 1].sqrt().expand(len(squares))
    return numbers[0], numbers[1], sd


def _cut(squares: Tensor, variance: Tensor) -> Tensor:
    return torch.minimum(squares, _CUT * variance)


def _n_blocks(n: int) -> int:
    return max(min(_BLOCKS, n // _FEWEST), 2)


def _unimodal(values: Tensor) -> list[float]:
    """The nearest sequence that rises to a peak and falls from it, by least squares."""
    y = values.tolist()
    rising, falling = _errors(y), _errors(y[::-1])[::-1]
    # The peak belongs to both: `k` values rise, the others fall.
    best = min(range(len(y) + 1), key=lambda k: rising[k] + falling[k])
    return [*_isotonic(y[:best]), *_isotonic(y[best:][::-1])[::-1]]


def _isotonic(y: list[float]) -> list[float]:
    """The nearest sequence that does not fall."""
    return [mean for mean, count in _pools(y)[0] for _ in range(count)]


def _errors(y: list[float]) -> list[float]:
    """Squared errors of the nearest such sequences of the first 0, 1, .. values."""
    return _pools(y)[1]


def _pools(y: list[float]) -> tuple[list[tuple[float, int]], list[float]]:
    pools: list[tuple[float, int, float]] = []  # mean, count, squared errors of this pool and all before it
    errors = [0.0]
    for value in y:
        mean, count, own = value, 1, 0.0
        while pools and pools[-1][0] >= mean:
            other, n, total = pools.pop()
            before = pools[-1][2] if pools else 0.0
            own += total - before + (mean - other) ** 2 * count * n / (count + n)
            mean, count = (mean * count + other * n) / (count + n), count + n
        pools.append((mean, count, own + (pools[-1][2] if pools else 0.0)))
        errors.append(pools[-1][2])
    return [(mean, count) for mean, count, _ in pools], errors


def knots_of(share: Tensor) -> tuple[list[float], list[float]]:
    """Places in blocks and values of a line through stairs `(block,)`: flat where a stair is longer than the next."""
    edges = [0, *(share.diff().nonzero()[:, 0] + 1).tolist(), len(share)]
    lengths = [b - a for a, b in itertools.pairwise(edges)]
    places, values = [0.0], [float(share[0])]
    for k in range(1, len(lengths)):
        reach = min(lengths[k - 1], lengths[k]) / 2
        places += [edges[k] - reach, edges[k] + reach]
        values += [float(share[edges[k] - 1]), float(share[edges[k]])]
    return [*places, float(len(share))], [*values, float(share[-1])]


def _samples_of(share: Tensor, size: int, n: int) -> Tensor:
    """A course in blocks `(block,)` at every sample, `(time,)`."""
    places, values = knots_of(share)
    return interpolated(torch.arange(n, dtype=share.dtype) + 0.5, [size * place for place in places], values)


def interpolated(at: Tensor, places: list[float], values: list[float]) -> Tensor:
    """A line through points, flat beyond them, at `at`."""
    x, y = (torch.tensor(v, dtype=at.dtype) for v in (places, values))
    right = torch.searchsorted(x, at).clamp(1, len(x) - 1)
    width = (x[right] - x[right - 1]).clamp(min=1e-300)
    return torch.lerp(y[right - 1], y[right], ((at - x[right - 1]) / width).clamp(0, 1))
