"""A fitted model in the units of a sensor's datasheet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch

from gyrofuse._base import units
from gyrofuse._base.checks import check_positive
from gyrofuse.noise.datasheet_units import BIAS_INSTABILITY, DatasheetEntry, DatasheetUnits
from gyrofuse.noise.model import check_scalar
from gyrofuse.noise.processes import Model

# Correlation time in seconds below which a process counts as white where there is no white noise: the random walk of an
# angle is read off the Allan deviation at 1 s (IEEE Std 952).
_WHITE_AFTER = 1.0
# Levels over which the floor of the Allan deviation is looked for: 2^40 samples are more than any record has.
_LEVELS = 40


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

    Bias instability is that of the flicker noise of the model. Without flicker noise it is the lowest local minimum of
    the Allan deviation, without sinusoids and drifts, over 0.664, at octave averaging times; the minimum counts only if
    the Allan deviation at all longer averaging times is larger.

    Args:
        model: Noise model with scalar parameters.
        rate: Sampling rate, Hz.
        unit: Unit of the model: deg/s, mdeg/s, deg/h, rad/s, mrad/s, rpm; m/s^2, g, mg, ug; or another spelling.
        n_levels: Averaging times looked at, from one sample up; those of the record behind the model, which knows no
            others.

    Raises:
        ValueError: A parameter is to be estimated or batched, or an unknown unit.

    References:
        IEEE Std 952, annex C; for accelerometers IEEE Std 1293, annex.
    """
    sheet = DatasheetUnits(check_positive("rate", rate), units.canonical_unit(unit))
    units.unit_factor(unit, sheet.base)
    check_scalar("model", model)
    entries = [entry for p in model.processes for entry in p._datasheet(sheet, **p.values)]
    if not any(entry.name == BIAS_INSTABILITY for entry in entries):
        entries += _bias_instability(model, sheet, n_levels)
    return Datasheet(sheet.rate, sheet.unit, (*_random_walk(model, sheet), *entries))


def _random_walk(model: Model, sheet: DatasheetUnits) -> Iterator[DatasheetEntry]:
    """Of white noise, after integration; where there is none, of processes that are white after a second."""
    counted = [process for process in model.processes if process.white]
    note = ""
    if not any(process.values["variance"] for process in counted):
        counted = [p for p in model.processes if p.has_memory() and p.time_constant(sheet.rate) < _WHITE_AFTER]
        note = " of " + " and ".join(dict.fromkeys(f"{process.symbol}s" for process in counted))
    density = sum(process.spectrum(0.0).item() for process in counted)
    if density > 0:
        yield from sheet.random_walk(density, note)


def _bias_instability(model: Model, sheet: DatasheetUnits, n_levels: int) -> Iterator[DatasheetEntry]:
    noise = [process for process in model.processes if process.gaussian]
    if not noise:
        return
    deviation = (2 * Model(noise).wavelet_variance(n_levels)).sqrt()  # Allan, at 2**(level - 1) samples
    inner = deviation[1:-1]
    later = deviation.flip(0).cummin(0).values.flip(0)[2:]
    lowest = torch.where((inner < deviation[:-2]) & (inner < later), inner, torch.inf)
    if torch.isfinite(lowest).any():
        yield sheet.bias_instability(units.bias_instability(float(lowest.min())))
        averaging = 2.0 ** (int(lowest.argmin()) + 1) / sheet.rate
        yield DatasheetEntry("bias instability reached at", averaging, "s")
