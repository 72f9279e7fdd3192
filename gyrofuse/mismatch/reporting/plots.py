"""Figures of a recording beside a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.axes import (
    BLUE,
    FRAME,
    INK,
    LABEL_SIZE,
    MOST_LABELS,
    ORANGE,
    SHADE,
    TICK_SIZE,
    clean_name,
    finish,
    new_axes,
    with_unit,
)
from gyrofuse._base.results import readable
from gyrofuse.fusion.plots import allan_deviation, time_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh

    from gyrofuse.mismatch.selection.shares import Share

_LEAST, _MOST = 4.0, 12.0  # standard deviations at the ends of the colours
_UNKNOWN = "#d9d9d9"
_BY_CHANCE = 0.05  # that any dot of a map is
_FLOOR = 0.1  # of a power over another, below which nothing is to be seen
_MARK: dict[str, Any] = {"linestyle": "none", "marker": "v", "markersize": 7, "clip_on": False}


def plot_map(
    z: Tensor,
    *,
    names: Sequence[str],
    rate: float,
    edges: Tensor | None = None,
    lines_hz: Sequence[float] = (),
    largest: float | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw where a recording has more (orange) or less (blue) than the simulation, in standard deviations.

    Dots are places where chance alone would get on one map of twenty; where the simulation says nothing it is grey.

    Args:
        z: `(place, sensor)`: averaging times, from one sample doubling, or bands of frequency.
        names: Of the sensors.
        rate: Hz.
        edges: Of the bands, cycles per sample `(place + 1,)`; averaging times by default.
        lines_hz: Frequencies to mark above, Hz.
        largest: At the ends of the colours; the largest there is by default, from 4 to 12.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    from matplotlib.colors import LinearSegmentedColormap

    ax = ax if ax is not None else new_axes()
    values = z.numpy()
    octaves = np.exp2(np.arange(len(values) + 1) - 0.5)
    places = octaves / rate if edges is None else edges.numpy() * rate
    colours = LinearSegmentedColormap.from_list("signed", [BLUE, "white", ORANGE]).with_extremes(bad=_UNKNOWN)
    reach = largest if largest is not None else ends_of_colours(z)
    rows = np.arange(len(names) + 1) - 0.5
    mesh = ax.pcolormesh(places, rows, np.ma.masked_invalid(values).T, cmap=colours, vmin=-reach, vmax=reach)
    mesh.set_edgecolor("face")
    known = np.isfinite(values)
    limit = -float(torch.special.ndtri(torch.tensor(_BY_CHANCE / 2 / max(int(known.sum()), 1), dtype=torch.float64)))
    place, sensor = np.nonzero(known & (np.abs(np.where(known, values, 0.0)) > limit))
    ax.plot(np.sqrt(places[place] * places[place + 1]), sensor, "o", color=INK, markersize=2.5)
    ax.plot(lines_hz, np.full(len(lines_hz), -0.5), color=ORANGE, **_MARK)
    if edges is None:
        time_axis(ax, True)
    else:
        ax.set_xscale("log")
        ax.set_xlabel("frequency (Hz)")
    ax.set_xlim(places[0], places[-1])
    ax.set_ylim(len(names) - 0.5, -0.5)  # the first sensor above, as in a table
    step = -(-len(names) // MOST_LABELS)
    ax.set_yticks(range(0, len(names), step), [clean_name(name) for name in names[::step]], parse_math=False)
    ax.set_ylabel("sensor")
    finish(ax)
    ax.grid(visible=False)
    _colour_scale(ax, mesh)
    return ax


def plot_shares(before: float, shares: Sequence[Share], *, ax: Axes | None = None) -> Axes:
    """Draw the share of a discrepancy that each repair carries, with the discrepancies before it and after it.

    Args:
        before: Discrepancy per degree of freedom before any repair.
        shares: Shares in the order of the repairs.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    percent = [100 * share.share for share in shares]
    percent.append(100 - sum(percent))  # what is left
    ends = [before, *(share.discrepancy for share in shares)]
    words = [f"{start:.3g} → {end:.3g}" for start, end in pairwise(ends)] + [f"{ends[-1]:.3g}"]
    colours = [BLUE if share.identified else FRAME for share in shares] + [ORANGE]
    rows = range(len(percent))
    ax.barh(rows, percent, height=0.55, color=colours, zorder=3)
    for row, value, change in zip(rows, percent, words, strict=True):
        ax.annotate(
            f"{value:.3g} %   ({change})",
            (max(value, 0.0), row),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=TICK_SIZE,
            color=INK,
        )
    ax.axvline(0, color=INK, linewidth=0.8, zorder=4)
    reach = max(percent)
    ax.set_xlim(1.05 * min(0.0, *percent), 1.4 * reach)  # with room for the words
    ax.set_xticks([tick for tick in ax.get_xticks() if ax.get_xlim()[0] <= tick <= max(reach, 100)])
    names = [readable(share.name) if share.identified else f"{readable(share.name)} (no name)" for share in shares]
    ax.set_yticks(rows, [*names, "left"], parse_math=False)
    ax.set_ylim(len(shares) + 0.6, -0.6)
    ax.set_xlabel("share of the discrepancy above noise alone (%)")
    finish(ax)
    ax.grid(visible=False, axis="y")
    return ax


