"""Strapdown navigation from increments of angle and velocity, over batches.

In a frame tangent to the Earth and fixed to it (north, east, down),

    C' = C W_ib - W_ie C,   v' = C f + g - 2 w_ie x v,   r' = v.

The increments of an interval are integrals in the axes of a body that rotates within it. The coning and sculling
corrections for that rotation are computed from the interval and the one before (Savage 1998, parts 1 and 2; Titterton
and Weston, chapter 11). Numbers in round brackets are equations of Groves, Principles of GNSS, Inertial, and
Multisensor Integrated Navigation Systems, second edition, whose Earth-centred frame is here the tangent one.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.units import GRAVITY
from gyrofuse.navigation.attitude import SMALL_ANGLE, conjugate, from_rotation_vector, multiply, rotate


class State(NamedTuple):
    """Navigation state, `(..., component)`.

    Attributes:
        attitude: Quaternion, body to navigation frame.
        velocity: Velocity in the navigation frame, m/s.
        position: Position in the navigation frame, m.
    """

    attitude: Tensor
    velocity: Tensor
    position: Tensor


class Frame(NamedTuple):
    """Rotation of the navigation frame with the Earth, and gravity, during one interval.

    Attributes:
        dt: Length of the interval, s.
        earth: Rate of the Earth in the frame, rad/s, `(3,)`.
        half: Quaternion of the inverse of the frame's rotation from the start of the interval to its middle.
        whole: The same for the end of the interval.
        down: Velocity that gravity adds in the interval, m/s.
    """

    dt: float
    earth: Tensor
    half: Tensor
    whole: Tensor
    down: Tensor

    @classmethod
    def of(cls, dt: float, earth: Tensor) -> Frame:
        """Frame for intervals of `dt` seconds, with the rate of the Earth `(3,)` in rad/s."""
        down = torch.tensor([0.0, 0.0, dt * GRAVITY], dtype=earth.dtype, device=earth.device)
        half, whole = (from_rotation_vector(-share * dt * earth) for share in (0.5, 1.0))
        return cls(dt, earth, half, whole, down)


def step(state: State, now: tuple[Tensor, Tensor], before: tuple[Tensor, Tensor], frame: Frame) -> State:
    """Integrate one interval.

    Args:
        state: State at the start of the interval.
        now: Increments of angle (rad) and velocity (m/s) in the interval, `(..., 3)` each.
        before: Increments of the interval before.
        frame: Rotation of the navigation frame in the interval.

    Returns:
        The state at the end of the interval.
    """
    angle, push = now
    angle_, push_ = before
    # Coning: linear rate over both intervals.
    turn = angle + torch.linalg.cross(angle_, angle) / 12
    # Rotation during the acceleration, exact for constant rate and force (5.84), and the sculling correction.
    pushed = push + _turned(angle, push)
    pushed = pushed + (torch.linalg.cross(angle_, push) + torch.linalg.cross(push_, angle)) / 12
    gained = rotate(state.attitude, pushed)
    gained = rotate(frame.half, gained) + frame.down  # (5.85): rotation of the frame
    turned = (frame.dt * frame.earth).expand_as(gained)
    # (5.36), with the velocity at the middle of the interval
    gained = gained - 2 * torch.linalg.cross(turned, state.velocity + gained / 2)
    velocity = state.velocity + gained
    # (5.38), and the double integral of a linear change of the specific force in the rotating frame.
    still = rotate(conjugate(state.attitude), turned)
    change = rotate(state.attitude, push - push_ + torch.linalg.cross(angle - still, push))
    position = state.position + frame.dt * (state.velocity + gained / 2 - change / 12)
    attitude = multiply(
        multiply(frame.whole.expand_as(state.attitude), state.attitude), from_rotation_vector(turn)
    )  # (5.75), with quaternions
    return State(attitude / attitude.norm(dim=-1, keepdim=True), velocity, position)


def _turned(angle: Tensor, push: Tensor) -> Tensor:
    """Correction of a velocity increment `(..., 3)` to the axes at the start, for constant rate and force."""
    size = angle.norm(dim=-1, keepdim=True)
    square, safe = size.square(), size.clamp(min=SMALL_ANGLE)
    one = torch.where(size < SMALL_ANGLE, 0.5 - square / 24, (1 - torch.cos(safe)) / safe.square())
    two = torch.where(size < SMALL_ANGLE, 1 / 6 - square / 120, (1 - torch.sin(safe) / safe) / safe.square())
    first = torch.linalg.cross(angle, push)
    return one * first + two * torch.linalg.cross(angle, first)


def navigate(start: State, angles: Tensor, pushes: Tensor, dt: float, earth: Tensor) -> State:
    """Integrate increments of angle and velocity, interval by interval.

    Args:
        start: Initial state.
        angles: Increments of angle, rad, `(..., interval, 3)`.
        pushes: Increments of velocity, m/s, `(..., interval, 3)`.
        dt: Length of an interval, s.
        earth: Rate of the Earth in the navigation frame, rad/s, `(3,)`.

    Returns:
        States at the end of every interval, `(..., interval, component)`.

    Raises:
        ValueError: No interval, or other shapes.
    """
    if angles.shape != pushes.shape or angles.ndim < 2 or angles.shape[-2] < 1 or angles.shape[-1] != 3:
        raise ValueError(
            f"`angles` and `pushes`: expected (..., interval, 3) both, with at least one interval, got "
            f"{tuple(angles.shape)} and {tuple(pushes.shape)}"
        )
    state, states = start, []
    before, frame = (_extrapolated(angles), _extrapolated(pushes)), Frame.of(dt, earth)
    for angle, push in zip(angles.unbind(-2), pushes.unbind(-2), strict=True):
        state = step(state, (angle, push), before, frame)
        before = angle, push
        states.append(state)
    return State(*(torch.stack(parts, -2) for parts in zip(*states, strict=True)))


def _extrapolated(increments: Tensor) -> Tensor:
    """Increments of the interval before the first, by linear extrapolation from the first two."""
    if increments.shape[-2] < 2:
        return increments[..., 0, :]
    return 2 * increments[..., 0, :] - increments[..., 1, :]
