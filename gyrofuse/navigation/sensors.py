"""Noise model of an inertial unit, from which errors are simulated or which a filter assumes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive
from gyrofuse.noise.model import Model
from gyrofuse.noise.state_space import StateSpace, state_space


@dataclass(frozen=True, eq=False)
class UnitErrors:
    """Noise of the three gyros and three accelerometers of a unit, axes independent and alike.

    Attributes:
        gyro: Noise model of the samples of angular rate, rad/s; parameters may have one batch dimension, a model for
            each flight.
        accelerometer: Noise model of the samples of specific force, m/s^2; likewise.
        rate: Sampling rate, Hz.
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
    ) -> ErrorSamples:
        """Simulate errors of flights; of a model with a batch dimension each entry makes the errors of one flight.

        Args:
            n_samples: Number of samples of each flight.
            n_flights: Number of flights.
            generator: Source of randomness.
            with_states: Whether the true states of the processes are kept, to check a filter's covariance against
                them; each takes as much memory as the samples.
        """
        models = self.gyro, self.accelerometer
        return ErrorSamples(*(_simulated(model, n_samples, n_flights, generator, with_states) for model in models))


class Axes(NamedTuple):
    """Errors of three axes.

    Attributes:
        samples: Errors of the samples, `(flight, time, 3)`.
        states: True values of the filter's states of these sensors, `(flight, time, 3, state)`; NaN where a process
            does not give them, and no state where they were not kept.
    """

    samples: Tensor
    states: Tensor


class ErrorSamples(NamedTuple):
    """Simulated errors of an inertial unit."""

    gyro: Axes
    accelerometer: Axes


def _simulated(model: Model, n_samples: int, n_flights: int, generator: torch.Generator, with_states: bool) -> Axes:
    batch = (3,) if model.params.ndim > 1 else (3, n_flights)
    total = torch.zeros(3, n_flights, n_samples, dtype=torch.float64)
    states = []
    for process in model.processes:
        path = process.simulate(n_samples, batch=batch, generator=generator)  # (3, flight, time)
        total += path
        if with_states:
            n_states = state_space(process, 1.0).F.shape[-1]
            states += [path] if n_states == 1 else [torch.full_like(path, torch.nan)] * n_states
    stacked = torch.stack(states, -1) if states else total.new_zeros(*total.shape, 0)
    return Axes(total.permute(1, 2, 0), stacked.permute(1, 2, 0, 3))
