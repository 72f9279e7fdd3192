"""A scale factor or misalignment: the output follows the true rate with a gain that is off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from gyrofuse.mismatch.detectors.slow.channels import rates
from gyrofuse.mismatch.mechanisms.signals.channel_gain import ChannelGain
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo


@dataclass(frozen=True, eq=False)
class ScaleFactor(ChannelGain):
    """`x_i(t) = error_i omega(t)` beside what the simulation has of the rate `omega`, an auxiliary channel.

    Seen only while the rate changes: at a constant rate it is a bias. Where it differs for either sign the output
    follows the modulus of the rate as well.
    """

    name: ClassVar[str] = "scale_factor"
    rivals: ClassVar[tuple[str, ...]] = (*ChannelGain.rivals, "g_sensitivity", "quadratic_coupling")
    separated_by: ClassVar[str] = "a recording on a table that turns at known rates"
    quantity: ClassVar[str] = "error"

    @classmethod
    def channels(cls, comparison: Comparison) -> list[str]:
        return rates(comparison)

    @classmethod
    def rows(cls, values: Tensor) -> Mapping[str, Tensor]:
        return {"each": values, "modulus": values.abs()}

    @classmethod
    def words(cls, gain: float, channel: str, where: str, unit: str) -> str:
        return f"{where} follows {channel} with a gain that is off by up to {gain:.3g} ppm"

    @classmethod
    def _unit(cls, info: RecordingInfo, name: str) -> tuple[str, float]:
        return "ppm", 1e6
