"""The judge: sealed truths and frozen answers to a table of counts with Clopper-Pearson intervals.

    python -m blind.judge truth.json TRUTH_DIGEST answers.json ANSWERS_DIGEST --out verdict.json

run from `tests/benchmarks`.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import beta

from . import scoring
from .scoring import Record
from .seal import unseal

Pair = tuple[Record, "Record | None"]
EVERYTHING = "all"


class Row(NamedTuple):
    """A count: `hits` of `trials`, for a mechanism (or kind) at a detectability."""

    line: str
    of: str
    nats: float | None
    hits: int
    trials: int

    @property
    def interval(self) -> tuple[float, float]:
        """Exact 95 % limits of the share."""
        low = beta.ppf(0.025, self.hits, self.trials - self.hits + 1) if self.hits else 0.0
        high = beta.ppf(0.975, self.hits + 1, self.trials - self.hits) if self.hits < self.trials else 1.0
        return float(low), float(high)

    def to_dict(self) -> Record:
        """Plain numbers."""
        low, high = self.interval
        return {**self._asdict(), "share": self.hits / self.trials, "low": low, "high": high}


class Figure(NamedTuple):
    """A mean, a median and quartiles: errors in the oracle's standard deviations, gains as shares of the true one's."""

    line: str
    of: str
    values: tuple[float, ...]

    def to_dict(self) -> Record:
        """Plain numbers."""
        quartiles = np.quantile(self.values, [0.25, 0.5, 0.75])
        return {
            "line": self.line, "of": self.of, "trials": len(self.values), "mean": float(np.mean(self.values)),
            "lower_quartile": quartiles[0], "median": quartiles[1], "upper_quartile": quartiles[2],
        }  # fmt: skip


class Verdict(NamedTuple):
    """All counts and figures."""

    rows: list[Row]
    figures: list[Figure]

    def to_dict(self) -> Record:
        """Plain numbers."""
        return {"rows": [r.to_dict() for r in self.rows], "figures": [f.to_dict() for f in self.figures]}

    def row(self, line: str, of: str = EVERYTHING, nats: float | None = None) -> Row:
        """One count."""
        return next(r for r in self.rows if (r.line, r.of, r.nats) == (line, of, nats))

    def __str__(self) -> str:
        by_nats = {(row.line, row.of) for row in self.rows if row.nats is not None}
        lines = [f"{'':36}{'of':30}{'nats':>6}{'hits':>7}{'of':>7}{'share':>8}   95 % interval", "-" * 112]
        for row in self.rows:
            if row.nats is None and row.of != EVERYTHING and (row.line, row.of) in by_nats:
                continue  # summed over unlike sizes: in the JSON, not worth a line here
            low, high = row.interval
            nats = "" if row.nats is None else f"{row.nats:g}"
            share = row.hits / row.trials
            lines.append(
                f"{row.line:36}{row.of:30}{nats:>6}{row.hits:7}{row.trials:7}{share:8.3f}   {low:.3f} .. {high:.3f}"
            )
        lines += [
            "",
            f"{'':36}{'of':30}{'':6}{'trials':>7}{'mean':>10}{'25 %':>10}{'median':>10}{'75 %':>10}",
            "-" * 122,
        ]
        for figure in map(Figure.to_dict, self.figures):
            told = (figure["mean"], figure["lower_quartile"], figure["median"], figure["upper_quartile"])
            numbers = "".join(f"{value:10.3g}" for value in told)
            lines.append(f"{figure['line']:36}{figure['of']:30}{'':6}{figure['trials']:7}{numbers}")
        return "\n".join(lines)


class _Counts:
    """Hits and trials by line, mechanism and nats, in the order in which they came; each also summed up."""

    def __init__(self) -> None:
        self.counts: dict[tuple[str, str, float | None], list[int]] = defaultdict(lambda: [0, 0])

    def add(self, line: str, hit: bool, of: Iterable[str] = (), nats: float | None = None) -> None:
        names = [EVERYTHING, *of]
        keys = [(name, level) for name in names for level in dict.fromkeys([None, nats])]
        for name, level in keys:
            count = self.counts[line, name, level]
            count[0] += bool(hit)
            count[1] += 1

    def rows(self) -> list[Row]:
        lines = list(dict.fromkeys(line for line, _, _ in self.counts))
        ordered = sorted(self.counts.items(), key=lambda item: (lines.index(item[0][0]), item[0][1] != EVERYTHING,
                                                                item[0][1], item[0][2] or 0.0))  # fmt: skip
        return [Row(*key, *count) for key, count in ordered]


def judge(
    truths: list[Record],
    answers: list[Record | None],
    *,
    false_alarm: float = 0.01,
    concealed: list[bool] | None = None,
) -> Verdict:
    """The acceptance table.

    Args:
        truths: Of `make_case`.
        answers: `to_dict()` of each report; None where the diagnosis failed.
        false_alarm: Of the oracle's test, the rate that the analyst was asked for.
        concealed: For each case whether the ordinary view shows nothing; adds lines on the concealed ones alone.

    Returns:
        Counts and figures.
    """
    counts, figures = _Counts(), defaultdict[tuple[str, str], list[float]](list)
    hidden = concealed or [False] * len(truths)
    for truth, answer, is_hidden in zip(truths, answers, hidden, strict=True):
        counts.add("diagnosis failed", answer is None)
        _GROUPS[truth["group"]](counts, figures, truth, answer, false_alarm)
        if scoring.detected(answer):
            counts.add("much is left and nothing said to be", scoring.silent(answer), (truth["group"],), truth["nats"])
        if is_hidden and truth["group"] in ("mechanism", "pair"):
            _named(counts, "concealed: ", truth, answer)
    return Verdict(counts.rows(), [Figure(line, of, tuple(v)) for (line, of), v in figures.items()])


def _where(truth: Record) -> tuple[str, ...]:
    """Kinds of cases beside the effect's own: how many of the sensors have it."""
    return (truth["kind"],) if truth["reach"] is None else (truth["kind"], f"in {truth['reach']}")


