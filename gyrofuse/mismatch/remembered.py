"""Values derived from one side of a case, computed once and kept as long as the side is."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar
from weakref import WeakKeyDictionary

from gyrofuse.mismatch.side import Side

Derived = TypeVar("Derived")


def remembered(function: Callable[[Side], Derived]) -> Callable[[Side], Derived]:
    """The function, evaluated once for each side."""
    known: WeakKeyDictionary[Side, Derived] = WeakKeyDictionary()

    @functools.wraps(function)
    def lookup(side: Side) -> Derived:
        if side not in known:
            known[side] = function(side)
        return known[side]

    return lookup
