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
from gyrofuse._base.deprecation import moved_names, renamed_arguments
from gyrofuse.navigation.attitude import conjugate, from_rotation_vector, matrix, multiply, rotate, rotation_vector
from gyrofuse.navigation.covariance import (
    ATTITUDE,
    N_NAVIGATION,
    POSITION,
    VELOCITY,
    initial_covariance,
    predicted_covariance,
)
from gyrofuse.navigation.sensors import ErrorSamples, UnitErrors
from gyrofuse.navigation.strapdown import Frame, State, step
from gyrofuse.navigation.trajectory import Trajectory
from gyrofuse.noise.state_space import StateSpace

# Samples between two predictions of the covariance, and between two recorded errors. Attitude and specific force are
# taken as constant in between: at 100 Hz, for 0.1 s. It divides the 100 samples between two fixes of the defaults.
_PREDICTION_INTERVAL = 10


@dataclass(frozen=True)
class Gnss:
    """Position fixes from satellites.

    Attributes:
        rate: Rate of the fixes, Hz; the sampling rate of the inertial unit is a multiple of it.
        sd: Standard deviations of the errors of north, east and down, independent from fix to fix, m.
        outage: Start and end of the interval without fixes, s; None for none.

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
        """Number of samples of the inertial unit from fix to fix.

        Args:
            rate: Sampling rate of the unit, Hz.

        Raises:
            ValueError: The number is not whole.
        """
        apart = rate / self.rate
        if round(apart) < 1 or not math.isclose(apart, round(apart), rel_tol=1e-6):
            raise ValueError(
                f"`gnss`: expected fixes a whole number of the unit's samples apart, got {self.rate:g} Hz beside "
                f"{rate:g} Hz; choose a rate of the unit that is a multiple of that of the fixes"
            )
        return round(apart)

    def available(self, time: float) -> bool:
        """Whether there is a fix at a time (s)."""
        return self.outage is None or not self.outage[0] < time <= self.outage[1]


@dataclass(frozen=True)
class InitialUncertainty:
    """Standard deviations of the initial errors.

    Attributes:
        attitude: Attitude about north, east and down, rad.
        velocity: Velocity along each axis, m/s.
        position: Position along each axis, m.
    """

    attitude: tuple[float, float, float] = (math.radians(0.5), math.radians(0.5), math.radians(2.0))
    velocity: float = 0.1
    position: float = 1.0

    @property
    def sd(self) -> Tensor:
        """Standard deviations of the nine navigation errors, `(9,)`."""
        return torch.tensor([*self.attitude, *[self.velocity] * 3, *[self.position] * 3], dtype=torch.float64)


class FilterErrors(NamedTuple):
    """Errors of a navigation filter over flights.

    Attributes:
        time: Time, s, `(time,)`.
        error: Errors of attitude (`psi`, rad), velocity (m/s), position (m) and the sensors' states, axis by axis,
            gyros first, `(time, flight, state)`; NaN where the true state is not known.
        sd: Standard deviations of these errors by the filter's covariance, `(time, flight, state)`.
        nees: Normalized estimation error squared, by the filter's covariance, of attitude, velocity, position and the
            sensors' states, `(time, flight, 4)`; NaN where the true state is not known.
        sizes: Number of states in each entry of `nees`, its expectation for a consistent filter.
        nis: Normalized innovation squared, `(fix, flight)`, of three components: its expectation is 3.

    References:
        Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, section 5.4.
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
        return self.error[..., ATTITUDE]

    @property
    def velocity(self) -> Tensor:
        """Errors of velocity, m/s."""
        return self.error[..., VELOCITY]

    @property
    def position(self) -> Tensor:
        """Errors of position, m."""
        return self.error[..., POSITION]


