"""Test of interleaved converters: every second sample is off, which is a line at half the rate, or of another size.

Statistic: the alternating mean of whitened samples of each sensor under a Hann taper, squared, over the mean power of
the bins next to half the rate: without a taper, where a filter leaves nothing there, a record's ends would be all. Null
law: F of one and as many degrees of freedom as bins, half of which are independent, for the most extreme sensor.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy import special
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.decisions import CHANCE
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.multiplicity import p_value_beyond_reference, sidak


class Alternation(NamedTuple):
    """How every second sample of whitened signals is off.

    Attributes:
        square: Squared alternating mean over the variance that noise gives it, `(sensor,)`.
        noise: Power next to half the rate over that of white noise of variance one, `(sensor,)`.
        p_value: Of the most extreme sensor, corrected for their number.
    """

    square: Tensor
    noise: Tensor
    p_value: float


def interleaving_test(comparison: Comparison) -> TestResult:
    """Even and odd samples of different means or sizes, where the simulation has none."""
    p_values = interleaving_p_value(comparison), size_alternation(comparison).p_value
    sized = p_values[1] < p_values[0]
    found = size_alternation(comparison) if sized else alternation(comparison)
    sensors = included_sensors(found.square, 1).positions
    return TestResult(
        "interleaving",
        sidak(min(p_values), len(p_values)),
        f"even and odd samples have different {'sizes' if sized else 'means'} in {comparison.info.named(sensors)}",
        sensors=sensors,
        levels=(1,),
        frequency_hz=comparison.info.rate / 2,
    )


def interleaving_p_value(comparison: Comparison) -> float:
    """p value beyond what the simulation has itself."""
    own = alternation(comparison).p_value
    return own if own > CHANCE else p_value_beyond_reference(own, _simulated(comparison).p_value)


@derived
def alternation(comparison: Comparison) -> Alternation:
    """Of the recording."""
    return _alternation(comparison.white)


@derived
def _simulated(comparison: Comparison) -> Alternation:
    return _alternation(whitened(comparison.reference.signal[0], comparison.base))


@derived
def size_alternation(comparison: Comparison) -> Alternation:
    """How every second sample is larger than the others: of the logarithms of moduli, beyond those of the simulation.

    Of differences of every second sample, in which nothing slow is left; outliers hardly count.
    """
    own = _alternation(_log_sizes(comparison.recording))
    simulated = _alternation(_log_sizes(comparison.reference.signal[0])).p_value
    return own._replace(p_value=p_value_beyond_reference(own.p_value, simulated))


def _log_sizes(signal: Tensor) -> Tensor:
    """Logarithms of moduli of differences of every second sample, without their mean, `(sensor, time - 2)`."""
    least = 0.01  # of the mean modulus: values on a grid differ by nothing at times
    size = (signal[:, 2:] - signal[:, :-2]).abs()
    logs = size.maximum(least * size.mean(-1, keepdim=True)).clamp(min=1e-300).log()
    return logs - logs.mean(-1, keepdim=True)


def _alternation(white: Tensor) -> Alternation:
    """Of signals `(sensor, time)` whose power is about the same next to half the rate."""
    n = white.shape[-1] // 2 * 2
    beside, guard = min(64, n // 8), 4  # bins
    taper = torch.hann_window(n, dtype=white.dtype)
    transform = torch.fft.rfft(white[:, :n] * (taper / taper.norm()))
    noise = squared_modulus(transform[:, -1 - guard - beside : -1 - guard]).mean(-1)
    square = transform[:, -1].real.square() / noise.clamp(min=1e-300)
    tails = special.betainc(beside / 2, 0.5, (beside / (beside + square)).numpy())
    return Alternation(square, noise, sidak(float(tails.min()), len(white)))
