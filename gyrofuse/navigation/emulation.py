"""Effect of a noise model on navigation: the same flights are estimated by two filters that assume different models."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.checks import check_confidence_level, check_positive_integer, repeatable_generator
from gyrofuse._base.deprecation import moved_names, renamed_arguments
from gyrofuse._base.results import ConfidenceInterval, cleaned, listed
from gyrofuse.navigation.filter import FilterErrors, Gnss, InitialUncertainty, run_filter
from gyrofuse.navigation.sensors import UnitErrors
from gyrofuse.navigation.trajectory import Trajectory, flight
from gyrofuse.noise.model import Model

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Fewest flights for confidence limits. A bootstrap of five has 126 distinct resamples, of four 35: too few for the
# tails; and a percentile interval is too short by the factor sqrt(1 - 1 / flights), 0.89 at five.
_MIN_FLIGHTS = 5
# Noise of a consumer-grade MEMS accelerometer, (m/s^2)^2 per sample: 0.01 m/s^2 white, and a slow random walk.
_ACCELEROMETER = "WN(variance=1e-4) + RW(variance=1e-11)"


class Peak(NamedTuple):
    """Largest ratio over time, with limits that account for the choice of its time.

    Attributes:
        time: Time of the largest ratio, s.
        ratio: Ratio of mean position errors.
        low: Lower limit, from resampled flights with the maximum taken anew in each; NaN with fewer than five flights.
        high: Upper limit, likewise.
    """

    time: float
    ratio: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Emulation:
    """Errors of two navigation filters that assume different noise models, on the same flights.

    Attributes:
        time: Time, s, `(time,)`.
        position: Mean length of the position error over flights, m, of the first and the second filter, `(2, time)`.
        attitude: Mean length of the attitude error over flights, rad, of both filters, `(2, time)`.
        ratio: Position error of the first filter over that of the second, `(time,)`.
        interval: Limits of `ratio` at each time, by resampling flights, `(time,)` each; NaN with fewer than five
            flights.
        peak: Largest ratio during the outage, or at any time where there is no outage.
        confidence_level: Confidence level of all limits.
        n_flights: Number of flights.
        outage: Start and end of the interval without satellites within the flights, s; None without one.
    """

    time: Tensor
    position: Tensor
    attitude: Tensor
    ratio: Tensor
    interval: ConfidenceInterval
    peak: Peak
    confidence_level: float
    n_flights: int
    outage: tuple[float, float] | None

    def summary(self) -> str:
        """Errors of both filters and their ratio, in a few lines."""
        when, ratio, low, high = self.peak
        where = "during the outage" if self.outage is not None else "at most"
        limits = f"[{low:.4f}, {high:.4f}]" if math.isfinite(low) else f"(no interval: {_MIN_FLIGHTS} flights at least)"
        end = int((self.time - (self.outage[1] if self.outage else float(self.time[-1]))).abs().argmin())
        lines = [
            f"{self.n_flights} flights of {float(self.time[-1]):g} s",
            f"Position error of the first model over that of the second, {where}: {ratio:.4f} {limits} at {when:.5g} s",
            f"{'':<10}{'position (m)':>14}{'attitude (deg)':>16}   at {float(self.time[end]):.5g} s",
        ]
        for name, position, attitude in zip(("first", "second"), self.position, self.attitude.rad2deg(), strict=True):
            lines.append(f"{name:<10}{float(position[end]):>14.4g}{float(attitude[end]):>16.4g}")
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the ratio of position errors over time with its band.

        Args:
            ax: Axes to draw on; new ones by default.

        Returns:
            The axes.
        """
        from gyrofuse.navigation.plots import plot_ratio_over_time

        return plot_ratio_over_time(self.time, self.ratio, self.interval, outage=self.outage, ax=ax)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, ready for JSON."""
        return {
            "n_flights": self.n_flights,
            "confidence_level": self.confidence_level,
            "outage": None if self.outage is None else list(self.outage),
            "peak": cleaned(self.peak._asdict()),
            "time": listed(self.time),
            "ratio": listed(self.ratio),
            "low": listed(self.interval.low),
            "high": listed(self.interval.high),
            "position": listed(self.position),
            "attitude": listed(self.attitude),
        }


@renamed_arguments(against="reference", alignment="initial_uncertainty")
def compare_filters(
    model: Model,
    reference: Model,
    *,
    truth: Model | None = None,
    accelerometer: Model | None = None,
    rate: float = 100.0,
    trajectory: Trajectory | None = None,
    gnss: Gnss | None = None,
    initial_uncertainty: InitialUncertainty | None = None,
    n_flights: int = 500,
    confidence_level: float = 0.95,
    generator: torch.Generator | None = None,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> Emulation:
    """Compare the position and attitude errors of two navigation filters that assume different gyro noise models.

    Sensor errors are simulated once; each flight is estimated twice, by filters that differ in the assumed model only.

    Args:
        model: Gyro noise model (rad/s per sample) assumed by the first filter. Parameters may have a batch dimension,
            one model for each flight.
        reference: Gyro noise model assumed by the second filter, likewise.
        truth: Gyro noise model that generates the errors; `reference` by default.
        accelerometer: Noise model of the accelerometers (m/s^2 per sample), which generates their errors and is
            assumed by both filters; by default that of a consumer-grade MEMS unit.
        rate: Sampling rate of the inertial unit, Hz.
        trajectory: True trajectory; by default a flight of 235 s.
        gnss: Position fixes; by default one a second with errors of 1 to 1.5 m, and none from 160 to 210 s.
        initial_uncertainty: Standard deviations of the initial errors.
        n_flights: Number of flights.
        confidence_level: Confidence level of the limits of the ratio.
        generator: Source of all random numbers.
        progress: Callback that gets a description and the share done, 0 to 1.

    Returns:
        Errors of both filters over time, and the ratio of their position errors.

    Raises:
        ValueError: Models without a state space, of other batch sizes, numbers out of range, or fixes that are not a
            whole number of samples apart.

    References:
        Voirol et al., section on the emulation study, steps (iii) and (iv).
    """
    check_positive_integer("n_flights", n_flights)
    check_confidence_level(confidence_level)
    for name, given in (("model", model), ("reference", reference), ("truth", truth)):
        if given is not None and given.params.ndim > 1 and given.params.shape[:-1] != (n_flights,):
            raise ValueError(
                f"`{name}`: expected one model, or one for each of {n_flights} flights, got parameters of shape "
                f"{tuple(given.params.shape)}"
            )
    generator = repeatable_generator(generator)
    path, gnss = trajectory or flight(), gnss or Gnss()
    gnss.samples_apart(rate)
    shared = _accelerometer() if accelerometer is None else accelerometer
    n_samples = round(path.duration * rate)
    errors = UnitErrors(reference if truth is None else truth, shared, rate).simulate(n_samples, n_flights, generator)
    seed = int(torch.randint(2**62, (), generator=generator))
    filtered = []
    for number, assumed in enumerate((model, reference)):

        def half(what: str, share: float, number: int = number) -> None:
            progress(what, (number + share) / 2)

        own = torch.Generator().manual_seed(seed)  # the same fixes and the same initial errors for both filters
        filtered.append(
            run_filter(
                path,
                errors,
                UnitErrors(assumed, shared, rate),
                gnss=gnss,
                initial_uncertainty=initial_uncertainty,
                generator=own,
                progress=half,
            )
        )
    outage = gnss.outage
    if outage is not None:
        outage = (outage[0], min(outage[1], path.duration)) if outage[0] < path.duration else None
    return _compared(filtered[0], filtered[1], outage, confidence_level, generator)


def _accelerometer() -> Model:
    from gyrofuse.noise.parsing import parse_model

    return parse_model(_ACCELEROMETER)


def _compared(
    one: FilterErrors,
    other: FilterErrors,
    outage: tuple[float, float] | None,
    level: float,
    generator: torch.Generator,
    n_resamples: int = 1000,
) -> Emulation:
    """Ratio of the mean position errors, and its limits from a bootstrap over flights.

    With 1000 resamples the probability beyond a 95 % limit has a Monte Carlo standard error of 0.005.
    """
    lengths = torch.stack([errors.position.norm(dim=-1) for errors in (one, other)])  # (2, time, flight)
    position = lengths.mean(-1)
    n = lengths.shape[-1]
    resampled = torch.randint(n, (n_resamples, n), generator=generator)
    share = torch.zeros(n, n_resamples, dtype=lengths.dtype)
    share.scatter_add_(0, resampled.mT, torch.ones_like(share))
    means = lengths @ share / n  # (2, time, resample); the same flights are resampled for both filters
    tails = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=lengths.dtype)
    ratio, ratios = position[0] / position[1], means[0] / means[1]
    inside = torch.ones_like(one.time, dtype=torch.bool)
    if outage is not None:
        inside = (one.time > outage[0]) & (one.time <= outage[1])
    at = int(torch.where(inside, ratio, -torch.inf).argmax())
    largest = float(ratio[at])
    # The maximum over time is biased upwards, and its bootstrap replicates are biased by as much again: the basic
    # (reversed) bootstrap interval, in logarithms, corrects for it.
    below, above = (largest**2 / ratios[inside].amax(0).quantile(tails.flip(0))).tolist()
    above = max(above, largest)
    low, high = ratios.quantile(tails, dim=-1)
    if n < _MIN_FLIGHTS:
        below = above = math.nan
        low, high = (torch.full_like(ratio, torch.nan) for _ in range(2))
    attitude = torch.stack([errors.attitude.norm(dim=-1).mean(-1) for errors in (one, other)])
    return Emulation(
        time=one.time,
        position=position,
        attitude=attitude,
        ratio=ratio,
        interval=ConfidenceInterval(low, high),
        peak=Peak(float(one.time[at]), largest, below, above),
        confidence_level=level,
        n_flights=n,
        outage=outage,
    )


__getattr__ = moved_names(__name__, {"emulate": "gyrofuse.navigation.emulation.compare_filters"})