def _named(counts: _Counts, prefix: str, truth: Record, answer: Record | None) -> None:
    (effect,) = truth["effects"]
    of, nats = _where(truth), truth["nats"]
    finding = scoring.match(effect, answer)
    counts.add(f"{prefix}detected", scoring.detected(answer), of, nats)
    counts.add(f"{prefix}right name", finding is not None and finding["mechanism"] == effect["mechanism"], of, nats)
    right = finding is not None
    if effect["class"] == [effect["mechanism"]]:
        named = finding is not None and finding["mechanism"] == effect["mechanism"]
        counts.add(f"{prefix}right name, where only one is", named, of, nats)
    counts.add(f"{prefix}right class", right, of, nats)
    if scoring.detected(answer):
        counts.add(f"{prefix}right class, of detected", right, of, nats)
    counts.add(f"{prefix}wrong name with confidence", bool(scoring.wrong_names(truth, answer)), of, nats)


def _single(counts: _Counts, figures: Any, truth: Record, answer: Record | None, false_alarm: float) -> None:
    prefix = "pair: " if truth["group"] == "pair" else ""
    _named(counts, prefix, truth, answer)
    if not prefix:
        (effect,) = truth["effects"]
        counts.add("oracle detects", scoring.oracle_detects(effect, false_alarm), (truth["kind"],), truth["nats"])
        counts.add(f"detected, simulation {_length(truth)}", scoring.detected(answer), (truth["kind"],), truth["nats"])
        _details(counts, figures, effect, answer, truth["nats"])
        _held_out(counts, figures, truth, answer)


def _length(truth: Record) -> str:
    """Of the simulation: what a comparison with few samples cannot show, no analyst can."""
    simulated = truth["simulated"]
    return "a model" if simulated is None else f"{simulated / truth['n_samples']:g} times as long"


