"""Shapes that a mechanism declares of its numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from torch import Tensor


@dataclass(frozen=True)
class Dims:
    """Shape of a tensor among a mechanism's numbers, which is made sure of where they are read from a file.

    Attributes:
        names: Of its axes: `sensor` is as long as the array has sensors, others of one name have one length.
        complex: Whether its numbers are complex.
        infinite: Whether they may be infinite.
    """

    names: tuple[str, ...]
    complex: bool = False
    infinite: bool = False


OfSensors = Annotated[Tensor, Dims(("sensor",))]
ComplexOfSensors = Annotated[Tensor, Dims(("sensor",), complex=True)]
