"""Interleaved blocks of a recording: the even ones to estimate with, the odd ones held out."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gyrofuse._transforms import cosine_ordinates, fast_length
from gyrofuse.mismatch.case import Case

N_HALVES = 32
_FIRST = 3  # ordinate of a block: below, what is slower than the block leaks in


def estimation_samples(n_samples: int) -> Tensor:
    """Which samples `(time,)` may be used for estimates: those in the even blocks, and none that are left over."""
    block = n_samples // N_HALVES
    place = torch.arange(n_samples) // block
    return (place % 2 == 0) & (place < N_HALVES)


def held_out_blocks(signal: Tensor) -> Tensor:
    """The odd blocks of signals `(..., time)`, as `(..., block, time)`."""
    block = signal.shape[-1] // N_HALVES
    return signal[..., : N_HALVES * block].unflatten(-1, (N_HALVES, block))[..., 1::2, :]


def spectral_gains(case: Case, left: Tensor, spectra: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Gain in log score of each block held out, `(block,)`, nats.

    The likelihood of cosine transforms, whose ordinates are independent for white noise and random walks. They are
    real: noise that sensors share a quarter of a cycle apart does not count.

    Args:
        case: Recording and simulation without the mechanism.
        left: `(sensor, time)`: the recording without what the mechanism takes off.
        spectra: What the mechanism makes of the simulation's cross-spectra.
    """
    block = case.n_samples // N_HALVES
    f = torch.arange(_FIRST, block, dtype=torch.float64) / (2 * block)
    plain = torch.diag_embed(case.base.spectrum(f).mT).to(torch.complex128)
    return _log_scores(left, spectra(plain, f).real) - _log_scores(case.recording, plain.real)


def signal_gains(case: Case, taken: Tensor) -> Tensor:
    """Gain in log score of each block held out, `(block,)`, nats, from a known signal `(sensor, time)` taken off.

    Signal and recording are whitened over the whole record, so that what is slower than a block counts as well: with
    `e` and `s` in units of the noise the gain of a sample is `e s - s^2 / 2`.
    """
    n = case.n_samples
    length = fast_length(n)
    f = torch.arange(length // 2 + 1, dtype=torch.float64) / length
    over = case.base.spectrum(f.clamp(min=1 / length)).rsqrt()
    both = torch.stack([case.recording, taken])
    both = both - both.mean(-1, keepdim=True)
    e, s = torch.fft.irfft(torch.fft.rfft(both, n=length) * over, n=length)[..., :n]
    return held_out_blocks(e * s - s.square() / 2).sum((0, -1))


def _log_scores(signal: Tensor, matrices: Tensor) -> Tensor:
    """Log likelihood of the blocks held out, `(block,)`, for spectra `(ordinate, sensor, sensor)`."""
    blocks = held_out_blocks(signal)  # (sensor, block, time)
    ordinates = cosine_ordinates(blocks.flatten(0, 1)).view_as(blocks)[..., _FIRST:].permute(1, 2, 0)
    power = matrices.diagonal(dim1=-1, dim2=-2)
    if bool((matrices == torch.diag_embed(power)).all()):
        return -(ordinates.square() / power + power.log()).sum((-1, -2)) / 2
    root = torch.linalg.cholesky(matrices)  # (ordinate, sensor, sensor)
    white = torch.linalg.solve_triangular(root, ordinates.permute(1, 2, 0), upper=False)  # (ordinate, sensor, block)
    log_determinant = 2 * root.diagonal(dim1=-1, dim2=-2).log().sum()
    return -(white.square().sum((0, 1)) + log_determinant) / 2
