"""Command for what error models cost in the air."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from gyrofuse._base.checks import check_positive_integer
from gyrofuse._base.units import GRAVITY, RATE_UNITS, rate_unit_factor
from gyrofuse.cli.console import progress_bar, say
from gyrofuse.cli.options import (
    Force,
    Json,
    agreed_rate,
    agreed_unit,
    draw,
    files_written,
    model_grid,
    outputs,
    read_model,
    write_json,
)
from gyrofuse.noise.processes import Model


def emulate(
    model: Annotated[Path, typer.Option(metavar="A.json", help="Noise of the gyros, as the first filter is told it.")],
    against: Annotated[Path, typer.Option(metavar="B.json", help="As the second filter is told it.")],
    truth: Annotated[
        Path | None, typer.Option(metavar="FILE", help="What makes the errors; the model of --against by default.")
    ] = None,
    accelerometer: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Noise of the accelerometers, m/s^2 or g; of fair ones by default."),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="time (s), north, east, down (m) [, roll, pitch, yaw (rad)]."),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Of the samples; that of the models, or 100, by default.")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(metavar="UNIT", help="Of the gyros' models, where they do not say; deg/s by default.")
    ] = None,
    flights: Annotated[int, typer.Option(metavar="N", help="How many flights.")] = 200,
    seed: Annotated[int, typer.Option(metavar="S", min=0, help="The same seed gives the same flights.")] = 0,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the ratio over time, .png, .svg or .pdf.")
    ] = None,
    json_file: Json = None,
    force: Force = False,
) -> None:
    """Fly with drawn errors and two filters that are told different noise models: what do they cost?

    Both get the same errors and the same satellite positions, one a second, and none from 160 to 210 s.
    """
    from gyrofuse.navigation import compare_filters, read_trajectory

    check_positive_integer("--flights", flights)
    given = [path for path in (model, against, truth, accelerometer, trajectory) if path is not None]
    with outputs(force, given, figure=figure, json=json_file) as drafts:
        gyros = [path for path in (model, against, truth) if path is not None]
        hz = agreed_rate([*gyros, *([accelerometer] if accelerometer else [])], rate) or 100.0
        told = [_gyro(path, unit) for path in gyros]
        with progress_bar("flying") as show:
            result = compare_filters(
                told[0],
                told[1],
                truth=told[2] if truth else None,
                accelerometer=_accelerometer(accelerometer) if accelerometer else None,
                rate=hz,
                trajectory=read_trajectory(trajectory) if trajectory else None,
                n_flights=flights,
                generator=torch.Generator().manual_seed(seed),
                progress=show,
            )
        if figure:
            draw(result.plot, drafts[figure], figure, height=3.6)
        if json_file:
            write_json(drafts[json_file], {"model": str(model), "against": str(against), **result.to_dict()})
    say("\n".join([result.summary(), *files_written(figure, json_file)]))


def _single(path: Path) -> Model:
    """One model, of one sensor."""
    noise = read_model(path)
    if not isinstance(noise, Model) or noise.params.numel() != len(noise.param_names):
        raise ValueError(f"{path}: expected the model of one sensor, found that of several; fit one with --sensors")
    return noise.with_params(noise.params.flatten())


def _gyro(path: Path, unit: str | None) -> Model:
    """In rad/s."""
    name = agreed_unit(path, unit) or "deg/s"
    if name not in RATE_UNITS:
        raise ValueError(f"{path}: expected a model in one of {', '.join(RATE_UNITS)}, found {name}; give --unit")
    return _single(path).scaled(rate_unit_factor(name, "rad/s"))


def _accelerometer(path: Path) -> Model:
    """In m/s^2, which a model that says nothing is in."""
    unit = model_grid(path)[1]
    if unit not in (None, "m/s^2", "g"):
        raise ValueError(f"{path}: expected a model of an accelerometer in m/s^2 or g, found one in {unit}")
    return _single(path).scaled(GRAVITY if unit == "g" else 1.0)
