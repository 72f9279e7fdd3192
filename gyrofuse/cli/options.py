"""What commands share: options, inputs, outputs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gyrofuse._base.checks import check_positive, same_rate
from gyrofuse._base.files import Outputs
from gyrofuse._base.units import KNOWN_UNITS, canonical_unit
from gyrofuse.cli.console import say_table, warn
from gyrofuse.io.recording import Recording
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.parsing import model_from_dict
from gyrofuse.noise.processes import Model

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gyrofuse.mismatch.repaired import RepairedModel

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

_NO_MODEL = "expected a model in JSON, as to_dict() of a model gives it"

Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write what is found as JSON.")]
Report = Annotated[Path | None, typer.Option(metavar="FILE", help="Write a report, one HTML page.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]


class Method(str, Enum):
    """How weights are chosen."""

    svo = "svo"
    multiscale = "multiscale"
    auto = "auto"
    model_assisted = "model-assisted"
    shrinkage = "shrinkage"
    nonnegative = "nonnegative"
    inverse_variance = "inverse-variance"
    equal = "equal"
    rdvg = "rdvg"


def known_unit(unit: str) -> str:
    """The unit that `--unit` names, in this project's spelling."""
    name = canonical_unit(unit)
    if name not in KNOWN_UNITS:
        raise ValueError(
            f"`--unit`: expected one of {', '.join(KNOWN_UNITS)}, got {unit!r}; give one of them, and with --scale the "
            "factor that brings the numbers of the log to it"
        )
    return name


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


def at_rest(recording: Recording, resting: tuple[float, float] | None) -> Recording:
    """The stretch that `--rest` asks for, all without it; where the log ends before it does, that is said."""
    if resting is None:
        return recording
    part = recording.between(*resting)
    if resting[1] > recording.duration + 1 / recording.rate:
        warn(
            f"`--rest`: expected a stretch within 0 to {recording.duration:.6g} s, got {resting[1]:g} s; it ends there"
        )
    return part


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


def read_model(path: Path) -> Model | ArrayModel | RepairedModel:
    """A model from JSON: of `to_dict()` of a model or of a fit, or of a simulation that a diagnosis repaired."""
    content = _model_content(path)
    try:
        if "processes" not in content and isinstance(content.get("model"), dict):
            content = content["model"]
        if "effects" not in content:
            return model_from_dict(content)
        from gyrofuse.mismatch.saved import repaired_from_dict

        return repaired_from_dict(content)
    except (ValueError, TypeError, AttributeError, RuntimeError, OverflowError, LookupError) as error:
        raise ValueError(f"{path}: {_NO_MODEL}: {error}") from None


def model_grid(path: Path) -> tuple[float | None, str | None]:
    """Rate in Hz and unit of the log that a model in JSON was fitted to, where it says."""
    content = _model_content(path)
    rate, unit = content.get("rate"), content.get("unit")
    if rate is not None and (isinstance(rate, bool) or not isinstance(rate, float | int)):
        raise ValueError(f"{path}: expected 'rate' to be a number of Hz, got {str(rate)[:80]!r}")
    if unit is not None and not isinstance(unit, str):
        raise ValueError(f"{path}: expected 'unit' to be a text such as 'deg/s', got {str(unit)[:80]!r}")
    return rate, (None if unit == "unknown" else unit)


def agreed_rate(models: Sequence[Path], rate: float | None) -> float | None:
    """Sampling rate that was asked for, or that of the logs that models were fitted to: all have to be the same."""
    chosen, by = (None, "") if rate is None else (check_positive("--rate", rate), "--rate")
    for model in models:
        own = model_grid(model)[0]
        if own is not None:
            check_positive(f"{model}: rate", own)
        if own is not None and chosen is not None and not same_rate(own, chosen):
            raise ValueError(
                f"`{by}`: expected {own:g} Hz, for which the model was fitted, got {chosen:g}; see {model}"
            )
        if own is not None and chosen is None:
            chosen, by = own, str(model)
    return chosen


def agreed_unit(model: Path | None, unit: str | None) -> str | None:
    """Unit that was asked for, which has to be that of the log that the model was fitted to, or that."""
    own = None if model is None else model_grid(model)[1]
    asked = None if unit is None else known_unit(unit)
    if None not in (asked, own) and asked != own:
        raise ValueError(f"`--unit`: expected {own}, for which the model was fitted, got {asked}; see {model}")
    return asked or own


def draw(plot: Callable[[Axes], Axes], draft: Path, path: Path, width: float = 7.0, height: float = 4.6) -> None:
    """A figure of one panel, in the format that the path asks for."""
    from gyrofuse._base.page import new_figure, save_figure

    figure = new_figure(width, height)
    plot(figure.subplots())
    save_figure(figure, draft, path.suffix[1:].lower())


def _model_content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise ValueError(f"{path}: {_NO_MODEL}, found lists within lists that do not end") from None
    except ValueError as error:
        raise ValueError(f"{path}: {_NO_MODEL}: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: {_NO_MODEL}, found a {type(content).__name__}")
    return content


def without_gaps(recording: Recording, done: str, fewest: int, otherwise: str = "") -> tuple[Recording, list[str]]:
    """The longest stretch that no sensor lacks a sample of, and what to say about it.

    Args:
        recording: As read.
        done: What the command does with it, a participle: "Ranked".
        fewest: Samples that it needs.
        otherwise: What else could be done where there are fewer.
    """
    part = recording.longest_whole()
    if part.n_samples == recording.n_samples:
        return recording, []
    if part.n_samples < fewest <= recording.n_samples:
        raise ValueError(
            f"`LOG`: expected a stretch of at least {fewest} samples that no sensor lacks, got one of "
            f"{part.n_samples}; choose with --sensors{otherwise}"
        )
    start = part.time[0].item()
    more = "; fewer --sensors may have a longer one" if part.n_sensors > 1 else ""
    return part, [
        f"{done} on {start:.6g} to {start + part.duration:.6g} s alone, {part.n_samples} of {recording.n_samples} "
        f"samples, the longest stretch that no sensor lacks a sample of{more}."
    ]


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write plain numbers as JSON."""
    path.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")


def unit_note(unit: str) -> list[str]:
    """What to say of a unit that no datasheet can be given in."""
    if unit in (*KNOWN_UNITS, "unknown"):
        return []
    return [f"Unit {unit!r} is none of {', '.join(KNOWN_UNITS)}: numbers are in it as they stand."]


def files_written(*paths: Path | None) -> list[str]:
    """A line that names the files written, where there are any."""
    names = [str(path) for path in paths if path]
    return [f"Written: {', '.join(names)}"] if names else []


def say_notes(recording: Recording) -> None:
    """Print what was found in a recording, where there is anything."""
    rows = [(note.kind.replace("_", " "), note.stream or "-", note.sentence) for note in recording.notes]
    if rows:
        say_table(("found", "where", "what"), rows)
