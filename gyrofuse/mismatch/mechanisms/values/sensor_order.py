"""Sensors in each other's place: cables or columns in another order than the simulation's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.data import block_spectra
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED


@dataclass(frozen=True, eq=False)
class SensorOrder(Mechanism):
    """`x_i = y_p(i)`: what the simulation gives for one sensor is where the recording has another one.

    Statistic: chi squares of the logarithms of the powers of each sensor of the recording over each of the simulation,
    and the order in which they are least (assignment). Other numbers of two sensors do not by chance make each like the
    other.

    Attributes:
        place: `p`, of each sensor that in the simulation which is like it, from 0.
    """

    name: ClassVar[str] = "sensor_order"
    separated_by: ClassVar[str] = "a known motion about the axis of one of them"
    of_spectra: ClassVar[bool] = True
    place: tuple[int, ...]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        p = comparison.n_sensors
        if p < 2:
            return None
        misfit, n_bands = _misfits(comparison)
        far, near, part = 10.0, 5.0, 0.01  # standard deviations of a chi square; of what was off before
        sd = math.sqrt(2 * n_bands)
        own_place = far * sd * torch.eye(p, dtype=torch.float64)  # is right unless another one is plainly better
        rows, columns = linear_sum_assignment((misfit - own_place).numpy())
        place = torch.from_numpy(columns)
        moved = place != torch.from_numpy(rows)
        before, after = misfit.diagonal(), misfit[torch.arange(p), place]
        apart = (before > n_bands + far * sd)[moved].all()
        alike = (after < (n_bands + near * sd) + part * before)[moved].all()
        if not bool(moved.any()) or not bool(apart & alike):
            return None
        gain = float((before - after)[moved].sum()) / 2
        p_value = math.exp(min(math.lgamma(p + 1) - gain, 0.0))
        if p_value > level:
            return None
        sensors = tuple(moved.nonzero()[:, 0].tolist())
        names = comparison.info.sensors
        words = ", ".join(f"{names[i]} is like the simulation's {names[int(place[i])]}" for i in sensors)
        return cls(tuple(place.tolist())).found(
            f"sensors are in another order than in the simulation: {words}, as where cables or columns are swapped",
            p_value,
            sensors,
            {},
            levels=(1,),
            gain=gain,
        )

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return signal[..., list(self.place), :]

    def spectra(self, matrices: Tensor, f: Tensor) -> Tensor:
        return matrices[:, list(self.place)][:, :, list(self.place)]

    def fit_without(self, comparison: Comparison, fold: int) -> Mechanism:
        """The same order: it is one of a few."""
        return self

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.ratio_of_spectra(ax, comparison, sensor, None)


def _misfits(comparison: Comparison) -> tuple[Tensor, int]:
    """Chi squares of the recording's sensors against the simulation's, `(sensor, sensor)`, and their bands."""
    both = block_spectra(comparison)
    own, d = both.observed.mean(torch.ones(N_JUDGED, dtype=torch.bool))
    simulated, s = both.reference.mean(torch.ones(N_FOLDS, dtype=torch.bool))
    known = (d > 1) & (s > 1)
    recorded, expected = (m.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).log()[known] for m in (own, simulated))
    variance = (1 / d + 1 / s)[known]
    apart = recorded[:, :, None] - expected[:, None, :]
    return (apart.square() / variance[:, None, None]).sum(0), int(known.sum())
