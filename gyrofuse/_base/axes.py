"""Axes of one look: colours, sizes of letters, legends, names on ticks.

Functions draw into the axes they are given, or into new ones of `matplotlib.pyplot` that `plt.show()` displays; nothing
else of matplotlib's state is touched. The colours are those of Okabe and Ito, which colour-blind readers and grey
printers tell apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

Array = NDArray[np.float64]
Numbers = ArrayLike | Tensor

BLUE, ORANGE, GREY, INK, FRAME, GRID = "#0072b2", "#d55e00", "#969696", "#262626", "#8c8c8c", "#e3e3e3"
DASHED: dict[str, Any] = {"color": ORANGE, "linewidth": 1.5, "linestyle": (0, (5, 2))}
SHADE: dict[str, Any] = {"color": BLUE, "alpha": 0.18, "linewidth": 0}
LABEL_SIZE, TICK_SIZE, SMALL_SIZE = 9.0, 8.0, 7.0  # of letters, points
MOST_LABELS = 16  # lines or marks that still get a label each: more overlap
LONGEST_NAME = 18  # characters of a label, beyond which it is cut


def with_unit(label: str, unit: str | None) -> str:
    """A label with its unit, where that is known."""
    return f"{label} ({unit})" if unit and unit != "unknown" else label


def new_axes() -> Axes:
    """New axes of pyplot."""
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(7.0, 4.6), layout="constrained")[1]


def new_axes_below_each_other(n: int) -> list[Axes]:
    """New axes of pyplot, `n` of them."""
    import matplotlib.pyplot as plt

    return list(plt.subplots(n, 1, figsize=(7.0, 3.0 * n), layout="constrained", squeeze=False)[1][:, 0])


def as_array(value: Numbers) -> Array:
    """Numbers as a NumPy array in double precision."""
    return torch.as_tensor(value).detach().cpu().double().numpy()


def finish(ax: Axes, handles: Sequence[Any] = (), labels: Sequence[str] = (), **place: Any) -> None:
    """Give axes the common look, and a legend for `handles` at `place`."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(FRAME)
    ax.tick_params(which="both", color=FRAME, labelcolor=INK, labelsize=TICK_SIZE)
    for axis in (ax.xaxis, ax.yaxis):
        axis.label.set(color=INK, fontsize=LABEL_SIZE)
        axis.get_offset_text().set(color=INK, fontsize=TICK_SIZE)
        if axis.get_scale() == "log":
            _label_decades(axis)
    ax.grid(color=GRID, linewidth=0.7)
    ax.set_axisbelow(True)
    if handles:
        legend = ax.legend(handles, labels, fontsize=TICK_SIZE, labelcolor=INK, frameon=True, framealpha=0.85, **place)
        legend.get_frame().set(edgecolor="none", facecolor="white")
        for text in legend.get_texts():
            text.set_parse_math(False)


def tick_text(value: float) -> str:
    """A number on an axis: `0.01`, `200`, `1e-5`."""
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:.6g}"
    digits, exponent = f"{value:.6e}".split("e")
    return f"{float(digits):g}e{int(exponent)}"


def _label_decades(axis: Axis) -> None:
    """Plain numbers at decades of a logarithmic axis, at 1, 2 and 5 where there are few; nothing in between."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    class Decades(LogLocator):
        def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
            low, high = sorted((vmin, vmax))
            if not low > 0:
                return super().tick_values(vmin, vmax)
            few, short, most = 2.5, 0.5, 8  # decades with labels in between, with even steps, and labels of all others
            decades = np.log10(high / low)
            if decades < short:
                return [value for value in MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(low, high) if value > 0]
            first, last, step = np.floor(np.log10(low)), np.ceil(np.log10(high)), np.ceil(decades / most)
            places = 10.0 ** np.arange(step * np.floor(first / step), last + 1, step)
            return [part * place for place in places.tolist() for part in ((1, 2, 5) if decades < few else (1,))]

    axis.set_major_locator(Decades())
    axis.set_major_formatter(FuncFormatter(lambda value, _: tick_text(value)))
    axis.set_minor_formatter(NullFormatter())


def clean_name(name: str) -> str:
    """A name that fits a figure: printable and not too long."""
    text = "".join(c if c.isprintable() else "?" for c in name)
    return text if len(text) <= LONGEST_NAME else f"{text[: LONGEST_NAME - 1]}…"


def name_ticks(ax: Axes, names: Sequence[str]) -> None:
    """Name the places 0, 1, ... on the x axis; turned when they are long, every n-th when they are many."""
    step = -(-len(names) // (2 * MOST_LABELS))
    shown = [clean_name(name) for name in names[::step]]
    room = ax.get_window_extent().width * 72 / ax.figure.dpi / len(shown)  # points for each
    turned = max(map(len, shown)) + 1 > room / (0.6 * TICK_SIZE)
    ax.set_xticks(range(0, len(names), step), shown, rotation=90 if turned else 0, fontsize=TICK_SIZE, parse_math=False)
