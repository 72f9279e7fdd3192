"""A gain on acceleration: the proof mass of a gyroscope is also that of an accelerometer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from gyrofuse.mismatch.detectors.slow.channels import accelerations
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.signals.channel_gain import ChannelGain, gain_in_g, gravity_unit, not_identifiable
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

_DOUBTFUL = 1.0  # deg/s/g, five times that of the poorest gyroscopes: what accelerates the board may turn it as well


@dataclass(frozen=True, eq=False)
class GSensitivity(ChannelGain):
    """`x_i(t) = g_i . a(t)`: every frequency with the same gain, at phase 0.

    A vibration that sensors and accelerometer both feel has gains that differ from frequency to frequency, and phases.
    Where all acceleration lies in one band, the two cannot be told apart.
    """

    name: ClassVar[str] = "g_sensitivity"
    rivals: ClassVar[tuple[str, ...]] = (*ChannelGain.rivals, "quadratic_coupling", "scale_factor")
    separated_by: ClassVar[str] = "acceleration recorded along with the rates, in several attitudes"
    of_one_band: ClassVar[tuple[str, ...]] = ("vibration_tone", "common_mode")
    largest: ClassVar[float] = 20.0  # deg/s/g: a hundred times the 0.2 that data sheets of the poorest gyroscopes state

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        finding = super().detect_and_fit(comparison, level)
        if finding is None or finding.mechanism != cls.name:
            return finding
        if not finding.alternatives and gain_in_g(comparison.info, finding, 1, sure=False) > _DOUBTFUL:
            return replace(finding, alternatives=("common_mode",))
        if not finding.alternatives:
            return finding
        where = f"the output of {comparison.info.named(finding.sensors, 'every sensor')}"
        return not_identifiable(finding, f"{where} moves with {finding.channel} in one narrow band alone")

    @classmethod
    def channels(cls, comparison: Comparison) -> list[str]:
        return accelerations(comparison)

    @classmethod
    def words(cls, gain: float, channel: str, where: str, unit: str) -> str:
        return f"{where} follows {channel} with a gain of up to {gain:.3g} {unit}, which the simulation does not have"

    @classmethod
    def _unit(cls, info: RecordingInfo, name: str) -> tuple[str, float]:
        unit = gravity_unit(info, name)
        return super()._unit(info, name) if unit is None else (f"{info.measure}/{unit}", 1.0)
