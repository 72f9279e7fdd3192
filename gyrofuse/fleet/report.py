"""Report of a fleet of logs as one self-contained HTML page: what stands out first, then the ranking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from gyrofuse._base.page import image, number, render
from gyrofuse._base.results import counted
from gyrofuse.fleet.plots import plot_course, plot_spread
from gyrofuse.fleet.summary import FEWEST_IN_TIME, GAIN, LEVEL, NOISY, Standing, arrays_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Pages stay readable; the table holds all.
_MOST_ROWS, _MOST_COURSES = 50, 6
_RANKED_BY = {
    "fuse": (
        "Gain",
        f"{GAIN}, which count as in the choice of the weights; below 1 is worse than the plain mean",
    ),
    "fit": ("J test p", "p value of the J test, that the model is complete"),
    "diagnose": ("p value", "p value of agreement between log and simulation"),
}


def fleet_report(
    standing: Standing, rows: Sequence[Mapping[str, Any]], *, title: str, settings: Mapping[str, Any] | None = None
) -> str:
    """Write the report of a fleet.

    Args:
        standing: What stands out.
        rows: Of the table.
        title: Heading of the page.
        settings: Of the table; what was asked is told where they are given.

    Returns:
        An HTML page that needs no other file, no network and no script.
    """
    heading, meaning = _RANKED_BY[standing.task]
    ranked = [_ranked_row(value, row) for value, row in standing.ranked[:_MOST_ROWS]]
    return render(
        Path(__file__).parent / "fleet.html.j2",
        title=title,
        asked=_asked(standing.task, settings or {}),
        standing=standing,
        verdict=verdict(standing),
        heading=heading,
        meaning=meaning,
        spread=_spread(standing.task, GAIN if standing.task == "fuse" else meaning, standing.values)
        if len(standing.values) > 1
        else None,
        ranked=ranked,
        placed=any(row["where"] for row in ranked),
        courses=_courses(rows) if standing.task == "fuse" else [],
        most=_MOST_ROWS,
        noisy_limit=NOISY,
    )


def verdict(standing: Standing) -> list[str]:
    """What stands out, in sentences."""
    failed = len(standing.failures)
    said = [
        f"{standing.n_logs} logs, " + (f"{failed} of which could not be used." if failed else "all of them usable.")
    ]
    if standing.task == "fuse" and standing.values:
        middle = number(median(standing.values), 3)
        said.append(
            f"The Allan deviation of the plain mean is {middle} times that of the virtual gyro: geometric mean over "
            "averaging times, which count as in the choice of the weights, and median over logs."
        )
        worse = sum(value < 1 for value in standing.values)
        if worse:
            said.append(f"For {worse} of {len(standing.values)} it is below one: worse than the plain mean.")
        said += [
            f"Sensor {s.sensor} of {s.array} is {number(s.relative_noise, 3)} times as noisy as its array's median."
            for s in standing.too_noisy[:3]
        ]
        if standing.outliers:
            n_unlike = len({o.log for o in standing.outliers})
            said.append(f"{n_unlike} {'log is' if n_unlike == 1 else 'logs are'} unlike the others.")
        said += [
            f"The weight of sensor {d.sensor} of {d.array} drifts from {number(d.first, 3)} to {number(d.last, 3)}."
            for d in standing.drifts[:3]
        ]
        if standing.doubts:
            logs = counted(standing.n_doubted, "log")
            said.append(f"The weights of {logs} are to be doubted, for motion or too short a recording.")
        if not (standing.too_noisy or standing.outliers or standing.doubts or standing.drifts):
            said.append("No sensor, log or drift of weights stands out.")
    if standing.task == "fit" and standing.values:
        said.append(f"{standing.n_refused} of {len(standing.ranked)} fits are refused by the J test at {LEVEL:g}.")
    if standing.n_unidentified:
        said.append(
            f"{standing.n_unidentified} of {len(standing.ranked)} fits have parameters that cannot be told apart."
        )
    if standing.task == "diagnose":
        said.append(f"{standing.n_differ} of {len(standing.ranked)} recordings differ from the simulation.")
    return said


def _ranked_row(value: float, row: Mapping[str, Any]) -> dict[str, Any]:
    told = {
        "log": row["log"],
        "where": " ".join(f"{kind} {row[kind]}" for kind in ("axis", "sensor") if row.get(kind)),
        "value": number(value, 3),
    }
    if "weights" in row:
        told["said"] = ", ".join(f"{w:+.3f}" for w in row["weights"])
    elif "values" in row:
        told["said"] = "; ".join(part for part in _fit_in_words(row) if part)
    else:
        told["said"] = (
            "; ".join([*row["sentences"], *(f"unexplained: {words}" for words in row["unexplained"])]) or "agrees"
        )
    return told


def _fit_in_words(row: Mapping[str, Any]) -> list[str]:
    """Parameters, what they are in datasheet units, and what cannot be told apart."""
    figures = zip(*(row.get(name) or [] for name in ("quantities", "figures", "figure_units")), strict=True)
    return [
        ", ".join(f"{name} {number(value)}" for name, value in zip(row["parameters"], row["values"], strict=True)),
        ", ".join(f"{name} {number(value)} {unit}" for name, value, unit in figures),
        "; ".join(["not identified", *row["remarks"]]) if row.get("identified") is False else "",
    ]


def _asked(task: str, settings: Mapping[str, Any]) -> str:
    """What was asked of every log."""
    done = {"fuse": "fused", "fit": "fitted", "diagnose": "compared with a simulation"}[task]
    names = {"fuse": ("method", "scale_weights"), "fit": ("model",), "diagnose": ("simulation", "false_alarm")}[task]
    told = [f"{name.replace('_', ' ')} {_plain(settings[name])}" for name in names if name in settings]
    return f"{done} ({', '.join(told)})" if told else done


def _plain(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _spread(task: str, label: str, values: Sequence[float]) -> str:
    mark, meaning = (1.0, "plain mean") if task == "fuse" else (LEVEL, f"{LEVEL:g}")
    limits = None if task == "fuse" else (0.0, 1.0)
    what = "recordings of arrays" if task == "fuse" else "fits" if task == "fit" else "recordings"
    draw = partial(plot_spread, values, label=label, mark=mark, meaning=meaning, what=what, limits=limits)
    return image(7, 3, _on_axes, draw)


def _courses(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Figures of weights over the logs of arrays that have several."""
    good = [row for row in rows if row["status"] == "ok"]
    several = [(name, own) for name, own in arrays_of(good).items() if len(own) >= FEWEST_IN_TIME]
    return [
        {
            "name": name,
            "figure": image(
                7, 3.2, _on_axes, partial(plot_course, [row["weights"] for row in own], names=own[0]["sensors"])
            ),
        }
        for name, own in several[:_MOST_COURSES]
    ]


def _on_axes(figure: Figure, draw: Any) -> None:
    draw(ax=figure.subplots())
