"""NumPy files: .npz recordings, .npz tables with named rows, .npy arrays.

An .npz file is one of two things.

- A recording: `gyro` (sensor, time), or (axis, sensor, time) with `axes`, and `fs`, `unit`, `sensors`, `time`; every
  other array of the same length is a channel, `temperature[imu2]` one of the sensor imu2. One of accelerations has
  `acceleration` in place of `gyro`. Where nothing is named so, `gyrofuse.io.formats.arrays` says which names are
  understood.
- Tables with named rows, which `gyrofuse.io.formats.numpy.tables` reads.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.formats.arrays import streams_from_arrays
from gyrofuse.io.formats.columns import AXES, classify_columns
from gyrofuse.io.formats.numpy.npy import MAGIC, read_header, read_numbers
from gyrofuse.io.formats.numpy.tables import streams_from_tables
from gyrofuse.io.formats.request import Request
from gyrofuse.io.formats.settings import settings_by_group, stated_rate
from gyrofuse.io.limits import LONGEST_NAME, Allowance, decoded
from gyrofuse.io.quantities import ACCELERATION, RATE
from gyrofuse.io.streams import Array, RecordingError, Stream, reading

_Content = Mapping[str, NDArray[Any]]


def read(request: Request) -> list[Stream]:
    """Read the gyros or accelerometers of an .npz or .npy file.

    The longer dimension of an .npy array is time, the other one the sensors `"1"`, `"2"`, ...; it states no rate.
    Arrays that would have to be unpickled are not read.

    Args:
        request: The file and the part of it to read. Its `key` is the array of an .npz file that holds the sensors,
            whatever its name, or the table to read.

    Raises:
        RecordingError: Not a NumPy file, damaged, with objects, ambiguous, without the quantity asked for, or too
            large.
    """
    path = request.path
    allowance = request.allowance()
    sound = "a NumPy file of numbers and text"
    with reading(path, sound, "save it again with np.savez or np.save, without objects"), path.open("rb") as file:
        magic = file.read(6)
        if magic[:2] != b"PK" and magic != MAGIC:
            raise RecordingError(
                f"{path}: expected a NumPy file, found something else; save it with np.savez or np.save, or name "
                "it by its format"
            )
        file.seek(0)
        if magic == MAGIC:
            return _bare_array(_array(file, "an array", allowance), request)
        content = _members(file, allowance)

    if "fs" in content and stated_rate(settings_by_group(content), "") is None:
        found = str(content["fs"])[:LONGEST_NAME]
        raise RecordingError(
            f"{path}: expected `fs` to be one sampling rate in Hz, found {found}; correct or leave it out"
        )
    if request.columns is not None:
        return streams_from_arrays(content, request)
    if "gyro" not in content and content.get("channels", np.empty(0)).dtype.kind == "U":
        return streams_from_tables(content, request)
    return _recording(content, request)


def _members(file: IO[bytes], allowance: Allowance) -> dict[str, NDArray[Any]]:
    """Arrays of an archive by name; other members are left out."""
    content = {}
    with zipfile.ZipFile(file) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            with archive.open(info) as member:
                if len(name) <= LONGEST_NAME and member.read(len(MAGIC)) == MAGIC:
                    member.seek(0)
                    content[name] = _array(member, f"`{name}`", allowance)
    return content


def _array(file: IO[bytes], what: str, allowance: Allowance) -> NDArray[Any]:
    """The array of a file in NumPy's format; bytes become text."""
    shape, fortran, dtype = read_header(file)
    allowance.take(what, shape, dtype.itemsize)
    array = read_numbers(file, shape, fortran, dtype)
    if array.dtype.kind == "S":
        array = np.array([decoded(item) for item in array.ravel().tolist()], dtype=str).reshape(array.shape)
    return array


def _bare_array(array: NDArray[Any], request: Request) -> list[Stream]:
    path, key = request.path, request.key
    if array.dtype.kind not in "iuf" or array.ndim not in (1, 2) or max(array.shape) < 2 or array.size == 0:
        raise RecordingError(
            f"{path}: expected numbers (sensor, time) with at least 2 samples, found {array.dtype} {array.shape}; "
            "save real numbers in one or two dimensions"
        )
    if key is not None:
        raise RecordingError(f"{path}: expected no `key` for an .npy file, which holds one array, found {key!r}")
    rows = np.atleast_2d(array)
    rows = rows.T if rows.shape[0] > rows.shape[1] else rows
    names = [path.stem] if len(rows) == 1 else [str(number) for number in range(1, len(rows) + 1)]
    return [Stream(name, {"": np.array(row, np.float64)}) for name, row in zip(names, rows, strict=True)]


