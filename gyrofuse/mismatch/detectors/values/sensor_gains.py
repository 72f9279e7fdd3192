"""Gains of whole sensors: one factor on all that a sensor gives, its noise and what it shares, of either sign.

A factor moves the powers of all bands alike, and what sensors share with them. Another level of white noise leaves
other noise, and what is shared, as it is: a gain is seen where either is plain enough to show that it is not so. Its
sign shows in what sensors share, as noise or as lines.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.lines.line_signs import line_signs
from gyrofuse.mismatch.detectors.spectra.delays import Phases, delays_on_grid, phases_of
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import shared_ordinates
from gyrofuse.mismatch.likelihoods.spectra.data import block_spectra, reference_noise
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED
from gyrofuse.mismatch.stats.multiplicity import sidak

_SURE = 5.0  # standard deviations of a logarithm
_SHARED = 100.0  # ordinates that show what is shared


class SensorGains(NamedTuple):
    """Factors of sensors, 1 in those that are right.

    Attributes:
        factor: Of either sign, `(sensor,)`.
        sd: Standard deviation of the logarithm of its size, `(sensor,)`; 0 where that is 1.
        p_value: For all sensors.
    """

    factor: Tensor
    sd: Tensor
    p_value: float


class _Levels(NamedTuple):
    """Logarithms of gains in bands, `(band, sensor)`, and their variances `(band, 1)`."""

    log_gain: Tensor
    variance: Tensor

    def mean(self) -> tuple[Tensor, Tensor]:
        """Weighted means over bands, and their standard deviation, `(sensor,)`."""
        weight = (1 / self.variance).expand_as(self.log_gain)
        total = weight.sum(0)
        return (weight * self.log_gain).sum(0) / total, total.rsqrt()

    def misfit(self, expected: Tensor) -> Tensor:
        """Chi squares of expected values `(..., band, sensor)`, `(..., sensor)`."""
        return ((self.log_gain - expected).square() / self.variance).sum(-2)


@derived
def sensor_gains(comparison: Comparison) -> SensorGains | None:
    """Gains that the whole recording shows; None where no sensor has another one than the simulation."""
    levels = _levels(comparison, torch.ones(N_JUDGED, dtype=torch.bool))
    middle, sd = levels.mean()
    z = (middle.abs() / sd).clamp(max=37.0)  # beyond, a normal tail is zero
    fitted, coarse = comparison.reference.uncertainty is not None, 0.2  # numbers of a fit are off by so much
    gained = (z > _SURE) & (middle.abs() > coarse * fitted) & _flat(levels, middle) & _lasting(comparison, middle)
    there, seen = shared_ordinates(comparison)
    coherent = (there < _SHARED) | (seen > there / 2)  # no gain changes a coherence
    if bool(gained.any()):
        gained &= _of_all_parts(comparison, levels, middle) | _of_what_is_shared(comparison, middle)
        gained &= coherent
    sign, p_sign = _signs(comparison)
    sign = torch.where(coherent, sign, 1.0)
    if not bool(gained.any()) and bool((sign > 0).all()):
        return None
    tails = torch.special.erfc(z / math.sqrt(2))[gained].tolist()
    p_values = [p_sign, *tails] if bool((sign < 0).any()) else tails
    factor = sign * torch.where(gained, middle, 0.0).exp()
    return SensorGains(factor, torch.where(gained, sd, 0.0), sidak(min(p_values), 2 * comparison.n_sensors))


def log_sizes(comparison: Comparison, blocks: Tensor) -> Tensor:
    """Logarithms of the sizes of gains in some blocks `(block,)` of the recording, `(sensor,)`."""
    return _levels(comparison, blocks).mean()[0]


def sign_gain(comparison: Comparison, blocks: Tensor, sign: Tensor) -> float:
    """Log likelihood of signs `(sensor,)` over none, from what sensors share in some blocks `(block,)`, nats."""
    phases = _phases(comparison, blocks)
    return 0.0 if phases is None else _gain(phases.weights.real.sum(0), sign)


def _phases(comparison: Comparison, blocks: Tensor) -> Phases | None:
    shared = 0.15  # coherence that shows a sign
    return phases_of(comparison, blocks, shared)


def _gain(pairs: Tensor, sign: Tensor) -> float:
    """The same from weights of pairs of sensors, `(sensor, sensor)`."""
    return float(sign @ pairs @ sign - pairs.sum())


def _levels(comparison: Comparison, blocks: Tensor) -> _Levels:
    both = block_spectra(comparison)
    own, d = both.observed.mean(blocks)
    simulated, s = both.reference.mean(torch.ones(N_FOLDS, dtype=torch.bool))
    power, before = (m.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300) for m in (own, simulated))
    known = (d > 1) & (s > 1)
    variance = torch.where(known, (1 / d.clamp(min=1) + 1 / s.clamp(min=1)) / 4, math.inf)
    return _Levels((power / before).log() / 2, variance[:, None])


def _flat(levels: _Levels, middle: Tensor) -> Tensor:
    """Whether nearly all bands of a sensor are off by one factor, `(sensor,)`."""
    nearly_all, sure, near = 0.95, 4.0, 0.03  # of the bands; standard deviations; of the logarithm
    off = (levels.log_gain - middle).abs()
    known = levels.variance.isfinite()
    inside = (off < (sure * levels.variance.sqrt()).maximum(near * middle.abs())) & known
    chi = ((levels.log_gain - middle).square() / levels.variance * inside).sum(0)
    n = inside.sum(0)
    return (n > nearly_all * known.sum()) & (chi < n + _SURE * (2.0 * n).sqrt())


def _of_all_parts(comparison: Comparison, levels: _Levels, middle: Tensor) -> Tensor:
    """Whether what is not white is seen to have the gain as well, most of its logarithm at least, `(sensor,)`."""
    sure, far = 9.0, 3.0  # chi square; logarithm beyond which half is enough: no noise is so far off by itself
    most = torch.where(middle.abs() < far, 0.85, 0.5)[:, None]
    bands = block_spectra(comparison).bands
    total = reference_noise(comparison).spectrum(bands.nodes)
    floor = bands.mean_of(total.amin(-1, keepdim=True).expand_as(total)) / bands.mean_of(total)  # (sensor, band)
    gain = 2 * middle[:, None]
    less = (floor * gain.exp() + (1 - floor) * (most * gain).exp()).log().mT / 2
    return levels.misfit(less) > levels.misfit(middle.expand_as(less)) + sure


def _of_what_is_shared(comparison: Comparison, middle: Tensor) -> Tensor:
    """Whether what a sensor shares with others has its gain as well, `(sensor,)`, which noise of its own leaves."""
    near = 0.3  # of the difference that the gain makes
    both, gain = block_spectra(comparison), middle.exp()
    own, d = both.observed.mean(torch.ones(N_JUDGED, dtype=torch.bool))
    simulated, s = both.reference.mean(torch.ones(N_FOLDS, dtype=torch.bool))
    size = simulated.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).rsqrt()
    scale, apart = size[:, :, None] * size[:, None, :], 1 - torch.eye(comparison.n_sensors, dtype=torch.float64)
    weight = (d * s / (d + s).clamp(min=1e-9))[:, None, None] * apart
    before = simulated * scale
    seen = (weight * (own * scale * before.conj()).real).sum(0)  # (sensor, sensor)
    there = (weight * (before.abs().square() - 1 / s.clamp(min=1.0)[:, None, None])).sum(0)
    known = there.sum(-1) > _SHARED
    ratio = (seen / gain).sum(-1) / there.sum(-1).clamp(min=1e-9)
    sd = gain / there.sum(-1).clamp(min=1e-9).sqrt()
    return known & ((ratio - 1).abs() > _SURE * sd) & ((ratio - gain).abs() < near * (gain - 1).abs())


def _lasting(comparison: Comparison, middle: Tensor) -> Tensor:
    """Whether the level of a sensor's fast noise is off by its gain all the time, `(sensor,)`."""
    spread = 0.25  # of the logarithm
    parts = comparison.recording.diff().tensor_split(N_JUDGED, -1)
    level = torch.stack([part.square().mean(-1) for part in parts]).clamp(min=1e-300).log() / 2  # (part, sensor)
    before = comparison.reference.signal.diff().square().mean((0, -1)).clamp(min=1e-300).log() / 2
    scatter = (2 * parts[0].shape[-1]) ** -0.5 * 5
    return ((level - before - middle).abs() < (spread * middle.abs()).clamp(min=scatter)).double().mean(0) > 0.8


