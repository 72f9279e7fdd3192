"""The simulation with what it left out, as several recordings of the device have it: it draws sessions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive_integer, own_generator
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.repair.repaired_model import RepairedModel


@dataclass(frozen=True, eq=False)
class SessionModel:
    """Repaired simulations of several recordings; each record that is drawn has the numbers of one of them.

    What is the device's is in all of them. What differs from session to session is drawn as whole sessions, so that
    numbers that go together stay together, and what happened once in a recording is left out.

    Attributes:
        models: Repaired simulation of each recording.
    """

    models: tuple[RepairedModel, ...]

    def simulate(
        self,
        n_samples: int,
        *,
        batch: Sequence[int] = (),
        channels: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw records `(*batch, sensor, time)`, each of a session; all sessions come as often, but for the rest.

        Args:
            n_samples: Samples of each.
            batch: Shape of the independent records.
            channels: Auxiliary channels `(row, time)` that mechanisms follow; those of each recording by default.
            generator: Source of randomness; by default a fresh one.
        """
        n_samples = check_positive_integer("n_samples", n_samples)
        generator = own_generator(generator, None)
        n_records, n = math.prod(batch), len(self.models)
        rounds = [torch.randperm(n, generator=generator, device=generator.device) for _ in range(-(-n_records // n))]
        drawn = torch.cat(rounds)[:n_records].tolist() if rounds else []
        records = [
            self.models[k].elsewhere().simulate(n_samples, channels=channels, generator=generator) for k in drawn
        ]
        if not records:
            n_sensors = len(self.models[0].info.sensors)
            return torch.empty(*batch, n_sensors, n_samples, dtype=torch.float64, device=generator.device)
        return torch.stack(records).view(*batch, *records[0].shape)

    def check(self, rate: float, unit: str, channels: Mapping[str, Tensor] | None = None) -> None:
        """Make sure that a simulation at this rate and in this unit, with these auxiliary channels, is these.

        Raises:
            ValueError: It is not.
        """
        for model in self.models:
            replace(model, info=replace(model.info, channels=dict(channels or {}))).check(rate, unit)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON; without the auxiliary channels."""
        first = self.models[0].info
        return {"sessions": [model.to_dict() for model in self.models], "rate": first.rate, "unit": first.unit}

    def __str__(self) -> str:
        return " or ".join(map(str, self.models))


def records_for(
    model: RepairedModel | SessionModel,
    recording: Recording | Tensor,
    fewest: int,
    channels: Mapping[str, Tensor] | None,
    generator: torch.Generator,
) -> Recording | Tensor:
    """Samples to set beside a recording: records as long as it one after the other, every session as often.

    Args:
        model: What is simulated.
        recording: Recording, or samples `(sensor, time)`, of which the kind is returned.
        fewest: Records, at least.
        channels: Auxiliary channels `(row, time)` that mechanisms follow; those of the model by default.
        generator: Source of randomness.
    """
    n = (recording.signal if isinstance(recording, Recording) else recording).shape[-1]
    n_sessions = len(model.models) if isinstance(model, SessionModel) else 1
    n_records = -(-fewest // n_sessions) * n_sessions
    records = model.simulate(n, batch=(n_records,), channels=channels, generator=generator)
    drawn = records.movedim(0, 1).flatten(1)
    if not isinstance(recording, Recording):
        return drawn
    return Recording(drawn, rate=recording.rate, unit=recording.unit)
