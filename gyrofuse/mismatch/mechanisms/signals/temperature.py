"""Temperature drift: a bias that follows a temperature, at once or with a lag."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.scans import Scan, SlowLook, concerned
from gyrofuse.mismatch.likelihoods.slow_noise import cosines, ordinates
from gyrofuse.mismatch.likelihoods.slow_templates import lagged
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.signals.slow_effect import (
    SlowEffect,
    estimate,
    log_factors,
    only,
    place,
    slow_finding,
    strong_scan,
)
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_SURROGATES = 200
_BETTER = 2  # so many surrogates may do as well as the channel
_RECORDS, _USUAL = 100, 0.9  # of sensors that follow the channel: so many of them are no less like it
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
    rivals: ClassVar[tuple[str, ...]] = ("step", "warm_up_transient")
    separated_by: ClassVar[str] = "a recording with temperature, over a temperature that goes up and down"
    lag_s: float
    channel: str
    row: int
    curvature: tuple[OfSensors, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None:
            return None
        look, scan = strong.look, strong.scan
        if not _beats_surrogates(look, scan):
            return None
        found = estimate(look, scan)
        effect, lag = cls.of(scan, comparison.info.rate), place(found.place, comparison.info.rate)
        if not effect.curvature:
            effect = replace(effect, size=only(found.size[:, 0], concerned(scan)), lag_s=lag.value)
        lag = lag._replace(value=effect.lag_s)
        words = f"follows {effect.channel}" + (f" with a lag of {lag.value:.3g} s" if lag.low > 0 else "")
        unit = comparison.info.measure
        return slow_finding(
            comparison,
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

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        channel = lagged(
            comparison.info, self.channel, self.row, self.lag_s * comparison.info.rate, comparison.n_samples
        )
        path = self._effect(comparison.n_samples, comparison.info) if fitted else None
        label = f"{self.channel}, with the lag" if self.lag_s else self.channel
        pictures.means_against(ax, comparison, sensor, channel, label, path)

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        path = lagged(info, self.channel, self.row, self.lag_s * info.rate, n_samples)
        path = path - path[0]
        return torch.stack([path, *(path.square() for _ in self.curvature)])


def _beats_surrogates(look: SlowLook, scan: Scan) -> bool:
    """Whether a channel's shape beyond its trend fits better than nearly all such shapes with random phases.

    The trend itself, which any drift has, is left out of both; where little is owed to the shape nothing can be said.
    A shape that is nearly one wave has many surrogates that hardly differ from it, and in many sensors any shape has
    many sizes to fit noise with: some do as well by chance where all sensors follow the channel. Where they fare no
    better, all together, than they would then, they are no reason against it.
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
    z, axes = _without_trend(y, variance, shapes, trend)
    gain = z.square().sum(0) / 2
    if float(gain[0]) < _DECISIVE or int((gain[1:] >= gain[0]).sum()) <= _BETTER:
        return True
    # Sizes of all sensors together are overestimated by their own scatter.
    followed = z[:, 0] * math.sqrt(max(1 - len(which) / (2 * float(gain[0])), 0.0))
    noise = torch.randn(_RECORDS, *y.shape, generator=generator, dtype=torch.float64)
    records = followed[:, None] * axes[:, 0] + noise  # (record, sensor, ordinate), in standard deviations
    if_followed = (records.movedim(0, 1) @ axes.mT).square().sum(0) / 2  # (record, shape)
    return float(_of_any_shape(gain)) <= float(_of_any_shape(if_followed).quantile(_USUAL))


def _of_any_shape(gain: Tensor) -> Tensor:
    """Logarithm of the surrogates' likelihoods, summed, over the channel's, by gains `(..., shape)`; it comes first."""
    return gain[..., 1:].logsumexp(-1) - gain[..., 0]


def _without_trend(y: Tensor, variance: Tensor, shapes: Tensor, trend: Tensor) -> tuple[Tensor, Tensor]:
    """Sizes of shapes `(shape, ordinate)` beside a trend, in standard deviations, and their whitened unit vectors.

    Returns:
        `(sensor, shape)` and `(sensor, shape, ordinate)`.
    """
    sd = variance.sqrt()
    white = shapes / sd[:, None]
    line = torch.nn.functional.normalize(trend / sd, dim=-1)[:, :, None]  # (sensor, ordinate, 1)
    axes = torch.nn.functional.normalize(white - (white @ line) * line.mT, dim=-1)
    return (axes @ (y / sd)[..., None])[..., 0], axes
