"""What a log may ask of a reader: how much memory, how long a name, which rates."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from math import prod
from pathlib import Path

from gyrofuse.io.streams import RecordingError

# Characters of a name, a cell or a comment that are looked at: no name of a sensor or setting is nearly as long, and
# what is done with a name may take the square of its length.
LONGEST_NAME = 1000
# Hz: one sample in twelve days, and one each picosecond; rates beyond are damaged numbers, with which the arithmetic of
# times overflows.
_SLOWEST, _FASTEST = 1e-6, 1e12
# Part of the memory that the numbers of a log may take: on the way to a recording they are there up to three times.
_SHARE = 0.25
_UNKNOWN_MEMORY = 2**33  # bytes, where the system does not say how much it has: a small computer of today
_CONTAINER = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")  # versions 2 and 1
_GIB = 2.0**30


def physical_memory() -> int:
    """Bytes of memory of the computer, or of the container where that has less."""
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        memory = _UNKNOWN_MEMORY
    for name in _CONTAINER:
        try:
            text = Path(name).read_text(encoding="ascii").strip()
        except (OSError, ValueError):
            continue
        if text.isdigit():
            memory = min(memory, int(text))
    return memory


class Allowance:
    """Memory that the numbers of one log may take; what the log declares is taken off before it is allocated.

    Args:
        path: The log.
        max_bytes: Limit; by default a quarter of the physical memory.
    """

    def __init__(self, path: Path, max_bytes: float | None = None) -> None:
        self.path = path
        self.max_bytes = _SHARE * physical_memory() if max_bytes is None else max_bytes
        self.taken = 0

    @property
    def left(self) -> int:
        """Bytes that may still be taken."""
        return max(int(self.max_bytes) - self.taken, 0)

    def take(self, what: str, shape: Iterable[int], itemsize: int = 8) -> None:
        """Account for an array that is about to be read, which becomes float64 where it is smaller.

        Args:
            what: What declares the size, for the message.
            shape: Its dimensions.
            itemsize: Bytes of one entry in the log.

        Raises:
            RecordingError: Together with what was taken before it is more than the limit.
        """
        dimensions = tuple(shape)
        self.taken += max(prod(dimensions), 0) * max(itemsize, 8)
        if self.taken > self.max_bytes:
            declared = " x ".join(map(str, dimensions)) or "1"
            raise RecordingError(
                f"{self.path}: expected a log whose numbers take at most {self.max_bytes / _GIB:.3g} GiB, found "
                f"{what[:LONGEST_NAME]} of {declared} numbers, which brings them to {self.taken / _GIB:.3g} GiB; allow "
                "more with max_bytes=, read the log by stretches with open_long, or cut it, and where it should be "
                "smaller, record or copy it again"
            )


def is_regular(path: Path) -> bool:
    """Whether a path is a file with an end: no folder, pipe, socket or device."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def is_rate(value: float) -> bool:
    """Whether a number can be a sampling rate in Hz."""
    return _SLOWEST <= value <= _FASTEST


def decoded(raw: bytes) -> str:
    """Text that should be UTF-8; where it is not, Windows-1252, which the loggers write that know no UTF-8."""
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def printable(text: str) -> str:
    r"""Text as any encoding can write it: halves of characters are written out, `\ud800`, and what is overlong cut."""
    return text[:LONGEST_NAME].encode("utf-8", "backslashreplace").decode("utf-8")


def enumerated(names: Iterable[str], most: int = 30) -> str:
    """Names for a message, the first ones alone where there are many."""
    listed = list(names)
    shown = ", ".join(name if len(name) <= 100 else f"{name[:100]}..." for name in listed[:most])
    return f"{shown} and {len(listed) - most} more" if len(listed) > most else shown
