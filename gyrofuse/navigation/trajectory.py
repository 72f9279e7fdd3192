"""Trajectories whose rates and specific forces are known exactly.

Position and Euler angles are splines of degree five; angular rate and specific force follow from their derivatives.
The frame is tangent to the Earth: north, east, down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import BSpline, make_interp_spline
from torch import Tensor

from gyrofuse._base.checks import check_floating, check_positive
from gyrofuse._base.units import GRAVITY
from gyrofuse.navigation.attitude import conjugate, from_euler, rotate

EARTH_RATE = 7.292115e-5  # rotation rate of the Earth, rad/s, as WGS 84 defines it
# Degree of the splines through position and Euler angles: quintic, so that specific force, which takes two derivatives
# of position, is twice continuously differentiable, as the coning and sculling corrections assume.
_DEGREE = 5
# Least ground speed, m/s, of a coordinated flight: its yaw is the direction of the ground velocity, which has no
# meaning near zero. It only decides which trajectories are refused.
_MIN_GROUND_SPEED = 0.5


class Motion(NamedTuple):
    """True motion at a number of times, `(time, ...)`.

    Attributes:
        position: Position in the navigation frame, m.
        velocity: Velocity in the navigation frame, m/s.
        attitude: Quaternion, body to navigation frame.
        rate: Angular rate of the body against inertial space, in body axes, rad/s.
        specific_force: Specific force in body axes, m/s^2.
    """

    position: Tensor
    velocity: Tensor
    attitude: Tensor
    rate: Tensor
    specific_force: Tensor


class Increments(NamedTuple):
    """Output of an ideal unit: integrals of angular rate and specific force over each interval, `(interval, 3)`.

    Attributes:
        angle: Increments of angle, rad.
        velocity: Increments of velocity, m/s.
    """

    angle: Tensor
    velocity: Tensor


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A smooth motion through given points.

    Attributes:
        time: Times of the points, s, `(point,)`, increasing.
        position: Positions north, east, down in m, `(point, 3)`.
        euler: Roll, pitch, yaw in rad, `(point, 3)`, roll and yaw of any number of turns; by default those of a
            coordinated flight.
        latitude: Latitude, rad, for the rotation of the Earth; None for an Earth that does not rotate.

    Raises:
        TypeError: Not tensors.
        ValueError: Fewer than six points, times that do not increase, other shapes, numbers that are not finite, or
            angles that cannot be in rad.
    """

    time: Tensor
    position: Tensor
    euler: Tensor | None = None
    latitude: float | None = None

    def __post_init__(self) -> None:
        for name, values in (("time", self.time), ("position", self.position), ("euler", self.euler)):
            if values is not None:
                check_floating(name, values)
        n = len(self.time)
        if n <= _DEGREE or self.time.ndim != 1:
            raise ValueError(f"`time`: expected at least {_DEGREE + 1} points, got shape {tuple(self.time.shape)}")
        if not bool((self.time.diff() > 0).all()):
            raise ValueError("`time`: expected increasing seconds, got some that do not increase; sort and thin them")
        for name, values in (("position", self.position), ("euler", self.euler)):
            if values is None:
                continue
            if values.shape != (n, 3):
                raise ValueError(f"`{name}`: expected shape ({n}, 3), got {tuple(values.shape)}")
            if not bool(values.isfinite().all()):
                raise ValueError(f"`{name}`: expected finite numbers, got others; leave those points out")
        if self.euler is not None and float(self.euler[:, 1].abs().max()) > math.pi / 2:
            raise ValueError(
                f"`euler`: expected roll, pitch and yaw in rad, a pitch of at most pi/2, got a pitch of "
                f"{float(self.euler[:, 1].abs().max()):g}; degrees? divide by 57.3"
            )
        if self.latitude is not None and not abs(self.latitude) <= math.pi / 2:
            raise ValueError(f"`latitude`: expected rad, at most pi/2, got {self.latitude:g}; degrees? divide by 57.3")

    @property
    def duration(self) -> float:
        """Time from the first point to the last, s."""
        return float(self.time[-1] - self.time[0])

    @property
    def earth_rate(self) -> Tensor:
        """Rotation rate of the Earth in the navigation frame, rad/s, `(3,)`."""
        if self.latitude is None:
            return torch.zeros(3, dtype=torch.float64)
        return EARTH_RATE * torch.tensor([np.cos(self.latitude), 0.0, -np.sin(self.latitude)], dtype=torch.float64)

    def at(self, time: Tensor) -> Motion:
        """Motion at given times.

        Args:
            time: Times since the first point, s, `(time,)`.
        """
        t = (time.to(torch.float64) + self.time[0]).numpy()
        position, velocity, acceleration = (torch.from_numpy(self._place(t, nu)) for nu in range(3))
        angles, turning = (torch.from_numpy(self._angles(t, nu)) for nu in range(2))
        attitude, earth = from_euler(angles), self.earth_rate
        to_body = conjugate(attitude)
        rate = _body_rate(angles, turning) + rotate(to_body, earth.expand_as(velocity))
        down = torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64)
        # v' = C f + g - 2 w_ie x v, in a frame that is fixed to the Earth (Groves, sections 2.3 and 5.2).
        force = acceleration - down + 2 * torch.linalg.cross(earth.expand_as(velocity), velocity)
        return Motion(position, velocity, attitude, rate, rotate(to_body, force))

    def increments(self, rate: float, n_nodes: int = 6) -> Increments:
        """Output of an ideal inertial unit, by Gauss-Legendre quadrature of each interval.

        Args:
            rate: Sampling rate of the unit, Hz.
            n_nodes: Nodes of the quadrature; with six it is exact for polynomials of degree eleven, twice that of
                the splines.
        """
        step = 1 / check_positive("rate", rate)
        n = round(self.duration * rate)
        nodes, weights = np.polynomial.legendre.leggauss(n_nodes)
        start = torch.arange(n, dtype=torch.float64)[:, None] * step
        motion = self.at((start + torch.from_numpy((nodes + 1) / 2) * step).flatten())
        share = torch.from_numpy(weights / 2) * step
        angle, velocity = (
            torch.einsum("ikc,k->ic", values.unflatten(0, (n, n_nodes)), share)
            for values in (motion.rate, motion.specific_force)
        )
        return Increments(angle, velocity)

    @cached_property
    def _place(self) -> BSpline:
        return make_interp_spline(self.time.numpy(), self.position.numpy(), k=_DEGREE)

    @cached_property
    def _angles(self) -> BSpline:
        if self.euler is not None:
            euler = self.euler.numpy().copy()
            for turns in (0, 2):  # pitch does not go round
                euler[:, turns] = np.unwrap(euler[:, turns])
            return make_interp_spline(self.time.numpy(), euler, k=_DEGREE)
        t = np.linspace(float(self.time[0]), float(self.time[-1]), max(round(2 * self.duration), 4 * _DEGREE))
        return make_interp_spline(t, _coordinated(self._place(t, 1), self._place(t, 2)), k=_DEGREE)


