"""Values that come back: of a running median each is one of the samples in its window, and several windows share it.

Equal values lie up to a window less one apart, with others between them, as neither held nor rounded ones do.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.values.lattices import distinct_values, exact_lattices
from gyrofuse.mismatch.detectors.values.quantisation_grid import core_sd
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.multiplicity import sidak


class MedianWindows(NamedTuple):
    """Running medians that a recording seems to have passed, `(sensor,)`.

    Attributes:
        samples: In the window; 1 where there is none.
        p_values: Of as many values that come back, beside those of the simulation.
    """

    samples: Tensor
    p_values: Tensor

    def within(self, level: float) -> tuple[int, ...]:
        """Sensors that have one at a p value up to a level."""
        p_values = [sidak(float(p), len(self.p_values)) for p in self.p_values]
        return tuple(i for i, p in enumerate(p_values) if p <= level and int(self.samples[i]) > 1)


@derived
def median_windows(comparison: Comparison) -> MedianWindows:
    """Windows by the largest distance of values that come back."""
    longest = 12
    if all(int(counts.max()) == 1 for _, counts in distinct_values(comparison.observed)):  # no value is met twice
        none = torch.ones(comparison.n_sensors, dtype=torch.int64)
        return MedianWindows(none, none.to(torch.float64))
    sides = ((comparison.observed, comparison.as_came), (comparison.reference, comparison.reference))
    own, theirs = (_returns(side, came, 2 * longest) for side, came in sides)
    coarse = torch.stack([_coarse(came) for _, came in sides]).any(0)[:, None]  # values of few digits meet by chance
    own, theirs = (torch.where(coarse, 0, returns) for returns in (own, theirs))
    n, m = (side.signal[:, 0].numel() for side in (comparison.observed, comparison.reference))
    by_chance = own[:, longest:].to(torch.float64).mean(-1, keepdim=True)  # values of few digits meet at any distance
    own, theirs = own[:, : longest - 1], theirs[:, : longest - 1]
    events, others = own.sum(-1), theirs.sum(-1)
    p_values = torch.from_numpy(stats.binom.sf((events - 1).numpy(), (events + others).numpy(), n / (n + m)))
    least = 1e-3  # of the samples: of a median of 13 one in a hundred comes back from the other end of its window
    lags = torch.arange(2, longest + 1)
    samples = (lags * ((own > least * n) & (own > 4 * by_chance))).amax(-1) + 1
    # One that is even is that of the next one, whose farthest returns were too few.
    samples = torch.where(samples > 1, samples + 1 - samples % 2, samples)
    return MedianWindows(samples, torch.where(samples > 1, p_values, 1.0))


def came_back(values: Tensor, window: int) -> Tensor:
    """Which samples `(..., time)` equal an earlier one of a window's reach."""
    again = torch.zeros(values.shape, dtype=torch.bool)
    for lag in range(1, window):
        again[..., lag:] |= values[..., lag:] == values[..., :-lag]
    return again


def _returns(side: Records, came: Records, longest: int) -> Tensor:
    """Samples that equal the one of a lag before but none between, for lags from 2 on, `(sensor, lag)`.

    A value that is met all over the record, as at an end stop or in the place of lost samples, does not count. Values
    on a grid are taken as they came.
    """
    several = 4.0  # times the usual value of a grid
    rounded = (_steps(came) > 0)[:, None, None]
    signal = torch.where(rounded, came.signal.movedim(1, 0), side.signal.movedim(1, 0))
    _, number, counts = signal.unique(return_inverse=True, return_counts=True)
    often = counts[number]
    ends = (signal == signal.amax(-1, keepdim=True)) | (signal == signal.amin(-1, keepdim=True))
    usual = torch.where(ends, torch.nan, often.to(torch.float64)).flatten(1).nanmedian(-1).values[:, None, None]
    seldom = (often <= longest) | (rounded & (often <= several * usual))
    before = torch.nn.functional.pad(signal[..., 1:] == signal[..., :-1], (1, 0))
    found = []
    for lag in range(2, longest + 1):
        same = torch.nn.functional.pad(signal[..., lag:] == signal[..., :-lag], (lag, 0)) & ~before
        found.append((same & seldom).sum((1, 2)))
        before = before | same
    return torch.stack(found, -1)


def _coarse(came: Records) -> Tensor:
    """Sensors whose grid is coarse beside their noise, `(sensor,)`."""
    coarse = 1 / 8  # sd of a sample given its past
    return _steps(came) > coarse * core_sd(came)


def _steps(came: Records) -> Tensor:
    """Steps of exact grids, `(sensor,)`; 0 without one."""
    return torch.tensor([0.0 if own is None else own.step for own in exact_lattices(came)], dtype=torch.float64)
