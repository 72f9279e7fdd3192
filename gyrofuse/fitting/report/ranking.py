"""Report of ranked noise models as one self-contained HTML page."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gyrofuse._base.page import number, render
from gyrofuse._base.results import counted, format_p_value, p_words, sensor_label, signed
from gyrofuse.fitting.j_test import REJECTED
from gyrofuse.fitting.moments.fit import composition_of
from gyrofuse.fitting.ranking.candidates import n_parameters, penalty
from gyrofuse.fitting.ranking.result import RankResult
from gyrofuse.fitting.report.page import MOST_SENSORS, model_part
from gyrofuse.fitting.report.words import model_method
from gyrofuse.io.recording import Recording

# Largest number of candidates in a table: a page stays readable, the JSON file holds all.
_MOST_ROWS = 15


def rank_report(
    result: RankResult, recording: Recording | None = None, *, title: str, remarks: Sequence[str] = ()
) -> str:
    """Write the report of noise models ranked for the sensors of a recording.

    Args:
        result: Ranking for the sensors of one array, or of one per axis.
        recording: Recording that was ranked, for its notes.
        title: Heading of the page.
        remarks: Sentences shown below the verdict.

    Returns:
        An HTML page that needs no other file, no network and no script.
    """
    indices = list(itertools.product(*map(range, result.choice.shape)))
    parts = [_part(result, recording, n, index) for n, index in enumerate(indices[:MOST_SENSORS])]
    fits = [fit for fit in result.best if fit is not None]
    return render(
        Path(__file__).parent / "ranking.html.j2",
        title=title,
        result=result,
        recording=recording,
        parts=parts,
        remarks=remarks,
        left_out=len(indices) - len(parts),
        method=model_method(fits[0]) if fits else None,
    )


def rank_verdict(result: RankResult, index: tuple[int, ...]) -> list[str]:
    """Say in sentences which model a sensor has, what is as good, and why the next one is not.

    Args:
        result: Ranking.
        index: Index of the sensor among the leading dimensions.
    """
    if int(result.choice[index]) < 0:
        return ["Not ranked: its record does not vary or has missing samples."]
    return list(_sentences(result, index))


def _sentences(result: RankResult, index: tuple[int, ...]) -> Iterator[str]:
    names, choice = result.candidates, int(result.choice[index])
    rows = _rows(result, index)
    if len(rows) > 1:
        yield f"{names[choice]} is the best of {len(rows)} candidates tried."
    else:
        yield f"{names[choice]} is the only candidate that was tried."
    aside: dict[str, list[str]] = {}
    for c in result.set_aside(index):
        aside.setdefault(str(result.reasons_of(index)[c]), []).append(names[c])
    for reason, those in aside.items():
        yield f"Not compared: {', '.join(those)} ({reason})."
    yield from result.doubts(index)
    if result.n_lines is not None and (n_lines := int(result.n_lines[index])):
        found = "One line" if n_lines == 1 else f"{n_lines} lines"
        if not result.lines_counted(index):
            found = f"At least {found.lower()}"
        yield f"{found} stand{'s' if n_lines == 1 else ''} out of the noise in the spectrum."
    same = [row["name"] for row in rows if row["standing"] == "equivalent"]
    if same:
        yield f"Equivalent to it: {', '.join(same)}."
    for row in rows:
        if row["reason"] and row["difference"] < 0:
            better = f"a criterion {-row['difference']:.1f} below, but is more than it takes: {row['reason']}."
            yield f"{row['name']} has {better}"
    others = [row for row in rows if row["standing"] in ("", "redundant") and row["difference"] >= 0]
    if others:
        which = "The runner-up" if others[0] is rows[1] else "The next one"
        yield f"{which}, {others[0]['name']}, {_why_not(result, index, others[0])}."


def _why_not(result: RankResult, index: tuple[int, ...], row: dict[str, Any]) -> str:
    """Why the next one lost."""
    own, chosen = (
        composition_of(name, held=True) for name in (row["name"], result.candidates[int(result.choice[index])])
    )
    more = n_parameters(own) - n_parameters(chosen)
    charged = (penalty(own, result.n_samples) - penalty(chosen, result.n_samples)) / 2
    nats = row["difference"] / 2
    # Likelihoods that differ by less than 0.1 nats are equal; ratios above e^15 are beyond doubt.
    if more > 0 and abs(charged - nats) < 0.1:
        what = f"no likelihood gained for {counted(more, 'more number')}"
    elif nats < 15.0:
        what = f"{number(math.exp(nats), 2)} times less likely, with its numbers charged for"
    else:
        what = "beyond any doubt"
    phrase = f"has a criterion {row['difference']:.1f} above ({what})"
    if row["reason"]:
        return f"{phrase} and is more than it takes: {row['reason']}"
    # That is against it only where the chosen one fits.
    if row["p_value"] < REJECTED <= result.p_value[index][int(result.choice[index])].item():
        return f"{phrase}; its wavelet variances do not fit (J test: {p_words(row['p_value'])})"
    return phrase


def _part(result: RankResult, recording: Recording | None, n: int, index: tuple[int, ...]) -> dict[str, Any]:
    name, fit = f"Sensor {sensor_label(result.sensors, index, result.axes)}", result.best[n]
    rows = _rows(result, index)
    return {
        "name": name,
        "anchor": f"fit-{n + 1}",
        "verdict": rank_verdict(result, index),
        "rows": rows[:_MOST_ROWS],
        "more": len(rows[_MOST_ROWS:]),
        "fit": None if fit is None else model_part(fit, (0,), name),
    }


def _rows(result: RankResult, index: tuple[int, ...]) -> list[dict[str, Any]]:
    """The candidates that were tried, from the best on."""
    if int(result.choice[index]) < 0:
        return []
    rows = []
    for c in result.compared_to(index):
        difference = result.difference[index][c].item()
        rows.append(
            {
                "name": result.candidates[c],
                "difference": difference,
                "criterion": signed(difference),
                "wvic": signed(result.wvic_difference[index][c].item()),
                "p_value": result.p_value[index][c].item(),
                "p": format_p_value(result.p_value[index][c].item()),
                "standing": result.standing(index, c),
                "reason": result.reasons_of(index)[c],
            }
        )
    return sorted(rows, key=lambda row: (row["difference"], row["standing"] != "chosen"))
