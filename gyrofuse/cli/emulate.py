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
from gyrofuse.noise.parsing import parse_model
from gyrofuse.noise.processes import Model


@takes_options
def emulate(
    *,
    model: Annotated[str, typer.Option(metavar="MODEL", help="Gyro noise model that the first filter assumes.")],
    against: Annotated[str, typer.Option(metavar="MODEL", help="Gyro noise model that the second filter assumes.")],
    truth: Annotated[
        str | None,
        typer.Option(metavar="MODEL", help="Gyro noise model of the errors; that of --against by default."),
    ] = None,
    accelerometer: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL",
            help="Noise model of the accelerometers, m/s^2 or g (a formula: m/s^2); that of consumer MEMS by default.",
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

    A MODEL is a file in JSON, as fit --model-out writes it, or a formula of processes with their numbers, per sample of
    --rate and in --unit: "WN(variance=1e-4) + AR1(phi=0.99, variance=1e-8) + RW(variance=1e-10)". Processes are
    WN(variance), QN(variance), FN(variance), AR1(phi, variance), GM2(phi, variance), RW(variance), DR(slope) and
    SIN(amplitude, beta).
    """
    from gyrofuse.navigation import compare_filters, read_trajectory

    check_positive_integer("--flights", flights)
    named = {"model": model, "against": against, "truth": truth, "accelerometer": accelerometer}
    sources = {option: _source(option, text) for option, text in named.items() if text is not None}
    of_models = [source for source in sources.values() if isinstance(source, Path)]
    with writing.files([*of_models, trajectory], figure=figure) as files:
        hz = agreed_rate(of_models, rate) or 100.0
        models = [_gyro(source, unit) for option, source in sources.items() if option != "accelerometer"]
        with progress_bar("flying") as show:
            result = compare_filters(
                models[0],
                models[1],
                truth=models[2] if truth else None,
                accelerometer=_accelerometer(sources["accelerometer"]) if accelerometer else None,
                rate=hz,
                trajectory=read_trajectory(trajectory) if trajectory else None,
                n_flights=flights,
                generator=torch.Generator().manual_seed(seed),
                progress=show,
            )
        files.write_figure(lambda: one_panel(result.plot, height=3.6))
        files.write_json(lambda: {"model": model, "against": against, **result.to_dict()})
    say("\n".join([result.summary(), *files.note]))


def _source(option: str, text: str) -> Path | Model:
    """The file that an option names, or the model whose formula it gives: one with numbers has brackets."""
    if text.lower().endswith(".json") or "(" not in text:
        path = Path(text)
        if not path.suffix and not path.exists():
            raise ValueError(
                f"`--{option}`: expected a file in JSON, or a formula with numbers such as "
                f'"WN(variance=1e-4) + RW(variance=1e-10)", got {text!r}'
            )
        return path
    try:
        noise = parse_model(text)
        noise.wavelet_variance(1)  # which asks for all numbers
    except ValueError as error:
        raise ValueError(f"`--{option}`: {error}") from None
    return noise


def _single(path: Path | Model) -> Model:
    """The noise model of one sensor."""
    if isinstance(path, Model):
        return path
    noise = read_model(path)
    if not isinstance(noise, Model) or noise.params.numel() != len(noise.param_names):
        raise ValueError(f"{path}: expected the model of one sensor, found that of several; fit one with --sensors")
    return noise.with_params(noise.params.flatten())


def _gyro(path: Path | Model, unit: str | None) -> Model:
    """The noise model of a gyro, in rad/s."""
    name = agreed_unit(None if isinstance(path, Model) else path, unit) or "deg/s"
    if name not in RATE_UNITS:
        source = "`--unit`" if isinstance(path, Model) else path
        raise ValueError(f"{source}: expected a model in one of {', '.join(RATE_UNITS)}, found {name}; give --unit")
    return _single(path).scaled(rate_unit_factor(name, "rad/s"))


def _accelerometer(path: Path | Model) -> Model:
    """The noise model of an accelerometer, in m/s^2, which is also the unit of a model without one."""
    unit = None if isinstance(path, Model) else model_grid(path)[1]
    if unit not in (None, "m/s^2", "g"):
        raise ValueError(f"{path}: expected a model of an accelerometer in m/s^2 or g, found one in {unit}")
    return _single(path).scaled(GRAVITY if unit == "g" else 1.0)
