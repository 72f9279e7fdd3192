"""Command `simulate`: a recording from a noise model."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from gyrofuse._base.checks import check_positive_integer
from gyrofuse._base.files import write_npz
from gyrofuse._base.units import quantity_of
from gyrofuse.cli.console import progress, say
from gyrofuse.cli.options import Quantity, Writing, takes_options
from gyrofuse.cli.reading import agreed_rate, agreed_unit, read_model
from gyrofuse.fusion.report.page import recording_report
from gyrofuse.io.limits import physical_memory
from gyrofuse.io.quantities import QUANTITY
from gyrofuse.io.recording import Recording
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.parsing import parse_model
from gyrofuse.noise.processes import Model


@takes_options
def simulate(
    *,
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
    writing: Writing,
) -> None:
    """Simulate a recording from a noise model.

    MODEL is a file in JSON, as fit --model-out writes it, or a formula of processes with their numbers, per sample and
    in the unit of the signal: "WN(variance=1e-4) + AR1(phi=0.99, variance=1e-8) + 2*RW(variance=1e-10)". Processes are
    WN(variance), QN(variance), FN(variance), AR1(phi, variance), GM2(phi, variance), RW(variance), DR(slope) and
    SIN(amplitude, beta).
    """
    check_positive_integer("--samples", samples)
    check_positive_integer("--sensors", 1 if sensors is None else sensors)
    source = [Path(model)] if model.lower().endswith(".json") else []
    with writing.files(source, out=out) as files:
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
        save_recording(recording, files.draft("out"))
        settings = {"model": noise.to_dict(), "n_samples": samples, "rate": rate, "unit": unit, "seed": seed}
        files.write_json(lambda: settings)
        files.write_report(lambda: recording_report(recording, title=f"A simulated recording of {model}"))
    say("\n".join(map(str, each)))
    say(f"{signal.shape[0]} x {samples} samples at {rate:g} Hz, seed {seed}, in {out}")


def _check_memory(samples: int, sensors: int) -> None:
    """Raise `ValueError` for a signal that does not fit into memory, before it is simulated."""
    needed, there = 8.0 * samples * sensors, physical_memory()
    if needed > there:
        raise ValueError(
            f"`--samples`: expected what fits into {there / 2**30:.3g} GiB of memory, got {samples:.3g} samples of "
            f"{sensors} sensor(s), {needed / 2**30:.3g} GiB; ask for fewer"
        )


def _each(noise: Any) -> list[Any]:
    """Models of single sensors, where a model has several."""
    if not isinstance(noise, Model) or noise.params.ndim < 2:
        return [noise]
    return [noise.with_params(own) for own in noise.params.flatten(0, -2)]


def save_recording(recording: Recording, path: Path, **arrays: np.ndarray[Any, Any]) -> None:
    """Save a recording as .csv, or as .npz with further arrays.

    Args:
        recording: The recording.
        path: The file; its suffix says the format.
        **arrays: Further arrays of a .npz file.
    """
    if path.suffix.lower() == ".csv":
        ends = [f"_{axis}" for axis in recording.axes] or [""]
        names = [f"{sensor}_{QUANTITY[recording.quantity].array}{end}" for end in ends for sensor in recording.sensors]
        columns = torch.cat([recording.time[None], recording.signal.flatten(0, -2)]).T
        unit = f" [{recording.unit}]" if recording.unit != "unknown" else ""
        with path.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(["time [s]", *(_cell(name + unit) for name in names)])
            np.savetxt(file, columns.numpy(), fmt="%.17g", delimiter=",")
        return
    recording.save(path, force=True)
    write_npz(path, arrays, "a")


def _cell(text: str) -> str:
    """A name from a log as a cell of a table that programs read neither as a formula nor as several lines."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return f"'{line}" if line[:1] in ("=", "+", "-", "@") else line
