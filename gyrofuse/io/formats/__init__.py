"""Log files, one module per format.

A module of a format has one function, `read(request: Request) -> list[Stream]`, which returns one stream for each
device as the log holds it and raises `RecordingError` where the log cannot be read. A new format is one such module,
and one line in `_READERS` below for each suffix of its files. Limits on memory are kept with `request.allowance()`;
logs of named columns or arrays go through `column_streams` or `arrays`, so that all formats understand the same names.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from gyrofuse.io.formats.request import Request
from gyrofuse.io.limits import is_regular
from gyrofuse.io.streams import RecordingError, Stream, unexpected

_READERS = {
    ".npz": "numpy.recordings",
    ".npy": "numpy.recordings",
    ".csv": "text.text",
    ".tsv": "text.text",
    ".txt": "text.text",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".mat": "matlab.matlab",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".hdf": "hdf5",
    ".ulg": "robots.ulog",
    ".bin": "robots.dataflash",
    ".log": "robots.dataflash",
    ".bag": "robots.rosbag",
    ".db3": "robots.rosbag",
    ".mcap": "robots.rosbag",
}
SUFFIXES = tuple(_READERS)
_TOPICS = ("robots.ulog", "robots.rosbag", "robots.dataflash")  # formats of messages with fixed fields, not of columns


def read_streams(request: Request) -> list[Stream]:
    """Read the devices of a log with the reader of its format.

    Args:
        request: The log and the part of it to read. The suffix of its name says the format.

    Raises:
        FileNotFoundError: No such file.
        PermissionError: The file may not be read.
        RecordingError: An unknown format, a pipe or device, an empty file, or an error of the format's reader.
        ImportError: The format's library is not installed.
    """
    reader = _reader(request.path)
    if request.columns is not None and reader in _TOPICS:
        raise RecordingError(
            f"{request.path}: expected a log with named columns or arrays (`columns`, --map), found one of topics; "
            "choose with `key`"
        )
    module = import_module(f"gyrofuse.io.formats.{reader}")
    try:
        streams: list[Stream] = module.read(request)
    except (RecordingError, ImportError):
        raise
    except Exception as error:  # the effects of a damaged log on a reader are not all foreseen
        raise unexpected(request.path, error) from error
    return streams


def _reader(path: Path) -> str:
    """Module that reads a log."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file; check the name and the folder")
    if path.is_dir():
        if not is_regular(path / "metadata.yaml"):
            raise RecordingError(f"{path}: expected a log, or a ROS 2 folder with metadata.yaml, found another folder")
        return "robots.rosbag"
    if path.suffix.lower() not in _READERS:
        known = " ".join(SUFFIXES)
        raise RecordingError(f"{path}: expected a log ({known}), found {path.suffix or 'no suffix'!r}; convert it")
    if not is_regular(path):
        raise RecordingError(f"{path}: expected a log, found a pipe or device, which has no end; copy it into a file")
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: expected a log, found an empty file; record or copy it again")
    with path.open("rb"):  # raises the error of a file that may not be read
        return _READERS[path.suffix.lower()]
