"""Errors of an inertial unit: what simulates them, and what a filter is told about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive
from gyrofuse.noise.model import Model
from gyrofuse.noise.processes import AR1, RandomWalk
from gyrofuse.noise.state_space import StateSpace, state_space


@dataclass(frozen=True, eq=False)
class UnitErrors:
    """Noise of the three gyros and three accelerometers of a unit, axes independent and alike.

    Attributes:
        gyro: Of samples of rate, rad/s; parameters may have one batch dimension, a model for each flight.
        accelerometer: Of samples of specific force, m/s^2; likewise.
        rate: Of the samples, Hz.
    """

    gyro: Model
    accelerometer: Model
    rate: float

    def __post_init__(self) -> None:
        check_positive("rate", self.rate)

    def systems(self) -> tuple[StateSpace, StateSpace]:
        """Linear systems of a gyro and of an accelerometer, one step a sample."""
        return state_space(self.gyro, self.rate), state_space(self.accelerometer, self.rate)

    def simulate(
        self, n_samples: int, n_flights: int, generator: torch.Generator, *, with_states: bool = False
    ) -> Drawn:
        """Draw errors of so many flights; models with batch dimensions have one flight each.

        Args:
            n_samples: Of each flight.
            n_flights: How many.
            generator: Source of randomness.
            with_states: Whether to keep what the processes are made of, to judge a filter's claims by: as much memory
                again for each of them.
        """
        models = self.gyro, self.accelerometer
        return Drawn(*(_drawn(model, n_samples, n_flights, generator, with_states) for model in models))


class Axes(NamedTuple):
    """Errors of three axes.

    Attributes:
        samples: `(flight, time, 3)`.
        states: What the filter's states of the sensors truly are, `(flight, time, 3, state)`; NaN where nobody knows,
            and none where they were not kept.
    """

    samples: Tensor
    states: Tensor


class Drawn(NamedTuple):
    """Errors of a unit."""

    gyro: Axes
    accelerometer: Axes


def _drawn(model: Model, n_samples: int, n_flights: int, generator: torch.Generator, with_states: bool) -> Axes:
    batch = (3,) if model.params.ndim > 1 else (3, n_flights)
    total = torch.zeros(3, n_flights, n_samples, dtype=torch.float64)
    states = []
    for process in model.processes:
        path = process.simulate(n_samples, batch=batch, generator=generator)  # (3, flight, time)
        total += path
        if with_states:
            n_states = state_space(process, 1.0).F.shape[-1]
            known = isinstance(process, AR1 | RandomWalk)
            states += [path] if known else [torch.full_like(path, torch.nan)] * n_states
    stacked = torch.stack(states, -1) if states else total.new_zeros(*total.shape, 0)
    return Axes(total.permute(1, 2, 0), stacked.permute(1, 2, 0, 3))
