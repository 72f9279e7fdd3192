"""HDF5 files: datasets with the names of gyros or accelerometers, in any group."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyrofuse.io.formats.arrays import streams_from_arrays
from gyrofuse.io.formats.hdf5_heaps import check_heaps
from gyrofuse.io.formats.request import Request
from gyrofuse.io.limits import DEEPEST_NESTING, LONGEST_NAME, Allowance, decoded
from gyrofuse.io.streams import RecordingError, Stream, needed, reading

# Texts of a MATLAB cell array, and characters of a text, that may be names of sensors: each text costs a read of the
# library, and no array has nearly as many sensors.
_MOST_TEXTS = 4096


def read(request: Request) -> list[Stream]:
    """Read the gyros or accelerometers of an HDF5 file; `gyrofuse.io.formats.arrays` says which names are understood.

    Sampling rate, unit and sensor names may be datasets or attributes of the dataset, a group or the file. Links to
    other files are not followed.

    Args:
        request: The file and the part of it to read. Its `key` is the dataset that holds the sensors, or the group to
            look in.

    Raises:
        RecordingError: Not an HDF5 file, damaged, without the quantity asked for, with numbers in other files, or too
            large.
        ImportError: h5py is not installed.
    """
    path = request.path
    with needed(path, "HDF5", "h5py"):
        import h5py
    with reading(path, "an HDF5 file", "copy or export it again"):
        check_heaps(path)
        with h5py.File(path, "r") as file:
            # Datasets are read when needed: a file may hold much besides sensors.
            return streams_from_arrays(_content(file, request.allowance()), request)


def objects(file: Any) -> Iterator[tuple[str, Any]]:
    """Groups and datasets of an HDF5 file with their names, each once; soft and external links are not followed."""
    import h5py

    seen = set()
    inside = [("", file["/"], 0)]
    while inside:
        name, item, depth = inside.pop()
        info = h5py.h5o.get_info(item.id)
        if (info.fileno, info.addr) in seen:
            continue
        seen.add((info.fileno, info.addr))
        yield name, item
        if isinstance(item, h5py.Group) and depth < DEEPEST_NESTING:
            prefix = f"{name}/" if name else ""
            names = sorted((raw if isinstance(raw, bytes) else raw.encode() for raw in item), reverse=True)
            hard = [raw for raw in names if item.id.links.get_info(raw).type == h5py.h5l.TYPE_HARD]
            inside += [(prefix + decoded(raw), item[raw], depth + 1) for raw in hard]


def settings_of(name: str, item: Any) -> dict[str, Any]:
    """Attributes of one value, named as members of the group or dataset that they describe.

    Args:
        name: Name of the group or dataset, `""` for the file.
        item: The group or dataset.
    """
    prefix = f"{name}/" if name else ""
    attributes = [(key if isinstance(key, str) else decoded(key), value) for key, value in item.attrs.items()]
    return {prefix + key: value for key, value in attributes if np.size(value) == 1}


def check_inside(path: Path, name: str, item: Any) -> None:
    """Raise `RecordingError` where the numbers of a dataset lie in other files: it could name any file.

    Args:
        path: The file.
        name: Name of the dataset.
        item: The dataset.
    """
    elsewhere = item.external or (item.is_virtual and [s for s in item.virtual_sources() if s.file_name != "."])
    if elsewhere:
        raise RecordingError(
            f"{path}: expected numbers in the file itself, found that those of `{name}` lie in other files; copy them "
            "into one file (h5repack)"
        )


class _Dataset:
    """A dataset, or a field of one, that is read when NumPy asks for it."""

    def __init__(self, name: str, item: Any, allowance: Allowance, field: str | None = None) -> None:
        self.shape: tuple[int, ...] = item.shape or ()
        self.dtype: np.dtype[Any] = item.dtype if field is None else item.dtype[field]
        self._name, self._item, self._allowance, self._field = name, item, allowance, field

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        check_inside(self._allowance.path, self._name, self._item)
        self._allowance.take(f"`{self._name}`", self.shape, self._item.dtype.itemsize)
        return np.asarray(self._item if self._field is None else self._item[self._field], dtype=dtype)


def _content(file: Any, allowance: Allowance) -> dict[str, Any]:
    """Datasets by path, and attributes beside them."""
    import h5py

    content: dict[str, Any] = {}
    for name, item in objects(file):
        if name.startswith("#") or len(name) > LONGEST_NAME:  # a group of MATLAB for the content of its cells
            continue
        content.update(settings_of(name, item))
        if not isinstance(item, h5py.Dataset):
            continue
        if item.attrs.get("MATLAB_class") in (b"char", b"cell"):
            content[name] = _matlab_texts(file, _Dataset(name, item, allowance), allowance)
        elif item.dtype.names:
            content.update({f"{name}/{field}": _Dataset(name, item, allowance, field) for field in item.dtype.names})
        else:
            lazy = _Dataset(name, item, allowance)
            content[name] = np.asarray(lazy) if h5py.check_string_dtype(item.dtype) else lazy
    return content


def _matlab_texts(file: Any, dataset: _Dataset, allowance: Allowance) -> list[str]:
    """Rows of text that MATLAB stores as 16 bit codes, or as a cell array of such rows."""
    import h5py

    if dataset.dtype == h5py.ref_dtype:
        if np.prod(dataset.shape) > _MOST_TEXTS:
            return []
        cells = [file[reference] for reference in np.asarray(dataset).ravel() if reference]
        texts = [cell for cell in cells if isinstance(cell, h5py.Dataset) and cell.dtype == np.uint16]
        return [row for cell in texts for row in _rows_of_text(_Dataset(cell.name, cell, allowance))]
    return _rows_of_text(dataset)


def _rows_of_text(dataset: _Dataset) -> list[str]:
    if dataset.dtype != np.uint16 or len(dataset.shape) != 2 or max(dataset.shape) > _MOST_TEXTS:
        return []
    return [row.tobytes().decode("utf-16-le", errors="replace") for row in np.asarray(dataset).T]
