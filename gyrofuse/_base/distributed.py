"""Helpers for torch.distributed: ranks, broadcast of objects, and errors that reach all processes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from torch import distributed

if TYPE_CHECKING:
    from lightning.fabric import Fabric


def rank_and_size(fabric: Fabric | None) -> tuple[int, int]:
    """Rank of this process, and the number of processes.

    Args:
        fabric: Of Lightning; one process without.

    Raises:
        RuntimeError: Several processes were asked for and not started.
    """
    if fabric is None:
        return 0, 1
    if fabric.world_size > 1 and not (distributed.is_available() and distributed.is_initialized()):
        raise RuntimeError(
            f"`fabric`: expected {fabric.world_size} processes that know of each other, found no process group; "
            "call fabric.launch() first"
        )
    return fabric.global_rank, fabric.world_size


def broadcast_from_first(value: Any, world_size: int) -> Any:
    """The value of the first process, in all of them.

    Args:
        value: Any object that can be pickled; only that of the first process counts.
        world_size: Number of processes.
    """
    if world_size > 1:
        gathered = [value]
        distributed.broadcast_object_list(gathered, src=0)
        return gathered[0]
    return value


@contextmanager
def all_or_none(otherwise: str, world_size: int) -> Iterator[None]:
    """Work that only counts if all processes finish it: where one fails, the others raise instead of waiting.

    Args:
        otherwise: Consequence of a failure, for the message: "x.npy was not written".
        world_size: Number of processes.

    Raises:
        RuntimeError: Another process failed; that one raises what happened to it.
    """
    try:
        yield
    except BaseException:
        _failures(True, world_size)
        raise
    if failed := [str(rank) for rank, whether in enumerate(_failures(False, world_size)) if whether]:
        raise RuntimeError(
            f"{otherwise}, for process(es) {', '.join(failed)} of {world_size} failed; their own errors say why"
        )


def _failures(failed: bool, world_size: int) -> list[bool]:
    """Whether each process failed, gathered from all."""
    gathered = [failed] * world_size
    if world_size > 1:
        distributed.all_gather_object(gathered, failed)
    return gathered
