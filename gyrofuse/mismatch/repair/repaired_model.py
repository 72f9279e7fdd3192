"""The simulation with what it left out: noise of the array and the mechanisms that act on it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive_integer, own_generator, same_rate
from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.signals.comparison import RecordingInfo
from gyrofuse.noise.array_model import ArrayModel


@dataclass(frozen=True, eq=False)
class RepairedModel:
    """Noise of an array, and mechanisms that act on it one after the other; compose with `+`.

    Attributes:
        noise: Of the array.
        info: Rate, unit, sensors and auxiliary channels of the recording.
        effects: In the order in which they were found; what was taken off the recording acts on the rest, and the
            converter last.
        noise_samples: Of a simulation, in each sensor, that the noise was estimated from; 0 where it is known.
    """

    noise: ArrayModel
    info: RecordingInfo
    effects: tuple[Mechanism, ...] = ()
    noise_samples: int = 0
    scene = RenamedAttribute("info")

    def __add__(self, effect: Mechanism) -> RepairedModel:
        known = hasattr(effect, "apply") and hasattr(effect, "order")
        return replace(self, effects=(*self.effects, effect)) if known else NotImplemented

    def elsewhere(self) -> RepairedModel:
        """The same for another recording: without steps and episodes, which happened once."""
        return replace(self, effects=tuple(effect for effect in self.effects if not effect.happened_once))

    def simulate(
        self,
        n_samples: int,
        *,
        batch: Sequence[int] = (),
        channels: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw records `(*batch, sensor, time)`.

        Args:
            n_samples: Samples of each.
            batch: Shape of the independent records.
            channels: Auxiliary channels `(row, time)` that mechanisms follow; those of the recording by default.
            generator: Source of randomness; by default a fresh one.
        """
        n_samples = check_positive_integer("n_samples", n_samples)
        generator = own_generator(generator, None)
        info = self.info if channels is None else replace(self.info, channels=dict(channels))
        signal = self.noise.simulate(n_samples, batch=tuple(batch), generator=generator)
        for effect in sorted(self.effects, key=lambda effect: effect.order):
            signal = effect.apply(signal, info, generator)
        return signal

    def correct(self, signal: Tensor) -> Tensor:
        """A recording `(sensor, time)` without what can be taken off it: tones, temperature, steps, spikes."""
        for effect in self.effects:
            signal = effect.remove(signal, self.info)
        return signal

    def check(self, rate: float, unit: str) -> None:
        """Make sure that a simulation at this rate and in this unit, without auxiliary channels, is the one repaired.

        Raises:
            ValueError: It is not.
        """
        info = self.info
        if not same_rate(rate, info.rate):
            raise ValueError(f"`rate`: expected that of the repaired simulation, {info.rate:g} Hz, got {rate:g} Hz")
        if "unknown" not in (unit, info.unit) and unit != info.unit:
            raise ValueError(f"`unit`: expected that of the repaired simulation, {info.unit!r}, got {unit!r}")
        followed = {name for effect in self.effects for name in effect.follows} - {*info.channels}
        if followed:
            raise ValueError(
                f"`channels`: expected {', '.join(sorted(followed))}, which the simulation follows, got none; to "
                "diagnose, give a recording that has them; to simulate, use Python, where `simulate` takes channels"
            )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON; without the auxiliary channels."""
        info = self.info
        return {
            "noise": self.noise.to_dict(),
            "noise_samples": self.noise_samples,
            "effects": [
                {"mechanism": effect.name, "kind": type(effect).__name__, "numbers": _plain(effect)}
                for effect in self.effects
            ],
            "rate": info.rate,
            "unit": info.unit,
            "sensors": list(info.sensors),
        }

    def __str__(self) -> str:
        return " + ".join([str(self.noise), *(effect.name for effect in self.effects)])


def _plain(value: Any) -> Any:
    """Numbers of a mechanism, what is not finite as text."""
    if isinstance(value, Tensor) and value.is_complex():
        return {"real": _plain(value.real), "imag": _plain(value.imag)}
    if isinstance(value, Tensor):
        return _plain(value.tolist())
    if is_dataclass(value):
        saved = (entry.name for entry in fields(value) if entry.metadata.get("saved", True))
        return {name: _plain(getattr(value, name)) for name in saved}
    if isinstance(value, tuple | list):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
