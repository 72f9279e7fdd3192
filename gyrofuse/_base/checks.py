"""Checks at the door: shapes always, values once, in messages that say what to do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import TypeVar

import torch
from torch import Tensor

_Value = TypeVar("_Value")
_BITS = 63  # of the length of a tensor


def check_floating(name: str, value: Tensor) -> Tensor:
    """Return `value` when it is a real floating point tensor.

    Raises:
        TypeError: Not a tensor, or a tensor that is not float32 or float64.
    """
    if not isinstance(value, Tensor):
        raise TypeError(
            f"`{name}`: expected a torch tensor, got {type(value).__name__}; convert with torch.as_tensor(...)"
        )
    if value.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"`{name}`: expected float32 or float64, got {value.dtype}; convert with .to(torch.float64)")
    return value


def first_twice(values: Sequence[_Value]) -> _Value | None:
    """The first value that came before; None where each comes once."""
    return next((value for k, value in enumerate(values) if value in values[:k]), None)


def check_signal(name: str, value: Tensor) -> Tensor:
    """Return `value` when it is a floating point `(..., sensor, time)` tensor with at least one sensor.

    Raises:
        TypeError: Not a floating point tensor.
        ValueError: Fewer than two dimensions, no sensor, or thousands of sensors with fewer samples.
    """
    check_floating(name, value)
    if value.ndim < 2:
        raise ValueError(
            f"`{name}`: expected (..., sensor, time), got shape {tuple(value.shape)}; "
            "add a sensor dimension with .unsqueeze(-2)"
        )
    if value.shape[-2] == 0:
        raise ValueError(f"`{name}`: expected at least one sensor, got shape {tuple(value.shape)}")
    many = 1000  # sensors, whose covariances take gigabytes
    if value.shape[-2] > max(many, value.shape[-1]):
        raise ValueError(
            f"`{name}`: expected (..., sensor, time), got shape {tuple(value.shape)}, more sensors than samples; "
            "if time comes first, transpose with .mT"
        )
    return value


def largest_level(n_samples: int) -> int:
    """Largest level J with `2**J <= n_samples`, 0 when there is none."""
    return max(int(n_samples).bit_length() - 1, 0)


def infinite_where(infinite: Tensor, moments: Tensor) -> Tensor:
    """Moments of signals, infinite where the signals are, although windows with such samples do not count in them."""
    return torch.where(infinite, torch.inf, moments)


def check_n_levels(n_levels: int | None, n_samples: int) -> int:
    """Resolve the number of levels; `None` is the largest `J` with `2**J <= n_samples`.

    Raises:
        ValueError: `n_levels` below 1 or above what `n_samples` allow.
    """
    if n_samples < 2:
        raise ValueError(f"`signal`: expected at least 2 samples for one wavelet level, got {n_samples}")
    if n_levels is None:
        return largest_level(n_samples)
    n_levels = check_positive_integer("n_levels", n_levels)
    if n_levels >= _BITS or 2**n_levels > n_samples:  # of an absurd number the power would never end
        raise ValueError(
            f"`n_levels`: expected at most {largest_level(n_samples)} for {n_samples} samples "
            f"(2**n_levels <= samples), got {n_levels}; ask for fewer levels or give a longer signal"
        )
    return n_levels


def check_positive_integer(name: str, value: int) -> int:
    """Return `value` as an int when it is a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, Real) or value < 1 or value % 1 != 0:
        raise ValueError(f"`{name}`: expected a whole number >= 1, got {value!r}")
    return int(value)


def check_batch(batch: Sequence[int]) -> tuple[int, ...]:
    """Return a shape of independent draws as a tuple."""
    if not isinstance(batch, Sequence) or isinstance(batch, str):
        raise ValueError(f"`batch`: expected a shape such as (3,) or (), got {batch!r}")
    return tuple(check_n_samples("batch", size) for size in batch)


def check_length(n_samples: int, *, recorded: bool) -> int:
    """Return the length of the record behind moments that are given, as an int.

    Raises:
        ValueError: Not a length, or what is given is a recording, which has its own.
    """
    if recorded:
        raise ValueError(
            f"`n_samples`: expected None with a Recording, whose length is known, got {n_samples!r}; leave it out, it "
            "goes with wavelet variances alone"
        )
    return check_positive_integer("n_samples", n_samples)


def check_n_samples(name: str, value: int) -> int:
    """Return `value` as an int when it is a whole number of samples, 0 or more."""
    if isinstance(value, bool) or not isinstance(value, Real) or not (value >= 0 and value % 1 == 0):
        raise ValueError(f"`{name}`: expected a whole number >= 0, got {value!r}")
    return int(value)


def check_positive(name: str, value: float) -> float:
    """Return `value` as a float when it is finite and above zero."""
    number = float(value)
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"`{name}`: expected a finite number > 0, got {value!r}")
    return number


def check_confidence_level(value: float) -> float:
    """Return `value` as a float when it lies strictly between 0 and 1.

    Raises:
        TypeError: Not a number.
        ValueError: Out of range.
    """
    if not isinstance(value, Real):
        raise TypeError(
            f"`confidence_level`: expected a number between 0 and 1 such as 0.95, got {type(value).__name__} {value!r}"
        )
    number = float(value)
    if not 0 < number < 1:
        raise ValueError(f"`confidence_level`: expected a number between 0 and 1 such as 0.95, got {value!r}")
    return number


# Relative difference of two sampling rates up to which they count as one: ten times the 0.01 % that the crystals of
# clocks are wrong by.
_SAME_RATE = 1e-3


def same_rate(first: float, second: float) -> bool:
    """Whether two sampling rates are the same, as far as rates that are read from time stamps can tell."""
    return abs(first / second - 1) <= _SAME_RATE


def own_generator(generator: torch.Generator | None, device: torch.device | str | None) -> torch.Generator:
    """Return `generator`, or a fresh one seeded by the operating system; never the global one.

    Raises:
        ValueError: `generator` lives on another device than `device`.
    """
    if generator is None:
        generator = torch.Generator(device or "cpu")
        generator.seed()
        return generator
    wanted = generator.device if device is None else torch.device(device)
    if wanted.type != generator.device.type or wanted.index not in (None, generator.device.index):
        raise ValueError(
            f"`generator`: expected a generator on device {str(wanted)!r}, got one on "
            f"{str(generator.device)!r}; make it with torch.Generator(device={str(wanted)!r})"
        )
    return generator


def repeatable_generator(generator: torch.Generator | None) -> torch.Generator:
    """Return `generator`, or one with a fixed seed, by which what it is for can be repeated.

    Raises:
        TypeError: It is something else, such as a seed.
    """
    if generator is None:
        return torch.Generator().manual_seed(0)
    if not isinstance(generator, torch.Generator):
        raise TypeError(
            f"`generator`: expected a torch.Generator, got {type(generator).__name__}; make one by "
            "`torch.Generator().manual_seed(seed)`"
        )
    return generator
