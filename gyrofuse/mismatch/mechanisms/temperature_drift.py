"""Temperature drift: a bias that follows a temperature, at once or with a lag."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.axes import OfSensors
from gyrofuse.mismatch.case import N_BLOCKS, Case, Scene
from gyrofuse.mismatch.mechanism import Finding
from gyrofuse.mismatch.slow import cosines, ordinates
from gyrofuse.mismatch.slow_effect import (
    SlowEffect,
    estimate,
    log_factors,
    only,
    place,
    slow_finding,
    strong_scan,
)
from gyrofuse.mismatch.slow_families import lagged
from gyrofuse.mismatch.slow_scans import Scan, SlowLook, concerned

_SURROGATES = 200
_BETTER = 2  # so many surrogates may do as well as the channel
_DECISIVE = 8.0  # nats that a channel must owe to its shape, for surrogates of the shape to tell anything


@dataclass(frozen=True, eq=False)
class TemperatureDrift(SlowEffect):
    """`x_i(t) = size_i u(t) + curvature_i u(t)^2`, `u = theta(t) - theta(0)`, in every sensor `i`.

    `theta` is what a part has whose heat follows the temperature `T` of a channel with the lag `tau`:
    `tau d theta / dt = T - theta`. A smooth channel fits a random walk by chance: beside the likelihood, surrogates of
    the channel with random phases must do worse.

    Attributes:
        size: Coefficients, `(sensor,)`, unit of the signal per unit of temperature.
        lag_s: `tau`, s; 0 for none.
        channel: Name of the channel.
        row: Its row.
        curvature: Of the square, `(sensor,)`, unit of the signal per unit of temperature squared; none where the line
            is straight.
    """

    name: ClassVar[str] = "temperature_drift"
    lag_s: float
    channel: str
    row: int
    curvature: tuple[OfSensors, ...] = ()

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        strong = strong_scan(case, cls.name, level)
        if strong is None:
            return None
        look, scan = strong.look, strong.scan
        if not _beats_surrogates(look, scan):
            return None
        found = estimate(look, scan)
        effect, lag = cls.of(scan, case.scene.rate), place(found.place, case.scene.rate)
        if not effect.curvature:
            effect = replace(effect, size=only(found.size[:, 0], concerned(scan)), lag_s=lag.value)
        lag = lag._replace(value=effect.lag_s)
        words = f"follows {effect.channel}" + (f" with a lag of {lag.value:.3g} s" if lag.low > 0 else "")
        unit = case.scene.measure
        return slow_finding(
            case,
            strong,
            effect,
            found,
            words + (", in a line that is bent" if effect.curvature else ""),
            {"lag": lag},
            sizes=[("coefficient", f"{unit}/K"), ("curvature", f"{unit}/K^2")],
            channel=effect.channel,
        )

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> TemperatureDrift:
        """The best of a scan, in the sensors concerned or in others."""
        size, *further = only(scan.fit.size, concerned(scan) if which is None else which).unbind(-1)
        family = scan.family
        return cls(size, log_factors(scan), scan.place / rate, family.channel or "", family.row, tuple(further))

    @property
    def sizes(self) -> Tensor:
        return torch.stack([self.size, *self.curvature], -1)

    def with_sizes(self, sizes: Tensor) -> TemperatureDrift:
        size, *further = sizes.unbind(-1)
        return replace(self, size=size, curvature=tuple(further))

    def paths(self, n_samples: int, scene: Scene) -> Tensor:
        path = lagged(scene, self.channel, self.row, self.lag_s * scene.rate, n_samples)
        path = path - path[0]
        return torch.stack([path, *(path.square() for _ in self.curvature)])


def _beats_surrogates(look: SlowLook, scan: Scan) -> bool:
    """Whether a channel's shape beyond its trend fits better than nearly all such shapes with random phases.

    The trend itself, which any drift has, is left out of both; where little is owed to the shape nothing can be said.
    """
    generator = torch.Generator().manual_seed(0)
    which = list(concerned(scan))
    y, variance = look.y[which], scan.fit.variance[which]
    t = torch.linspace(-1, 1, N_BLOCKS, dtype=torch.float64)
    # What several paths do together, as in the sensor that shows it best.
    best = max(which, key=lambda i: float(scan.z[i].norm()))
    left = scan.fit.size[best] @ scan.design @ cosines()
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
