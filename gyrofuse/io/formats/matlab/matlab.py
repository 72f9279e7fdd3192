"""MATLAB files, version 5 to 7.3: arrays with the names of gyros or accelerometers, in structs too."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np

from gyrofuse.io.formats import hdf5
from gyrofuse.io.formats.arrays import streams_from_arrays
from gyrofuse.io.formats.matlab import mat5
from gyrofuse.io.formats.request import Request
from gyrofuse.io.streams import RecordingError, Stream, cause, reading

_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def read(request: Request) -> list[Stream]:
    """Read the gyros or accelerometers of a .mat file; `gyrofuse.io.formats.arrays` says which names are understood.

    Files of version 7.3 are HDF5, which their content shows.

    Args:
        request: The file and the part of it to read. Its `key` is the array that holds the sensors (`"imu.gyr"` or
            `"imu/gyr"` in a struct), or the struct to look in.

    Raises:
        RecordingError: Not a MATLAB file, damaged, without the quantity asked for, or too large.
        ImportError: Version 7.3 and h5py is not installed.
    """
    from scipy.io import loadmat

    path = request.path
    if request.key:
        request = replace(request, key=request.key.replace(".", "/"))
    user_block = 512  # bytes that MATLAB writes before an HDF5 file
    try:
        with path.open("rb") as file:
            start = file.read(user_block + len(_HDF5_SIGNATURE))
    except OSError as error:
        raise RecordingError(
            f"{path}: expected a MATLAB file, found one that cannot be opened ({cause(error)})"
        ) from error
    if start.startswith(_HDF5_SIGNATURE) or start.endswith(_HDF5_SIGNATURE):
        return hdf5.read(request)
    allowance = request.allowance()
    with reading(path, "a MATLAB file of version 5 to 7.3", "save it again with save(..., '-v7')"):
        if 0 in start[:4]:  # version 4, which has neither cells nor packed variables
            allowance.take("variables", (-(-path.stat().st_size // 8),))
            variables = loadmat(path)
        else:
            variables = loadmat(io.BytesIO(mat5.plain(path, allowance)))
    content: dict[str, Any] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            content |= _members(name, value)
    return streams_from_arrays(content, request)


def _members(name: str, value: Any) -> dict[str, Any]:
    """A variable by its name; the fields of a struct by `name/field`, of an array of structs by `name1/field`."""
    if not isinstance(value, np.ndarray):  # sparse matrices, function handles
        return {}
    if value.dtype.names:
        members: dict[str, Any] = {}
        for number, struct in enumerate(value.ravel(), 1):
            owner = name if value.size == 1 else f"{name}{number}"
            for field in value.dtype.names:
                members |= _members(f"{owner}/{field}", struct[field])
        return members
    if value.dtype.kind == "O":  # a cell array, of which only text is used
        cells = [cell for cell in value.ravel() if isinstance(cell, np.ndarray) and cell.dtype.kind == "U"]
        return {name: [text for cell in cells for text in cell.ravel().tolist()]}
    return {name: value}
