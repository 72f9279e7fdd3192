"""Figures of fitted noise models."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.axes import BLUE, INK, SHADE, finish, new_axes, with_unit
from gyrofuse.fusion.plots import allan_deviation, time_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gyrofuse.noise.processes import Model

# Okabe and Ito without the blue of the sum.
_COLOURS = ("#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_STYLES = ("--", "-.", ":")
_FADED = "#b8b8b8"
# Difference of criteria, half nats, at which its axis ends: candidates beyond are out of the question.
_MOST_SHOWN = 40.0


def plot_moment_fit(
    wavelet_variance: Tensor,
    limits: tuple[Tensor, Tensor],
    model: Model,
    *,
    confidence_level: float | None = None,
    rate: float | None = None,
    unit: str | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a measured Allan deviation `sqrt(2 nu)` with intervals, that of the fitted model, and its components.

    Args:
        wavelet_variance: Measured wavelet variance `(level,)`, signal^2.
        limits: Its lower and upper limits, `(level,)` each.
        model: Fitted model with scalar parameters.
        confidence_level: Probability that the limits hold the true value, for the legend.
        rate: Sampling rate in Hz; without it the averaging times are in samples.
        unit: Unit of the signal.
        title: Title of the axes.
        ax: Axes to draw on; new ones by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    n_levels = len(wavelet_variance)
    times = np.exp2(np.arange(n_levels)) / (rate or 1.0)
    low, high = limits
    handles: list[Any] = [ax.fill_between(times, allan_deviation(low), allan_deviation(high), zorder=1, **SHADE)]
    labels = ["interval" if confidence_level is None else f"{100 * confidence_level:g} % interval"]
    dots: dict[str, Any] = {"color": INK, "marker": "o", "markersize": 4, "linestyle": "none"}
    handles += ax.plot(times, allan_deviation(wavelet_variance), zorder=4, **dots)
    labels += ["measured"]
    fitted = model.wavelet_variance(n_levels).to(wavelet_variance)
    handles += ax.plot(times, allan_deviation(fitted), color=BLUE, linewidth=2.2, zorder=3)
    labels += ["fitted model"]
    shown = torch.cat([low, high, wavelet_variance, fitted])
    floor = shown[shown > 0].min().item() / 30
    seen: dict[str, int] = {}
    for k, process in enumerate(model.processes):
        seen[process.symbol] = seen.get(process.symbol, 0) + 1
        variance = process.wavelet_variance(n_levels)
        if not bool((variance > floor).any()):
            continue
        visible = torch.where(variance > 0, variance, torch.nan)
        style: dict[str, Any] = {"color": _COLOURS[k % len(_COLOURS)], "linestyle": _STYLES[k % len(_STYLES)]}
        handles += ax.plot(times, allan_deviation(visible), zorder=2, linewidth=1.1, **style)
        labels += [process.symbol + (f" {seen[process.symbol]}" if process.repeatable else "")]
    ax.set_yscale("log")
    ax.set_ylabel(with_unit("Allan deviation", unit), parse_math=False)
    time_axis(ax, rate is not None)
    if title:
        ax.set_title(title, loc="left", fontsize=10, parse_math=False)
    # Curves go on to the lower edge; above them there is space for the legend, 7 % of the height for each of its rows.
    columns, row = 4, 0.07
    bottom, top = (2 * floor) ** 0.5, (2 * max(shown.nan_to_num().max().item(), floor)) ** 0.5
    space = row * (1 + -(-len(labels) // columns))
    ax.set_ylim(bottom, top * (top / bottom) ** (space / (1 - space)))
    finish(ax, handles, labels, loc="upper center", ncols=columns)
    return ax


def plot_residuals(residuals: Tensor, *, rate: float | None = None, ax: Axes | None = None) -> Axes:
    """Draw wavelet variances measured less fitted, in standard deviations, with the range of 95 % of them.

    Args:
        residuals: Residuals, `(level,)`, in standard deviations.
        rate: Sampling rate in Hz; without it the averaging times are in samples.
        ax: Axes to draw on; new ones by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    times = np.exp2(np.arange(len(residuals))) / (rate or 1.0)
    ax.axhline(0.0, color=BLUE, linewidth=1.2)
    for limit in (-1.96, 1.96):
        ax.axhline(limit, color=BLUE, linewidth=0.8, linestyle="--")
    ax.vlines(times, 0.0, residuals.tolist(), color=INK, linewidth=1.0)
    ax.plot(times, residuals.tolist(), "o", color=INK, markersize=4)
    ax.set_ylabel("residual")
    time_axis(ax, rate is not None)
    finish(ax)
    return ax


