"""Coupling to an auxiliary signal: a motor's command, a supply voltage, a current, a camera's trigger."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from gyrofuse.mismatch.detectors.slow.channels import auxiliary
from gyrofuse.mismatch.mechanisms.signals.channel_gain import ChannelGain
from gyrofuse.mismatch.signals.comparison import Comparison


@dataclass(frozen=True, eq=False)
class ChannelCoupling(ChannelGain):
    """`x_i(t) = coupling_ik (m * a_k)(t)` with the rows `a` of a channel that is no motion and no temperature."""

    name: ClassVar[str] = "channel_coupling"
    rivals: ClassVar[tuple[str, ...]] = (*ChannelGain.rivals, "step", "ramp", "resonance")
    separated_by: ClassVar[str] = "a recording in which the channel has another course"

    @classmethod
    def channels(cls, comparison: Comparison) -> list[str]:
        return auxiliary(comparison)

    @classmethod
    def words(cls, gain: float, channel: str, where: str, unit: str) -> str:
        return f"{where} follows {channel}, by up to {gain:.3g} {unit}"
