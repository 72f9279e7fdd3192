"""Families of slow effects: what a step, a warm-up, or a lagging temperature of size one does to block means."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy.signal import lfilter
from torch import Tensor

from gyrofuse.mismatch.case import N_BLOCKS, Case, Scene
from gyrofuse.mismatch.slow import ordinates, slow_ordinates

_TIME_CONSTANTS = 24
_LAGS = 16


class Family(NamedTuple):
    """Templates of one mechanism.

    Attributes:
        name: Of the mechanism.
        templates: Ordinates of block means for a size of one, `(template, ordinate)`.
        places: What tells them apart, `(template,)`, samples: onset, time constant or lag.
        channel: Of a temperature, and its row.
        row: Likewise.
    """

    name: str
    templates: Tensor
    places: Tensor
    channel: str | None = None
    row: int = 0


def steps(case: Case) -> Family:
    """Steps at the edges of blocks and in their middles."""
    at = edges()
    middles = (at[:-1] + at[1:]) / 2
    onsets = torch.cat([torch.arange(1.0, N_BLOCKS), torch.arange(1.5, N_BLOCKS - 1)]).to(torch.float64)
    order = onsets.argsort()
    return Family("step", torch.cat([at, middles])[order], onsets[order] * case.block)


def warm_ups(case: Case, time_constants: Tensor | None = None) -> Family:
    """Decays `exp(-t / tau)` with time constants `(template,)`, samples; by default from half a block to the record."""
    if time_constants is None:
        time_constants = torch.logspace(
            math.log10(case.block / 2), math.log10(case.n_samples), _TIME_CONSTANTS, dtype=torch.float64
        )
    tau = time_constants[:, None]
    # The mean over a block, a geometric sum.
    mean = torch.expm1(-case.block / tau) / torch.expm1(-1 / tau) / case.block
    means = mean * (-torch.arange(N_BLOCKS) * case.block / tau).exp()
    return Family("warm_up_transient", ordinates(means), time_constants)


def temperatures(case: Case) -> list[Family]:
    """Each row of each temperature, with lags from none to a quarter of the record."""
    lags = torch.logspace(math.log10(case.block / 2), math.log10(case.n_samples / 4), _LAGS - 1, dtype=torch.float64)
    lags = torch.cat([torch.zeros(1, dtype=torch.float64), lags])
    return [temperature(case.scene, channel, row, lags, case.n_samples) for channel, row in temperature_rows(case)]


def temperature_rows(case: Case) -> list[tuple[str, int]]:
    """Names and rows of the channels that are temperatures, whole, and not constant."""
    return [
        (name, row)
        for name, values in case.scene.channels.items()
        if name.lower().startswith("temperature")
        for row, channel in enumerate(values.reshape(-1, values.shape[-1]))
        if bool(channel.isfinite().all()) and bool(channel.amax() > channel.amin())
    ]


def temperature(scene: Scene, channel: str, row: int, lags: Tensor, n_samples: int) -> Family:
    """One row with lags `(template,)` in samples."""
    paths = torch.stack([lagged(scene, channel, row, float(lag), n_samples) for lag in lags])
    return Family("temperature_drift", slow_ordinates(paths), lags, channel, row)


def lagged(scene: Scene, channel: str, row: int, lag: float, n_samples: int) -> Tensor:
    """Temperature of what follows a channel with a lag in samples, `tau dy/dt = x - y`, from equilibrium, `(time,)`."""
    x = scene.channels[channel]
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
