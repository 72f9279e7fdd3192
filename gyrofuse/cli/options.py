"""Options that commands share, and the files that they write."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from gyrofuse._base.files import Outputs
from gyrofuse._base.units import known_unit
from gyrofuse.cli.console import progress
from gyrofuse.fusion.weights.methods import METHODS
from gyrofuse.io.reading import read_recording
from gyrofuse.io.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SUFFIXES = {
    "out": (".npz", ".csv"),
    "figure": (".png", ".svg", ".pdf"),
    "json": (".json",),
    "report": (".html",),
    "kalibr": (".yaml", ".yml"),
    "model-out": (".json",),
    "corrected": (".npz",),
    "header": (".h",),
}
METHOD_NAMES = tuple(name.replace("_", "-") for name in (*METHODS, "multiscale"))

Logs = Annotated[
    list[Path],
    typer.Argument(metavar="LOG...", help="The recording. Several files are one array, aligned on their clocks."),
]
Rest = Annotated[
    str | None, typer.Option(metavar="START:STOP", help="Use this stretch of the recording alone (seconds).")
]
ModelLevels = Annotated[
    int | None, typer.Option(metavar="J", help="Number of levels; as many as hold two windows by default.")
]
Confidence = Annotated[float, typer.Option(metavar="P", help="Confidence level of all intervals.")]


class Quantity(str, Enum):
    """Kind of sensors that are read from a log."""

    rate = "rate"
    acceleration = "acceleration"
    all = "all"


@dataclass(frozen=True)
class FileReading:
    """Options with which each of many logs is read."""

    quantity: Annotated[
        Quantity, typer.Option(help="Take the gyros of the log, or its accelerometers; diagnose takes all of a board.")
    ] = Quantity.rate
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
        """Keyword arguments of `read_recording` that were given."""
        given = {
            "quantity": None if self.quantity is Quantity.rate else self.quantity.value,
            "axis": self.axis,
            "sensors": None if self.sensors is None else self.sensors.split(","),
            "rate": self.rate,
            "unit": None if self.unit is None else known_unit("--unit", self.unit),
            "scale": self.scale,
            "key": self.key,
            "columns": _named_columns(self.columns),
            "max_bytes": self.max_bytes,
        }
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class Reading(FileReading):
    """Options with which a recording is read, of one log or several."""

    mounting: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="JSON: for each device by name, the 3x3 matrix to the common frame."),
    ] = None

    @property
    def options(self) -> dict[str, Any]:
        """Keyword arguments of `read_recording` that were given."""
        given = super().options
        return given if self.mounting is None else {**given, "mounting": self.mounting}

    def read(self, logs: Sequence[Path]) -> Recording:
        """Read the logs as one recording, with progress shown."""
        with progress("reading"):
            return read_recording(logs, **self.options)


@dataclass(frozen=True)
class WrittenFiles:
    """Files that a command was asked to write; they appear together when it has succeeded.

    Attributes:
        paths: Path of each file by its option, such as `"model-out"`.
        drafts: Path to write to until then, by path.
    """

    paths: Mapping[str, Path]
    drafts: Mapping[Path, Path]

    def draft(self, option: str) -> Path:
        """Path to write to, of an option that was given."""
        return self.drafts[self.paths[option]]

    def write(self, option: str, text: Callable[[], str]) -> None:
        """Write a text, if its option was given."""
        if option in self.paths:
            self.draft(option).write_text(text(), encoding="utf-8")

    def write_json(self, content: Callable[[], dict[str, Any]], option: str = "json") -> None:
        """Write plain numbers as JSON, if the option was given."""
        self.write(option, lambda: json.dumps(content(), allow_nan=False) + "\n")

    def write_report(self, page: Callable[[], str]) -> None:
        """Write the page that `--report` asks for, with progress shown."""
        with progress("drawing"):
            self.write("report", page)

    def write_figure(self, draw: Callable[[], Figure]) -> None:
        """Write the figure that `--figure` asks for, in the format of its suffix, with progress shown."""
        if "figure" in self.paths:
            from gyrofuse._base.page import save_figure

            with progress("drawing"):
                save_figure(draw(), self.draft("figure"), self.paths["figure"].suffix[1:].lower())

    @property
    def note(self) -> list[str]:
        """A line that names the files, where there are any."""
        return [f"Written: {', '.join(map(str, self.paths.values()))}"] if self.paths else []


@dataclass(frozen=True)
class FileWriting:
    """Options of the files that every command can write."""

    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write what is found as JSON.")] = (
        None
    )
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False

    @contextmanager
    def files(self, inputs: Sequence[Path | None] = (), **others: Path | None) -> Iterator[WrittenFiles]:
        """Files to write, which appear when the block ends without an error.

        Args:
            inputs: Files that the command reads, which are never replaced.
            **others: Further files, by option.

        Raises:
            ValueError: A suffix that is not of the option's formats, or what `Outputs` refuses.
        """
        asked = {name.replace("_", "-"): path for name, path in {**others, **self._own}.items() if path is not None}
        for option, path in asked.items():
            if path.suffix.lower() not in _SUFFIXES[option]:
                raise ValueError(
                    f"`--{option}`: expected a name that ends in {' or '.join(_SUFFIXES[option])}, got {str(path)!r}"
                )
        with Outputs(asked.values(), force=self.force, inputs=[path for path in inputs if path]) as drafts:
            yield WrittenFiles(asked, drafts)

    @property
    def _own(self) -> dict[str, Path | None]:
        return {"json": self.json_file}


@dataclass(frozen=True)
class Writing(FileWriting):
    """Options of the files that most commands can write."""

    report: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a report, one HTML page.")] = None

    @property
    def _own(self) -> dict[str, Path | None]:
        return {**super()._own, "report": self.report}


def takes_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command, each of whose parameters of a dataclass is given as one option of the command line for each field."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters = []
    for name, parameter in signature(command).parameters.items():
        if name in groups:
            kinds = get_type_hints(groups[name], include_extras=True)
            parameters += [
                Parameter(one.name, Parameter.KEYWORD_ONLY, default=one.default, annotation=kinds[one.name])
                for one in fields(groups[name])
            ]
        else:
            parameters.append(parameter.replace(annotation=hints[name], kind=Parameter.KEYWORD_ONLY))

    @wraps(command)
    def run(**given: Any) -> None:
        made = {
            name: group(**{one.name: given.pop(one.name) for one in fields(group)}) for name, group in groups.items()
        }
        command(**made, **given)

    run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]  # what typer makes options of
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def chosen(option: str, given: str, names: Sequence[str]) -> str:
    """Python's name (`block_bootstrap`) of a choice on the command line (`block-bootstrap`).

    Args:
        option: Option that was given, such as `--method`.
        given: Its value.
        names: Values that it may have, as on the command line.

    Raises:
        ValueError: It has another value.
    """
    if given not in names:
        raise ValueError(f"`{option}`: expected one of {', '.join(names)}, got {given!r}")
    return given.replace("-", "_")


def scale_weights_of(text: str) -> str | tuple[float, ...]:
    """The name that `--scale-weights` gives, or its numbers."""
    if text in ("flat", "short", "long"):
        return text
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(
            f"`--scale-weights`: expected flat, short, long, or numbers separated by commas, got {text!r}"
        ) from None


def stretch(rest: str | None) -> tuple[float, float] | None:
    """Start and end in seconds that `--rest` gives."""
    if rest is None:
        return None
    try:
        start, stop = (float(edge) for edge in rest.split(":"))
    except ValueError:
        start = stop = math.nan
    if not start < stop:
        raise ValueError(f"`--rest`: expected START:STOP in seconds, such as 0:60, got {rest!r}")
    return start, stop


def one_panel(plot: Callable[[Axes], Axes], width: float = 7.0, height: float = 4.6) -> Figure:
    """A figure of one panel, of a width and a height in inches."""
    from gyrofuse._base.page import new_figure

    figure = new_figure(width, height)
    plot(figure.subplots())
    return figure


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
