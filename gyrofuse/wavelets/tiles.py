"""Sums of wavelet products over long recordings, one cache-sized tile of time after another.

The same pyramid as in `gyrofuse.wavelets.haar`, arranged so that the data cross the memory bus about once: a tile of
time passes through all levels while it is in cache, and the Gram product of its coefficients is taken there. What a
level needs of the past (the last `h = 2**level` samples of its smooth) is kept from tile to tile, so that chunks of any
length, and a whole recording in one go, add up to the same sums.

Inside, time comes before sensor (`(item, time, sensor)`): a lag is then an offset in contiguous memory and the Gram
product reads its operand once. The factor 1/2 of each level is left out until the end, where `4**-level` is exact.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import torch
from torch import Tensor

# Samples x sensors of one tile for each CPU thread (2**18): a tile and its coefficients take 4 MiB in float64 and stay
# in the last level of cache; smaller tiles would take more time for calls than they save.
_CPU_TILE = 262_144
# The same for a GPU: one tile takes 256 MiB, enough work for every multiprocessor at each level.
_GPU_TILE = 16_777_216
# Samples of a tile at least, however many recordings are advanced together: half of it is the longest lag within a
# tile.
_SHORTEST_TILE = 16


class WaveletProducts:
    """Running sums `sum_t W_t W_t'` per level and how many products each holds, carried from chunk to chunk.

    Args:
        n_items: Independent recordings advanced together.
        n_sensors: Sensors of each.
        n_levels: Levels J.
        length: Samples expected, where known; a short recording gets a short tile.
        bin_length: Keep the sums apart by bins of this many samples, a power of two; needs `length`. A coefficient
            belongs to the bin of its newest sample.
        dtype: Dtype of the arithmetic; sums and counts are float64.
        device: Where the tiles live.
    """

    def __init__(
        self,
        n_items: int,
        n_sensors: int,
        n_levels: int,
        *,
        dtype: torch.dtype,
        device: torch.device,
        length: int | None = None,
        bin_length: int | None = None,
    ) -> None:
        self.n_levels = n_levels
        self._shape = (n_items, n_sensors)
        self._like: dict[str, Any] = {"dtype": dtype, "device": device}
        self._tile = tile_length(n_items * n_sensors, device, length)
        self._bin_length = bin_length
        if bin_length is not None and length is not None:
            self._stripes, n_bins = max(1, self._tile // bin_length), -(-length // bin_length)
        else:
            # One product of this shape runs on one core: stripes of a tile keep the others busy.
            threads = torch.get_num_threads() if device.type == "cpu" else 1
            self._stripes = min(1 << (threads - 1).bit_length(), self._tile) if n_items < threads else 1
            n_bins = 1
        self._buffer = self._empty(self._tile // 2 + self._tile)
        self._coefficients = self._empty(self._tile)
        self._products = torch.empty(n_levels, n_items, self._stripes, n_sensors, n_sensors, **self._like)
        self._history = [self._empty(2**level) for level in range(min(n_levels, self._tile.bit_length() - 1))]
        self._look_into_buffer()
        self._queues: list[deque[Tensor]] = [deque() for _ in range(len(self._short), n_levels)]
        self._spare: Tensor | None = None
        self._offset: Tensor | None = None
        self._n_staged = 0
        self._time = 0  # samples before the staged ones
        self._flawed = -1  # no sample after this one is missing, of those in finished tiles
        shape = (n_levels, n_items, n_bins, n_sensors, n_sensors)
        self._sums = torch.zeros(shape, dtype=torch.float64, device=device)
        self._counts = torch.zeros_like(self._sums)

    def _look_into_buffer(self) -> None:
        """Views of the buffer: the tile, and for each lag within it the samples before, shifted and at its end."""
        tile, margin = self._tile, self._tile // 2
        self._staged = self._buffer[:, margin:]
        self._short = []
        for history in self._history:
            start = margin - history.shape[1]
            head, past = self._buffer[:, start:margin], self._buffer[:, start : start + tile]
            self._short.append((head, past, self._buffer[:, start + tile :], history))

    def __getstate__(self) -> dict[str, Any]:
        # A pickled view no longer shares its memory: make the views anew.
        return {name: value for name, value in self.__dict__.items() if name not in ("_staged", "_short")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._look_into_buffer()

    @property
    def n_samples(self) -> int:
        """Samples taken in so far."""
        return self._time + self._n_staged

    @property
    def device(self) -> torch.device:
        """Where the tiles live."""
        return self._sums.device

    def update(self, chunk: Tensor) -> None:
        """Take in the next samples `(item, sensor, time)`; non-finite ones are missing."""
        if chunk.shape[-1] == 0:
            return
        if self._offset is None:
            # Haar filters ignore a constant; removing one keeps the digits of what they do see.
            first = chunk[..., : self._tile].to(self._like["dtype"])
            mean = torch.where(first.isfinite(), first, torch.nan).nanmean(-1)
            self._offset = mean.nan_to_num()[:, None, :]
        taken = 0
        while taken < chunk.shape[-1]:
            n = min(self._tile - self._n_staged, chunk.shape[-1] - taken)
            rows = chunk[..., taken : taken + n].transpose(-1, -2)  # (item, time, sensor)
            staged = self._staged[:, self._n_staged : self._n_staged + n]
            torch.sub(rows.to(self._like["dtype"]), self._offset, out=staged)
            self._n_staged += n
            taken += n
            if self._n_staged == self._tile:
                sums, counts, self._flawed = self._run(self._tile, keep=True)
                bins = self._bins()
                self._sums[:, :, bins] += sums
                self._counts[:, :, bins] += counts
                self._time += self._tile
                self._n_staged = 0

    def totals(self) -> tuple[Tensor, Tensor]:
        """Sums of products (unit of the signal squared) and their counts, `(level, item, bin, sensor, sensor)`.

        Includes the samples of the unfinished tile, which stays unfinished.
        """
        sums, counts = self._sums.clone(), self._counts.clone()
        if self._n_staged:
            extra_sums, extra_counts, _ = self._run(self._n_staged, keep=False)
            bins = self._bins()
            n = sums[:, :, bins].shape[2]  # the last stripes may lie beyond the end
            sums[:, :, bins] += extra_sums[:, :, :n]
            counts[:, :, bins] += extra_counts[:, :, :n]
        levels = torch.arange(1, self.n_levels + 1, dtype=torch.float64, device=self.device)
        return sums * torch.exp2(-2 * levels)[:, None, None, None, None], counts

    def _bins(self) -> slice:
        """Bins that the stripes of the tile at hand belong to."""
        if self._bin_length is None:
            return slice(0, 1)
        first = self._time // self._bin_length
        return slice(first, first + self._stripes)

    def _empty(self, n: int) -> Tensor:
        n_items, n_sensors = self._shape
        return torch.empty(n_items, n, n_sensors, **self._like)

    def _run(self, n: int, *, keep: bool) -> tuple[Tensor, Tensor, int]:
        """Pass the first `n` staged samples through the levels; `keep` makes a full tile part of the past.

        Returns the sums and counts of each stripe, where bins are asked for, else of the tile, and the last sample
        before which one may be missing.
        """
        tile = self._tile
        staged = None if keep else self._staged[:, :n].clone()
        smooth, coefficients = self._staged[:, :n], self._coefficients[:, :n]
        # One look at each tile tells which levels have to mind missing samples.
        flawed = self._flawed if bool(smooth.sum().isfinite()) else self._time + n - 1
        self._products.zero_()
        counts = torch.zeros(self._products.shape, dtype=torch.float64, device=self.device)
        stripe = tile // self._stripes
        for level in range(self.n_levels):
            lag = 2**level
            if lag < tile:
                # The past of a lag within the tile: what was kept of the tile before, put in front of this one.
                head, past, tail, history = self._short[level]
                head.copy_(history)
                if keep:
                    history.copy_(tail)
                else:
                    past = past[:, :n]
            else:
                # The past of a longer lag is a tile of its own, the oldest in a queue.
                queue = self._queues[level - len(self._short)]
                if keep:
                    queue.append(smooth)
                if len(queue) < lag // tile + keep:
                    break
                past = queue.popleft() if keep else queue[0][:, :n]
            # The first window that lies wholly inside the recording ends at sample 2 * lag - 1.
            first = max(0, 2 * lag - 1 - self._time)
            if first >= n:
                break
            torch.sub(smooth, past, out=coefficients)
            # Whole stripes, with nothing in them that is no window of the recording.
            end = -(-n // stripe) * stripe
            self._coefficients[:, :first].zero_()
            self._coefficients[:, n:end].zero_()
            if flawed > self._time + first - 2 * lag:
                known = self._coefficients[:, :end].isfinite()
                self._multiply(torch.where(known, self._coefficients[:, :end], 0.0), self._products[level])
                known[:, :first] = False
                known[:, n:] = False
                self._multiply(known.to(coefficients.dtype), counts[level])
            else:
                self._multiply(self._coefficients[:, :end], self._products[level])
                starts = torch.arange(0, tile, stripe, dtype=torch.float64, device=self.device)
                complete = starts.add(stripe).clamp(max=n) - starts.clamp(min=first)
                counts[level] = complete.clamp(min=0)[:, None, None]
            if level + 1 == self.n_levels:
                if keep and lag >= tile:
                    self._spare = past
            elif 2 * lag < tile:
                # smooth + past = 2 smooth - coefficients, with the sign turned (no product minds): in place, so that
                # one tile and its coefficients are all that has to stay in cache.
                torch.sub(coefficients, smooth, alpha=2, out=smooth)
            elif not keep:
                smooth = smooth + past
            elif lag < tile:
                # The queues own their tiles: take the one that left the last queue, or a new one.
                spare, self._spare = self._spare, None
                smooth = torch.add(smooth, past, out=self._empty(tile) if spare is None else spare)
            else:
                smooth = past.add_(smooth)
        if staged is not None:
            self._staged[:, :n].copy_(staged)
        if self._bin_length is None or self._stripes == 1:
            return self._products.sum(2, True, dtype=torch.float64), counts.sum(2, True), flawed
        return self._products.double(), counts, flawed

    def _multiply(self, rows: Tensor, products: Tensor) -> None:
        """Write the products `(item, stripe, sensor, sensor)` of `(item, time, sensor)` rows of whole stripes."""
        n_items, n, n_sensors = rows.shape
        stripe = self._tile // self._stripes
        n_stripes = n // stripe
        striped = rows.reshape(n_items * n_stripes, stripe, n_sensors)
        products[:, :n_stripes] = _gram(striped).view(n_items, n_stripes, n_sensors, n_sensors)


def _gram(coefficients: Tensor) -> Tensor:
    """`W' W` of `(item, time, sensor)`, `(item, sensor, sensor)`."""
    if coefficients.shape[-1] == 1:
        return torch.linalg.vector_norm(coefficients, dim=1).square()[..., None]
    return torch.bmm(coefficients.transpose(1, 2), coefficients)


def tile_length(n_series: int, device: torch.device, length: int | None) -> int:
    """Samples of a tile: a power of two that fits the cache, no longer than the recording needs."""
    budget = _CPU_TILE * torch.get_num_threads() if device.type == "cpu" else _GPU_TILE
    tile = max(_SHORTEST_TILE, 1 << max(budget // max(n_series, 1), 1).bit_length() - 1)
    if length is not None:
        tile = min(tile, max(_SHORTEST_TILE, 1 << (length - 1).bit_length()))
    return tile
