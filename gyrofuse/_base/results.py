"""What every result shares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor


class ConfidenceInterval(NamedTuple):
    """Lower and upper limits of the same shape as the estimate."""

    low: Tensor
    high: Tensor


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


def place(sensors: Sequence[str], index: Sequence[int], axes: Sequence[str] = ()) -> str:
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


def chance(p_value: float) -> str:
    """A p value in digits, `-` where there is no test."""
    if math.isnan(p_value):
        return "-"
    return f"{p_value:.2g}" if p_value > 0 else "< 1e-300"


def p_words(p_value: float) -> str:
    """A p value in a sentence."""
    return f"p = {chance(p_value)}" if p_value > 0 else f"p {chance(p_value)}"


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
