"""Reports as one self-contained HTML page: the verdict first, then figures, tables and how they came about."""

from __future__ import annotations

import base64
import io
import math
import warnings
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import torch
from torch import Tensor

from gyrofuse import plotting
from gyrofuse._result import numbered
from gyrofuse.covariance import wavelet_variance
from gyrofuse.multiscale_result import MultiScaleResult
from gyrofuse.recording import Recording
from gyrofuse.svo_result import SVOResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_ALIKE = 0.005  # relative difference between Allan deviations that is not worth a word
_MOST_NAMED = 8  # sensors listed in one sentence
_METHODS = {
    "svo": "Scale-wise variance optimisation (SVO): the weights minimise the wavelet variance of the virtual gyro, "
    "summed over scales with the scale weights of the table (Zhang, Cucci, Molinari, Guerrier, IEEE Transactions on "
    "Signal Processing 70, 2022, equations 6 and 7). They sum to 1 and may be negative.",
    "inverse_variance": "Inverse variance: every sensor is weighted by the reciprocal of its wavelet variance, summed "
    "over scales with the scale weights of the table; correlation between sensors is ignored.",
    "model_assisted": "Model-assisted SVO: the weights minimise the wavelet variance of the virtual gyro, summed over "
    "scales with the scale weights of the table, where the last scales, of few observations, are those of a smooth "
    "noise model fitted to the others.",
    "rdvg": "Reduced-drift virtual gyro (Vaccaro and Zaki, Sensors 17, 2017): the weights minimise the random walk in "
    "a model of white noise and random walk.",
    "equal": "Equal weights: the virtual gyro is the plain mean of the sensors.",
}


def fusion_report(
    result: SVOResult,
    recording: Recording | None = None,
    virtual: Tensor | None = None,
    *,
    title: str,
    remarks: Sequence[str] = (),
) -> str:
    """Write the report of a fused array.

    Args:
        result: Of one array, or of one per axis.
        recording: What was fused, for its notes and the plain mean in the figure of the signals.
        virtual: Virtual signal `(time,)`, or `(axis, time)` for a result with axes, to be drawn.
        title: Heading of the page.
        remarks: Sentences shown below the verdict.

    Returns:
        An HTML page that needs no other file, no network and no script.

    Raises:
        ValueError: `result` has more than one batch dimension.
    """
    time, signals = None, {}
    if virtual is not None:
        signals["virtual gyro"] = virtual
        time = torch.arange(virtual.shape[-1], dtype=torch.float64) / (result.rate or 1.0)
        if recording is not None:
            signals["plain mean"], time = recording.signal.mean(-2), recording.time
    parts = []
    for i, (name, item) in enumerate(_items(result)):
        own = {label: signal if signal.ndim == 1 else signal[i] for label, signal in signals.items()}
        drawn = {"unit": item.unit, "in_seconds": item.rate is not None}
        parts.append(
            {
                "name": name,
                "verdict": verdict(item),
                "fusion": _image(7, 8, _draw_fusion, item),
                "signals": _image(7, 4.4, plotting.plot_signals, time, own, **drawn) if own else None,
                "sensors": _sensor_rows(item),
                "levels": _level_rows(item),
            }
        )
    return _render(
        "fusion.html.j2",
        title=title,
        result=result,
        recording=recording,
        parts=parts,
        remarks=remarks,
        method=_METHODS[result.method],
        percent=f"{100 * result.confidence_level:g} %",
        second="s" if result.rate else "samples",
    )


def recording_report(recording: Recording, *, title: str) -> str:
    """Write the report of what a log holds: its sensors, what was found in it, and their Allan deviations.

    Args:
        recording: Any recording.
        title: Heading of the page.

    Returns:
        An HTML page that needs no other file, no network and no script.
    """
    parts = []
    for name, signal in _by_axis(recording):
        mean = {"mean of the sensors": signal.nanmean(-2)}
        parts.append(
            {
                "name": name,
                "allan": _image(7, 4.6, _draw_sensors, signal, recording),
                "signals": _image(7, 4.4, plotting.plot_signals, recording.time, mean, unit=recording.unit),
            }
        )
    return _render("recording.html.j2", title=title, recording=recording, parts=parts, sensors=sensor_rows(recording))


