"""Null replicates: what all tests say of pairs of recording and simulation in which nothing is missing.

A replicate has a recording and a simulation of its own, as long as those given and with the same auxiliary channels:
whatever finite lengths and chance do, they do to replicates as well. Both are drawn from the noise that describes the
simulation; where that is not Gaussian, innovations are drawn from those that it has, in blocks of random length whose
ends meet (the stationary bootstrap: Politis and Romano, JASA 89 (1994), 1303), the same for all sensors.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from scipy import fft
from torch import Tensor

from gyrofuse.mismatch.detectors.tests import family_wise_p_value, run_tests
from gyrofuse.mismatch.detectors.variance.level_spread import with_spread
from gyrofuse.mismatch.detectors.variance.normality import SQUARE_CUT, gaussian_sensors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.stats.long_run_variance import long_run_variance

FEWEST = 50
_FEWEST_BLOCKS = 8  # in a record, of a level that wanders however slowly: fewer would be the record again


def twin(comparison: Comparison, generator: torch.Generator) -> Comparison:
    """A recording and a simulation that agree, drawn from what describes the simulation."""
    n_records, _, n = comparison.reference.signal.shape
    if bool(gaussian_sensors(comparison.reference).all()):
        model = comparison.base.model()
        recording = model.simulate(comparison.n_samples, generator=generator)
        simulation = model.simulate(n, batch=(n_records,), generator=generator)
    else:
        recording = _resampled(comparison, 1, comparison.n_samples, generator)[0]
        simulation = _resampled(comparison, n_records, n, generator)
    drawn = Comparison.of(comparison.info, recording, simulation).knowing(comparison.reference.lines)
    drawn = replace(drawn, reference=replace(drawn.reference, gaussian=comparison.reference.gaussian))
    return with_spread(drawn)


def block_length(white: Tensor) -> float:
    """Mean length of blocks of whitened records `(record, sensor, time)` that keep a level that varies, samples.

    So long as the spectrum of the squares takes to be flat; 1 where squares are independent.
    """
    n, longest = white.shape[-1], 1.0
    squares = white.square().clamp(max=SQUARE_CUT)
    for row in squares.movedim(1, 0):
        found = long_run_variance(row)
        chance = 1 + 4 * (2 / found.dof) ** 0.5  # four sd of a chi-square over its degrees of freedom, of any sensor
        if found.value > chance * float(row.var()):
            longest = max(longest, 2 * len(row) * n / found.dof)
    return min(longest, n / _FEWEST_BLOCKS)


def _resampled(comparison: Comparison, n_records: int, n: int, generator: torch.Generator) -> Tensor:
    """Records `(record, sensor, time)` of the simulation's innovations, in the colour of its noise."""
    white = left_out(comparison.reference).white
    length, source = block_length(white), white.movedim(1, 0).flatten(1)
    start = torch.randint(source.shape[-1], (n_records, n), generator=generator)
    fresh = torch.rand(n_records, n, generator=generator, dtype=torch.float64) < 1 / length
    fresh[:, 0] = True
    began = torch.where(fresh, torch.arange(n), 0).cummax(-1).values
    at = (start.gather(-1, began) + torch.arange(n) - began) % source.shape[-1]
    drawn = source[:, at].movedim(0, 1) / source.square().mean(-1, keepdim=True).sqrt()
    places = torch.arange(1, n, dtype=torch.float64) / (2 * n)  # of cosines, cycles per sample
    size = torch.nn.functional.pad(comparison.base.spectrum(places).sqrt(), (1, 0))
    ordinates = torch.from_numpy(fft.dct(drawn.numpy(), norm="ortho", axis=-1)) * size
    return torch.from_numpy(fft.idct(ordinates.numpy(), norm="ortho", axis=-1))


def twin_p_values(comparison: Comparison, n_twins: int, generator: torch.Generator) -> Tensor:
    """Family-wise p values of null replicates, `(replicate,)`: uniform, as far as every test is honest."""
    values = [family_wise_p_value(run_tests(twin(comparison, generator))) for _ in range(n_twins)]
    return torch.tensor(values, dtype=torch.float64)
