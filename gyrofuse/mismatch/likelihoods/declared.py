"""What was declared by subclassing: a search knows the kinds of what it looks for by their base alone."""

from __future__ import annotations

from typing import TypeVar

_T = TypeVar("_T")


def declared(base: type[_T]) -> list[type[_T]]:
    """All classes under a base, in the order of their names, whatever was imported first."""
    found: set[type[_T]] = set()
    new = {base}
    while new:
        new = {kind for parent in new for kind in parent.__subclasses__()} - found
        found |= new
    return sorted(found, key=lambda kind: (kind.__module__, kind.__qualname__))