def plot_resampled(
    names: list[str],
    bias: Tensor,
    percentile: tuple[Tensor, ...],
    studentized: tuple[Tensor, ...],
    *,
    percent: float,
    ax: Axes | None = None,
) -> Axes:
    """Draw how far the parameters of resamples are from the estimates, in standard deviations of the resamples.

    Args:
        names: Names of the parameters.
        bias: Mean of the resampled estimates less the estimate, `(parameter,)`.
        percentile: Lower and upper limits by percentiles, `(parameter,)` each.
        studentized: Lower and upper studentized limits, `(parameter,)` each.
        percent: Probability of both intervals, %.
        ax: Axes to draw on; new ones by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    places = np.arange(len(names))
    ax.axvline(0.0, color=INK, linewidth=0.8)
    handles: list[Any] = []
    for (low, high), shift, color, width in ((percentile, -0.12, _COLOURS[0], 1.6), (studentized, 0.12, BLUE, 2.6)):
        handles.append(ax.hlines(places + shift, low.tolist(), high.tolist(), color=color, linewidth=width))
    handles += ax.plot(bias.tolist(), places, "o", color=INK, markersize=4)
    ax.set_yticks(places, names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.set_xlabel("less the estimate, in standard deviations of the resamples")
    finish(ax, handles, [f"{percent:g} % percentile", f"{percent:g} % studentized", "mean of the resamples"])
    return ax


def plot_ranking(
    names: list[str],
    difference: Tensor,
    standings: list[str],
    *,
    rejected: bool = False,
    aside: list[str] | None = None,
    title: str | None = None,
    note: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the criteria of candidates over that of the chosen one.

    The axis ends where candidates are out of the question; those beyond have an arrow and their number.

    Args:
        names: Names of the candidates, from the best on.
        difference: Criteria less that of the chosen one, `(candidate,)`.
        standings: Standing of each: `chosen`, `equivalent`, `redundant` or nothing.
        rejected: Whether the J test clearly rejects the chosen one.
        aside: Candidates that were not compared.
        title: Title of the axes.
        note: Note on what is not shown, to the right of the title.
        ax: Axes to draw on; new ones by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    values, aside = difference.tolist(), aside or []
    ends = [min(max(value, -_MOST_SHOWN), _MOST_SHOWN) for value in values]
    least, most = min([0.0, *ends]), max([_MOST_SHOWN / 4, *ends])
    ax.axvline(0.0, color=INK, linewidth=0.8, zorder=1)
    for named, color in ((("chosen", ""), BLUE), (("equivalent",), _COLOURS[1]), (("redundant",), _FADED)):
        places = [k for k, own in enumerate(standings) if own in named]
        if places:
            ax.hlines(places, 0.0, [ends[k] for k in places], color=color, linewidth=5, zorder=2)
            style: dict[str, Any] = {"linestyle": "none", "color": color, "markersize": 8, "zorder": 3}
            ax.plot([], [], marker="o", label=named[-1] or "candidate", **style)
            for k in places:
                ax.plot(ends[k], k, marker="o" if ends[k] == values[k] else "<" if values[k] < 0 else ">", **style)
    chosen = "chosen, though the J test refuses it" if rejected else "chosen"
    for k, (value, standing) in enumerate(zip(values, standings, strict=True)):
        text = chosen if standing == "chosen" else f"{value:+.1f}"
        ax.annotate(text, (max(ends[k], 0.0), k), (9, 0), textcoords="offset points", va="center", fontsize=8)
    for k in range(len(aside)):
        ax.annotate("not compared", (0.0, len(values) + k), (9, 0), textcoords="offset points", va="center", fontsize=8)
    ax.set_yticks(range(len(values) + len(aside)), [*names, *aside])
    ax.set_ylim(len(values) + len(aside) - 0.5, -0.5)
    room = 0.25 * (most - least)  # for the numbers
    ax.set_xlim(least - 0.05 * (most - least), most + room)
    ax.set_xticks([tick for tick in ax.get_xticks() if ax.get_xlim()[0] <= tick <= most])
    beyond = "; arrow: beyond the axis" if ends != values else ""
    ax.set_xlabel(f"criterion over that of the chosen model (half nats{beyond})")
    if title:
        ax.set_title(title, loc="left", fontsize=10, parse_math=False)
    if note:
        ax.set_title(note, loc="right", fontsize=8, parse_math=False)
    marked = {"equivalent", "redundant"} & set(standings)
    finish(ax, *(ax.get_legend_handles_labels() if marked else ()))
    return ax


def add_recordings(wavelet_variances: list[Tensor], *, rate: float | None = None, ax: Axes) -> None:
    """Add the Allan deviations of several recordings to the figure of their joint fit.

    Args:
        wavelet_variances: Wavelet variance `(level,)` of each recording.
        rate: Sampling rate in Hz; without it the averaging times are in samples.
        ax: Axes that `plot_moment_fit` returned.
    """
    for variance in wavelet_variances:
        times = np.exp2(np.arange(len(variance))) / (rate or 1.0)
        ax.plot(times, allan_deviation(variance), color=INK, linewidth=0.7, alpha=0.6, zorder=3)
