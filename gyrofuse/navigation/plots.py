"""Figures of navigation studies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from gyrofuse._base.axes import BLUE, FRAME, SHADE, as_array, finish, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_ratio_over_time(
    time: Tensor,
    ratio: Tensor,
    limits: tuple[Tensor, Tensor],
    *,
    outage: tuple[float, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a ratio of position errors with its band, the outage shaded.

    Args:
        time: Time, s, `(time,)`.
        ratio: Ratio of mean position errors, `(time,)`.
        limits: Lower and upper confidence limits of the ratio, `(time,)` each.
        outage: Start and end of the interval without satellites, s; None without one.
        ax: Axes to draw on; new ones by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    handles: list[Any] = []
    labels: list[str] = []
    if outage is not None:
        handles.append(ax.axvspan(*outage, color="#ececec", zorder=0))
        labels.append("no satellites")
    low, high = limits
    handles.append(ax.fill_between(as_array(time), as_array(low), as_array(high), zorder=2, **SHADE))
    handles.append(ax.plot(as_array(time), as_array(ratio), color=BLUE, linewidth=1.5, zorder=3)[0])
    labels += ["interval", "ratio of mean position errors"]
    ax.axhline(1, color=FRAME, linewidth=0.8, zorder=1)
    ax.set_xlabel("time (s)")
    ax.set_ylabel("ratio")
    finish(ax, handles, labels, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderaxespad=0.2)
    return ax
