"""A tone whose frequency wanders, or noise through a resonance? Their spectra may be the same.

Of a Gaussian oscillation the squared envelope is exponential, `E |z|^4 = 2 (E |z|^2)^2`, and in short windows all its
frequencies are present; a tone has one frequency at a time and a steady envelope. Both are judged against Gaussian
records of the same spectrum, and against tones that wander in it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.detectors.spectra.frequency_courses import (
    rampless_transform,
    wandering_log_ratio,
    weights_in_phase,
)
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation
from gyrofuse.mismatch.signals.comparison import Comparison

_DRAWN = 60  # Gaussian records of the same spectrum
_LEAST = 96  # bins in which an envelope and short windows differ by more than chance


class Steadiness(NamedTuple):
    """What the envelope and short windows say.

    Attributes:
        tone: Whether it is a tone.
        open: Whether the other one is possible too.
        slow: Whether short windows show its frequency, so that it wanders slowly.
    """

    tone: bool
    open: bool
    slow: bool


def steadiness(comparison: Comparison, peak: Oscillation) -> Steadiness:
    """Judge a bump; one that sensors do not share is no tone.

    It is a tone where an envelope or a window lies 4.5 standard deviations from those of Gaussian records. If it does
    not, though in half of the tones of the same spectrum one would lie twice as far, it is none. Else the likelihood
    ratio decides, surely from three nats.
    """
    rare, sure = 4.5, 3.0
    several = int((peak.variance > 3 * peak.variance_sd).sum()) > 1
    if peak.gain is None and several:
        return Steadiness(tone=False, open=False, slow=False)
    weights = weights_in_phase(comparison, peak)
    bins, floor = _baseband(comparison, peak, weights)
    if len(bins) < _LEAST:
        return Steadiness(tone=False, open=True, slow=False)
    generator = torch.Generator().manual_seed(0)
    smooth = _smoothed(squared_modulus(bins))
    usual = _Usual.of(_drawn(smooth, generator))
    ridge, steady = usual.scores(bins[None])
    if max(float(ridge), float(steady)) > rare:
        return Steadiness(tone=True, open=False, slow=float(ridge) > rare)
    log_ratio = wandering_log_ratio(comparison, peak, weights)
    # What would not be seen of a tone is no proof of noise.
    would = [
        float(torch.stack(usual.scores(tones)).amax(0).median())
        for tones in _tones(peak, smooth, floor, comparison.n_samples, generator)
    ]
    unsure = abs(log_ratio) < sure or (log_ratio < 0 and min(would) < 2 * rare)
    return Steadiness(tone=log_ratio > 0, open=unsure, slow=float(ridge) > float(steady))


def _baseband(comparison: Comparison, peak: Oscillation, weights: Tensor) -> tuple[Tensor, float]:
    """Bins `(bin,)` around the bump of the sensors' weighted sum, and the power of noise in each; none without room.

    Six half widths on either side.
    """
    n = comparison.n_samples
    reach = max(round(6 * peak.width * n), _LEAST // 2)
    centre = round(peak.centre * n)
    reach = min(reach, centre - 3, n // 2 - centre - 2)
    if 2 * reach < _LEAST:
        return torch.zeros(0, dtype=weights.dtype), 0.0
    bins = weights @ rampless_transform(comparison)[:, centre - reach : centre + reach]
    power = squared_modulus(bins)
    edge = max(len(power) // 8, 1)
    floor = float((power[:edge].mean() + power[-edge:].mean()) / 2)
    tail = 1 / (1 + (reach / max(peak.width * n, 1e-9)) ** 2)
    return bins, max(floor - tail * float(power.max()), 0.2 * floor)


def _smoothed(power: Tensor) -> Tensor:
    reach = max(len(power) // 40, 2)
    total = pad(power.cumsum(0), (1, 0))
    at = torch.arange(len(power))
    low, high = (at - reach).clamp(min=0), (at + reach + 1).clamp(max=len(power))
    return (total[high] - total[low]) / (high - low)


def _normals(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    parts = torch.randn(2, *shape, generator=generator, dtype=torch.float64)
    return torch.complex(parts[0], parts[1]) / math.sqrt(2)


def _drawn(power: Tensor, generator: torch.Generator) -> Tensor:
    """Gaussian records' bins `(record, bin)`."""
    return _normals((_DRAWN, len(power)), generator) * power.sqrt()


