"""HDF5 files: datasets with the names of gyros, in any group."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gyrofuse.io.arrays import streams_from_arrays
from gyrofuse.io.stream import RecordingError, Stream


def read(path: Path, *, key: str | None = None) -> list[Stream]:
    """Read the gyros of an HDF5 file; `gyrofuse.io.arrays` says which names are understood.

    Sampling rate, unit and sensor names may be datasets or attributes of the dataset, a group or the file.

    Args:
        path: The file.
        key: The dataset that holds the gyros, or the group to look in.

    Raises:
        RecordingError: Not an HDF5 file, damaged, or without gyro data.
        ImportError: h5py is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError(f'{path}: reading HDF5 needs h5py; pip install "gyrofuse[logs]"') from error
    try:
        with h5py.File(path, "r") as file:
            # Datasets are read when needed: a file may hold much besides gyros.
            return streams_from_arrays(_content(file), path, key=key)
    except RecordingError:
        raise
    except Exception as error:  # a damaged file may fail anywhere in the library
        raise RecordingError(
            f"{path}: expected an HDF5 file, found one that cannot be read ({error}); copy or export it again"
        ) from error


def _content(file: Any) -> dict[str, Any]:
    """Datasets by path, and attributes of one value as if they were members of what they describe."""
    import h5py

    content: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        if name.startswith("#"):  # where MATLAB keeps what its cells refer to
            return
        prefix = f"{name}/" if name else ""
        content.update({prefix + key: value for key, value in item.attrs.items() if np.size(value) == 1})
        if not isinstance(item, h5py.Dataset):
            return
        if item.attrs.get("MATLAB_class") in (b"char", b"cell"):
            content[name] = _matlab_texts(file, item)
        elif item.dtype.names:
            content.update({prefix + field: item[field] for field in item.dtype.names})
        else:
            content[name] = item[()] if h5py.check_string_dtype(item.dtype) else item

    visit("", file)
    file.visititems(visit)
    return content


def _matlab_texts(file: Any, item: Any) -> list[str]:
    """Rows of text that MATLAB keeps as 16 bit codes, or as a cell array of such."""
    values = item[()]
    if item.attrs.get("MATLAB_class") == b"cell":
        return [text for reference in values.ravel() for text in _matlab_texts(file, file[reference])]
    if values.dtype != np.uint16 or values.ndim != 2:
        return []
    return [row.tobytes().decode("utf-16-le", errors="replace") for row in values.T]
