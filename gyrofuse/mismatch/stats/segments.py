"""Stretches of a whitened record in which its variance is another, by the likelihood of two levels."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.stats.level_scan import Reference, scanned_levels

_FINEST_BLOCKS = 16384
_SHORTEST_BLOCK = 16
_ROUNDS = 4
_LOUDER = 3.0  # factor to start from, where no stretch is
_CUT = 25.0  # squares: an outlier is no episode
_TELL_A_LEVEL = 64  # samples of a stretch: fewer may all be outliers
_MEDIAN = 0.4549364231195724  # of the square of a standard normal variable
_CERTAIN, _BEYOND_DOUBT = 2.5, 3.5  # sd of the log of a factor
_PRIOR = 0.5  # sd of the log of a factor beforehand
_GRID, _REFINEMENTS = 160, 3  # starts and stops that are looked at at once, and how often more finely
_TAIL, _ZOOM = 0.025, 1e-5  # of the posterior, beyond limits, and where no finer grid is made


class Episode(NamedTuple):
    """First sample, and the one after the last."""

    start: int
    stop: int


class Episodes(NamedTuple):
    """Stretches of another level.

    Attributes:
        episodes: In order of time.
        factor: Of the variance within them, `(sensor,)`; 1 where a sensor takes no part.
        log_ratio: Log of the mean likelihood ratio of a single one, wherever it is, nats.
    """

    episodes: tuple[Episode, ...]
    factor: Tensor
    log_ratio: float = 0.0

    def inside(self, n: int) -> Tensor:
        """Samples within, `(time,)`."""
        within = torch.zeros(n, dtype=torch.bool)
        for start, stop in self.episodes:
            within[start:stop] = True
        return within

    def other_way_round(self, n: int) -> Episodes:
        """With what lies between them as the episodes."""
        edges = [0, *(e for pair in self.episodes for e in pair), n]
        between = tuple(Episode(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a < b)
        return self._replace(episodes=between, factor=1 / self.factor)


def episodes_of(white: Tensor, p_values: Tensor, reference: Reference | None = None) -> Episodes | None:
    """The likeliest episodes of `(sensor, time)`, `None` where no sensor has any.

    Args:
        white: Whitened recording.
        p_values: That its level changes, for each sensor and for all together, `(sensor + 1,)`.
        reference: What else is known of the level between them.
    """
    best, best_score = None, 0.0
    scan = scanned_levels(white.square().clamp(max=_CUT), reference)
    for factor, stretch in ((0.0, None), (0.0, (scan.start, scan.stop)), (_LOUDER, None)):
        found, score = _from_start(white, p_values, factor, stretch, reference)
        if found is not None and (best is None or score > best_score):
            best, best_score = found, score
    if best is None:
        return None
    return best._replace(factor=_of_the_concerned(white, best, reference), log_ratio=scan.log_ratio)


def stretch_of(white: Tensor) -> Episodes:
    """The likeliest single stretch of a whitened recording `(sensor, time)`, as the scan has it."""
    scan = scanned_levels(white.square().clamp(max=_CUT))
    found = Episodes((Episode(scan.start, scan.stop),), torch.ones(len(white), dtype=white.dtype), scan.log_ratio)
    return found._replace(factor=_of_the_concerned(white, found, None))


def _of_the_concerned(white: Tensor, found: Episodes, reference: Reference | None) -> Tensor:
    """Factors, 1 in sensors that are nearer to no change than to the change of those that have it.

    Those are the sensors that together tell most of one change: of the largest `k` changes `d`, the `k` that make
    `k mean(d)^2` largest.
    """
    inside = found.inside(white.shape[-1])
    log_factor, sd = log_factors(_without_outliers(white, inside), inside, reference)
    typical, most = 0.0, 0.0
    for sign in (1.0, -1.0):
        mean = (sign * log_factor).sort(descending=True).values.cumsum(0) / torch.arange(1, len(log_factor) + 1)
        told = torch.where(mean > 0, mean.square(), 0.0) * torch.arange(1, len(log_factor) + 1)
        if float(told.max()) > most:
            most, typical = float(told.max()), sign * float(mean[told.argmax()])
    concerned = ((2 * log_factor - typical) * typical > 0) | (log_factor.abs() > _BEYOND_DOUBT * sd)
    return torch.where(concerned, log_factor.exp(), 1.0)


def _without_outliers(white: Tensor, inside: Tensor) -> Tensor:
    """Squares of whitened samples `(sensor, time)`, none larger than an outlier's of the level that is there.

    Of noise that is many times as loud all samples are beyond what the rest of the record calls an outlier.
    """
    squares = white.square()
    limit = torch.full_like(squares, _CUT)
    for part in (inside, ~inside):
        if int(part.sum()) >= _TELL_A_LEVEL:
            level = squares[:, part].median(-1, keepdim=True).values / _MEDIAN
            limit[:, part] = _CUT * level.clamp(min=1.0)
    return squares.minimum(limit)


def log_factors(squares: Tensor, inside: Tensor, reference: Reference | None) -> tuple[Tensor, float]:
    """Of the variance inside to that outside, `(sensor,)`, and their sd."""
    n_inside = int(inside.sum())
    energy, worth = _known(squares, reference)
    n_outside = len(inside) - n_inside + worth
    outside = (squares[:, ~inside].sum(-1) + energy) / n_outside
    ratio = squares[:, inside].mean(-1) / outside.clamp(min=1e-300)
    return ratio.clamp(min=1e-300).log(), math.sqrt(2 / n_inside + 2 / n_outside)


def _known(squares: Tensor, reference: Reference | None) -> tuple[Tensor, float]:
    """Energy `(sensor,)` and samples that a reference adds to what lies outside of episodes."""
    mean = squares.mean(-1)
    return (mean * 0.0, 0.0) if reference is None else (mean * reference.level * reference.worth, reference.worth)


def _quiet(squares: Tensor, factor: Tensor, inside: Tensor, reference: Reference | None) -> Tensor:
    """Variance outside of episodes, `(sensor,)`, which in them is so many times as large."""
    energy, worth = _known(squares, reference)
    within, without = squares[:, inside].sum(-1), squares[:, ~inside].sum(-1)
    return (within / factor + without + energy) / (len(inside) + worth)


def two_level_scores(white: Tensor, factor: Tensor, inside: Tensor, reference: Reference | None = None) -> Tensor:
    """Log likelihood of two levels against one, `(sensor, time)`, where `inside` `(time,)` has `factor`."""
    squares = white.square()
    one, quiet = (_quiet(squares, f, inside, reference)[:, None] for f in (torch.ones_like(factor), factor))
    level = quiet * torch.where(inside, factor[:, None], 1.0)
    return (squares / one - squares / level - (level / one).log()) / 2


class Limits(NamedTuple):
    """Median and 95 % limits."""

    value: float
    low: float
    high: float


class Told(NamedTuple):
    """What the data tell of one episode.

    Attributes:
        start, stop: Samples.
        log_factor: Mean and sd of its logarithm, `(sensor,)`.
        log_factor_sd: Likewise.
    """

    start: Limits
    stop: Limits
    log_factor: Tensor
    log_factor_sd: Tensor


def told_of_first(white: Tensor, episodes: tuple[Episode, ...], reference: Reference | None = None) -> Told:
    """Posterior of the first episode's ends and factors, the other episodes given.

    With `x` the share of a sensor's energy in `m` of `n` samples, the likelihood of the best factor is

        log L = n/2 log(1/n) - m/2 log(x/m) - (n - m)/2 log((1 - x)/(n - m)),

    and normal in the factor's logarithm, of which the information is `I = m (n - m)/2n`: under a normal prior of sd
    `tau` it is `L^s / sqrt(1 + tau^2 I)`, `s = tau^2 I/(1 + tau^2 I)`. All starts and stops are as likely beforehand; a
    grid of them is made finer where the posterior is.

    Args:
        white: Whitened recording of the sensors concerned, `(sensor, time)`.
        episodes: In order of time.
        reference: What else is known of their level between episodes.
    """
    end = white.shape[-1]
    others = Episodes(episodes[1:], torch.ones(0)).inside(end)
    cut = _without_outliers(white, Episodes(episodes, torch.ones(0)).inside(end))
    squares = torch.where(others, 0.0, cut)
    energy, worth = _known(cut, reference)
    total = torch.nn.functional.pad(squares.cumsum(-1), (1, 0))
    whole = (total[:, -1] + energy)[:, None, None]
    n_samples = int((~others).sum())
    n = n_samples + worth
    last = episodes[1].start if len(episodes) > 1 else end
    ranges = [(0, last), (0, last)]
    for _ in range(_REFINEMENTS):
        start, stop = (_grid(low, high) for low, high in ranges)
        m = (stop[None] - start[:, None]).to(torch.float64)  # (start, stop)
        possible = (m >= _SHORTEST_BLOCK) & (m <= n_samples - _SHORTEST_BLOCK)
        m = torch.where(possible, m, n / 2)
        information = m * (n - m) / (2 * n)
        shrunk = _PRIOR**2 * information / (1 + _PRIOR**2 * information)
        x = ((total[:, None, stop] - total[:, start, None]) / whole).clamp(1e-12, 1 - 1e-12)
        inside, outside = (x / m).log(), ((1 - x) / (n - m)).log()
        gain = -(math.log(n) * n + inside * m + outside * (n - m)) / 2
        log_weight = (shrunk * gain + torch.log1p(-shrunk) / 2).sum(0)
        weight = torch.softmax(log_weight.masked_fill(~possible, -math.inf).flatten(), 0).view_as(m)
        ends = ((start, weight.sum(1)), (stop, weight.sum(0)))
        steps = [int(grid.diff().max()) if len(grid) > 1 else 1 for grid, _ in ends]
        ranges = [
            (max(_quantile(*pair, _ZOOM) - step, 0), min(_quantile(*pair, 1 - _ZOOM) + step, last))
            for pair, step in zip(ends, steps, strict=True)
        ]
    from_, to = (Limits(*(float(_quantile(*pair, share)) for share in (0.5, _TAIL, 1 - _TAIL))) for pair in ends)
    mean = shrunk * (inside - outside)
    log_factor = (weight * mean).sum((1, 2))
    variance = (weight * (mean.square() + shrunk / information)).sum((1, 2)) - log_factor.square()
    return Told(from_, to, log_factor, variance.clamp(min=0).sqrt())


def _grid(low: int, high: int) -> Tensor:
    return torch.linspace(low, high, min(high - low + 1, _GRID), dtype=torch.float64).round().long()


def _quantile(places: Tensor, weight: Tensor, share: float) -> int:
    """Of places that are `weight` likely."""
    below = weight.cumsum(0) - weight / 2
    return int(places[min(int(torch.searchsorted(below, share)), len(places) - 1)])


def _from_start(
    white: Tensor, p_values: Tensor, start: float, stretch: tuple[int, int] | None, reference: Reference | None
) -> tuple[Episodes | None, float]:
    """The likeliest episodes from a factor on, or where it is 0 from a stretch or that of the CUSUM's range."""
    n = white.shape[-1]
    squares = white.square().clamp(max=_CUT)
    own = p_values[:-1] <= max(float(p_values.min()), 1e-4)
    concerned = own if bool(own.any()) else torch.ones_like(own)
    inside = torch.zeros(n, dtype=torch.bool)
    factor = torch.where(concerned, start, 1.0).to(torch.float64)
    if start == 0:
        if stretch is None:
            inside = _widest(_blocks(squares[concerned]).mean(0), n)
        else:
            inside[slice(*stretch)] = True
        factor = _factors(squares, inside, concerned, reference)
    for _ in range(_ROUNDS):
        log_ratios = _log_ratios(squares, factor, inside, reference)
        found = _likeliest(log_ratios)
        if not found:
            return None, 0.0
        inside = Episodes(found, factor).inside(n)
        if bool(inside.all()):
            return None, 0.0
        factor = _factors(squares, inside, torch.ones_like(concerned), reference)
        if bool((factor == 1).all()):
            return None, 0.0
    episodes = Episodes(found, factor)
    if reference is None and 2 * int(inside.sum()) > n:  # what lasts longer is the rule
        episodes = episodes.other_way_round(n)
    score = float(two_level_scores(white, episodes.factor, episodes.inside(n), reference).sum())
    return episodes, score - 2 * len(episodes.episodes) * math.log(n)


