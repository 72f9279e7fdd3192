"""Signals filtered by a response given in frequency or resampled at other times, and noise of a given density."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from scipy.signal import lfilter
from torch import Tensor

from gyrofuse._base.transforms import fast_length

_SINC_TAPS = 32  # taps on either side
_KAISER_BETA = 6.0  # of the Kaiser window


def filtered(signal: Tensor, response: Callable[[Tensor], Tensor]) -> Tensor:
    """Signals `(..., sensor, time)` through filters.

    They go on as their mirror images at either end, so that a walk has no jump there, and white noise that is made a
    walk no slope.

    Args:
        signal: Records.
        response: Complex gains `(sensor, frequency)` at `f` cycles per sample.
    """
    transform, middle, f = _mirrored_transform(signal)
    gain = response(f)
    moved = torch.fft.irfft(transform * gain, n=2 * signal.shape[-1])[..., : signal.shape[-1]]
    return moved - moved.mean(-1, keepdim=True) + middle * gain[..., :1].real


def mixed(signal: Tensor, mixing: Callable[[Tensor], Tensor]) -> Tensor:
    """Signals `(..., sensor, time)` mixed frequency by frequency; their means stay.

    Args:
        signal: Records.
        mixing: Complex gains `(frequency, sensor, sensor)` at `f` cycles per sample.
    """
    transform, middle, f = _mirrored_transform(signal)
    moved = torch.einsum("fij,...jf->...if", mixing(f), transform)
    moved = torch.fft.irfft(moved, n=2 * signal.shape[-1])[..., : signal.shape[-1]]
    return moved - moved.mean(-1, keepdim=True) + middle


def _mirrored_transform(signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Transform of records with their mirror images behind them, their means, and the frequencies of the bins."""
    n, middle = signal.shape[-1], signal.mean(-1, keepdim=True)
    centred = signal - middle
    transform = torch.fft.rfft(torch.cat([centred, centred.flip(-1)], -1))
    return transform, middle, torch.arange(n + 1, dtype=torch.float64) / (2 * n)


def noise(n_samples: int, density: Callable[[Tensor], Tensor], rows: int, generator: torch.Generator) -> Tensor:
    """Gaussian records `(row, time)` of a density per sample at `f` cycles per sample, rows independent."""
    length = fast_length(2 * n_samples)
    white = torch.randn(rows, length, generator=generator, dtype=torch.float64)
    f = (torch.arange(length // 2 + 1, dtype=torch.float64) / length).clamp(min=1 / length)
    return torch.fft.irfft(torch.fft.rfft(white) * density(f).sqrt(), n=length)[:, :n_samples]


def of_phase(gain: Tensor, source: Tensor) -> Tensor:
    """Records `(sensor, time)` of one source, or of as many as sensors, with the phases of complex gains."""
    return gain.real[:, None] * source + gain.imag[:, None] * quadrature(source)


def quadrature(signal: Tensor) -> Tensor:
    """Records `(..., time)` with every frequency a quarter of a cycle ahead."""
    n = signal.shape[-1]
    transform = torch.fft.rfft(signal) * 1j
    transform[..., 0] = 0
    return torch.fft.irfft(transform, n=n)


def resampled(signal: Tensor, times: Tensor) -> Tensor:
    """Signals `(..., time)` at `times` `(time,)` in samples, by windowed sincs; beyond their ends they are mirrored.

    At whole samples these are the samples themselves.
    """
    n = signal.shape[-1]
    whole = times.floor()
    part = times - whole
    whole = whole.long()
    total = torch.zeros(*signal.shape[:-1], len(times), dtype=torch.float64)
    edge = torch.i0(torch.tensor(_KAISER_BETA, dtype=torch.float64))
    for tap in range(-_SINC_TAPS + 1, _SINC_TAPS + 1):
        apart = part - tap
        window = torch.i0(_KAISER_BETA * (1 - (apart / _SINC_TAPS).square()).clamp(min=0).sqrt()) / edge
        total += signal[..., _mirrored(whole + tap, n)] * (torch.sinc(apart) * window)
    return total


def _mirrored(index: Tensor, n: int) -> Tensor:
    """Indices beyond the ends, as if in a mirror."""
    index = index.remainder(2 * n)
    return torch.where(index < n, index, 2 * n - 1 - index)


def late(row: Tensor, samples: float) -> Tensor:
    """A mean `(time,)` over the past of a row, with weights that fall exponentially within so many samples."""
    if samples <= 0:
        return row
    keeps = math.exp(-1 / samples)
    return torch.from_numpy(lfilter([1 - keeps], [1, -keeps], row.numpy(), zi=(row[:1] * keeps).numpy())[0])
