"""Command `fuse`: one virtual gyro from an array."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gyrofuse.cli.console import progress, say
from gyrofuse.cli.options import (
    METHOD_NAMES,
    Confidence,
    Logs,
    Reading,
    Writing,
    chosen,
    scale_weights_of,
    stretch,
    takes_options,
)
from gyrofuse.cli.reading import at_rest, naming, say_notes, titled
from gyrofuse.cli.simulate import save_recording
from gyrofuse.fusion.multiscale import fit_multiscale
from gyrofuse.fusion.multiscale_result import MultiScaleResult
from gyrofuse.fusion.report.page import fusion_figure, fusion_report
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.svo import fit_svo
from gyrofuse.fusion.weights.methods import COVARIANCES
from gyrofuse.io.recording import Recording

_COVARIANCE_NAMES = tuple(name.replace("_", "-") for name in COVARIANCES)
# Methods whose weights have no sampling distribution for an interval, or, equal ones, are not estimated at all.
_WITHOUT_INTERVALS = ("multiscale", "nonnegative", "equal", "rdvg")


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
    method: Annotated[str, typer.Option(metavar="|".join(METHOD_NAMES), help="How the weights are chosen.")] = "svo",
    covariance: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(_COVARIANCE_NAMES), show_default="model", help="What the intervals of the weights rest on."
        ),
    ] = None,
    levels: Annotated[
        int | None, typer.Option(metavar="J", help="Number of levels; as many as fit by default.")
    ] = None,
    rest: Annotated[
        str | None,
        typer.Option(metavar="START:STOP", help="Choose the weights on this stretch alone (seconds); fuse all of it."),
    ] = None,
    reading: Reading,
    confidence_level: Confidence = 0.95,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the virtual gyro, .npz (with the weights) or .csv.")
    ] = None,
    figure: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw it, .png, .svg or .pdf.")] = None,
    writing: Writing,
) -> None:
    """Fuse an array, recorded at rest, into one virtual gyro."""
    weights, resting = scale_weights_of(scale_weights), stretch(rest)
    method_name = chosen("--method", method, METHOD_NAMES)
    covariance_name = chosen("--covariance", covariance or "model", _COVARIANCE_NAMES)
    if method in _WITHOUT_INTERVALS and covariance not in (None, "none"):
        raise ValueError(
            f"`--covariance`: {covariance} has no use, for --method {method} gives no intervals of its "
            "weights; leave the option out, or choose another method"
        )
    with writing.files([*logs, reading.mounting], out=out, figure=figure) as files:
        recording = reading.read(logs)
        if recording.axes and recording.n_sensors == 1:
            raise ValueError(
                f"{titled(logs)}: expected several devices to fuse, found one with the axes {', '.join(recording.axes)}"
                "; give the logs of all devices of the array"
            )
        with progress("fusing"), naming(logs):
            part = at_rest(recording, resting)
            result: SVOResult | MultiScaleResult
            if method == "multiscale":
                result = fit_multiscale(part, weights, confidence_level=confidence_level, n_levels=levels)
            else:
                result = fit_svo(
                    part,
                    weights,
                    method=method_name,
                    covariance=covariance_name,
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
            save_recording(fused, files.draft("out"), weights=result.weights.numpy())
        files.write_figure(lambda: fusion_figure(result))
        title = f"Virtual gyro of {titled(logs)}"
        files.write_report(lambda: fusion_report(result, recording, virtual, title=title, remarks=remarks))
        files.write_json(result.to_dict)
    say("\n".join([result.summary(), *remarks, *files.note]))
    say_notes(recording)
