"""Cases of a parametrised test, of which a few are in the fast set and the others have the marker `slow`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import pytest


def slow_but_for(quick: Collection[str], cases: Mapping[str, Any] | Collection[str]) -> list[Any]:
    """Parameters for `pytest.mark.parametrize`, by their names: of a mapping its values, else the names themselves.

    Args:
        quick: Names of those in the fast set.
        cases: All of them.
    """
    named = cases if isinstance(cases, Mapping) else {name: name for name in cases}
    unknown = set(quick) - set(named)
    assert not unknown, f"no such cases: {unknown}"
    return [
        pytest.param(case, id=name, marks=() if name in quick else pytest.mark.slow) for name, case in named.items()
    ]
