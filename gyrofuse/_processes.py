"""What processes that share a piece of work tell each other, beyond tensors that add up."""

from __future__ import annotations

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


def where_true(value: bool, world_size: int) -> list[int]:
    """Processes for which something is true, in all of them."""
    told: list[Any] = [value] * world_size
    if world_size > 1:
        distributed.all_gather_object(told, value)
    return [rank for rank, whether in enumerate(told) if whether]