def multiscale_figure(result: MultiScaleResult) -> Figure:
    """Draw the Allan deviations of a multi-scale virtual gyro, axes side by side.

    Args:
        result: Of one array, or of one per axis.

    Returns:
        A figure unknown to pyplot; save it with `save_figure`.
    """
    items = [("", result)] if result.weights.ndim == 2 else [(n, result[i]) for i, n in enumerate(result.single.axes)]
    figure = new_figure(7 if len(items) == 1 else 5 * len(items), 4.6)
    for ax, (name, item) in zip(figure.subplots(1, len(items), squeeze=False)[0], items, strict=True):
        item.plot(ax)
        ax.set_title(name, parse_math=False)
    return figure


def fusion_figure(result: SVOResult) -> Figure:
    """Draw gain, Allan deviations and weights of a fused array in one figure, axes side by side.

    Args:
        result: Of one array, or of one per axis.

    Returns:
        A figure unknown to pyplot; save it with `save_figure`.

    Raises:
        ValueError: `result` has more than one batch dimension.
    """
    items = _items(result)
    figure = new_figure(7 if len(items) == 1 else 5 * len(items), 8)
    for (name, item), part in zip(items, figure.subfigures(1, len(items), squeeze=False)[0], strict=True):
        if name:
            part.suptitle(name, fontsize=11, parse_math=False)
        _draw_fusion(part, item)
    return figure


def save_figure(figure: Figure, file: Path | IO[bytes], file_format: str, **options: Any) -> None:
    """Save a figure.

    Args:
        figure: The figure.
        file: Where to write.
        file_format: `"png"`, `"svg"` or `"pdf"`.
        **options: As for `Figure.savefig`.
    """
    with warnings.catch_warnings():
        # A name in a script that the font lacks is drawn as boxes, which shows by itself.
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        figure.savefig(file, format=file_format, **{"dpi": 200, **options})


def verdict(result: SVOResult) -> list[str]:
    """Say in sentences which sensors carry the virtual gyro, where it wins and where it loses.

    Args:
        result: Of one array.
    """
    sentences = [f"Beware: {result.motion}."] if result.motion else []
    sentences += _weights_in_words(result)
    if result.method != "equal":
        sentences.append(_compared(result, result.equal_wavelet_variance, "the plain mean"))
    best = result.wavelet_variance.amin(-1)
    sentences.append(_compared(result, best, "the best single sensor"))
    few = (result.degrees_of_freedom < len(result.sensors)) & (result.scale_weights > 0)
    if result.method == "svo" and bool(few.any()):
        level = int(few.nonzero()[0])
        sentences.append(
            f"From {_time(result, level)} on, the recording holds fewer independent observations "
            f"({number(result.degrees_of_freedom[level].item(), 2)} or less) than there are sensors: what it gains "
            "there is partly fitted to this very recording, and another one has to confirm it."
        )
    return sentences


def number(value: float | None, digits: int = 4) -> str:
    """Write a number with so many significant digits, `-` when it is missing."""
    if value is None or not math.isfinite(value):
        return "-"
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:.{digits}g}" if not 1e-3 <= abs(rounded) < 1e7 else f"{rounded:.10g}"


def sensor_rows(recording: Recording) -> list[dict[str, Any]]:
    """Axis, name, missing fraction, mean and standard deviation of every sensor on every axis.

    Args:
        recording: Any recording.
    """
    known = recording.to_dict()
    columns = [known[name] if recording.axes else [known[name]] for name in ("missing", "mean", "standard_deviation")]
    return [
        {"axis": axis, "name": name, "missing": missing, "mean": mean, "deviation": deviation}
        for axis, *per_axis in zip(recording.axes or ("",), *columns, strict=True)
        for name, missing, mean, deviation in zip(recording.sensors, *per_axis, strict=True)
    ]


