"""A gain on acceleration: the proof mass of a gyroscope is also that of an accelerometer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.channels import accelerations
from gyrofuse.mismatch.mechanism import Finding
from gyrofuse.mismatch.mechanisms._channel_gain import ChannelGain, gravity_unit
from gyrofuse.mismatch.mechanisms.not_identifiable import not_identifiable
from gyrofuse.units import GRAVITY

_LARGEST = 1.0  # deg/s per g, ten times that of poor gyroscopes


@dataclass(frozen=True, eq=False)
class GSensitivity(ChannelGain):
    """`x_i(t) = g_i . a(t)`: every frequency with the same gain, at phase 0.

    A vibration that sensors and accelerometer both feel has gains that differ from frequency to frequency, and phases.
    Where all acceleration lies in one band, the two cannot be told apart.
    """

    name: ClassVar[str] = "g_sensitivity"
    of_one_band: ClassVar[tuple[str, ...]] = ("vibration_tone", "common_mode")

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        finding = super().nominate(case, level)
        if finding is not None and not finding.alternatives and _beyond_sensors(case.scene, finding):
            return replace(finding, alternatives=("common_mode",))
        if finding is None or not finding.alternatives:
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


def _beyond_sensors(scene: Scene, finding: Finding) -> bool:
    """Whether gains are far above those of gyroscopes: what accelerates the board may turn it as well."""
    unit, turn = gravity_unit(scene, finding.channel or ""), {"deg/s": 1.0, "rad/s": math.degrees(1)}.get(scene.unit)
    if unit is None or turn is None:
        return False
    largest = max(abs(entry.value) for entry in finding.parameters.values())
    return largest * turn * (GRAVITY if unit == "m/s^2" else 1.0) > _LARGEST
