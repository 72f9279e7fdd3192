"""Elements of a MATLAB file of version 5, checked before SciPy reads them.

SciPy descends into cells and structs on the stack of the C language, and allocates the dimensions that a variable
announces before it has found its numbers in the file: a file of a few kB can end the process. Here the elements
are followed as SciPy follows them, by the number of entries that each announces.

Reference: MAT-File Format, The MathWorks, chapter 1 (level 5).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from enum import IntEnum
from math import prod
from pathlib import Path

from gyrofuse.io.limits import DEEPEST_NESTING, Allowance

_HEADER = 128  # bytes of text and version before the first element


# Types of elements (table 1-1 of the reference), from 1 on.
_Type = IntEnum(
    "_Type",
    "INT8 UINT8 INT16 UINT16 INT32 UINT32 SINGLE RESERVED8 DOUBLE RESERVED10 RESERVED11 INT64 UINT64 MATRIX COMPRESSED "
    "UTF8 UTF16 UTF32",
)
# Classes of matrices (table 1-3 of the reference, and those of later releases), from 1 on.
_Class = IntEnum(
    "_Class",
    "CELL STRUCT OBJECT CHAR SPARSE DOUBLE SINGLE INT8 UINT8 INT16 UINT16 INT32 UINT32 INT64 UINT64 FUNCTION OPAQUE",
)
_TEXT = {_Type.UTF8, _Type.UTF16, _Type.UTF32}
_NUMBERS = {kind for kind in _Type if kind < _Type.MATRIX and not kind.name.startswith("RESERVED")}
_DATA = _NUMBERS | _TEXT
_INTEGERS = {_Type.INT32, _Type.UINT32}


def plain(path: Path, allowance: Allowance) -> bytes:
    """A file of version 5 with its elements unpacked, after a check that SciPy can read it without harm.

    Args:
        path: The file.
        allowance: Memory that the unpacked file and the arrays in it may take.

    Raises:
        RecordingError: Larger than the allowance.
        ValueError: Elements that do not fit into each other, or are nested too deep.
    """
    allowance.take("variables", (-(-path.stat().st_size // 8),))
    content = path.read_bytes()
    order = ">" if content[126:128] == b"MI" else "<"
    unpacked = [content[:_HEADER], *_unpacked(content, order, allowance)]
    for element in unpacked[1:]:
        _Walk(element, order, allowance).check()
    return b"".join(unpacked)


def _unpacked(content: bytes, order: str, allowance: Allowance) -> Iterator[bytes]:
    """Matrices at the top, each with its tag."""
    position = _HEADER
    while position + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, position)
        body = content[position + 8 : position + 8 + size]
        position += 8 + size
        if kind == _Type.COMPRESSED:
            stream = zlib.decompressobj()
            element = stream.decompress(body, allowance.left + 1)
            allowance.take("a packed variable", (-(-len(element) // 8),))
            yield element
        elif kind == _Type.MATRIX:
            yield struct.pack(f"{order}II", kind, len(body)) + body
        else:
            raise ValueError(f"an element of type {kind} where a variable was expected")


class _Walk:
    """One variable, followed element by element."""

    def __init__(self, element: bytes, order: str, allowance: Allowance) -> None:
        self._bytes, self._order, self._allowance = memoryview(element), order, allowance
        self._position = 0

    def check(self) -> None:
        """Go through the variable and all inside it, without recursion."""
        left = [1]  # number of matrices that follow, at each depth
        while left:
            if left[-1] == 0:
                left.pop()
                continue
            left[-1] -= 1
            left.append(self._matrix())
            if len(left) > DEEPEST_NESTING:
                raise ValueError(f"cells or structs more than {DEEPEST_NESTING} deep inside each other")

    def _matrix(self) -> int:
        """Go past a matrix up to the matrices inside it, and say how many there are."""
        kind, size = self._integers(8)
        if kind != _Type.MATRIX:
            raise ValueError(f"an element of type {kind} where a matrix was expected")
        if size == 0:
            return 0
        _, _, flags, _ = self._integers(16)
        what = flags & 0xFF
        if what == _Class.OPAQUE:
            for _ in range(3):  # a name, the kind of object and its class
                self._data(_DATA)
            return 1
        shape = struct.unpack(f"{self._order}{len(dims) // 4}i", dims) if (dims := self._data(_INTEGERS)) else ()
        if min(shape, default=0) < 0:
            raise ValueError(f"dimensions of {shape}")
        name = bytes(self._data(_DATA)).decode("latin-1")
        n_fields = self._fields(what)
        if what != _Class.SPARSE:
            self._allowance.take(f"a variable {name}".rstrip(), (*shape, max(n_fields, 1)))
        if what in (_Class.CELL, _Class.STRUCT, _Class.OBJECT):
            return prod(shape) * n_fields
        if what == _Class.FUNCTION:
            return 1
        if not _Class.CHAR <= what <= _Class.UINT64:
            raise ValueError(f"a matrix of class {what}")
        is_complex = bool(flags & 0x800)  # the bit of a matrix with an imaginary part
        parts = 1 if what == _Class.CHAR else (3 if what == _Class.SPARSE else 1) + is_complex
        for _ in range(parts):
            self._data(_DATA if what == _Class.CHAR else _NUMBERS)
        return 0

    def _fields(self, what: int) -> int:
        """Matrices that each entry of a matrix of this class holds."""
        if what not in (_Class.STRUCT, _Class.OBJECT):
            return int(what == _Class.CELL)
        if what == _Class.OBJECT:
            self._data(_DATA)  # the name of its class
        (length,) = struct.unpack(f"{self._order}i", self._data(_INTEGERS))
        names = self._data(_DATA)
        if length < 1:
            raise ValueError(f"names of fields of {length} characters")
        return len(names) // length

    def _data(self, kinds: Collection[int]) -> memoryview:
        """The content of the next element, which is no matrix."""
        (kind,) = self._integers(4)
        if kind >> 16:  # up to 4 bytes, within the tag
            kind, size, space = kind & 0xFFFF, kind >> 16, 4
        else:
            (size,) = self._integers(4)
            space = -(-size // 8) * 8
        if kind not in kinds or size > space:
            raise ValueError(f"an element of type {kind} and {size} bytes where there is none")
        content = self._take(size)
        self._position += space - size
        return content

    def _integers(self, n_bytes: int) -> tuple[int, ...]:
        return struct.unpack(f"{self._order}{n_bytes // 4}I", self._take(n_bytes))

    def _take(self, n_bytes: int) -> memoryview:
        begin, self._position = self._position, self._position + n_bytes
        if self._position > len(self._bytes):
            raise ValueError("elements longer than what they are in")
        return self._bytes[begin : self._position]
