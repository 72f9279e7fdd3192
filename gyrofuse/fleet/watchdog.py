"""Journal of the logs that a process works on, and a watchdog that ends the process at a timeout.

A damaged log may crash the process that reads it, in a C library and without an exception, or hang it. The journal,
written before a log is read, survives: the next start, or the parent process, knows which log it was.
"""

from __future__ import annotations

import faulthandler
import json
import os
import threading
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from gyrofuse.fleet.store.sealed import draft_in
from gyrofuse.fleet.store.table import identity_in

_BEGUN = "*.begun"
_SUSPECTS = "suspects"
_MAX_CRASHES = 2  # after which a log is passed over; a single crash may be an end from outside, such as of memory
_TIMEOUT_MARK = b"Timeout ("  # first words of what faulthandler writes at the timeout
_watchdogs: weakref.WeakSet[Watchdog] = weakref.WeakSet()

LogEntry = Mapping[str, Any]  # columns log, path, size and modified of the rows of a log


class Watchdog:
    """Journal and watchdog of a process, and of each process that it is handed to.

    Args:
        folder: Folder of the journals.
        timeout: Seconds that a log may take to be read, and again to be worked on, after which the process ends; None
            for no limit.
    """

    def __init__(self, folder: Path, timeout: float | None = None) -> None:
        self.folder = folder
        self.timeout = timeout
        self._file: BinaryIO | None = None
        self._owner = 0

    def begin(self, logs: Sequence[LogEntry]) -> None:
        """Record that work on some logs begins, and start the timeout."""
        if not logs:
            return
        file = self._own_file()
        file.truncate(0)
        file.seek(0)
        file.write(json.dumps({"pid": os.getpid(), "timeout": self.timeout, "logs": list(logs)}).encode() + b"\n")
        if self.timeout:
            # A thread in C, which needs no interpreter lock: a hanging library may never release it.
            limit = min(self.timeout * len(logs), threading.TIMEOUT_MAX)
            faulthandler.dump_traceback_later(limit, exit=True, file=file)

    def end(self) -> None:
        """Record that the work is done, and stop the timeout."""
        if self._file is None or self._owner != os.getpid():
            return
        if self.timeout:
            faulthandler.cancel_dump_traceback_later()
        self._file.truncate(0)

    def close(self) -> None:
        """Remove the journal."""
        if self._file is None or self._owner != os.getpid():
            return
        self.end()
        self._file.close()
        _remove(Path(self._file.name))
        self._file = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None}

    def _own_file(self) -> BinaryIO:
        """Journal of this process; that of the process it was forked from is not touched."""
        if self._file is None or self._owner != os.getpid():
            name = draft_in(self.folder).with_suffix(_BEGUN[1:])
            self._file, self._owner = name.open("w+b", buffering=0), os.getpid()
            _watchdogs.add(self)
        return self._file


def close_all() -> None:
    """Remove the journals of this process, which ends for a reason that is no log."""
    for watchdog in list(_watchdogs):
        watchdog.close()


class Suspect(NamedTuple):
    """A log at which a process crashed: its size and time, the number of crashes, and whether it is now taken alone."""

    size: int | None
    modified: int | None
    n_crashes: int
    alone: bool


class CrashReport(NamedTuple):
    """A log at which a process crashed or hung: its entry, a sentence, and whether it is passed over from now on."""

    entry: LogEntry
    words: str
    final: bool


def settle(folder: Path, ended: Sequence[int] | None = None) -> list[CrashReport]:
    """Evaluate the journals that crashed processes have left, and remove them.

    Args:
        folder: Folder of the journals.
        ended: Identifiers of the processes that crashed; the journals of others, which were ended from outside, do not
            count. By default all count, and the cause of each end is unknown.
    """
    known = suspects_in(folder)
    found: list[CrashReport] = []
    for note in sorted(folder.glob(_BEGUN)):
        try:
            first, _, rest = note.read_bytes().partition(b"\n")
            journal = json.loads(first)
            process, timeout, logs = journal["pid"], journal["timeout"], list(journal["logs"])
        except (OSError, ValueError, KeyError, TypeError):  # empty: no work was going on
            logs = []
        _remove(note)
        if not logs or (ended is not None and process not in ended):
            continue
        late = _TIMEOUT_MARK in rest
        sure = late or ended is not None
        for entry in logs:
            log, state = identity_in(entry), (entry["size"], entry["modified"])
            before = known.pop(log, None)
            times = 1 + (before.n_crashes if before is not None and before[:2] == state else 0)
            if len(logs) > 1:
                # Which of them it was is not known. Results alone may differ in the last digit from those in a batch,
                # so that logs are taken alone only if the crash is certain or repeated.
                apart = sure or times >= _MAX_CRASHES
                known[log] = Suspect(*state, 0 if apart else times, apart)
                again = "tried again alone" if apart else "tried again"
                words = f"was worked on with others when their process ended; {again} after the others"
                found.append(CrashReport(entry, words, False))
            elif late:
                words = (
                    f"took longer than {timeout:g} s; --timeout (`timeout`) gives more, with --retry it is tried again"
                )
                found.append(CrashReport(entry, words, True))
            elif times >= _MAX_CRASHES:
                words = "ended the process that read it, twice; it is damaged, or too large for the memory"
                found.append(CrashReport(entry, f"{words} (--retry tries it again)", True))
            else:
                known[log] = Suspect(*state, times, before is not None and before.alone)
                found.append(CrashReport(entry, "ended the process that read it; tried again after the others", False))
    if found:
        draft = draft_in(folder)
        draft.write_text(json.dumps(known), encoding="utf-8")
        draft.replace(folder / _SUSPECTS)
    return found


def suspects_in(folder: Path) -> dict[str, Suspect]:
    """Logs at which a process crashed, by identity; none where the file cannot be read, and all are tried again."""
    try:
        known = json.loads((folder / _SUSPECTS).read_bytes())
        return {log: Suspect(*entries) for log, entries in known.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def forget(folder: Path) -> None:
    """Remove all journals, of processes that were ended from outside."""
    for note in folder.glob(_BEGUN):
        _remove(note)


def _remove(note: Path) -> None:
    with suppress(OSError):  # Windows removes no file of a process that lives
        note.unlink()
