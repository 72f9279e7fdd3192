"""Commands for noise models: fit one, rank many."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gyrofuse._console import progress, say
from gyrofuse.cli_shared import (
    Axis,
    Force,
    Json,
    Key,
    Logs,
    Mounting,
    Rate,
    Scale,
    Sensors,
    Unit,
    outputs,
    read,
    say_notes,
    stretch,
    write_json,
)
from gyrofuse.export import to_kalibr
from gyrofuse.gmwm import fit_gmwm
from gyrofuse.gmwm_result import GMWMResult
from gyrofuse.ranking import rank_models
from gyrofuse.recording import Recording
from gyrofuse.report import new_figure, save_figure

_MOST_FITS = 12  # printed in full


def fit(
    logs: Logs,
    model: Annotated[
        str, typer.Option(metavar="FORMULA", help='Processes to fit, such as "WN + AR1 + RW" or "WN + 2*AR1 + SIN".')
    ],
    levels: Annotated[
        int | None, typer.Option(metavar="J", help="Number of levels; as many as hold two windows by default.")
    ] = None,
    rest: Annotated[str | None, typer.Option(metavar="START:STOP", help="Fit this stretch alone (seconds).")] = None,
    axis: Axis = None,
    sensors: Sensors = None,
    rate: Rate = None,
    unit: Unit = None,
    scale: Scale = None,
    key: Key = None,
    mounting: Mounting = None,
    confidence_level: Annotated[float, typer.Option(metavar="P", help="Of all intervals.")] = 0.95,
    kalibr: Annotated[Path | None, typer.Option(metavar="FILE", help="Write Kalibr's imu.yaml, of one sensor.")] = None,
    model_out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the fitted model, .json, which simulate reads.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the fit of the first sensor, .png, .svg or .pdf.")
    ] = None,
    json_file: Json = None,
    force: Force = False,
) -> None:
    """Fit a noise model to every sensor of a log, recorded at rest."""
    resting = stretch(rest)
    asked = {"kalibr": kalibr, "model-out": model_out, "figure": figure, "json": json_file}
    with outputs(force, [*logs, mounting], **asked) as drafts:
        recording = read(logs, axis, sensors, rate, unit, scale, key, mounting)
        with progress("fitting"):
            part = recording.between(*resting) if resting else recording
            result = fit_gmwm(part, model, confidence_level=confidence_level, n_levels=levels)
        if kalibr:
            drafts[kalibr].write_text(_kalibr(result, recording), encoding="utf-8")
        if model_out:
            write_json(drafts[model_out], result.model.to_dict())
        if figure:
            drawn = new_figure(7.0, 4.6)
            result.plot(drawn.subplots())
            save_figure(drawn, drafts[figure], figure.suffix[1:])
        if json_file:
            write_json(drafts[json_file], result.to_dict())
    say(result.summary())
    say_notes(recording)


def _kalibr(result: GMWMResult, recording: Recording) -> str:
    params = result.params.flatten(0, -2)
    if len(params) != 1:
        raise ValueError(
            f"`--kalibr`: expected one sensor and axis, got {len(params)}; choose with --sensors and --axis"
        )
    return to_kalibr(result.model.with_params(params[0]), recording.rate, recording.unit)


def rank(
    logs: Logs,
    candidates: Annotated[
        str | None,
        typer.Option(
            metavar="FORMULA,...",
            help='Compositions to compare, such as "WN+AR1, WN+AR1+RW"; all that make sense by default.',
        ),
    ] = None,
    levels: Annotated[
        int | None, typer.Option(metavar="J", help="Number of levels; as many as hold two windows by default.")
    ] = None,
    rest: Annotated[str | None, typer.Option(metavar="START:STOP", help="Rank this stretch alone (seconds).")] = None,
    axis: Axis = None,
    sensors: Sensors = None,
    rate: Rate = None,
    unit: Unit = None,
    scale: Scale = None,
    key: Key = None,
    mounting: Mounting = None,
    confidence_level: Annotated[float, typer.Option(metavar="P", help="Of all intervals.")] = 0.95,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the ranking of the first sensor, .png, .svg or .pdf.")
    ] = None,
    json_file: Json = None,
    force: Force = False,
) -> None:
    """Find which noise processes made the signal of every sensor of a log, recorded at rest."""
    resting = stretch(rest)
    formulas = None if candidates is None else [formula.strip() for formula in candidates.split(",")]
    with outputs(force, [*logs, mounting], figure=figure, json=json_file) as drafts:
        recording = read(logs, axis, sensors, rate, unit, scale, key, mounting)
        with progress("ranking"):
            part = recording.between(*resting) if resting else recording
            result = rank_models(part, formulas, confidence_level=confidence_level, n_levels=levels)
        if figure:
            drawn = new_figure(7.0, 4.6)
            result.plot(drawn.subplots())
            save_figure(drawn, drafts[figure], figure.suffix[1:])
        if json_file:
            write_json(drafts[json_file], result.to_dict())
    say(result.summary())
    fits = [fit for fit in result.best if fit is not None]
    if len(fits) <= _MOST_FITS:
        say("\n".join(f"\n{fit}" for fit in fits))
    say_notes(recording)
