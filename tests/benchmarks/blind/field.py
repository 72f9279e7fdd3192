"""Real backgrounds: what a device gave at rest, and as its simulation the stretch that it gave next.

Nothing is known of them but what was measured; effects are sized by the stretch's own spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .analog import Base
from .likelihood import coefficients

Array = NDArray[np.float64]
FILES = tuple(f"adis16405_rec{k}.npz" for k in (1, 2, 3))
_GYROSCOPES = 3
_PER_OCTAVE = 4  # bands of the measured spectrum


class Background(NamedTuple):
    """Two stretches, one after the other, `(sensor, time)` in deg/s, their steps `(sensor,)`, and the rate in Hz."""

    recording: Array
    simulation: Array
    step: Array
    rate: float
    source: str


@dataclass(frozen=True)
class MeasuredBase(Base):
    """A base of which nothing is known but its spectrum `(sensor, n_samples - 1)`."""

    measured: Array

    def components(self, n_samples: int) -> list[Array]:
        """The whole, for it has no known parts."""
        if self.measured.shape[-1] != n_samples - 1:
            raise ValueError(f"`n_samples`: expected {self.measured.shape[-1] + 1}, as measured, got {n_samples}")
        return [self.measured]


def background(folder: Path, n_samples: int, rng: np.random.Generator) -> Background:
    """A random place in one of the recordings of a folder."""
    source = FILES[int(rng.integers(len(FILES)))]
    with np.load(folder / source) as file:
        counts, scale, rate = file["counts"][:_GYROSCOPES], file["scale"][:_GYROSCOPES], float(file["fs"])
    start = int(rng.integers(counts.shape[1] - 2 * n_samples + 1))
    both = counts[:, start : start + 2 * n_samples] * scale[:, None]
    return Background(both[:, :n_samples], both[:, n_samples:], scale, rate, source)


def measured_base(stretch: Array, rate: float) -> MeasuredBase:
    """White level and spectrum of a stretch, averaged in bands and drawn through their middles."""
    energy = coefficients(stretch) ** 2
    n = energy.shape[-1]
    edges = np.unique(np.geomspace(8, n, int(_PER_OCTAVE * np.log2(n / 8)) + 1).astype(int))
    edges[0] = 0
    middles = np.array([np.sqrt((a + 1) * b) for a, b in pairwise(edges)])
    levels = np.stack([energy[:, a:b].mean(axis=1) for a, b in pairwise(edges)], axis=1)
    along = np.log(np.arange(1, n + 1))
    spectrum = np.exp([np.interp(along, np.log(middles), np.log(level)) for level in levels])
    nothing = np.zeros((len(stretch), 0))
    white = np.median(spectrum[:, n // 2 :], axis=1)
    zero = np.zeros(len(stretch))
    return MeasuredBase(white, nothing, nothing, zero, zero, rate, spectrum)
