"""Command `rank`: noise models compared for every sensor."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from gyrofuse._base.results import sensor_label
from gyrofuse.cli.console import progress, say
from gyrofuse.cli.options import (
    Confidence,
    Logs,
    ModelLevels,
    Reading,
    Rest,
    Writing,
    one_panel,
    stretch,
    takes_options,
)
from gyrofuse.cli.reading import at_rest, naming, say_notes, titled, without_gaps
from gyrofuse.fitting.ranking.rank import rank_models
from gyrofuse.fitting.report.ranking import rank_report
from gyrofuse.fitting.spectral.tones import FEWEST_SAMPLES

_MOST_FITS = 12  # fits printed in full, each on about ten lines; of more sensors the table alone is printed
_WITH_GAPS = ", or fit a model with `gyrofuse fit`, which gets along with gaps"


@takes_options
def rank(
    *,
    logs: Logs,
    candidates: Annotated[
        str | None,
        typer.Option(
            metavar="FORMULA,...",
            help='Models to compare, such as "WN+AR1, WN+AR1+RW"; all that make sense by default.',
        ),
    ] = None,
    levels: ModelLevels = None,
    rest: Rest = None,
    reading: Reading,
    confidence_level: Confidence = 0.95,
    figure: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the ranking of the first sensor that has one, .png, .svg or .pdf."),
    ] = None,
    writing: Writing,
) -> None:
    """Find which noise processes made the signal of every sensor of a log, recorded at rest.

    Spectra need records without gaps: where samples are missing, the longest stretch without them is ranked, and named.
    """
    resting = stretch(rest)
    formulas = None if candidates is None else [formula.strip() for formula in candidates.split(",")]
    with writing.files([*logs, reading.mounting], figure=figure) as files:
        recording = reading.read(logs)
        with progress("ranking"), naming(logs):
            asked = at_rest(recording, resting)
            part, remarks = without_gaps(asked, "Ranked", FEWEST_SAMPLES, _WITH_GAPS)
            result = rank_models(part, formulas, confidence_level=confidence_level, n_levels=levels)
        files.write_figure(
            lambda: one_panel(
                partial(result.plot, title=f"Sensor {sensor_label(result.sensors, result.first_ranked, result.axes)}")
            )
        )
        title = f"Noise models for {titled(logs)}"
        files.write_report(lambda: rank_report(result, part, title=title, remarks=remarks))
        files.write_json(result.to_dict)
    say("\n".join([result.summary(), *remarks]))
    places = itertools.product(*map(range, result.choice.shape))
    fits = [
        replace(fit, sensors=(sensor_label(result.sensors, place, result.axes),))
        for place, fit in zip(places, result.best, strict=True)
        if fit is not None
    ]
    if len(fits) <= _MOST_FITS:
        say("\n".join(f"\n{fit}" for fit in fits))
    if notes := files.note:
        say("\n".join(notes))
    say_notes(recording)
