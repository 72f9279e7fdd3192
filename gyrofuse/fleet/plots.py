"""Figures of a fleet of logs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gyrofuse._base.axes import BLUE, DASHED, FRAME, as_array, clean_name, finish, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.ticker import Locator

_COLOURS = (BLUE, "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#969696", "#8c510a")  # not that of the mean


def plot_distribution(
    values: Sequence[float],
    *,
    label: str,
    mark: float,
    meaning: str,
    what: str = "logs",
    limits: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a histogram of a quantity over a fleet.

    Args:
        values: Value of each log; values that are not finite are left out.
        label: Label of the horizontal axis.
        mark: Value at which a vertical line is drawn.
        meaning: Legend of that line.
        what: Label of the vertical axis, what is counted.
        limits: Range of the histogram; that of the values by default.
        ax: Axes to draw on; new ones by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    known = as_array(values)
    known = known[np.isfinite(known)]
    n_bins = min(max(round(2 * np.sqrt(known.size)), 5), 60)  # Rice-like rule, within what a 7-inch figure resolves
    ax.hist(known, bins=n_bins, range=limits, color=BLUE, alpha=0.75)
    line = ax.axvline(mark, **DASHED)
    ax.set_xlabel(label)
    ax.set_ylabel(what)
    ax.yaxis.set_major_locator(_whole())
    finish(ax, [line], [meaning], loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.2)
    return ax


def plot_weights_over_logs(weights: Sequence[Sequence[float]], *, names: Sequence[str], ax: Axes | None = None) -> Axes:
    """Draw the weights of an array from log to log.

    Args:
        weights: Weights, `(log, sensor)`.
        names: Names of the sensors.
        ax: Axes to draw on; new ones by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    table = as_array(weights)
    ax.axhline(0, color=FRAME, linewidth=0.8, zorder=1)
    place = np.arange(1, len(table) + 1)
    handles = [
        ax.plot(place, table[:, i], marker=".", linewidth=1.2, color=_COLOURS[i % len(_COLOURS)])[0]
        for i in range(table.shape[1])
    ]
    handles.append(ax.axhline(1 / table.shape[1], zorder=2, **DASHED))
    ax.set_xlabel("log, in the order of the table")
    ax.set_ylabel("weight")
    ax.xaxis.set_major_locator(_whole())
    shown = len(_COLOURS)
    labels = [*(clean_name(name) for name in names[:shown]), "plain mean"]
    kept = [*handles[:-1][:shown], handles[-1]]
    finish(ax, kept, labels, loc="lower right", bbox_to_anchor=(1, 1), ncols=min(len(kept), 5), borderaxespad=0.2)
    return ax


def _whole() -> Locator:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(integer=True)
