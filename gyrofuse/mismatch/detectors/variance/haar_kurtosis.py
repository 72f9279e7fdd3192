"""Kurtosis of Haar coefficients: jumps between levels, scale by scale.

Statistic: kurtosis of thinned Haar coefficients. Null law: where the simulation is Gaussian, and shows no departure
from it at a scale, Anscombe's and Glynn's; elsewhere that of `stats.kurtosis` for two series, after outliers of single
samples and the local level of the noise were taken off both sides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.variance.normality import NOTHING_SHOWN, gaussian_sensors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import MOST_RECORDS, left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.kurtosis import kurtosis_p_value, kurtosis_score
from gyrofuse.mismatch.stats.level_scan import local_level
from gyrofuse.mismatch.stats.multiplicity import sidak

_TOP = 6  # levels at the top, with fewer than 64 wavelets in the record: too few for a kurtosis


def jump_test(comparison: Comparison) -> TestResult:
    """Jumps between levels, over all scales and sensors."""
    p_values = kurtosis_p_values(comparison)
    level, sensor = divmod(int(p_values.argmin()), p_values.shape[1])
    return TestResult(
        "jump",
        sidak(float(p_values.min()), p_values.numel()),
        f"wavelet coefficients at level {level + 1} that are not normal in sensor {comparison.info.sensors[sensor]}",
        sensors=(sensor,),
        levels=(level + 1,),
    )


def kurtosis_p_values(comparison: Comparison) -> Tensor:
    """Two-sided p values of the kurtosis of Haar coefficients, `(level, sensor)`, from level 1 to J - 6.

    Levels too high for a shorter simulation are not compared.
    """
    scores, reference = kurtosis_scores(comparison.observed), kurtosis_scores(comparison.reference)
    known = min(len(reference), len(scores))
    scores, reference = scores[:known], reference[:known]
    if comparison.reference.gaussian:
        # Effects built into a Gaussian model show beyond 3.5 sd, which chance reaches at one of 2000 scales.
        scores = scores - reference.sign() * (reference.abs() - 3.5).clamp(min=0)
        return 2 * torch.special.ndtr(-scores.abs())
    p_values = 2 * torch.special.ndtr(-scores.abs())
    records = min(len(comparison.reference.signal), MOST_RECORDS)
    shown = 2 * torch.special.ndtr(-reference.abs() * math.sqrt(records)) < NOTHING_SHOWN
    shown |= ~gaussian_sensors(comparison.reference)
    for sensor in shown.any(0).nonzero()[:, 0].tolist():
        sides = (_levelled_coefficients(side, sensor) for side in (comparison.observed, comparison.reference))
        for level, own, other in zip(range(known), *sides, strict=False):
            if bool(shown[level, sensor]):
                p_values[level, sensor] = kurtosis_p_value(own, other)
    return p_values


@derived
def kurtosis_scores(side: Records) -> Tensor:
    """Kurtosis of thinned Haar coefficients as a standard normal variable, `(level, sensor)`; mean of the records."""
    steady = side.steady[:MOST_RECORDS]
    rows = [torch.stack([kurtosis_score(w) for w in _coefficients(row)]) for row in steady.flatten(0, 1)]
    return torch.stack(rows, -1).unflatten(-1, steady.shape[:2]).mean(1)


def _coefficients(signal: Tensor) -> Iterator[Tensor]:
    """Thinned Haar coefficients of `(..., time)` without their means, from level 1 to J - 6.

    Four in each wavelet, of means over pairs of samples that are thinned as they grow longer.
    """
    mean, stride = signal - signal.mean(-1, keepdim=True), 1
    for level in range(1, int(math.log2(signal.shape[-1])) - _TOP + 1):
        half = 2 ** (level - 1) // stride  # samples of the thinned mean in half a wavelet
        w = (mean[..., half:] - mean[..., :-half]) / 2
        w = w[..., :: max(half // 2, 1)]
        yield w - w.mean(-1, keepdim=True)
        mean = (mean[..., half:] + mean[..., :-half]) / 2
        if half == 4:
            mean, stride = mean[..., ::2], stride * 2


def _levelled_coefficients(side: Records, sensor: int) -> Iterator[Tensor]:
    """Coefficients `(record, time)` without outliers beyond 3 sd, over the level of the fast noise."""
    expected, steady = left_out(side), side.steady[:MOST_RECORDS, sensor]
    error = expected.correctable()[:, sensor]
    reach = 3.0 * expected.sd[:, sensor, None]
    level = local_level(expected.white[:, sensor])
    for w in _coefficients(steady - (error - error.clamp(min=-reach, max=reach))):
        at = torch.linspace(0, level.shape[-1] - 1, w.shape[-1]).round().long()
        over = w / level[:, at].sqrt()
        over = over - over.mean(-1, keepdim=True)
        yield over / over.square().mean(-1, keepdim=True).sqrt().clamp(min=1e-300)  # the records' own levels may differ
