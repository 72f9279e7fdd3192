"""What commands share: options, inputs, outputs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from gyrofuse._console import progress, say_table
from gyrofuse._output import Outputs
from gyrofuse.io.columns import canonical_unit
from gyrofuse.recording import Recording, read_recording
from gyrofuse.units import OTHER_UNITS, RATE_UNITS

_SUFFIXES = {
    "out": (".npz", ".csv"),
    "figure": (".png", ".svg", ".pdf"),
    "json": (".json",),
    "report": (".html",),
    "kalibr": (".yaml", ".yml"),
    "model-out": (".json",),
    "header": (".h",),
}

Logs = Annotated[
    list[Path],
    typer.Argument(metavar="LOG...", help="The recording. Several files are one array, aligned on their clocks."),
]
Axis = Annotated[str | None, typer.Option(metavar="x|y|z", help="Take this axis alone.")]
Sensors = Annotated[str | None, typer.Option(metavar="A,B,...", help="Take these sensors alone.")]
Rate = Annotated[float | None, typer.Option(metavar="HZ", help="Sampling rate, where the log does not say.")]
Unit = Annotated[str | None, typer.Option(metavar="UNIT", help="Unit of the rates, where the log does not say.")]
Scale = Annotated[float | None, typer.Option(help="Factor that turns what is logged (counts) into the unit.")]
Key = Annotated[str | None, typer.Option(metavar="NAME", help="Topic, array, group or column that holds the gyros.")]
Mounting = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="JSON: for each device by name, the 3x3 matrix to the common frame."),
]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write what is found as JSON.")]
Report = Annotated[Path | None, typer.Option(metavar="FILE", help="Write a report, one HTML page.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]


def read(
    logs: Sequence[Path],
    axis: str | None,
    sensors: str | None,
    rate: float | None,
    unit: str | None,
    scale: float | None,
    key: str | None,
    mounting: Path | None,
) -> Recording:
    """Read a log with progress shown."""
    with progress("reading"):
        return read_recording(
            logs,
            axis=axis,
            sensors=None if sensors is None else sensors.split(","),
            rate=rate,
            unit=None if unit is None else known_unit(unit),
            scale=scale,
            key=key,
            mounting=mounting,
        )


def known_unit(unit: str) -> str:
    """The unit that `--unit` names, in this project's spelling."""
    known = (*RATE_UNITS, *OTHER_UNITS)
    name = canonical_unit(unit)
    if name not in known:
        raise ValueError(
            f"`--unit`: expected one of {', '.join(known)}, got {unit!r}; give one of them, and with --scale the "
            "factor that brings the numbers of the log to it"
        )
    return name


def stretch(rest: str | None) -> tuple[float, float] | None:
    """Start and end in seconds of `--rest`."""
    if rest is None:
        return None
    try:
        start, stop = (float(edge) for edge in rest.split(":"))
    except ValueError:
        start = stop = math.nan
    if not start < stop:
        raise ValueError(f"`--rest`: expected START:STOP in seconds, such as 0:60, got {rest!r}")
    return start, stop


def outputs(force: bool, inputs: Sequence[Path | None] = (), **asked: Path | None) -> Outputs:
    """Files to write, those asked for, by option; none of the inputs given is ever replaced."""
    for option, path in asked.items():
        if path is not None and path.suffix.lower() not in _SUFFIXES[option]:
            raise ValueError(
                f"`--{option}`: expected a name that ends in {' or '.join(_SUFFIXES[option])}, got {str(path)!r}"
            )
    return Outputs(
        [path for path in asked.values() if path is not None], force=force, inputs=[path for path in inputs if path]
    )


def titled(logs: Sequence[Path]) -> str:
    """What a title calls a log of one file or several."""
    return logs[0].name if len(logs) == 1 else f"{logs[0].name} and {len(logs) - 1} more"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write plain numbers as JSON."""
    path.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")


def say_notes(recording: Recording) -> None:
    """Print what was found in a recording, where there is anything."""
    rows = [(note.kind.replace("_", " "), note.stream or "-", note.sentence) for note in recording.notes]
    if rows:
        say_table(("found", "where", "what"), rows)
