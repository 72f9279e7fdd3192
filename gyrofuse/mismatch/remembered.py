"""Values derived from a case or one of its sides, computed once and kept as long as it is."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar
from weakref import WeakKeyDictionary

Source = TypeVar("Source")
Derived = TypeVar("Derived")


def remembered(function: Callable[[Source], Derived]) -> Callable[[Source], Derived]:
    """The function, evaluated once for each case or side."""
    known: WeakKeyDictionary[Source, Derived] = WeakKeyDictionary()

    @functools.wraps(function)
    def lookup(source: Source) -> Derived:
        if source not in known:
            known[source] = function(source)
        return known[source]

    return lookup
