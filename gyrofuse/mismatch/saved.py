"""A repaired simulation read back from plain numbers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import torch

from gyrofuse.mismatch.base import Base
from gyrofuse.mismatch.case import Scene
from gyrofuse.mismatch.mechanism import Mechanism
from gyrofuse.mismatch.mechanisms import STAGES
from gyrofuse.mismatch.remainder import Remainder
from gyrofuse.mismatch.repaired import RepairedModel
from gyrofuse.parsing import model_from_dict
from gyrofuse.simulate import ArrayModel


def repaired_from_dict(description: Mapping[str, Any]) -> RepairedModel:
    """Rebuild the repaired simulation whose `to_dict` gave `description`; auxiliary channels are not among it.

    Raises:
        ValueError: Missing entries, an unknown mechanism, or numbers that do not fit it.
    """
    try:
        noise = model_from_dict(description["noise"])
        scene = Scene(float(description["rate"]), str(description["unit"]), tuple(description["sensors"]))
        effects = tuple(_effect(entry) for entry in description["effects"])
    except (KeyError, TypeError) as error:
        raise ValueError(
            "`description`: expected the entries noise, effects, rate, unit and sensors of a repaired simulation, got "
            f"{sorted(description)} ({type(error).__name__}: {error})"
        ) from None
    if not isinstance(noise, ArrayModel):
        raise ValueError("`description`: expected the noise of an array, got that of a sensor")
    return RepairedModel(noise, scene, effects, int(description.get("noise_samples", 0)))


def _effect(entry: Mapping[str, Any]) -> Mechanism:
    kinds = {kind.__name__: kind for kind in (*itertools.chain(*STAGES), Remainder)}
    if entry["kind"] not in kinds:
        raise ValueError(f"`description`: expected a mechanism among {', '.join(kinds)}, got {entry['kind']!r}")
    return _rebuilt(kinds[entry["kind"]], entry["numbers"])


def _rebuilt(kind: Any, numbers: Mapping[str, Any]) -> Any:
    """A dataclass from the plain numbers of its fields, by what they are declared to be."""
    saved = (field for field in fields(kind) if field.metadata.get("saved", True))
    return kind(**{field.name: _value(str(field.type), numbers[field.name]) for field in saved})


def _value(declared: str, value: Any) -> Any:
    if declared == "Tensor" and isinstance(value, Mapping):
        return torch.complex(_value(declared, value["real"]), _value(declared, value["imag"]))
    if declared == "Tensor":
        return torch.from_numpy(np.array(_finished(value)))
    return _rebuilt(Base, value) if declared == "Base" else _finished(value)


def _finished(value: Any) -> Any:
    """Tuples in place of lists, and numbers that are not finite in place of their names."""
    if isinstance(value, list):
        return tuple(_finished(entry) for entry in value)
    return float(value) if value in ("inf", "-inf", "nan") else value
