"""Command `diagnose`: effects that a simulation leaves out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
import typer

from gyrofuse._base.checks import same_rate
from gyrofuse.cli.console import progress, progress_bar, say
from gyrofuse.cli.options import Logs, Reading, Rest, Writing, stretch, takes_options
from gyrofuse.cli.reading import at_rest, model_grid, read_model, say_notes, titled, without_gaps
from gyrofuse.io.recording import Recording
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.processes import Model

if TYPE_CHECKING:
    from gyrofuse.mismatch import MismatchReport
    from gyrofuse.mismatch.repair.repaired_model import RepairedModel


@takes_options
def diagnose(
    *,
    logs: Logs,
    simulation: Annotated[
        Path,
        typer.Option(metavar="SIM", help="What a simulator gives for the same array: a recording, or a model, .json."),
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
    the two logs are apart.
    """
    resting = stretch(rest)
    inputs = [*logs, reading.mounting, simulation, judge]
    with writing.files(inputs, corrected=corrected, model_out=model_out) as files:
        recording = _one_axis(reading.read(logs), titled(logs))
        recording = _as_the_model(recording, simulation)
        simulated = _simulation(simulation, recording, reading)
        judging = None
        if judge is not None:
            judging = _one_axis(reading.read([judge]), judge.name)
            judging = _as_the_model(judging, simulation)
        part = at_rest(recording, resting)
        names = {
            "`recording`": titled(logs),
            "`simulation`": str(simulation),
            "`judge`": "" if judge is None else judge.name,
        }
        found, remarks = _diagnosed(part, simulated, judging, names, false_alarm, twins, fitted_samples)
        remarks += _units_taken(recording, simulated, (titled(logs), simulation.name))
        if corrected:
            whole, _ = without_gaps(part, "", 0)
            clean = found.correct(whole)
            clean.save(files.draft("corrected"), force=True)
            if torch.equal(clean.signal, whole.signal):
                remarks.append(f"Nothing was found that can be taken off: {corrected} is the recording as it came.")
        files.write_json(lambda: found.model.to_dict(), "model-out")
        if writing.report:
            with progress("drawing"):
                notes = [f"{titled(logs)}: {note}" for note in recording.notes]
                if isinstance(simulated, Recording):
                    notes += [f"{simulation.name}: {note}" for note in simulated.notes]
                title = f"{titled(logs)} against {simulation.name}"
                found.to_html(files.draft("report"), title=title, remarks=[*remarks, *notes])
        sources: dict[str, object] = {"recording": list(recording.source), "simulation": simulation.name}
        if judge is not None:
            sources["judge"] = judge.name
        files.write_json(lambda: {**sources, **found.to_dict()})
    say("\n".join([found.summary(), *remarks]))
    say_notes(recording)


def _diagnosed(
    recording: Recording,
    simulation: Recording | Model | ArrayModel | RepairedModel,
    judge: Recording | None,
    names: dict[str, str],
    false_alarm: float,
    twins: int,
    fitted_samples: int | None,
) -> tuple[MismatchReport, list[str]]:
    """Report on the longest stretch without gaps, and remarks on it; errors name the file and the option at fault."""
    from gyrofuse.mismatch import diagnose as find_mismatch
    from gyrofuse.mismatch.repair.inputs import FEWEST

    with progress_bar("comparing") as show:
        if isinstance(simulation, Recording):
            simulation, lacking = without_gaps(simulation, "Simulation: compared", 0)
        else:
            lacking = []
        try:
            part, remarks = without_gaps(recording, "Diagnosed", FEWEST)
            if judge is not None:
                judge, gaps = without_gaps(judge, f"{names['`judge`']}: judged", 0)
                lacking += gaps
            found = find_mismatch(
                part,
                simulation,
                false_alarm=false_alarm,
                twins=twins,
                fitted_samples=fitted_samples,
                judge=judge,
                progress=show,
            )
            start = float(part.time[0])
            if start and found.mismatch:
                remarks.append(f"Times count from the first sample that was diagnosed, at {start:.6g} s of the log.")
            return found, remarks + lacking
        except (ValueError, TypeError) as error:
            message = str(error)
            files = {**names, "`LOG`": names["`recording`"]}
            options = {
                "`false_alarm`": "`--false-alarm`",
                "`twins`": "`--twins`",
                "`fitted_samples`": "`--fitted-samples`",
            }
            for parameter, name in {**files, **options}.items():
                message = message.replace(parameter, name)
            raise type(error)(message) from None


def _units_taken(recording: Recording, simulation: object, names: tuple[str, str]) -> list[str]:
    """Remark on the unit assumed where one of two recordings, or both, state none."""
    if not isinstance(simulation, Recording) or "unknown" not in (recording.unit, simulation.unit):
        return []
    if recording.unit == simulation.unit:
        return [f"Units: neither {names[0]} nor {names[1]} states one; their numbers are compared as they are."]
    pair = (names[0], simulation.unit) if recording.unit == "unknown" else (names[1], recording.unit)
    return [f"Units: {pair[0]} states none; its numbers are taken as {pair[1]}."]


def _simulation(path: Path, recording: Recording, reading: Reading) -> Recording | Model | ArrayModel | RepairedModel:
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


def _as_the_model(recording: Recording, path: Path) -> Recording:
    """The recording, converted to the unit of a model in JSON; raises `ValueError` if their rates differ."""
    rate, unit = model_grid(path) if path.suffix.lower() == ".json" else (None, None)
    if rate is not None and not same_rate(rate, recording.rate):
        raise ValueError(
            f"{path}: expected a model for the recording's {recording.rate:g} Hz, got one that was fitted at "
            f"{rate:g} Hz; fit one at that rate, or resample the log"
        )
    return recording if unit is None or recording.unit in ("unknown", unit) else recording.to(unit)


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
