"""Recording against simulation, level by level and band by band, in standard deviations: what figures show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.psd import hann_transform
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.wavelets.covariance import wavelet_variance
from gyrofuse.wavelets.intervals import normal_quantile, wavelet_variance_interval

_LEVEL = 0.95
_FEWEST_WINDOWS = 2  # of the last level that is compared
_GROUPS, _FEWEST = 120, 4  # of a spectrum that is drawn, and bins in each
_FIRST = 2  # bins that the taper mixes with the mean are left out


@dataclass(frozen=True, eq=False)
class VarianceComparison:
    """Wavelet variances of both sides.

    Attributes:
        observed: `(level, sensor)`, signal^2.
        reference: The same; NaN where the simulation is too short.
        spread: Standard deviation of the logarithm of their ratio, `(level, sensor)`.
    """

    observed: Tensor
    reference: Tensor
    spread: Tensor

    @property
    def z(self) -> Tensor:
        """Logarithm of recorded over simulated in standard deviations, `(level, sensor)`."""
        return (self.observed / self.reference).log() / self.spread


@dataclass(frozen=True, eq=False)
class Spectrum:
    """A periodogram over the smooth spectrum of the simulation, in groups of frequencies.

    Attributes:
        frequency: Middle of each group, cycles per sample, `(group,)`.
        mean: Mean of each.
        largest: The largest ordinate of each, where a line shows.
    """

    frequency: Tensor
    mean: Tensor
    largest: Tensor


def compared_variances(*comparisons: Comparison) -> list[VarianceComparison]:
    """Wavelet variances of both sides, and how far chance takes them apart, in each case of one diagnosis."""
    n_levels = int(math.log2(comparisons[0].n_samples / _FEWEST_WINDOWS))
    sides = {
        side: _with_spread(side.signal, n_levels)
        for comparison in comparisons
        for side in (comparison.observed, comparison.reference)
    }
    return [
        VarianceComparison(observed, reference, (own.square() + other.square()).sqrt())
        for (observed, own), (reference, other) in ((sides[c.observed], sides[c.reference]) for c in comparisons)
    ]


def compared_powers(comparison: Comparison) -> Tensor:
    """Logarithm of the ratio of powers in standard deviations, `(band, sensor)`; NaN where nothing is simulated."""
    own, other = comparison.bands.dof, comparison.reference.dof
    known = other > 0
    other = torch.where(known, other, 1.0)
    # The mean of `d` ordinates is gamma distributed: its logarithm has the mean digamma(d) - log(d).
    shift = (own.digamma() - own.log()) - (other.digamma() - other.log())
    sd = (torch.polygamma(1, own) + torch.polygamma(1, other)).sqrt()
    z = ((comparison.observed.power / comparison.reference.power).log() - shift) / sd
    return z.masked_fill(~known, torch.nan).mT


def grouped_spectrum(comparison: Comparison, side: Records, sensor: int) -> Spectrum:
    """Periodogram under a Hann taper of one sensor's first record, in groups evenly spaced on a logarithmic axis.

    Args:
        comparison: For the simulation's smooth spectrum.
        side: The recording or the simulation.
        sensor: Its position.
    """
    transform, length = hann_transform(side.signal[0, sensor])
    f = torch.arange(_FIRST, len(transform) - _FIRST, dtype=torch.float64) / length
    density = transform.abs().square()[_FIRST:-_FIRST]
    power = (density / comparison.base.spectrum(f)[sensor]).numpy()
    starts = np.unique(np.geomspace(_FEWEST, len(power), _GROUPS).astype(int) // _FEWEST * _FEWEST - _FEWEST)[:-1]
    n = np.diff(starts, append=len(power))
    centre = (_FIRST + starts + (n - 1) / 2) / length
    columns = (centre, np.add.reduceat(power, starts) / n, np.maximum.reduceat(power, starts))
    return Spectrum(*map(torch.from_numpy, columns))


def _with_spread(records: Tensor, n_levels: int) -> tuple[Tensor, Tensor]:
    """Mean wavelet variance `(level, sensor)` of records `(record, sensor, time)`, and the sd of its logarithm."""
    possible = min(n_levels, int(math.log2(records.shape[-1])))
    variance = wavelet_variance(records, possible)
    low, high = wavelet_variance_interval(records, possible, confidence_level=_LEVEL)
    width = 2 * normal_quantile((1 + _LEVEL) / 2)
    spread = (high / low).log().mean(0) / width / math.sqrt(len(records))
    missing = spread.new_full((n_levels - possible, spread.shape[-1]), torch.nan)
    return torch.cat([variance.mean(0), missing]), torch.cat([spread, missing])
