"""Area under the ROC curve of a classifier of windows, those of a recording against those of a simulation.

Linear discriminant analysis on what a window shows: wavelet variances, tails, repeats, how far its mean has moved, and
how much sensors share. Each fold of windows is judged by a classifier that has not seen it; 0.5 is guessing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_JUDGED, in_fold
from gyrofuse.wavelets.covariance import wavelet_cross_covariance

_WINDOWS = (
    512  # of a recording: the area of so many has a standard error of 0.02, and a window of it still holds four levels
)
_SHORTEST = 64  # samples of a window
_LEVELS_LEFT = 3  # of a window's longest wavelets, too few coefficients
_RIDGE = 1.0  # windows' worth of prior on the features' scatter
_MOST_RECORDS = 2
_TINY = 1e-300


def distinguishability(comparison: Comparison, fold: int) -> float:
    """Area under the ROC curve on windows that a fold holds out, each as long as 1/512 of the recording, or longer.

    Shorter where the simulation is too short to have one for each block.
    """
    observed, reference = _both(comparison)
    everything = torch.cat([observed, reference])
    everything = (everything - everything.mean(0)) / everything.std(0).clamp(min=1e-12)
    label = torch.arange(len(everything)) < len(observed)
    most = len(observed) // N_JUDGED  # windows of a block
    place = torch.cat([torch.arange(n) // min(n // N_JUDGED, most) for n in (len(observed), len(reference))])
    judged = in_fold(N_JUDGED, fold)[place % N_JUDGED]
    score = everything[judged] @ _discriminant(everything[~judged], label[~judged])
    return area_under_curve(score[label[judged]], score[~label[judged]])


@derived
def _both(comparison: Comparison) -> tuple[Tensor, Tensor]:
    """Features of the windows of the recording and of the simulation."""
    records = comparison.reference.signal[:_MOST_RECORDS]
    n_windows = min(_WINDOWS, comparison.n_samples // (_SHORTEST * N_JUDGED) * N_JUDGED)
    window = min(comparison.n_samples // n_windows, records.shape[-1] // N_JUDGED)
    return features(comparison.recording, window), torch.cat([features(record, window) for record in records])


def features(signal: Tensor, window: int) -> Tensor:
    """What each window of `(sensor, time)` shows, `(window, feature)`."""
    n = signal.shape[-1] // window
    windows = signal[..., : n * window].unflatten(-1, (n, window)).movedim(-2, 0)  # (window, sensor, time)
    n_levels = max(window.bit_length() - 1 - _LEVELS_LEFT, 1)
    moments = wavelet_cross_covariance(windows, n_levels)  # (window, level, sensor, sensor)
    variance = moments.diagonal(dim1=-2, dim2=-1).clamp(min=_TINY)
    size = variance.rsqrt()
    shared = torch.linalg.eigvalsh(moments * size[..., :, None] * size[..., None, :])[..., -1]
    change = windows.diff()
    scale = change.square().mean(-1, keepdim=True).sqrt().clamp(min=_TINY)
    mean = windows.mean(-1)
    moved = torch.cat([torch.zeros_like(mean[:1]), mean.diff(dim=0).abs()])
    return torch.cat(
        [
            variance.log().flatten(1),
            shared,
            (change / scale).abs().amax(-1),
            (change / scale).pow(4).mean(-1).clamp(min=_TINY).log(),
            (change == 0).to(signal.dtype).mean(-1),
            moved,
        ],
        1,
    )


def area_under_curve(positive: Tensor, negative: Tensor) -> float:
    """Share of pairs in which the positive one has the larger score; ties count half."""
    larger = (positive[:, None] > negative).to(torch.float64) + (positive[:, None] == negative).to(torch.float64) / 2
    return float(larger.mean())


def _discriminant(values: Tensor, label: Tensor) -> Tensor:
    """Fisher's direction, the scatter within classes drawn a little towards that of independent features."""
    means = [values[label].mean(0), values[~label].mean(0)]
    left = torch.cat([values[label] - means[0], values[~label] - means[1]])
    scatter = left.mT @ left + _RIDGE * torch.eye(values.shape[-1], dtype=values.dtype)
    return torch.linalg.solve(scatter, means[0] - means[1])
