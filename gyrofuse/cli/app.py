"""The command line: look into a log, fuse it, simulate an array, watch a demonstration.

Bad input ends with one line on stderr and exit status 2, a defect of the program with one line and status 1; with
`--debug` either shows its traceback. Files appear when everything has worked, or not at all.
"""

from __future__ import annotations

import atexit
import csv
import gc
import shutil
import signal
import sys
import threading
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from gyrofuse._base.checks import check_positive_integer
from gyrofuse._base.files import output_folder, write_npz
from gyrofuse._base.units import quantity_of
from gyrofuse.cli.console import Commands, progress, say, say_table
from gyrofuse.cli.demo.demo import FILES, run_demo
from gyrofuse.cli.diagnose import diagnose
from gyrofuse.cli.emulate import emulate
from gyrofuse.cli.fleet import fleet
from gyrofuse.cli.models import fit, rank
from gyrofuse.cli.options import (
    Force,
    Json,
    Method,
    Report,
    agreed_rate,
    agreed_unit,
    at_rest,
    outputs,
    read_model,
    say_notes,
    scale_weights_of,
    stretch,
    titled,
    write_json,
)
from gyrofuse.cli.reading import Logs, Quantity, Reading, takes_options
from gyrofuse.fusion.multiscale import fit_multiscale
from gyrofuse.fusion.multiscale_result import MultiScaleResult
from gyrofuse.fusion.report.page import (
    fusion_figure,
    fusion_report,
    number,
    recording_report,
    save_figure,
    sensor_rows,
)
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.svo import fit_svo
from gyrofuse.io.formats.columns import WORD_OF
from gyrofuse.io.limits import physical_memory
from gyrofuse.io.recording import Recording
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.parsing import parse_model
from gyrofuse.noise.processes import Model

app = typer.Typer(
    name="gyrofuse",
    cls=Commands,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class Covariance(str, Enum):
    """What the intervals of the weights rest on."""

    model = "model"
    block_bootstrap = "block-bootstrap"
    resampling = "resampling"
    none = "none"


# Methods whose weights have no law to rest an interval on, or, equal ones, are not estimated at all.
_WITHOUT_INTERVALS = (Method.multiscale, Method.nonnegative, Method.equal, Method.rdvg)


def _version(wanted: bool) -> None:
    if wanted:
        from gyrofuse import __version__

        try:
            print(f"gyrofuse {__version__}", flush=True)
        except OSError as error:
            print(f"error: standard output: {error.strerror}", file=sys.stderr)
            raise typer.Exit(2) from None
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and leave.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """One virtual gyro from an array of gyros: better than the mean, and it says where and by how much."""


@app.command()
@takes_options
def info(
    *,
    logs: Logs,
    reading: Reading,
    json_file: Json = None,
    report: Report = None,
    force: Force = False,
) -> None:
    """Show what is in a log: sensors, rate, gaps, units, channels."""
    with outputs(force, [*logs, reading.mounting], json=json_file, report=report) as drafts:
        recording = reading.read(logs)
        if json_file:
            write_json(drafts[json_file], recording.to_dict())
        if report:
            with progress("drawing"):
                page = recording_report(recording, title=f"What is in {titled(logs)}")
            drafts[report].write_text(page, encoding="utf-8")
    _say_recording(recording)


@app.command()
@takes_options
def fuse(
    *,
    logs: Logs,
    scale_weights: Annotated[
        str,
        typer.Option(
            metavar="flat|short|long|W1,W2,...",
            help="Which averaging times count: all alike, the short, the long, or one number >= 0 for each level.",
        ),
    ] = "flat",
    method: Annotated[Method, typer.Option(help="How the weights are chosen.")] = Method.svo,
    covariance: Annotated[
        Covariance | None, typer.Option(show_default="model", help="What the intervals of the weights rest on.")
    ] = None,
    levels: Annotated[
        int | None, typer.Option(metavar="J", help="Number of levels; as many as fit by default.")
    ] = None,
    rest: Annotated[
        str | None,
        typer.Option(metavar="START:STOP", help="Choose the weights on this stretch alone (seconds); fuse all of it."),
    ] = None,
    reading: Reading,
    confidence_level: Annotated[float, typer.Option(metavar="P", help="Of all intervals.")] = 0.95,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the virtual gyro, .npz (with the weights) or .csv.")
    ] = None,
    figure: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw it, .png, .svg or .pdf.")] = None,
    json_file: Json = None,
    report: Report = None,
    force: Force = False,
) -> None:
    """Fuse an array, recorded at rest, into one virtual gyro."""
    weights, resting = scale_weights_of(scale_weights), stretch(rest)
    if method in _WITHOUT_INTERVALS and covariance not in (None, Covariance.none):
        raise ValueError(
            f"`--covariance`: {covariance.value} has no use, for --method {method.value} gives no intervals of its "
            "weights; leave the option out, or choose another method"
        )
    with outputs(force, [*logs, reading.mounting], out=out, figure=figure, json=json_file, report=report) as drafts:
        recording = reading.read(logs)
        if recording.axes and recording.n_sensors == 1:
            raise ValueError(
                f"{titled(logs)}: expected several devices to fuse, found one with the axes {', '.join(recording.axes)}"
                "; give the logs of all devices of the array"
            )
        with progress("fusing"):
            part = at_rest(recording, resting)
            result: SVOResult | MultiScaleResult
            if method is Method.multiscale:
                result = fit_multiscale(part, weights, confidence_level=confidence_level, n_levels=levels)
            else:
                result = fit_svo(
                    part,
                    weights,
                    method=method.value.replace("-", "_"),
                    covariance=(covariance or Covariance.model).value.replace("-", "_"),
                    confidence_level=confidence_level,
                    n_levels=levels,
                )
            virtual = result.virtual(recording)
        remarks = []
        if resting:
            remarks = [
                f"Weights from {resting[0]:g} to {resting[1]:g} s of {recording.duration:.6g} s; all of it fused."
            ]
        if out:
            fused = Recording(
                virtual.unsqueeze(-2),
                rate=recording.rate,
                unit=recording.unit,
                sensors=("virtual",),
                time=recording.time,
                axes=recording.axes,
                quantity=recording.quantity,
            )
            _save(fused, drafts[out], weights=result.weights.numpy())
        with progress("drawing"):
            if figure:
                save_figure(fusion_figure(result), drafts[figure], figure.suffix[1:].lower())
            if report:
                title = f"Virtual gyro of {titled(logs)}"
                page = fusion_report(result, recording, virtual, title=title, remarks=remarks)
                drafts[report].write_text(page, encoding="utf-8")
        if json_file:
            write_json(drafts[json_file], result.to_dict())
    say("\n".join([result.summary(), *remarks]))
    say_notes(recording)