def _signs(comparison: Comparison) -> tuple[Tensor, float]:
    """Signs of sensors, most of which are 1, and their p value."""
    sign = torch.ones(comparison.n_sensors, dtype=torch.float64)
    lines = line_signs(comparison)
    every = torch.ones(N_JUDGED, dtype=torch.bool)
    phases = _phases(comparison, every) if comparison.n_sensors > 1 else None
    if phases is None:
        return (sign, 1.0) if lines is None else (lines.sign, lines.p_value)
    pairs = phases.weights.real.sum(0)
    for _ in range(comparison.n_sensors):
        turned = torch.stack([torch.where(torch.arange(len(sign)) == i, -sign, sign) for i in range(len(sign))])
        values = torch.einsum("ki,ij,kj->k", turned, pairs, turned)
        if float(values.max()) <= float(sign @ pairs @ sign):
            break
        sign = turned[int(values.argmax())]
    if float(sign.sum()) < 0:
        sign = -sign
    gain = _gain(pairs, sign)
    if bool((sign < 0).any()) and (lines is None or bool((lines.sign == sign).all())) and not _is_late(phases, sign):
        return sign, math.exp(-max(gain, 0.0))
    return torch.ones_like(sign), 1.0


def _is_late(phases: Phases, sign: Tensor) -> bool:
    """Whether a delay of the sensors that have the other sign fits the phases better, as of a filter of many taps."""
    farthest, better = 32.0, 10.0  # samples; nats
    late = delays_on_grid(phases, torch.zeros_like(sign), (sign < 0).nonzero()[:, 0].tolist(), farthest)
    turned = torch.einsum("i,bij,j->", sign, phases.weights.real, sign)
    return float(phases.likelihood(late)) > float(turned) + better
