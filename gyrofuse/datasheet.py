"""A fitted model in the units of a sensor's datasheet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from gyrofuse import units
from gyrofuse._checks import check_positive
from gyrofuse.processes import (
    AR1,
    Drift,
    Model,
    Process,
    QuantizationNoise,
    RandomWalk,
    Sinusoid,
    WhiteNoise,
)

_WHITE_AFTER = 1.0  # s
_LEVELS = 40  # where the floor of the Allan deviation is looked for: of any record


class DatasheetEntry(NamedTuple):
    """One quantity of a datasheet."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class Datasheet:
    """A model's parameters in datasheet units.

    Attributes:
        rate: Hz.
        unit: Rate unit of the model.
        entries: Angle random walk, then the rest in the order of the model's processes; one may appear in two units.
    """

    rate: float
    unit: str
    entries: tuple[DatasheetEntry, ...]

    def summary(self) -> str:
        """Return a table of fixed width."""
        head = f"Datasheet at {self.rate:g} Hz, model in {self.unit}"
        rows = [f"{e.name:<30}{e.value:>14.6g}  {e.unit}" for e in self.entries]
        return "\n".join([head, *rows])

    def __str__(self) -> str:
        return self.summary()

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
        return {"rate": self.rate, "unit": self.unit, "entries": [e._asdict() for e in self.entries]}


def datasheet(model: Model, rate: float, unit: str, *, n_levels: int = _LEVELS) -> Datasheet:
    """Translate a model into angle random walk, bias instability, rate random walk and the like.

    Where no white noise is left, angle random walk is that of AR1s with a correlation time below one second.

    Bias instability is the lowest local minimum of the Allan deviation, without tones and drifts, over 0.664,
    on octave averaging times, of those that longer averaging does not get below; a model whose Allan deviation has no
    such floor has none, as one without a random walk, which falls in the end.

    Args:
        model: With scalar parameters.
        rate: Sampling rate, Hz.
        unit: Rate unit of the model: deg/s, mdeg/s, deg/h, rad/s, mrad/s or rpm, or another spelling of one.
        n_levels: Averaging times looked at, from one sample up; those of the record behind the model, which knows no
            others.

    Raises:
        ValueError: A parameter is to be estimated or batched, or an unknown unit.

    References:
        IEEE Std 952, annex C.
    """
    rate = check_positive("rate", rate)
    degrees = units.rate_unit_factor(unit, "deg/s")
    unit = units.canonical_unit(unit)
    if model.params.ndim > 1:
        raise ValueError(
            f"`model`: expected scalar parameters, got a batch of shape {tuple(model.params.shape[:-1])}; "
            "pick one item with model.with_params(model.params[i])"
        )
    white = list(_angle_random_walk(model, rate, unit, degrees))
    entries = [e for process in model.processes for e in _entries(process, rate, degrees, unit)]
    return Datasheet(rate, unit, (*white, *entries, *_floor(model, rate, degrees, n_levels)))


def _angle_random_walk(model: Model, rate: float, unit: str, degrees: float) -> Iterator[DatasheetEntry]:
    """Of white noise; where there is none, of the AR1s that are white after less than a second."""
    variance = sum(p.params.tolist()[0] for p in model.processes if isinstance(p, WhiteNoise))
    name = "angle random walk N"
    if variance == 0:
        shaped = [p.params.tolist() for p in model.processes if isinstance(p, AR1)]
        variance = sum(own / (1 - phi) ** 2 for phi, own in shaped if _short(phi, rate))
        name += " of AR1s"
    if variance > 0:
        density = units.angle_random_walk(variance, rate)
        yield DatasheetEntry(name, units.per_sqrt_hour(density * degrees), "deg/sqrt(h)")
        yield DatasheetEntry(name, density, f"{unit}/sqrt(Hz)")


def _short(phi: float, rate: float) -> bool:
    return phi <= 0 or units.correlation_time(phi, rate) < _WHITE_AFTER


def _entries(process: Process, rate: float, degrees: float, unit: str) -> Iterator[DatasheetEntry]:
    first, *rest = process.params.tolist()
    hour = units.SECONDS_PER_HOUR
    if isinstance(process, QuantizationNoise):
        angle = units.quantization(first, rate) * degrees * units.ARCSECONDS_PER_DEGREE
        yield DatasheetEntry("quantization Q", angle, "arcsec")
    elif isinstance(process, RandomWalk):
        density = units.rate_random_walk(first, rate)
        yield DatasheetEntry("rate random walk K", density * degrees * hour**1.5, "deg/h/sqrt(h)")
        yield DatasheetEntry("rate random walk K", density, f"{unit}/s/sqrt(Hz)")
    elif isinstance(process, Drift):
        yield DatasheetEntry("rate ramp R", units.rate_ramp(first, rate) * degrees * hour**2, "deg/h/h")
    elif isinstance(process, AR1):
        phi, variance = first, *rest
        if phi > 0:
            yield DatasheetEntry("Gauss-Markov correlation time", units.correlation_time(phi, rate), "s")
        deviation = (variance / ((1 - phi) * (1 + phi))) ** 0.5
        yield DatasheetEntry("Gauss-Markov deviation", deviation * degrees * hour, "deg/h")
    elif isinstance(process, Sinusoid):
        amplitude, beta = first, *rest
        yield DatasheetEntry("tone frequency", units.tone_frequency(beta, rate), "Hz")
        yield DatasheetEntry("tone amplitude", amplitude, unit)


def _floor(model: Model, rate: float, degrees: float, n_levels: int) -> Iterator[DatasheetEntry]:
    noise = [p for p in model.processes if not isinstance(p, (Sinusoid, Drift))]
    if not noise:
        return
    deviation = (2 * Model(noise).wavelet_variance(n_levels)).sqrt()  # Allan, at 2**(level - 1) samples
    inner = deviation[1:-1]
    later = deviation.flip(0).cummin(0).values.flip(0)[2:]
    lowest = torch.where((inner < deviation[:-2]) & (inner < later), inner, torch.inf)
    if torch.isfinite(lowest).any():
        floor = float(lowest.min()) * degrees * units.SECONDS_PER_HOUR
        yield DatasheetEntry("bias instability B", units.bias_instability(floor), "deg/h")
        averaging = 2.0 ** (int(lowest.argmin()) + 1) / rate
        yield DatasheetEntry("bias instability reached at", averaging, "s")
