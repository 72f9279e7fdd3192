"""Families of slow effects: what a step, a warm-up, or a lagging temperature of size one does to block means."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from scipy.signal import lfilter
from torch import Tensor

from gyrofuse.mismatch.likelihoods.slow_noise import ordinates, slow_ordinates
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo

_TIME_CONSTANTS = 24
_LAGS = 16
_APART = 2  # places of the grid between two time constants


def _no_more(*_places: Tensor) -> Family:
    raise NotImplementedError("a family without places between its own")


class Family(NamedTuple):
    """Templates of one mechanism.

    Attributes:
        name: Of the mechanism.
        templates: Ordinates of block means for a size of one, `(template, ordinate)`.
        places: What tells them apart, `(template,)`, samples: onset, time constant or lag.
        channel: Of a temperature, and its row.
        row: Likewise.
        beside: A second path of the same physics with a size of its own, for each template; None for none.
        others: Its places, where it has its own.
        at: The family of other places, and others; that of steps has no more.
    """

    name: str
    templates: Tensor
    places: Tensor
    channel: str | None = None
    row: int = 0
    beside: Tensor | None = None
    others: Tensor | None = None
    at: Callable[..., Family] = _no_more

    @property
    def where(self) -> list[Tensor]:
        """Places, and others where there are."""
        return [self.places] if self.others is None else [self.places, self.others]

    @property
    def designs(self) -> Tensor:
        """All paths of each template, `(template, column, ordinate)`."""
        return torch.stack([self.templates] if self.beside is None else [self.templates, self.beside], 1)


def steps(comparison: Comparison) -> Family:
    """Steps at the edges of blocks and in their middles."""
    at = edges()
    middles = (at[:-1] + at[1:]) / 2
    onsets = torch.cat([torch.arange(1.0, N_BLOCKS), torch.arange(1.5, N_BLOCKS - 1)]).to(torch.float64)
    order = onsets.argsort()
    return Family("step", torch.cat([at, middles])[order], onsets[order] * comparison.block)


def warm_ups(comparison: Comparison, time_constants: Tensor | None = None) -> Family:
    """Decays `exp(-t / tau)` with time constants `(template,)`, samples; by default from half a block to the record."""
    return _decays(comparison.block, _time_constants(comparison) if time_constants is None else time_constants)


def double_warm_ups(comparison: Comparison) -> Family:
    """Sums of two decays, of a part and of what it stands in, `others` the slower one; samples."""
    grid = _time_constants(comparison)
    fast, slow = torch.triu_indices(len(grid), len(grid), _APART)
    return _decays(comparison.block, grid[fast], grid[slow])


def _time_constants(comparison: Comparison) -> Tensor:
    low, high = math.log10(comparison.block / 2), math.log10(comparison.n_samples)
    return torch.logspace(low, high, _TIME_CONSTANTS, dtype=torch.float64)


def _decays(block: int, time_constants: Tensor, others: Tensor | None = None) -> Family:
    """Decays in blocks of so many samples, a second one beside each where `others` has its time constant."""
    templates, *beside = (_decay(block, tau) for tau in (time_constants, others) if tau is not None)
    at = partial(_decays, block)
    return Family("warm_up_transient", templates, time_constants, None, 0, beside[0] if beside else None, others, at)


def _decay(block: int, time_constants: Tensor) -> Tensor:
    tau = time_constants[:, None]
    # The mean over a block, a geometric sum.
    mean = torch.expm1(-block / tau) / torch.expm1(-1 / tau) / block
    return ordinates(mean * (-torch.arange(N_BLOCKS) * block / tau).exp())


def temperatures(comparison: Comparison) -> list[Family]:
    """Each row of each temperature, in a straight line and a bent one, with lags up to a quarter of the record."""
    lags = torch.logspace(
        math.log10(comparison.block / 2), math.log10(comparison.n_samples / 4), _LAGS - 1, dtype=torch.float64
    )
    lags = torch.cat([torch.zeros(1, dtype=torch.float64), lags])
    return [
        temperature(comparison.info, channel, row, comparison.n_samples, bent, lags)
        for channel, row in temperature_rows(comparison)
        for bent in (False, True)
    ]


def temperature_rows(comparison: Comparison) -> list[tuple[str, int]]:
    """Names and rows of the channels that are temperatures, whole, and not constant."""
    return [
        (name, row)
        for name, values in comparison.info.channels.items()
        if name.lower().startswith("temperature")
        for row, channel in enumerate(values.reshape(-1, values.shape[-1]))
        if bool(channel.isfinite().all()) and bool(channel.amax() > channel.amin())
    ]


def temperature(info: RecordingInfo, channel: str, row: int, n_samples: int, bent: bool, lags: Tensor) -> Family:
    """One row with lags `(template,)` in samples, its square beside it where it may be bent."""
    paths = torch.stack([lagged(info, channel, row, float(lag), n_samples) for lag in lags])
    paths = paths - paths[:, :1]
    squares = slow_ordinates(paths.square()) if bent else None
    at = partial(temperature, info, channel, row, n_samples, bent)
    return Family("temperature_drift", slow_ordinates(paths), lags, channel, row, squares, at=at)


def lagged(info: RecordingInfo, channel: str, row: int, lag: float, n_samples: int) -> Tensor:
    """Temperature of what follows a channel with a lag in samples, `tau dy/dt = x - y`, from equilibrium, `(time,)`."""
    x = info.channels[channel]
    x = x.reshape(-1, x.shape[-1])[row].to(torch.float64)
    if len(x) < n_samples:
        raise ValueError(
            f"`channels`: expected {channel!r} at {n_samples} samples or more, got {len(x)}; "
            "give it for the whole record"
        )
    x = x[:n_samples]
    if not lag:
        return x
    keeps = math.exp(-1 / lag)
    y, _ = lfilter([1 - keeps], [1, -keeps], x.numpy(), zi=[keeps * float(x[0])])
    return torch.from_numpy(y)


def edges() -> Tensor:
    """Steps at every edge of blocks, `(edge, ordinate)`."""
    place = torch.arange(N_BLOCKS)
    return ordinates((place >= place[1:, None]).to(torch.float64))
