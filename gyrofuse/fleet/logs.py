"""The logs of a fleet, and the groups in which they are worked on."""

from __future__ import annotations

import codecs
import glob
import os
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from gyrofuse.io.formats import SUFFIXES

_WILD = "*?["


class State(NamedTuple):
    """Size of a log in bytes, and time of its last change in ns since 1970; None where the log cannot be read."""

    size: int | None = None
    modified: int | None = None


def state_of(log: str | Path) -> State:
    """State of a file, or of all files of a folder together."""
    try:
        files = [Path(log)] if not os.path.isdir(log) else [path for path in Path(log).rglob("*") if path.is_file()]
        found = [file.stat() for file in files]
    except (OSError, ValueError):  # no name of a file: it holds NUL, say
        return State()
    return State(sum(s.st_size for s in found), max((s.st_mtime_ns for s in found), default=None))


def identity(log: str | Path) -> str:
    """Identity of a log: its absolute path with links resolved."""
    try:
        return as_text(os.path.realpath(log))
    except ValueError:  # no name of a file
        return as_text(os.path.abspath(log))


def as_text(text: str) -> str:
    r"""Valid UTF-8 of a text: bytes of names of files are written out as `\xff`, lone surrogates as `\ud800`."""
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # surrogates that stand for no byte
        return text.encode("utf-8", "backslashreplace").decode("utf-8")


def find_logs(paths: str | Path | Iterable[str | Path], *, manifest: str | Path | None = None) -> tuple[Path, ...]:
    """All logs of some names, each once, in their order.

    A file is a log whatever its suffix; of a folder, all files below with a known suffix are, and ROS 2 folders. A
    folder that cannot be read is listed itself, so that its row says so.

    Args:
        paths: Files, folders, and patterns such as `"flights/*/imu.npz"`, with `**` for any folders between; or one.
        manifest: Text file with one such name a line, relative to its own folder, in UTF-8 or, as Windows writes it,
            with a byte order mark or in UTF-16; lines that begin with `#` do not count. What it names and is not
            there is listed all the same.

    Raises:
        FileNotFoundError: A name or a pattern without files, or a manifest that does not exist.
        ValueError: No log at all.
    """
    found: dict[str, Path] = {}
    for path in [paths] if isinstance(paths, str | Path) else paths:
        for log in _logs_of(Path(path)):
            found.setdefault(identity(log), log)
    if manifest is not None:
        for path in _listed(Path(manifest)):
            for log in _expanded_or_itself(path):
                found.setdefault(identity(log), log)
    if not found:
        raise ValueError(f"`paths`: expected logs ({' '.join(SUFFIXES)}) or folders with some, found none")
    return tuple(found.values())


def groups_of(
    logs: Sequence[Path], size: int, done: Collection[str] = (), last: Collection[str] = (), alone: Collection[str] = ()
) -> tuple[tuple[Path, ...], ...]:
    """Consecutive logs in groups of up to `size`, without those that are done; the largest groups first.

    The groups are formed of all logs, done or not, so that results do not depend on where a run was stopped. The order
    balances the work of processes that take groups in turns.

    Args:
        logs: Logs of the fleet.
        size: Number of logs in a group.
        done: Identities of logs that are left out.
        last: Identities of logs whose groups come after all others.
        alone: Identities of logs that form a group each.
    """
    known = {log: identity(log) for log in logs}
    groups = [logs[i : i + size] for i in range(0, len(logs), size)]
    parts = [tuple(log for log in group if known[log] not in done and known[log] not in alone) for group in groups]
    parts += [(log,) for log in logs if known[log] in alone and known[log] not in done]

    def place(group: tuple[Path, ...]) -> tuple[bool, int]:
        return any(known[log] in last for log in group), -sum(state_of(log).size or 0 for log in group)

    return tuple(sorted(filter(None, parts), key=place))


def _logs_of(path: Path) -> Iterable[Path]:
    logs = _expanded(path)
    if not logs and path.is_dir():
        return ()
    if not logs:
        what = "file fits the pattern" if any(c in str(path) for c in _WILD) else "such file or folder"
        raise FileNotFoundError(f"{path}: no {what}; check the name")
    return logs


def _expanded(path: Path) -> list[Path]:
    """Logs of a file, a folder or a pattern; a broken link counts as a log, and its row says so."""
    if os.path.isdir(path):
        return list(_walked(path))
    if os.path.lexists(path):
        return [path]
    if not any(c in str(path) for c in _WILD):
        return []
    return [log for name in sorted(glob.glob(str(path), recursive=True)) for log in _expanded(Path(name))]


def _expanded_or_itself(path: Path) -> list[Path]:
    """Logs of a line of a manifest; the line itself where there are none, so that its row says so."""
    try:
        return _expanded(path) or [path]
    except ValueError:  # no name of a file
        return [path]


def _walked(folder: Path) -> Iterator[Path]:
    """Logs below a folder, and folders that cannot be read, sorted by name."""
    unreadable: list[Path] = []
    for name, folders, files in os.walk(folder, onerror=lambda error: unreadable.append(Path(error.filename))):
        if "metadata.yaml" in files:
            folders.clear()
            yield Path(name)
            continue
        folders.sort()
        yield from (Path(name) / file for file in sorted(files) if _is_log(file))
    yield from unreadable


def _is_log(name: str) -> bool:
    return not name.startswith(".") and Path(name).suffix.lower() in SUFFIXES


def _listed(manifest: Path) -> list[Path]:
    """Names in a manifest. An invalid byte affects its own line alone."""
    content = manifest.read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):  # as PowerShell writes it
        text = content.decode("utf-16", "replace")
    else:
        text = content.decode("utf-8-sig", "surrogateescape")
    lines = [line.strip() for line in text.splitlines()]
    return [manifest.parent / line for line in lines if line and not line.startswith("#")]
