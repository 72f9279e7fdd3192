"""Logs that are read by parts of their time: .npy, .npz without compression, HDF5 and Parquet.

Between two reads no file is open and no memory is held, not even a memory map, whose pages would count as memory of the
process for as long as it lives, and which ends the process where the file is cut short. `read` is bound to names and
numbers alone, so that it can be sent to another process.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse.io.formats.columns import classify_columns
from gyrofuse.io.formats.hdf5 import check_inside, objects, settings_of
from gyrofuse.io.formats.hdf5_heaps import check_heaps
from gyrofuse.io.formats.numpy.npy import read_header, read_numbers, read_stretch
from gyrofuse.io.formats.parquet import metadata_of
from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.settings import settings_by_group, stated_rate, stated_unit
from gyrofuse.io.limits import enumerated, is_regular
from gyrofuse.io.quantities import RATE, Quantity
from gyrofuse.io.streams import Array, RecordingError, cause, needed, reading

# Bytes of an array that is read because it may be a setting: names of a thousand sensors take 64 kB.
_MOST_SETTING = 65_536
# The header of a member of a .zip file before its name, with the lengths of the name and of the extra field.
_LOCAL_HEADER = struct.Struct("<26xHH")
_Found = dict[str, tuple[Any, tuple[int, ...]]]  # type and shape of each array by its name


@dataclass(frozen=True)
class Slices:
    """A log whose samples are read by parts of their time.

    Attributes:
        read: Maps `(start, stop)`, positions in time, to the samples `(sensor, stop - start)`.
        n_samples: Samples of each sensor.
        sensors: Name of each sensor.
        rate: Sampling rate that the log states in Hz, or None.
        unit: Unit that the log states, or `"unknown"`.
    """

    read: Callable[[int, int], Array]
    n_samples: int
    sensors: tuple[str, ...]
    rate: float | None
    unit: str


def open_slices(path: Path, key: str | Sequence[str] | None, quantity: Quantity = RATE) -> Slices:
    """Find the gyros or accelerometers of a log without reading them.

    Args:
        path: The file; its suffix says the format.
        key: The array of an .npz or HDF5 file, or the columns of a Parquet file, one for each sensor.
        quantity: The quantity whose sensors are read.

    Raises:
        FileNotFoundError: No such file.
        RecordingError: A format that has to be read whole, a damaged file, no array or several that may be the sensors.
        ImportError: The library of the format is not installed.
    """
    openers: dict[str, Callable[[Path, Any, Quantity], Slices]] = {
        ".npy": _open_npy,
        ".npz": _open_npz,
        ".h5": _open_hdf5,
        ".hdf5": _open_hdf5,
        ".parquet": _open_parquet,
    }
    suffix = path.suffix.lower()
    if suffix not in openers:
        raise RecordingError(
            f"{path}: expected one of {', '.join(openers)}, which can be read by stretches, found {suffix or 'no'!r}; "
            "save it as .npy (sensor, time), or read it whole with read_recording"
        )
    if key is not None and not isinstance(key, str) and suffix != ".parquet":
        raise RecordingError(f"{path}: expected `key` to name one array, got {key!r}; several go with .parquet only")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    if not is_regular(path):
        raise RecordingError(f"{path}: expected a file, found a folder, pipe or device; copy the log into a file")
    with reading(path, f"a {suffix} file", "save or export it again"):
        return openers[suffix](path, key, quantity)


def _open_npy(path: Path, key: str | None, quantity: Quantity) -> Slices:
    if key is not None:
        raise RecordingError(f"{path}: expected no `key` for an .npy file, which holds one array, found {key!r}")
    return _mapped(path, 0, "the array", {}, quantity, ())


def _open_npz(path: Path, key: str | None, quantity: Quantity) -> Slices:
    with zipfile.ZipFile(path) as archive:
        headers = {}
        for info in archive.infolist():
            with archive.open(info) as member:
                headers[info.filename.removesuffix(".npy")] = (read_header(member), info)
        found = {n: (dtype, shape) for n, ((shape, _, dtype), _) in headers.items()}
        name = _choose(path, found, key, quantity)
        info = headers[name][1]
        if info.compress_type != zipfile.ZIP_STORED:
            raise RecordingError(
                f"{path}: expected `{name}` as it is, found it compressed, which cannot be read by stretches; "
                "save it with np.savez or np.save, not np.savez_compressed"
            )
        few = {}
        for other, ((shape, order, kind), beside) in headers.items():
            if other != name and prod(shape) * kind.itemsize <= _MOST_SETTING and not kind.hasobject:
                with archive.open(beside) as member:
                    read_header(member)
                    few[other] = read_numbers(member, shape, order, kind)
    with path.open("rb") as file:
        file.seek(info.header_offset)
        name_length, extra_length = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
        start = file.tell() + name_length + extra_length
    return _mapped(path, start, f"`{name}`", few, quantity, {*_kinds(found, quantity).values()})


def _mapped(
    path: Path, start: int, what: str, settings: dict[str, Any], quantity: Quantity, kinds: Collection[str]
) -> Slices:
    """An array in NumPy's format that begins `start` bytes into a file."""
    with path.open("rb") as file:
        file.seek(start)
        shape, fortran, dtype = read_header(file)
        offset = file.tell()
    names = _names(settings.get("sensors"))
    n_sensors, n_samples, time_first = _orientation(path, what, dtype, shape, len(names))
    if path.stat().st_size < offset + prod(shape) * dtype.itemsize:  # better an error now than in the middle of a run
        raise EOFError(f"{shape} numbers announced, fewer there")
    read = partial(read_stretch, path, offset, dtype, n_sensors, n_samples, time_first != fortran)
    unit = stated_unit(settings_by_group(settings), "", quantity, kinds)
    return _slices(path, read, n_samples, n_sensors, names, settings, "", unit)


