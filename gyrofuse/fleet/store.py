"""A Parquet file that fills up group by group and can be gone on with, wherever its writing was stopped.

Rows of a group appear together, as one small Parquet file in a folder beside the table; when all are there they become
the table. A file of a group is named after its logs: whoever writes it again writes the same.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gyrofuse._version import __version__
from gyrofuse.fleet.logs import State, state_of

if TYPE_CHECKING:
    import pyarrow


class Column(NamedTuple):
    """What a column holds: `"text"`, `"number"`, `"whole"` numbers, `"truth"` values, `"texts"` or `"numbers"`."""

    kind: str
    description: str


COMMON = {
    "log": Column("text", "the log as it was named"),
    "path": Column("text", "its absolute path, by which it is known again"),
    "size": Column("whole", "of the log in bytes, when it was read"),
    "modified": Column("whole", "when it was last changed before, ns since 1970"),
    "status": Column("text", "ok or failed"),
    "error": Column("text", "why it failed"),
    "sensors": Column("texts", "names of the sensors"),
    "n_samples": Column("whole", "samples of each sensor, missing ones included"),
    "rate": Column("number", "sampling rate in Hz"),
    "unit": Column("text", "of the signal"),
    "missing": Column("number", "share of its samples that the sensor lacks that lacks most, 0 to 1"),
    "notes": Column("texts", "what was found on reading: gaps, repeats, jitter, offsets"),
    "warnings": Column("texts", "what the task warned of"),
}
_SETTINGS = b"gyrofuse"
_HEAD = "head"  # among the parts: a table of no rows
_NO_TABLE = "no table of a fleet"
_MOST_OPEN = 4  # files in memory while the table is made
_MOST_LOGS, _MOST_BYTES = 1000, 2**26  # in a row group of it


class _Source(NamedTuple):
    """Where rows of a log are, whether they are of the log as it is now, and whether it could be used."""

    path: Path
    current: bool
    worked: bool


class ResultStore:
    """Where rows go.

    Args:
        path: The table, `.parquet`.
        columns: Of the task, by name, beside those that all tasks have; descriptions become metadata of the fields.
        settings: What the rows depend on: only a run of the same goes on with what is there.

    Raises:
        ImportError: pyarrow is not installed.
    """

    def __init__(self, path: str | Path, columns: Mapping[str, Column], settings: Mapping[str, Any]) -> None:
        _arrow(Path(path))
        self.path = Path(path)
        self.parts = self.path.with_name(f".{self.path.name}.parts")
        self._columns = {**COMMON, **columns}
        self._settings = json.loads(json.dumps(settings))  # as they are read back

    def open(self, *, force: bool = False) -> None:
        """Make ready for writing.

        Args:
            force: Whether a table or parts of other settings are replaced; another file never is.

        Raises:
            FileExistsError: What is there is of other settings, or no table of a fleet.
            FileNotFoundError: The folder does not exist.
            OSError: It cannot be written to.
            ValueError: It is a folder.
        """
        from pyarrow import parquet

        if self.path.is_dir():
            raise ValueError(f"{self.path}: expected the name of a file, found a folder; choose another name")
        for file in (self.path, self.parts / _HEAD):
            differs = self._difference_to(file) if file.exists() else None
            if differs is None:
                continue
            if file == self.path and differs == _NO_TABLE:  # a log, perhaps
                raise FileExistsError(f"{file}: is {differs}; choose another name")
            if not force:
                raise FileExistsError(
                    f"{file}: is {differs}; choose another name, or replace it with --force (`force`)"
                )
            file.unlink()
            shutil.rmtree(self.parts, ignore_errors=True)
        if not self.path.resolve().parent.is_dir():
            raise FileNotFoundError(f"{self.path}: the folder {self.path.parent} does not exist; create it first")
        self.parts.mkdir(exist_ok=True)
        for draft in self.parts.glob("*.draft"):  # of a process that was killed
            draft.unlink(missing_ok=True)
        self._place(self.parts / _HEAD, lambda draft: parquet.write_table(self._table([]), draft))

    def holds(self, columns: Mapping[str, Column], settings: Mapping[str, Any]) -> bool:
        """Whether it is for rows of these columns and settings; settings of reading may be there beside them."""
        asked = json.loads(json.dumps(settings))
        return self._columns == {**COMMON, **columns} and asked.items() <= self._settings.items()

    def write(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Add all rows of some logs, at once or not at all."""
        from pyarrow import parquet

        if not rows:
            return
        logs = "\n".join(dict.fromkeys(map(identity_in, rows)))
        name = hashlib.sha256(logs.encode()).hexdigest()[:32]
        table = self._table(rows)
        self._place(self.parts / f"{name}.parquet", lambda draft: parquet.write_table(table, draft))

    def done(self, *, failed: bool = True) -> frozenset[str]:
        """Identities of the logs whose rows are there; a part that cannot be read does not count and is removed.

        A log that has changed since, in size or time, is not done; one that is no longer there stays so.

        Args:
            failed: Whether those that failed count as done.
        """
        return frozenset(log for log, own in self._sources().items() if own.current and (failed or own.worked))

    @property
    def n_parts(self) -> int:
        """Groups of logs whose rows are there and not yet in the table."""
        return sum(1 for _ in self.parts.glob("*.parquet"))

    def finish(self, order: Sequence[str]) -> int:
        """Make the table of the rows, in the order of their logs, and remove the parts; a few parts at a time.

        Args:
            order: Identities of logs; others that the table has stay before them.

        Returns:
            Number of rows.
        """
        from pyarrow import parquet

        source = {log: own.path for log, own in self._sources().items()}
        last = set(order)
        logs = [*(log for log in source if log not in last), *(log for log in order if log in source)]
        n_rows = 0

        def write(draft: Path) -> None:
            nonlocal n_rows
            with parquet.ParquetWriter(draft, self._schema()) as writer:
                for table in _in_order(logs, source, self._table([])):
                    writer.write_table(table)
                    n_rows += table.num_rows

        self._place(self.path, write)
        shutil.rmtree(self.parts, ignore_errors=True)
        return n_rows

    def _sources(self) -> dict[str, _Source]:
        """Of each log: rows of it as it is now first, then what worked before what failed, a part before the table."""
        found: dict[str, _Source] = {}
        states: dict[str, State] = {}
        for path in [*([self.path] if self.path.exists() else []), *sorted(self.parts.glob("*.parquet"))]:
            for row in self._logs_in(path):
                log = identity_in(row)
                if log not in states:
                    states[log] = state_of(log) if row.get("path") else State()
                current = states[log].size is None or states[log] == (row["size"], row["modified"])
                own = _Source(path, current, row["status"] == "ok")
                if log not in found or own[1:] >= found[log][1:]:
                    found[log] = own
        return found

    def _logs_in(self, path: Path) -> list[dict[str, Any]]:
        """What tells a log, of every row; none of a part that a machine has cut short: it is removed and done again."""
        import pyarrow as pa

        try:
            return _read_file(path, ["log", "path", "size", "modified", "status"]).to_pylist()
        except (pa.ArrowException, OSError):
            if path == self.path:
                raise
            path.unlink(missing_ok=True)
            return []

    def _difference_to(self, file: Path) -> str | None:
        """What tells a table, or what its parts begin with, from one of these settings and columns."""
        from pyarrow import parquet

        found = _settings_of(file)
        if found is None:
            return _NO_TABLE
        if found != self._settings:
            return f"of other settings ({_difference(found, self._settings)})"
        if parquet.read_schema(file).names != list(self._columns):
            return "of other columns, written by another version"
        return None

    def _table(self, rows: Sequence[Mapping[str, Any]]) -> pyarrow.Table:
        import pyarrow as pa

        rows = [{name: row.get(name) for name in self._columns} for row in rows]
        return pa.Table.from_pylist(rows, schema=self._schema())

    def _schema(self) -> pyarrow.Schema:
        import pyarrow as pa

        kinds = {
            "text": pa.string(),
            "texts": pa.list_(pa.string()),
            "number": pa.float64(),
            "numbers": pa.list_(pa.float64()),
            "whole": pa.int64(),
            "truth": pa.bool_(),
        }
        fields = [
            pa.field(name, kinds[column.kind], metadata={"description": column.description})
            for name, column in self._columns.items()
        ]
        return pa.schema(fields, metadata={_SETTINGS: json.dumps(self._settings), b"gyrofuse_version": __version__})

    def _place(self, path: Path, write: Any) -> None:
        """Write under another name, then rename."""
        folder = self.parts if self.parts.is_dir() else path.parent
        draft = folder / f"{secrets.token_hex(8)}.draft"
        try:
            write(draft)
            draft.replace(path)
        except OSError as error:
            raise type(error)(f"{path}: cannot be written ({error}); what is finished is kept, go on later") from error
        finally:
            draft.unlink(missing_ok=True)