def _tones(peak: Oscillation, smooth: Tensor, floor: float, n_samples: int, generator: torch.Generator) -> list[Tensor]:
    """Tones as wide and strong as the bump, in noise: of a phase that diffuses, and of speeds that wander."""
    count, rows = len(smooth), _DRAWN // 4
    width = peak.width * n_samples / count  # cycles per sample of the base band
    energy = float((smooth - floor).clamp(min=0).sum()) / count
    diffusing = torch.randn(rows, count, generator=generator, dtype=torch.float64) * math.sqrt(4 * math.pi * width)
    phases = [diffusing.cumsum(-1)]
    for share in (count / 20, 1 / width):  # samples between changes of speed
        step = max(round(share), 2)
        knots = torch.randn(rows, 1, count // step + 2, generator=generator, dtype=torch.float64) * width
        speed = interpolate(knots, count, mode="linear", align_corners=True)[:, 0]
        phases.append(2 * math.pi * speed.cumsum(-1))
    made = []
    for phase in phases:
        tone = torch.polar(torch.full_like(phase, math.sqrt(energy)), phase)
        bins = torch.fft.fftshift(torch.fft.fft(tone) / math.sqrt(count), dim=-1)
        made.append(bins + _normals((rows, count), generator) * math.sqrt(floor))
    return made


class _Usual(NamedTuple):
    """What Gaussian records show.

    Attributes:
        middle, spread: Of peaks in short windows, `(length, 1)`.
        most: Of the largest of them in a record, in units of their spread: mean and sd.
        steady: Of the envelope: mean and sd.
    """

    middle: Tensor
    spread: Tensor
    most: tuple[Tensor, Tensor]
    steady: tuple[Tensor, Tensor]

    @classmethod
    def of(cls, bins: Tensor) -> _Usual:
        """From bins `(record, bin)`."""
        among, steady = _ridges(bins), _steady(bins)
        middle, spread = among.mean(1, keepdim=True), among.std(1, keepdim=True)
        most = ((among - middle) / spread).amax(0)
        return cls(middle, spread, (most.mean(), most.std()), (steady.mean(), steady.std()))

    def scores(self, bins: Tensor) -> tuple[Tensor, Tensor]:
        """How far records lie from Gaussian ones, sds `(record,)`: of short windows' peaks, and of the envelope."""
        most = ((_ridges(bins) - self.middle) / self.spread).amax(0)
        return (most - self.most[0]) / self.most[1], (_steady(bins) - self.steady[0]) / self.steady[1]


def _steady(bins: Tensor) -> Tensor:
    """`1 - v^(1/3)`, `v = E |z|^4 / (E |z|^2)^2 - 1`: about 0 of Gaussian noise, 1 of a tone.

    `v` is the relative variance of the squared envelope. Of a narrow bump it is that of a few independent values, as
    skew as a chi-square of few degrees: its cube root is nearly normal (Wilson and Hilferty), so that standard
    deviations tell how rare an envelope is that hardly varies at all.
    """
    best = bins.shape[-1]
    inner = bins[..., best // 4 : best - best // 4]
    power = squared_modulus(torch.fft.ifft(inner))
    variance = power.square().mean(-1) / power.mean(-1).square() - 1
    return 1 - variance.clamp(min=0).pow(1 / 3)


def _ridges(bins: Tensor) -> Tensor:
    """Mean log of the highest bin over the mean bin in windows of several lengths, `(length, record)`."""
    z = torch.fft.ifft(bins)
    n, found = z.shape[-1], []
    length = 8
    while length <= max(n // 8, 8):
        windows = z[..., : n // length * length].unflatten(-1, (-1, length))
        power = squared_modulus(torch.fft.fft(windows))
        white = power / power.mean(-2, keepdim=True)
        found.append((white.amax(-1) / white.mean(-1)).log().mean(-1))
        length *= 2
    return torch.stack(found)
