"""Noise models: processes, their sums, arrays of them, and what a data sheet says of them."""

from gyrofuse.noise.datasheet import Datasheet
from gyrofuse.noise.state_space import StateSpace

__all__ = ["Datasheet", "StateSpace"]