def read_results(path: str | Path, *, without: Sequence[str] = ()) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Settings and rows of a table of a fleet.

    Args:
        path: The table.
        without: Columns that are left out.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a table of a fleet.
        ImportError: pyarrow is not installed.
    """
    _arrow(Path(path))
    from pyarrow import parquet

    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: no such file; check the name and the folder")
    settings = _settings_of(Path(path))
    if settings is None:
        raise ValueError(f"{path}: expected a table that `gyrofuse fleet` wrote, found another file")
    with parquet.ParquetFile(path) as file:
        return settings, file.read([name for name in file.schema_arrow.names if name not in without]).to_pylist()


def identity_in(row: Mapping[str, Any]) -> str:
    """The log of a row; by its name alone where it is no file."""
    return str(row.get("path") or row["log"])


def _read_file(path: Path, columns: list[str] | None) -> pyarrow.Table:
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        return file.read(columns=columns)


def _in_order(logs: Sequence[str], source: Mapping[str, Path], empty: pyarrow.Table) -> Iterator[pyarrow.Table]:
    """Rows of logs in their order, in tables of a size that does not depend on the files that they come from."""
    import pyarrow as pa

    kept, n_bytes = [empty], 0
    files: dict[Path, tuple[pyarrow.Table, dict[str, list[int]]]] = {}
    for log in logs:
        path = source[log]
        if path not in files:
            if len(files) == _MOST_OPEN:
                del files[next(iter(files))]
            table = _read_file(path, None)
            places: dict[str, list[int]] = {}
            for i, row in enumerate(table.select(["log", "path"]).to_pylist()):
                places.setdefault(identity_in(row), []).append(i)
            files[path] = table, places
        table, places = files[path]
        rows = table.take(places[log])
        kept.append(rows)
        n_bytes += rows.nbytes
        if len(kept) > _MOST_LOGS or n_bytes > _MOST_BYTES:
            yield pa.concat_tables(kept).combine_chunks()
            kept, n_bytes = [empty], 0
    if len(kept) > 1:
        yield pa.concat_tables(kept).combine_chunks()


def _settings_of(path: Path) -> dict[str, Any] | None:
    """What a table says that it was made with; None where nothing is said."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        settings = json.loads((parquet.read_schema(path).metadata or {})[_SETTINGS])
    except (OSError, KeyError, ValueError, pa.ArrowException):
        return None
    return settings if isinstance(settings, dict) else None


def _difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    names = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    return ", ".join(f"{name} {one.get(name)!r} instead of {other.get(name)!r}" for name in names)


def _arrow(path: Path) -> None:
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise ImportError(f'{path}: writing Parquet needs pyarrow; pip install "gyrofuse[logs]"') from error