def _details(
    counts: _Counts, figures: Any, effect: Record, answer: Record | None, nats: float | None, prefix: str = ""
) -> None:
    """What is said of an effect whose name is right."""
    finding, name = scoring.match(effect, answer), effect["mechanism"]
    if finding is None or finding["mechanism"] != name:
        return
    exact, resolved = scoring.right_sensors(effect, finding)
    counts.add(f"{prefix}exact sensors", exact, (name,), nats)
    counts.add(f"{prefix}exact sensors, resolved ones", resolved, (name,), nats)
    chance = scoring.oracle_exact(effect)
    if chance is not None and nats is not None:
        figures[f"{prefix}oracle has the exact sensors", f"{nats:g} nats"].append(chance)
    for line, error in (
        ("frequency", scoring.frequency_error(effect, finding)),
        ("onset", scoring.onset_error(effect, finding)),
    ):
        if error is not None:
            counts.add(f"{prefix}{line} within 3 sd of the oracle", error <= 3, (name,))
            figures[f"{prefix}{line} error / sd of the oracle", name].append(error)
    for parameter, covered in scoring.coverage(effect, finding):
        counts.add(f"{prefix}interval covers", covered, (f"{name}.{parameter}",))
    if prefix:
        return
    unmatched = scoring.unmatched(effect, finding)
    for parameter in finding.get("parameters") or {}:
        counts.add("parameter can be judged", parameter not in unmatched, (f"{name}.{parameter.partition('[')[0]}",))


def _held_out(counts: _Counts, figures: Any, truth: Record, answer: Record | None) -> None:
    held = (answer or {}).get("held_out") or {}
    gain = (held.get("gain") or {}).get("value")
    if not scoring.detected(answer) or gain is None:
        return
    of = (truth["effects"][0]["mechanism"],)
    counts.add("held-out score improves", gain > 0, of)
    if held.get("before") is not None and held.get("after") is not None:
        counts.add("held-out discrepancy falls", held["after"] < held["before"], of)
    left = (held.get("auc") or {}).get("after")
    if left is not None:
        counts.add("area under the curve after, at most 0.55", left <= 0.55, of)
    if (truth.get("true_gain") or 0) > 0:
        for name in (EVERYTHING, f"{truth['nats']:g} nats", of[0]):
            figures["gain / gain of the true model", name].append(gain / truth["true_gain"])


def _null(counts: _Counts, figures: Any, truth: Record, answer: Record | None, false_alarm: float) -> None:
    prefix = "" if truth["group"] == "null" else f"{truth['group']}: "
    counts.add(f"{prefix}false alarm", scoring.detected(answer), (truth["kind"],))
    counts.add(f"{prefix or 'null: '}something named", bool(scoring.findings(answer)), (truth["kind"],))


def _misfit(counts: _Counts, figures: Any, truth: Record, answer: Record | None, false_alarm: float) -> None:
    """Of a noise model that lacks a process: the recording has what it has not."""
    counts.add("misfit: detected", scoring.detected(answer), (truth["kind"],))
    named = any(f["mechanism"] == "parameter_shift" for f in scoring.findings(answer))
    counts.add("misfit: other noise named, of detected", named, (truth["kind"],)) if scoring.detected(answer) else None


def _form(counts: _Counts, figures: Any, truth: Record, answer: Record | None, false_alarm: float) -> None:
    """Of the catalogue's physics in another form: its name, and what is left once it is explained."""
    _named(counts, "form: ", truth, answer)
    (effect,) = truth["effects"]
    finding = scoring.match(effect, answer)
    if finding is not None:
        exact, _ = scoring.right_sensors(effect, finding)
        counts.add("form: exact sensors", exact, _where(truth), truth["nats"])
    left = ((answer or {}).get("held_out") or {}).get("after")
    if scoring.detected(answer) and left is not None:
        counts.add("form: discrepancy after, at most 1.5", left <= 1.5, _where(truth), truth["nats"])


