"""A tone that wanders, or Gaussian noise of the same spectrum: mean likelihood ratios over the courses of either.

In a band of frequencies around a bump, a tone of amplitude `A` in noise of variance one per sample gives windows of
`L` samples, transformed at twice as many frequencies, powers `P` with the likelihood ratio

    exp(-rho) I_0(2 sqrt(rho P)),   rho = A^2 L,

over noise alone, whatever its phase (Rice); from window to window its frequency moves as a hidden Markov chain does.
Gaussian noise has a hump, Lorentzian or normal, on a level, and Whittle's likelihood. Each is averaged over windows,
strengths and speeds, or centres, widths and heights.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived

_FEWEST = 256  # bins on either side of a peak, in which tones and noise of its spectrum differ by their courses
_MOST_CELLS = 4096  # of a band, in which peaks are searched for: memory and time do not grow with the record


def weights_in_phase(comparison: Comparison, peak: Oscillation) -> Tensor:
    """Complex weights `(sensor,)` that sum the sensors in phase, by their noise; the clearest where they have none."""
    noise = comparison.base.spectrum(torch.tensor([peak.centre], dtype=torch.float64))[:, 0]
    if peak.gain is not None:
        return peak.gain.conj() / noise
    weights = torch.zeros_like(noise).to(torch.complex128)
    weights[int((peak.variance / noise).argmax())] = 1.0
    return weights


def wandering_log_ratio(comparison: Comparison, peak: Oscillation, weights: Tensor) -> float:
    """Log likelihood of a tone over that of Gaussian noise, in the sensors' weighted sum around a bump."""
    bins = _band(comparison, peak, weights)
    if len(bins) < _FEWEST:
        return 0.0
    power = squared_modulus(bins)
    hump = _hump(power)
    tone = _tone(bins / math.sqrt(hump.level), hump.energy)
    noise = -len(bins) * math.log(hump.level) - float(power.sum()) / hump.level
    return tone + noise - hump.log_mean


def probably_normal(comparison: Comparison, peak: Oscillation) -> float:
    """Probability that a hump has the shape of a normal law, not a Lorentzian one."""
    bins = _band(comparison, peak, weights_in_phase(comparison, peak))
    return _hump(squared_modulus(bins)).normal if len(bins) >= _FEWEST else 0.5


@derived
def rampless_transform(comparison: Comparison) -> Tensor:
    """Transform `(sensor, bin)` of the recording whose ends are made to meet."""
    ramp = torch.linspace(0, 1, comparison.n_samples, dtype=torch.float64)
    return torch.fft.rfft(comparison.recording - (comparison.recording[:, -1:] - comparison.recording[:, :1]) * ramp)


