"""Arrays in NumPy's file format: their headers, and parts of their numbers.

Files are read without a memory map: where another process cuts a mapped file short, the reading process ends without an
error, while reading from a file raises one.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"\x93NUMPY"


def read_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read a header up to where the numbers begin.

    Args:
        file: File at the beginning of the header.

    Returns:
        Shape, whether the array is in Fortran order, and dtype.

    Raises:
        ValueError: No such header.
    """
    longest = 10_000  # bytes: NumPy's own limit, which it checks only after it has read the header
    begin = file.tell()
    major = file.read(8)[6:7]
    wide = major != b"\x01"
    (length,) = struct.unpack("<I" if wide else "<H", file.read(4 if wide else 2))
    if length > longest:
        raise ValueError(f"a header of {length} bytes")
    file.seek(begin)
    np.lib.format.read_magic(file)
    read: Callable[[Any], Any] = (
        np.lib.format.read_array_header_2_0 if wide else np.lib.format.read_array_header_1_0  # 3.0 is 2.0 in UTF-8
    )
    shape, fortran, dtype = read(file)
    if min(shape, default=0) < 0:
        raise ValueError(f"a shape of {shape}")
    return shape, fortran, dtype


def read_numbers(file: IO[bytes], shape: tuple[int, ...], fortran: bool, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Read the array behind a header.

    Args:
        file: File at the beginning of the numbers.
        shape: Shape of the array.
        fortran: Whether the array is in Fortran order.
        dtype: Type of the numbers.

    Raises:
        ValueError: Objects, which would have to be unpickled.
        EOFError: The file ends before.
    """
    if dtype.hasobject:
        raise ValueError("Python objects, which are not unpickled")
    chunk = 2**18  # bytes at a time: members of an archive pass through a buffer, which should stay in the cache
    content = memoryview(bytearray(prod(shape) * dtype.itemsize))
    done = 0
    while done < len(content):
        if not (n_bytes := file.readinto(content[done : done + chunk])):  # type: ignore[attr-defined]
            raise EOFError(f"{len(content)} bytes announced, {done} there")
        done += n_bytes
    values: NDArray[Any] = np.frombuffer(content, dtype) if len(content) else np.empty(prod(shape), dtype)
    return values.reshape(shape, order="F" if fortran else "C")


def read_stretch(
    path: Path,
    offset: int,
    dtype: np.dtype[Any],
    n_sensors: int,
    n_samples: int,
    interleaved: bool,
    start: int,
    stop: int,
) -> NDArray[Any]:
    """Read samples `start` to `stop - 1` of an array of one or two dimensions: `(sensor, stop - start)`.

    Args:
        path: The file.
        offset: Byte at which the numbers begin.
        dtype: Type of the numbers.
        n_sensors: Number of sensors.
        n_samples: Samples of each sensor.
        interleaved: Whether all sensors of one instant follow each other in the file, not all instants of one sensor.
        start: Position of the first sample.
        stop: Position after the last sample.

    Raises:
        EOFError: The file ends before.
    """
    count = stop - start
    with path.open("rb") as file:
        if interleaved:
            values = _numbers(file, offset + start * n_sensors * dtype.itemsize, dtype, count * n_sensors)
            return values.reshape(count, n_sensors).T
        begins = [offset + (sensor * n_samples + start) * dtype.itemsize for sensor in range(n_sensors)]
        return np.stack([_numbers(file, begin, dtype, count) for begin in begins])


def _numbers(file: IO[bytes], begin: int, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
    file.seek(begin)
    values = np.fromfile(file, dtype, count)
    if values.size < count:
        raise EOFError(f"{count} numbers announced from byte {begin} on, {values.size} there")
    return values