def _two(counts: _Counts, figures: Any, truth: Record, answer: Record | None, false_alarm: float) -> None:
    of, nats = (truth["kind"],), truth["nats"]
    found = [scoring.match(effect, answer) is not None for effect in truth["effects"]]
    counts.add("two: detected", scoring.detected(answer), of, nats)
    counts.add("two: both in class", all(found), of, nats)
    counts.add("two: at least one in class", any(found), of, nats)
    counts.add("two: wrong name with confidence", bool(scoring.wrong_names(truth, answer)), of, nats)


def _outside(counts: _Counts, figures: Any, truth: Record, answer: Record | None, false_alarm: float) -> None:
    of, nats = (truth["kind"],), truth["nats"]
    counts.add("outside: detected", scoring.detected(answer), of, nats)
    counts.add("outside: oracle detects", scoring.oracle_detects(truth["effects"][0], false_alarm), of, nats)
    wrong = bool(scoring.wrong_names(truth, answer))
    counts.add("outside: misnamed", wrong, of, nats)
    if scoring.detected(answer):
        unexplained = bool((answer or {}).get("unexplained"))
        counts.add("outside: unexplained, of detected", unexplained and not wrong, of, nats)
        (effect,) = truth["effects"]
        if effect["class"] == [effect["mechanism"]]:
            counts.add("outside: unexplained, where nothing looks alike", unexplained and not wrong, of, nats)
        else:
            counts.add("outside: unexplained, or its look-alikes listed", not wrong, of, nats)


def _unidentifiable(counts: _Counts, figures: Any, truth: Record, answer: Record | None, false_alarm: float) -> None:
    named = [f["mechanism"] for f in scoring.findings(answer) if f["mechanism"] != scoring.ABSTAINED]
    counts.add("unidentifiable: abstained", answer is not None and not named, (truth["kind"],))
    counts.add("unidentifiable: said so", any(
        scoring.ABSTAINED in (f["mechanism"], *(f.get("alternatives") or [])) for f in scoring.findings(answer)
    ), (truth["kind"],))  # fmt: skip


def _real(counts: _Counts, figures: Any, truth: Record, answer: Record | None, false_alarm: float) -> None:
    """Of an effect put into a real recording; what else is found there may be there."""
    of, nats = (truth["kind"],), truth["nats"]
    if not truth["effects"]:
        counts.add("real, untouched: detected", scoring.detected(answer), of)
        counts.add("real, untouched: something named", bool(scoring.findings(answer)), of)
        return
    (effect,) = truth["effects"]
    finding = scoring.match(effect, answer)
    counts.add("real: detected", scoring.detected(answer), of, nats)
    counts.add("real: right name", finding is not None and finding["mechanism"] == effect["mechanism"], of, nats)
    counts.add("real: right class", finding is not None, of, nats)
    counts.add("real: something else named", bool(scoring.wrong_names(truth, answer)), of, nats)
    _details(counts, figures, effect, answer, nats, "real: ")


_GROUPS: dict[str, Callable[[_Counts, Any, Record, Record | None, float], None]] = {
    "null": _null,
    "common_noise": _null,
    "fitted": _null,
    "misfit": _misfit,
    "form": _form,
    "mechanism": _single,
    "pair": _single,
    "two": _two,
    "outside": _outside,
    "unidentifiable": _unidentifiable,
    "real": _real,
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    for name in ("truth", "truth_digest", "answers", "answers_digest"):
        parser.add_argument(name)
    parser.add_argument("--out", type=Path, help="verdict as JSON")
    parser.add_argument("--false-alarm", type=float, default=0.01)
    parser.add_argument(
        "--concealed", action="store_true", help="make the cases again and see what the ordinary view shows"
    )
    given = parser.parse_args()
    truths, answers = unseal(given.truth, given.truth_digest, given.answers, given.answers_digest)
    hidden = None
    if given.concealed:
        from .ordinary_view import concealed

        hidden = [concealed(truth) for truth in truths]
    verdict = judge(truths, answers, false_alarm=given.false_alarm, concealed=hidden)
    print(verdict)
    if given.out:
        given.out.write_text(json.dumps(verdict.to_dict(), indent=1))


if __name__ == "__main__":
    main()
