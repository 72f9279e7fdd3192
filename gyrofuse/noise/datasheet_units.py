"""How datasheets give the numbers of a noise: names, units and factors, of rates and of accelerations."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from gyrofuse._base import units


class DatasheetEntry(NamedTuple):
    """One number of a datasheet.

    Attributes:
        name: Quantity.
        value: Number in `unit`.
        unit: Unit of the number.
    """

    name: str
    value: float
    unit: str


class _Row(NamedTuple):
    """How datasheets give one quantity.

    Attributes:
        name: Name of the quantity; empty where it depends on the process.
        unit: Unit in which it is given.
        factor: Factor to it from the base unit and seconds.
    """

    name: str
    unit: str
    factor: float


class _Rows(NamedTuple):
    """How datasheets give the noise of a sensor.

    Attributes:
        base: Unit of the signal that the factors start from.
        random_walk: Density of white noise, whose integral is a random walk.
        bias: Sizes in the unit of the signal, such as the bias instability.
        walk: Density of a random walk.
        ramp: Slope of a drift.
        quantization: Size of quantisation noise.
        density: Unit of noise densities beside the model's own; empty for none.
    """

    base: str
    random_walk: _Row
    bias: _Row
    walk: _Row
    ramp: _Row
    quantization: _Row
    density: str = ""


BIAS_INSTABILITY = "bias instability B"
_HOUR = units.SECONDS_PER_HOUR
_MICRO_G = units.unit_factor("m/s^2", "ug")
_ROWS = {
    "rate": _Rows(
        "deg/s",
        _Row("angle random walk N", "deg/sqrt(h)", math.sqrt(_HOUR)),
        _Row("", "deg/h", _HOUR),
        _Row("rate random walk K", "deg/h/sqrt(h)", _HOUR * math.sqrt(_HOUR)),
        _Row("rate ramp R", "deg/h/h", _HOUR * _HOUR),
        _Row("quantization Q", "arcsec", units.ARCSECONDS_PER_DEGREE),
    ),
    "acceleration": _Rows(
        "m/s^2",
        _Row("velocity random walk N", "m/s/sqrt(h)", math.sqrt(_HOUR)),
        _Row("", "ug", _MICRO_G),
        _Row("acceleration random walk K", "ug/sqrt(h)", _MICRO_G * math.sqrt(_HOUR)),
        _Row("acceleration ramp R", "ug/h", _MICRO_G * _HOUR),
        _Row("quantization Q", "m/s", units.unit_factor("m/s^2", "m/s^2")),
        density="ug",
    ),
}


@dataclass(frozen=True)
class DatasheetUnits:
    """Writes entries of a datasheet from numbers of a model.

    Args:
        rate: Sampling rate, Hz.
        unit: Unit of the model, of rate or acceleration.
    """

    rate: float
    unit: str

    @property
    def base(self) -> str:
        """Unit of the quantity that factors start from."""
        return self._rows.base

    @property
    def _rows(self) -> _Rows:
        return _ROWS[units.quantity_of(self.unit) or "rate"]

    def _entry(self, row: _Row, value: float, name: str = "") -> DatasheetEntry:
        """Of a value in the model's unit and seconds."""
        size = units.unit_factor(self.unit, self.base)
        return DatasheetEntry(name or row.name, value * size * row.factor, row.unit)

    def random_walk(self, variance: float, note: str = "") -> Iterator[DatasheetEntry]:
        """Angle or velocity random walk of white noise with a variance per sample, in all its units."""
        density, rows = units.angle_random_walk(variance, self.rate), self._rows
        name = rows.random_walk.name + note
        yield self._entry(rows.random_walk, density, name)
        for unit in dict.fromkeys([self.unit, rows.density or self.unit]):
            yield DatasheetEntry(name, density * units.unit_factor(self.unit, unit), f"{unit}/sqrt(Hz)")

    def walk(self, variance: float) -> Iterator[DatasheetEntry]:
        """Rate or acceleration random walk with increments of a variance per sample, in both its units."""
        density = units.rate_random_walk(variance, self.rate)
        yield self._entry(self._rows.walk, density)
        yield DatasheetEntry(self._rows.walk.name, density, f"{self.unit}/s/sqrt(Hz)")

    def ramp(self, slope: float) -> DatasheetEntry:
        """Ramp of a drift with a slope per sample."""
        return self._entry(self._rows.ramp, units.rate_ramp(slope, self.rate))

    def quantization(self, variance: float) -> DatasheetEntry:
        """Size of quantisation noise from the variance `q2`."""
        return self._entry(self._rows.quantization, units.quantization(variance, self.rate))

    def bias_instability(self, size: float) -> DatasheetEntry:
        """Bias instability `B` of IEEE Std 952, from that in the unit of the model."""
        return self._entry(self._rows.bias, size, BIAS_INSTABILITY)

    def bias(self, name: str, size: float) -> DatasheetEntry:
        """What has the unit of the signal, such as a standard deviation."""
        return self._entry(self._rows.bias, size, name)