def _by_axis(recording: Recording) -> list[tuple[str, Tensor]]:
    """The signal `(sensor, time)` of each axis with its name, which is empty where axes have none."""
    return list(zip(recording.axes, recording.signal, strict=True)) if recording.axes else [("", recording.signal)]


def _weights_in_words(result: SVOResult) -> list[str]:
    if result.method == "equal":
        return [f"Every sensor has the weight 1/{len(result.sensors)}: this is the plain mean."]
    low, high = result.confidence_interval
    order = result.weights.abs().argsort(descending=True).tolist()
    if bool(low.isnan().any()):
        return [f"The largest weights are those of {_listed(result, order)}; no intervals were asked for."]
    certain = ((low > 0) | (high < 0)).tolist()
    carriers, others = ([i for i in order if certain[i] is wanted] for wanted in (True, False))
    percent = f"{100 * result.confidence_level:g} %"
    if not carriers:
        return [f"No sensor stands out: the {percent} interval of every weight holds 0."]
    sentences = [
        f"Sensors that carry the virtual gyro, with weights whose {percent} intervals exclude 0: "
        f"{_listed(result, carriers)}."
    ]
    if others:
        sentences.append(f"Sensors whose weights cannot be told from 0: {_listed(result, others)}.")
    if any(result.weights[i] < 0 for i in carriers):
        sentences.append("A negative weight subtracts an error that the sensor shares with the others.")
    return sentences


def _listed(result: SVOResult, which: Sequence[int]) -> str:
    """Sensors with their weights, as far as a sentence can bear."""
    shown = [f"{result.sensors[i]} (weight {result.weights[i].item():.3f})" for i in which[:_MOST_NAMED]]
    if len(which) > _MOST_NAMED:
        shown.append(f"{len(which) - _MOST_NAMED} more")
    return _joined(shown)


def _compared(result: SVOResult, other: Tensor, name: str) -> str:
    """Where the Allan deviation of the virtual gyro is lower than another one, and where it is higher."""
    ratio = (result.virtual_wavelet_variance / other).sqrt()
    lower, higher = _where(result, 1 - ratio), _where(result, ratio - 1)
    start = "The Allan deviation of the virtual gyro is"
    if lower:
        rest = f"It is higher at {higher}." if higher else "It is nowhere higher."
        return f"{start} lower than that of {name} at averaging times of {lower}. {rest}"
    if higher:
        return f"{start} nowhere lower than that of {name}; it is higher at averaging times of {higher}."
    return f"{start} that of {name} within {_percent(_ALIKE)} at every averaging time."


def _where(result: SVOResult, difference: Tensor) -> str:
    """Averaging times at which a difference counts, neighbours as a range, and how large it gets."""
    counts = (difference > _ALIKE).tolist()
    runs = [list(run) for holds, run in groupby(range(len(counts)), counts.__getitem__) if holds]
    if not runs:
        return ""
    starts = [f"{number(result.tau[run[0]].item())} to " if len(run) > 1 else "" for run in runs]
    times = _joined([start + _time(result, run[-1]) for start, run in zip(starts, runs, strict=True)])
    # The size that the recording resolves, rather than the one that a few observations give by chance.
    resolved = (difference > _ALIKE) & (result.degrees_of_freedom >= len(result.sensors))
    told = resolved if bool(resolved.any()) else difference > _ALIKE
    level = int(torch.where(told, difference, -math.inf).argmax())
    if sum(counts) == 1:
        return f"{times}, by {_percent(difference[level].item())}"
    return f"{times}, by up to {_percent(difference[level].item())} (at {_time(result, level)})"


def _percent(fraction: float) -> str:
    percent = round(100 * fraction, 1)
    return f"{percent:.{0 if percent >= 10 else 1}f}\N{NO-BREAK SPACE}%"


def _time(result: SVOResult, level: int) -> str:
    return f"{number(result.tau[level].item())} {'s' if result.rate else 'samples'}"


