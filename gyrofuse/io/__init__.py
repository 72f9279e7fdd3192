"""Log files: one module per format, each with `read(path, *, key=None) -> list[Stream]`."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from gyrofuse.io.stream import RecordingError, Stream

_READERS = {
    ".npz": "numpy_log",
    ".npy": "numpy_log",
    ".csv": "text",
    ".tsv": "text",
    ".txt": "text",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".mat": "matlab",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".hdf": "hdf5",
    ".ulg": "ulog",
    ".bag": "rosbag",
    ".db3": "rosbag",
    ".mcap": "rosbag",
}
SUFFIXES = tuple(_READERS)


def read_streams(path: Path, *, key: str | None = None) -> list[Stream]:
    """Read the devices of a log, by the suffix of its name.

    Args:
        path: A file, or the folder of a ROS 2 bag.
        key: Which recording inside, where a log holds several.

    Raises:
        FileNotFoundError: No such file.
        PermissionError: The file may not be read.
        RecordingError: A format that is not read, an empty file, or what the format's reader raises.
        ImportError: The format's library is not installed.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file; check the name and the folder")
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            raise RecordingError(f"{path}: expected a log, or a ROS 2 folder with metadata.yaml, found another folder")
        reader = "rosbag"
    elif path.suffix.lower() not in _READERS:
        known = " ".join(SUFFIXES)
        raise RecordingError(f"{path}: expected a log ({known}), found {path.suffix or 'no suffix'!r}; convert it")
    elif path.stat().st_size == 0:
        raise RecordingError(f"{path}: expected a log, found an empty file; record or copy it again")
    else:
        with path.open("rb"):  # a file that may not be read says so itself
            reader = _READERS[path.suffix.lower()]
    streams: list[Stream] = import_module(f"gyrofuse.io.{reader}").read(path, key=key)
    return streams