app.command()(fit)
app.command()(rank)
app.command()(diagnose)
app.command()(fleet)
app.command()(emulate)


@app.command()
def simulate(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODEL", help='A model in JSON, or a formula such as "WN(variance=1) + RW(variance=1e-6)".'
        ),
    ],
    samples: Annotated[int, typer.Option(metavar="N", help="Samples of each sensor.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Where the recording goes, .npz or .csv.")],
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Sampling rate; by default that of a model fitted to a log.")
    ] = None,
    sensors: Annotated[
        int | None,
        typer.Option(metavar="N", help="How many independent sensors; 1 by default, unless MODEL is an array."),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            metavar="UNIT", help="Unit of the numbers; by default that of a model fitted to a log, or deg/s or m/s^2."
        ),
    ] = None,
    quantity: Annotated[
        Quantity | None, typer.Option(help="What the sensors measure; rate where no unit says.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(metavar="S", min=0, max=2**63 - 1, help="The same seed gives the same recording.")
    ] = None,
    json_file: Json = None,
    report: Report = None,
    force: Force = False,
) -> None:
    """Simulate a recording from a noise model."""
    check_positive_integer("--samples", samples)
    check_positive_integer("--sensors", 1 if sensors is None else sensors)
    source = [Path(model)] if model.lower().endswith(".json") else []
    with outputs(force, source, out=out, json=json_file, report=report) as drafts:
        noise = read_model(source[0]) if source else parse_model(model)
        rate = agreed_rate(source, rate)
        if rate is None:
            raise ValueError(
                "`--rate`: expected the sampling rate in Hz, which this model does not say, got none; give it"
            )
        base = "m/s^2" if quantity is Quantity.acceleration else "deg/s"
        unit = agreed_unit(source[0] if source else None, unit) or base
        if quantity is not None and quantity_of(unit) not in (None, quantity.value):
            raise ValueError(f"`--quantity`: expected that of {unit}, {quantity_of(unit)}, got {quantity.value}")
        generator = torch.Generator()
        seed = generator.seed() % 2**32 if seed is None else seed
        generator.manual_seed(seed)
        whole = not isinstance(noise, Model)
        if not isinstance(noise, Model | ArrayModel):
            noise.check(rate, unit)
        each = _each(noise)
        if (whole or len(each) > 1) and sensors is not None:
            own = f"{len(each)} sensors" if len(each) > 1 else "a whole array"
            raise ValueError(f"`--sensors`: {model} is a model of {own}; leave the option out")
        batch = () if whole or len(each) > 1 else (1 if sensors is None else sensors,)
        _check_memory(samples, noise.n_sensors if isinstance(noise, ArrayModel) else max(len(each), *batch, 1))
        with progress("simulating"):
            signal = noise.simulate(samples, batch=batch, generator=generator).flatten(0, -2)
        measured = quantity_of(unit) or (quantity or Quantity.rate).value
        recording = Recording(signal, rate=rate, unit=unit, quantity=measured)
        _save(recording, drafts[out])
        if json_file:
            settings = {"model": noise.to_dict(), "n_samples": samples, "rate": rate, "unit": unit, "seed": seed}
            write_json(drafts[json_file], settings)
        if report:
            page = recording_report(recording, title=f"A simulated recording of {model}")
            drafts[report].write_text(page, encoding="utf-8")
    say("\n".join(map(str, each)))
    say(f"{signal.shape[0]} x {samples} samples at {rate:g} Hz, seed {seed}, in {out}")


