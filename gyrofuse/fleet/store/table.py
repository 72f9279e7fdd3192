"""Parquet tables of a fleet: columns, and rows, which are read with the checksum of each page verified."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gyrofuse._base import __version__
from gyrofuse.fleet.logs import as_text
from gyrofuse.fleet.store.sealed import read_sealed
from gyrofuse.io.streams import not_installed

if TYPE_CHECKING:
    import pyarrow
    from pyarrow import parquet


class Column(NamedTuple):
    """Type of a column (`"text"`, `"number"`, `"whole"`, `"truth"`, `"texts"` or `"numbers"`) and its meaning."""

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
    "missing": Column("number", "largest fraction of missing samples over the sensors, 0 to 1"),
    "notes": Column("texts", "what was found on reading: gaps, repeats, jitter, offsets"),
    "warnings": Column("texts", "what the task warned of"),
}
_SETTINGS = b"gyrofuse"
# Most logs in a table that is written at once, a row group of the file: a damaged page costs no more than these.
_MAX_LOGS = 1000


def read_results(path: str | Path, *, without: Sequence[str] = ()) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Settings and rows of a table of a fleet.

    Args:
        path: The table.
        without: Names of columns that are left out.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a table of a fleet, or a damaged one.
        ImportError: pyarrow is not installed.
    """
    need_arrow(Path(path))
    import pyarrow as pa

    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: no such file; check the name and the folder")
    settings = settings_of(Path(path))
    if settings is None:
        raise ValueError(f"{path}: expected a table that `gyrofuse fleet` wrote, found another file or a damaged one")
    try:
        with opened(path) as file:
            return settings, file.read([name for name in file.schema_arrow.names if name not in without]).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise ValueError(
            f"{path}: is damaged ({error}); run the command that wrote it again, which does again what is lost"
        ) from None


def identity_in(row: Mapping[str, Any]) -> str:
    """Identity of the log of a row: its path, or its name where it is not a file."""
    return str(row.get("path") or row["log"])


def schema_of(columns: Mapping[str, Column], settings: Mapping[str, Any]) -> pyarrow.Schema:
    """Schema of a table, with the settings and the descriptions of the columns as metadata."""
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
        for name, column in columns.items()
    ]
    return pa.schema(fields, metadata={_SETTINGS: json.dumps(settings), b"gyrofuse_version": __version__})


def settings_of(source: Path | bytes) -> dict[str, Any] | None:
    """Settings in the metadata of a table or of its content; None where there are none."""
    import pyarrow as pa

    try:
        with opened(source) as file:
            settings = json.loads((file.schema_arrow.metadata or {})[_SETTINGS])
    except (OSError, KeyError, ValueError, pa.ArrowException):
        return None
    return settings if isinstance(settings, dict) else None


def opened(source: str | Path | bytes) -> parquet.ParquetFile:
    """A table or its content, opened so that reading verifies the checksums of its pages."""
    import pyarrow as pa
    from pyarrow import parquet

    file = pa.BufferReader(source) if isinstance(source, bytes) else source
    return parquet.ParquetFile(file, page_checksum_verification=True)


def content_of(table: pyarrow.Table) -> pyarrow.Buffer:
    """Content of a Parquet file with this table."""
    import pyarrow as pa
    from pyarrow import parquet

    sink = pa.BufferOutputStream()
    parquet.write_table(table, sink, write_page_checksum=True)
    return sink.getvalue()


def sound_rows(
    path: Path, schema: pyarrow.Schema, *, sealed: bool, columns: Sequence[str] | None = None
) -> tuple[pyarrow.Table, bool]:
    """Undamaged rows of a file, and whether these are all of its rows.

    Args:
        path: The file.
        schema: Schema of the file.
        sealed: Whether the file's name is a digest of its content; otherwise a row group with a damaged page is lost.
        columns: Columns to read; all by default.
    """
    import pyarrow as pa

    asked = schema if columns is None else pa.schema([schema.field(name) for name in columns])
    source = read_sealed(path) if sealed else path
    if source is None:
        return asked.empty_table(), False
    read = asked if sealed else schema  # a digest covers all columns, a checksum one page
    try:
        with opened(source) as file:
            groups = [_row_group(file, i, read) for i in range(file.num_row_groups)]
    except (pa.ArrowException, OSError):
        return asked.empty_table(), False
    sound = [group.select(asked.names) for group in groups if group is not None]
    return pa.concat_tables([asked.empty_table(), *sound]), len(sound) == len(groups)


