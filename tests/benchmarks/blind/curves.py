"""Shares of effects detected and named against their size, beside what the oracle detects."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from .judge import EVERYTHING, Row, Verdict

LINES = {
    "oracle detects": ("oracle", "#000000", "s"),
    "detected": ("detected", "#0072b2", "o"),
    "right name": ("right name", "#009e73", "^"),
    "wrong name with confidence": ("wrong name", "#d55e00", "x"),
}
_COLUMNS = 5
_APART = 0.03  # of markers of one size, as a share of it


def draw_curves(verdict: Verdict, path: Path) -> bool:
    """One panel for all mechanisms and one for each, with 95 % intervals; False where there is nothing to draw."""
    of = list(dict.fromkeys(row.of for row in verdict.rows if row.line == "detected" and row.nats is not None))
    if not of:
        return False
    of.sort(key=lambda name: (name != EVERYTHING, name))
    n_rows = -(-len(of) // _COLUMNS)
    figure, axes = plt.subplots(
        n_rows, _COLUMNS, figsize=(2.6 * _COLUMNS, 2.0 * n_rows + 0.6), sharex=True, sharey=True, squeeze=False
    )
    for ax, name in zip(axes.flat, of, strict=False):
        _panel(ax, [row for row in verdict.rows if row.of == name and row.nats is not None])
        ax.set_title("all mechanisms" if name == EVERYTHING else name, fontsize=9)
    for ax in axes.flat[len(of) :]:
        ax.set_axis_off()
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=len(LINES), frameon=False)
    figure.supxlabel("size of the effect, nats")
    figure.supylabel("share of cases")
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.35 / figure.get_figheight()))
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return True


def _panel(ax: Axes, rows: list[Row]) -> None:
    for place, (line, (label, color, marker)) in enumerate(LINES.items()):
        own = sorted((row for row in rows if row.line == line), key=lambda row: row.nats or 0.0)
        if not own:
            continue
        nats = [(row.nats or 0.0) * (1 + _APART * place) for row in own]
        share = [row.hits / row.trials for row in own]
        reach = [
            [s - row.interval[0] for s, row in zip(share, own, strict=True)],
            [row.interval[1] - s for s, row in zip(share, own, strict=True)],
        ]
        ax.errorbar(nats, share, yerr=reach, label=label, color=color, marker=marker, ms=4, lw=1, elinewidth=0.7)
    ax.set_xscale("log")
    ticks = sorted({row.nats for row in rows if row.nats is not None})
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_ylim(-0.05, 1.05)
    ax.grid(alpha=0.3, lw=0.5)