def _factors(squares: Tensor, inside: Tensor, concerned: Tensor, reference: Reference | None) -> Tensor:
    """Of the variance inside to that outside, 1 where it is not certain."""
    n_inside = int(inside.sum())
    if n_inside == 0 or n_inside == len(inside):
        return torch.ones(len(squares), dtype=torch.float64)
    log_factor, sd = log_factors(squares, inside, reference)
    return torch.where(concerned & (log_factor.abs() > _CERTAIN * sd), log_factor.exp(), 1.0)


def _log_ratios(squares: Tensor, factor: Tensor, inside: Tensor, reference: Reference | None) -> Tensor:
    """`(e^2 (1/v - 1/(r v)) - log r)/2` summed over the sensors, `(time,)`."""
    weight = (1 - 1 / factor) / _quiet(squares, factor, inside, reference)
    return (weight @ squares - factor.log().sum()) / 2


def _blocks(values: Tensor) -> Tensor:
    size = _block_size(values.shape[-1])
    n = values.shape[-1] // size
    return values[..., : n * size].unflatten(-1, (n, size)).mean(-1)


def _block_size(n: int) -> int:
    return max(_SHORTEST_BLOCK, -(-n // _FINEST_BLOCKS))


def _widest(blocks: Tensor, n: int) -> Tensor:
    """Samples between the ends of the CUSUM's range."""
    path = (blocks - blocks.mean()).cumsum(0)
    size = _block_size(n)
    low, high = sorted(((int(path.argmin()) + 1) * size, (int(path.argmax()) + 1) * size))
    inside = torch.zeros(n, dtype=torch.bool)
    inside[low:high] = True
    return inside


def _likeliest(log_ratios: Tensor) -> tuple[Episode, ...]:
    """Episodes of the largest sum: one of any gain, or several that each pay for two changes; edges to the sample."""
    n, size = len(log_ratios), _block_size(len(log_ratios))
    sums = (_blocks(log_ratios[None])[0] * size).tolist()
    coarse = _several(sums, math.log(n)) or _single(sums)
    total = torch.nn.functional.pad(log_ratios.cumsum(0), (1, 0))
    found: list[Episode] = []
    for start, stop in coarse:
        lower = max(start * size - 2 * size, found[-1].stop if found else 0)
        if lower >= n:
            break
        a = lower + int(total[lower : min(start * size + 2 * size + 1, n)].argmin())
        upper = max(stop * size - 2 * size, a + 1)
        last = n if stop == len(sums) else min(stop * size + 2 * size, n)
        b = upper + int(total[upper : last + 1].argmax())
        if b > a:
            found.append(Episode(a, b))
    return tuple(found)


def _single(sums: list[float]) -> list[tuple[int, int]]:
    """The stretch of the largest sum."""
    best, where, running, start = 0.0, None, 0.0, 0
    for i, value in enumerate(sums):
        if running <= 0:
            running, start = 0.0, i
        running += value
        if running > best:
            best, where = running, (start, i + 1)
    return [] if where is None else [where]


def _several(sums: list[float], cost: float) -> list[tuple[int, int]]:
    """Stretches of the largest sum less `cost` for each beginning and end (Viterbi's algorithm with two states)."""
    out, into = 0.0, -cost
    came_from_in, came_from_out = [], []
    for value in sums:
        leave, enter = into - cost > out, out - cost > into
        came_from_in.append(leave)
        came_from_out.append(enter)
        out, into = (into - cost if leave else out), (out - cost if enter else into) + value
    state, stretches, stop = into > out, [], len(sums)
    for i in range(len(sums) - 1, -1, -1):
        if state and came_from_out[i]:
            stretches.append((i, stop))
            state = False
        elif not state and came_from_in[i]:
            state, stop = True, i
    if state:
        stretches.append((0, stop))
    return stretches[::-1]
