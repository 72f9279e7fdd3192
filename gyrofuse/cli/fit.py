"""Command `fit`: a noise model for every sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from gyrofuse._base.units import ACCELERATION_UNITS, DATASHEET_UNITS, RATE_UNITS
from gyrofuse.cli.console import progress, say
from gyrofuse.cli.options import (
    Confidence,
    Logs,
    ModelLevels,
    Quantity,
    Reading,
    Rest,
    Writing,
    one_panel,
    stretch,
    takes_options,
)
from gyrofuse.cli.reading import at_rest, naming, say_notes, titled
from gyrofuse.export.c_header import to_c_header
from gyrofuse.export.kalibr import to_kalibr
from gyrofuse.fitting.gmwm import fit_gmwm
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.report.page import model_report
from gyrofuse.io.recording import Recording
from gyrofuse.io.streams import RecordingError
from gyrofuse.noise.processes import Model


class Weighting(str, Enum):
    """Weights of the levels."""

    optimal = "optimal"
    diagonal = "diagonal"
    identity = "identity"


@takes_options
def fit(
    *,
    logs: Logs,
    model: Annotated[
        str, typer.Option(metavar="FORMULA", help='Processes to fit, such as "WN + AR1 + RW" or "WN + 2*AR1 + SIN".')
    ],
    levels: ModelLevels = None,
    weighting: Annotated[Weighting, typer.Option(help="How much the levels count.")] = Weighting.optimal,
    refine: Annotated[
        bool, typer.Option("--refine", help="Go on to the maximum of the spectral likelihood, a little sharper.")
    ] = False,
    robust: Annotated[
        float,
        typer.Option(metavar="EFF", help="Efficiency of the wavelet variance; below 1, such as 0.6, it is robust."),
    ] = 1.0,
    rest: Rest = None,
    reading: Reading,
    confidence_level: Confidence = 0.95,
    kalibr: Annotated[Path | None, typer.Option(metavar="FILE", help="Write Kalibr's imu.yaml, of one device.")] = None,
    kalibr_slow: Annotated[
        float, typer.Option(metavar="S", help="AR1s with a correlation time from this on are Kalibr's random walk.")
    ] = 1.0,
    header: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a Kalman filter's matrices as a C header, of one sensor.")
    ] = None,
    model_out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the fitted model, .json, which simulate reads.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw the fit of the first sensor, .png, .svg or .pdf.")
    ] = None,
    writing: Writing,
) -> None:
    """Fit a noise model to every sensor of a log, recorded at rest."""
    resting, kalibr_remarks = stretch(rest), list[str]()
    if refine and robust < 1:
        raise ValueError("`--refine`: the spectral likelihood is not robust; leave out --refine or --robust")
    others = {"kalibr": kalibr, "header": header, "model_out": model_out, "figure": figure}
    with writing.files([*logs, reading.mounting], **others) as files:
        recording = reading.read(logs)
        with progress("fitting"), naming(logs):
            part = at_rest(recording, resting)
            fitted = partial(
                fit_gmwm,
                model=model,
                weighting=weighting.value,
                confidence_level=confidence_level,
                n_levels=levels,
                refine=refine,
                efficiency=robust,
            )
            result = fitted(part)
            if kalibr:
                text, kalibr_remarks = _kalibr(result, reading, logs, resting, fitted, kalibr_slow)
                files.write("kalibr", lambda: text)
        files.write("header", lambda: _c_header(result, recording))
        if model_out:
            known = _known_model(result, "model-out").to_dict()
            files.write_json(lambda: {**known, "rate": recording.rate, "unit": recording.unit}, "model-out")
        files.write_figure(lambda: one_panel(partial(result.plot, index=_first_fitted(result))))
        files.write_report(lambda: model_report(result, part, title=f"Noise of {titled(logs)}"))
        files.write_json(result.to_dict)
    say("\n".join([result.summary(), *kalibr_remarks, *files.note]))
    say_notes(recording)


def _kalibr(
    result: GMWMResult,
    reading: Reading,
    logs: list[Path],
    resting: tuple[float, float] | None,
    fitted: Callable[[Recording], GMWMResult],
    slow: float,
) -> tuple[str, list[str]]:
    """Kalibr's file of the one device, with its accelerometers where the log has some, and remarks on them."""
    if reading.quantity is not Quantity.rate:
        raise ValueError(
            "`--kalibr`: expected the gyros of a log, whose accelerometers are added, got --quantity acceleration; "
            "leave that out"
        )
    if len(result.sensors) > 1:
        raise ValueError(
            f"`--kalibr`: expected one device, got {', '.join(result.sensors)}; choose one with --sensors, and --axis "
            "where one axis is to stand for all"
        )
    _check_unit(result, "kalibr")
    try:
        # A unit, a factor and a key that were given are those of the gyros.
        options = replace(reading, quantity=Quantity.acceleration, unit=None, scale=None, key=None, columns=None)
        accelerations = at_rest(options.read(logs), resting)
    except RecordingError:
        return to_kalibr(result, slow=slow), ["No accelerations in the log: Kalibr's file wants them filled in."]
    if accelerations.unit not in ACCELERATION_UNITS:
        remark = f"Accelerations are in {accelerations.unit}: Kalibr's file wants their noise filled in."
        return to_kalibr(result, slow=slow), [remark]
    return to_kalibr(result, slow=slow, accelerometer=fitted(accelerations)), []


def _first_fitted(result: GMWMResult) -> tuple[int, ...]:
    """Index of the first sensor that could be fitted."""
    return tuple(result.params.isfinite().all(-1).nonzero()[0].tolist())


def _known_model(result: GMWMResult, option: str) -> Model:
    """The fitted model; raises `ValueError` if a sensor has none."""
    missing = ~result.params.isfinite().all(-1).reshape(-1, len(result.sensors)).all(0)
    if bool(missing.any()):
        names = [name for name, gone in zip(result.sensors, missing.tolist(), strict=True) if gone]
        raise ValueError(
            f"`--{option}`: expected sensors that could all be fitted, got none for {', '.join(names)}; leave them "
            "out with --sensors"
        )
    return result.model


def _c_header(result: GMWMResult, recording: Recording) -> str:
    """C header with a Kalman filter's matrices, of the one sensor."""
    params = result.params.flatten(0, -2)
    if len(params) != 1:
        raise ValueError(
            f"`--header`: expected one sensor and axis, got {len(params)}; choose with --sensors and --axis"
        )
    _check_unit(result, "header")
    return to_c_header(_known_model(result, "header").with_params(params[0]), recording.rate, recording.unit)


def _check_unit(result: GMWMResult, option: str) -> None:
    """Raise `ValueError` where a file for other tools would be in no known unit."""
    known = RATE_UNITS if option == "kalibr" else DATASHEET_UNITS
    if result.unit not in known:
        raise ValueError(
            f"`--{option}`: expected a log in one of {', '.join(known)}, got unit {result.unit or 'unknown'!r}; where "
            "the log does not say, give its unit with --unit, and with --scale the factor to it from other numbers"
        )
