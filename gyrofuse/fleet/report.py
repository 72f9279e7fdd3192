"""Report of a fleet of logs as one self-contained HTML page: what stands out first, then the ranking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from gyrofuse._base.page import image, number, render
from gyrofuse._base.results import counted
from gyrofuse.fitting.j_test import REJECTED
from gyrofuse.fleet.plots import plot_distribution, plot_weights_over_logs
from gyrofuse.fleet.summary import FEWEST_IN_TIME, GAIN, LEVEL, NOISY, FleetSummary, arrays_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Lengths that keep a page readable; all rows are in the table.
_MOST_ROWS = 50  # rows of each list on the page, about two screens
_MOST_COURSES = 6  # figures of weights over logs, one for each array
_RANKED_BY = {
    "fuse": (
        "Gain",
        f"{GAIN}, which count as in the choice of the weights; below 1 is worse than the plain mean",
    ),
    "fit": ("J test p", "p value of the J test, that the model is complete"),
    "diagnose": ("p value", "p value of agreement between log and simulation"),
}


def fleet_report(
    summary: FleetSummary, rows: Sequence[Mapping[str, Any]], *, title: str, settings: Mapping[str, Any] | None = None
) -> str:
    """Write the report of a fleet.

    Args:
        summary: Summary of the table.
        rows: Rows of the table.
        title: Heading of the page.
        settings: Settings of the table; with them the page names the options of the task.

    Returns:
        An HTML page that needs no other file, no network and no script.
    """
    heading, meaning = _RANKED_BY[summary.task]
    ranked = [_ranked_row(value, row) for value, row in summary.ranked[:_MOST_ROWS]]
    return render(
        Path(__file__).parent / "fleet.html.j2",
        title=title,
        asked=_asked(summary.task, settings or {}),
        summary=summary,
        verdict=verdict(summary),
        heading=heading,
        meaning=meaning,
        distribution=_distribution(summary.task, GAIN if summary.task == "fuse" else meaning, summary.values)
        if len(summary.values) > 1
        else None,
        ranked=ranked,
        placed=any(row["where"] for row in ranked),
        courses=_courses(rows) if summary.task == "fuse" else [],
        most=_MOST_ROWS,
        noisy_limit=NOISY,
    )


def verdict(summary: FleetSummary) -> list[str]:
    """The summary in sentences."""
    failed = len(summary.failures)
    sentences = [
        f"{summary.n_logs} logs, " + (f"{failed} of which could not be used." if failed else "all of them usable.")
    ]
    if summary.task == "fuse" and summary.values:
        middle = number(median(summary.values), 3)
        sentences.append(
            f"The Allan deviation of the plain mean is {middle} times that of the virtual gyro: geometric mean over "
            "averaging times, which count as in the choice of the weights, and median over logs."
        )
        worse = sum(value < 1 for value in summary.values)
        if worse:
            sentences.append(f"For {worse} of {len(summary.values)} it is below one: worse than the plain mean.")
        sentences += [
            f"Sensor {s.sensor} of {s.array} is {number(s.relative_noise, 3)} times as noisy as its array's median."
            for s in summary.too_noisy[:3]
        ]
        if summary.outliers:
            n_unlike = len({o.log for o in summary.outliers})
            sentences.append(f"{n_unlike} {'log is' if n_unlike == 1 else 'logs are'} unlike the others.")
        sentences += [
            f"The weight of sensor {d.sensor} of {d.array} drifts from {number(d.first, 3)} to {number(d.last, 3)}."
            for d in summary.trends[:3]
        ]
        if summary.weight_warnings:
            logs = counted(summary.n_warned, "log")
            sentences.append(f"The weights of {logs} are to be doubted, for motion or too short a recording.")
        if not (summary.too_noisy or summary.outliers or summary.weight_warnings or summary.trends):
            sentences.append("No sensor, log or drift of weights stands out.")
    if summary.task == "fit" and summary.values:
        sentences.append(
            f"{summary.n_refused} of {len(summary.ranked)} fits are refused by the J test at {REJECTED:g}."
        )
    if summary.n_unidentified:
        sentences.append(
            f"{summary.n_unidentified} of {len(summary.ranked)} fits have parameters that cannot be told apart."
        )
    if summary.task == "diagnose":
        sentences.append(f"{summary.n_differ} of {len(summary.ranked)} recordings differ from the simulation.")
    return sentences


def _ranked_row(value: float, row: Mapping[str, Any]) -> dict[str, Any]:
    cells = {
        "log": row["log"],
        "where": " ".join(f"{kind} {row[kind]}" for kind in ("axis", "sensor") if row.get(kind)),
        "value": number(value, 3),
    }
    if "weights" in row:
        cells["said"] = ", ".join(f"{w:+.3f}" for w in row["weights"])
    elif "values" in row:
        cells["said"] = "; ".join(part for part in _fit_in_words(row) if part)
    else:
        cells["said"] = (
            "; ".join([*row["sentences"], *(f"unexplained: {words}" for words in row["unexplained"])]) or "agrees"
        )
    return cells


def _fit_in_words(row: Mapping[str, Any]) -> list[str]:
    """Parameters, their values in datasheet units, and which are not identified."""
    figures = zip(*(row.get(name) or [] for name in ("quantities", "figures", "figure_units")), strict=True)
    return [
        ", ".join(f"{name} {number(value)}" for name, value in zip(row["parameters"], row["values"], strict=True)),
        ", ".join(f"{name} {number(value)} {unit}" for name, value, unit in figures),
        "; ".join(["not identified", *row["remarks"]]) if row.get("identified") is False else "",
    ]


def _asked(task: str, settings: Mapping[str, Any]) -> str:
    """The task and its options in words."""
    done = {"fuse": "fused", "fit": "fitted", "diagnose": "compared with a simulation"}[task]
    names = {"fuse": ("method", "scale_weights"), "fit": ("model",), "diagnose": ("simulation", "false_alarm")}[task]
    options = [f"{name.replace('_', ' ')} {_plain(settings[name])}" for name in names if name in settings]
    return f"{done} ({', '.join(options)})" if options else done


def _plain(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _distribution(task: str, label: str, values: Sequence[float]) -> str:
    level = REJECTED if task == "fit" else LEVEL
    mark, meaning = (1.0, "plain mean") if task == "fuse" else (level, f"{level:g}")
    limits = None if task == "fuse" else (0.0, 1.0)
    what = "recordings of arrays" if task == "fuse" else "fits" if task == "fit" else "recordings"
    draw = partial(plot_distribution, values, label=label, mark=mark, meaning=meaning, what=what, limits=limits)
    return image(7, 3, _on_axes, draw)


def _courses(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Figures of weights over the logs of arrays that have several."""
    good = [row for row in rows if row["status"] == "ok"]
    several = [(name, own) for name, own in arrays_of(good).items() if len(own) >= FEWEST_IN_TIME]
    courses = []
    for name, own in several[:_MOST_COURSES]:
        draw = partial(plot_weights_over_logs, [row["weights"] for row in own], names=own[0]["sensors"])
        courses.append({"name": name, "figure": image(7, 3.2, _on_axes, draw)})
    return courses


def _on_axes(figure: Figure, draw: Any) -> None:
    draw(ax=figure.subplots())