class _Sensor(NamedTuple):
    """Three axes of one kind of sensor: its noise model, matrices `(flight or 1, ...)`, and the estimated states."""

    system: StateSpace
    estimate: Tensor  # (flight, 3, state)

    def predicted(self) -> _Sensor:
        return self._replace(estimate=torch.einsum("...ij,...aj->...ai", self.system.F, self.estimate))

    @property
    def error(self) -> Tensor:
        """Estimated error of a sample, `(flight, 3)`."""
        return torch.einsum("...j,...aj->...a", self.system.H[..., 0, :], self.estimate)


@renamed_arguments(drawn="errors", told="assumed", alignment="initial_uncertainty")
def run_filter(
    trajectory: Trajectory,
    errors: ErrorSamples,
    assumed: UnitErrors,
    *,
    gnss: Gnss | None = None,
    initial_uncertainty: InitialUncertainty | None = None,
    generator: torch.Generator,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> FilterErrors:
    """Estimate many flights along one trajectory with an error-state Kalman filter, and return its errors.

    Args:
        trajectory: True trajectory of all flights.
        errors: True errors of the inertial unit's samples.
        assumed: Noise model of the unit that the filter assumes.
        gnss: Position fixes; by default one a second, and none from 160 to 210 s.
        initial_uncertainty: Standard deviations of the initial errors, which the filter knows.
        generator: Random numbers of the fixes' and the initial errors: the same seed gives every filter the same.
        progress: Callback that gets a description and the share done, 0 to 1.

    Returns:
        Errors at every tenth sample and right after every fix.

    Raises:
        ValueError: Fixes that are not a whole number of samples apart.

    References:
        Groves, second edition, sections 3.2 and 14.2 to 14.3.
    """
    gnss, initial = gnss or Gnss(), initial_uncertainty or InitialUncertainty()
    dt, earth = 1 / assumed.rate, trajectory.earth_rate
    frame = Frame.of(dt, earth)
    ideal = trajectory.increments(assumed.rate)
    n_flights, n_samples = errors.gyro.samples.shape[:2]
    n_samples = min(n_samples, len(ideal.angle))
    fix_interval = gnss.samples_apart(assumed.rate)
    truth = trajectory.at(torch.arange(n_samples + 1, dtype=torch.float64) * dt)
    systems = assumed.systems()
    sensors = [_Sensor(s, s.x0[..., None, :].expand(n_flights, 3, -1)) for s in systems]
    covariance = initial_covariance(initial.sd, systems, n_flights)
    off = torch.randn(n_flights, N_NAVIGATION, generator=generator, dtype=torch.float64) * initial.sd
    state = State(
        multiply(from_rotation_vector(-off[:, ATTITUDE]), truth.attitude[0].expand(n_flights, 4)),
        truth.velocity[0] + off[:, VELOCITY],
        truth.position[0] + off[:, POSITION],
    )
    sd = torch.tensor(gnss.sd, dtype=torch.float64)
    before = (ideal.angle[0].expand(n_flights, 3), ideal.velocity[0].expand(n_flights, 3))
    recorded, nis = [], []
    first = 0
    while first < n_samples:
        last = min(first + _PREDICTION_INTERVAL, (first // fix_interval + 1) * fix_interval, n_samples)
        start, pushed = state, torch.zeros_like(state.velocity)
        for k in range(first, last):
            sensors = [sensor.predicted() for sensor in sensors]
            now = tuple(
                (own[k] + dt * (axes.samples[:, k] - sensor.error))
                for own, axes, sensor in zip(ideal, errors, sensors, strict=True)
            )
            before_turn = state.attitude
            state = step(state, (now[0], now[1]), before, frame)
            before = now[0], now[1]
            pushed = pushed + rotate(before_turn, now[1])
        middle = matrix(multiply(start.attitude, from_rotation_vector(0.5 * rotation_vector(_between(start, state)))))
        force = pushed / ((last - first) * dt)
        covariance = predicted_covariance(covariance, middle, force, systems, earth, dt, last - first)
        if last % fix_interval == 0:
            # Drawn during an outage as well, so that the fixes after an outage do not depend on its length.
            noise = torch.randn(n_flights, 3, generator=generator, dtype=torch.float64) * sd
            if gnss.available(last * dt):
                fix = truth.position[last] + noise
                state, sensors, covariance, innovation_squared = _corrected(state, sensors, covariance, fix, sd)
                nis.append(innovation_squared)
        known = [axes.states[:, last - 1] for axes in errors]
        recorded.append((last * dt, *_errors(state, truth, last, sensors, known, covariance)))
        first = last
        progress("flying", last / n_samples)
    time, error, claimed, nees = zip(*recorded, strict=True)
    sizes = (3, 3, 3, 3 * sum(s.F.shape[-1] for s in systems))
    return FilterErrors(
        torch.tensor(time, dtype=torch.float64),
        torch.stack(error),
        torch.stack(claimed),
        torch.stack(nees),
        sizes,
        torch.stack(nis) if nis else off.new_zeros(0, n_flights),
    )


def _between(start: State, end: State) -> Tensor:
    return multiply(conjugate(start.attitude), end.attitude)


def _corrected(
    state: State, sensors: list[_Sensor], covariance: Tensor, fix: Tensor, sd: Tensor
) -> tuple[State, list[_Sensor], Tensor, Tensor]:
    """State, sensors and covariance after a fix `(flight, 3)`, and its normalized innovation squared `(flight,)`."""
    innovation = state.position - fix  # (14.102) with H of (14.115), both with the other sign
    innovation_cov = covariance[:, POSITION, POSITION] + torch.diag(sd.square())
    root = torch.linalg.cholesky(innovation_cov)
    gain = torch.cholesky_solve(covariance[:, POSITION, :], root).mT  # (3.21), (flight, state, 3)
    error = (gain @ innovation[..., None])[..., 0]  # (3.24), nothing being predicted in closed loop
    squared = torch.linalg.solve_triangular(root, innovation[..., None], upper=False).square().sum((-1, -2))
    # (I - K H) P (I - K H)' + K R K', which stays positive definite (Joseph).
    kept = torch.eye(covariance.shape[-1], dtype=covariance.dtype).repeat(len(covariance), 1, 1)
    kept[:, :, POSITION] -= gain
    covariance = kept @ covariance @ kept.mT + gain * sd.square() @ gain.mT
    state = State(  # (14.7) to (14.9)
        multiply(from_rotation_vector(error[:, ATTITUDE]), state.attitude),
        state.velocity - error[:, VELOCITY],
        state.position - error[:, POSITION],
    )
    at, corrected = N_NAVIGATION, []
    for sensor in sensors:
        n = sensor.estimate.shape[-1]
        corrected.append(sensor._replace(estimate=sensor.estimate + error[:, at : at + 3 * n].unflatten(-1, (3, n))))
        at += 3 * n
    return state, corrected, (covariance + covariance.mT) / 2, squared


def _errors(
    state: State, truth: tuple[Tensor, ...], at: int, sensors: list[_Sensor], known: list[Tensor], covariance: Tensor
) -> tuple[Tensor, ...]:
    """Errors of all states, their standard deviations by the filter, and the NEES of the four kinds of states."""
    position, velocity, attitude = (part[at] for part in truth[:3])
    psi = rotation_vector(multiply(attitude.expand_as(state.attitude), conjugate(state.attitude)))
    off = [psi, state.velocity - velocity, state.position - position]
    slices = [ATTITUDE, VELOCITY, POSITION, slice(N_NAVIGATION, covariance.shape[-1])]
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


__getattr__ = moved_names(
    __name__,
    {
        "Alignment": "gyrofuse.navigation.filter.InitialUncertainty",
        "Flown": "gyrofuse.navigation.filter.FilterErrors",
        "fly": "gyrofuse.navigation.filter.run_filter",
    },
)
