"""Covariance of the errors of inertial navigation: its initial value, and its prediction from sample to sample.

Numbers in round brackets are equations of Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation
Systems, second edition.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gyrofuse.navigation.attitude import skew
from gyrofuse.noise.state_space import StateSpace

# Places of the three navigation errors in the state, each of three components along north, east and down; the states
# of the sensors' noise follow from N_NAVIGATION on, gyros first, axis by axis.
ATTITUDE, VELOCITY, POSITION = (slice(first, first + 3) for first in (0, 3, 6))
N_NAVIGATION = POSITION.stop


def initial_covariance(std: Tensor, systems: Sequence[StateSpace], n_flights: int) -> Tensor:
    """Initial covariance `(flight, state, state)`; that of the sensors' states is the prior of their noise models.

    Args:
        std: Standard deviations of the navigation errors, `(9,)`: rad, m/s, m.
        systems: Noise models of a gyro and of an accelerometer.
        n_flights: Number of flights.
    """
    blocks = [torch.diag(std.square()).expand(n_flights, N_NAVIGATION, N_NAVIGATION)]
    for system in systems:
        n_states = system.F.shape[-1]
        blocks += [system.P0.expand(n_flights, n_states, n_states)] * 3
    return _block_diagonal(blocks)


def predicted_covariance(
    covariance: Tensor, turn: Tensor, force: Tensor, systems: Sequence[StateSpace], earth: Tensor, dt: float, n: int
) -> Tensor:
    """Covariance `n` samples later, with attitude and specific force taken as constant in between.

    Transition and noise of one sample are composed by repeated doubling: those of `2k` samples from two halves.

    Args:
        covariance: Covariance of the errors, `(flight, state, state)`.
        turn: Rotation matrices from body to navigation frame, `(flight, 3, 3)`.
        force: Specific force in the navigation frame, m/s^2, `(flight, 3)`.
        systems: Noise models of a gyro and of an accelerometer.
        earth: Rate of the Earth in the navigation frame, rad/s, `(3,)`.
        dt: Sampling interval, s.
        n: Number of samples.
    """
    transition, noise = _one_sample(turn, force, systems, earth, dt, covariance.shape[-1])
    composed: tuple[Tensor, Tensor] | None = None
    while n:
        if n & 1:
            if composed is None:
                composed = transition, noise
            else:
                composed = transition @ composed[0], transition @ composed[1] @ transition.mT + noise
        n >>= 1
        if n:
            noise = transition @ noise @ transition.mT + noise
            transition = transition @ transition
    assert composed is not None
    predicted = composed[0] @ covariance @ composed[0].mT + composed[1]  # (3.46), the noise composed instead of halved
    return (predicted + predicted.mT) / 2


def _one_sample(
    turn: Tensor, force: Tensor, systems: Sequence[StateSpace], earth: Tensor, dt: float, size: int
) -> tuple[Tensor, Tensor]:
    """Transition (14.50) and noise (14.82) of one sample, `(flight, state, state)` each."""
    n_flights = len(turn)
    eye = torch.eye(size, dtype=turn.dtype)
    transition = eye.expand(n_flights, size, size).clone()
    noise = torch.zeros_like(transition)
    transition[:, ATTITUDE, ATTITUDE] -= dt * skew(earth)
    transition[:, VELOCITY, ATTITUDE] = dt * skew(force)
    transition[:, VELOCITY, VELOCITY] -= 2 * dt * skew(earth)
    transition[:, POSITION, VELOCITY] = dt * eye[:3, :3]
    at = N_NAVIGATION
    for s, row, sign in zip(systems, (ATTITUDE, VELOCITY), (-1.0, 1.0), strict=True):
        n = s.F.shape[-1]
        # Column (axis, state): effect of the error of an axis on the navigation error that it drives.
        output = turn[..., None] * s.H[..., 0, :].expand(n_flights, n)[:, None, None, :]
        output = sign * dt * output.flatten(-2)
        F = _block_diagonal([s.F.expand(n_flights, n, n)] * 3)
        Q = _block_diagonal([s.Q.expand(n_flights, n, n)] * 3)
        own = slice(at, at + 3 * n)
        transition[:, own, own] = F
        transition[:, row, own] = output @ F
        noise[:, own, own] = Q
        noise[:, row, own] = output @ Q
        noise[:, own, row] = (output @ Q).mT
        white = (dt**2 * s.R[..., 0, 0]).expand(n_flights)[:, None, None] * eye[:3, :3]
        noise[:, row, row] += output @ Q @ output.mT + white
        at += 3 * n
    return transition, noise


def _block_diagonal(blocks: list[Tensor]) -> Tensor:
    """Block diagonal matrix of square matrices `(flight, i, i)`."""
    size = sum(block.shape[-1] for block in blocks)
    whole, at = blocks[0].new_zeros(blocks[0].shape[0], size, size), 0
    for block in blocks:
        n = block.shape[-1]
        whole[:, at : at + n, at : at + n] = block
        at += n
    return whole
