"""A gain on acceleration: the proof mass of a gyroscope is also that of an accelerometer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.channels import accelerations
from gyrofuse.mismatch.mechanism import Finding
from gyrofuse.mismatch.mechanisms._channel_gain import ChannelGain, gain_in_g, gravity_unit
from gyrofuse.mismatch.mechanisms.not_identifiable import not_identifiable

_DOUBTFUL = 1.0  # deg/s/g, five times that of the poorest gyroscopes: what accelerates the board may turn it as well


@dataclass(frozen=True, eq=False)
class GSensitivity(ChannelGain):
    """`x_i(t) = g_i . a(t)`: every frequency with the same gain, at phase 0.

    A vibration that sensors and accelerometer both feel has gains that differ from frequency to frequency, and phases.
    Where all acceleration lies in one band, the two cannot be told apart.
    """

    name: ClassVar[str] = "g_sensitivity"
    of_one_band: ClassVar[tuple[str, ...]] = ("vibration_tone", "common_mode")
    largest: ClassVar[float] = 20.0  # deg/s/g: a hundred times the 0.2 that data sheets of the poorest gyroscopes state

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        finding = super().nominate(case, level)
        if finding is None or finding.mechanism != cls.name:
            return finding
        if not finding.alternatives and gain_in_g(case.scene, finding, 1, sure=False) > _DOUBTFUL:
            return replace(finding, alternatives=("common_mode",))
        if not finding.alternatives:
            return finding
        where = f"the output of {case.scene.named(finding.sensors, 'every sensor')}"
        return not_identifiable(finding, f"{where} moves with {finding.channel} in one narrow band alone")

    @classmethod
    def channels(cls, case: Case) -> list[str]:
        return accelerations(case)

    @classmethod
    def words(cls, gain: float, channel: str, where: str, unit: str) -> str:
        return f"{where} follows {channel} with a gain of up to {gain:.3g} {unit}, which the simulation does not have"

    @classmethod
    def _unit(cls, scene: Scene, name: str) -> tuple[str, float]:
        unit = gravity_unit(scene, name)
        return super()._unit(scene, name) if unit is None else (f"{scene.measure}/{unit}", 1.0)
