"""Values that are counts of an angle: differences of a rounded sum, whose errors cancel from sample to sample.

Rounded rates and counts of angles lie on the same grid. What rounding adds to a rate is white; what it adds to a
count is the first difference of white noise, of which nothing is left over many samples. Haar wavelet variances tell
the two apart where the simulation's samples, rounded in either way, differ there.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.detectors.values.lattices import Lattice
from gyrofuse.mismatch.detectors.values.quantisation_grid import missing_lattices
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.wavelets.covariance import wavelet_variance


def counted(signal: Tensor, step: Tensor) -> Tensor:
    """Counts of the angle `(..., sensor, time)` for samples of its rate, in steps `(sensor,)` of the rate's unit."""
    angle = (signal / step[:, None]).cumsum(-1).round()
    return torch.nn.functional.pad(angle, (1, 0)).diff(dim=-1) * step[:, None]


def angle_counts(comparison: Comparison, level: float) -> dict[int, Lattice]:
    """Exact grids of the recording that the simulation lacks, where they are those of counts, by sensor."""
    found = {
        i: own for i, own in missing_lattices(comparison, level).lattices.items() if not own.blur and not own.cut_off
    }
    if not found:
        return {}
    sensors = list(found)
    step = torch.tensor([own.step for own in found.values()], dtype=torch.float64)
    simulated = comparison.reference.signal[:, sensors]
    seen = comparison.as_came.signal[0, sensors]
    bias = seen.mean(-1, keepdim=True) - simulated.mean(-1, keepdim=True)
    offset = torch.tensor([own.offset for own in found.values()], dtype=torch.float64)[:, None]
    rounded = ((simulated + bias - offset) / step[:, None]).round() * step[:, None]
    # Another level of white noise, as of dither, comes close to either.
    white = torch.linspace(-0.8, 4.0, 25, dtype=torch.float64)[:, None] * step.square() / 12
    better = _log_likelihood(seen, counted(simulated + bias, step), 0 * white[:1]) - _log_likelihood(
        seen, rounded, white
    )
    least = (
        0.0 if float(better.sum()) > NATS_AS_GOOD else NATS_AS_GOOD
    )  # sensors of an array have one kind of converter
    return {i: own for (i, own), nats in zip(found.items(), better.tolist(), strict=True) if nats > least}


def _log_likelihood(seen: Tensor, simulated: Tensor, white: Tensor) -> Tensor:
    """Of the wavelet variances of samples `(sensor, time)`, chi squared about those of `(record, sensor, time)`.

    The largest one for variances `(level, sensor)` of white noise in addition.
    """
    n, fewest = seen.shape[-1], 32  # coefficients of a level that overlap nowhere
    n_levels = max(int(math.log2(min(n, simulated.shape[-1]) / fewest)), 1)
    expected = wavelet_variance(simulated, n_levels).mean(0)  # (level, sensor)
    scale = 2.0 ** torch.arange(1, n_levels + 1, dtype=torch.float64)[:, None]
    expected = (expected + white[:, None] / scale).maximum(0.01 * expected).clamp(min=1e-300)
    ratio = wavelet_variance(seen, n_levels) / expected
    return (n / scale / 2 * (ratio.clamp(min=1e-300).log() - ratio)).sum(1).amax(0)
