"""What the wavelet cross-covariance is compared with: the limit, and what a good engineer writes in an afternoon."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def gram_products(n_sensors: int, n_samples: int, n_levels: int, tile: int = 8192) -> Tensor:
    """The bare Gram products of all tiles and levels on one core: the arithmetic that nothing can avoid.

    One pair of operands stays in cache and is multiplied as often as there are tiles, in whichever of the two
    orders of memory the library multiplies faster; a single product of this shape runs on one core.
    """
    block = torch.ones(tile, n_sensors, dtype=torch.float64)
    transposed = block.T
    out = torch.empty(n_sensors, n_sensors, dtype=torch.float64)
    for _ in range(round(n_levels * n_samples / tile)):
        torch.mm(transposed, block, out=out)
    return out


def blocked_numpy_wccv(signal: np.ndarray, n_levels: int, block: int = 8192) -> np.ndarray:
    """WCCV by the pyramid over blocks of time, each with the samples that its longest filter looks back on.

    Levels whose filters are longer than a block work on the smooth of the level where blocks end, whole.
    """
    n_sensors, n_samples = signal.shape
    n_short = min(n_levels, int(np.log2(block)) - 1)
    halo = 2**n_short - 1
    sums = np.zeros((n_levels, n_sensors, n_sensors))
    smooth = np.empty((n_sensors, n_samples - halo))
    for start in range(0, n_samples, block):
        tile = signal[:, max(0, start - halo) : start + block]
        v = tile
        for level in range(n_short):
            lag = 2**level
            w = v[:, lag:] - v[:, :-lag]
            v = v[:, lag:] + v[:, :-lag]
            w *= 0.5
            v *= 0.5
            new = w[:, -min(block, tile.shape[1]) :] if start else w
            own = min(new.shape[1], n_samples - start, block) if start else new.shape[1]
            part = new[:, new.shape[1] - own :]
            sums[level] += part @ part.T
        if v.shape[1]:
            end = min(start + block, n_samples) - halo
            smooth[:, end - v.shape[1] : end] = v
    v = smooth
    for level in range(n_short, n_levels):
        lag = 2**level
        longer = np.empty((n_sensors, v.shape[1] - lag))
        for start in range(0, v.shape[1] - lag, block):
            now, past = (
                v[:, lag + start : lag + start + block],
                v[:, start : start + block][:, : longer.shape[1] - start],
            )
            w = now - past
            w *= 0.5
            np.add(now, past, out=longer[:, start : start + block])
            longer[:, start : start + block] *= 0.5
            sums[level] += w @ w.T
        v = longer
    counts = n_samples - 2 ** np.arange(1, n_levels + 1) + 1
    return sums / counts[:, None, None]


def blocked_numpy_variance(x: np.ndarray, n_levels: int, block: int = 32_768) -> np.ndarray:
    """WV of one series from its cumulative sum, in blocks that stay in cache."""
    total = np.concatenate([[0.0], np.cumsum(x)])
    n_samples = x.shape[0]
    out = np.empty(n_levels)
    work, square = np.empty(block), 0.0
    for level in range(n_levels):
        lag = 2**level
        count = n_samples - 2 * lag + 1
        square = 0.0
        for start in range(0, count, block):
            n = min(block, count - start)
            w = work[:n]
            np.subtract(total[start + 2 * lag : start + 2 * lag + n], total[start + lag : start + lag + n], out=w)
            w -= total[start + lag : start + lag + n]
            w += total[start : start + n]
            square += w @ w
        out[level] = square / (count * (2.0 * lag) ** 2)
    return out


def conv1d_wccv(signal: Tensor, n_levels: int) -> Tensor:
    """WCCV by whole-array dilated convolutions."""
    kernel = torch.tensor([[[-0.5, 0.5]], [[0.5, 0.5]]], dtype=signal.dtype)
    smooth = signal[:, None]
    levels = []
    for level in range(n_levels):
        both = torch.nn.functional.conv1d(smooth, kernel, dilation=2**level)
        w, smooth = both[:, 0], both[:, 1:]
        levels.append(w @ w.T / w.shape[1])
    return torch.stack(levels)


def pywavelets_wccv(signal: np.ndarray, n_levels: int) -> list[np.ndarray]:
    """WCCV by PyWavelets' stationary transform, on the power of two below the length (it is circular)."""
    import pywt

    n_samples = 2 ** int(np.log2(signal.shape[1]))
    levels = pywt.swt(signal[:, :n_samples], "haar", level=min(n_levels, n_samples.bit_length() - 1), norm=True)
    return [detail @ detail.T / n_samples for _, detail in levels]


def ptwt_wccv(signal: Tensor, n_levels: int) -> list[Tensor]:
    """WCCV by ptwt's stationary transform, on the power of two below the length (it is circular)."""
    import ptwt

    n_samples = 2 ** int(np.log2(signal.shape[1]))
    _, *levels = ptwt.swt(signal[:, :n_samples], "haar", level=min(n_levels, n_samples.bit_length() - 1))
    return [detail @ detail.T / n_samples for detail in levels]