def _open_hdf5(path: Path, key: str | None, quantity: Quantity) -> Slices:
    with needed(path, "HDF5", "h5py"):
        import h5py
    check_heaps(path)
    with h5py.File(path, "r") as file:
        datasets: dict[str, Any] = {}
        settings = dict(file.attrs)
        for name, item in objects(file):
            settings.update(settings_of(name, item))
            if isinstance(item, h5py.Dataset) and item.shape is not None:
                datasets[name] = item
                if item.size == 1 and item.dtype.itemsize <= _MOST_SETTING:
                    settings[name] = item[()]
        found = {name: (item.dtype, item.shape) for name, item in datasets.items()}
        name = _choose(path, found, key, quantity)
        check_inside(path, name, datasets[name])
        dtype, shape = datasets[name].dtype, datasets[name].shape
        n_sensors, n_samples, time_first = _orientation(path, f"`{name}`", dtype, shape, 0)
        raw_name = datasets[name].name
    read = partial(_read_hdf5, path, raw_name, time_first)
    unit = stated_unit(settings_by_group(settings), name, quantity, {*_kinds(found, quantity).values()})
    return _slices(path, read, n_samples, n_sensors, (), settings, name, unit)


def _read_hdf5(path: Path, name: str | bytes, time_first: bool, start: int, stop: int) -> Array:
    import h5py

    with h5py.File(path, "r") as file:
        return _rows(file[name], time_first, start, stop)


def _open_parquet(path: Path, key: str | Sequence[str] | None, quantity: Quantity) -> Slices:
    with needed(path, "Parquet", "pyarrow"):
        from pyarrow import parquet
        from pyarrow import types as kinds
    with parquet.ParquetFile(path) as file:
        schema, metadata = file.schema_arrow, file.metadata
        numbers = [f.name for f in schema if kinds.is_integer(f.type) or kinds.is_floating(f.type)]
        lengths = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
        ends = np.cumsum(lengths).tolist()
    columns = classify_columns(numbers, quantity)
    kinds = {column.kind for column in columns}
    if key is None:
        columns = [column for column in columns if column.kind == quantity.name]
        wanted = [column.name for column in columns]
        if len({column.device for column in columns}) > 1 and len({column.axis for column in columns}) > 1:
            raise RecordingError(
                f"{path}: expected one column for each sensor, found several axes of several devices "
                f"({', '.join(wanted)}); name those of one axis with `key`"
            )
    else:
        wanted = [key] if isinstance(key, str) else list(key)
    absent = [name for name in wanted if name not in numbers]
    if absent or not wanted or not ends or ends[-1] < 2:
        asked = f"a column with the name of {quantity.named}" if key is None else f"columns {wanted} (`key`)"
        advice = "say with `key` which columns are the sensors"
        raise RecordingError(
            f"{path}: expected {asked} of numbers with at least 2 rows, found {metadata.num_rows} rows of "
            f"{enumerated(schema.names)}; {advice if key is not None else quantity.advice(kinds, advice)}"
        )
    # A row group is the smallest part that is read.
    Request(path).allowance().take("columns of a row group", (max(lengths), len(wanted)))
    settings = metadata_of(schema)
    units = {column.unit for column in classify_columns(wanted, quantity)} - {""}
    unit = units.pop() if len(units) == 1 else stated_unit(settings_by_group(settings), "", quantity, kinds)
    read = partial(_read_parquet, path, wanted, ends)
    return _slices(path, read, ends[-1], len(wanted), tuple(wanted), settings, "", unit)


