"""How much less a band's power is known of noise whose level varies.

Ordinates of white noise of a level `s_t^2` go together: given the level, those at a distance of `k` bins have the
covariance `|sum_t s_t^2 exp(-2 pi i k t / n)|^2 / n^2` (Brillinger, Time Series, 1981, theorem 4.3.2, for such noise).
With `Q_k` the transform of the squares `x^2`, whose scatter alone gives `|Q_k|^2` the mean `n var(x^2)`, their
correlation is `rho_k = (|Q_k|^2 - n var(x^2)) / Q_0^2`, and a sum of ordinates with weights `w` has the variance of
independent ones times

    F = 1 + 2 sum_k rho_k c_k / c_0,   c_k = sum_i w_i w_{i + k}.

Bursts of 20 samples make random humps a twentieth of the sampling rate wide.
"""

from __future__ import annotations

import torch
from torch import Tensor


def level_correlations(white: Tensor) -> Tensor:
    """Correlations of ordinates by their distance, bins of the record, from whitened samples `(sensor, time)`.

    Returns:
        `(sensor, distance)`, from one bin to half the record's.
    """
    squares = white.square()
    centred = squares - squares.mean(-1, keepdim=True)
    power = torch.fft.rfft(centred)[..., 1:].abs().square()
    by_chance = centred.square().sum(-1, keepdim=True)
    return (power - by_chance) / squares.sum(-1, keepdim=True).square().clamp(min=1e-300)


def inflation(correlations: Tensor, weights: Tensor, width: float) -> Tensor:
    """`F`, not below one, `(sensor,)`.

    Args:
        correlations: `(sensor, distance)`, as `level_correlations` gives them.
        weights: Of neighbouring stretches of the spectrum, `(stretch,)`.
        width: Of such a stretch, bins of the record.
    """
    m = len(weights)
    c = torch.fft.irfft(torch.fft.rfft(weights, n=2 * m).abs().square(), n=2 * m)[:m]
    n_bins = min(int((m - 1) * width), correlations.shape[-1])
    at = torch.arange(1, n_bins + 1) / width
    low = at.long().clamp(max=m - 2)
    between = c[low] + (at - low) * (c[low + 1] - c[low])  # weights are the same all over a stretch
    return (1 + 2 * (correlations[:, :n_bins] @ between) / c[0]).clamp(min=1)
