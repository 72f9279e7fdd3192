"""Clock and bus: offset, samples that are lost or sent twice."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def sample_times(n: int, ppm: float, lost: NDArray[Any]) -> Array:
    """Times of the samples in nominal periods: a clock off by `ppm` that skips a sample after each index in `lost`."""
    index = np.arange(n, dtype=np.float64)
    return index * (1 + 1e-6 * ppm) + np.searchsorted(np.sort(lost), index)


def repeat_last(signal: Array, at: NDArray[np.bool_]) -> Array:
    """The bus sends the sample before once more where `at` is true."""
    source = np.where(at, 0, np.arange(len(at)))
    return signal[np.maximum.accumulate(source)]


def lose(signal: Array, at: NDArray[np.bool_], n: int) -> Array:
    """The bus loses samples and closes the gap; the first `n` of what is left."""
    return signal[..., ~at][..., :n]