def _read_parquet(path: Path, names: list[str], ends: list[int], start: int, stop: int) -> Array:
    from pyarrow import parquet

    rows = np.empty((len(names), stop - start))
    with parquet.ParquetFile(path) as file:
        for group, end in enumerate(ends):
            begin = ends[group - 1] if group else 0
            first, last = max(start, begin), min(stop, end)
            if first >= last:
                continue
            table = file.read_row_group(group, columns=names).slice(first - begin, last - first)
            for row, name in zip(rows, names, strict=True):
                row[first - start : last - start] = table.column(name).to_numpy()
    return rows


def _kinds(found: _Found, quantity: Quantity) -> dict[str, str]:
    """Kind of each array of numbers of two dimensions, by its name."""
    tables = [name for name, (dtype, shape) in found.items() if dtype.kind in "iuf" and len(shape) == 2]
    return {column.name: column.kind for column in classify_columns(tables, quantity)}


def _choose(path: Path, found: _Found, key: str | None, quantity: Quantity) -> str:
    """The array asked for, else `gyro` or `acceleration`, else the only array of two dimensions that may be sensors."""
    kinds = _kinds(found, quantity)
    named = [name for name in kinds if name.rpartition("/")[2] == quantity.array]
    others = [name for name, kind in kinds.items() if kind == quantity.other.name]
    wanted = (
        [name for name in found if name == key] if key is not None else named or [n for n in kinds if n not in others]
    )
    if len(wanted) != 1:
        asked = "one array (sensor, time) of numbers" if key is None else f"an array {key!r} (`key`)"
        listed = enumerated(f"{name} {shape}" for name, (_, shape) in found.items()) or "nothing"
        advice = f"name the {quantity.sensor}s with `key`"
        there = {kinds[name] for name in others} if key is None and not wanted else ()
        raise RecordingError(f"{path}: expected {asked}, found {listed}; {quantity.advice(there, advice)}")
    return wanted[0]


def _orientation(path: Path, what: str, dtype: Any, shape: tuple[int, ...], n_names: int) -> tuple[int, int, bool]:
    """Numbers of sensors and samples, and whether time comes first: time is the longer dimension or has no names."""
    if dtype.kind not in "iuf" or len(shape) not in (1, 2) or min(shape, default=0) < 1 or max(shape) < 2:
        raise RecordingError(
            f"{path}: expected {what} to be numbers (sensor, time) with at least 2 samples, found {dtype} {shape}; "
            "save one axis of real numbers"
        )
    if len(shape) == 1:
        return 1, shape[0], False
    time_first = shape[0] > shape[1] and shape[0] != n_names
    n_sensors, n_samples = shape[::-1] if time_first else shape
    return n_sensors, n_samples, time_first


def _rows(array: Any, time_first: bool, start: int, stop: int) -> Array:
    """Samples of a dataset of one or two dimensions as `(sensor, time)`."""
    if len(array.shape) == 1:
        part = array[start:stop][None]
    else:
        part = array[start:stop].T if time_first else array[:, start:stop]
    return np.asarray(part)


def _names(value: Any) -> tuple[str, ...]:
    return () if value is None else tuple(np.asarray(value).astype(str).ravel().tolist())


def _read_named(path: Path, read: Callable[[int, int], Any], start: int, stop: int) -> Array:
    """Samples in float64; any error becomes one that names the file."""
    try:
        return np.array(read(start, stop), dtype=np.float64, order="C")
    except Exception as error:  # a file that is damaged, or was changed since, may fail anywhere in its library
        raise RecordingError(
            f"{path}: expected samples {start} to {stop}, found that they cannot be read ({cause(error)}); save or "
            "export it again, and leave it as it is while it is read"
        ) from error


def _slices(
    path: Path,
    read: Callable[[int, int], Any],
    n_samples: int,
    n_sensors: int,
    names: tuple[str, ...],
    settings: dict[str, Any],
    name: str,
    unit: str,
) -> Slices:
    fits = len(names) == n_sensors == len({*names})
    return Slices(
        read=partial(_read_named, path, read),
        n_samples=n_samples,
        sensors=names if fits else tuple(str(number) for number in range(1, n_sensors + 1)),
        rate=stated_rate(settings_by_group(settings), name),
        unit=unit,
    )
