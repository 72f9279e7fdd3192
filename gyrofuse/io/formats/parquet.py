"""Parquet files: columns with the names of gyros or accelerometers."""

from __future__ import annotations

from typing import Any

import numpy as np

from gyrofuse._base.units import SECONDS_PER
from gyrofuse.io.formats.column_streams import streams_from_columns
from gyrofuse.io.formats.columns import classify_columns, renamed
from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.settings import settings_by_group, stated_rate, stated_unit
from gyrofuse.io.limits import decoded, enumerated
from gyrofuse.io.streams import Array, RecordingError, Stream, needed, reading


def read(request: Request) -> list[Stream]:
    """Read the gyros or accelerometers of a Parquet file, whose columns are named as in a CSV file.

    `fs` (Hz) and `unit` are taken from the metadata of the schema. A null is NaN.

    Args:
        request: The file and the part of it to read. Its `key` is the only column to read, whatever its name.

    Raises:
        RecordingError: Not a Parquet file, damaged, empty, without the quantity asked for, or too large.
        ImportError: pyarrow is not installed.
    """
    path, key, quantity, columns = request.path, request.key, request.quantity, request.columns
    with needed(path, "Parquet", "pyarrow"):
        import pyarrow as pa
        from pyarrow import parquet
    with reading(path, "a Parquet file", "export it again"), parquet.ParquetFile(path) as file:
        schema = file.schema_arrow
        numbers = [f.name for f in schema if pa.types.is_integer(f.type) or pa.types.is_floating(f.type)]
        dates = [f.name for f in schema if pa.types.is_timestamp(f.type) or pa.types.is_duration(f.type)]
        called = {name: name for name in numbers} if columns is None else renamed(path, schema.names, columns)
        numbers = [name for name in numbers if name in called]
        kinds = {c.name: c.kind for c in classify_columns([called[name] for name in numbers], quantity)}
        wanted = [name for name in numbers if kinds[called[name]] or called[name] == key]
        request.allowance().take("columns", (file.metadata.num_rows, len(wanted) + len(dates)))
        table = file.read(columns=[*wanted, *dates])
        # The arrays of pyarrow may not be written to, of which torch warns.
        read = {called[name]: np.require(table.column(name).to_numpy(), requirements="W") for name in wanted}
        time = _seconds(table.column(dates[0])) if dates else None

    if key is not None:
        read = {name: values for name, values in read.items() if name == key or kinds[name] != quantity.name}
        if key in read and kinds[key] != quantity.name:
            read[quantity.array] = read.pop(key)
    settings = settings_by_group(metadata_of(schema))
    streams = streams_from_columns(
        read,
        name=path.stem if key is None else key,
        unit=stated_unit(settings, "", quantity, {column.kind for column in classify_columns(list(read), quantity)}),
        rate=stated_rate(settings, ""),
        time=time,
        quantity=quantity,
    )
    if not streams or table.num_rows == 0:
        what = f"with the name of {quantity.named}" if key is None else f"{key!r} (`key`) of numbers"
        found = {column.kind for column in classify_columns(numbers)}
        advice = quantity.advice(found, "say with `columns` (--map) what the columns are")
        raise RecordingError(
            f"{path}: expected a column {what}, found {table.num_rows} rows of {enumerated(schema.names)}; {advice}"
        )
    return streams


def metadata_of(schema: Any) -> dict[str, str]:
    """The metadata of a schema as text, by name."""
    return {decoded(name): decoded(value) for name, value in (schema.metadata or {}).items()}


def _seconds(column: Any) -> Array:
    """A column of dates or durations in seconds, exact to the last digit of float64."""
    per_second = round(1 / SECONDS_PER[column.type.unit])
    ticks = column.cast("int64").to_numpy()
    seconds: Array = ticks // per_second + (ticks % per_second) / per_second
    return seconds
