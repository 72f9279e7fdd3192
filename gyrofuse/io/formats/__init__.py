"""Log files: one module per format, each with `read(path, *, key=None, max_bytes=None) -> list[Stream]`."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

from gyrofuse.io.limits import is_regular
from gyrofuse.io.streams import RecordingError, Stream, unexpected

# A format is a module with `read`, and a line here for each suffix of its files.
# A new format: a module here with `read`, and a line for each suffix of its files.
_READERS = {
    ".npz": "numpy.recordings",
    ".npy": "numpy.recordings",
    ".csv": "text.text",
    ".tsv": "text.text",
    ".txt": "text.text",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".mat": "matlab",
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
_TOPICS = ("robots.ulog", "robots.rosbag", "robots.dataflash")  # formats whose messages say themselves what they hold


def read_streams(
    path: Path,
    *,
    key: str | None = None,
    quantity: str = "rate",
    columns: Mapping[str, str] | None = None,
    max_bytes: float | None = None,
) -> list[Stream]:
    """Read the devices of a log, by the suffix of its name.

    Args:
        path: A file, or the folder of a ROS 2 bag.
        key: Which recording inside, where a log holds several.
        quantity: `"rate"` or `"acceleration"`: the sensors to read.
        columns: What columns or arrays are, where their names do not say: these by the names that they should have.
        max_bytes: Memory that its numbers may take; by default a quarter of what there is.

    Raises:
        FileNotFoundError: No such file.
        PermissionError: The file may not be read.
        RecordingError: A format that is not read, a pipe or device, an empty file, or what the format's reader raises.
        ImportError: The format's library is not installed.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file; check the name and the folder")
    if path.is_dir():
        if not is_regular(path / "metadata.yaml"):
            raise RecordingError(f"{path}: expected a log, or a ROS 2 folder with metadata.yaml, found another folder")
        reader = "robots.rosbag"
    elif path.suffix.lower() not in _READERS:
        known = " ".join(SUFFIXES)
        raise RecordingError(f"{path}: expected a log ({known}), found {path.suffix or 'no suffix'!r}; convert it")
    elif not is_regular(path):
        raise RecordingError(f"{path}: expected a log, found a pipe or device, which has no end; copy it into a file")
    elif path.stat().st_size == 0:
        raise RecordingError(f"{path}: expected a log, found an empty file; record or copy it again")
    else:
        with path.open("rb"):  # a file that may not be read says so itself
            reader = _READERS[path.suffix.lower()]
    if columns is not None and reader in _TOPICS:
        raise RecordingError(
            f"{path}: expected a log with named columns or arrays (`columns`, --map), found one of topics; choose with "
            "`key`"
        )
    module = import_module(f"gyrofuse.io.formats.{reader}")
    try:
        named = {} if columns is None else {"columns": columns}
        streams: list[Stream] = module.read(path, key=key, quantity=quantity, max_bytes=max_bytes, **named)
    except (RecordingError, ImportError):
        raise
    except Exception as error:  # what a damaged log does to a reader is never foreseen in full
        raise unexpected(path, error) from error
    return streams
