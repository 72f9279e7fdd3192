"""What an error model costs in the air: flights with the same errors, filtered with one model and with another."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.checks import check_confidence_level, check_positive_integer
from gyrofuse._base.results import ConfidenceInterval, cleaned, listed
from gyrofuse.navigation.filter import Alignment, Flown, Gnss, fly
from gyrofuse.navigation.sensors import UnitErrors
from gyrofuse.navigation.trajectory import Trajectory, flight
from gyrofuse.noise.model import Model

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RESAMPLES = 1000
_FEWEST = 5  # flights, for limits
_ACCELEROMETER = "WN(variance=1e-4) + RW(variance=1e-11)"  # m/s^2, of a sample


class Peak(NamedTuple):
    """The largest ratio, and limits that know that it was chosen for being the largest.

    Attributes:
        time: s.
        ratio: Of mean position errors.
        low: Lower limit, by resampling flights and choosing anew each time; NaN with fewer than five flights.
        high: Upper limit.
    """

    time: float
    ratio: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Emulation:
    """Errors of navigation with a filter that is told one model, and with one that is told another.

    Attributes:
        time: s, `(time,)`.
        position: Mean length of the position error over flights, m, of the one and of the other, `(2, time)`.
        attitude: Mean length of the attitude error, rad, likewise.
        ratio: Of the position errors, the one over the other, `(time,)`.
        interval: Its limits at each time, by resampling flights, `(time,)` each; NaN with fewer than five flights.
        peak: The largest ratio of the outage, or anywhere without one.
        confidence_level: Of all limits.
        n_flights: Flights.
        outage: s, as far as the flights go; None without one.
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
        """The costs in a few lines."""
        when, ratio, low, high = self.peak
        where = "during the outage" if self.outage is not None else "at most"
        end = int((self.time - (self.outage[1] if self.outage else float(self.time[-1]))).abs().argmin())
        lines = [
            f"{self.n_flights} flights of {float(self.time[-1]):g} s",
            f"Position error of the first model over that of the second, {where}: {ratio:.4f} "
            f"[{low:.4f}, {high:.4f}] at {when:.5g} s",
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
            ax: Where to draw; new axes by default.

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


def emulate(
    model: Model,
    against: Model,
    *,
    truth: Model | None = None,
    accelerometer: Model | None = None,
    rate: float = 100.0,
    trajectory: Trajectory | None = None,
    gnss: Gnss | None = None,
    alignment: Alignment | None = None,
    n_flights: int = 500,
    confidence_level: float = 0.95,
    generator: torch.Generator | None = None,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> Emulation:
    """Compare what two noise models of gyros cost in position and attitude.

    The same errors are drawn once, and each flight is estimated twice, by filters that differ in what they are told.

    Args:
        model: Of the gyros, that the first filter is told: of samples, rad/s. Parameters may have a batch dimension,
            one model for each flight.
        against: That the second is told.
        truth: That makes the errors; by default `against`.
        accelerometer: Noise of the accelerometers, m/s^2, known to both; by default that of a fair MEMS unit.
        rate: Of the unit, Hz.
        trajectory: By default a flight of 235 s.
        gnss: By default one position a second of 1 to 1.5 m, and none from 160 to 210 s.
        alignment: What is known at first.
        n_flights: How many.
        confidence_level: Of the limits of the ratio.
        generator: Source of all random numbers.
        progress: Is told the share done.

    Returns:
        Errors over time, and their ratio.

    Raises:
        ValueError: Models without a state space, of other batch sizes, numbers out of range, or fixes that are not a
            whole number of samples apart.

    References:
        Voirol et al., section on the emulation study, steps (iii) and (iv).
    """
    check_positive_integer("n_flights", n_flights)
    check_confidence_level(confidence_level)
    for name, given in (("model", model), ("against", against), ("truth", truth)):
        if given is not None and given.params.ndim > 1 and given.params.shape[:-1] != (n_flights,):
            raise ValueError(
                f"`{name}`: expected one model, or one for each of {n_flights} flights, got parameters of shape "
                f"{tuple(given.params.shape)}"
            )
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    path, gnss = trajectory or flight(), gnss or Gnss()
    gnss.samples_apart(rate)
    shared = _accelerometer() if accelerometer is None else accelerometer
    n_samples = round(path.duration * rate)
    drawn = UnitErrors(against if truth is None else truth, shared, rate).simulate(n_samples, n_flights, generator)
    seed = int(torch.randint(2**62, (), generator=generator))
    flown = []
    for number, told in enumerate((model, against)):

        def half(what: str, share: float, number: int = number) -> None:
            progress(what, (number + share) / 2)

        own = torch.Generator().manual_seed(seed)  # the same fixes and the same alignment for both
        flown.append(
            fly(
                path,
                drawn,
                UnitErrors(told, shared, rate),
                gnss=gnss,
                alignment=alignment,
                generator=own,
                progress=half,
            )
        )
    outage = gnss.outage
    if outage is not None:
        outage = (outage[0], min(outage[1], path.duration)) if outage[0] < path.duration else None
    return _compared(flown[0], flown[1], outage, confidence_level, generator)


def _accelerometer() -> Model:
    from gyrofuse.noise.parsing import parse_model

    return parse_model(_ACCELEROMETER)


def _compared(
    one: Flown, other: Flown, outage: tuple[float, float] | None, level: float, generator: torch.Generator
) -> Emulation:
    lengths = torch.stack([flown.position.norm(dim=-1) for flown in (one, other)])  # (2, time, flight)
    position = lengths.mean(-1)
    n = lengths.shape[-1]
    resampled = torch.randint(n, (_RESAMPLES, n), generator=generator)
    share = torch.zeros(n, _RESAMPLES, dtype=lengths.dtype)
    share.scatter_add_(0, resampled.mT, torch.ones_like(share))
    means = lengths @ share / n  # (2, time, resample): flights stay together, so both share what they have in common
    tails = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=lengths.dtype)
    ratio, ratios = position[0] / position[1], means[0] / means[1]
    inside = torch.ones_like(one.time, dtype=torch.bool)
    if outage is not None:
        inside = (one.time > outage[0]) & (one.time <= outage[1])
    at = int(torch.where(inside, ratio, -torch.inf).argmax())
    largest = float(ratio[at])
    # The largest of many is too large, and that of resampled flights is by as much larger again: turned round.
    below, above = (largest**2 / ratios[inside].amax(0).quantile(tails.flip(0))).tolist()
    above = max(above, largest)
    low, high = ratios.quantile(tails, dim=-1)
    if n < _FEWEST:
        below = above = math.nan
        low, high = (torch.full_like(ratio, torch.nan) for _ in range(2))
    attitude = torch.stack([flown.attitude.norm(dim=-1).mean(-1) for flown in (one, other)])
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
