"""Parquet files: columns with the names of gyros."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse.io.arrays import settings_by_group, stated_rate, stated_unit
from gyrofuse.io.column_streams import streams_from_columns
from gyrofuse.io.columns import classify_columns
from gyrofuse.io.limits import Allowance, decoded, enumerated
from gyrofuse.io.stream import Array, RecordingError, Stream, cause


def read(path: Path, *, key: str | None = None, max_bytes: float | None = None) -> list[Stream]:
    """Read the gyros of a Parquet file, whose columns are named as in a CSV file.

    `fs` (Hz) and `unit` are taken from the metadata of the schema. A null is NaN.

    Args:
        path: The file.
        key: The only column to read as a gyro, whatever its name.
        max_bytes: Memory that the columns may take; by default a quarter of what there is.

    Raises:
        RecordingError: Not a Parquet file, damaged, empty, without gyro data, or too large.
        ImportError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError(f'{path}: reading Parquet needs pyarrow; pip install "gyrofuse[logs]"') from error
    try:
        with parquet.ParquetFile(path) as file:
            schema = file.schema_arrow
            numbers = [f.name for f in schema if pa.types.is_integer(f.type) or pa.types.is_floating(f.type)]
            dates = [f.name for f in schema if pa.types.is_timestamp(f.type) or pa.types.is_duration(f.type)]
            wanted = [column.name for column in classify_columns(numbers) if column.kind or column.name == key]
            Allowance(path, max_bytes).take("columns", (file.metadata.num_rows, len(wanted) + len(dates)))
            table = file.read(columns=[*wanted, *dates])
            # pyarrow lends its own memory, which may not be written to: torch warns of that
            columns = {name: np.require(table.column(name).to_numpy(), requirements="W") for name in wanted}
            time = _seconds(table.column(dates[0])) if dates else None
    except RecordingError:
        raise
    except Exception as error:  # a damaged file may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected a Parquet file, found one that cannot be read ({cause(error)}); export it again"
        ) from error

    if key is not None:
        kinds = {column.name: column.kind for column in classify_columns(wanted)}
        columns = {name: values for name, values in columns.items() if name == key or kinds[name] != "gyro"}
        if key in columns and kinds[key] != "gyro":
            columns["gyro"] = columns.pop(key)
    settings = settings_by_group(metadata_of(schema))
    streams = streams_from_columns(
        columns,
        name=path.stem if key is None else key,
        unit=stated_unit(settings, ""),
        rate=stated_rate(settings, ""),
        time=time,
    )
    if not streams or table.num_rows == 0:
        wanted_name = "with the name of a gyro (gyro_x, gx)" if key is None else f"{key!r} (`key`) of numbers"
        raise RecordingError(
            f"{path}: expected a column {wanted_name}, found {table.num_rows} rows of {enumerated(schema.names)}; "
            "say with `key` which column is the gyro"
        )
    return streams


def metadata_of(schema: Any) -> dict[str, str]:
    """What the metadata of a schema state, as text."""
    return {decoded(name): decoded(value) for name, value in (schema.metadata or {}).items()}


def _seconds(column: Any) -> Array:
    """A column of dates or durations in seconds, exact to the last digit of float64."""
    per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[column.type.unit]
    ticks = column.cast("int64").to_numpy()
    seconds: Array = ticks // per_second + (ticks % per_second) / per_second
    return seconds
