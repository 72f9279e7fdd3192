"""One trial: seal the truths, let an analyst answer every case, freeze the answers, judge.

    plan = plan_trial(per_kind=5, nulls=50, nats=(3, 10, 30, 100), seed=secrets.randbits(64))
    verdict = run_trial(plan, analyse, "folder")

`analyse(recording, simulation)` returns a report's dictionary; it sees neither the kind of a case nor its seed.
"""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .cases import NATS, RATE, Case, make_case
from .judge import Verdict, judge
from .kinds import GROUPS, KINDS, SIZELESS
from .likelihood import OutOfReachError
from .ordinary_view import is_concealed
from .seal import freeze, seal, unseal

Analyse = Callable[[dict[str, Any], dict[str, Any]], dict[str, Any]]
Mapping = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]


class Item(NamedTuple):
    """What makes a case."""

    kind: str
    nats: float | None
    seed: int
    wide: bool = False


def plan_trial(
    per_kind: int,
    nulls: int,
    nats: Sequence[float] = NATS,
    *,
    seed: int,
    groups: Sequence[str] = GROUPS,
    wide: bool = False,
) -> list[Item]:
    """Cases in random order.

    Args:
        per_kind: Cases of each kind with an effect, at each of `nats` where these mean something.
        nulls: Cases of each kind without one.
        nats: Detectabilities.
        seed: Of the order and of the cases' seeds.
        groups: Of kinds; by default `GROUPS`.
        wide: Whether each case has sensors, rate, length and share of the sensors of its own.
    """
    items: list[tuple[str, float | None]] = []
    for name, kind in KINDS.items():
        if kind.group not in groups:
            continue
        if not kind.effects:
            items += [(name, None)] * nulls
        elif kind.group == "unidentifiable" or name in SIZELESS:
            items += [(name, None)] * (per_kind * len(nats))
        else:
            items += [(name, n) for n in nats] * per_kind
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(items))
    return [Item(*items[i], int(rng.integers(2**31)), wide) for i in order]


def run_trial(
    plan: Sequence[Item],
    analyse: Analyse,
    folder: str | Path,
    *,
    n_samples: int = 65536,
    rate: float = RATE,
    false_alarm: float = 0.01,
    over: Mapping = map,
    data: Path | None = None,
) -> Verdict:
    """Truths are sealed before the first recording is shown; the truth is opened once the answers are frozen.

    The folder receives `truth.json`, `answers.json`, `digests.json`, `verdict.json` and, for each diagnosis that
    failed, its traceback in `failures.txt`. The cases are made twice, so that nothing large is written; effects that
    cannot be as large as the plan has them are left out.

    Args:
        plan: What makes the cases.
        analyse: The analyst.
        folder: Of what is written.
        n_samples: Of each recording.
        rate: Hz.
        false_alarm: Error rate that the analyst is held to.
        over: `map`, or the `map` of a pool of processes, which gives answers in order.
        data: Folder of real recordings, for the group "real".
    """
    at = Path(folder)
    at.mkdir(parents=True, exist_ok=True)
    made = partial(_made, n_samples, rate, data)
    known = [(item, truth) for item in plan if (truth := _truth(made, item)) is not None]
    plan, truths = [item for item, _ in known], [truth for _, truth in known]
    digests = {"truth": seal(truths, at / "truth.json")}
    (at / "digests.json").write_text(json.dumps(digests))
    answered = list(over(partial(_answered, analyse, made), plan))
    failures = [f"case {number}\n{entry.failure}\n" for number, entry in enumerate(answered) if entry.failure]
    if failures:
        (at / "failures.txt").write_text("".join(failures))
    answers = [entry.answer for entry in answered]
    digests["answers"] = freeze(answers, digests["truth"], at / "answers.json")
    (at / "digests.json").write_text(json.dumps(digests))
    opened = unseal(at / "truth.json", digests["truth"], at / "answers.json", digests["answers"])
    verdict = judge(*opened, false_alarm=false_alarm, concealed=[entry.hidden for entry in answered])
    (at / "verdict.json").write_text(json.dumps(verdict.to_dict(), indent=1))
    return verdict


class _Answered(NamedTuple):
    answer: dict[str, Any] | None
    hidden: bool
    failure: str | None


def _made(n_samples: int, rate: float, data: Path | None, item: Item) -> Case:
    return make_case(item.kind, item.nats, item.seed, n_samples=n_samples, rate=rate, data=data, wide=item.wide)


def _truth(made: Callable[[Item], Case], item: Item) -> dict[str, Any] | None:
    """None where there is no such case."""
    try:
        return made(item).truth
    except OutOfReachError:
        return None


def _answered(analyse: Analyse, made: Callable[[Item], Case], item: Item) -> _Answered:
    """One case answered; a diagnosis that fails is counted by the judge as nothing detected, nothing named."""
    case = made(item)
    hidden = is_concealed(case)
    try:
        return _Answered(analyse(case.recording, case.simulation), hidden, None)
    except Exception:
        return _Answered(None, hidden, traceback.format_exc())
