"""The global heaps of an HDF5 file, checked before the library reads them: in a damaged one it would loop for ever."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from gyrofuse.io.streams import RecordingError

_SIGNATURE = b"GCOL\x01\0\0\0"  # start of a collection of version 1, the only version there is
_HEADER = struct.Struct("<8sQ")  # signature; bytes of the collection, with this header
_OBJECT = struct.Struct("<HHIQ")  # index, references, unused, bytes of the object without this header


def check_heaps(path: Path) -> None:
    """Check all collections of the global heap, where texts and the sources of virtual datasets lie.

    The walk is that of the library (HDF5 file format specification, III.E), which steps over an object by its declared
    size and does not notice a free space of size zero.

    Args:
        path: The file.

    Raises:
        RecordingError: An object of a collection has a size with which the walk does not end.
    """
    smallest = 4096  # bytes of a collection, by the specification
    if path.stat().st_size < smallest:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        start = content.find(_SIGNATURE)
        while start >= 0:
            _, size = _HEADER.unpack_from(content, start) if start + _HEADER.size <= len(content) else (b"", 0)
            # Numbers may spell the signature by chance; a collection lies in the file as a whole.
            if smallest <= size <= len(content) - start:
                _walk(path, content, start + _HEADER.size, start + size)
            start = content.find(_SIGNATURE, start + 1)


def _walk(path: Path, content: mmap.mmap, at: int, end: int) -> None:
    while at + _OBJECT.size <= end:
        index, _, _, size = _OBJECT.unpack_from(content, at)
        step = size if index == 0 else _OBJECT.size + -(-size // 8) * 8  # free space counts its header
        if step < _OBJECT.size:
            raise RecordingError(
                f"{path}: expected an HDF5 file, found a damaged one (free space of {size} bytes at byte {at}); copy "
                "or export it again"
            )
        at += step
