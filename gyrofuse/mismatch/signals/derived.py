"""Cached properties that stand beside their class: what a test derives from a comparison is kept in that comparison."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

Source = TypeVar("Source")
Derived = TypeVar("Derived")


def derived(function: Callable[[Source], Derived]) -> Callable[[Source], Derived]:
    """Evaluate a function of an immutable object once, and keep the value in that object, as `cached_property` does.

    Args:
        function: Of one object whose attributes never change, `Comparison` or `Records`.
    """
    name = f"{function.__module__}.{function.__qualname__}"

    @functools.wraps(function)
    def value(source: Source) -> Derived:
        kept = vars(source)
        if name not in kept:
            kept[name] = function(source)
        return kept[name]

    return value