def _check_memory(samples: int, sensors: int) -> None:
    """Refuse what cannot be held, before anything is simulated."""
    needed, there = 8.0 * samples * sensors, physical_memory()
    if needed > there:
        raise ValueError(
            f"`--samples`: expected what fits into {there / 2**30:.3g} GiB of memory, got {samples:.3g} samples of "
            f"{sensors} sensor(s), {needed / 2**30:.3g} GiB; ask for fewer"
        )


def _each(noise: Any) -> list[Any]:
    """A model for every sensor where there are several."""
    if not isinstance(noise, Model) or noise.params.ndim < 2:
        return [noise]
    return [noise.with_params(own) for own in noise.params.flatten(0, -2)]


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write to.")] = Path("gyrofuse-demo"),
    json_file: Json = None,
    report: Report = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files and an earlier demonstration.")] = False,
) -> None:
    """Watch it work on a simulated array.

    Needs no file and no network. The truth is known, and what is found is held against it.
    """
    with (
        outputs(force, json=json_file, report=report) as drafts,
        output_folder(out, own=FILES, force=force) as folder,
    ):
        with progress("simulating, fusing and drawing"):
            story = run_demo(folder)
        for path, name in ((json_file, "result.json"), (report, "report.html")):
            if path:
                shutil.copyfile(folder / name, drafts[path])
    pages = {"Report": "report.html", "Noise models": "models.html", "Mismatch": "mismatch.html", "Figures": "figures"}
    say("\n".join([f"{story}\n", *(f"{name}: {out / file}" for name, file in pages.items())]))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit status."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # names in logs may hold what the terminal cannot show
            stream.reconfigure(errors="replace")
    if threading.current_thread() is threading.main_thread():  # ended from outside: leave no draft behind
        for number in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):  # SIGHUP: the terminal is gone
            if signal.getsignal(number) != signal.SIG_IGN:  # as nohup asks
                signal.signal(number, lambda got, _: sys.exit(128 + got))
    atexit.register(gc.freeze)  # taking apart what was imported, before the process ends anyway, takes a second
    app(arguments)


def _save(recording: Recording, path: Path, **arrays: np.ndarray[Any, Any]) -> None:
    """Save a recording as .csv, or as .npz with further arrays."""
    if path.suffix.lower() == ".csv":
        ends = [f"_{axis}" for axis in recording.axes] or [""]
        names = [f"{sensor}_{WORD_OF[recording.quantity]}{end}" for end in ends for sensor in recording.sensors]
        columns = torch.cat([recording.time[None], recording.signal.flatten(0, -2)]).T
        unit = f" [{recording.unit}]" if recording.unit != "unknown" else ""
        with path.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(["time [s]", *(_cell(name + unit) for name in names)])
            np.savetxt(file, columns.numpy(), fmt="%.17g", delimiter=",")
        return
    recording.save(path, force=True)
    write_npz(path, arrays, "a")


def _cell(text: str) -> str:
    """A name that came with a log, as a cell that no program takes for a formula or for more than one line."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return f"'{line}" if line[:1] in ("=", "+", "-", "@") else line


def _say_recording(recording: Recording) -> None:
    facts = [
        ("source", ", ".join(recording.source)),
        ("sensors", str(recording.n_sensors)),
        ("axes", ", ".join(recording.axes) or "-"),
        ("quantity", recording.quantity),
        ("unit", recording.unit),
        ("rate", f"{number(recording.rate, 8)} Hz"),
        ("samples", str(recording.n_samples)),
        ("duration", f"{number(recording.duration, 6)} s"),
    ]
    say_table((), facts)
    sensors = [
        (
            row["name"],
            row["axis"] or "-",
            f"{100 * row['missing']:.3g} %",
            number(row["mean"]),
            number(row["deviation"]),
        )
        for row in sensor_rows(recording)
    ]
    say_table(("sensor", "axis", "missing", "mean", "standard deviation"), sensors, right=(2, 3, 4))
    if recording.channels:
        channels = [(name, " x ".join(map(str, values.shape))) for name, values in recording.channels.items()]
        say_table(("channel", "shape"), channels)
    say_notes(recording)
