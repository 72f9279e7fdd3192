"""Settings that a file states beside its arrays: sampling rate, unit, names of sensors."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from gyrofuse._base.units import canonical_unit, quantity_of
from gyrofuse.io.limits import LONGEST_NAME, decoded, is_rate
from gyrofuse.io.quantities import Quantity

_RATE = ("fs rate samplingrate samplerate samplingfrequency samplefrequency samplefreq outputrate updaterate").split()
_UNIT = ("unit", "units")
_SENSORS = ("sensors", "sensornames")
# Numbers and text by the group that holds them ("" is the file) and their name in lower case letters.
Settings = Mapping[tuple[str, str], Any]


def settings_by_group(values: Mapping[str, Any]) -> Settings:
    """Arrange numbers and text by the group that holds them and their name in lower case letters, without `hz`.

    Args:
        values: Numbers and text by name, `group/name`.
    """
    settings = {}
    for path, value in values.items():
        group, _, name = path.rpartition("/")
        letters = "".join(letter for letter in name.lower() if "a" <= letter <= "z")
        settings[group, letters.removesuffix("hz")] = value
    return settings


def stated_rate(settings: Settings, name: str) -> float | None:
    """Return the sampling rate in Hz that is stated nearest to an array, `None` where there is none.

    Args:
        settings: Numbers and text of the file, as `settings_by_group` arranges them.
        name: Name of the array, `""` for the whole file.
    """
    value = _nearest(settings, name, _RATE)
    if np.iscomplexobj(value):
        return None
    try:
        rate = float(_text(value) or np.asarray(value, dtype=np.float64).item())
    except (TypeError, ValueError):
        return None
    return rate if is_rate(rate) else None


def stated_unit(settings: Settings, name: str, quantity: Quantity, kinds: Collection[str]) -> str:
    """Return the unit that is stated nearest to the array `name`, `"unknown"` where there is none.

    A unit of the other quantity in a group around the array belongs to arrays of that quantity, if the file has any.

    Args:
        settings: Numbers and text of the file, as `settings_by_group` arranges them.
        name: Name of the array, or of the group that holds it.
        quantity: Quantity of the array.
        kinds: Kinds of all arrays of the file.
    """
    if own := canonical_unit(own_unit(settings, name)) if name else "":
        return own
    unit = canonical_unit(_text(_nearest(settings, name, _UNIT)))
    measured = quantity_of(unit)
    return "unknown" if not unit or (measured != quantity.name and measured in kinds) else unit


def own_unit(settings: Settings, name: str) -> str:
    """Return the unit that an attribute of the array `name` states, `""` where there is none."""
    return next((_text(settings[name, s]) for s in _UNIT if (name, s) in settings), "")


def nearest_names(settings: Settings) -> Callable[[str], list[str]]:
    """A function that returns the names of sensors that are stated nearest to an array.

    Args:
        settings: Numbers and text of the file, as `settings_by_group` arranges them.
    """
    known: dict[int, list[str]] = {}  # by the identity of the setting, which many arrays share

    def names(name: str) -> list[str]:
        setting = _nearest(settings, name, _SENSORS)
        if id(setting) not in known:
            known[id(setting)] = list(dict.fromkeys(_texts(setting)))
        return known[id(setting)]

    return names


def _nearest(settings: Settings, name: str, spellings: Sequence[str]) -> Any:
    """The setting of the array itself, else of the groups around it, the innermost first."""
    parts = name.split("/")
    around = ["/".join(parts[:i]) for i in range(len(parts), 0, -1)] + [""]
    return next((settings[group, s] for group in around for s in spellings if (group, s) in settings), None)


def _texts(value: Any) -> list[str]:
    flat = np.asarray(value).ravel()
    if flat.dtype.kind not in "USO":
        return []
    words = [decoded(item) if isinstance(item, bytes) else item for item in flat.tolist()]
    return [word[:LONGEST_NAME].strip() for word in words if isinstance(word, str)]


def _text(value: Any) -> str:
    return (*_texts(np.asarray(value).ravel()[:1]), "")[0]
