"""MATLAB files, version 5 to 7.3: arrays with the names of gyros or accelerometers, in structs too."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse.io.formats import hdf5, mat5
from gyrofuse.io.formats.arrays import streams_from_arrays
from gyrofuse.io.limits import Allowance
from gyrofuse.io.streams import RecordingError, Stream, cause

_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_USER_BLOCK = 512  # MATLAB puts its own header before the HDF5 file


def read(
    path: Path,
    *,
    key: str | None = None,
    quantity: str = "rate",
    columns: Mapping[str, str] | None = None,
    max_bytes: float | None = None,
) -> list[Stream]:
    """Read the gyros or accelerometers of a .mat file; `gyrofuse.io.formats.arrays` says which names are understood.

    Files of version 7.3 are HDF5 and are told apart by their content.

    Args:
        path: The file.
        key: The array that holds the sensors (`"imu.gyr"` or `"imu/gyr"` in a struct), or the struct to look in.
        quantity: `"rate"` or `"acceleration"`: the sensors to read.
        columns: What arrays are, where their names do not say: these by the names that they should have; the others are
            left out.
        max_bytes: Memory that the variables may take, packed and unpacked; by default a quarter of what there is.

    Raises:
        RecordingError: Not a MATLAB file, damaged, without the quantity asked for, or too large.
        ImportError: Version 7.3 and h5py is not installed.
    """
    from scipy.io import loadmat

    key = key.replace(".", "/") if key else key
    try:
        with path.open("rb") as file:
            start = file.read(_USER_BLOCK + len(_HDF5_SIGNATURE))
    except OSError as error:
        raise RecordingError(
            f"{path}: expected a MATLAB file, found one that cannot be opened ({cause(error)})"
        ) from error
    if start.startswith(_HDF5_SIGNATURE) or start.endswith(_HDF5_SIGNATURE):
        return hdf5.read(path, key=key, quantity=quantity, columns=columns, max_bytes=max_bytes)
    allowance = Allowance(path, max_bytes)
    try:
        if 0 in start[:4]:  # version 4, which has neither cells nor packed variables
            allowance.take("variables", (-(-path.stat().st_size // 8),))
            variables = loadmat(path)
        else:
            variables = loadmat(io.BytesIO(mat5.plain(path, allowance)))
    except RecordingError:
        raise
    except Exception as error:  # a damaged file may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected a MATLAB file of version 5 to 7.3, found one that cannot be read ({cause(error)}); "
            "save it again with save(..., '-v7')"
        ) from error
    content: dict[str, Any] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            content |= _members(name, value)
    return streams_from_arrays(content, path, key=key, quantity=quantity, columns=columns)


def _members(name: str, value: Any) -> dict[str, Any]:
    """The variable itself; of a struct its fields, `name/field`, and of an array of structs `name1/field`."""
    if not isinstance(value, np.ndarray):  # sparse matrices, function handles
        return {}
    if value.dtype.names:
        members: dict[str, Any] = {}
        for number, struct in enumerate(value.ravel(), 1):
            owner = name if value.size == 1 else f"{name}{number}"
            for field in value.dtype.names:
                members |= _members(f"{owner}/{field}", struct[field])
        return members
    if value.dtype.kind == "O":  # a cell array: only text in it is of use
        cells = [cell for cell in value.ravel() if isinstance(cell, np.ndarray) and cell.dtype.kind == "U"]
        return {name: [text for cell in cells for text in cell.ravel().tolist()]}
    return {name: value}