def _joined(parts: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(parts[:-1]), *parts[-1:]]))


def _items(result: SVOResult) -> list[tuple[str, SVOResult]]:
    """The results of each axis with its name."""
    if result.weights.ndim > 2:
        raise ValueError(
            f"`result`: expected one array, or one per axis, got batch shape {tuple(result.weights.shape[:-1])}; "
            "index the result"
        )
    if result.weights.ndim == 1:
        return [("", result)]
    return [(name, result[i]) for i, name in enumerate(result.axes or numbered(len(result.weights)))]


def _sensor_rows(result: SVOResult) -> list[dict[str, Any]]:
    columns = (result.weights, *result.confidence_interval)
    return [
        {"name": name, "weight": weight, "low": low, "high": high, "unsure": low <= 0 <= high}
        for name, weight, low, high in zip(result.sensors, *(column.tolist() for column in columns), strict=True)
    ]


def _level_rows(result: SVOResult) -> list[dict[str, Any]]:
    best = result.wavelet_variance.min(-1)
    virtual, equal = result.virtual_wavelet_variance, result.equal_wavelet_variance
    low, high = result.interval_of(virtual)
    ratios = (virtual / equal).sqrt().tolist()
    columns = {
        "tau": result.tau,
        "scale_weight": result.scale_weights,
        "best": (2 * best.values).sqrt(),
        "equal": (2 * equal).sqrt(),
        "virtual": (2 * virtual).sqrt(),
        "low": (2 * low).sqrt(),
        "high": (2 * high).sqrt(),
        "degrees": result.degrees_of_freedom,
    }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [
        dict(
            zip(columns, row, strict=True),
            ratio=ratio,
            best_name=result.sensors[sensor],
            standing="better" if ratio < 1 - _ALIKE else "worse" if ratio > 1 + _ALIKE else "",
        )
        for row, sensor, ratio in zip(rows, best.indices.tolist(), ratios, strict=True)
    ]


def _draw_fusion(figure: Figure | SubFigure, result: SVOResult) -> None:
    virtual = result.virtual_wavelet_variance
    plotting.plot_fusion(
        figure,
        result.tau,
        result.wavelet_variance,
        result.weights,
        names=result.sensors,
        virtual=virtual,
        equal=result.equal_wavelet_variance,
        band=result.interval_of(virtual),
        interval=result.confidence_interval,
        unit=result.unit,
        in_seconds=result.rate is not None,
    )


def _draw_sensors(figure: Figure, signal: Tensor, recording: Recording) -> None:
    with warnings.catch_warnings():
        # A level without a complete window is a gap in the sensor's line.
        warnings.filterwarnings("ignore", "no complete window", UserWarning)
        variance = wavelet_variance(signal)
    tau = torch.exp2(torch.arange(len(variance))) / recording.rate
    plotting.plot_allan_deviation(tau, variance, names=recording.sensors, unit=recording.unit, ax=figure.subplots())


def _image(width: float, height: float, draw: Callable[..., None], *arguments: Any, **options: Any) -> str:
    """A figure as the source of an `img`: a picture that cannot run anything, whatever its labels say."""
    figure = new_figure(width, height)
    draw(figure, *arguments, **options)
    file = io.BytesIO()
    save_figure(figure, file, "svg", transparent=True)
    return "data:image/svg+xml;base64," + base64.b64encode(file.getvalue()).decode()


def new_figure(width: float, height: float) -> Figure:
    """A figure of so many inches that pyplot does not know."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def _render(template: str, **context: Any) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    from gyrofuse import __version__

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["with_unit"] = plotting.with_unit
    environment.filters["scientific"] = lambda value: f"{value:.3e}" if math.isfinite(value) else "-"
    environment.filters["fixed"] = lambda value: f"{value:.4f}" if math.isfinite(value) else "-"
    environment.filters["signed"] = lambda value: f"{value:+.4f}" if math.isfinite(value) else "-"
    return environment.get_template(template).render(version=__version__, **context)
