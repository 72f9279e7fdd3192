"""Command `diagnose`: effects that a simulation leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
import typer

from gyrofuse.cli.console import progress, say
from gyrofuse.cli.diagnose.board import BoardInputs, check_of_board, diagnose_whole_board
from gyrofuse.cli.diagnose.search import Search
from gyrofuse.cli.options import Quantity, Reading, Rest, Writing, stretch, takes_options
from gyrofuse.cli.reading import as_the_model, at_rest, naming, read_model, say_notes, titled, without_gaps
from gyrofuse.io.recording import Recording
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.processes import Model

if TYPE_CHECKING:
    from gyrofuse.mismatch import MismatchReport, SessionsReport
    from gyrofuse.mismatch.repair.repaired_model import RepairedModel
    from gyrofuse.mismatch.repair.session_model import SessionModel


@takes_options
def diagnose(
    *,
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG...", help="The recording. Several files are recordings of one device, or one array; see below."
        ),
    ],
    simulations: Annotated[
        list[Path],
        typer.Option(
            "--simulation",
            metavar="SIM",
            help="What a simulator gives for the same array: a recording, or a model, .json; of a board two models.",
        ),
    ],
    false_alarm: Annotated[
        float, typer.Option(metavar="P", help="Probability of a finding where nothing is missing.")
    ] = 0.01,
    twins: Annotated[
        int, typer.Option(metavar="N", help="Hold the false alarm for this very recording, by N twins of it.")
    ] = 0,
    judge: Annotated[
        Path | None,
        typer.Option(metavar="OTHER", help="Another log of the same device: does the repair help there, too?"),
    ] = None,
    fitted_samples: Annotated[
        int | None,
        typer.Option(metavar="N", help="Samples of each sensor that a model was estimated from, if its file lacks it."),
    ] = None,
    apart: Annotated[
        bool | None,
        typer.Option(
            "--apart/--together",
            help="Whether several files are recordings taken one after the other, or one array.",
            show_default="whether each has all the sensors of SIM",
        ),
    ] = None,
    rest: Rest = None,
    reading: Reading,
    corrected: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the log without what can be taken off it, .npz.")
    ] = None,
    model_out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the repaired simulation, .json.")
    ] = None,
    writing: Writing,
) -> None:
    """Find where a log, recorded at rest, differs from a simulation, and which physics that left out.

    The verdict comes first; it is no error to find something. Spectra need records without gaps: where samples are
    missing, the longest stretch without them is diagnosed, and named. With --judge another log of the device, at the
    same rate and of the same sensors, shows how far the simulation is from it before and after the repair, and how far
    the two logs are apart. Several files are one array, aligned on their clocks; where each has all the sensors of the
    simulation, or with --apart, they are recordings of one device taken one after the other: what all have is the
    device's, what differs a session's, and the repaired simulation draws sessions. With --quantity all the gyros and
    the accelerometers of all axes and devices are diagnosed together, and a cause that they share is told once: SIM is
    then a log of both, or given twice, with a model of the gyros and one of the accelerometers.
    """
    resting = stretch(rest)
    if reading.quantity is Quantity.all:
        check_of_board(len(logs) if apart else 1, corrected=corrected, twins=twins)
        board = BoardInputs(logs, simulations, judge, reading, resting)
        diagnose_whole_board(board, false_alarm, fitted_samples, model_out, writing)
        return
    if len(simulations) > 1:
        raise ValueError(
            f"`--simulation`: expected one, got {len(simulations)}; two are of a whole board, with --quantity all"
        )
    simulation = simulations[0]
    inputs = [*logs, reading.mounting, simulation, judge]
    several = len(logs) > 1 and (_each_is_whole(logs, simulation, reading) if apart is None else apart)
    if several and (corrected or twins):
        raise ValueError(
            f"`--{'corrected' if corrected else 'twins'}`: expected with a single recording, got {len(logs)}; give "
            "them one by one, or --together if they are one array"
        )
    groups = [[log] for log in logs] if several else [logs]
    with writing.files(inputs, corrected=corrected, model_out=model_out) as files:
        came = [reading.read(group) for group in groups]
        recordings = [
            as_the_model(_one_axis(one, titled(group)), simulation) for one, group in zip(came, groups, strict=True)
        ]
        simulated = _simulation(simulation, recordings[0], reading)
        judging = None
        if judge is not None:
            judging = as_the_model(_one_axis(reading.read([judge]), judge.name), simulation)
        names = [titled(group) for group in groups]
        if len({*names}) < len(names):  # in different folders
            names = [str(log) for log in logs]
        parts = {}
        for name, group, one in zip(names, groups, recordings, strict=True):
            with naming(group):
                parts[name] = at_rest(one, resting)
        search = Search(simulated, judging, str(simulation), judge.name if judge else "", false_alarm, fitted_samples)
        found: MismatchReport | SessionsReport
        if several:
            found, remarks = search.several(parts)
        else:
            found, remarks = search.one(names[0], parts[names[0]], twins)
            if corrected:
                remarks += _save_corrected(found, parts[names[0]], came[0], corrected, files.draft("corrected"))
        remarks += _units_taken(recordings[0], simulated, (names[0], simulation.name))
        files.write_json(lambda: found.model.to_dict(), "model-out")
        if writing.report:
            with progress("drawing"):
                notes = [f"{name}: {note}" for name, part in parts.items() for note in part.notes]
                if isinstance(simulated, Recording):
                    notes += [f"{simulation.name}: {note}" for note in simulated.notes]
                title = f"{titled(logs)} against {simulation.name}"
                found.to_html(files.draft("report"), title=title, remarks=[*remarks, *notes])
        sources: dict[str, object] = {
            "recording": [source for one in recordings for source in one.source],
            "simulation": simulation.name,
        }
        if judge is not None:
            sources["judge"] = judge.name
        files.write_json(lambda: {**sources, **found.to_dict()})
    say("\n".join([found.summary(), *remarks, *files.note]))
    for one in recordings:
        say_notes(one)


def _save_corrected(
    report: MismatchReport, recording: Recording, came: Recording, path: Path, draft: Path
) -> list[str]:
    """Save a recording, which came in another shape, without what can be taken off it; a remark where that is nothing.

    Axes of a device, each of which was diagnosed by itself, are its axes again.
    """
    whole, _ = without_gaps(recording, "", 0)
    clean = report.correct(whole)
    changed = not torch.equal(clean.signal, whole.signal)
    if came.n_sensors == 1 and set(clean.sensors) == set(came.axes):
        clean = replace(clean, signal=clean.signal[:, None], sensors=came.sensors, axes=clean.sensors)
    clean.save(draft, force=True)
    if changed:
        return []
    return [f"Nothing was found that can be taken off: {path} is the recording as it came."]


def _each_is_whole(logs: Sequence[Path], simulation: Path, reading: Reading) -> bool:
    """Whether the first log alone has all the sensors of the simulation, so that others are further recordings."""
    from gyrofuse.mismatch.repair.session_model import SessionModel

    model: Any = read_model(simulation) if simulation.suffix.lower() == ".json" else None
    if isinstance(model, Model):
        n_sensors = model.params.shape[:-1].numel()
    elif isinstance(model, ArrayModel):
        n_sensors = model.n_sensors
    elif model is not None:
        n_sensors = len((model.models[0] if isinstance(model, SessionModel) else model).info.sensors)
    first = _one_axis(reading.read(logs[:1]), logs[0].name)
    if model is None:
        simulated: Any = _simulation(simulation, first, reading)
        n_sensors = simulated.n_sensors
    return n_sensors > 1 and first.n_sensors == n_sensors


def _units_taken(recording: Recording, simulation: object, names: tuple[str, str]) -> list[str]:
    """Remark on the unit assumed where one of two recordings, or both, state none."""
    if not isinstance(simulation, Recording) or "unknown" not in (recording.unit, simulation.unit):
        return []
    if recording.unit == simulation.unit:
        return [f"Units: neither {names[0]} nor {names[1]} states one; their numbers are compared as they are."]
    pair = (names[0], simulation.unit) if recording.unit == "unknown" else (names[1], recording.unit)
    return [f"Units: {pair[0]} states none; its numbers are taken as {pair[1]}."]


def _simulation(
    path: Path, recording: Recording, reading: Reading
) -> Recording | Model | ArrayModel | RepairedModel | SessionModel:
    """Content of SIM: a model, or a recording of the same sensors and axis."""
    if path.suffix.lower() == ".json":
        return read_model(path)
    # The simulation may have fewer sensors, or other names, than the log; its numbers are in the unit already.
    whole = replace(reading, axis=None, sensors=None, scale=None, key=None, columns=None, mounting=None).read([path])
    if reading.axis is not None and reading.axis in whole.axes:
        whole = whole.select(axis=reading.axis)
    names = reading.options.get("sensors", [])
    if whole.n_sensors > recording.n_sensors and set(names) <= set(whole.sensors):
        whole = whole.select(sensors=names or None)
    return _one_axis(whole, path.name)


def _one_axis(recording: Recording, name: str) -> Recording:
    """The recording `(sensor, time)`: of one axis, or all axes of a single device."""
    recording = recording.axes_as_sensors()
    if recording.signal.ndim == 2:
        return recording
    if len(recording.axes) == 1:
        return recording.select(axis=recording.axes[0])
    raise ValueError(
        f"{name}: expected the sensors of one axis, got axes {', '.join(recording.axes)}; choose one with --axis"
    )
