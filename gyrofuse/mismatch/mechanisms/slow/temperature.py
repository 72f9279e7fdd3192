"""Temperature drift: a bias that follows a temperature, at once or with a lag."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.estimates import estimate, log_factors, only
from gyrofuse.mismatch.detectors.slow.scans import Scan
from gyrofuse.mismatch.detectors.slow.surrogates import beats_surrogates
from gyrofuse.mismatch.likelihoods.slow_templates import Family, lagged, temperatures
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect, in_seconds, slow_finding, strong_scan
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
    def families(cls, comparison: Comparison) -> Iterable[Family]:
        return temperatures(comparison)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        strong = strong_scan(comparison, cls.name, level)
        if strong is None:
            return None
        analysis, scan = strong.analysis, strong.scan
        if not beats_surrogates(analysis, scan, comparison.generator()):
            return None
        found = estimate(analysis, scan)
        effect, lag = cls.of(scan, comparison.info.rate), in_seconds(found.points[0], comparison.info.rate)
        if not effect.curvature:
            effect = replace(effect, size=only(found.size[:, 0], scan.sensors), lag_s=lag.value)
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
        """The best of a scan, in its sensors or in others."""
        size, *further = only(scan.fit.size, scan.sensors if which is None else which).unbind(-1)
        family = scan.family
        return cls(size, log_factors(scan), scan.point[0] / rate, family.channel or "", family.row, tuple(further))

    @property
    def follows(self) -> tuple[str, ...]:
        return (self.channel,)

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
