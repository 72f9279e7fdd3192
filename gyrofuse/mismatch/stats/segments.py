"""Stretches of a whitened record in which its variance is another: two levels, and when each of them holds.

A squared sample of variance `v` has the log likelihood `-(log v + e^2/v)/2`. The path of two levels that is likeliest,
each change costing `log n`, is found by dynamic programming; levels and path are estimated in turn.

References:
    Viterbi, Error bounds for convolutional codes, IEEE Trans. Inf. Theory 13 (1967), 260.
    Yao, Estimating the number of change-points via Schwarz' criterion, Stat. Prob. Lett. 6 (1988), 181: the cost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.level_scan import Reference, scanned_levels

OUTLIER = 25.0  # squares over their variance, beyond which a sample is an outlier and no sign of another level: 5 sd
CHI2_MEDIAN = 0.4549364231195724  # median of the square of a standard normal variable
_SHORTEST = 16  # samples of a segment: the variance of fewer is known to no better than a factor of two at 95 %


def runs_of(true: Tensor) -> Tensor:
    """First sample of each run of true entries of `(time,)`, and the one after its last, `(run, 2)`."""
    return pad(true.to(torch.int8), (1, 1)).diff().nonzero().view(-1, 2)


class Episode(NamedTuple):
    """First sample, and the one after the last."""

    start: int
    stop: int


class Episodes(NamedTuple):
    """Stretches of another level.

    Attributes:
        episodes: Stretches in order of time.
        factor: Ratio of the variance within them to that outside, `(sensor,)`; 1 where a sensor does not change.
        log_ratio: Logarithm of the mean likelihood ratio of a single stretch, wherever it is, nats.
    """

    episodes: tuple[Episode, ...]
    factor: Tensor
    log_ratio: float = 0.0

    def inside(self, n: int) -> Tensor:
        """Whether each of `n` samples is within, `(time,)`."""
        return in_stretches(self.episodes, n)

    def other_way_round(self, n: int) -> Episodes:
        """The complement in `n` samples, as the stretches of another level."""
        edges = [0, *(e for pair in self.episodes for e in pair), n]
        between = tuple(Episode(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a < b)
        return self._replace(episodes=between, factor=1 / self.factor)


def in_stretches(stretches: tuple[Episode, ...], n: int) -> Tensor:
    """Whether each of `n` samples is in one of the stretches, `(time,)`."""
    within = torch.zeros(n, dtype=torch.bool)
    for start, stop in stretches:
        within[start:stop] = True
    return within


def episodes_of(white: Tensor, reference: Reference | None = None) -> Episodes | None:
    """The likeliest episodes; `None` where no path of two levels is likelier than one level.

    Searched from the likeliest single stretch on, and from a level three times as loud, which finds many short ones.

    Args:
        white: Whitened recording, `(sensor, time)`.
        reference: Level between the episodes, where it is known beside the record.
    """
    n = white.shape[-1]
    scan = scanned_levels(white.square().clamp(max=OUTLIER), reference)
    stretch, nowhere = in_stretches((Episode(scan.start, scan.stop),), n), torch.zeros(n, dtype=torch.bool)
    best, best_score = None, 0.0
    for inside, factor in (
        (stretch, _factors(white, stretch, reference)),
        (nowhere, torch.full_like(white[:, 0], 3.0)),
    ):
        found = _improved(white, inside, factor, reference)
        if found is None:
            continue
        score = float(two_level_scores(white, found.factor, found.inside(n), reference).sum())
        score -= 2 * len(found.episodes) * math.log(n)
        if best is None or score > best_score:
            best, best_score = found, score
    if best is None:
        return None
    if reference is None and 2 * int(best.inside(n).sum()) > n:  # what lasts longer is the rule
        best = best.other_way_round(n)
    return best._replace(log_ratio=scan.log_ratio)


def stretch_of(white: Tensor) -> Episodes:
    """The likeliest single stretch of a whitened recording `(sensor, time)`, as the scan has it."""
    scan = scanned_levels(white.square().clamp(max=OUTLIER))
    stretch = (Episode(scan.start, scan.stop),)
    return Episodes(stretch, _factors(white, in_stretches(stretch, white.shape[-1]), None), scan.log_ratio)


def _improved(white: Tensor, inside: Tensor, factor: Tensor, reference: Reference | None) -> Episodes | None:
    """The likeliest path and its levels, in turn from a path `(time,)` and factors `(sensor,)` on."""
    squares = white.square().clamp(max=OUTLIER)
    found: tuple[Episode, ...] = ()
    for _ in range(4):  # or until the path stays
        quiet, before = _quiet(squares, factor, inside, reference), found
        found = _likeliest((((1 - 1 / factor) / quiet) @ squares - factor.log().sum()) / 2)
        inside = in_stretches(found, len(inside))
        if not found or bool(inside.all()):
            return None
        factor = _factors(white, inside, reference)
        if found == before:
            break
    return Episodes(found, factor)


def _likeliest(log_ratios: Tensor) -> tuple[Episode, ...]:
    """Stretches of the largest sum of `(time,)` less `log n` for each change; one of any sum where none pays for it.

    The path is found in blocks, and each of its changes to the sample within two blocks of it.
    """
    n = len(log_ratios)
    total = pad(log_ratios.cumsum(0), (1, 0))
    size = max(_SHORTEST, -(-n // 2**14))  # at most 16384 steps of the dynamic program
    path = torch.tensor(_two_state_path(total[::size].diff().tolist(), math.log(n)), dtype=torch.int8)
    changes = pad(path, (1, 0)).diff().nonzero()[:, 0].tolist()
    if not changes:
        return _single(total)
    edges = [0]
    for k, change in enumerate(changes):
        low = max(change * size - 2 * size, edges[-1])
        near = total[low : max(change * size + 2 * size, low) + 1]
        edges.append(low + int(near.argmax() if k % 2 else near.argmin()))
    edges = [*edges[1:], n] if len(changes) % 2 else edges[1:]
    return tuple(Episode(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a < b)


def _single(total: Tensor) -> tuple[Episode, ...]:
    """The stretch of the largest sum, from sums of the first 0, 1, .. values."""
    low = total.cummin(0)
    stop = int((total - low.values).argmax())
    return (Episode(int(low.indices[stop]), stop),) if stop else ()


def _two_state_path(values: list[float], cost: float) -> list[bool]:
    """States of the largest sum of values in the second state less `cost` for each change, from the first state on.

    Viterbi's algorithm: with two states all that counts is by how much the second one is ahead, at most the cost of a
    change to it.
    """
    ahead = [-cost]
    for value in values:
        ahead.append(min(max(ahead[-1], -cost), cost) + value)
    state, states = ahead[-1] > 0, []
    for before in reversed(ahead[:-1]):
        states.append(state)
        state = before >= -cost if state else before > cost
    return states[::-1]


def _factors(white: Tensor, inside: Tensor, reference: Reference | None) -> Tensor:
    """Ratios of the variance inside to that outside, `(sensor,)`; 1 in sensors that need not have changed."""
    log_factor, sd = log_factors(_without_outliers(white, inside), inside, reference)
    return torch.where(included_sensors((log_factor / sd).square(), 1).which, log_factor.exp(), 1.0)


def _without_outliers(white: Tensor, inside: Tensor) -> Tensor:
    """Squares of whitened samples `(sensor, time)`, none larger than an outlier's of the level that is there.

    Of noise that is many times as loud all samples are beyond what the rest of the record calls an outlier. Fewer than
    64 samples may all be outliers, and have no level of their own.
    """
    squares = white.square()
    limit = torch.full_like(squares, OUTLIER)
    for part in (inside, ~inside):
        if int(part.sum()) >= 64:
            level = squares[:, part].median(-1, keepdim=True).values / CHI2_MEDIAN
            limit[:, part] = OUTLIER * level.clamp(min=1.0)
    return squares.minimum(limit)


def log_factors(squares: Tensor, inside: Tensor, reference: Reference | None) -> tuple[Tensor, float]:
    """Logarithms of the ratio of the variance inside to that outside, `(sensor,)`, and their sd.

    Args:
        squares: Squares of whitened samples, `(sensor, time)`.
        inside: Samples of the other level, `(time,)`.
        reference: Level outside, where it is known beside the record.
    """
    n_inside = int(inside.sum())
    energy, n_known = _known(squares, reference)
    n_outside = len(inside) - n_inside + n_known
    outside = (squares[:, ~inside].sum(-1) + energy) / n_outside
    ratio = squares[:, inside].mean(-1) / outside.clamp(min=1e-300)
    return ratio.clamp(min=1e-300).log(), math.sqrt(2 / n_inside + 2 / n_outside)


def _known(squares: Tensor, reference: Reference | None) -> tuple[Tensor, float]:
    """Energy `(sensor,)` and number of samples that a reference adds to those outside."""
    mean = squares.mean(-1)
    if reference is None:
        return 0.0 * mean, 0.0
    return mean * reference.level * reference.n_samples, reference.n_samples


def _quiet(squares: Tensor, factor: Tensor, inside: Tensor, reference: Reference | None) -> Tensor:
    """Variance outside, `(sensor,)`, if that inside is so many times as large."""
    energy, n_known = _known(squares, reference)
    within, without = squares[:, inside].sum(-1), squares[:, ~inside].sum(-1)
    return (within / factor + without + energy) / (len(inside) + n_known)


def course_scores(white: Tensor, variance: Tensor, reference: Reference | None = None) -> Tensor:
    """Log likelihood ratio of a variance known up to its size to a steady one, `(sensor, time)`, nats.

    Args:
        white: Whitened samples, `(sensor, time)`.
        variance: Variance of each, up to a factor of each sensor, likewise; 1 where the reference has its level.
        reference: Level where the variance is 1, where it is known beside the record.
    """
    squares = white.square()
    energy, n_known = _known(squares, reference)
    n = white.shape[-1] + n_known
    size = (squares / variance).median(-1, keepdim=True).values / CHI2_MEDIAN
    for _ in range(3):  # outliers are cut at the size found so far
        size = (((squares / variance).minimum(OUTLIER * size).sum(-1) + energy) / n)[:, None]
    variance = size * variance
    squares = squares.minimum(OUTLIER * variance)
    one = ((squares.sum(-1) + energy) / n)[:, None]
    return (squares / one - squares / variance - (variance / one).log()) / 2


def two_level_scores(white: Tensor, factor: Tensor, inside: Tensor, reference: Reference | None = None) -> Tensor:
    """Log likelihood ratio of two levels to one for each sample, `(sensor, time)`, nats.

    Args:
        white: Whitened samples, `(sensor, time)`.
        factor: Ratio of the variance inside to that outside, `(sensor,)`.
        inside: Samples of the other level, `(time,)`.
        reference: Level outside, where it is known beside the record.
    """
    return course_scores(white, torch.where(inside, factor[:, None], 1.0), reference)


class Limits(NamedTuple):
    """Median and 95 % limits."""

    value: float
    low: float
    high: float


class SegmentPosterior(NamedTuple):
    """Posterior of one episode.

    Attributes:
        start, stop: Samples.
        log_factor: Posterior mean of the logarithm of its factor, `(sensor,)`.
        log_factor_sd: Posterior sd of it, `(sensor,)`.
    """

    start: Limits
    stop: Limits
    log_factor: Tensor
    log_factor_sd: Tensor


def first_segment_posterior(
    white: Tensor, episodes: tuple[Episode, ...], reference: Reference | None = None
) -> SegmentPosterior:
    """Posterior of the first episode's ends and factors, the other episodes given.

    With `x` the share of a sensor's energy in `m` of `n` samples, the likelihood of the best factor is

        log L = n/2 log(1/n) - m/2 log(x/m) - (n - m)/2 log((1 - x)/(n - m)),

    and normal in the factor's logarithm, of which the information is `I = m (n - m)/2n`: under a normal prior of sd
    `tau` it is `L^s / sqrt(1 + tau^2 I)`, `s = tau^2 I/(1 + tau^2 I)`. All starts and stops are as likely beforehand; a
    grid of them is refined twice where the posterior is.

    Args:
        white: Whitened recording of the sensors that change, `(sensor, time)`.
        episodes: Stretches in order of time.
        reference: Level between episodes, where it is known beside the record.
    """
    prior_variance = 0.5**2  # of the factor's logarithm: factors from 0.4 to 2.7 at 95 %
    end = white.shape[-1]
    others = in_stretches(episodes[1:], end)
    cut = _without_outliers(white, in_stretches(episodes, end))
    energy, n_known = _known(cut, reference)
    total = pad(torch.where(others, 0.0, cut).cumsum(-1), (1, 0))
    whole = (total[:, -1] + energy)[:, None, None]
    n_samples = int((~others).sum())
    n = n_samples + n_known
    last = episodes[1].start if len(episodes) > 1 else end
    ranges = [(0, last), (0, last)]
    for _ in range(3):
        # 160 x 160 pairs at once.
        start, stop = (torch.linspace(a, b, min(b - a + 1, 160), dtype=torch.float64).round().long() for a, b in ranges)
        m = (stop[None] - start[:, None]).to(torch.float64)  # (start, stop)
        possible = (m >= _SHORTEST) & (m <= n_samples - _SHORTEST)
        m = torch.where(possible, m, n / 2)
        information = m * (n - m) / (2 * n)
        shrunk = prior_variance * information / (1 + prior_variance * information)
        x = ((total[:, None, stop] - total[:, start, None]) / whole).clamp(1e-12, 1 - 1e-12)
        inside, outside = (x / m).log(), ((1 - x) / (n - m)).log()
        gain = -(math.log(n) * n + inside * m + outside * (n - m)) / 2
        log_weight = (shrunk * gain + torch.log1p(-shrunk) / 2).sum(0)
        weight = torch.softmax(log_weight.masked_fill(~possible, -math.inf).flatten(), 0).view_as(m)
        ends = ((start, weight.sum(1)), (stop, weight.sum(0)))
        ranges = []
        for grid, mass in ends:
            step, (low, high) = int(grid.diff().max()) if len(grid) > 1 else 1, _quantiles(grid, mass, 1e-5, 1 - 1e-5)
            ranges.append((max(low - step, 0), min(high + step, last)))
    from_, to = (Limits(*map(float, _quantiles(*pair, 0.5, 0.025, 0.975))) for pair in ends)
    mean = shrunk * (inside - outside)
    log_factor = (weight * mean).sum((1, 2))
    variance = (weight * (mean.square() + shrunk / information)).sum((1, 2)) - log_factor.square()
    return SegmentPosterior(from_, to, log_factor, variance.clamp(min=0).sqrt())


def _quantiles(samples: Tensor, weight: Tensor, *shares: float) -> list[int]:
    """Quantiles of samples that have the posterior probabilities `weight`."""
    below = weight.cumsum(0) - weight / 2
    at = torch.searchsorted(below, torch.tensor(shares, dtype=below.dtype)).clamp(max=len(samples) - 1)
    return [int(s) for s in samples[at]]
