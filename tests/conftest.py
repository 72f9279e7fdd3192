"""Data beside the repository, shared by every test that compares with other people's numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder `shared` beside the repository, with `data` and `reference`."""
    if not SHARED.is_dir():
        pytest.skip("needs the recordings and published numbers of the folder `shared` beside the repository")
    return SHARED
