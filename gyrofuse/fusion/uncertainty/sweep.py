"""One pass over a recording for statistics that are linear in products of wavelet coefficients.

Such a statistic is a sum over levels and times of influences `u_{j,t}`, functions of the coefficients of level `j`
whose windows start at sample `t`. A block bootstrap needs the series `h_t = sum_j u_{j,t}` and, per level, sums of
`u_{j,t}` over bins of time.

Coefficients go by the *first* sample of their window here, so that all levels of one time stand together, and the
pyramid looks ahead. Two passes cross memory about once each: the short levels in tiles of consecutive time, with the
few samples that they look ahead; the long ones, whose lags are multiples of `2**12`, in tiles of some residues modulo
that, which never meet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse.wavelets.block_length import moments_over_starts

# Numbers in a tile on a CPU (2**19, 4 MiB): with its coefficients and their influences it stays in the last level of
# cache.
_CPU_TILE = 524_288
# Numbers in a tile for each CPU thread, where that is more: many threads need more work to share.
_CPU_TILE_PER_THREAD = 262_144
# Numbers in a tile on a GPU (2**24, 128 MiB): enough work for every multiprocessor at each level.
_GPU_TILE = 16_777_216
# Number of levels that are swept in tiles of consecutive time. A tile needs `2**12` samples after its end, which stay
# few beside a tile; fewer short levels would leave the long ones more rounds.
_SHORT_LEVELS = 12
# Number of steps in a recording at least: stretches that complete a level start at every `step`-th time, and between
# neighbouring starts a stretch hardly changes, so that the covariance moves by a few parts in a thousand at most.
_FEWEST_STEPS = 8_192
# Samples swept at a time at least: many times the look-ahead of the short levels.
_SHORTEST_STRETCH = 65_536


class Statistic(NamedTuple):
    """A linear statistic of products of coefficients, `jacobian @ sum_{j,t} u_{j,t}`.

    Attributes:
        mapping: `(item, row, sensor)`, how the sensors are mixed first, or None to take them as they are.
        influence: Given coefficients `(item, row, ...)`, without their factor `2**-j`, the index of their level and a
            series `(item, out, ...)`, adds their influences to the series.
        estimate: `(item, out)`, sum of the influences over all levels and times.
        jacobian: `(item, sensor, out)`.
        levels: Indices of the levels that have an influence.
        n_levels: Number of levels J.
    """

    mapping: Tensor | None
    influence: Callable[[Tensor, int, Tensor], None]
    estimate: Tensor
    jacobian: Tensor
    levels: tuple[int, ...]
    n_levels: int


class Sweeps:
    """Sweeps over consecutive stretches of a recording, keeping the sums that complete its levels.

    Args:
        statistic: What is swept for.
        n_samples: Length of the recording.
        windows: Longest windows in a stretch: more of them look ahead less often, fewer hold less of a stream.
    """

    def __init__(self, statistic: Statistic, n_samples: int, *, windows: int) -> None:
        self._statistic = statistic
        self._n_samples, self._n_left = n_samples, n_samples
        longest = 2**statistic.n_levels
        self._step = 1 << max(1, n_samples // _FEWEST_STEPS).bit_length() - 1
        self._stretch = max(windows * longest, _SHORTEST_STRETCH, self._step)
        self._chunks: list[Tensor] = []
        self._n_held = 0
        self._sums: list[tuple[Tensor, Tensor]] = []

    def update(self, chunk: Tensor) -> Iterator[Tensor]:
        """Take in the next samples `(item, sensor, time)`; yield the series `(item, out, time)` as far as it goes."""
        self._chunks.append(chunk)
        self._n_held += chunk.shape[-1]
        overlap = 2**self._statistic.n_levels - 1
        done = self._n_held == self._n_left
        if not done and self._n_held <= self._stretch + overlap:
            return
        held = joined(self._chunks)
        while held.shape[-1] > self._stretch + overlap:
            yield self._sweep(held[..., : self._stretch + overlap], last=False)
            held = held[..., self._stretch :]
            self._n_left -= self._stretch
        if done:
            yield self._sweep(held, last=True)
            held = held[..., :0]
        self._chunks, self._n_held = [held], held.shape[-1]

    def covariance(self, mean: Tensor, covariance: Tensor) -> Tensor:
        """Second moment about the estimate over all draws, `(item, sensor, sensor)`.

        Args:
            mean: `(item, out)` of the series rebuilt from blocks.
            covariance: `(item, out, out)` of it.
        """
        bins, heads = (joined(parts) for parts in zip(*self._sums, strict=True))
        longest = 2**self._statistic.n_levels
        n_starts = (self._n_samples - longest + 1) // self._step + 1
        for level in self._statistic.levels:
            whole, part = divmod(longest - 2 ** (level + 1), self._step)  # D_j in bins
            total = pad(bins[level].cumsum(-1), (1, 0))
            ends = total[..., whole : whole + n_starts]
            if part:
                ends = ends + heads[level, ..., whole : whole + n_starts]
            extra_mean, extra_covariance = moments_over_starts(ends - total[..., :n_starts])
            mean, covariance = mean + extra_mean, covariance + extra_covariance
        bias = mean - self._statistic.estimate
        jacobian = self._statistic.jacobian
        return jacobian @ (covariance + bias[:, :, None] * bias[:, None, :]) @ jacobian.mT

    def _sweep(self, stretch: Tensor, *, last: bool) -> Tensor:
        series, bins, heads = _swept(stretch, self._statistic, self._step, last)
        self._sums.append((bins, heads))
        return series


def joined(parts: Sequence[Tensor]) -> Tensor:
    """Consecutive stretches of time as one; a copy only where there are several."""
    return parts[0] if len(parts) == 1 else torch.cat(tuple(parts), dim=-1)


def _swept(signal: Tensor, statistic: Statistic, step: int, last: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Sweep over a stretch `(item, sensor, time)` of at least `2**n_levels` samples.

    Where the recording goes on after it, only times whose longest window ends within the stretch are taken, which has
    to be a multiple of `step`, a power of two.

    Returns:
        The series `(item, out, time)` at the times that all levels share; sums over bins of `step` times,
        `(level, item, out, bin)`; and, for levels where this is not 0, sums over the first `D_j mod step` times of each
        bin, by which the stretches that complete a level are longer than some bins.
    """
    mapping, influence, estimate, _, levels, n_levels = statistic
    n_items, n_sensors, n_samples = signal.shape
    n_rows, n_out = n_sensors if mapping is None else mapping.shape[1], estimate.shape[1]
    n_shared = n_samples - 2**n_levels + 1
    n_taken = n_samples if last else n_shared
    wanted = [min(n_taken, n_samples - 2 ** (level + 1) + 1) for level in range(n_levels)]
    budget = max(1, _tile(signal.device) // (n_items * n_rows))
    n_short = max(levels) + 1
    if n_samples > 4 * budget:
        n_short = min(n_short, max(_SHORT_LEVELS, step.bit_length() - 1))
    phases = 2**n_short
    tile = n_samples if n_samples <= 4 * budget else max(4 * phases, 1 << budget.bit_length() - 1)
    tile += -tile % step
    padded = n_samples + -n_samples % max(phases, step)
    like: dict[str, Any] = {"dtype": torch.float64, "device": signal.device}
    series = torch.empty(n_items, n_out, padded, **like)
    bins = torch.zeros(n_levels, n_items, n_out, padded // step, **like)
    heads = torch.zeros(max(0, min(step.bit_length() - 1, n_levels) - 1), n_items, n_out, padded // step, **like)
    smooth = torch.empty(n_items, n_rows, padded, **like) if max(levels) >= n_short else None
    room = _Room(n_items * max(n_rows, n_sensors, n_out) * (tile + phases), like)
    offset = _mean(signal[..., :tile])  # no filter sees it; without it the rest keeps its digits

    for start in range(0, n_taken if smooth is None else n_samples, tile):
        h = series[..., start : start + tile].zero_()
        binned, which = h.unflatten(-1, (-1, step)), slice(start // step, (start + tile) // step)
        held = torch.zeros_like(binned[..., 0])
        part = signal[..., start : start + tile + phases - 1]
        v = torch.sub(part, offset, out=room(0, part.shape))
        if mapping is not None:
            v = torch.bmm(mapping, v, out=room(1, (n_items, n_rows, v.shape[-1])))
        for level in range(n_short):
            if v.shape[-1] <= 2**level:
                break
            d, v = _split(v, 2**level, -1, room)
            n = min(tile, wanted[level] - start)
            if n <= 0 or level not in levels:
                continue
            head = (2**n_levels - 2 ** (level + 1)) % step  # D_j mod step
            behind = binned[..., head:].sum(-1) if head else None
            influence(d[..., :n], level, h[..., :n])
            # What a level adds to the series is what its bins hold: one pass for both.
            before, held = held, binned.sum(-1)
            bins[level, ..., which] = held - before
            if behind is not None:
                heads[level, ..., which] = held - before - (binned[..., head:].sum(-1) - behind)
        else:
            if smooth is not None:
                n = min(tile, v.shape[-1])
                smooth[..., start : start + n] = v[..., :n]
    if smooth is not None:
        _long_levels(smooth, series, bins, statistic, n_short, wanted, step, budget)
    n_bins = padded // step if last else n_taken // step
    return series[..., :n_shared], bins[..., :n_bins], heads[..., :n_bins]


def _long_levels(
    smooth: Tensor,
    series: Tensor,
    bins: Tensor,
    statistic: Statistic,
    n_short: int,
    wanted: list[int],
    step: int,
    budget: int,
) -> None:
    """Go on from the smooth of the short levels, adding to the series and the bins.

    Time is (round, phase) with `2**n_short` phases: lags go from round to round, a tile is some phases of all rounds.
    """
    phases, n_out = 2**n_short, series.shape[1]
    smooth, series = smooth.unflatten(-1, (-1, phases)), series.unflatten(-1, (-1, phases))
    bins = bins.unflatten(-1, (-1, phases // step))  # (level, item, out, round, bin of the round)
    n_items, n_rows, n_rounds, _ = smooth.shape
    width = min(phases, 1 << max(1, budget // n_rounds).bit_length() - 1)
    n_bins = max(1, width // step)
    ones = smooth.new_ones(width // n_bins)
    room = _Room(n_items * max(n_rows, n_out) * n_rounds * width, {"dtype": smooth.dtype, "device": smooth.device})
    for first in range(0, phases, width):
        v = room(0, (n_items, n_rows, n_rounds, width)).copy_(smooth[..., first : first + width])
        h = room(1, (n_items, n_out, n_rounds, width)).copy_(series[..., first : first + width])
        which = slice(first // step, first // step + n_bins)
        held = h.unflatten(-1, (n_bins, -1)) @ ones
        for level in range(n_short, max(statistic.levels) + 1):
            d, v = _split(v, 2 ** (level - n_short), -2, room)
            if level not in statistic.levels:
                continue
            whole, rest = divmod(wanted[level], phases)
            n = whole + (rest > 0)
            if 0 < rest < first + width:
                d[..., whole, max(0, rest - first) :] = 0.0  # windows that go on past the end
            statistic.influence(d[..., :n, :], level, h[..., :n, :])
            before, held = held, h.unflatten(-1, (n_bins, -1)) @ ones
            bins[level, ..., which] += held - before
        series[..., first : first + width] = h


class _Room:
    """Memory that tiles use over and over: fresh memory costs more than the arithmetic."""

    def __init__(self, n: int, like: dict[str, Any]) -> None:
        self._buffers = [torch.empty(n, **like) for _ in range(3)]

    def __call__(self, which: int, shape: Sequence[int]) -> Tensor:
        return self._buffers[which][: math.prod(shape)].view(shape)


def _split(v: Tensor, lag: int, dim: int, room: _Room) -> tuple[Tensor, Tensor]:
    """Difference and sum of samples a lag apart: `v_{t+lag} - v_t` and `v_{t+lag} + v_t`, the latter in place."""
    n = v.shape[dim] - lag
    past, now = v.narrow(dim, 0, n), v.narrow(dim, lag, n)
    d = torch.sub(now, past, out=room(2, past.shape))
    return d, torch.add(d, past, alpha=2, out=past)


def _tile(device: torch.device) -> int:
    if device.type != "cpu":
        return _GPU_TILE
    return max(_CPU_TILE, _CPU_TILE_PER_THREAD * torch.get_num_threads())


def _mean(signal: Tensor) -> Tensor:
    known = torch.where(signal.isfinite(), signal, torch.nan).to(torch.float64)
    return known.nanmean(-1, keepdim=True).nan_to_num()
