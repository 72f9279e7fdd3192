"""How many items are worked on at a time: one budget of memory for all that goes through batches in parts."""

from __future__ import annotations

# Numbers, in float64, of the largest array that one step of a calculation makes: 32 MiB. Several such arrays side by
# side stay far below the memory of a small computer, and parts are large enough that the loop over them costs nothing.
MEMORY = 2**22
# Numbers of an array that is swept over many times, such as a batch of transforms: 4 MiB stay in the cache of a core.
CACHE = 2**19


def items_at_once(numbers: int, budget: int = MEMORY) -> int:
    """Number of items that fit a budget, at least one.

    Args:
        numbers: Size of the largest array that one item makes.
        budget: Numbers that all items of a part may make together.
    """
    return max(budget // max(numbers, 1), 1)
