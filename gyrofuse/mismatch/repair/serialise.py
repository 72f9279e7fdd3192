"""A repaired simulation read back from plain numbers.

A field of a mechanism comes back as what it is declared to be: `typing.get_type_hints` tells its kind, the `Dims`
beside a tensor its shape. What fits its declaration may still be absurd, so each effect has to act on a short record.
"""

from __future__ import annotations

import math
import sys
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import torch
from torch import Tensor

from gyrofuse._base.checks import check_n_samples, check_positive
from gyrofuse.mismatch.mechanisms.catalogue import CATALOGUE
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.repair.session_model import SessionModel
from gyrofuse.mismatch.signals.comparison import RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.parsing import model_from_dict

_TRIED = 256  # samples of the record that every effect has to act on: filters of all forms have died away in so many
_KINDS = {int: "a whole number", str: "a text", bool: "true or false", dict: "an effect"}


def repaired_from_dict(description: Mapping[str, Any]) -> RepairedModel:
    """Rebuild the repaired simulation whose `to_dict` gave `description`; auxiliary channels are not among it.

    Raises:
        ValueError: Missing entries, an unknown mechanism, or numbers that do not fit it.
    """
    try:
        noise = model_from_dict(description["noise"])
        info = RecordingInfo(
            check_positive("rate", _value(float, description["rate"], "rate", {})),
            _value(str, description["unit"], "unit", {}),
            _value(tuple[str, ...], description["sensors"], "sensors", {}),
        )
        noise_samples = check_n_samples("noise_samples", description.get("noise_samples", 0))
        entries = _value(tuple[dict, ...], description["effects"], "effects", {})
    except (KeyError, TypeError, OverflowError) as error:
        raise ValueError(
            "`description`: expected the entries noise, effects, rate, unit and sensors of a repaired simulation, got "
            f"{sorted(map(str, description))} ({type(error).__name__}: {error})"
        ) from None
    if not isinstance(noise, ArrayModel):
        raise ValueError("`description`: expected the noise of an array, got that of a sensor")
    if noise.n_sensors != len(info.sensors):
        raise ValueError(
            f"`description`: expected the names of {noise.n_sensors} sensors, as many as the noise is of, got "
            f"{len(info.sensors)}"
        )
    effects = tuple(_effect(entry, f"effects.{k}", len(info.sensors)) for k, entry in enumerate(entries))
    model = RepairedModel(noise, info, effects, noise_samples)
    for k, effect in enumerate(effects):
        _try(model, effect, f"effects.{k}")
    return model


def sessions_from_dict(description: Mapping[str, Any]) -> SessionModel:
    """Rebuild the simulation of several sessions whose `to_dict` gave `description`.

    Raises:
        ValueError: No session, one that `repaired_from_dict` refuses, or sessions of different arrays.
    """
    entries = description.get("sessions")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, Mapping) for entry in entries):
        raise _wrong("sessions", "a list of repaired simulations", entries)
    models = tuple(map(repaired_from_dict, entries))
    grids = {(model.info.rate, model.info.unit, len(model.info.sensors)) for model in models}
    if len(grids) > 1:
        raise _wrong("sessions", "one rate, unit and number of sensors", str(sorted(grids)))
    return SessionModel(models)


def _effect(entry: Mapping[str, Any], where: str, n_sensors: int) -> Mechanism:
    kinds = {kind.__name__: kind for kind in CATALOGUE}
    kind, numbers = entry.get("kind"), entry.get("numbers")
    if not isinstance(kind, str) or kind not in kinds:
        raise ValueError(f"`description`: expected in {where} a mechanism among {', '.join(kinds)}, got {kind!r}")
    effect = _rebuilt(kinds[kind], numbers, f"{where}.numbers", {"sensor": n_sensors})
    return typing.cast(Mechanism, effect)


def _rebuilt(kind: Any, numbers: Any, where: str, lengths: dict[str, int]) -> Any:
    """A dataclass from the plain numbers of its fields, by what they are declared to be.

    Args:
        kind: The dataclass.
        numbers: By the names of its fields.
        where: Place in the description.
        lengths: Of the axes that are known, by name; those of its tensors are added.
    """
    if not isinstance(numbers, Mapping):
        raise _wrong(where, f"the numbers of a {kind.__name__} by their names", numbers)
    hints = get_type_hints(kind, include_extras=True)
    values = {}
    for entry in fields(kind):
        if not entry.metadata.get("saved", True):
            continue
        # Saved before there was another kind, or more than one number.
        if entry.name not in numbers and (entry.metadata.get("plain", False) or entry.default == ()):
            continue
        if entry.name not in numbers:
            raise _wrong(where, f"an entry {entry.name!r}", sorted(map(str, numbers)))
        values[entry.name] = _value(hints[entry.name], numbers[entry.name], f"{where}.{entry.name}", lengths)
    return kind(**values)


