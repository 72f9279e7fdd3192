"""Reports as one self-contained HTML page: the verdict first, then figures, tables and how they came about."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gyrofuse._base.page import image, new_figure, number, render, save_figure
from gyrofuse._base.results import numbered
from gyrofuse.fusion import plots as plotting
from gyrofuse.fusion.multiscale_result import MultiScaleResult
from gyrofuse.fusion.report.words import ALIKE, Fused, verdict
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.weights.methods import METHODS, MULTISCALE
from gyrofuse.fusion.weights.rdvg import rdvg
from gyrofuse.io.recording import Recording
from gyrofuse.wavelets.covariance import wavelet_variance

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

__all__ = [
    "fusion_figure",
    "fusion_report",
    "new_figure",
    "number",
    "recording_report",
    "save_figure",
    "sensor_rows",
    "verdict",
]


def fusion_report(
    result: Fused,
    recording: Recording | None = None,
    virtual: Tensor | None = None,
    *,
    title: str,
    remarks: Sequence[str] = (),
) -> str:
    """Write the report of a fused array.

    Args:
        result: Result of one array, or of one array for each axis.
        recording: Recording that was fused, for its notes and the plain mean in the figure of the signals.
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
    cautions = _cautions(result, recording)
    for i, (name, item) in enumerate(_items(result)):
        own = {label: signal if signal.ndim == 1 else signal[i] for label, signal in signals.items()}
        drawn = {"unit": item.unit, "in_seconds": item.rate is not None}
        parts.append(
            {
                "name": name,
                "verdict": cautions[i] + verdict(item),
                "fusion": image(7, 8, _draw_fusion, item),
                "signals": image(7, 4.4, plotting.plot_signals, time, own, **drawn) if own else None,
                "sensors": _sensor_rows(item) if isinstance(item, SVOResult) else None,
                "with_intervals": isinstance(item, SVOResult) and bool(item.confidence_interval[0].isfinite().any()),
                "bands": _band_rows(item) if isinstance(item, MultiScaleResult) else None,
                "levels": _level_rows(item),
            }
        )
    return render(
        Path(__file__).parent / "fusion.html.j2",
        title=title,
        result=result,
        recording=recording,
        parts=parts,
        remarks=remarks,
        method=METHODS.get(result.method, MULTISCALE),
        selection=result.selection if isinstance(result, SVOResult) else None,
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
                "allan": image(7, 4.6, _draw_sensors, signal, recording),
                "signals": image(7, 4.4, plotting.plot_signals, recording.time, mean, unit=recording.unit),
            }
        )
    return render(
        Path(__file__).parent / "recording.html.j2",
        title=title,
        recording=recording,
        parts=parts,
        sensors=sensor_rows(recording),
    )


def fusion_figure(result: Fused) -> Figure:
    """Draw gain, Allan deviations and weights of a fused array in one figure, axes side by side.

    Args:
        result: Result of one array, or of one array for each axis.

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


def _items(result: Fused) -> list[tuple[str, Fused]]:
    """The results of each axis with its name."""
    batch = result.virtual_wavelet_variance.shape[:-1]
    if len(batch) > 1:
        raise ValueError(
            f"`result`: expected one array, or one per axis, got batch shape {tuple(batch)}; index the result"
        )
    if not batch:
        return [("", result)]
    return [(name, result[i]) for i, name in enumerate(result.axes or numbered(batch[0]))]


def _cautions(result: Fused, recording: Recording | None) -> list[list[str]]:
    """For each item, what its weights lack: those of RDVG minimise nothing where `Q` is not a covariance.

    A result does not keep `Q`. It is estimated again, and believed where the weights are those of the result: they are
    not where these come from another stretch of the recording.
    """
    weights = [item.weights for _, item in _items(result)]
    if result.method != "rdvg" or recording is None:
        return [[] for _ in weights]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the fit has warned
        again = rdvg(recording.signal)
    found, sound = again.weights.reshape(-1, again.weights.shape[-1]), again.positive_definite.reshape(-1).tolist()
    if found.shape != (len(weights), len(result.sensors)):
        return [[] for _ in weights]
    pairs = zip(found, weights, strict=True)
    same = [torch.allclose(ours.to(own), own, rtol=1e-3, atol=1e-6, equal_nan=True) for ours, own in pairs]
    told = (
        "Beware: the estimated covariance of the random walks, Q, is not positive definite: the weights follow the "
        "formula of RDVG but minimise nothing."
    )
    return [[told] if known and not good else [] for known, good in zip(same, sound, strict=True)]


def _sensor_rows(result: SVOResult) -> list[dict[str, Any]]:
    columns = (result.weights, *result.confidence_interval)
    return [
        {"name": name, "weight": weight, "low": low, "high": high, "unsure": low <= 0 <= high}
        for name, weight, low, high in zip(result.sensors, *(column.tolist() for column in columns), strict=True)
    ]


def _band_rows(result: MultiScaleResult) -> list[dict[str, Any]]:
    """Averaging time, None for the last band of all that is slower, and weights of every band."""
    times = [*result.tau[: result.n_bands - 1].tolist(), None]
    return [{"tau": tau, "weights": weights} for tau, weights in zip(times, result.weights.tolist(), strict=True)]


def _level_rows(result: Fused) -> list[dict[str, Any]]:
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
        "degrees": result.dof,
    }
    if isinstance(result, MultiScaleResult):
        columns |= {
            "best_variance": best.values,
            "equal_variance": equal,
            "one_variance": result.single.virtual_wavelet_variance,
            "least_variance": result.optimal_wavelet_variance,
            "virtual_variance": virtual,
            "over_equal": virtual / equal,
            "over_best": virtual / best.values,
        }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [
        dict(
            zip(columns, row, strict=True),
            ratio=ratio,
            best_name=result.sensors[sensor],
            standing="better" if ratio < 1 - ALIKE else "worse" if ratio > 1 + ALIKE else "",
        )
        for row, sensor, ratio in zip(rows, best.indices.tolist(), ratios, strict=True)
    ]


def _draw_fusion(figure: Figure | SubFigure, result: Fused) -> None:
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
        interval=result.confidence_interval if isinstance(result, SVOResult) else None,
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
