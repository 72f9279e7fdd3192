"""Bumps of a spectrum wider than a line and narrower than an octave."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse._base.transforms import fast_length, squared_modulus
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.modulated_ordinates import level_correlations
from gyrofuse.mismatch.detectors.spectra.own_peak_scan import scanned_own_peaks
from gyrofuse.mismatch.detectors.spectra.shared_peak_scan import flank_of, scanned_shared_peaks
from gyrofuse.mismatch.likelihoods.spectra.coherence import decorrelated
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.known_lines import without_lines
from gyrofuse.mismatch.signals.lines import simulated_lines, whitened
from gyrofuse.mismatch.signals.psd import light_taper
from gyrofuse.mismatch.stats.multiplicity import p_value_from_e_value, sidak

# Bins of a spectrum under the light taper, a tenth of which is at either end, for an independent one in far tails.
_DEPENDENT = 1.15
_AS_WELL = 0.01  # p value at which the simulation has a peak as well, or is too faint to be compared


class Stretch(NamedTuple):
    """Bins that stand out.

    Attributes:
        frequency: Of their middle, cycles per sample.
        width: Cycles per sample.
        p_value: For all stretches, sensor by sensor and together.
        sensors: In which it alone stands out.
    """

    frequency: float
    width: float
    p_value: float
    sensors: tuple[int, ...]


def peak_test(comparison: Comparison) -> TestResult:
    """The strongest bump that the simulation does not have."""
    found = strongest_peak(comparison)
    f = found.frequency * comparison.info.rate
    names = ", ".join(comparison.info.sensors[i] for i in found.sensors)
    return TestResult(
        "bump",
        found.p_value,
        f"a bump {found.width * comparison.info.rate:.3g} Hz wide at {f:.5g} Hz in sensors {names}",
        sensors=found.sensors,
        levels=(level_of(found.frequency),),
        frequency_hz=f,
    )


@derived
def strongest_peak(comparison: Comparison) -> Stretch:
    """The most conspicuous bump of the recording that is neither a line nor in the simulation.

    Six are tried; a line has three fifths of the excess in three bins.
    """
    tries = 6
    transform, length = _transformed(comparison.lineless)
    last = int((0.5 - 2 / comparison.n_samples) * length)
    transform = transform[:, :last]
    ordinates = comparison.n_samples / length / _DEPENDENT
    levels, width = level_correlations(comparison.lineless), comparison.n_samples / length
    scans = list(scanned_own_peaks(squared_modulus(_apart(transform, length, comparison)), ordinates, levels, width))
    if comparison.n_sensors > 1:
        scans += scanned_shared_peaks(transform, ordinates, levels, width)
    power, nothing = squared_modulus(transform), Stretch(0.25, 0.5, 1.0, tuple(range(comparison.n_sensors)))
    reference: tuple[Tensor, int] | None = None
    for _ in range(tries if scans else 0):
        best = max(scans, key=lambda scan: float(scan.log_ratio.amax()))
        a, n = int(best.first[best.log_ratio.argmax()]), best.width
        if not bool(best.log_ratio.isfinite().any()):
            return nothing
        means = [torch.logsumexp(scan.log_ratio, 0) - math.log(len(scan.first)) for scan in scans]
        p_value = p_value_from_e_value(float(torch.logsumexp(torch.stack(means), 0)) - math.log(len(scans)))
        sensors = _alone(power, a, n, n * ordinates)
        stretch = Stretch((a + (n - 1) / 2) / length, n / length, p_value, sensors)
        if p_value > _AS_WELL:
            return stretch
        excess = (power[:, a : a + n].mean(0) - _flanks(power, a, n).mean()).clamp(min=0)
        line = float(excess.topk(3).values.sum()) > 0.6 * float(excess.sum())
        if reference is None:
            bare = without_lines(comparison.reference.signal, simulated_lines(comparison.reference))
            reference = _transformed(whitened(comparison.reference.steadied(bare), comparison.base))
        if not line and not _has_it((transform[None], length), reference, stretch):
            return stretch
        for scan in scans:
            over = (scan.first < a + 2 * n) & (scan.first + scan.width > a - n)
            scan.log_ratio[over] = -math.inf
    return nothing


def _transformed(white: Tensor) -> tuple[Tensor, int]:
    """Transform of whitened samples, `(..., sensor, bin)`, and the length padded to."""
    n = white.shape[-1]
    length = fast_length(n)
    return torch.fft.rfft(white * light_taper(n), n=length), length


def _apart(transform: Tensor, length: int, comparison: Comparison) -> Tensor:
    """Without what sensors `(sensor, bin)` share over broad bands of both.

    Bins are cut to 3.4 medians of their modulus, one in three thousand of noise: lines are nothing that bands share.
    """
    scale = length / comparison.n_samples
    edges = [0, *(round(e * scale) for e in comparison.bands.edges[1:-1]), transform.shape[-1]]
    parts = [transform[:, a:b] for a, b in itertools.pairwise(edges)]
    limits = [3.4 * part.abs().median(-1, keepdim=True).values for part in parts]
    cut = [part * (limit / part.abs()).clamp(max=1) for part, limit in zip(parts, limits, strict=True)]
    return decorrelated(torch.cat(cut, -1), edges, comparison.observed.dof)


def _flanks(power: Tensor, a: int, n: int) -> Tensor:
    """Both flanks of `n` bins from `a` on, `(..., bin)`, as far as they reach."""
    gap, wide = n // 2, flank_of(n, power.shape[-1])
    left, right = power[..., max(a - gap - wide, 0) : max(a - gap, 0)], power[..., a + n + gap : a + n + gap + wide]
    return torch.cat([left, right], -1)


def _alone(power: Tensor, a: int, n: int, d: float) -> tuple[int, ...]:
    """Sensors in which `n` bins from `a` on, of `d` independent ordinates, stand out alone."""
    tails = stats.f.sf((power[:, a : a + n].mean(-1) / _flanks(power, a, n).mean(-1)).numpy(), 2 * d, 6 * d)
    p = len(power)
    return tuple(i for i in range(p) if sidak(float(tails[i]), p) < 0.01) or (int(tails.argmin()),)


def _has_it(recording: tuple[Tensor, int], simulation: tuple[Tensor, int], stretch: Stretch) -> bool:
    """Whether the simulation stands out from its flanks as much as the recording does, within three sd of chance.

    Args:
        recording: Transform `(record, sensor, bin)` and the length padded to.
        simulation: The same.
        stretch: What stands out in the recording.
    """
    (one, chance), (other, others_chance) = _contrast(*recording, stretch), _contrast(*simulation, stretch)
    return float(one - other) < 3 * math.sqrt(chance + others_chance)


def _contrast(transform: Tensor, length: int, stretch: Stretch) -> tuple[Tensor, float]:
    """Log power of a stretch over that of its flanks, as far as they reach, mean of its sensors; and its variance."""
    power = squared_modulus(transform[:, list(stretch.sensors)])
    n = max(round(stretch.width * length), 1)
    a = round(stretch.frequency * length - (n - 1) / 2)
    inside, flanks = power[..., max(a, 0) : a + n], _flanks(power, a, n)
    each = len(power) * len(stretch.sensors) / _DEPENDENT  # independent ordinates in a bin of all records, unpadded
    variance = (1 / inside.shape[-1] + 1 / flanks.shape[-1]) / each
    return (inside.mean((0, -1)) / flanks.mean((0, -1))).log().mean(), variance
