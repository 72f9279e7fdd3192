"""Which logs a process is at, written down before it reads them, and an end to it where that takes too long.

A damaged log may end the process that reads it, within a library in C and without an exception, or never let it go.
What is written down survives: the next start, or a process that watches this one, knows which log it was.
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
_TWICE = 2  # a single time, the process may have been ended from outside
_OVER = b"Timeout ("  # what faulthandler writes where the time is over
_watches: weakref.WeakSet[Watch] = weakref.WeakSet()

Place = Mapping[str, Any]  # of a log: the columns log, path, size and modified of its rows


class Watch:
    """Of one process, and of those that it hands this to.

    Args:
        folder: Where the notes go.
        timeout: Seconds that a log may take to be read, and again to be worked on; then the process ends. None for any.
    """

    def __init__(self, folder: Path, timeout: float | None = None) -> None:
        self.folder = folder
        self.timeout = timeout
        self._file: BinaryIO | None = None
        self._owner = 0

    def begin(self, logs: Sequence[Place]) -> None:
        """Note that these are worked on."""
        if not logs:
            return
        file = self._own_file()
        file.truncate(0)
        file.seek(0)
        file.write(json.dumps({"pid": os.getpid(), "timeout": self.timeout, "logs": list(logs)}).encode() + b"\n")
        if self.timeout:
            # Of C, with no need of the interpreter: a loop within a library may never let go of it.
            limit = min(self.timeout * len(logs), threading.TIMEOUT_MAX)
            faulthandler.dump_traceback_later(limit, exit=True, file=file)

    def end(self) -> None:
        """Note that they are done."""
        if self._file is None or self._owner != os.getpid():
            return
        if self.timeout:
            faulthandler.cancel_dump_traceback_later()
        self._file.truncate(0)

    def close(self) -> None:
        """Leave no note behind."""
        if self._file is None or self._owner != os.getpid():
            return
        self.end()
        self._file.close()
        _remove(Path(self._file.name))
        self._file = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None}

    def _own_file(self) -> BinaryIO:
        """A file of this process alone: that of the one it was forked from is not touched."""
        if self._file is None or self._owner != os.getpid():
            name = draft_in(self.folder).with_suffix(_BEGUN[1:])
            self._file, self._owner = name.open("w+b", buffering=0), os.getpid()
            _watches.add(self)
        return self._file


def close_all() -> None:
    """Leave no note of this process behind: it is ended, and no log is to blame."""
    for watch in list(_watches):
        watch.close()


class Suspect(NamedTuple):
    """A log that was worked on when a process ended: its state, how often that was, and whether it is taken alone."""

    size: int | None
    modified: int | None
    ended: int
    alone: bool


class Finding(NamedTuple):
    """What a process that ended says of a log: its place, in words, and whether it is passed over."""

    place: Place
    words: str
    final: bool


def settle(folder: Path, ended: Sequence[int] | None = None) -> list[Finding]:
    """What the notes that were left behind say of their logs; they are removed.

    Args:
        folder: Where they are.
        ended: Processes that have ended by themselves; the notes of others, which were ended, say nothing. By
            default all do, and how they ended is not known.
    """
    known = suspects_in(folder)
    found: list[Finding] = []
    for note in sorted(folder.glob(_BEGUN)):
        try:
            first, _, rest = note.read_bytes().partition(b"\n")
            said = json.loads(first)
            process, timeout, places = said["pid"], said["timeout"], list(said["logs"])
        except (OSError, ValueError, KeyError, TypeError):  # empty: it was at no log
            places = []
        _remove(note)
        if not places or (ended is not None and process not in ended):
            continue
        late = _OVER in rest
        sure = late or ended is not None
        for place in places:
            log, state = identity_in(place), (place["size"], place["modified"])
            before = known.pop(log, None)
            times = 1 + (before.ended if before is not None and before[:2] == state else 0)
            if len(places) > 1:
                # Which of them it was is not known. Alone they may differ in the last digit: not without a reason.
                apart = sure or times >= _TWICE
                known[log] = Suspect(*state, 0 if apart else times, apart)
                words = "was worked on with others when their process ended"
                found.append(Finding(place, f"{words}; tried again{' alone' if apart else ''} after the others", False))
            elif late:
                words = (
                    f"took longer than {timeout:g} s; --timeout (`timeout`) gives more, with --retry it is tried again"
                )
                found.append(Finding(place, words, True))
            elif times >= _TWICE:
                words = "ended the process that read it, twice; it is damaged, or too large for the memory"
                found.append(Finding(place, f"{words} (--retry tries it again)", True))
            else:
                known[log] = Suspect(*state, times, before is not None and before.alone)
                found.append(Finding(place, "ended the process that read it; tried again after the others", False))
    if found:
        draft = draft_in(folder)
        draft.write_text(json.dumps(known), encoding="utf-8")
        draft.replace(folder / _SUSPECTS)
    return found


def suspects_in(folder: Path) -> dict[str, Suspect]:
    """Logs that a process ended at, by identity; none where that cannot be read: they get their chances anew."""
    try:
        known = json.loads((folder / _SUSPECTS).read_bytes())
        return {log: Suspect(*entries) for log, entries in known.items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def forget(folder: Path) -> None:
    """Remove all notes, of processes that were ended from outside."""
    for note in folder.glob(_BEGUN):
        _remove(note)


def _remove(note: Path) -> None:
    with suppress(OSError):  # Windows removes no file of a process that lives
        note.unlink()
