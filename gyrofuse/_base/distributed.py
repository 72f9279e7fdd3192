"""What processes that share a piece of work tell each other, beyond tensors that add up."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from torch import distributed

if TYPE_CHECKING:
    from lightning.fabric import Fabric


def place(fabric: Fabric | None) -> tuple[int, int]:
    """Which process this is, and of how many.

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


def told_by_first(value: Any, world_size: int) -> Any:
    """What the first process gives, in all of them."""
    if world_size > 1:
        told = [value]
        distributed.broadcast_object_list(told, src=0)
        return told[0]
    return value


@contextmanager
def all_or_none(otherwise: str, world_size: int) -> Iterator[None]:
    """Work that is worth something if all processes do their share: nobody waits for one that fails.

    Args:
        otherwise: What is to be said if one fails, a clause: "x.npy was not written".
        world_size: Number of processes.

    Raises:
        RuntimeError: Another process failed; that one raises what happened to it.
    """
    try:
        yield
    except BaseException:
        _told_of(True, world_size)
        raise
    if failed := [str(rank) for rank, whether in enumerate(_told_of(False, world_size)) if whether]:
        raise RuntimeError(
            f"{otherwise}, for process(es) {', '.join(failed)} of {world_size} failed; their own errors say why"
        )


def _told_of(failed: bool, world_size: int) -> list[bool]:
    """Who failed, in all processes."""
    told = [failed] * world_size
    if world_size > 1:
        distributed.all_gather_object(told, failed)
    return told
