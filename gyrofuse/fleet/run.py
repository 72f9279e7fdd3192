"""Rows of logs: a log that cannot be used gets a row with the reason, and the others are not affected."""

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
from gyrofuse.fleet.watchdog import Watchdog
from gyrofuse.io.reading import check_reading, read_recording
from gyrofuse.io.recording import Recording

_OPTIONS = tuple(name for name in signature(read_recording).parameters if name != "path")


@dataclass(frozen=True)
class Log:
    """A log with its recording, or with the reason why it could not be read.

    Attributes:
        name: Path as given.
        recording: The recording; None where the log could not be read.
        error: Reason why it could not be read.
        path: Absolute path, where the log is a file or folder.
        state: State of the file when reading began.
    """

    name: str
    recording: Recording | None
    error: str | None = None
    path: str | None = None
    state: State = field(default_factory=State)

    @property
    def entry(self) -> Row:
        """Columns of its rows that identify the log."""
        return {"log": self.name, "path": self.path, **self.state._asdict()}

    def to(self, device: torch.device) -> Log:
        """The log with its signal on a device."""
        if self.recording is None:
            return self
        return replace(self, recording=replace(self.recording, signal=self.recording.signal.to(device)))


class LogGroups(Dataset[tuple[Log, ...]]):
    """Groups of logs, read when they are asked for.

    Args:
        groups: Paths, group by group.
        options: Keyword arguments of `read_recording`.
        watch: Watchdog that records which log is being read.

    Raises:
        TypeError: An option that `read_recording` does not have.
        ValueError: A rate or scale that is not a positive number.
    """

    def __init__(
        self, groups: Sequence[Sequence[Path]], options: Mapping[str, Any], watch: Watchdog | None = None
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
            self.watch.begin([log.entry])
        try:
            return replace(log, recording=read_recording(path, **self.options))
        except Exception as error:  # whatever a damaged file does to a library, the others are read
            return replace(log, error=as_text(_message(error)).removeprefix(f"{log.name}: "))


@dataclass
class _Outcome:
    """Rows of a log without the common columns, or an error, and the warnings."""

    rows: list[Row] = field(default_factory=list)
    error: str | None = None
    warned: list[str] = field(default_factory=list)


def rows_of(task: Task, logs: Sequence[Log]) -> list[Row]:
    """Rows of some logs.

    Recordings of one shape are worked on together where the task can; if that fails, each alone.

    Args:
        task: The task.
        logs: Logs, read.
    """
    outcomes: dict[str, _Outcome] = {log.name: _Outcome(error=log.error) for log in logs}
    for group in _alike(logs):
        names, recordings = zip(*group, strict=True)
        found = _attempt(task, recordings)
        if len(group) > 1 and any(outcome.error or outcome.warned for outcome in found):
            # Which recording an error or a warning is of is not known.
            found = [outcome for recording in recordings for outcome in _attempt(task, [recording])]
        outcomes |= dict(zip(names, found, strict=True))
    return [row for log in logs for row in _whole_rows(log, outcomes[log.name])]


def _alike(logs: Sequence[Log]) -> Iterable[list[tuple[str, Recording]]]:
    groups: dict[tuple[int, ...], list[tuple[str, Recording]]] = {}
    for log in logs:
        if log.recording is not None:
            groups.setdefault(tuple(log.recording.signal.shape), []).append((log.name, log.recording))
    return groups.values()


def _attempt(task: Task, recordings: Sequence[Recording]) -> list[_Outcome]:
    """Outcomes of recordings that are worked on together; each has the error and the warnings of all."""
    rows: list[list[Row]] = [[] for _ in recordings]
    error = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            rows = task.rows(recordings)
        except Exception as failure:
            error = _message(failure)
    return [_Outcome(own, error, [str(w.message) for w in caught]) for own in rows]


def _whole_rows(log: Log, outcome: _Outcome) -> list[Row]:
    common: Row = {**log.entry, "status": "ok" if outcome.error is None else "failed", "error": outcome.error}
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
    whole = [{**common, **own, "warnings": [*outcome.warned, *own.get("warnings", ())]} for own in outcome.rows or [{}]]
    return [{name: _storable(value) for name, value in row.items()} for row in whole]


def _storable(value: Any) -> Any:
    """Text, alone or in lists, as valid UTF-8: names of sensors come from logs unchecked."""
    if isinstance(value, str):
        return as_text(value)
    texts = isinstance(value, list | tuple) and any(isinstance(entry, str) for entry in value[:1])
    return [_storable(entry) for entry in value] if texts else value


def _message(error: Exception) -> str:
    """Message of an error in one line, with its type where it is a defect and not bad input."""
    words = " ".join(str(error).split())
    known = isinstance(error, ValueError | TypeError | OSError | ImportError)
    return words if known and words else f"{type(error).__name__}: {words}"
