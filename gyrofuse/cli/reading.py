"""How commands read logs: the options that all of them take, said once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from gyrofuse.cli.console import progress
from gyrofuse.cli.options import known_unit
from gyrofuse.io.recording import Recording, read_recording

Logs = Annotated[
    list[Path],
    typer.Argument(metavar="LOG...", help="The recording. Several files are one array, aligned on their clocks."),
]


class Quantity(str, Enum):
    """Which sensors of a log are read."""

    rate = "rate"
    acceleration = "acceleration"


@dataclass(frozen=True)
class FileReading:
    """Options with which each of many logs is read."""

    quantity: Annotated[Quantity, typer.Option(help="Take the gyros of the log, or its accelerometers.")] = (
        Quantity.rate
    )
    axis: Annotated[str | None, typer.Option(metavar="x|y|z", help="Take this axis alone.")] = None
    sensors: Annotated[str | None, typer.Option(metavar="A,B,...", help="Take these sensors alone.")] = None
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Sampling rate, where the log does not say.")] = None
    unit: Annotated[
        str | None, typer.Option(metavar="UNIT", help="Unit of the numbers, where the log does not say.")
    ] = None
    scale: Annotated[float | None, typer.Option(help="Factor that turns what is logged (counts) into the unit.")] = None
    key: Annotated[
        str | None, typer.Option(metavar="NAME", help="Topic, array, group or column that holds the sensors.")
    ] = None
    columns: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            metavar="NAME=COLUMN",
            help="What a column or array is, where its name does not say: gyro_x=u3, time=t. Others are left out.",
        ),
    ] = None
    max_bytes: Annotated[
        float | None,
        typer.Option(metavar="N", help="Memory that the numbers of a log may take; a quarter of what there is."),
    ] = None

    @property
    def options(self) -> dict[str, Any]:
        """Of `read_recording`, those that were given."""
        given = {
            "quantity": None if self.quantity is Quantity.rate else self.quantity.value,
            "axis": self.axis,
            "sensors": None if self.sensors is None else self.sensors.split(","),
            "rate": self.rate,
            "unit": None if self.unit is None else known_unit(self.unit),
            "scale": self.scale,
            "key": self.key,
            "columns": _named_columns(self.columns),
            "max_bytes": self.max_bytes,
        }
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class Reading(FileReading):
    """Options with which a log is read."""

    mounting: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="JSON: for each device by name, the 3x3 matrix to the common frame."),
    ] = None

    @property
    def options(self) -> dict[str, Any]:
        """Of `read_recording`, those that were given."""
        given = super().options
        return given if self.mounting is None else {**given, "mounting": self.mounting}

    def read(self, logs: Sequence[Path]) -> Recording:
        """Read a log with progress shown."""
        with progress("reading"):
            return read_recording(logs, **self.options)


def takes_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose parameter `reading` is made of options of the command line."""
    own, hints = signature(command).parameters, get_type_hints(command, include_extras=True)
    made: type[FileReading] = hints["reading"]
    kinds = get_type_hints(made, include_extras=True)
    names = [one.name for one in fields(made)]
    parameters = []
    for name, parameter in own.items():
        if name == "reading":
            parameters += [
                Parameter(one.name, Parameter.KEYWORD_ONLY, default=one.default, annotation=kinds[one.name])
                for one in fields(made)
            ]
        else:
            parameters.append(parameter.replace(annotation=hints[name], kind=Parameter.KEYWORD_ONLY))

    @wraps(command)
    def run(**given: Any) -> None:
        command(reading=made(**{name: given.pop(name) for name in names}), **given)

    run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]  # what typer makes options of
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _named_columns(texts: Sequence[str] | None) -> dict[str, str] | None:
    """Names and columns that `--map` gives."""
    if not texts:
        return None
    named = {}
    for text in texts:
        name, equals, column = (part.strip() for part in text.partition("="))
        if not (name and equals and column):
            raise ValueError(f"`--map`: expected NAME=COLUMN, such as gyro_x=u3, got {text!r}")
        if name in named:
            raise ValueError(f"`--map`: expected each name once, got {name!r} twice")
        named[name] = column
    return named
