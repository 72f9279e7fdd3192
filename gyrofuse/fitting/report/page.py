"""Report of fitted noise models as one self-contained HTML page."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gyrofuse._base.page import image, render
from gyrofuse._base.results import sensor_label
from gyrofuse._base.units import DATASHEET_UNITS
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.plots import plot_residuals
from gyrofuse.fitting.report.words import model_method, model_verdict, residuals
from gyrofuse.io.recording import Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Largest number of sensors on a page, which stays readable; the JSON file holds all.
MOST_SENSORS = 24


def model_report(result: GMWMResult, recording: Recording | None = None, *, title: str) -> str:
    """Write the report of noise models fitted to the sensors of a recording.

    Args:
        result: Fit of the sensors of one array, or of one per axis.
        recording: Recording that was fitted, for its notes.
        title: Heading of the page.

    Returns:
        An HTML page that needs no other file, no network and no script.
    """
    indices = list(itertools.product(*map(range, result.params.shape[:-1])))
    parts = [
        model_part(result, index, f"Sensor {sensor_label(result.sensors, index, result.axes)}")
        for index in indices[:MOST_SENSORS]
    ]
    return render(
        Path(__file__).parent / "models.html.j2",
        title=title,
        result=result,
        recording=recording,
        model=result.name,
        parts=parts,
        left_out=len(indices) - len(parts),
        method=model_method(result),
    )


def model_part(result: GMWMResult, index: tuple[int, ...], name: str) -> dict[str, Any]:
    """What a page shows of the model of one sensor.

    Args:
        result: Result of a fit.
        index: Index of the sensor among the leading dimensions.
        name: Name of the sensor on the page.
    """
    return {
        "name": name,
        "verdict": model_verdict(result, index),
        "figure": image(7, 6.2, _draw, result, index) if _fitted(result, index) else None,
        "parameters": _parameter_rows(result, index),
        "datasheet": _datasheet_rows(result, index),
        "unit": result.unit,
        "percent": f"{100 * result.confidence_level:g} %",
    }


def _fitted(result: GMWMResult, index: tuple[int, ...]) -> bool:
    return bool(result.params[index].isfinite().all())


def _draw(figure: Figure, result: GMWMResult, index: tuple[int, ...]) -> None:
    figure.set_layout_engine("none")  # nothing to fit in, and half of the time saved
    margins = {"left": 0.11, "right": 0.98, "bottom": 0.08, "top": 0.98, "hspace": 0.08}
    above, below = figure.subplots(2, 1, height_ratios=[3, 1], sharex=True, gridspec_kw=margins)
    result.plot(above, index=index)
    above.set_xlabel("")
    above.set_title("", loc="left")  # the page has it
    plot_residuals(residuals(result, index), rate=result.rate, ax=below)


def _parameter_rows(result: GMWMResult, index: tuple[int, ...]) -> list[dict[str, Any]]:
    columns = (result.params, *result.confidence_interval, result.determined)
    rows = zip(result.param_names, *(column[index].tolist() for column in columns), strict=True)
    return [
        {
            "name": name,
            "value": value,
            "low": low,
            "high": high,
            "note": "at its limit" if value == 0 else "" if known or math.isnan(value) else "weakly determined",
        }
        for name, value, low, high, known in rows
    ]


def _datasheet_rows(result: GMWMResult, index: tuple[int, ...]) -> list[dict[str, Any]]:
    if not (result.rate and result.unit in DATASHEET_UNITS and _fitted(result, index)):
        return []
    return [entry._asdict() for entry in result.datasheet(index).entries]
