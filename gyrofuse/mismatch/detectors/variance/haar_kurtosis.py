"""Kurtosis of Haar coefficients: jumps between levels, scale by scale.

Where the simulation is Gaussian, and shows no departure from it at a scale, the recording's kurtosis has Anscombe's and
Glynn's law (1983). Elsewhere it is compared with the simulation's, of which `stats.kurtosis` says how
uncertain it is; outliers of single samples, and the local level of the noise, are taken off both sides before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.variance.normality import NOTHING_SHOWN, gaussian_sensors
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.prediction_errors import MOST_RECORDS, left_out
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.kurtosis import kurtosis_p_value
from gyrofuse.mismatch.stats.local_level import local_level

_TOP = 6  # levels at the top that have too few coefficients
_NEIGHBOURS = 8  # thinned Haar coefficients that are correlated
_BUILT_IN = 3.5  # sd of a Gaussian model's kurtosis, beyond which effects that were built into it are taken for it
_OUTLIER = 3.0  # sd of its prediction, beyond which a sample is pulled in


def kurtosis_p_values(comparison: Comparison) -> Tensor:
    """Two-sided p values of the kurtosis of Haar coefficients, `(level, sensor)`, from level 1 to J - 6."""
    n_levels = int(math.log2(comparison.n_samples)) - _TOP
    scores = kurtosis_scores(comparison.observed)[:n_levels]
    reference = kurtosis_scores(comparison.reference)
    # Levels too high for a shorter simulation have none to compare with.
    known = min(len(reference), len(scores))
    scores, reference = scores[:known], reference[:known]
    if comparison.reference.gaussian:
        scores = scores - reference.sign() * (reference.abs() - _BUILT_IN).clamp(min=0)
        return 2 * torch.special.ndtr(-scores.abs())
    p_values = 2 * torch.special.ndtr(-scores.abs())
    records = min(len(comparison.reference.signal), MOST_RECORDS)
    shown = 2 * torch.special.ndtr(-reference.abs() * math.sqrt(records)) < NOTHING_SHOWN
    shown |= ~gaussian_sensors(comparison.reference)
    if bool(shown.any()):
        sides = zip(
            _levelled_coefficients(comparison.observed), _levelled_coefficients(comparison.reference), strict=False
        )
        for level, (own, other) in zip(range(known), sides, strict=False):
            for sensor in shown[level].nonzero()[:, 0].tolist():
                p_values[level, sensor] = kurtosis_p_value(own[:, sensor], other[:, sensor])
    return p_values


@derived
def kurtosis_scores(side: Records) -> Tensor:
    """Kurtosis of thinned Haar coefficients as a standard normal variable, `(level, sensor)`; mean of the records."""
    scores = []
    for centred in _coefficients(side.steady[:MOST_RECORDS]):
        kurtosis = centred.pow(4).mean(-1) / centred.square().mean(-1).square()
        scores.append(normal_kurtosis(kurtosis, independent_values(centred)).mean(0))
    return torch.stack(scores)


def _coefficients(signal: Tensor) -> Iterator[Tensor]:
    """Thinned Haar coefficients of `(..., time)` without their means, from level 1 to J - 6."""
    mean, stride = signal - signal.mean(-1, keepdim=True), 1
    for level in range(1, int(math.log2(signal.shape[-1])) - _TOP + 1):
        half = 2 ** (level - 1) // stride  # samples of the thinned mean in half a wavelet
        w = (mean[..., half:] - mean[..., :-half]) / 2
        w = w[..., :: max(half // 2, 1)]
        yield w - w.mean(-1, keepdim=True)
        mean = (mean[..., half:] + mean[..., :-half]) / 2
        if half == 4:
            mean, stride = mean[..., ::2], stride * 2


def _levelled_coefficients(side: Records) -> Iterator[Tensor]:
    """The same without single outliers, and over the local level of the fast noise."""
    expected, steady = left_out(side), side.steady[:MOST_RECORDS]
    error = expected.correctable()
    reach = _OUTLIER * expected.sd[..., None]
    level = local_level(expected.white)
    for w in _coefficients(steady - (error - error.clamp(min=-reach, max=reach))):
        at = torch.linspace(0, level.shape[-1] - 1, w.shape[-1]).round().long()
        over = w / level[..., at].sqrt()
        over = over - over.mean(-1, keepdim=True)
        yield over / over.square().mean(-1, keepdim=True).sqrt().clamp(min=1e-300)  # the records' own levels may differ


def independent_values(w: Tensor) -> Tensor:
    """How many independent normal values `(...)` have a kurtosis as certain as that of `(..., time)`.

    The fourth Hermite polynomials of two values correlated by `rho` are correlated by `rho^4`.
    """
    energy = w.square().sum(-1)
    rho = [(w[..., lag:] * w[..., :-lag]).sum(-1) / energy for lag in range(1, _NEIGHBOURS + 1)]
    return w.shape[-1] / (1 + 2 * torch.stack(rho).pow(4).sum(0))


def normal_kurtosis(b2: Tensor, n: Tensor) -> Tensor:
    """Standard normal score of a sample kurtosis of `n` independent values (Anscombe and Glynn, 1983)."""
    mean = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1).square() * (n + 3) * (n + 5))
    x = (b2 - mean) / variance.sqrt()
    tail = (6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3))).sqrt()
    skew = 6 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9)) * tail
    a = 6 + 8 / skew * (2 / skew + (1 + 4 / skew.square()).sqrt())
    ratio = (1 - 2 / a) / (1 + x * (2 / (a - 4)).sqrt())
    return (1 - 2 / (9 * a) - ratio.sign() * ratio.abs().pow(1 / 3)) / (2 / (9 * a)).sqrt()
