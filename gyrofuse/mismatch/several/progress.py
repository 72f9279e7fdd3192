"""Progress of one diagnosis among several."""

from __future__ import annotations

from collections.abc import Callable, Sequence

Progress = Callable[[str, float], None]


def part_of(progress: Progress, names: Sequence[str], place: int) -> Progress:
    """Tell the progress of the diagnosis at a place as that of all.

    Args:
        progress: Function of what is searched, and of the share of all work that is done.
        names: Of the diagnoses, in order.
        place: Position of this one.
    """
    return lambda what, share: progress(f"{names[place]}: {what}", (place + share) / len(names))