def _row_group(file: parquet.ParquetFile, i: int, schema: pyarrow.Schema) -> pyarrow.Table | None:
    import pyarrow as pa

    try:
        return file.read_row_group(i, schema.names).cast(schema)
    except (pa.ArrowException, OSError, ValueError):
        return None


def in_order(
    logs: Sequence[str],
    source: Mapping[str, Path],
    schema: pyarrow.Schema,
    table: Path,
    *,
    max_open: int = 4,
    max_bytes: int = 2**26,
) -> Iterator[pyarrow.Table]:
    """Rows of logs in their order, in tables of a size that does not depend on the files that they come from.

    Args:
        logs: Identities of the logs.
        source: File with the rows of each log.
        schema: Schema of the rows.
        table: The one file that is not named after a digest of its content.
        max_open: Files kept in memory; logs in order are mostly in one file, or in those of as many processes.
        max_bytes: Size of a table, 64 MiB, which bounds the memory of writer and reader.

    Raises:
        OSError: A file no longer holds what it held.
    """
    import pyarrow as pa

    kept, n_bytes = [schema.empty_table()], 0
    files: dict[Path, tuple[pyarrow.Table, dict[str, list[int]]]] = {}
    for log in logs:
        path = source[log]
        if path not in files:
            if len(files) == max_open:
                del files[next(iter(files))]
            own, _ = sound_rows(path, schema, sealed=path != table)
            places: dict[str, list[int]] = {}
            for i, row in enumerate(own.select(["log", "path"]).to_pylist()):
                places.setdefault(identity_in(row), []).append(i)
            files[path] = own, places
        own, places = files[path]
        if log not in places:
            raise OSError(f"{path} was damaged a moment ago")
        rows = own.take(places[log])
        kept.append(rows)
        n_bytes += rows.nbytes
        if len(kept) > _MAX_LOGS or n_bytes > max_bytes:
            yield pa.concat_tables(kept).combine_chunks()
            kept, n_bytes = [schema.empty_table()], 0
    if len(kept) > 1:
        yield pa.concat_tables(kept).combine_chunks()


def fitting_rows(
    rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Column], schema: pyarrow.Schema
) -> pyarrow.Table:
    """Rows as a table; a log whose rows do not fit the schema gets one row that says so."""
    import pyarrow as pa

    whole = [{name: row.get(name) for name in columns} for row in rows]
    try:
        return pa.Table.from_pylist(whole, schema=schema)
    except _unfit():
        own: dict[str, list[dict[str, Any]]] = {}
        for row in whole:
            own.setdefault(identity_in(row), []).append(row)
        return pa.concat_tables([_rows_of_one(of_one, schema) for of_one in own.values()])


def _rows_of_one(rows: list[dict[str, Any]], schema: pyarrow.Schema) -> pyarrow.Table:
    import pyarrow as pa

    try:
        return pa.Table.from_pylist(rows, schema=schema)
    except _unfit() as error:
        log, path = (None if rows[0][name] is None else as_text(str(rows[0][name])) for name in ("log", "path"))
        state = {name: rows[0][name] for name in ("size", "modified")}
        words = as_text(f"its rows do not fit the table ({' '.join(str(error).split())})")
        stand_in = {"log": log, "path": path, **state, "status": "failed", "error": words}
        return pa.Table.from_pylist([stand_in], schema=schema)


def _unfit() -> tuple[type[Exception], ...]:
    """Exceptions of pyarrow for values that are not of the type of their column."""
    import pyarrow as pa

    return pa.ArrowException, ValueError, TypeError, OverflowError


def need_arrow(path: Path) -> None:
    """Raise `ImportError` if pyarrow is not installed."""
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise not_installed(path, "writing Parquet", "pyarrow") from error
