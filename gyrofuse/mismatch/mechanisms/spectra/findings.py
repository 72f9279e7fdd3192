"""Sentences and findings of spectral shapes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import Shape
from gyrofuse.mismatch.mechanisms.spectra.spectral import Spectral
from gyrofuse.mismatch.stats.limits import Z


def spanned(number: Callable[[float], float], middle: float, sd: float, unit: str) -> Parameter:
    """A number that rises with an estimate of normal error, and its limits."""
    return Parameter(number(middle), number(middle - Z * sd), number(middle + Z * sd), unit)


def half_power_words(corners: Sequence[float]) -> str:
    """Where filters halve the power, Hz."""
    low, high = min(corners), max(corners)
    return f"half power at {low:.4g} Hz" if high <= 1.02 * low else f"half power between {low:.4g} and {high:.4g} Hz"


def found(
    effect: Spectral,
    shape: Shape,
    sensors: tuple[int, ...],
    parameters: dict[str, Parameter],
    sentence: str,
    frequency_hz: float | None = None,
) -> Finding:
    """A finding made of a spectral shape."""
    # Of several shapes the form of all together is off: the others are yet to be found in the same bands.
    off = not shape.fits and shape.alone
    limits = {name: entry for name, entry in parameters.items() if not math.isnan(entry.value)}
    return replace(effect, company=shape.company, approximate=off).found(
        sentence + _of_another_form(shape) if off else sentence,
        shape.p_value,
        sensors,
        limits,
        levels=shape.levels,
        alternatives=shape.alternatives,
        frequency_hz=frequency_hz,
        gain=shape.gain,
    )


def _of_another_form(shape: Shape) -> str:
    """What is said of a form that the catalogue only approximates."""
    return (
        f"; {math.floor(100 * shape.explained)} % of how the spectra differ is explained, the rest is more than "
        "chance: its form is not quite one of the catalogue"
    )
