"""Parity residuals of an array: energies of every sensor's difference from the others, window by window.

Combinations of sensors whose coefficients sum to 0 do not hold the common rate: they are the parity space, of p - 1
dimensions, in which an array can be tested while it moves. At level j the most sensitive combination for sensor i is
its difference from the optimal fusion of all others,

    e_i = (N W)_i / N_ii,   N = G^-1 - G^-1 1 1' G^-1 / (1' G^-1 1),   Var e_i = 1 / N_ii,   G = Gamma_j,

and the parity energy `W' N W` less its energy is the parity energy of the array without sensor i.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

# Samples of all sensors that are worked on at a time (2**17, 1 MiB): they and their coefficients stay in cache.
_AT_ONCE = 131_072


class Products(NamedTuple):
    """Products of coefficients in each window.

    Attributes:
        means: Mean products, `(..., window, level, sensor, sensor)`.
        counts: Number of coefficients, `(..., window, level)`.
        live: Whether a sensor has half of a window's samples, `(..., window, sensor)`.
    """

    means: Tensor
    counts: Tensor
    live: Tensor


class Energies(NamedTuple):
    """Energies of each window, level and sensor, `(..., window, level, sensor)`.

    Attributes:
        parity: Energy of `e_i`, 1 on average in a nominal array.
        own: Energy of the sensor itself, 1 on average in a nominal array at rest.
        rest: Parity energy of the array without the sensor.
        counts: Number of coefficients, `(..., window, level)`.
    """

    parity: Tensor
    own: Tensor
    rest: Tensor
    counts: Tensor


def chunks_of(signal: Tensor, window: int, n_levels: int, history: Tensor | None = None) -> Iterator[Tensor]:
    """Stretches of some windows each, with `2**(n_levels + 1)` samples before them (NaN where there are none).

    The longest wavelet reaches back over half of these; the other half shows a fault's beginning.

    Args:
        signal: `(..., sensor, time)`.
        window: Samples of a window.
        n_levels: Number of levels.
        history: `(..., sensor, time)`, samples before the signal.
    """
    past = 2 ** (n_levels + 1)
    n_windows = signal.shape[-1] // window
    if history is not None:
        signal = torch.cat([history[..., -past:], signal], -1)
    missing = past if history is None else max(past - history.shape[-1], 0)
    n_items = max(signal[..., 0].numel(), 1)
    at_once = max((_AT_ONCE // n_items - past) // window, past // window, 1)
    for first in range(0, n_windows, at_once):
        start = first * window - missing
        stop = start + past + min(at_once, n_windows - first) * window
        yield functional.pad(signal[..., max(start, 0) : stop].double(), (max(-start, 0), 0), value=torch.nan)


def window_products(chunk: Tensor, window: int, n_levels: int) -> Products:
    """Mean products of the coefficients that end in each window of a chunk.

    A sample that one sensor lacks is left out of all sensors, so that the rate cancels, and half a wavelet is the mean
    of the remaining samples, three quarters at least. With n of h samples in each half the coefficient is taken times
    `sqrt(2 / (h/n_1 + h/n_0))`, which gives white noise the variance of a whole one and slower noise a little less. A
    sensor that lacks more than half of a window is left out of it.

    Args:
        chunk: `(..., sensor, time)`, of `chunks_of`.
        window: Samples of a window.
        n_levels: Number of levels.
    """
    items = chunk.reshape(-1, *chunk.shape[-2:])
    # As many at a time as stay in cache.
    group = max(_AT_ONCE // max(chunk.shape[-2] * chunk.shape[-1], 1), 1)
    parts = [_products(some, window, n_levels) for some in items.split(group)]
    return Products(*(torch.cat(c).reshape(*chunk.shape[:-2], *c[0].shape[1:]) for c in zip(*parts, strict=True)))


def _products(chunk: Tensor, window: int, n_levels: int) -> Products:
    """The same for `(item, sensor, time)`."""
    length = chunk.shape[-1] - 2 ** (n_levels + 1)
    lead = -chunk.shape[-1] % window
    finite = functional.pad(chunk.isfinite(), (lead, 0))
    present = finite.unflatten(-1, (-1, window)).double().mean(-1) >= 0.5  # (item, sensor, window)
    absent = ~present & present.any(-2, keepdim=True)
    some_absent = bool(absent.any())
    live = ~absent[..., -(length // window) :].mT  # (item, window, sensor)
    finite = finite[..., lead:]
    mean = torch.where(finite, chunk, torch.nan).nanmean(-1, keepdim=True)
    used = (finite | absent.repeat_interleave(window, -1)[..., lead:]).all(-2, keepdim=True)
    sums = torch.where(finite & used, chunk - mean, 0.0)
    n, n_own = used.to(sums), (finite & used).to(sums)
    means, counts = [], []
    for level in range(n_levels):
        half = 2**level
        newer, older = slice(half, None), slice(None, -half)
        n_1, n_0 = n[..., newer], n[..., older]
        complete = torch.minimum(n_1, n_0) >= 0.75 * half
        if some_absent:
            complete = complete & (n_own[..., newer] == n_1) & (n_own[..., older] == n_0)
            n_own = n_own[..., newer] + n_own[..., older]
        scale_1, scale_0 = 1 / n_1.clamp(min=1), 1 / n_0.clamp(min=1)
        share = (2 / half / (scale_1 + scale_0)).sqrt() / 2
        last = slice(sums.shape[-1] - half - length, None)
        ending = sums[..., newer][..., last] * (share * scale_1)[..., last]
        ending -= sums[..., older][..., last] * (share * scale_0)[..., last]
        sums, n = sums[..., newer] + sums[..., older], n_1 + n_0
        ending, complete = (
            m.unflatten(-1, (-1, window)).movedim(-3, -2) for m in (ending, complete[..., last])
        )  # (item, window, sensor, time)
        if some_absent:
            complete = (complete | ~live.unsqueeze(-1)).all(-2, keepdim=True)
        filled = torch.where(complete & live.unsqueeze(-1), ending, 0.0)
        counts.append(complete.sum((-2, -1)).double())
        means.append(filled @ filled.mT / counts[-1].clamp(min=1)[..., None, None])
    return Products(torch.stack(means, -3), torch.stack(counts, -1), live)


def parity_matrix(gamma: Tensor, live: Tensor) -> tuple[Tensor, Tensor]:
    """`N` of the live sensors, and their optimal weights; 0 for the others.

    Args:
        gamma: `(..., level, sensor, sensor)` of a nominal array.
        live: `(..., window, sensor)`, bool.

    Returns:
        `(..., window, level, sensor, sensor)` and `(..., window, level, sensor)`; with a single window, for all, where
        all sensors are live.
    """
    mask = (live[..., :1, :] if bool(live.all()) else live).unsqueeze(-2)  # (..., window, 1, sensor)
    gamma = gamma.unsqueeze(-4)
    both = mask[..., :, None] & mask[..., None, :]
    inverse = torch.linalg.inv(torch.where(both, gamma, torch.diag_embed((~mask).to(gamma))))
    inverse = torch.where(both, inverse, 0.0)
    sums = inverse.sum(-1)
    total = sums.sum(-1, keepdim=True).clamp(min=torch.finfo(sums.dtype).tiny)
    return inverse - sums[..., :, None] * (sums / total)[..., None, :], sums / total


def own_variance(gamma: Tensor) -> Tensor:
    """Wavelet variance of each sensor itself, without common motion.

    Vibration in the reference is not noise of the sensors. For independent noises `N_ii = u_i - u_i^2 / sum_k u_k` with
    `u = 1 / variance`, whatever the common motion, solved for `u` by a fixed point; two sensors do not determine it.

    Args:
        gamma: `(..., level, sensor, sensor)`.

    Returns:
        `(..., level, sensor)`.
    """
    variance = gamma.diagonal(dim1=-2, dim2=-1)
    if gamma.shape[-1] < 3:
        return variance
    live = torch.ones_like(variance[..., 0, :], dtype=torch.bool).unsqueeze(-2)
    precision = parity_matrix(gamma, live)[0].squeeze(-4).diagonal(dim1=-2, dim2=-1)
    alone = precision
    for _ in range(20):  # settles to rounding in a few
        alone = precision / (1 - alone / alone.sum(-1, keepdim=True)).clamp(min=0.1)
    return torch.minimum(variance, 1 / alone)


def energies_of(
    products: Products,
    matrix: Tensor,
    weights: Tensor,
    own: Tensor,
    scale_factor_tolerance: float = 0.0,
) -> Energies:
    """Energies of a chunk's windows in units of those of a nominal array.

    Args:
        products: Products of the windows.
        matrix: `N` of a nominal array, `(..., window, level, sensor, sensor)`.
        weights: Its optimal weights, `(..., window, level, sensor)`.
        own: Its `own_variance`.
        scale_factor_tolerance: Relative difference of scale factors that is no fault.
    """
    means, counts, _ = products
    own_precision = matrix.diagonal(dim1=-2, dim2=-1)  # N_ii = 1 / Var e_i
    spared = torch.where(own_precision > 0, own_precision, torch.inf)
    squares = torch.einsum("...ik,...kl,...li->...i", matrix, means, matrix)
    parity = squares / spared
    rest = (torch.einsum("...ik,...ki->...", matrix, means).unsqueeze(-1) - parity).clamp(min=0)
    if scale_factor_tolerance:
        # e_i holds at most tolerance x (1 + sum_k |a_k|) times the rate, whose energy is that of the fused signal.
        rate = torch.einsum("...i,...ik,...k->...", weights, means, weights).unsqueeze(-1)
        error = scale_factor_tolerance * matrix.abs().sum(-1) / spared
        parity = parity / (1 + error.square() * rate * own_precision)
    return Energies(parity, means.diagonal(dim1=-2, dim2=-1) / own.unsqueeze(-3), rest, counts)
