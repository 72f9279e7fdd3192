"""Files and folders that appear whole or not at all: checked before the work, renamed into place at its end."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal

import numpy as np

_NO_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF)  # what file systems that cannot sync a folder say


class Outputs:
    """Files to be written together; `with Outputs(paths) as drafts` gives the path to write to for each of them.

    When the block ends all take their names; when it fails none appears, and what was there stays. Without `force` a
    name that was taken while the block ran stays with whoever took it, and none of these appears.

    Args:
        paths: Where the files go.
        force: Whether existing files may be replaced.
        inputs: Files that must not be replaced in any case.

    Raises:
        FileNotFoundError: A folder does not exist.
        FileExistsError: A file exists and `force` is not set, at the beginning or at the end.
        OSError: A folder cannot be written to.
        ValueError: A file is named twice, is one of `inputs`, or is not a file.
    """

    def __init__(self, paths: Iterable[Path], *, force: bool = False, inputs: Iterable[Path] = ()) -> None:
        used = {path.resolve() for path in inputs}
        self._drafts: dict[Path, Path] = {}
        self._force = force
        try:
            for path in paths:
                where = _target(path)
                if where in used:
                    raise ValueError(f"{path}: is in use by the same command; choose another name")
                if where.exists() and not where.is_file():
                    raise ValueError(f"{path}: expected the name of a file, found something else; choose another name")
                _check_absent(path, force)
                used.add(where)
                self._drafts[path] = _draft(path)
                with creating(path):
                    self._drafts[path].touch(exist_ok=False)
        except BaseException:
            self._discard()
            raise

    def __enter__(self) -> dict[Path, Path]:
        return self._drafts

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._publish()
        finally:
            self._discard()

    def _publish(self) -> None:
        if self._force:
            for path, draft in self._drafts.items():
                draft.replace(path.resolve())
            return
        placed: list[Path] = []
        try:
            for path, draft in self._drafts.items():
                _place_new(draft, path)
                placed.append(path.resolve())
        except BaseException:
            for where in placed:  # all or none
                where.unlink()
            raise

    def _discard(self) -> None:
        for draft in self._drafts.values():
            with suppress(OSError):  # of a folder that takes no changes: what is said of that counts
                draft.unlink(missing_ok=True)


@contextmanager
def output_folder(path: Path, *, own: Collection[str], force: bool = False) -> Iterator[Path]:
    """Write a folder that appears whole or not at all.

    Args:
        path: The folder.
        own: Names that it holds; an existing folder with anything else in it is never replaced.
        force: Whether an existing folder may be replaced.

    Yields:
        The folder to write to, which takes its name when the block ends.

    Raises:
        FileNotFoundError: The folder around it does not exist.
        FileExistsError: It exists and `force` is not set.
        OSError: The folder around it cannot be written to.
        ValueError: It holds anything else.
    """
    where = path.resolve()
    _check_absent(path, force)
    if where.exists():
        others = sorted({entry.name for entry in where.iterdir()} - {*own}) if where.is_dir() else ["it is a file"]
        if others:
            raise ValueError(f"{path}: holds something else ({others[0]}) and is left alone; choose another folder")
    draft, before = _draft(path), _draft(path)
    with creating(path):
        draft.mkdir()
    try:
        yield draft
        _check_absent(path, force)  # what another run made meanwhile
        if where.exists():
            where.rename(before)
        draft.rename(where)
        shutil.rmtree(before, ignore_errors=True)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def sync_file(path: Path) -> None:
    """Have a file on the disk before anything that comes later."""
    file = os.open(path, os.O_RDWR)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def sync_folder(folder: Path) -> None:
    """The same of the names in a folder, where the system can."""
    try:
        entry = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folder
        return
    try:
        os.fsync(entry)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise
    finally:
        os.close(entry)


def _draft(path: Path) -> Path:
    """A name beside the file behind `path`, so that renaming it does not leave the file system."""
    return path.resolve().with_name(f".{secrets.token_hex(8)}{path.suffix}")


def _target(path: Path) -> Path:
    """The file behind links."""
    try:
        return path.resolve()
    except RuntimeError:
        raise ValueError(f"{path}: is a link that leads to itself; choose another name") from None


def _place_new(draft: Path, path: Path) -> None:
    """Give a file its name, which nothing may have taken: a second run of the same command, say, that ended sooner."""
    where = path.resolve()
    try:
        os.link(draft, where)
    except FileExistsError:
        _check_absent(path, force=False)
        raise
    except OSError:  # a file system without hard links: a name is taken by an empty file, then that is replaced
        try:
            where.touch(exist_ok=False)
        except FileExistsError:
            _check_absent(path, force=False)
            raise
        draft.replace(where)


def _check_absent(path: Path, force: bool) -> None:
    if path.exists() and not force:
        raise FileExistsError(f"{path}: exists already; choose another name, or replace it with --force (`force`)")


@contextmanager
def creating(path: Path) -> Iterator[None]:
    """Say what a folder that takes no new file means for `path`, which is to appear in it."""
    try:
        yield
    except FileNotFoundError:
        if path.resolve().parent.is_dir():  # a file system that makes its own files, such as /proc
            raise OSError(f"{path}: the folder {path.parent} takes no new files; choose another place") from None
        raise FileNotFoundError(f"{path}: the folder {path.parent} does not exist; create it first") from None
    except OSError as error:
        raise OSError(f"{path}: cannot be written there ({error.strerror}); choose another place") from None


def write_npz(file: Path | IO[bytes], arrays: Mapping[str, Any], mode: Literal["w", "a"] = "w") -> None:
    """Write arrays as the members of an .npz, or with mode "a" add them to one.

    `numpy.savez` takes names as keyword arguments, of which `file` and `allow_pickle` are its own.
    """
    with zipfile.ZipFile(file, mode) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