def _band(comparison: Comparison, peak: Oscillation, weights: Tensor) -> Tensor:
    """Bins `(bin,)` of the sum in units of its noise, eight half widths on either side."""
    n = comparison.n_samples
    centre, reach = round(peak.centre * n), max(round(8 * peak.width * n), _FEWEST)
    reach = min(reach, centre - 3, n // 2 - centre - 2)
    reach -= reach % _cell(2 * reach)
    inside = slice(centre - reach, centre + reach)
    f = torch.arange(inside.start, inside.stop, dtype=torch.float64) / n
    noise = weights.abs().square() @ comparison.base.spectrum(f) * n
    return (weights @ rampless_transform(comparison)[:, inside]) / noise.sqrt()


class Hump(NamedTuple):
    """A hump on a level.

    Attributes:
        log_mean: Mean log likelihood of Gaussian humps.
        level, energy: Of the likeliest, the energy in units of the level.
        normal: Probability that it has the shape of a normal law, not a Lorentzian one.
    """

    log_mean: float
    level: float
    energy: float
    normal: float


def _cell(n_bins: int) -> int:
    """Bins in a cell, a power of two: half of a band may be a whole number of cells, and is one of shorter cells."""
    return 1 << max((max(n_bins, 1) - 1) // _MOST_CELLS, 0).bit_length()


def _hump(power: Tensor) -> Hump:
    """Humps of powers `(bin,)`, a whole number of cells, over which a hump is taken for level.

    Half widths are from two cells to an eighth of the band, centres an eighth of it off at most, heights 0.05 to 100
    times the level.
    """
    centres = torch.linspace(-1 / 8, 1 / 8, 9)
    heights = torch.logspace(math.log10(0.05), 2, 12, dtype=torch.float64)
    cell = _cell(len(power))
    power = power.unflatten(0, (-1, cell)).mean(-1)
    n = len(power)
    k = torch.arange(n, dtype=torch.float64) - (n - 1) / 2
    widths = torch.logspace(math.log10(2), math.log10(n / 8), 10, dtype=torch.float64)
    height = heights[:, None, None]
    values: tuple[list[Tensor], list[Tensor]] = ([], [])  # Lorentzian, normal
    best = (-math.inf, 1.0, 0.0)
    for centre in (n * centres).tolist():
        square = ((k - centre) / widths[:, None]).square()
        for of_shape, shape in zip(values, (1 / (1 + square), (-square / 2).exp()), strict=True):
            spectrum = 1 + height * shape  # (height, width, bin)
            level = (power / spectrum).mean(-1)
            value = -cell * (n * (level.log() + 1) + spectrum.log().sum(-1))
            of_shape.append(value.flatten())
            at = int(value.argmax())
            if float(value.max()) > best[0]:
                energy = cell * (height * shape).sum(-1)
                best = float(value.max()), float(level.flatten()[at]), float(energy.flatten()[at])
    total = torch.stack([torch.cat(of_shape).logsumexp(0) for of_shape in values])
    count = sum(len(part) for of_shape in values for part in of_shape)
    log_mean = float(total.logsumexp(0)) - math.log(count)
    return Hump(log_mean, best[1], best[2], float(total.softmax(0)[1]))


def _tone(bins: Tensor, energy: float) -> float:
    """Mean log likelihood ratio of tones over noise of one in each bin, in windows of 4 to 128 samples of the band."""
    n = len(bins)
    z = torch.fft.ifft(torch.fft.ifftshift(bins)) * math.sqrt(n)
    found, length = [], 4
    while length <= min(n // 4, 128):
        windows = z[: n // length * length].unflatten(-1, (-1, length))
        power = squared_modulus(torch.fft.fft(windows, n=2 * length)) / length  # (window, frequency), in circular order
        found.append(_courses(power, energy / len(power)))
        length *= 2
    every = torch.cat(found)
    return float(every.logsumexp(0)) - math.log(len(every))


def _courses(power: Tensor, energy: float) -> Tensor:
    """Log likelihood ratios `(strength * speed,)` over all courses of the frequency through windows.

    Args:
        power: Powers over the noise, `(window, frequency)`.
        energy: Energy of the likeliest peak in a window: a tone has 0.25 to 1.5 of it.
    """
    strengths = torch.tensor([0.25, 0.4, 0.6, 1.0, 1.5], dtype=torch.float64)
    speeds = torch.tensor([0.5, 1.5, 4.0], dtype=torch.float64)  # from window to window, half their resolution
    n = power.shape[-1]
    power = torch.fft.fftshift(power, dim=-1)
    rho = energy * strengths[:, None, None, None]
    x = 2 * (rho * power[:, None]).sqrt()
    log_ratio = torch.special.i0e(x).log() + x - rho  # (strength, window, 1, frequency)
    peak = log_ratio.amax(-1, keepdim=True)
    ratio = (log_ratio - peak).exp()
    apart = (torch.arange(n)[:, None] - torch.arange(n)).abs().to(torch.float64)
    chain = (-apart / speeds[:, None, None]).exp()
    chain = chain / chain.sum(-1, keepdim=True)
    state = torch.full((len(strengths), len(speeds), n), 1 / n, dtype=torch.float64)
    total = peak.sum((1, 2, 3))[:, None].expand(-1, len(speeds))
    for window in range(len(power)):
        here = state * ratio[:, window]
        size = here.sum(-1, keepdim=True)
        total = total + size[..., 0].log()
        state = ((here / size).movedim(1, 0) @ chain).movedim(0, 1)
    return total.flatten()
