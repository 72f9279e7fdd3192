"""Advisory lock: one run at a time on one table."""

from __future__ import annotations

import errno
import os
import platform
import sys
from pathlib import Path

if sys.platform != "win32":
    import fcntl

_TAKEN = (errno.EWOULDBLOCK, errno.EACCES)  # errors of `flock` where another process holds the lock
_held: dict[Path, int] = {}  # open files behind the locks that this process holds


def hold(path: Path, table: Path) -> None:
    """Take a lock, which the operating system releases when the process ends, however it ends.

    Nothing is locked where the file system or the platform has no such locks.

    Args:
        path: File that is locked; created if it does not exist.
        table: Table that is worked on, for the message.

    Raises:
        BlockingIOError: Another process holds it.
    """
    path = path.absolute()
    if path in _held and _is(path, _held[path]):
        return
    release(path)
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        if sys.platform != "win32":
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in _TAKEN:
                    holder = os.read(file, 200).decode(errors="replace").strip() or "its process is not known"
                    os.close(file)
                    raise BlockingIOError(
                        f"{table}: another run is at work on it ({holder}); wait until it ends, or choose another name"
                    ) from None
        if _is(path, file):
            break
        os.close(file)  # a run that ended between the two lines removed it
    os.ftruncate(file, 0)
    os.write(file, f"process {os.getpid()} on {platform.node()}\n".encode())
    _held[path] = file


def release(path: Path) -> None:
    """Release a lock, if this process holds it."""
    file = _held.pop(path.absolute(), None)
    if file is not None:
        os.close(file)


def _is(path: Path, file: int) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(file))
    except OSError:
        return False
