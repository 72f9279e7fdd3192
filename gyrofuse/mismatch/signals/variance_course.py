"""Courses of the level of noise, as they act on records, and from which frequency on they do."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gyrofuse.mismatch.signals.filters import filtered
from gyrofuse.mismatch.signals.known_lines import without_lines
from gyrofuse.mismatch.signals.psd import bands, cross_spectra

CORNER = 1 / 64  # cycles per sample, for stretches too short to determine it


@dataclass(frozen=True, eq=False)
class VarianceCourse:
    """Density `1 + (r - 1) f^2 / (f^2 + f_c^2)` times what it was: white noise that is louder, above a walk.

    With `r = b q^c` and a course `c` that all sensors have.

    Attributes:
        course: `c`, `(time,)`, from 0 to 1; of an episode whether a sample is inside.
        factor: `q`, `(sensor,)`, of the variance where the course is 1; 1 where a sensor does not change.
        corner: `f_c`, cycles per sample: what is slower stays as it is.
        base: `b`, `(sensor,)`, of the variance where the course is 0.
    """

    course: Tensor
    factor: Tensor
    corner: float
    base: Tensor | float = 1.0

    @property
    def variance(self) -> Tensor:
        """Variance of whitened samples, `(sensor, time)`."""
        return whitened_factor(self._log_level().exp(), self.corner)

    def of_length(self, n_samples: int) -> VarianceCourse:
        """The course in a record of another length, at the same share of it."""
        n = len(self.course)
        return self if n_samples == n else replace(self, course=self.course[torch.arange(n_samples) * n // n_samples])

    def added(self, signal: Tensor, lines: tuple[float, ...] = ()) -> Tensor:
        """Signals `(..., sensor, time)` with it; lines, cycles per sample, are no noise and stay as they are."""
        noise = without_lines(signal, lines)
        return signal - noise + self._times(noise, 0.5)

    def taken_off(self, signal: Tensor) -> Tensor:
        """Signals `(..., sensor, time)` that have it, without."""
        return self._times(signal, -0.5)

    def _log_level(self) -> Tensor:
        """`log r`, `(sensor, time)`."""
        base = torch.as_tensor(self.base, dtype=self.factor.dtype).expand_as(self.factor)
        return base.log()[:, None] + self.factor.log()[:, None] * self.course.to(self.factor.dtype)

    def _times(self, signal: Tensor, power: float) -> Tensor:
        """Signals times a power of the density, through a filter for each of several levels, interpolated in between.

        Filters are a log variance of 0.2 apart: amplitudes between them are off by a thousandth.
        """
        level = self._log_level()
        low, high = level.amin(-1, keepdim=True), level.amax(-1, keepdim=True)
        steps = max(math.ceil(float((high - low).max()) / 0.2), 1)
        position = steps * (level - low) / (high - low).clamp(min=1e-12)
        total = torch.zeros_like(signal)
        for step in range(steps + 1):
            weight = (1 - (position - step).abs()).clamp(min=0)
            if bool(weight.any()):
                r = (low + (high - low) * step / steps).exp()
                total = total + weight * _louder(signal, r, self.corner, power)
        return total


def _louder(signal: Tensor, r: Tensor, corner: float, power: float) -> Tensor:
    """Signals `(..., sensor, time)` whose fast noise has a variance `(sensor, 1)` times what it was."""
    if bool((r == 1).all()):
        return signal
    return filtered(signal, lambda f: (1 + (r - 1) * fast_share(f, corner)).pow(power))


def fast_share(f: Tensor, corner: float) -> Tensor:
    """Share of a density at `f` that is white noise, above a walk as strong as it at the corner."""
    return f.square() / (f.square() + corner**2).clamp(min=1e-300)  # of a corner at zero the mean stays


def whitened_factor(factor: Tensor, corner: float) -> Tensor:
    """Variance ratio of whitened samples where that of the fast noise is `factor`: less, since slow noise stays.

    The mean of `f^2 / (f^2 + f_c^2)` over all frequencies is `1 - 2 f_c atan(1 / 2 f_c)`.
    """
    return 1 + (factor - 1) * mean_fast_share(corner)


def fast_factor(whitened: Tensor, corner: float) -> Tensor:
    """Variance ratio of the fast noise where that of whitened samples is `whitened`: the inverse of `whitened_factor`.

    Not below a tenth of it: fast noise has no negative variance.
    """
    return (1 + (whitened - 1) / mean_fast_share(corner)).maximum(0.1 * whitened)


def mean_fast_share(corner: float) -> float:
    """Mean of `fast_share` over all frequencies."""
    return 1 - 2 * corner * math.atan2(1, 2 * corner)


def corner_of(noise: Tensor, inside: Tensor, factor: Tensor) -> float:
    """Frequency from which on noise is louder, cycles per sample: of the likely ones that nearest to a 64th.

    Arguments as of `likely_corners`.
    """
    return likely_corners(noise, inside, factor)[0]


def likely_corners(noise: Tensor, inside: Tensor, factor: Tensor) -> list[float]:
    """Frequencies from which on noise may be louder, cycles per sample, that nearest to a 64th first.

    By least squares of log spectra of the longest stretch inside over that outside, over powers of two: those within 4
    of the least chi-square, 2 sd. A 64th where a stretch has less than 256 samples.

    Args:
        noise: Noise, `(sensor, time)`.
        inside: Samples of the louder level, `(time,)`.
        factor: Ratio of the variance of whitened samples inside to that outside, `(sensor,)`.
    """
    parts = [_longest(inside), _longest(~inside)]
    lengths = [b - a for a, b in parts]
    if min(lengths) < 256:
        return [max(CORNER, 1 / len(inside))]
    wanted = bands(lengths[0])
    powers = [cross_spectra(noise[None, :, a:b], wanted)[0].diagonal(dim1=-1, dim2=-2).real.mT for a, b in parts]
    ratio = (powers[0] / powers[1]).log()
    known = ratio.isfinite().all(0)
    weight = wanted.dof[known] / (1 + lengths[0] / lengths[1])

    def misfit(corner: float) -> float:
        more = fast_factor(factor, corner) - 1
        expected = torch.log1p(more[:, None] * fast_share(wanted.frequency, corner))
        return float(((ratio - expected)[:, known].square() @ weight).sum())

    tried = {k: misfit(2.0**-k) for k in range(4, math.ceil(math.log2(len(inside))) + 1)}
    good = [k for k, chi2 in tried.items() if chi2 <= min(tried.values()) + 4.0]
    return [2.0**-k for k in sorted(good, key=lambda k: abs(k + math.log2(CORNER)))]


def _longest(where: Tensor) -> tuple[int, int]:
    """First sample of the longest run of true entries, and the one after its last."""
    ends = [0, *(where.diff().nonzero()[:, 0] + 1).tolist(), len(where)]
    runs = [(a, b) for a, b in itertools.pairwise(ends) if bool(where[a])]
    return max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
