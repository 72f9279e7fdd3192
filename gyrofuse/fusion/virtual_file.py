"""The virtual gyro of a long recording as a file, written by one process or by many."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.checks import check_floating
from gyrofuse._base.distributed import all_or_none, place, told_by_first
from gyrofuse._base.files import Outputs
from gyrofuse.fusion.result import fuse
from gyrofuse.io.chunked import ChunkedRecording, Progress, check_chunked_recording, shard_bounds, silent

if TYPE_CHECKING:
    from lightning.fabric import Fabric


def write_virtual(
    recording: ChunkedRecording,
    weights: Tensor,
    path: str | Path,
    *,
    chunk_samples: int | None = None,
    fabric: Fabric | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> None:
    """Fuse a long recording with given weights into a `.npy` file `(time,)`, float64, chunk by chunk.

    Each process writes its stretch of time. The file appears whole or not at all; a sample that any sensor lacks is
    NaN.

    Args:
        recording: What is read.
        weights: `(sensor,)`.
        path: Where the file goes, on a file system that all processes share.
        chunk_samples: Samples of each sensor that are read at a time; by default 16 MiB.
        fabric: The processes, as for `stream_svo`.
        force: Whether an existing file may be replaced.
        progress: Is told what is done and the share that is, of this process's stretch.

    Raises:
        TypeError: `recording` is not a `ChunkedRecording`, or `weights` no floating point tensor.
        ValueError: The name does not end in .npy or is that of the recording, or there is not one weight for each
            sensor.
        FileExistsError: The file exists and `force` is not set.
        FileNotFoundError: The folder does not exist.
        RuntimeError: `fabric` was not launched, or another process failed.
    """
    check_chunked_recording(recording)
    path = Path(path)
    if path.suffix.lower() != ".npy":
        raise ValueError(f"`path`: expected a name that ends in .npy, got {path.name!r}")
    if recording.path is not None and path.resolve() == recording.path:
        raise ValueError(f"`path`: expected another file than the log that is read, got {path}; choose another name")
    check_floating("weights", weights)
    if weights.shape != (recording.n_sensors,):
        raise ValueError(
            f"`weights`: expected one for each of {recording.n_sensors} sensors, got shape {tuple(weights.shape)}"
        )
    start, stop = shard_bounds(recording.n_samples, *place(fabric))
    values = weights.detach().to("cpu", torch.float64)
    with _draft_for_all(path, recording.n_samples, fabric, force=force) as (draft, offset), draft.open("r+b") as file:
        file.seek(offset + 8 * start)
        for end, chunk in recording.chunks(start, stop, chunk_samples):
            file.write(fuse(values, chunk).numpy().astype("<f8", copy=False).data)
            progress("writing", (end - start) / (stop - start))


@contextmanager
def _draft_for_all(path: Path, n_samples: int, fabric: Fabric | None, *, force: bool) -> Iterator[tuple[Path, int]]:
    """A `.npy` file (time,) that all processes write to, and where its numbers begin.

    It takes its name when all of them are done, and vanishes when one fails.
    """
    rank, world_size = place(fabric)
    with ExitStack() as stack:
        found: tuple[Path, int] | Exception | None = None
        if rank == 0:
            try:
                draft = stack.enter_context(Outputs([path], force=force))[path]
                found = draft, _make_npy(draft, n_samples)
            except (OSError, ValueError) as error:
                found = error  # the others, who would wait for ever, are told as well
        found = told_by_first(found, world_size)
        if isinstance(found, Exception):
            raise found
        with all_or_none(f"{path}: was not written", world_size):
            yield found
    if fabric is not None:
        fabric.barrier()  # the file has its name before anyone goes on


def _make_npy(draft: Path, n_samples: int) -> int:
    """Make a file of the final size, and return where its numbers begin."""
    with draft.open("wb") as file:
        header = {"descr": "<f8", "fortran_order": False, "shape": (n_samples,)}
        np.lib.format.write_array_header_1_0(file, header)
        offset = file.tell()
        file.truncate(offset + 8 * n_samples)
    return offset