def plot_recordings(names: Sequence[str], ends: Sequence[tuple[float, float]], *, ax: Axes | None = None) -> Axes:
    """Draw the discrepancy of each recording, from before its repair to after it.

    Args:
        names: Of the recordings.
        ends: Discrepancies per degree of freedom before and after.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    rows = np.arange(len(names))
    before, after = np.array(ends, dtype=float).reshape(-1, 2).T
    ax.hlines(rows, after, before, color=FRAME, linewidth=1.5, zorder=2)
    handles = ax.plot(before, rows, "o", color=ORANGE, zorder=3) + ax.plot(after, rows, "o", color=BLUE, zorder=4)
    ax.axvline(1, color=INK, linewidth=0.8, zorder=1)
    ax.set_xscale("log")
    ax.set_yticks(rows, [clean_name(name) for name in names], parse_math=False)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.set_xlabel("discrepancy (1 = noise alone)")
    finish(ax, handles, ["before the repair", "after it"], ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
    ax.grid(visible=False, axis="y")
    return ax


def ends_of_colours(*maps: Tensor) -> float:
    """Standard deviations at the ends of the colours of maps side by side."""
    sizes = torch.cat([z[z.isfinite()].abs() for z in maps])
    return min(max(float(sizes.max()), _LEAST), _MOST) if len(sizes) else _LEAST


def plot_deviations(
    observed: Tensor, reference: Tensor, spread: Tensor, *, rate: float, unit: str, ax: Axes | None = None
) -> Axes:
    """Draw Allan deviations `sqrt(2 nu)` of a recorded sensor and of the simulated one, with the reach of chance.

    Args:
        observed: Wavelet variance `(level,)`, signal^2.
        reference: The same; NaN where unknown.
        spread: Standard deviation of the logarithm of their ratio, `(level,)`.
        rate: Hz.
        unit: Of the signal.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    times = np.exp2(np.arange(len(observed))) / rate
    low, high = (allan_deviation(reference * (sign * 1.96 * spread).exp()) for sign in (-1, 1))
    handles: list[Any] = ax.plot(times, allan_deviation(observed), "o", color=INK, markersize=4, zorder=4)
    handles += ax.plot(times, allan_deviation(reference), color=BLUE, linewidth=1.8, zorder=3)
    handles += [ax.fill_between(times, low, high, zorder=1, **SHADE)]
    ax.set_yscale("log")
    ax.set_ylabel(with_unit("Allan deviation", unit), parse_math=False)
    time_axis(ax, True)
    finish(ax, handles, ["recording", "simulation", "where 95 % of recordings lie that agree"])
    return ax


def plot_spectra(
    observed: tuple[Tensor, Tensor, Tensor],
    reference: tuple[Tensor, Tensor, Tensor],
    *,
    rate: float,
    lines_hz: Sequence[float] = (),
    ax: Axes | None = None,
) -> Axes:
    """Draw spectra of a recorded sensor and of the simulated one over the simulation's: means, and what stands out.

    Args:
        observed: Frequencies in cycles per sample, mean and largest ordinate in each group: `(group,)` each.
        reference: The same.
        rate: Hz.
        lines_hz: Frequencies to mark above, Hz.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    (f, mean, largest), (other_f, other_mean, other_largest) = observed, reference
    handles: list[Any] = ax.plot(f * rate, mean, color=INK, linewidth=1.1, zorder=4)
    handles += ax.plot(f * rate, largest, "o", color=INK, markersize=2.5, zorder=5)
    handles += ax.plot(other_f * rate, other_mean, color=BLUE, linewidth=1.1, zorder=3)
    handles += ax.plot(other_f * rate, other_largest, color=BLUE, linewidth=0.9, alpha=0.6, zorder=2)
    ax.plot(lines_hz, np.ones(len(lines_hz)), color=ORANGE, transform=ax.get_xaxis_transform(), **_MARK)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_ylim(bottom=max(ax.get_ylim()[0], _FLOOR))
    ax.set_xlabel("frequency (Hz)")
    ax.set_ylabel("power over the simulation's")
    labels = ["recording, mean", "recording, largest", "simulation, mean", "simulation, largest"]
    finish(ax, handles, labels, ncols=2, loc="lower right")
    return ax


def plot_blocks(
    means: Tensor, *, duration: float, unit: str, onsets: Sequence[float] = (), ax: Axes | None = None
) -> Axes:
    """Draw averages of a sensor over equal blocks of time, with marks where something sets in.

    Args:
        means: `(block,)`, unit of the signal.
        duration: Of the recording, s.
        unit: Of the signal.
        onsets: Times to mark, s.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    times = (np.arange(len(means)) + 0.5) * duration / len(means)
    ax.plot(times, means - means.mean(), color=INK, linewidth=1.0, zorder=3)
    for onset in onsets:
        ax.axvline(onset, color=ORANGE, linewidth=1.2, linestyle=(0, (4, 3)), zorder=2)
    ax.set_xlim(0, duration)
    ax.set_xlabel("time (s)")
    ax.set_ylabel(with_unit("average", unit), parse_math=False)
    finish(ax)
    return ax


def _colour_scale(ax: Axes, mesh: QuadMesh) -> None:
    """Beside the axes rather than out of them, so that maps above each other are alike."""
    scale = ax.inset_axes((1.02, 0.0, 0.02, 1.0))
    ax.figure.colorbar(mesh, cax=scale, extend="both", extendfrac=0.04)
    scale.spines["outline"].set(color=FRAME, linewidth=0.8)
    scale.set_ylabel("standard deviations", color=INK, fontsize=LABEL_SIZE)
    scale.tick_params(color=FRAME, labelcolor=INK, labelsize=TICK_SIZE)
