"""A fitted model in the units of a sensor's datasheet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from gyrofuse._base import units
from gyrofuse._base.checks import check_positive
from gyrofuse.noise.processes import (
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
    """One number of a datasheet."""

    name: str
    value: float
    unit: str


class _Row(NamedTuple):
    """How datasheets give a number: its name, its unit, and the factor to it."""

    name: str
    unit: str
    factor: float

    def entry(self, value: float, name: str = "") -> DatasheetEntry:
        """Of a value in the base unit and in seconds."""
        return DatasheetEntry(name or self.name, value * self.factor, self.unit)


class _Rows(NamedTuple):
    """All numbers of one quantity.

    Attributes:
        base: Unit that the factors start from.
        random_walk, walk, ramp, quantization: Of white noise, random walk, drift and quantisation noise.
        bias: What is of the quantity itself: bias instability, deviations.
        density: Unit in which noise densities are given beside the model's own; empty where there is none.
    """

    base: str
    random_walk: _Row
    bias: _Row
    walk: _Row
    ramp: _Row
    quantization: _Row
    density: str = ""

    def densities(self, size: float) -> dict[str, float]:
        """That unit with the factor to it from a model's unit, which is `size` base units large."""
        return {self.density: size * units.unit_factor(self.base, self.density)} if self.density else {}


_HOUR = units.SECONDS_PER_HOUR
_MICRO_G = 1e6 / units.GRAVITY  # micro-g in a m/s^2
_ROWS = {
    "rate": _Rows(
        "deg/s",
        _Row("angle random walk N", "deg/sqrt(h)", _HOUR**0.5),
        _Row("", "deg/h", _HOUR),
        _Row("rate random walk K", "deg/h/sqrt(h)", _HOUR**1.5),
        _Row("rate ramp R", "deg/h/h", _HOUR**2),
        _Row("quantization Q", "arcsec", units.ARCSECONDS_PER_DEGREE),
    ),
    "acceleration": _Rows(
        "m/s^2",
        _Row("velocity random walk N", "m/s/sqrt(h)", _HOUR**0.5),
        _Row("", "ug", _MICRO_G),
        _Row("acceleration random walk K", "ug/sqrt(h)", _MICRO_G * _HOUR**0.5),
        _Row("acceleration ramp R", "ug/h", _MICRO_G * _HOUR),
        _Row("quantization Q", "m/s", 1.0),
        density="ug",
    ),
}


@dataclass(frozen=True)
class Datasheet:
    """A model's parameters in datasheet units.

    Attributes:
        rate: Hz.
        unit: Unit of the model, of rate or acceleration.
        entries: Angle or velocity random walk, then the rest in the order of the model's processes; one may appear in
            two units.
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

    Of an accelerometer, whose unit says that it is one, these are velocity random walk, acceleration random walk and
    acceleration ramp.

    Where no white noise is left, angle or velocity random walk is that of AR1s with a correlation time below one
    second.

    Bias instability is the lowest local minimum of the Allan deviation, without tones and drifts, over 0.664,
    on octave averaging times, of those that longer averaging does not get below; a model whose Allan deviation has no
    such floor has none, as one without a random walk, which falls in the end.

    Args:
        model: With scalar parameters.
        rate: Sampling rate, Hz.
        unit: Unit of the model: deg/s, mdeg/s, deg/h, rad/s, mrad/s, rpm; m/s^2, g, mg, ug; or another spelling.
        n_levels: Averaging times looked at, from one sample up; those of the record behind the model, which knows no
            others.

    Raises:
        ValueError: A parameter is to be estimated or batched, or an unknown unit.

    References:
        IEEE Std 952, annex C; for accelerometers IEEE Std 1293, annex.
    """
    rate = check_positive("rate", rate)
    unit = units.canonical_unit(unit)
    rows = _ROWS[units.quantity_of(unit) or "rate"]
    size = units.unit_factor(unit, rows.base)
    if model.params.ndim > 1:
        raise ValueError(
            f"`model`: expected scalar parameters, got a batch of shape {tuple(model.params.shape[:-1])}; "
            "pick one item with model.with_params(model.params[i])"
        )
    white = list(_random_walk(model, rate, unit, rows, size))
    entries = [e for process in model.processes for e in _entries(process, rate, unit, rows, size)]
    return Datasheet(rate, unit, (*white, *entries, *_floor(model, rate, rows, size, n_levels)))


def _random_walk(model: Model, rate: float, unit: str, rows: _Rows, size: float) -> Iterator[DatasheetEntry]:
    """Of white noise, after integration; where there is none, of the AR1s that are white after less than a second."""
    variance = sum(p.params.tolist()[0] for p in model.processes if isinstance(p, WhiteNoise))
    name, of = rows.random_walk.name, ""
    if variance == 0:
        shaped = [p.params.tolist() for p in model.processes if isinstance(p, AR1)]
        variance = sum(own / (1 - phi) ** 2 for phi, own in shaped if _short(phi, rate))
        of = " of AR1s"
    if variance > 0:
        density = units.angle_random_walk(variance, rate)
        yield DatasheetEntry(name + of, density * size * rows.random_walk.factor, rows.random_walk.unit)
        for inside, factor in {unit: 1.0, **rows.densities(size)}.items():
            yield DatasheetEntry(name + of, density * factor, f"{inside}/sqrt(Hz)")


def _short(phi: float, rate: float) -> bool:
    return phi <= 0 or units.correlation_time(phi, rate) < _WHITE_AFTER


def _entries(process: Process, rate: float, unit: str, rows: _Rows, size: float) -> Iterator[DatasheetEntry]:
    first, *rest = process.params.tolist()
    if isinstance(process, QuantizationNoise):
        yield rows.quantization.entry(units.quantization(first, rate) * size)
    elif isinstance(process, RandomWalk):
        density = units.rate_random_walk(first, rate)
        yield rows.walk.entry(density * size)
        yield DatasheetEntry(rows.walk.name, density, f"{unit}/s/sqrt(Hz)")
    elif isinstance(process, Drift):
        yield rows.ramp.entry(units.rate_ramp(first, rate) * size)
    elif isinstance(process, AR1):
        phi, variance = first, *rest
        if phi > 0:
            yield DatasheetEntry("Gauss-Markov correlation time", units.correlation_time(phi, rate), "s")
        deviation = (variance / ((1 - phi) * (1 + phi))) ** 0.5
        yield rows.bias.entry(deviation * size, "Gauss-Markov deviation")
    elif isinstance(process, Sinusoid):
        amplitude, beta = first, *rest
        yield DatasheetEntry("tone frequency", units.tone_frequency(beta, rate), "Hz")
        yield DatasheetEntry("tone amplitude", amplitude, unit)


def _floor(model: Model, rate: float, rows: _Rows, size: float, n_levels: int) -> Iterator[DatasheetEntry]:
    noise = [p for p in model.processes if not isinstance(p, (Sinusoid, Drift))]
    if not noise:
        return
    deviation = (2 * Model(noise).wavelet_variance(n_levels)).sqrt()  # Allan, at 2**(level - 1) samples
    inner = deviation[1:-1]
    later = deviation.flip(0).cummin(0).values.flip(0)[2:]
    lowest = torch.where((inner < deviation[:-2]) & (inner < later), inner, torch.inf)
    if torch.isfinite(lowest).any():
        yield rows.bias.entry(units.bias_instability(float(lowest.min())) * size, "bias instability B")
        averaging = 2.0 ** (int(lowest.argmin()) + 1) / rate
        yield DatasheetEntry("bias instability reached at", averaging, "s")
