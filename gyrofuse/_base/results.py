"""Base class of results, and text for messages and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor

_R = TypeVar("_R", bound="Result")


class ConfidenceInterval(NamedTuple):
    """Lower and upper limits of the same shape as the estimate."""

    low: Tensor
    high: Tensor


class Result:
    """Base of results, which are frozen dataclasses: text, plain numbers, and items of a batch.

    A subclass names the fields that begin with the dimensions of the batch in `_batched`, and in `_contents` the
    attributes that `to_dict` writes, by default its fields; in `_keys` the keys of those that have another name there.
    """

    _batched: ClassVar[tuple[str, ...]] = ()
    _contents: ClassVar[tuple[str, ...]] = ()
    _keys: ClassVar[dict[str, str]] = {}

    def summary(self) -> str:
        """The result as text of fixed width."""
        raise NotImplementedError

    def __str__(self) -> str:
        return self.summary()

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN and infinities as None)."""
        names = self._contents or [entry.name for entry in fields(self)]  # type: ignore[arg-type]
        return {self._keys.get(name, name): plain(getattr(self, name)) for name in names}

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions of the result; `()` for a single one."""
        raise NotImplementedError

    def __getitem__(self: _R, index: Any) -> _R:
        """One item, or some, of the leading batch dimensions."""
        size = len(index) if isinstance(index, tuple) else 1
        if size > len(self.batch_shape):
            raise IndexError(f"expected at most {len(self.batch_shape)} indices for batch shape {self.batch_shape}")
        return replace(self, **{name: _item(getattr(self, name), index) for name in self._batched})  # type: ignore[type-var]


def _item(value: Any, index: Any) -> Any:
    """An item of what a batched field holds: a tensor, a pair of limits or others, another result, or nothing."""
    if isinstance(value, ConfidenceInterval):
        return ConfidenceInterval(value.low[index], value.high[index])
    if isinstance(value, tuple):
        return tuple(part[index] for part in value)
    return None if value is None else value[index]


def scattered(value: Tensor, usable: Tensor, batch: Sequence[int], missing: float | bool = torch.nan) -> Tensor:
    """Put the items that could be worked on back into their places among all.

    Args:
        value: Of those items, `(usable item, ...)`.
        usable: Which of all items they are, `(item,)`, bool.
        batch: Dimensions that `item` stands for.
        missing: Value of the other items.

    Returns:
        `(*batch, ...)`.
    """
    whole = value.new_full((len(usable), *value.shape[1:]), missing)
    whole[usable] = value
    return whole.view((*batch, *value.shape[1:]))


def plain(value: Any) -> Any:
    """A value as plain lists, dictionaries and numbers, ready for JSON, with None for NaN and infinities."""
    if isinstance(value, ConfidenceInterval):
        return {"low": listed(value.low), "high": listed(value.high)}
    if isinstance(value, Tensor):
        return listed(value)
    if hasattr(value, "to_dict"):
        return cleaned(value.to_dict())
    if isinstance(value, tuple | list):
        return [plain(entry) for entry in value]
    return cleaned(value)


def named(names: Sequence[str], which: Sequence[int], most: int = 5) -> str:
    """Some of the names for a message, not more than a line can bear."""
    more = f" and {len(which) - most} more" if len(which) > most else ""
    return ", ".join(names[i] for i in which[:most]) + more


def counted(n: int, noun: str) -> str:
    """A number of things, such as `1 sensor` and `no lines`."""
    return f"{n or 'no'} {noun}" + ("" if n == 1 else "s")


def numbered(n: int) -> tuple[str, ...]:
    """Names `"1"` to `"n"` for sensors without any."""
    return tuple(str(i + 1) for i in range(n))


def sensor_label(sensors: Sequence[str], index: Sequence[int], axes: Sequence[str] = ()) -> str:
    """Name of a sensor with its axis, or its item in a batch: `imu1, axis x`, `a of item 0`.

    Args:
        sensors: Their names.
        index: Of the sensor among the leading dimensions.
        axes: Names along the leading dimension, where there is one.
    """
    *batch, sensor = index
    if len(batch) == 1 and axes:
        return f"{sensors[sensor]}, axis {axes[batch[0]]}"
    return sensors[sensor] + (f" of item {', '.join(map(str, batch))}" if batch else "")


def format_p_value(p_value: float) -> str:
    """A p value in digits, `-` where there is no test."""
    if math.isnan(p_value):
        return "-"
    return f"{p_value:.2g}" if p_value > 0 else "< 1e-300"


def p_words(p_value: float) -> str:
    """A p value in a sentence."""
    return f"p = {format_p_value(p_value)}" if p_value > 0 else f"p {format_p_value(p_value)}"


def signed(value: float) -> str:
    """A difference with two decimals, nothing as `+0.00`."""
    return f"{round(value, 2) + 0.0:+.2f}"


def listed(value: Tensor) -> Any:
    """Nested lists of plain numbers, NaN and infinities as None, ready for JSON."""
    return cleaned(value.detach().cpu().tolist())


def cleaned(entry: Any) -> Any:
    """Plain lists and dictionaries with None in place of NaN and infinities."""
    if isinstance(entry, dict):
        return {key: cleaned(value) for key, value in entry.items()}
    if isinstance(entry, list):
        return [cleaned(value) for value in entry]
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry


def readable(name: str) -> str:
    """An identifier as words for readers."""
    return name.replace("_", " ")
