"""Spectral lines of an array above its own local background.

Each sensor is whitened with the smooth spectrum of the simulation, which leaves no steep slope to leak, and transformed
without a taper, twice as finely as its bins: a taper would cost a third of a line's power. A bin's power in one sensor
over the mean of `m` independent others nearby, without the bins next to it, is `F(2, 2m)` distributed. Sensors are
pooled as `q = z^H C^-1 z` with the cross-spectral matrix `C` of some bands, over its own mean nearby, which is
`F(2p, 2pm)`: in a plain sum noise that sensors share would look like a line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy import special
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._transforms import fast_length
from gyrofuse.mismatch.base import Base
from gyrofuse.mismatch.evidence import corrected
from gyrofuse.mismatch.side import Side

_FINER = 2
_REACH, _GUARD = 32, 3  # bins on either side that tell the background, and those too near to
_NEARBY = 2.0 * (_REACH - _GUARD)
_FEWEST_CYCLES = 10.0
_LINE_IN_SIMULATION = 1e-3  # p value


@dataclass(frozen=True)
class FoundLine:
    """The most conspicuous line.

    Attributes:
        frequency: Cycles per sample, to a fraction of a bin.
        p_value: For having looked at every bin, pooled and sensor by sensor.
        sensors: Those in which the bin alone stands out.
    """

    frequency: float
    p_value: float
    sensors: tuple[int, ...]


def strongest_line(recorded: Side, simulated: Side) -> FoundLine:
    """The most conspicuous line of a recording that the simulation does not have."""
    z, length = _whitened(recorded, simulated.base)
    z = z[0]  # (sensor, bin)
    f = torch.arange(z.shape[-1], dtype=torch.float64) / length
    known = _without_verdict(f, simulated)
    n_bins = int((~known).sum())
    p = z.shape[0]
    band = torch.tensor(recorded.bands.edges[1:-1], dtype=torch.float64) / recorded.bands.n_samples
    matrices = recorded.over(simulated.base)[torch.bucketize(f, band, right=True)]
    pooled = (z.mH[..., None, :] @ torch.linalg.solve(matrices, z.mT[..., None]))[..., 0, 0].real
    log_pooled = _log_tail(pooled[None], p)[0].masked_fill(known, 0.0)
    single = _log_tail(z.abs().square(), 1)
    log_single = (single + math.log(p)).masked_fill(known, 0.0).clamp(max=0.0)
    best = torch.minimum(log_pooled, log_single.amin(0))
    at = int(best.argmin())
    p_value = corrected(2 * math.exp(float(best[at])), n_bins)
    alone = tuple(i for i in range(p) if corrected(math.exp(float(single[i, at])), p) < 0.01)
    return FoundLine(at / length, p_value, alone or (int(single[:, at].argmin()),))


def _whitened(side: Side, base: Base) -> tuple[Tensor, int]:
    """Transform `(record, sensor, bin)` of whitened signals over the root of their length, and the padded length."""
    signal = side.signal - side.signal.mean(-1, keepdim=True)
    n = signal.shape[-1]
    once, twice = fast_length(n), fast_length(_FINER * n)
    f = torch.arange(once // 2 + 1, dtype=torch.float64) / once
    white = torch.fft.irfft(torch.fft.rfft(signal, n=once) / base.spectrum(f.clamp(min=1 / once)).sqrt(), n=once)
    return torch.fft.rfft(white[..., :n], n=twice) / math.sqrt(n), twice


def _log_tail(power: Tensor, shape: int) -> Tensor:
    """Logarithm of the p value of each of `(..., sensor, bin)`, gamma variables of one `shape`, over those nearby."""
    ratio = power / _nearby_mean(power)
    others = shape * _NEARBY
    tail = special.betainc(others, shape, (others / (others + shape * ratio)).numpy())
    return torch.from_numpy(tail).clamp(min=1e-300).log()


def _nearby_mean(power: Tensor) -> Tensor:
    """Mean over the bins within reach but for the nearest."""

    def window(reach: int) -> tuple[Tensor, Tensor]:
        def box(values: Tensor) -> Tensor:
            total = pad(values, (reach + 1, reach)).cumsum(-1)
            return total[..., 2 * reach + 1 :] - total[..., : -2 * reach - 1]

        return box(power), box(torch.ones_like(power[..., :1, :].flatten(0, -2)[:1]))

    (wide, n_wide), (near, n_near) = window(_FINER * _REACH), window(_FINER * _GUARD)
    return ((wide - near) / (n_wide - n_near)).clamp(min=1e-300)


def _without_verdict(f: Tensor, simulated: Side) -> Tensor:
    """Frequencies `(bin,)` with too few cycles, next to the highest, and of lines that the simulation has as well."""
    n = simulated.bands.n_samples
    known = (f * n < _FEWEST_CYCLES) | (f * n > n / 2 - _GUARD)
    z, length = _whitened(simulated, simulated.base)
    log_p = _log_tail(z.abs().square(), 1).amin((0, 1)) + math.log(z.numel())
    for place in (log_p < math.log(_LINE_IN_SIMULATION)).nonzero()[:, 0].tolist():
        known |= (f - place / length).abs() * min(n, simulated.signal.shape[-1]) < _GUARD + 1
    return known
