"""A Parquet table that is written group by group, and can be resumed wherever the writing was stopped.

The rows of a group are written at once, as a small Parquet file (a part) in a folder beside the table; when all groups
are done the parts are merged into the table. A part is named after a digest of its content, which shows damage.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gyrofuse._base.files import creating, sync_file, sync_folder
from gyrofuse.fleet.logs import State, state_of
from gyrofuse.fleet.store.lock import hold, release
from gyrofuse.fleet.store.sealed import DRAFTS, draft_in, read_sealed, write_sealed
from gyrofuse.fleet.store.table import (
    COMMON,
    Column,
    content_of,
    fitting_rows,
    identity_in,
    in_order,
    need_arrow,
    opened,
    schema_of,
    settings_of,
    sound_rows,
)
from gyrofuse.fleet.watchdog import CrashReport, Suspect, forget, settle, suspects_in

if TYPE_CHECKING:
    import pyarrow

_HEAD = ".head"  # suffix of a part without rows, which holds the settings before there are others
_LOCK = "lock"
_NO_TABLE = "no table of a fleet"
_MAGIC = b"PAR1"  # first bytes of a Parquet file
_KEY = ["log", "path", "size", "modified", "status"]  # columns that identify a log and its state


class _Source(NamedTuple):
    """File with the rows of a log, its time in ns since 1970, and whether the log is unchanged and could be used."""

    path: Path
    written: int
    current: bool
    worked: bool


class ResultStore:
    """Writer of the table of a fleet.

    Args:
        path: The table, `.parquet`.
        columns: Columns of the task, in addition to those of all tasks; descriptions become metadata of the fields.
        settings: Settings that the rows depend on: a table is resumed only with the same.

    Attributes:
        passed_over: Identities of logs that the last `open` or `settle` passed over; their rows hold the reason.

    Raises:
        ImportError: pyarrow is not installed.
    """

    def __init__(self, path: str | Path, columns: Mapping[str, Column], settings: Mapping[str, Any]) -> None:
        need_arrow(Path(path))
        self.path = Path(path)
        self.parts = self.path.with_name(f".{self.path.name}.parts")
        self.passed_over: frozenset[str] = frozenset()
        self._columns = {**COMMON, **columns}
        self._settings = json.loads(json.dumps(settings))  # as they are read back
        self._held = False  # by this process, or by the one that this store was handed on from
        self._warned: set[Path] = set()  # damaged files that a warning has named

    def open(self, *, force: bool = False) -> None:
        """Open for writing, and lock for this run.

        A log that crashed two processes, or took too long, gets a row that says so.

        Args:
            force: Whether a table or parts of other settings are replaced; another file never is.

        Raises:
            BlockingIOError: Another run is at work on it.
            FileExistsError: The existing file has other settings, or is no table of a fleet.
            FileNotFoundError: The folder does not exist.
            OSError: It cannot be written to.
            ValueError: It is a folder.
        """
        if self.path.is_dir():
            raise ValueError(f"{self.path}: expected the name of a file, found a folder; choose another name")
        if not self.path.resolve().parent.is_dir():
            raise FileNotFoundError(f"{self.path}: the folder {self.path.parent} does not exist; create it first")
        self._others(force)  # before anything is made
        with creating(self.path):
            self.parts.mkdir(exist_ok=True)
        if not self._held:
            hold(self.parts / _LOCK, self.path)
            self._held = True
        for file in self._others(force):
            file.unlink()
        for draft in self.parts.glob(DRAFTS):  # of a process that was killed
            draft.unlink(missing_ok=True)
        if not any(self.parts.glob(f"*{_HEAD}")):
            self._write(_HEAD, [])
        self.settle()

    def close(self) -> None:
        """Release the lock; `finish` does so as well."""
        release(self.parts / _LOCK)
        self._held = False

    def settle(self, ended: Sequence[int] | None = None) -> list[CrashReport]:
        """Reports on the logs at which processes crashed; logs that are passed over get their rows.

        Args:
            ended: Identifiers of the processes that crashed, where they are known.
        """
        found = settle(self.parts, ended)
        for finding in found:
            if finding.final:
                self.write([{**finding.entry, "status": "failed", "error": finding.words}])
        self.passed_over = frozenset(identity_in(finding.entry) for finding in found if finding.final)
        return found

    @property
    def suspects(self) -> dict[str, Suspect]:
        """Logs at which a process crashed, by identity; they are worked on last."""
        return suspects_in(self.parts)

    def forget(self) -> None:
        """Discard the journals of processes that were ended from outside."""
        forget(self.parts)

    def holds(self, columns: Mapping[str, Column], settings: Mapping[str, Any]) -> bool:
        """Whether the table has these columns and settings.

        Args:
            columns: Columns of a task.
            settings: Settings of a task; the table may have settings of reading in addition.
        """
        asked = json.loads(json.dumps(settings))
        return self._columns == {**COMMON, **columns} and asked.items() <= self._settings.items()

    def write(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write all rows of some logs, at once or not at all.

        A log whose rows do not fit the columns gets one that says so.

        Args:
            rows: Rows, by column.

        Raises:
            OSError: They cannot be written.
        """
        if rows:
            self._write(".parquet", rows)

    def done(self, *, failed: bool = True, since: int = 0) -> frozenset[str]:
        """Identities of the logs whose rows are written; a damaged part does not count and is removed, with a warning.

        A log that has changed since, in size or time, is not done; a log that no longer exists stays done.

        Args:
            failed: Whether failed logs count as done.
            since: Earliest time at which the rows of failed logs count, ns since 1970.
        """
        return frozenset(
            log
            for log, own in self._sources()[0].items()
            if own.current and (own.worked or (failed and own.written >= since))
        )

    @property
    def opened(self) -> int:
        """Time of opening by the clock of the disk, ns since 1970."""
        return (self.parts / _LOCK).stat().st_mtime_ns

    @property
    def n_parts(self) -> int:
        """Number of groups of logs whose rows are written and not yet in the table."""
        try:
            return sum(name.endswith(".parquet") for name in os.listdir(self.parts))
        except FileNotFoundError:
            return 0

    def finish(self, order: Sequence[str]) -> int:
        """Merge the parts into the table, in the order of the logs, and remove them.

        Args:
            order: Identities of logs; other logs of the table stay before them.

        Returns:
            Number of rows.

        Raises:
            OSError: A part is damaged, or the table cannot be written.
        """
        from pyarrow import parquet

        found, damaged = self._sources()
        if any(path != self.path for path in damaged):
            raise OSError(f"{self.path}: parts of it were damaged; what is sound is kept, start again to go on")
        last = set(order)
        logs = [*(log for log in found if log not in last), *(log for log in order if log in found)]
        missing = [log for log in last if log not in found]
        if missing:
            warnings.warn(
                f"{self.path}: has no rows of {len(missing)} of {len(last)} logs; start again to go on", stacklevel=2
            )
        source = {log: own.path for log, own in found.items()}
        draft = draft_in(self.parts if self.parts.is_dir() else self.path.parent)
        n_rows = 0
        try:
            with parquet.ParquetWriter(draft, self._schema(), write_page_checksum=True) as writer:
                for table in in_order(logs, source, self._schema(), self.path):
                    writer.write_table(table)
                    n_rows += table.num_rows
            sync_file(draft)
            if damaged:
                self.path.replace(self._kept)
            draft.replace(self.path)
            sync_folder(self.path.resolve().parent)
        except OSError as error:
            raise type(error)(
                f"{self.path}: cannot be written ({error}); what is finished is kept, go on later"
            ) from error
        finally:
            draft.unlink(missing_ok=True)
        shutil.rmtree(self.parts, ignore_errors=True)
        self.close()
        return n_rows

    @property
    def _kept(self) -> Path:
        return self.path.with_name(f"{self.path.name}.damaged")

    def _sources(self) -> tuple[dict[str, _Source], list[Path]]:
        """File with the rows of each log, and damaged files.

        Rows of an unchanged log have priority, then rows that worked over failed ones, then later rows.
        """
        found: dict[str, _Source] = {}
        states: dict[str, State] = {}
        damaged: list[Path] = []
        for written, path in self._files():
            rows, whole = sound_rows(path, self._schema(), sealed=path != self.path, columns=_KEY)
            if not whole:
                damaged.append(path)
            for row in rows.to_pylist():
                log = identity_in(row)
                if log not in states:
                    states[log] = state_of(log) if row.get("path") else State()
                current = states[log].size is None or states[log] == (row["size"], row["modified"])
                own = _Source(path, written, current, row["status"] == "ok")
                if log not in found or own[2:] >= found[log][2:]:
                    found[log] = own
        self._drop(damaged)
        return found, damaged

    def _files(self) -> list[tuple[int, Path]]:
        """All files with rows and the times of writing: the table, and parts in the order of these times."""
        parts = sorted((part.stat().st_mtime_ns, part) for part in self.parts.glob("*.parquet"))
        return [*([(self.path.stat().st_mtime_ns, self.path)] if self.path.exists() else []), *parts]

    def _drop(self, damaged: Sequence[Path]) -> None:
        new = [path for path in damaged if path not in self._warned]
        self._warned.update(new)
        parts = [path for path in new if path != self.path]
        for path in parts:
            path.unlink(missing_ok=True)
        again = "by a power loss or a bad disk; the logs in it are done again"
        if parts:
            warnings.warn(f"{self.path}: {len(parts)} of its parts damaged, {again}", stacklevel=4)
        if len(parts) < len(new):
            warnings.warn(f"{self.path}: damaged, {again}, and it is kept as {self._kept}", stacklevel=4)

    def _others(self, force: bool) -> list[Path]:
        """Files of other settings or columns, and damaged heads, which are to be removed.

        Raises:
            FileExistsError: There are files that may not be replaced.
        """
        heads, parts = list(self.parts.glob(f"*{_HEAD}")), list(self.parts.glob("*.parquet"))
        first = next((content for part in [*heads, *parts] if (content := read_sealed(part)) is not None), None)
        table = self._difference_to(self.path) if self.path.exists() else None
        if table == _NO_TABLE:  # a log, perhaps
            with self.path.open("rb") as file:
                damaged = ", or a damaged one" if file.read(len(_MAGIC)) == _MAGIC else ""
            raise FileExistsError(f"{self.path}: is {_NO_TABLE}{damaged}; choose another name")
        differs = table or (None if first is None else self._difference_to(first))
        if differs is None:
            return [head for head in heads if read_sealed(head) is None]
        if not force:
            raise FileExistsError(
                f"{self.path}: is {differs}; choose another name, or replace it with --force (`force`)"
            )
        return [*heads, *parts, *([self.path] if table else [])]

    def _difference_to(self, source: Path | bytes) -> str | None:
        """Difference of a table or a part from these settings and columns, in words; None without one."""
        found = settings_of(source)
        if found is None:
            return _NO_TABLE
        if found != self._settings:
            return f"of other settings ({_difference(found, self._settings)})"
        with opened(source) as file:
            same = file.schema_arrow.names == list(self._columns)
        return None if same else "of other columns, written by another version"

    def _schema(self) -> pyarrow.Schema:
        return schema_of(self._columns, self._settings)

    def _write(self, suffix: str, rows: Sequence[Mapping[str, Any]]) -> None:
        import pyarrow as pa

        try:
            write_sealed(self.parts, suffix, content_of(fitting_rows(rows, self._columns, self._schema())))
        except (OSError, pa.ArrowException) as error:
            kind = type(error) if isinstance(error, OSError) else OSError
            logs = list(dict.fromkeys(str(row["log"]) for row in rows))
            whose = f"rows of {logs[0]}{f' and {len(logs) - 1} more' if len(logs) > 1 else ''}" if rows else "it"
            raise kind(
                f"{self.path}: {whose} cannot be written ({error}); what is finished is kept, go on later"
            ) from error


def _difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    names = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    return ", ".join(f"{name} {one.get(name)!r} instead of {other.get(name)!r}" for name in names)
