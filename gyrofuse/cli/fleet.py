"""Command `fleet`: many logs at once."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gyrofuse._base.checks import check_positive_integer
from gyrofuse.cli.console import progress_bar, say, warn
from gyrofuse.cli.options import METHOD_NAMES, FileReading, Writing, chosen, scale_weights_of, takes_options
from gyrofuse.cli.reading import read_model
from gyrofuse.fleet.workers import begin_imports
from gyrofuse.io.reading import read_recording
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.processes import Model

if TYPE_CHECKING:
    from gyrofuse.fleet.store.store import ResultStore
    from gyrofuse.fleet.tasks import Task

_ACCELERATORS = ("cpu", "gpu", "auto")
# Default of --timeout, s. Far above what sound logs take (10^8 samples are fused in a minute, 10^6 diagnosed in some
# minutes), and a damaged log, which a library may never finish reading, costs only a part of a night's run.
_TIMEOUT = 3600.0


class Kind(str, Enum):
    """Task for every log."""

    fuse = "fuse"
    fit = "fit"
    diagnose = "diagnose"


@takes_options
def fleet(
    *,
    paths: Annotated[
        list[str] | None,
        typer.Argument(metavar="PATH...", help='Logs, folders with logs, and patterns such as "flights/*/imu.npz".'),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Where the rows go, .parquet (needs pyarrow); a run that was stopped goes on there.",
        ),
    ] = Path("results.parquet"),
    task: Annotated[Kind, typer.Option(help="Task for every log.")] = Kind.fuse,
    manifest: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Text file with one path a line, relative to its folder.")
    ] = None,
    devices: Annotated[int, typer.Option(metavar="N", help="Processes, or GPUs, to share the work.")] = 1,
    accelerator: Annotated[str, typer.Option(metavar="cpu|gpu|auto", help="Where they compute.")] = "cpu",
    group: Annotated[
        int, typer.Option(metavar="N", help="Logs taken at a time; more than one pays where they are many and short.")
    ] = 1,
    timeout: Annotated[
        float,
        typer.Option(
            metavar="S", help="Seconds that a log may take to be read, and again to be worked on; 0 for any number."
        ),
    ] = _TIMEOUT,
    retry: Annotated[bool, typer.Option("--retry", help="Try logs again that failed before.")] = False,
    scale_weights: Annotated[
        str | None,
        typer.Option(
            metavar="flat|short|long|W1,W2,...", show_default="flat", help="fuse: which averaging times count."
        ),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(metavar="|".join(METHOD_NAMES), show_default="svo", help="fuse: how weights are chosen."),
    ] = None,
    virtual: Annotated[bool, typer.Option("--virtual", help="fuse: keep the virtual gyros in the table.")] = False,
    model: Annotated[
        str | None, typer.Option(metavar="FORMULA", show_default="WN + AR1 + RW", help="fit: processes to fit.")
    ] = None,
    simulation: Annotated[
        Path | None, typer.Option(metavar="SIM", help="diagnose: a recording of the simulator, or a model, .json.")
    ] = None,
    false_alarm: Annotated[
        float | None, typer.Option(metavar="P", show_default="0.01", help="diagnose: where nothing is missing.")
    ] = None,
    reading: FileReading,
    writing: Writing,
) -> None:
    """Fuse, fit or diagnose many logs, on one process or several, into one table with a row for each.

    A log that cannot be used gets a row with the reason, also if it crashes or hangs the process that reads it, and the
    other logs are not affected; the exit status is 1 if no log can be used. A run that was stopped at any moment is
    resumed by the same command.
    """
    check_positive_integer("--devices", devices)
    check_positive_integer("--group", group)
    if accelerator not in _ACCELERATORS:
        known = f"{', '.join(_ACCELERATORS[:-1])} or {_ACCELERATORS[-1]}"
        raise ValueError(f"`--accelerator`: expected {known}, got {accelerator!r}")
    if not (timeout >= 0 and math.isfinite(timeout)):
        raise ValueError(f"`--timeout`: expected a finite number of seconds >= 0, got {timeout!r}")
    begin_imports(accelerator)

    from gyrofuse.fleet.lightning import GyroArrayDataModule
    from gyrofuse.fleet.logs import identity
    from gyrofuse.fleet.processes import run_fleet
    from gyrofuse.fleet.store.store import ResultStore
    from gyrofuse.fleet.store.table import read_results
    from gyrofuse.fleet.summary import summarise

    if out.suffix.lower() != ".parquet":
        raise ValueError(f"`--out`: expected a name that ends in .parquet, got {str(out)!r}")
    for option, kind, given in (
        ("--scale-weights", Kind.fuse, scale_weights is not None),
        ("--method", Kind.fuse, method is not None),
        ("--virtual", Kind.fuse, virtual),
        ("--model", Kind.fit, model is not None),
        ("--simulation", Kind.diagnose, simulation is not None),
        ("--false-alarm", Kind.diagnose, false_alarm is not None),
    ):
        if given and kind is not task:
            raise ValueError(f"`{option}`: expected with --task {kind.value} alone, got {task.value}; leave it out")
    asked = _task(task, scale_weights, method, virtual, model, simulation, false_alarm)
    options = reading.options
    with writing.files([manifest, simulation]) as files:
        store = ResultStore(out, asked.columns, {**asked.settings, **options})
        data = GyroArrayDataModule(paths or [], manifest=manifest, group_size=group, **options)
        data.logs = tuple(log for log in data.logs if identity(log) != identity(out))  # its suffix is that of a log
        _check_devices(devices, accelerator)
        store.open(force=writing.force)
        try:
            with _watched(store, len(data.logs), group):
                run_fleet(
                    asked,
                    data,
                    store,
                    devices=devices,
                    accelerator=accelerator,
                    timeout=timeout or None,
                    retry=retry,
                    report=warn,
                )
        except (SystemExit, KeyboardInterrupt):
            warn("stopped; what is finished is kept, start again to go on")
            raise
        finally:
            store.close()
        settings, rows = read_results(out, without=["virtual"])
        summary = summarise(settings["task"], rows)
        files.write_json(summary.to_dict)
        if writing.report:
            from gyrofuse.fleet.report import fleet_report

            title = f"Fleet in {out.name}"
            files.write_report(lambda: fleet_report(summary, rows, title=title, settings=settings))
    written = ", ".join(map(str, (out, *files.paths.values())))
    say(f"{summary.summary()}\nWritten: {written}")
    if len(summary.failures) == summary.n_logs:
        raise typer.Exit(1)  # for what starts the command and goes on with the table


def _task(
    kind: Kind,
    scale_weights: str | None,
    method: str | None,
    virtual: bool,
    model: str | None,
    simulation: Path | None,
    false_alarm: float | None,
) -> Task:
    from gyrofuse.fleet.tasks import Diagnose, Fit, Fuse

    if kind is Kind.fuse:
        name = chosen("--method", method or Fuse.method, METHOD_NAMES)
        if name == "multiscale":
            raise ValueError("`--method`: expected one with a weight for each sensor, got multiscale; choose another")
        weights = Fuse.scale_weights if scale_weights is None else scale_weights_of(scale_weights)
        return Fuse(weights, method=name, virtual=virtual)
    if kind is Kind.fit:
        return Fit() if model is None else Fit(model)
    if simulation is None:
        raise ValueError("`--simulation`: expected what to compare with, a recording or a model, got none; give it")
    level = Diagnose.false_alarm if false_alarm is None else false_alarm
    return Diagnose(_simulation(simulation), false_alarm=level, source=str(simulation))


def _simulation(path: Path) -> Any:
    if path.suffix.lower() != ".json":
        return read_recording(path)
    noise = read_model(path)
    if not isinstance(noise, Model | ArrayModel):
        raise ValueError(f"{path}: expected a noise model, found a repaired simulation; draw a recording of it first")
    return noise


def _check_devices(devices: int, accelerator: str) -> None:
    from lightning.pytorch.utilities.exceptions import MisconfigurationException

    from gyrofuse.fleet.lightning import quiet_trainer

    try:
        quiet_trainer(devices=devices, accelerator=accelerator)
    except MisconfigurationException as error:
        raise ValueError(
            f"`--accelerator`: expected {devices} of the kind {accelerator}, which this computer does not have "
            f"({error}); leave it out, or ask for fewer --devices"
        ) from None


@contextmanager
def _watched(store: ResultStore, n_logs: int, group: int, interval: float = 0.5) -> Iterator[None]:
    """Show how many groups of logs are done in this run, by all processes, updated every `interval` seconds."""
    over = threading.Event()
    already, n_groups = store.n_parts, math.ceil(n_logs / group)

    with progress_bar(f"{n_logs} logs") as show:

        def update() -> None:
            while not over.wait(interval):
                done = max(store.n_parts - already, 0)
                show(f"{done} groups done", min((already + done) / n_groups, 1.0))

        watcher = threading.Thread(target=update, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()
