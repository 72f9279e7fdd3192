"""Limits that hold for logs of every format: memory, lengths of names, depth of nesting, sampling rates."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from math import prod
from pathlib import Path

from gyrofuse.io.streams import RecordingError

# Characters of a name, a cell or a comment that are read. Names of sensors and settings have fewer than a hundred; the
# work on a name may grow with the square of its length, so that a damaged one of a megabyte would take hours.
LONGEST_NAME = 1000
# Groups, cells or structs inside each other. Logs have fewer than ten; the HDF5 library and SciPy go down on the stack
# of the C language, of which SciPy takes about 2 kB a level and a thread may have as little as 512 kB.
DEEPEST_NESTING = 64
# Sets of sensors with a clock of their own in one file. Each is read with all arrays of its length, so that the work
# grows with the square of their number.
MOST_DEVICES = 256
# Sampling rates in Hz: one sample in twelve days, and one each picosecond. A rate beyond is a damaged number, with
# which times in float64 overflow.
_SLOWEST, _FASTEST = 1e-6, 1e12
# Fraction of the memory that the numbers of a log may take: on the way to a recording they exist up to three times.
_SHARE = 0.25
_CONTAINER = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")  # versions 2 and 1


def physical_memory() -> int:
    """Memory in bytes of the computer, or of the container where it has less.

    Where the system does not say, 8 GiB are assumed, which a small computer has.
    """
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        memory = 8 * 2**30
    for name in _CONTAINER:
        try:
            text = Path(name).read_text(encoding="ascii").strip()
        except (OSError, ValueError):
            continue
        if text.isdigit():
            memory = min(memory, int(text))
    return memory


class Allowance:
    """Account of the memory that the numbers of one log may take, checked before any of it is allocated.

    Args:
        path: The log.
        max_bytes: Limit in bytes; by default a quarter of the physical memory.
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
        """Enter an array that is about to be read; entries smaller than float64 become float64.

        Args:
            what: Name of the array, for the message.
            shape: Dimensions of the array, as the log declares them.
            itemsize: Bytes of one entry in the log.

        Raises:
            RecordingError: All entries together are above the limit.
        """
        dimensions = tuple(shape)
        self.taken += max(prod(dimensions), 0) * max(itemsize, 8)
        if self.taken > self.max_bytes:
            gib = 2.0**30
            declared = " x ".join(map(str, dimensions)) or "1"
            raise RecordingError(
                f"{self.path}: expected a log whose numbers take at most {self.max_bytes / gib:.3g} GiB, found "
                f"{what[:LONGEST_NAME]} of {declared} numbers, which brings them to {self.taken / gib:.3g} GiB; allow "
                "more with max_bytes=, read the log by stretches with open_recording, or cut it, and where it should "
                "be smaller, record or copy it again"
            )


def is_regular(path: Path) -> bool:
    """Whether a path is a regular file: no folder, and no pipe, socket or device, whose content has no end."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def is_rate(value: float) -> bool:
    """Whether a number can be a sampling rate in Hz."""
    return _SLOWEST <= value <= _FASTEST


def decoded(raw: bytes) -> str:
    """Decode text as UTF-8, or else as Windows-1252, in which loggers without UTF-8 write."""
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def printable(text: str) -> str:
    r"""Text that any encoding can write: halves of surrogate pairs become escapes, `\ud800`, overlong text is cut."""
    return text[:LONGEST_NAME].encode("utf-8", "backslashreplace").decode("utf-8")


def enumerated(names: Iterable[str], most: int = 30) -> str:
    """Names in one line for a message.

    Args:
        names: The names; each is cut after 100 characters.
        most: Number of names that are listed; the others are counted.
    """
    listed = list(names)
    shown = ", ".join(name if len(name) <= 100 else f"{name[:100]}..." for name in listed[:most])
    return f"{shown} and {len(listed) - most} more" if len(listed) > most else shown
