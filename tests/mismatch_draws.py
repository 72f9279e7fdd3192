"""Draws and nominations that tests of impulsive mechanisms share."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.mechanism import Finding, Mechanism

LEVEL = 5e-4


def even(*shape: int, g: torch.Generator) -> Tensor:
    return torch.rand(shape, generator=g, dtype=torch.float64)


def normal(*shape: int, g: torch.Generator) -> Tensor:
    return torch.randn(shape, generator=g, dtype=torch.float64)


def nominated(case: Case, mechanism: type[Mechanism]) -> Finding:
    found = mechanism.nominate(case, LEVEL)
    assert found is not None
    return found
