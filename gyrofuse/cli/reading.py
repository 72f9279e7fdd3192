"""What commands read: the stretch of a recording that they use, and models in JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gyrofuse._base.checks import check_positive, same_rate
from gyrofuse._base.units import KNOWN_UNITS, canonical_unit, known_unit
from gyrofuse.cli.console import say_table, warn
from gyrofuse.io.recording import Recording
from gyrofuse.io.streams import RecordingError
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.parsing import model_from_dict
from gyrofuse.noise.processes import Model

if TYPE_CHECKING:
    from gyrofuse.mismatch.repair.repaired_model import RepairedModel
    from gyrofuse.mismatch.repair.session_model import SessionModel

_NO_MODEL = "expected a model in JSON, as to_dict() of a model gives it"


def titled(logs: Sequence[Path]) -> str:
    """Name of a recording of one file or several, for titles and messages."""
    return logs[0].name if len(logs) == 1 else f"{logs[0].name} and {len(logs) - 1} more"


@contextmanager
def naming(logs: Sequence[Path]) -> Iterator[None]:
    """Name the log in errors of what is computed of it; those of options that have nothing to do with it stay.

    Args:
        logs: Its files.
    """
    name, of_log = titled(logs), ("`n_levels`", "`model`", "`start`")
    try:
        yield
    except RecordingError:  # has the name
        raise
    except ValueError as error:
        message = str(error)
        told = message.replace("`signal`", name).replace("`LOG`", name)
        if told == message and (not message.startswith("`") or message.startswith(of_log)):
            told = f"{name}: {message}"
        raise ValueError(told) from error


def at_rest(recording: Recording, resting: tuple[float, float] | None) -> Recording:
    """The part of a recording that `--rest` asks for, with a warning where the recording ends before it does.

    Args:
        recording: The whole recording.
        resting: Start and end in seconds; None for all of it.
    """
    if resting is None:
        return recording
    part = recording.between(*resting)
    if resting[1] > recording.duration + 1 / recording.rate:
        warn(
            f"`--rest`: expected a stretch within 0 to {recording.duration:.6g} s, got {resting[1]:g} s; it ends there"
        )
    return part


def without_gaps(recording: Recording, done: str, fewest: int, otherwise: str = "") -> tuple[Recording, list[str]]:
    """The longest stretch without missing samples, and a sentence that names it where it is not the whole recording.

    Args:
        recording: The recording.
        done: Participle of what the command does with the stretch, such as "Ranked".
        fewest: Number of samples that the command needs.
        otherwise: Words that end the message, on what else can be done.

    Raises:
        ValueError: The stretch is too short, though the recording is not.
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


def say_notes(recording: Recording) -> None:
    """Print what was found in a recording, where there is anything."""
    rows = [(note.kind.replace("_", " "), note.stream or "-", note.sentence) for note in recording.notes]
    if rows:
        say_table(("found", "where", "what"), rows)


def read_model(path: Path) -> Model | ArrayModel | RepairedModel | SessionModel:
    """Read a model from JSON: `to_dict()` of a model, of a fit, or of a simulation that a diagnosis repaired.

    Raises:
        ValueError: It is none of these.
    """
    content = json_object(path)
    try:
        if "processes" not in content and isinstance(content.get("model"), dict):
            content = content["model"]
        if "effects" not in content and "sessions" not in content:
            return model_from_dict(content)
        from gyrofuse.mismatch.repair.serialise import repaired_from_dict, sessions_from_dict

        return sessions_from_dict(content) if "sessions" in content else repaired_from_dict(content)
    except (ValueError, TypeError, AttributeError, RuntimeError, OverflowError, LookupError) as error:
        raise ValueError(f"{path}: {_NO_MODEL}: {error}") from None


def model_grid(path: Path) -> tuple[float | None, str | None]:
    """Rate in Hz and unit of the log that a model in JSON was fitted to, where the file has them.

    Raises:
        ValueError: They are not a number and a text.
    """
    content = json_object(path)
    rate, unit = content.get("rate"), content.get("unit")
    if rate is not None and (isinstance(rate, bool) or not isinstance(rate, float | int)):
        raise ValueError(f"{path}: expected 'rate' to be a number of Hz, got {str(rate)[:80]!r}")
    if unit is not None and not isinstance(unit, str):
        raise ValueError(f"{path}: expected 'unit' to be a text such as 'deg/s', got {str(unit)[:80]!r}")
    if unit in (None, "unknown"):
        return rate, None
    if canonical_unit(unit) not in KNOWN_UNITS:
        raise ValueError(
            f"{path}: expected 'unit' to be one of {', '.join(KNOWN_UNITS)}, got {unit[:80]!r}; correct it there"
        )
    return rate, canonical_unit(unit)


def as_the_model(recording: Recording, path: Path) -> Recording:
    """The recording, converted to the unit of a model in JSON; raises `ValueError` if their rates differ."""
    return on_grid(recording, path, *(model_grid(path) if path.suffix.lower() == ".json" else (None, None)))


def on_grid(recording: Recording, path: Path, rate: float | None, unit: str | None) -> Recording:
    """The recording, converted to the unit of a model, where one is known.

    Args:
        recording: The recording.
        path: File of the model, for the message.
        rate: Sampling rate of the model, Hz.
        unit: Its unit.

    Raises:
        ValueError: Their rates differ, or their units are of different quantities.
    """
    source = ", ".join(recording.source) or "the recording"
    if rate is not None and not same_rate(rate, recording.rate):
        raise ValueError(
            f"{path}: expected a model for the {recording.rate:g} Hz of {source}, got one that was fitted at "
            f"{rate:g} Hz; fit one at that rate, or resample the log"
        )
    if unit is None or recording.unit in ("unknown", unit):
        return recording
    try:
        return recording.to(unit)
    except ValueError:
        raise ValueError(
            f"{path}: expected a model in {recording.unit}, the unit of {source}, or one that it can be converted to, "
            f"got one in {unit}; give one that was fitted to the same quantity"
        ) from None


def agreed_rate(models: Sequence[Path], rate: float | None) -> float | None:
    """The one sampling rate, Hz, of `--rate` and of the logs that models were fitted to; None where nothing says.

    Args:
        models: Files of models.
        rate: Value of `--rate`, if it was given.

    Raises:
        ValueError: Two of them differ.
    """
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
    """The one unit of `--unit` and of the log that a model was fitted to; None where nothing says.

    Args:
        model: File of the model, if there is one.
        unit: Value of `--unit`, if it was given.

    Raises:
        ValueError: The two differ.
    """
    own = None if model is None else model_grid(model)[1]
    asked = None if unit is None else known_unit("--unit", unit)
    if None not in (asked, own) and asked != own:
        raise ValueError(f"`--unit`: expected {own}, for which the model was fitted, got {asked}; see {model}")
    return asked or own


def json_object(path: Path) -> dict[str, Any]:
    """Content of a model's file; raises `ValueError` if it is no object in JSON."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise ValueError(f"{path}: {_NO_MODEL}, found lists within lists that do not end") from None
    except ValueError as error:
        raise ValueError(f"{path}: {_NO_MODEL}: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path}: {_NO_MODEL}, found a {type(content).__name__}")
    return content
