"""Stretches of a whitened record in which its variance is another, by the likelihood of two levels."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.level_scan import scanned_levels

_FINEST_BLOCKS = 16384
_SHORTEST_BLOCK = 16
_ROUNDS = 4
_LOUDER = 3.0  # factor to start from, where no stretch is
_CUT = 25.0  # squares: an outlier is no episode
_CERTAIN = 2.5  # sd of the log of a factor


class Episode(NamedTuple):
    """First sample, and the one after the last."""

    start: int
    stop: int


class Episodes(NamedTuple):
    """Episodes and the factor of the variance within them, `(sensor,)`; 1 where a sensor takes no part."""

    episodes: tuple[Episode, ...]
    factor: Tensor

    def inside(self, n: int) -> Tensor:
        """Samples within, `(time,)`."""
        within = torch.zeros(n, dtype=torch.bool)
        for start, stop in self.episodes:
            within[start:stop] = True
        return within

    def log_ratios(self, white: Tensor) -> Tensor:
        """Log likelihood ratio of each sample's belonging to an episode, `(time,)`."""
        return _log_ratios(white.square(), self.factor, self.inside(white.shape[-1]))


def episodes_of(white: Tensor, p_values: Tensor) -> Episodes | None:
    """The likeliest episodes of `(sensor, time)`, `None` where no sensor has any.

    Args:
        white: Whitened recording.
        p_values: That its level changes, for each sensor and for all together, `(sensor + 1,)`.
    """
    best, best_score = None, 0.0
    scan = scanned_levels(white.square().clamp(max=_CUT))
    for factor, stretch in ((0.0, None), (0.0, (scan.start, scan.stop)), (_LOUDER, None)):
        found, score = _from_start(white, p_values, factor, stretch)
        if found is not None and (best is None or score > best_score):
            best, best_score = found, score
    return best


def two_level_scores(white: Tensor, factor: Tensor, inside: Tensor) -> Tensor:
    """Log likelihood of two levels against their mean, `(sensor, time)`, where `inside` `(time,)` has `factor`."""
    squares, share = white.square(), inside.to(torch.float64).mean()
    mean = squares.mean(-1, keepdim=True)
    quiet = mean / (1 - share + share * factor[:, None])
    level = quiet * torch.where(inside, factor[:, None], 1.0)
    return (squares / mean - squares / level - (level / mean).log()) / 2


def onset_limits(log_ratios: Tensor, episode: Episode, *, rising: bool) -> tuple[int, int]:
    """95 % limits of an episode's start (`rising`) or stop, by the likelihood of every place up to its other end."""
    n = len(log_ratios)
    if rising:
        first, last = 0, episode.stop
        # Samples from the start on belong to the episode.
        likelihood = log_ratios[first:last].flip(0).cumsum(0).flip(0)
        offset = 0
    else:
        first, last = episode.start, n
        likelihood = log_ratios[first:last].cumsum(0)
        offset = 1
    weight = (likelihood - likelihood.max()).exp().cumsum(0)
    weight = weight / weight[-1].clone()
    low, high = (int(torch.searchsorted(weight, q)) for q in (0.025, 0.975))
    return first + low + offset, first + min(high, len(weight) - 1) + offset


def _from_start(
    white: Tensor, p_values: Tensor, start: float, stretch: tuple[int, int] | None
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
        factor = _factors(squares, inside, concerned)
    for _ in range(_ROUNDS):
        log_ratios = _log_ratios(squares, factor, inside)
        found = _likeliest(log_ratios)
        if not found:
            return None, 0.0
        inside = Episodes(found, factor).inside(n)
        if bool(inside.all()):
            return None, 0.0
        factor = _factors(squares, inside, torch.ones_like(concerned))
        if bool((factor == 1).all()):
            return None, 0.0
    if 2 * int(inside.sum()) > n:  # what lasts longer is the rule
        edges = [0, *(e for pair in found for e in pair), n]
        found = tuple(Episode(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a < b)
        factor, inside = 1 / factor, ~inside
    score = float(two_level_scores(white, factor, inside).sum()) - 2 * len(found) * math.log(n)
    return Episodes(found, factor), score


def _factors(squares: Tensor, inside: Tensor, concerned: Tensor) -> Tensor:
    """Of the variance inside to that outside, 1 where it is not certain."""
    n_inside = int(inside.sum())
    if n_inside == 0 or n_inside == len(inside):
        return torch.ones(len(squares), dtype=torch.float64)
    factor = squares[:, inside].mean(-1) / squares[:, ~inside].mean(-1).clamp(min=1e-300)
    sd = math.sqrt(2 / n_inside + 2 / (len(inside) - n_inside))
    return torch.where(concerned & (factor.log().abs() > _CERTAIN * sd), factor, 1.0)


def _log_ratios(squares: Tensor, factor: Tensor, inside: Tensor) -> Tensor:
    """`(e^2 (1/v - 1/(r v)) - log r)/2` summed over the sensors, `(time,)`."""
    share = inside.to(torch.float64).mean()
    quiet = squares.mean(-1) / (1 - share + share * factor)
    weight = (1 - 1 / factor) / quiet
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
        a = lower + int(total[lower : start * size + 2 * size + 1].argmin())
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
