"""Command `emulate`: effect of gyro noise models on navigation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from gyrofuse._base.checks import check_positive_integer
from gyrofuse._base.units import GRAVITY, RATE_UNITS, rate_unit_factor
from gyrofuse.cli.console import progress_bar, say
from gyrofuse.cli.options import FileWriting, one_panel, takes_options
from gyrofuse.cli.reading import agreed_rate, agreed_unit, model_grid, read_model
from gyrofuse.noise.processes import Model


@takes_options
def emulate(
    *,
    model: Annotated[Path, typer.Option(metavar="A.json", help="Gyro noise model that the first filter assumes.")],
    against: Annotated[Path, typer.Option(metavar="B.json", help="Gyro noise model that the second filter assumes.")],
    truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Gyro noise model of the errors; that of --against by default."),
    ] = None,
    accelerometer: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Noise model of the accelerometers, m/s^2 or g; that of consumer MEMS by default."
        ),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="time (s), north, east, down (m) [, roll, pitch, yaw (rad)]."),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Sampling rate; that of the models, or 100, by default.")
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(metavar="UNIT", help="Unit of gyro models that have none; deg/s by default."),
    ] = None,
    flights: Annotated[int, typer.Option(metavar="N", help="Number of flights.")] = 200,
    seed: Annotated[int, typer.Option(metavar="S", min=0, help="The same seed gives the same flights.")] = 0,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the ratio over time, .png, .svg or .pdf.")
    ] = None,
    writing: FileWriting,
) -> None:
    """Compare navigation filters that assume different gyro noise models, on simulated flights.

    Both filters get the same errors and the same satellite positions, one a second, and none from 160 to 210 s.
    """
    from gyrofuse.navigation import compare_filters, read_trajectory

    check_positive_integer("--flights", flights)
    given = [path for path in (model, against, truth, accelerometer, trajectory) if path is not None]
    with writing.files(given, figure=figure) as files:
        gyros = [path for path in (model, against, truth) if path is not None]
        hz = agreed_rate([*gyros, *([accelerometer] if accelerometer else [])], rate) or 100.0
        models = [_gyro(path, unit) for path in gyros]
        with progress_bar("flying") as show:
            result = compare_filters(
                models[0],
                models[1],
                truth=models[2] if truth else None,
                accelerometer=_accelerometer(accelerometer) if accelerometer else None,
                rate=hz,
                trajectory=read_trajectory(trajectory) if trajectory else None,
                n_flights=flights,
                generator=torch.Generator().manual_seed(seed),
                progress=show,
            )
        files.write_figure(lambda: one_panel(result.plot, height=3.6))
        files.write_json(lambda: {"model": str(model), "against": str(against), **result.to_dict()})
    say("\n".join([result.summary(), *files.note]))


def _single(path: Path) -> Model:
    """Read the noise model of one sensor."""
    noise = read_model(path)
    if not isinstance(noise, Model) or noise.params.numel() != len(noise.param_names):
        raise ValueError(f"{path}: expected the model of one sensor, found that of several; fit one with --sensors")
    return noise.with_params(noise.params.flatten())


def _gyro(path: Path, unit: str | None) -> Model:
    """Read the noise model of a gyro, in rad/s."""
    name = agreed_unit(path, unit) or "deg/s"
    if name not in RATE_UNITS:
        raise ValueError(f"{path}: expected a model in one of {', '.join(RATE_UNITS)}, found {name}; give --unit")
    return _single(path).scaled(rate_unit_factor(name, "rad/s"))


def _accelerometer(path: Path) -> Model:
    """Read the noise model of an accelerometer, in m/s^2, which is also the unit of a model without one."""
    unit = model_grid(path)[1]
    if unit not in (None, "m/s^2", "g"):
        raise ValueError(f"{path}: expected a model of an accelerometer in m/s^2 or g, found one in {unit}")
    return _single(path).scaled(GRAVITY if unit == "g" else 1.0)
