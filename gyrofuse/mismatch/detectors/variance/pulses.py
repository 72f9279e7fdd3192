"""Test of pulses: something that pushes a sensor one way for a few samples, as a shock or a fault of a bus does.

Whitened records of a steady level are seen through half waves of 2, 3, 4, 6, 8, 12 .. samples. The values `z` of a
width are over their median modulus, of all times and of the times around; of noise they are normal. A pulse whose
energy is `a` times that of the noise has the likelihood ratio

    exp(a / (1 + a) z^2 / 2) / sqrt(1 + a)

in each sensor. The mean over places, widths, sizes and sensors that have it is judged as that of ring-downs is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CHANCE, NATS_AS_GOOD
from gyrofuse.mismatch.detectors.lines.ring_cells import RingCell, RingScan, apart, in_another_order, p_value_beside
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.stats.level_scan import local_level
from gyrofuse.mismatch.stats.multiplicity import e_value_of_some


def pulse_test(comparison: Comparison) -> TestResult:
    """A push of a few samples that the simulation does not have."""
    found, info = pulses_of(comparison), comparison.info
    if not found.cells:
        return TestResult("pulse", 1.0, "nothing pushes a sensor for a few samples")
    cell = found.cells[0]
    return TestResult(
        "pulse",
        pulse_p_value(comparison),
        f"a pulse of {cell.length / info.rate:.3g} s at {cell.onset / info.rate:.6g} s in "
        f"{info.named(cell.sensors, 'all sensors')}",
        sensors=cell.sensors,
        levels=(level_of(cell.frequency),),
        time_s=cell.onset / info.rate,
    )


@derived
def pulses_of(comparison: Comparison) -> RingScan:
    """Pulses of the recording."""
    return scanned_pulses(comparison.lineless)


@derived
def disordered(comparison: Comparison) -> RingScan:
    """The same of the recording's samples in another order, of which none lasts."""
    return scanned_pulses(in_another_order(comparison.lineless))


@derived
def _simulated(comparison: Comparison) -> RingScan:
    return scanned_pulses(comparison.lineless_reference[0])


def pulse_p_value(comparison: Comparison) -> float:
    """p value of the recording's, by Ville's bound and beside the strongest of the simulation."""
    own = pulses_of(comparison)
    if own.p_value > CHANCE:
        return own.p_value
    return p_value_beside(own, _simulated(comparison), disordered(comparison))


def scanned_pulses(white: Tensor) -> RingScan:
    """All pulses of whitened samples `(sensor, time)`."""
    clip, fewest = 4.5, 64  # standard deviations: no single sample is a pulse; widths that a record has room for
    local = local_level(white)
    white = (white / local.sqrt()).clamp(-clip, clip)
    total, n_cells, found = -math.inf, 0, list[RingCell]()
    scale, widths = 1, [2, 3, 4, 6]
    while 6 * fewest <= white.shape[-1]:
        for width in widths:
            ends = 2 * width  # where a filter lets in what is not there
            score = _over_median(_seen(white, width), local, width)[:, ends:-ends].square() / 2  # (sensor, place)
            n_cells += score.shape[-1]
            places = (score.amax(0) > NATS_AS_GOOD).nonzero()[:, 0]
            if not len(places):
                continue
            log_ratios = _log_ratios(score[:, places])
            total = float(torch.logaddexp(log_ratios.logsumexp(0), torch.tensor(total, dtype=torch.float64)))
            found += _likeliest(log_ratios, score[:, places], places + ends, scale, width)
        n = white.shape[-1] // 2 * 2
        white, local = white[:, :n].unflatten(-1, (-1, 2)).sum(-1) / math.sqrt(2), local[:, :n:2]
        scale, widths = 2 * scale, [4, 6]
    found.sort(key=lambda cell: -cell.log_ratio)
    return RingScan(total - math.log(max(n_cells, 1)), n_cells, tuple(apart(found)))


def _seen(white: Tensor, width: int) -> Tensor:
    """Through half waves of a width that begin at each sample, `(sensor, place)`."""
    half_wave = torch.sin(math.pi * (torch.arange(width, dtype=white.dtype) + 0.5) / width)
    return torch.nn.functional.conv1d(white[:, None], (half_wave / half_wave.norm())[None, None])[:, 0]


def _over_median(z: Tensor, local: Tensor, width: int) -> Tensor:
    """Over the median modulus of normal values: of all, and of those in quiet times and nearby where that is larger.

    Where a fast tone is loud, what is slow has become quieter than it is with the local level.
    """
    normal, near = 0.6745, 48 * width  # samples
    size, local = z.abs(), local[:, : z.shape[-1]]
    quiet = size.masked_fill(local > local.median(-1, keepdim=True).values, math.nan).nanmedian(-1, keepdim=True).values
    level = torch.maximum(size.median(-1, keepdim=True).values, quiet).clamp(min=1e-12)
    n = z.shape[-1] // near
    if n > 1:
        parts = size[:, : n * near].unflatten(-1, (n, near)).median(-1).values
        part = (torch.arange(z.shape[-1]) // near).clamp(max=n - 1)
        level = torch.maximum(level, 0.8 * parts[:, part])  # of so few a median may be high by chance
    return z * (normal / level)


def _likeliest(log_ratios: Tensor, score: Tensor, place: Tensor, scale: int, width: int) -> Iterator[RingCell]:
    """The best of cells `(cell,)`, some hundreds of each width."""
    most, length = 256, width * scale
    for k in log_ratios.argsort(descending=True)[:most].tolist():
        yield RingCell(
            int(place[k]) * scale, 0.5 / length, length, length, float(log_ratios[k]), score[:, k].to(torch.float64)
        )


def _log_ratios(score: Tensor) -> Tensor:
    """Of cells `(cell,)`, from the scores of their sensors, nats `(sensor, cell)`."""
    sizes = (12.0, 48.0, 192.0)  # energy of a pulse over that of the noise
    each = torch.stack([e_value_of_some(a / (1 + a) * score - math.log1p(a) / 2) for a in sizes])
    return each.logsumexp(0) - math.log(len(sizes))
