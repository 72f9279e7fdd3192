"""Inertial navigation corrected by positions from GNSS: an error-state Kalman filter in closed loop, over batches.

The errors are of attitude `psi` (`C_estimated = (I - [psi x]) C`, in the navigation frame), velocity and position
(estimate less truth), and of the states of the sensors' noise (truth less estimate):

    psi' = -w_ie x psi - C dw,   dv' = [f x] psi + C df - 2 w_ie x dv,   dr' = dv

with the errors `dw`, `df` of gyros and accelerometers that the noise models make (Titterton and Weston, chapters 12 and
13; Groves, chapter 14; Farrell, chapter 11). Numbers in round brackets are those of Groves, Principles of GNSS,
Inertial, and Multisensor Integrated Navigation Systems, second edition, whose Earth-centred frame is here the tangent
one, gravity the same everywhere in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive
from gyrofuse.navigation.attitude import (
    conjugate,
    from_rotation_vector,
    matrix,
    multiply,
    rotate,
    rotation_vector,
    skew,
)
from gyrofuse.navigation.sensors import Drawn, UnitErrors
from gyrofuse.navigation.strapdown import Frame, State, step
from gyrofuse.navigation.trajectory import Trajectory
from gyrofuse.noise.state_space import StateSpace

_TOGETHER = 10  # samples that the covariance is carried over in one go
_ATTITUDE, _VELOCITY, _POSITION = slice(0, 3), slice(3, 6), slice(6, 9)


@dataclass(frozen=True)
class Gnss:
    """Positions from satellites.

    Attributes:
        rate: Hz; a whole number of the unit's samples apart.
        sd: Of the errors of north, east and down, independent from fix to fix, m.
        outage: Start and end of what has none, s.

    Raises:
        ValueError: Numbers that are not positive, or an outage that ends before it starts.
    """

    rate: float = 1.0
    sd: tuple[float, float, float] = (1.0, 1.0, 1.5)
    outage: tuple[float, float] | None = (160.0, 210.0)

    def __post_init__(self) -> None:
        check_positive("rate", self.rate)
        sd = tuple(self.sd) if isinstance(self.sd, Sequence) else (self.sd,)
        if len(sd) != 3 or not all(math.isfinite(value) and value > 0 for value in sd):
            raise ValueError(f"`sd`: expected three numbers of metres > 0, of north, east and down, got {self.sd!r}")
        if self.outage is not None and not 0 <= self.outage[0] < self.outage[1]:
            raise ValueError(f"`outage`: expected its start and a later end in s, got {self.outage!r}")

    def samples_apart(self, rate: float) -> int:
        """Samples of a unit of that rate (Hz) from fix to fix.

        Raises:
            ValueError: Not a whole number of them.
        """
        apart = rate / self.rate
        if round(apart) < 1 or not math.isclose(apart, round(apart), rel_tol=1e-6):
            raise ValueError(
                f"`gnss`: expected fixes a whole number of the unit's samples apart, got {self.rate:g} Hz beside "
                f"{rate:g} Hz; choose a rate of the unit that is a multiple of that of the fixes"
            )
        return round(apart)

    def available(self, time: float) -> bool:
        """Whether there is a fix at a time, s."""
        return self.outage is None or not self.outage[0] < time <= self.outage[1]


@dataclass(frozen=True)
class Alignment:
    """Standard deviations of what is known at first, of each axis.

    Attributes:
        attitude: rad: about north, east and down.
        velocity: m/s.
        position: m.
    """

    attitude: tuple[float, float, float] = (math.radians(0.5), math.radians(0.5), math.radians(2.0))
    velocity: float = 0.1
    position: float = 1.0

    @property
    def sd(self) -> Tensor:
        """Of the nine errors, `(9,)`."""
        return torch.tensor([*self.attitude, *[self.velocity] * 3, *[self.position] * 3], dtype=torch.float64)


class Flown(NamedTuple):
    """Errors of the estimate over flights, `(time, flight, ...)`.

    Attributes:
        time: s.
        error: Of attitude (`psi`, rad), velocity (m/s), position (m) and the sensors' states, axis by axis, gyros
            first, `(time, flight, state)`; NaN for what nobody knows.
        sd: Of the same, as the filter claims.
        nees: Squared errors in units of the claimed covariance, of attitude, velocity, position and the sensors'
            known states, `(time, flight, 4)`; NaN where nobody knows.
        sizes: How many states each of them has.
        nis: The same of the innovations, `(fix, flight)`, of three each.
    """

    time: Tensor
    error: Tensor
    sd: Tensor
    nees: Tensor
    sizes: tuple[int, int, int, int]
    nis: Tensor

    @property
    def attitude(self) -> Tensor:
        """Errors of attitude, rad, `(time, flight, 3)`."""
        return self.error[..., _ATTITUDE]

    @property
    def velocity(self) -> Tensor:
        """Errors of velocity, m/s."""
        return self.error[..., _VELOCITY]

    @property
    def position(self) -> Tensor:
        """Errors of position, m."""
        return self.error[..., _POSITION]


class _Sensor(NamedTuple):
    """Of one kind of sensor, three axes: matrices `(flight or 1, ...)` and the estimated states."""

    system: StateSpace
    estimate: Tensor  # (flight, 3, state)

    def predicted(self) -> _Sensor:
        return self._replace(estimate=torch.einsum("...ij,...aj->...ai", self.system.F, self.estimate))

    @property
    def error(self) -> Tensor:
        """That is to be taken off a sample, `(flight, 3)`."""
        return torch.einsum("...j,...aj->...a", self.system.H[..., 0, :], self.estimate)


def fly(
    trajectory: Trajectory,
    drawn: Drawn,
    told: UnitErrors,
    *,
    gnss: Gnss | None = None,
    alignment: Alignment | None = None,
    generator: torch.Generator,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> Flown:
    """Fly many times with drawn errors, and estimate with a filter that is told a model of them.

    Args:
        trajectory: Of all flights.
        drawn: Errors of the unit's samples.
        told: What the filter believes about them.
        gnss: One position a second, and none from 160 to 210 s, by default.
        alignment: What is known at first.
        generator: Of the positions' and the alignment's errors: the same seed gives every filter the same.
        progress: Is told the share done.

    Returns:
        Errors at every tenth sample and right after every fix.

    Raises:
        ValueError: Fixes that are not a whole number of samples apart.
    """
    gnss, alignment = gnss or Gnss(), alignment or Alignment()
    dt, earth = 1 / told.rate, trajectory.earth_rate
    frame = Frame.of(dt, earth)
    ideal = trajectory.increments(told.rate)
    n_flights, n_samples = drawn.gyro.samples.shape[:2]
    n_samples = min(n_samples, len(ideal.angle))
    every = gnss.samples_apart(told.rate)
    truth = trajectory.at(torch.arange(n_samples + 1, dtype=torch.float64) * dt)
    sensors = [_Sensor(s, s.x0[..., None, :].expand(n_flights, 3, -1)) for s in told.systems()]
    covariance = _initial(alignment, sensors, n_flights)
    off = torch.randn(n_flights, 9, generator=generator, dtype=torch.float64) * alignment.sd
    state = State(
        multiply(from_rotation_vector(-off[:, _ATTITUDE]), truth.attitude[0].expand(n_flights, 4)),
        truth.velocity[0] + off[:, _VELOCITY],
        truth.position[0] + off[:, _POSITION],
    )
    sd = torch.tensor(gnss.sd, dtype=torch.float64)
    before = (ideal.angle[0].expand(n_flights, 3), ideal.velocity[0].expand(n_flights, 3))
    seen, nis = [], []
    first = 0
    while first < n_samples:
        last = min(first + _TOGETHER, (first // every + 1) * every, n_samples)
        start, pushed = state, torch.zeros_like(state.velocity)
        for k in range(first, last):
            sensors = [sensor.predicted() for sensor in sensors]
            now = tuple(
                (own[k] + dt * (axes.samples[:, k] - sensor.error))
                for own, axes, sensor in zip(ideal, drawn, sensors, strict=True)
            )
            before_turn = state.attitude
            state = step(state, (now[0], now[1]), before, frame)
            before = now[0], now[1]
            pushed = pushed + rotate(before_turn, now[1])
        middle = matrix(multiply(start.attitude, from_rotation_vector(0.5 * rotation_vector(_between(start, state)))))
        covariance = _carried(covariance, middle, pushed / ((last - first) * dt), sensors, earth, dt, last - first)
        # Drawn where there is no fix as well: what comes after an outage does not depend on it.
        noise = torch.randn(n_flights, 3, generator=generator, dtype=torch.float64) * sd if last % every == 0 else None
        if noise is not None and gnss.available(last * dt):
            state, sensors, covariance, told_apart = _corrected(
                state, sensors, covariance, truth.position[last] + noise, sd
            )
            nis.append(told_apart)
        known = [axes.states[:, last - 1] for axes in drawn]
        seen.append((last * dt, *_errors(state, truth, last, sensors, known, covariance)))
        first = last
        progress("flying", last / n_samples)
    time, error, claimed, nees = zip(*seen, strict=True)
    sizes = (3, 3, 3, 3 * sum(s.system.F.shape[-1] for s in sensors))
    return Flown(
        torch.tensor(time, dtype=torch.float64),
        torch.stack(error),
        torch.stack(claimed),
        torch.stack(nees),
        sizes,
        torch.stack(nis) if nis else off.new_zeros(0, n_flights),
    )


def _between(start: State, end: State) -> Tensor:
    return multiply(conjugate(start.attitude), end.attitude)


def _initial(alignment: Alignment, sensors: list[_Sensor], n_flights: int) -> Tensor:
    """Covariance at first, `(flight, state, state)`: that of the sensors' states is their model's."""
    blocks = [torch.diag(alignment.sd.square()).expand(n_flights, 9, 9)]
    for sensor in sensors:
        n_states = sensor.system.F.shape[-1]
        blocks += [sensor.system.P0.expand(n_flights, n_states, n_states)] * 3
    return _diagonal(blocks)


def _diagonal(blocks: list[Tensor]) -> Tensor:
    """Block diagonal of matrices `(flight, i, i)`."""
    size = sum(block.shape[-1] for block in blocks)
    whole, at = blocks[0].new_zeros(blocks[0].shape[0], size, size), 0
    for block in blocks:
        n = block.shape[-1]
        whole[:, at : at + n, at : at + n] = block
        at += n
    return whole


def _carried(
    covariance: Tensor, turn: Tensor, force: Tensor, sensors: list[_Sensor], earth: Tensor, dt: float, n: int
) -> Tensor:
    """Covariance `n` samples on, attitude `(flight, 3, 3)` and force `(flight, 3)` taken for constant meanwhile.

    One sample's transition and noise are composed: twice as long ones from two halves.
    """
    transition, noise = _one_sample(turn, force, sensors, earth, dt, covariance.shape[-1])
    done: tuple[Tensor, Tensor] | None = None
    while n:
        if n & 1:
            if done is None:
                done = transition, noise
            else:
                done = transition @ done[0], transition @ done[1] @ transition.mT + noise
        n >>= 1
        if n:
            noise = transition @ noise @ transition.mT + noise
            transition = transition @ transition
    assert done is not None
    moved = done[0] @ covariance @ done[0].mT + done[1]  # (3.46), the noise composed instead of halved
    return (moved + moved.mT) / 2


def _one_sample(
    turn: Tensor, force: Tensor, sensors: list[_Sensor], earth: Tensor, dt: float, size: int
) -> tuple[Tensor, Tensor]:
    """Transition (14.50) and noise (14.82) of one sample, `(flight, state, state)` each."""
    n_flights = len(turn)
    eye = torch.eye(size, dtype=turn.dtype)
    transition = eye.expand(n_flights, size, size).clone()
    noise = torch.zeros_like(transition)
    transition[:, _ATTITUDE, _ATTITUDE] -= dt * skew(earth)
    transition[:, _VELOCITY, _ATTITUDE] = dt * skew(force)
    transition[:, _VELOCITY, _VELOCITY] -= 2 * dt * skew(earth)
    transition[:, _POSITION, _VELOCITY] = dt * eye[:3, :3]
    at = 9
    for sensor, row, sign in zip(sensors, (_ATTITUDE, _VELOCITY), (-1.0, 1.0), strict=True):
        s, n = sensor.system, sensor.system.F.shape[-1]
        # Column (axis, state) of what an axis's error does to the error that it drives.
        output = turn[..., None] * s.H[..., 0, :].expand(n_flights, n)[:, None, None, :]
        output = sign * dt * output.flatten(-2)
        F = _diagonal([s.F.expand(n_flights, n, n)] * 3)
        Q = _diagonal([s.Q.expand(n_flights, n, n)] * 3)
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


def _corrected(
    state: State, sensors: list[_Sensor], covariance: Tensor, fix: Tensor, sd: Tensor
) -> tuple[State, list[_Sensor], Tensor, Tensor]:
    """Everything after a position `(flight, 3)`, and the innovation squared in units of its covariance."""
    innovation = state.position - fix  # (14.102) with H of (14.115), both with the other sign
    spread = covariance[:, _POSITION, _POSITION] + torch.diag(sd.square())
    root = torch.linalg.cholesky(spread)
    gain = torch.cholesky_solve(covariance[:, _POSITION, :], root).mT  # (3.21), (flight, state, 3)
    error = (gain @ innovation[..., None])[..., 0]  # (3.24), nothing being predicted in closed loop
    surprise = torch.linalg.solve_triangular(root, innovation[..., None], upper=False).square().sum((-1, -2))
    # (I - K H) P (I - K H)' + K R K', which stays positive definite (Joseph).
    kept = torch.eye(covariance.shape[-1], dtype=covariance.dtype).repeat(len(covariance), 1, 1)
    kept[:, :, _POSITION] -= gain
    covariance = kept @ covariance @ kept.mT + gain * sd.square() @ gain.mT
    state = State(  # (14.7) to (14.9)
        multiply(from_rotation_vector(error[:, _ATTITUDE]), state.attitude),
        state.velocity - error[:, _VELOCITY],
        state.position - error[:, _POSITION],
    )
    at, corrected = 9, []
    for sensor in sensors:
        n = sensor.estimate.shape[-1]
        corrected.append(sensor._replace(estimate=sensor.estimate + error[:, at : at + 3 * n].unflatten(-1, (3, n))))
        at += 3 * n
    return state, corrected, (covariance + covariance.mT) / 2, surprise


def _errors(
    state: State, truth: tuple[Tensor, ...], at: int, sensors: list[_Sensor], known: list[Tensor], covariance: Tensor
) -> tuple[Tensor, ...]:
    """Errors of all states, claimed standard deviations, and squared errors of kinds of states in their units."""
    position, velocity, attitude = (part[at] for part in truth[:3])
    psi = rotation_vector(multiply(attitude.expand_as(state.attitude), conjugate(state.attitude)))
    off = [psi, state.velocity - velocity, state.position - position]
    slices = [_ATTITUDE, _VELOCITY, _POSITION, slice(9, covariance.shape[-1])]
    if all(k.shape[-1] == s.estimate.shape[-1] for k, s in zip(known, sensors, strict=True)):
        left = [(k - s.estimate).flatten(-2) for k, s in zip(known, sensors, strict=True)]
    else:
        left = [torch.full_like(s.estimate, torch.nan).flatten(-2) for s in sensors]
    off.append(torch.cat(left, -1))
    nees = [_nees(error, covariance[:, own, own]) for error, own in zip(off, slices, strict=True)]
    claimed = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    return torch.cat(off, -1), claimed, torch.stack(nees, -1)


def _nees(error: Tensor, covariance: Tensor) -> Tensor:
    if not error.shape[-1] or not bool(error.isfinite().all()):
        return error.new_full(error.shape[:-1], torch.nan)
    root, failed = torch.linalg.cholesky_ex(covariance)
    value = torch.linalg.solve_triangular(root, error[..., None], upper=False).square().sum((-1, -2))
    return value.masked_fill(failed > 0, torch.nan)
