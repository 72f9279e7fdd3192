"""Finite responses from rows of channels to sensors, by least squares on whitened samples.

`y_i(t) = sum_k sum_l h_ikl a_k(t - l) + noise_i`, `l` from `-L` to `L`. Sensors and rows pass one filter, which makes
the noise that the mean sensor has in the recording white, and leaves `h` as it is. A ridge keeps what the rows do not
move from being guessed. All sums are kept block by block, so that every fold, set of rows and reach is solved from the
same ones.

What is slower than a block of a 256th of the record is left out: any two things that drift look alike there, and a
response of a few samples cannot be told from a gain.

The score of the blocks held out is a log likelihood ratio with numbers that they had no part in: its exponential is an
e-value, in each fold and sensor, and so is the mean over these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates, fast_length
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, held_out_blocks, in_fold
from gyrofuse.mismatch.signals.lines import with_factors
from gyrofuse.mismatch.signals.psd import between_bands, narrow_bands


@dataclass(frozen=True, eq=False)
class ResponseSums:
    """Sums over the samples of each block.

    Attributes:
        reach: `L`.
        gram: Products of lagged rows, `(block, row * lag, row * lag)`, the earliest lag first.
        moment: Of sensors with lagged rows, `(block, sensor, row * lag)`.
        power: Squares of sensors, `(block, sensor)`.
        count: Samples, `(block,)`.
    """

    reach: int
    gram: Tensor
    moment: Tensor
    power: Tensor
    count: Tensor

    @classmethod
    def of(cls, comparison: Comparison, rows: Tensor, reach: int) -> ResponseSums:
        """Those of a recording and rows `(row, time)`."""
        signal = comparison.recording - comparison.recording.mean(-1, keepdim=True)
        rows = rows - rows.mean(-1, keepdim=True)
        found = cls._whitened(comparison, signal, rows, reach, _smooth_density(comparison, signal))
        for _ in range(2):  # what a strong effect adds to the spectrum is no noise
            left = signal - responded(found.solved(range(len(rows)), reach).taps, rows)
            found = cls._whitened(comparison, signal, rows, reach, _smooth_density(comparison, left))
        return found

    @classmethod
    def _whitened(
        cls, comparison: Comparison, signal: Tensor, rows: Tensor, reach: int, density: Tensor
    ) -> ResponseSums:
        y, a = (with_factors(x, _whitening(density)) for x in (signal, rows))
        n_lags, block = 2 * reach + 1, comparison.n_samples // N_JUDGED
        most = 2**16  # samples whose lagged rows are in memory at once
        gram, moment, power, counts = [], [], [], []
        for k in range(N_JUDGED):
            first, last = max(k * block, reach), min((k + 1) * block, comparison.n_samples - reach)
            own = torch.zeros(len(a) * n_lags, len(a) * n_lags, dtype=torch.float64)
            cross = torch.zeros(len(y), len(own), dtype=torch.float64)
            for start in range(first, last, most):
                stop = min(start + most, last)
                # a(t - l) with l from -L to L: the last sample of a window is a(t + L).
                lagged = a[:, start - reach : stop + reach].unfold(-1, n_lags, 1).flip(-1)  # (row, time, lag)
                design = lagged.movedim(1, 0).flatten(1)
                own += design.mT @ design
                cross += y[:, start:stop] @ design
            gram.append(own)
            moment.append(cross)
            power.append(y[:, first:last].square().sum(-1))
            counts.append(last - first)
        return cls(reach, torch.stack(gram), torch.stack(moment), torch.stack(power), torch.tensor(counts))

    def solved(self, rows: Sequence[int], reach: int, fold: int | None = None) -> FiniteResponse:
        """Responses to some rows, of a reach up to that of the sums, without a fold of blocks."""
        at = self._places(rows, reach)
        kept = torch.ones(N_JUDGED, dtype=torch.bool) if fold is None else ~in_fold(N_JUDGED, fold)
        gram, moment = self.gram[kept].sum(0)[at][:, at], self.moment[kept].sum(0)[:, at]
        ridge = 1e-4  # of the mean square of each whitened row
        inverse = torch.linalg.inv(gram + ridge * torch.diag(gram.diagonal().clamp(min=1e-300)))
        taps = moment @ inverse
        free = max(int(self.count[kept].sum()) - len(at), 1)
        left = (self.power[kept].sum(0) - (moment * taps).sum(-1)).clamp(min=1e-300) / free
        shape = (len(taps), len(rows), 2 * reach + 1)
        return FiniteResponse(taps.view(shape), inverse, left)

    def held_out(self, rows: Sequence[int], reach: int, *, shared: bool = False) -> Tensor:
        """Log likelihood ratios of the blocks of each fold, numbers of the others, `(fold, sensor)`, nats.

        Of the nearest product of gains and one response, where that is to be `shared` by all sensors and rows.
        """
        at, scores = self._places(rows, reach), []
        for fold in range(N_FOLDS):
            found = self.solved(rows, reach, fold)
            taps = _product(found.taps) if shared else found.taps
            scores.append(self._gained(taps, at, found.variance, fold).sum(0))
        return torch.stack(scores)

    def _gained(self, taps: Tensor, at: Tensor, variance: Tensor, fold: int) -> Tensor:
        """The same in each block and sensor `(block, sensor)` beside white noise of a variance."""
        judged, h = in_fold(N_JUDGED, fold), taps.flatten(1)
        moment, gram = self.moment[judged][:, :, at], self.gram[judged][:, at][:, :, at]
        return ((h * moment).sum(-1) - ((h @ gram) * h).sum(-1) / 2) / variance

    def _places(self, rows: Sequence[int], reach: int) -> Tensor:
        lags = torch.arange(self.reach - reach, self.reach + reach + 1)
        return (torch.tensor(list(rows))[:, None] * (2 * self.reach + 1) + lags).flatten()


@dataclass(frozen=True, eq=False)
class FiniteResponse:
    """Responses with their uncertainty.

    Attributes:
        taps: `h`, `(sensor, row, lag)`, the earliest lag first.
        inverse: Covariance of taps in units of a sensor's noise, `(row * lag, row * lag)`.
        variance: Of the whitened noise, `(sensor,)`.
    """

    taps: Tensor
    inverse: Tensor
    variance: Tensor


def responded(taps: Tensor, rows: Tensor) -> Tensor:
    """What sensors do, `(sensor, time)`, as rows `(row, time)` move; rows stay as they are beyond a record's ends."""
    reach, n = taps.shape[-1] // 2, rows.shape[-1]
    padded = torch.cat([rows[:, :1].expand(-1, reach), rows, rows[:, -1:].expand(-1, reach)], -1)
    length = fast_length(n + 4 * reach)
    response = torch.fft.rfft(taps.to(torch.float64), n=length)  # (sensor, row, bin)
    moved = torch.einsum("ikf,kf->if", response, torch.fft.rfft(padded, n=length))
    return torch.fft.irfft(moved, n=length)[:, 2 * reach : 2 * reach + n]


