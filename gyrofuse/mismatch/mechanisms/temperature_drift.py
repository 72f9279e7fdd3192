"""Temperature drift: a bias that follows a temperature, at once or with a lag."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.case import N_BLOCKS, Case, Scene
from gyrofuse.mismatch.mechanism import Finding
from gyrofuse.mismatch.slow import cosines, ordinates
from gyrofuse.mismatch.slow_effect import (
    SlowEffect,
    estimate,
    log_factors,
    only,
    place,
    plausible,
    slow_finding,
    strong_scan,
)
from gyrofuse.mismatch.slow_families import lagged, temperature
from gyrofuse.mismatch.slow_scans import Scan, SlowLook, concerned

_PLACES = 48
_SURROGATES = 200
_BETTER = 2  # so many surrogates may do as well as the channel
_DECISIVE = 8.0  # nats that a channel must owe to its shape, for surrogates of the shape to tell anything


@dataclass(frozen=True, eq=False)
class TemperatureDrift(SlowEffect):
    """`x_i(t) = size_i (theta(t) - theta(0))`, `tau d theta / dt = T - theta`, in every sensor `i`.

    `theta` is what a part has whose heat follows the temperature `T` of a channel with the lag `tau`. A smooth channel
    fits a random walk by chance: beside the likelihood, surrogates of the channel with random phases must do worse.

    Attributes:
        size: Coefficients, `(sensor,)`, unit of the signal per unit of temperature.
        lag_s: `tau`, s; 0 for none.
        channel: Name of the channel.
        row: Its row.
    """

    name: ClassVar[str] = "temperature_drift"
    lag_s: float
    channel: str
    row: int

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        strong = strong_scan(case, cls.name, level)
        if strong is None:
            return None
        look, scan = strong.look, strong.scan
        if not _beats_surrogates(look, scan):
            return None
        channel, row = scan.family.channel or "", scan.family.row
        low, high = plausible(look, scan)
        lags = torch.linspace(low, high, _PLACES, dtype=torch.float64)
        found = estimate(look, scan, temperature(case.scene, channel, row, lags, case.n_samples))
        lag = place(found.place, case.scene.rate)
        if low == 0:
            lag = lag._replace(low=0.0)
        effect = cls(only(found.size, concerned(scan)), log_factors(scan), lag.value, channel, row)
        words = f"follows {channel}" + (f" with a lag of {lag.value:.3g} s" if lag.low > 0 else "")
        return slow_finding(
            case,
            strong,
            effect,
            found,
            words,
            {"lag": lag},
            size="coefficient",
            unit=f"{case.scene.measure}/K",
            channel=channel,
        )

    def path(self, n_samples: int, scene: Scene) -> Tensor:
        path = lagged(scene, self.channel, self.row, self.lag_s * scene.rate, n_samples)
        return path - path[0]


def _beats_surrogates(look: SlowLook, scan: Scan) -> bool:
    """Whether a channel's shape beyond its trend fits better than nearly all such shapes with random phases.

    The trend itself, which any drift has, is left out of both; where little is owed to the shape nothing can be said.
    """
    generator = torch.Generator().manual_seed(0)
    which = list(concerned(scan))
    y, variance = look.y[which], scan.fit.variance[which]
    t = torch.linspace(-1, 1, N_BLOCKS, dtype=torch.float64)
    left = scan.template @ cosines()
    left = left - (left @ t) / (t @ t) * t
    transform = torch.fft.rfft(left)
    turn = 2 * math.pi * torch.rand(_SURROGATES, len(transform), generator=generator, dtype=torch.float64)
    surrogates = torch.fft.irfft(transform * torch.polar(torch.ones_like(turn), turn), n=len(left))
    shapes, trend = ordinates(torch.cat([left[None], surrogates])), ordinates(t)
    slope = trend / variance / (trend.square() / variance).sum(-1, keepdim=True)  # (sensor, ordinate)
    y = y - (slope * y).sum(-1, keepdim=True) * trend
    shapes = shapes - (shapes @ slope.mT).mT[..., None] * trend  # (sensor, surrogate, ordinate)
    information = (shapes.square() / variance[:, None]).sum(-1)
    score = (shapes @ (y / variance)[..., None])[..., 0]
    gain = (score.square() / information).sum(0) / 2
    return float(gain[0]) < _DECISIVE or int((gain[1:] >= gain[0]).sum()) <= _BETTER