def _value(declared: Any, value: Any, where: str, lengths: dict[str, int]) -> Any:
    """One value as it is declared."""
    if get_origin(declared) is Annotated:
        declared, axes = get_args(declared)[:2]
        return _tensor(value, axes, where, lengths) if declared is Tensor else _number(value, where, infinite=True)
    if is_dataclass(declared):
        # Its axes are its own but for the sensors.
        return _rebuilt(declared, value, where, {"sensor": lengths["sensor"]})
    if get_origin(declared) is tuple:
        return _several(declared, value, where, lengths)
    if declared is float:
        return _number(value, where)
    if not isinstance(value, declared) or (isinstance(value, bool) and declared is not bool):
        raise _wrong(where, _KINDS[declared], value)
    if declared is int and abs(value) >= 2**63:
        raise _wrong(where, "a whole number of 64 bits", "a larger one")
    return value


def _several(declared: Any, value: Any, where: str, lengths: dict[str, int]) -> tuple[Any, ...]:
    """A tuple of one kind of entry and any length, or of given ones."""
    if not isinstance(value, list | tuple):
        raise _wrong(where, "a list", value)
    kinds = get_args(declared)
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(kinds) != len(value):
        raise _wrong(where, f"{len(kinds)} entries", value)
    return tuple(_value(kind, v, f"{where}.{k}", lengths) for k, (kind, v) in enumerate(zip(kinds, value, strict=True)))


def _number(value: Any, where: str, *, infinite: bool = False) -> float:
    """A number, finite unless it may be infinite."""
    if infinite and value in ("inf", "-inf"):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not _finite(value):
        raise _wrong(where, "a number" if infinite else "a finite number", value)
    if abs(value) > math.sqrt(sys.float_info.max):  # its square, a power, is not finite
        raise _wrong(where, "a number below 1e154", value)
    return float(value)


def _finite(value: float) -> bool:
    """Whether a float holds it; whole numbers may be too large for one."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def _tensor(value: Any, axes: Dims, where: str, lengths: dict[str, int]) -> Tensor:
    """A tensor of float64, or where it is complex from its parts."""
    if axes.complex:
        if not isinstance(value, Mapping) or not {"real", "imag"} <= set(value):
            raise _wrong(where, "complex numbers as their parts real and imag", value)
        parts = replace(axes, complex=False)
        return torch.complex(*(_tensor(value[part], parts, f"{where}.{part}", lengths) for part in ("real", "imag")))
    shape: list[int] = []
    level = [value]
    for name in axes.names:
        if not level or not all(isinstance(entry, list) and len(entry) == len(level[0]) for entry in level):
            raise _wrong(where, f"{_product(axes.names)} numbers as lists in lists of equal length", value)
        shape.append(len(level[0]))
        if lengths.setdefault(name, shape[-1]) != shape[-1]:
            raise _wrong(where, f"a list of {lengths[name]} along the axis {name}", f"one of {shape[-1]}")
        level = [entry for entries in level for entry in entries]
    flat = [_number(entry, where, infinite=axes.infinite) for entry in level]
    return torch.tensor(flat, dtype=torch.float64).view(shape)


def _product(names: tuple[str, ...]) -> str:
    return " x ".join(names)


def _try(model: RepairedModel, effect: Mechanism, where: str) -> None:
    """Make sure that an effect makes finite samples of a record of the noise; what follows a channel has none here."""
    if effect.follows:
        return
    generator = torch.Generator().manual_seed(0)
    signal = model.noise.simulate(_TRIED, generator=generator)
    try:
        finite = bool(effect.apply(signal, model.info, generator).isfinite().all())
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise _wrong(where, "an effect that can be simulated", f"{type(error).__name__}: {error}") from None
    if not finite:
        raise _wrong(where, "an effect that makes finite samples", f"a {type(effect).__name__} that does not")


def _wrong(where: str, expected: str, found: Any) -> ValueError:
    shown = found if isinstance(found, str) and " " in found else repr(found)
    shown = shown if len(shown) < 80 else f"{shown[:80]} ..."
    return ValueError(f"`description`: expected in {where} {expected}, got {shown}")