def _product(taps: Tensor) -> Tensor:
    """The nearest product of gains `(sensor, row)` and one response `(lag,)`."""
    u, s, v = torch.linalg.svd(taps.flatten(0, 1), full_matrices=False)
    return (s[0] * u[:, :1] * v[:1]).view_as(taps)


def path_gains(comparison: Comparison, path: Tensor, fold: int) -> Tensor:
    """Log likelihood ratio of a path `(sensor, time)` in each block of a fold, in the noise it leaves, `(block,)`."""
    signal, path = (x - x.mean(-1, keepdim=True) for x in (comparison.recording, path))
    factor = _whitening(_smooth_density(comparison, signal - path))
    y, s = (with_factors(x, factor) for x in (signal, path))
    variance = (y - s).square().mean(-1, keepdim=True)
    return held_out_blocks((y * s - s.square() / 2) / variance, fold).sum((0, -1))


def response_at(taps: Tensor, f: float) -> Tensor:
    """Complex gains `(sensor, row)` at `f` cycles per sample."""
    reach = taps.shape[-1] // 2
    lags = torch.arange(-reach, reach + 1, dtype=torch.float64)
    return taps.to(torch.complex128) @ torch.polar(torch.ones_like(lags), -2 * math.pi * f * lags)


def _whitening(density: Tensor) -> Tensor:
    """Factors of cosine ordinates that leave noise of a density white but for what is slow."""
    factors = density.rsqrt()
    factors[:N_BLOCKS] = 0.0
    return factors


def _smooth_density(comparison: Comparison, signal: Tensor) -> Tensor:
    """Density of the mean sensor at cosine ordinates, smooth over bands, `(ordinate,)`: geometric means of sensors."""
    n, narrow = comparison.n_samples, narrow_bands(comparison.n_samples)
    power = cosine_ordinates(signal)[:, 1:].square()
    edges = torch.tensor([1, *(2 * edge for edge in narrow.edges[1:-1]), n])
    ordinate = torch.arange(1, n)
    band = torch.bucketize(ordinate, edges[1:-1], right=True)
    sums = torch.zeros(len(power), len(edges) - 1, dtype=torch.float64).index_add(1, band, power)
    level = (sums / torch.bincount(band, minlength=len(edges) - 1).clamp(min=1)).clamp(min=1e-300).log().mean(0)
    middle = (edges[:-1] + edges[1:]).to(torch.float64) / 2
    return between_bands(level, middle, torch.arange(n, dtype=torch.float64)).exp()
