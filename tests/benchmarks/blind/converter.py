"""From the analogue signal to numbers: filter, integrate and dump, lattice, dead band, full scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, freqz, iirnotch, lfilter, sosfilt

Array = NDArray[np.float64]


def decimate(analog: Array, factor: int) -> Array:
    """Integrate and dump: the mean of each `factor` fine samples."""
    return analog.reshape(*analog.shape[:-1], -1, factor).mean(axis=-1)


def low_pass(analog: Array, corner: float) -> Array:
    """Second-order Butterworth filter of the sensor, started at rest; `corner` in cycles per fine sample."""
    start = analog[..., :1]
    return sosfilt(butter(2, 2 * corner, output="sos"), analog - start, axis=-1) + start


def low_pass_gain(nu: Array, corner: float) -> Array:
    """Squared gain of `low_pass` at `nu` cycles per fine sample."""
    return 1 / (1 + (np.tan(np.pi * nu) / np.tan(np.pi * corner)) ** 4)


def notch(analog: Array, centre: float, width: float, depth: float) -> Array:
    """Second-order notch of every channel, settled on the first sample.

    Centre and width are in cycles per fine sample; a share of `depth` of the amplitude is taken out at the centre.
    """
    start = analog[:, :1]
    return (1 - depth) * analog + depth * (lfilter(*iirnotch(2 * centre, centre / width), analog - start) + start)


def notch_gain(nu: Array, centre: float, width: float, depth: float) -> Array:
    """Squared gain of `notch` at `nu` cycles per fine sample."""
    deep = freqz(*iirnotch(2 * centre, centre / width), worN=2 * np.pi * nu)[1]
    return np.abs(1 - depth + depth * deep) ** 2


def round_to_lattice(signal: Array, step: float | Array) -> Array:
    """Rounding of the rate to whole steps."""
    return step * np.round(signal / step)


def count_angle(signal: Array, step: float) -> Array:
    """Whole steps by which the integral of the rate moves from sample to sample."""
    return step * np.diff(np.round(signal.cumsum(axis=-1) / step), prepend=0.0)


def dead_band(signal: Array, width: float) -> Array:
    """Rates smaller than `width` read as zero."""
    return np.where(np.abs(signal) < width, 0.0, signal)


def clip(signal: Array, low: Array, high: Array) -> Array:
    """Full scale per sensor."""
    return np.clip(signal, low[:, None], high[:, None])