def _recording(content: _Content, request: Request) -> list[Stream]:
    """Streams of an .npz recording, or of arrays that only `gyrofuse.io.formats.arrays` understands."""
    path, main = request.path, request.quantity.array
    values = content.get(main)
    # Accelerations beside gyros are a channel of the gyros; `sensors` and `axes` are not the names of their rows.
    of_gyros = request.quantity is ACCELERATION and RATE.array in content
    if values is None or of_gyros or request.key not in (None, main):
        return streams_from_arrays(content, request)
    if values.dtype.kind not in "iuf" or values.ndim not in (1, 2, 3) or values.shape[-1] < 2 or values.size == 0:
        raise RecordingError(
            f"{path}: expected `{main}` to be numbers (sensor, time) or (axis, sensor, time) with at least 2 samples, "
            f"found {values.dtype} {values.shape}; save it with time last"
        )
    axes = _axes(content, values, path, main) if values.ndim == 3 else [""]
    sensors = content.get("sensors", np.empty(0)).astype(str).ravel().tolist()
    rows = np.atleast_2d(values)
    # Names of the rows show which dimension is time, however short the recording; without them it is the longer one.
    if values.ndim == 2 and len(sensors) != len(rows) > rows.shape[1]:
        rows = rows.T
    n_sensors, n_samples = rows.shape[-2:]
    notes = [] if len(sensors) in (0, n_sensors) else [f"{len(sensors)} sensor names do not fit {n_sensors} sensors"]
    if len({*sensors}) < len(sensors) or len(sensors) != n_sensors:
        sensors = [str(number) for number in range(1, n_sensors + 1)] if n_sensors > 1 else [path.stem]
    if (time := content.get("time")) is not None and time.size != n_samples:
        raise RecordingError(
            f"{path}: expected `time` of the length of `{main}` {values.shape}, found {time.shape}; save both of "
            "one length"
        )

    # One group for each sensor, as files of several devices have it.
    signal = rows.reshape(len(axes), n_sensors, n_samples)
    grouped: dict[str, Any] = {
        f"{i}/{main}/{axis}": signal[k, i] for i in range(n_sensors) for k, axis in enumerate(axes)
    }
    if "fs" not in content:
        grouped["time/unit"] = np.str_("s")  # beside a rate, the unit of the clock follows from its steps
    own: list[dict[str, Array]] = [{} for _ in sensors]
    position_of = {sensor: position for position, sensor in enumerate(sensors)}
    for name, value in content.items():
        if name in (main, "sensors", "axes"):
            continue
        owner = _in_brackets(name, position_of)
        named_alike = classify_columns([main, name])[1].kind == request.quantity.name
        if not (named_alike or owner):
            grouped[name] = value
        elif value.dtype.kind in "biuf" and value.shape[-1:] == (n_samples,):
            # `temperature[imu2]` belongs to the sensor imu2; a second array of the quantity is a channel.
            number, label = (position_of[owner], name.removesuffix(f"[{owner}]")) if owner else (0, name)
            own[number][label] = value.astype(np.float64)
    return [
        replace(stream, name=sensor, channels=stream.channels | channels, notes=(*stream.notes, *notes))
        for stream, sensor, channels in zip(
            streams_from_arrays(grouped, replace(request, key=None)), sensors, own, strict=True
        )
    ]


def _in_brackets(name: str, known: Mapping[str, Any]) -> str:
    """The one of the known names that stands in brackets at the end of a name, `""` where there is none."""
    if not name.endswith("]"):
        return ""
    inside = (name[begin + 1 : -1] for begin, letter in enumerate(name) if letter == "[")
    return next((text for text in inside if text in known), "")


def _axes(content: _Content, values: NDArray[Any], path: Path, main: str) -> list[str]:
    axes = [str(axis).strip().lower() for axis in content.get("axes", np.array(AXES[: values.shape[0]])).ravel()]
    if len(axes) != values.shape[0] or not {*axes} <= {*AXES} or len({*axes}) < len(axes):
        raise RecordingError(
            f"{path}: expected `{main}` (axis, sensor, time) and in `axes` which of x, y, z its axes are, "
            f"found {values.shape} and {axes}; save one name per axis"
        )
    return axes