def flight() -> Trajectory:
    """A flight of 235 s at 17 to 21 m/s: one and a half circles to the right, a climb of 88 m, a descent of 39 m."""
    # s, north, east, up: m
    points = torch.tensor(
        [
            [0, 0, 0, 100],
            [15, 285, 10, 108],
            [30, 555, 90, 120],
            [45, 730, 300, 133],
            [60, 700, 570, 146],
            [75, 480, 730, 158],
            [90, 210, 690, 168],
            [105, 40, 490, 176],
            [120, 60, 230, 182],
            [135, 250, 60, 186],
            [150, 510, 30, 188],
            [165, 760, 110, 187],
            [180, 930, 310, 183],
            [195, 920, 570, 176],
            [210, 750, 770, 167],
            [225, 500, 830, 156],
            [235, 320, 800, 149],
        ],
        dtype=torch.float64,
    )
    return Trajectory(points[:, 0], points[:, 1:] * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory from a text file with named columns separated by commas.

    Args:
        path: The file, with the columns `time` (s), `north`, `east`, `down` (m), and optionally `roll`, `pitch`,
            `yaw` (rad).

    Raises:
        FileNotFoundError: No such file.
        ValueError: Columns are missing, or values that `Trajectory` refuses.
    """
    first, *lines = Path(path).read_text(encoding="utf-8").splitlines() or [""]
    names = [name.strip().lower() for name in first.split(",")]
    missing = [name for name in ("time", "north", "east", "down") if name not in names]
    if missing or not lines:
        what = f"no {', '.join(missing)}" if missing else "no rows"
        raise ValueError(f"{path}: expected the columns time, north, east, down [, roll, pitch, yaw], found {what}")
    try:
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path}: expected numbers separated by commas below the names: {error}") from None
    if table.shape[-1] != len(names):
        raise ValueError(f"{path}: expected as many columns as names, {len(names)}, found {table.shape[-1]}")
    column = {name: torch.from_numpy(table[:, i].copy()) for i, name in enumerate(names)}
    euler = [name for name in ("roll", "pitch", "yaw") if name in names]
    if len(euler) in (1, 2):
        raise ValueError(f"{path}: expected roll, pitch and yaw, or none of them, found {' and '.join(euler)} alone")
    angles = torch.stack([column[name] for name in euler], -1) if euler else None
    place = torch.stack([column[name] for name in ("north", "east", "down")], -1)
    try:
        return Trajectory(column["time"], place, angles)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _coordinated(velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw of a coordinated flight, without sideslip, from velocity and acceleration, `(time, 3)`."""
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    if speed.min() < _MIN_GROUND_SPEED:
        raise ValueError(
            f"`position`: expected a flight of more than {_MIN_GROUND_SPEED} m/s over ground, got {speed.min():.3g}; "
            "give `euler` for one that hovers"
        )
    yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    pitch = np.arctan2(-velocity[:, 2], speed)
    sideways = (velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]) / speed
    return np.stack([np.arctan2(sideways, GRAVITY), pitch, yaw], -1)


def _body_rate(euler: Tensor, turning: Tensor) -> Tensor:
    """Angular rate in body axes, from Euler angles and their derivatives (Titterton and Weston, section 3.6)."""
    roll, pitch, _ = euler.unbind(-1)
    roll_, pitch_, yaw_ = turning.unbind(-1)
    return torch.stack(
        [
            roll_ - yaw_ * torch.sin(pitch),
            pitch_ * torch.cos(roll) + yaw_ * torch.sin(roll) * torch.cos(pitch),
            -pitch_ * torch.sin(roll) + yaw_ * torch.cos(roll) * torch.cos(pitch),
        ],
        -1,
    )
