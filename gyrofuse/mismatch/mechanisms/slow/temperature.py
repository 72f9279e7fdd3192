"""Temperature drift: a bias that follows a temperature, at once or with a lag."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.estimates import estimate, log_factors, only
from gyrofuse.mismatch.detectors.slow.scans import Scan
from gyrofuse.mismatch.detectors.slow.surrogates import beats_surrogates
from gyrofuse.mismatch.likelihoods.slow_templates import Family, ThermalForm, lagged, temperatures
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.slow.slow_effect import SlowEffect, in_seconds, slow_finding, strong_scan
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors


@dataclass(frozen=True, eq=False)
class TemperatureDrift(SlowEffect):
    """`x_i(t) = size_i u(t) + curvature_i u(t)^2 + cubic_i u(t)^3`, `u = theta(t) - theta(0)`, in every sensor `i`.

    `theta` is what a part has whose heat follows the temperature `T` of a channel with the lag `tau`:
    `tau d theta / dt = T - theta`. Where the way counts by which a temperature was reached, and not in all sensors
    alike, `u = T(t) - T(0)` instead, and `change_i d theta / dt` is added, as if `T` had changed at its first rate
    before the record as well. A smooth channel fits a random walk by chance: beside the likelihood, surrogates of the
    channel with random phases must do worse.

    Attributes:
        size: Coefficients, `(sensor,)`, unit of the signal per unit of temperature.
        lag_s: `tau`, s; 0 for none.
        channel: Name of the channel.
        row: Its row.
        curvature: Of the square and of the cube, `(sensor,)` each, unit of the signal per unit of temperature to that
            power; none where the line is straight.
        change: Of the rate of change, `(sensor,)`, unit of the signal per unit of temperature and second; none where
            that adds nothing.
    """

    name: ClassVar[str] = "temperature_drift"
    rivals: ClassVar[tuple[str, ...]] = ("step", "warm_up_transient")
    separated_by: ClassVar[str] = "a recording with temperature, over a temperature that goes up and down"
    lag_s: float
    channel: str
    row: int
    curvature: tuple[OfSensors, ...] = ()
    change: tuple[OfSensors, ...] = ()

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
        found = found._replace(sd=found.sd * _per_second(scan, comparison.info.rate))
        effect, lag = cls.of(scan, comparison.info.rate), in_seconds(found.points[0], comparison.info.rate)
        if effect.form == ThermalForm(1, changes=False):
            effect = replace(effect, size=only(found.size[:, 0], scan.sensors), lag_s=lag.value)
        lag = lag._replace(value=effect.lag_s)
        words = f"follows {effect.channel}"
        if effect.change:
            words += " and its rate of change"
        elif lag.low > 0:
            words += f" with a lag of {lag.value:.3g} s"
        unit = comparison.info.measure
        powers = [("coefficient", f"{unit}/K"), ("curvature", f"{unit}/K^2"), ("cubic", f"{unit}/K^3")]
        return slow_finding(
            comparison,
            strong,
            effect,
            found,
            words + (", in a line that is bent" if effect.curvature else ""),
            {"lag": lag},
            sizes=[*powers[: effect.form.powers], ("change", f"{unit} per K/s")],
            channel=effect.channel,
        )

    @classmethod
    def of(cls, scan: Scan, rate: float, which: Sequence[int] | None = None) -> TemperatureDrift:
        """The best of a scan, in its sensors or in others."""
        family = scan.family
        assert family.form is not None
        sizes = only(scan.fit.size, scan.sensors if which is None else which) * _per_second(scan, rate)
        powers, change = sizes.unbind(-1)[: family.form.powers], sizes.unbind(-1)[family.form.powers :]
        return cls(
            powers[0], log_factors(scan), scan.point[0] / rate, family.channel or "", family.row, powers[1:], change
        )

    @property
    def form(self) -> ThermalForm:
        """What it has of the temperature."""
        return ThermalForm(1 + len(self.curvature), bool(self.change))

    @property
    def follows(self) -> tuple[str, ...]:
        return (self.channel,)

    @property
    def sizes(self) -> Tensor:
        return torch.stack([self.size, *self.curvature, *self.change], -1)

    def with_sizes(self, sizes: Tensor) -> TemperatureDrift:
        size, *further = sizes.unbind(-1)
        n = len(self.curvature)
        return replace(self, size=size, curvature=tuple(further[:n]), change=tuple(further[n:]))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        at_once = 0.0 if self.change else self.lag_s * comparison.info.rate
        channel = lagged(comparison.info, self.channel, self.row, at_once, comparison.n_samples)
        path = self._effect(comparison.n_samples, comparison.info) if fitted else None
        label = f"{self.channel}, with the lag" if at_once else self.channel
        pictures.means_against(ax, comparison, sensor, channel, label, path)

    def paths(self, n_samples: int, info: RecordingInfo) -> Tensor:
        temperature, lagging = (
            lagged(info, self.channel, self.row, lag, n_samples, moving=bool(self.change))
            for lag in (0.0, self.lag_s * info.rate)
        )
        return self.form.paths(temperature, lagging, self.lag_s)


def _per_second(scan: Scan, rate: float) -> Tensor:
    """Factors `(path,)` that make sizes of paths counted by samples those of paths counted by seconds."""
    factors = torch.ones(scan.fit.size.shape[-1], dtype=torch.float64)
    if scan.family.form is not None and scan.family.form.changes:
        factors[-1] /= rate
    return factors
