"""Command for many logs at once."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gyrofuse._checks import check_positive_integer
from gyrofuse._console import progress_bar, say
from gyrofuse.cli_shared import (
    Axis,
    Force,
    Json,
    Key,
    Method,
    Rate,
    Report,
    Scale,
    Sensors,
    Unit,
    files_written,
    known_unit,
    outputs,
    read_model,
    scale_weights_of,
    write_json,
)
from gyrofuse.processes import Model
from gyrofuse.recording import read_recording
from gyrofuse.simulate import ArrayModel

if TYPE_CHECKING:
    from gyrofuse.fleet.store import ResultStore
    from gyrofuse.fleet.tasks import Task
    from gyrofuse.lightning_module import GyroArrayDataModule

_ACCELERATORS = ("cpu", "gpu", "auto")
_LOOK = 0.5  # s between looks at how far a run has come


class Kind(str, Enum):
    """What is asked of every log."""

    fuse = "fuse"
    fit = "fit"
    diagnose = "diagnose"


def fleet(
    paths: Annotated[
        list[str] | None,
        typer.Argument(metavar="PATH...", help='Logs, folders with logs, and patterns such as "flights/*/imu.npz".'),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Where the rows go, .parquet; a run that was stopped goes on there.")
    ] = Path("results.parquet"),
    task: Annotated[Kind, typer.Option(help="What is asked of every log.")] = Kind.fuse,
    manifest: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Text file with one path a line, relative to its folder.")
    ] = None,
    devices: Annotated[int, typer.Option(metavar="N", help="Processes, or GPUs, to share the work.")] = 1,
    accelerator: Annotated[str, typer.Option(metavar="cpu|gpu|auto", help="Where they compute.")] = "cpu",
    group: Annotated[
        int, typer.Option(metavar="N", help="Logs taken at a time; more than one pays where they are many and short.")
    ] = 1,
    retry: Annotated[bool, typer.Option("--retry", help="Try logs again that failed before.")] = False,
    scale_weights: Annotated[
        str, typer.Option(metavar="flat|short|long|W1,W2,...", help="fuse: which averaging times count.")
    ] = "flat",
    method: Annotated[Method, typer.Option(help="fuse: how weights are chosen.")] = Method.svo,
    virtual: Annotated[bool, typer.Option("--virtual", help="fuse: keep the virtual gyros in the table.")] = False,
    model: Annotated[str, typer.Option(metavar="FORMULA", help="fit: processes to fit.")] = "WN + AR1 + RW",
    simulation: Annotated[
        Path | None, typer.Option(metavar="SIM", help="diagnose: a recording of the simulator, or a model, .json.")
    ] = None,
    false_alarm: Annotated[float, typer.Option(metavar="P", help="diagnose: where nothing is missing.")] = 0.01,
    axis: Axis = None,
    sensors: Sensors = None,
    rate: Rate = None,
    unit: Unit = None,
    scale: Scale = None,
    key: Key = None,
    json_file: Json = None,
    report: Report = None,
    force: Force = False,
) -> None:
    """Fuse, fit or diagnose many logs, on one process or several, into one table with a row for each.

    A log that cannot be used gets a row that says why, and the others theirs. Stopped at any moment, the same command
    goes on where it was.
    """
    from gyrofuse.fleet.logs import groups_of
    from gyrofuse.fleet.standing import standing_of
    from gyrofuse.fleet.store import ResultStore, read_results
    from gyrofuse.lightning_module import GyroArrayDataModule

    check_positive_integer("--devices", devices)
    check_positive_integer("--group", group)
    if accelerator not in _ACCELERATORS:
        known = f"{', '.join(_ACCELERATORS[:-1])} or {_ACCELERATORS[-1]}"
        raise ValueError(f"`--accelerator`: expected {known}, got {accelerator!r}")
    if out.suffix.lower() != ".parquet":
        raise ValueError(f"`--out`: expected a name that ends in .parquet, got {str(out)!r}")
    asked = _task(task, scale_weights, method, virtual, model, simulation, false_alarm)
    options: dict[str, Any] = {
        "axis": axis,
        "sensors": None if sensors is None else sensors.split(","),
        "rate": rate,
        "unit": None if unit is None else known_unit(unit),
        "scale": scale,
        "key": key,
    }
    options = {name: value for name, value in options.items() if value is not None}
    with outputs(force, [manifest, simulation], json=json_file, report=report) as drafts:
        store = ResultStore(out, asked.columns, {**asked.settings, **options})
        data = GyroArrayDataModule(paths or [], manifest=manifest, **options)
        store.open(force=force)
        data.groups = groups_of(data.logs, group, store.done(failed=not retry))
        _run(asked, store, data, devices, accelerator)
        settings, rows = read_results(out, without=["virtual"])
        standing = standing_of(settings["task"], rows)
        if json_file:
            write_json(drafts[json_file], standing.to_dict())
        if report:
            from gyrofuse.report_fleet import fleet_report

            drafts[report].write_text(fleet_report(standing, rows, title=f"Fleet in {out.name}"), encoding="utf-8")
    say("\n".join([standing.summary(), *files_written(out, json_file, report)]))


def _task(
    kind: Kind,
    scale_weights: str,
    method: Method,
    virtual: bool,
    model: str,
    simulation: Path | None,
    false_alarm: float,
) -> Task:
    from gyrofuse.fleet.tasks import Diagnose, Fit, Fuse

    if kind is Kind.fuse:
        weights = scale_weights_of(scale_weights)
        if method is Method.multiscale:
            raise ValueError("`--method`: expected one with a weight for each sensor, got multiscale; choose another")
        return Fuse(weights, method=method.value.replace("-", "_"), virtual=virtual)
    if kind is Kind.fit:
        return Fit(model)
    if simulation is None:
        raise ValueError("`--simulation`: expected what to compare with, a recording or a model, got none; give it")
    return Diagnose(_simulation(simulation), false_alarm=false_alarm, source=str(simulation))


def _simulation(path: Path) -> Any:
    if path.suffix.lower() != ".json":
        return read_recording(path)
    noise = read_model(path)
    if not isinstance(noise, Model | ArrayModel):
        raise ValueError(f"{path}: expected a noise model, found a repaired simulation; draw a recording of it first")
    return noise


def _run(task: Task, store: ResultStore, data: GyroArrayDataModule, devices: int, accelerator: str) -> None:
    """Work on what is not done yet, with a bar."""
    from torch.multiprocessing import ProcessExitedException, ProcessRaisedException

    from gyrofuse.fleet.logs import identity
    from gyrofuse.lightning_module import FusionModule, ResultWriter, quiet_trainer

    if not data.groups:
        store.finish([identity(log) for log in data.logs])
        return
    try:
        with _watched(store, store.n_parts, len(data.groups), len(data.logs)):
            trainer = quiet_trainer(devices=devices, accelerator=accelerator, callbacks=[ResultWriter(store)])
            trainer.predict(FusionModule(task), datamodule=data, return_predictions=False)
    except ProcessRaisedException as error:  # its last line is what was raised
        kind, _, words = str(error).strip().rpartition("\n")[2].partition(": ")
        raise (OSError if kind.endswith("Error") else RuntimeError)(words or kind) from None
    except ProcessExitedException as error:
        raise OSError(f"a process ended early ({error}); what is finished is kept, start again to go on") from None


@contextmanager
def _watched(store: ResultStore, already: int, n_groups: int, n_logs: int) -> Iterator[None]:
    """Show how many groups of logs are done, whoever does them."""
    over = threading.Event()

    with progress_bar(f"{n_logs} logs") as show:

        def look() -> None:
            while not over.wait(_LOOK):
                done = max(store.n_parts - already, 0)
                show(f"{done} of {n_groups} to do", done / n_groups)

        watcher = threading.Thread(target=look, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()
