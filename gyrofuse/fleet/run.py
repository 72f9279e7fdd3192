"""Logs in, rows out: a log that cannot be worked on gets a row that says why, and those beside it theirs."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import Dataset

from gyrofuse.fleet.logs import State, as_text, identity, state_of
from gyrofuse.fleet.tasks import Row, Task
from gyrofuse.fleet.watch import Watch
from gyrofuse.io.recording import Recording, check_reading, read_recording

_OPTIONS = tuple(signature(read_recording).parameters)[1:]  # without the path


@dataclass(frozen=True)
class Log:
    """A log as it was read, or why it was not.

    Attributes:
        name: Its path, as given.
        recording: None where it could not be read.
        error: Why.
        path: Absolute, where it is a file or folder.
        state: When reading began.
    """

    name: str
    recording: Recording | None
    error: str | None = None
    path: str | None = None
    state: State = field(default_factory=State)

    @property
    def place(self) -> Row:
        """What its rows say of where it is."""
        return {"log": self.name, "path": self.path, **self.state._asdict()}

    def to(self, device: torch.device) -> Log:
        """With the signal on a device."""
        if self.recording is None:
            return self
        return replace(self, recording=replace(self.recording, signal=self.recording.signal.to(device)))


class LogGroups(Dataset[tuple[Log, ...]]):
    """Groups of logs, read when they are asked for.

    Args:
        groups: Paths, group by group.
        options: Of `read_recording`.
        watch: Where it is noted which log is being read.

    Raises:
        TypeError: An option that it does not have.
        ValueError: A rate or scale that is none.
    """

    def __init__(
        self, groups: Sequence[Sequence[Path]], options: Mapping[str, Any], watch: Watch | None = None
    ) -> None:
        self.watch = watch
        self.groups = tuple(map(tuple, groups))
        self.options = dict(options)
        unknown = [name for name in options if name not in _OPTIONS]
        if unknown:
            raise TypeError(
                f"`{unknown[0]}`: expected an option of read_recording ({', '.join(_OPTIONS)}); leave it out"
            )
        checked = ("rate", "scale", "quantity", "columns")
        check_reading(**{name: self.options[name] for name in checked if name in self.options})

    def __len__(self) -> int:
        return len(self.groups)

    def __getitem__(self, index: int) -> tuple[Log, ...]:
        return tuple(map(self._watched, self.groups[index]))

    def _watched(self, path: Path) -> Log:
        try:
            return self._read(path)
        finally:  # and no sooner: to take apart what a library has left of a log may end the process, too
            if self.watch is not None:
                self.watch.end()

    def _read(self, path: Path) -> Log:
        log = Log(as_text(str(path)), None, path=identity(path), state=state_of(path))
        if "\0" in str(path):
            return replace(log, error="expected the name of a file, found one with NUL bytes; save the list as UTF-8")
        if self.watch is not None:
            self.watch.begin([log.place])
        try:
            return replace(log, recording=read_recording(path, **self.options))
        except Exception as error:  # whatever a damaged file does to a library, the others are read
            return replace(log, error=as_text(_said(error)).removeprefix(f"{log.name}: "))


@dataclass
class _Answer:
    """Rows of a log without what all rows have, and what was warned of."""

    rows: list[Row] = field(default_factory=list)
    error: str | None = None
    warned: list[str] = field(default_factory=list)


def rows_of(task: Task, logs: Sequence[Log]) -> list[Row]:
    """Rows of some logs.

    Those of one shape are worked on together where the task can; if that fails, each alone.
    """
    answers: dict[str, _Answer] = {log.name: _Answer(error=log.error) for log in logs}
    for group in _alike(logs):
        together = _asked(task, [recording for _, recording in group])
        if together is None:
            for name, recording in group:
                answers[name] = _alone(task, recording)
            continue
        for (name, _), answer in zip(group, together, strict=True):
            answers[name] = answer
    return [row for log in logs for row in _whole_rows(log, answers[log.name])]


def _alike(logs: Sequence[Log]) -> Iterable[list[tuple[str, Recording]]]:
    groups: dict[tuple[int, ...], list[tuple[str, Recording]]] = {}
    for log in logs:
        if log.recording is not None:
            groups.setdefault(tuple(log.recording.signal.shape), []).append((log.name, log.recording))
    return groups.values()


def _asked(task: Task, recordings: Sequence[Recording]) -> list[_Answer] | None:
    """Answers to several, None where something is wrong with any."""
    if len(recordings) == 1:
        return None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            rows = task.rows(recordings)
        except Exception:
            return None
    if caught:  # said of one of them
        return None
    return [_Answer(own) for own in rows]


def _alone(task: Task, recording: Recording) -> _Answer:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            (rows,) = task.rows([recording])
        except Exception as error:
            return _Answer(error=_said(error), warned=[str(w.message) for w in caught])
    return _Answer(rows, warned=[str(w.message) for w in caught])


def _whole_rows(log: Log, answer: _Answer) -> list[Row]:
    common: Row = {**log.place, "status": "ok" if answer.error is None else "failed", "error": answer.error}
    if log.recording is not None:
        r = log.recording
        common |= {
            "sensors": list(r.sensors),
            "n_samples": r.n_samples,
            "rate": r.rate,
            "unit": r.unit,
            "missing": float(r.missing.max()),
            "notes": [str(note) for note in r.notes],
        }
    whole = [{**common, **own, "warnings": [*answer.warned, *own.get("warnings", ())]} for own in answer.rows or [{}]]
    return [{name: _storable(value) for name, value in row.items()} for row in whole]


def _storable(value: Any) -> Any:
    """Text, alone or in lists, as UTF-8 can hold it: names of sensors come from logs as they are."""
    if isinstance(value, str):
        return as_text(value)
    texts = isinstance(value, list | tuple) and any(isinstance(entry, str) for entry in value[:1])
    return [_storable(entry) for entry in value] if texts else value


def _said(error: Exception) -> str:
    """One line; what is a defect rather than bad input says its type."""
    words = " ".join(str(error).split())
    known = isinstance(error, ValueError | TypeError | OSError | ImportError)
    return words if known and words else f"{type(error).__name__}: {words}"
