"""A gain on products of acceleration: vibration rectification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from gyrofuse.mismatch.detectors.slow.channels import accelerations, squared
from gyrofuse.mismatch.mechanisms.signals.channel_gain import ChannelGain, gravity_unit
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo


@dataclass(frozen=True, eq=False)
class QuadraticCoupling(ChannelGain):
    """`x_i(t) = a(t)' Q_i a(t)`: lines at twice those of the acceleration, and a bias that follows its mean square.

    Most simply `Q_i` is a number, a gain on the squared length of the acceleration or on the square of one axis.
    At twice a line there is no linear coherence with the acceleration, which tells it from a tone.
    """

    name: ClassVar[str] = "quadratic_coupling"
    rivals: ClassVar[tuple[str, ...]] = (*ChannelGain.rivals, "g_sensitivity", "scale_factor")
    separated_by: ClassVar[str] = "acceleration recorded along with the rates"
    of_one_band: ClassVar[tuple[str, ...]] = ("vibration_tone",)
    # deg/s/g^2: data sheets and vibration tests have 1e-4 to 1e-1; a hundred times that is no rectification.
    largest: ClassVar[float] = 10.0
    power_of_g: ClassVar[int] = 2

    @classmethod
    def channels(cls, comparison: Comparison) -> list[str]:
        return accelerations(comparison)

    @classmethod
    def rows(cls, values: Tensor) -> Mapping[str, Tensor]:
        return squared(values)

    @classmethod
    def words(cls, gain: float, channel: str, where: str, unit: str) -> str:
        return f"{where} follows the square of {channel} with a gain of up to {gain:.3g} {unit}: vibration is rectified"

    @classmethod
    def _unit(cls, info: RecordingInfo, name: str) -> tuple[str, float]:
        unit = gravity_unit(info, name)
        squared = f" per squared unit of {name}" if unit is None else f"/{unit}^2" if unit == "g" else f"/({unit})^2"
        return f"{info.measure}{squared}", 1.0
