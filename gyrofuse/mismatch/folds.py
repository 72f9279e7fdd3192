"""Interleaved blocks of a recording in four folds: each is judged with numbers estimated from the other three.

Cross-validation uses every block to judge and most of them to estimate: with one half for either, the numbers of a
weak effect cost as much as the other half can gain.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gyrofuse._transforms import cosine_ordinates
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.lines import whitened

N_JUDGED = 32  # blocks
N_FOLDS = 4
_FIRST = 3  # ordinate of a block: below, what is slower than the block leaks in


def in_fold(n_blocks: int, fold: int) -> Tensor:
    """Which of so many blocks, taken in turns, a fold holds out, `(block,)`."""
    return torch.arange(n_blocks) % N_FOLDS == fold


def estimation_samples(n_samples: int, fold: int) -> Tensor:
    """Which samples `(time,)` may be used for estimates: those in the blocks of other folds, and none left over."""
    block = n_samples // N_JUDGED
    place = torch.arange(n_samples) // block
    return (place % N_FOLDS != fold) & (place < N_JUDGED)


def held_out_blocks(signal: Tensor, fold: int) -> Tensor:
    """The blocks of signals `(..., time)` that a fold holds out, as `(..., block, time)`."""
    block = signal.shape[-1] // N_JUDGED
    return signal[..., : N_JUDGED * block].unflatten(-1, (N_JUDGED, block))[..., fold::N_FOLDS, :]


def spectral_gains(case: Case, left: Tensor, spectra: Callable[[Tensor, Tensor], Tensor], fold: int) -> Tensor:
    """Gain in log score of each block held out, `(block,)`, nats.

    The likelihood of cosine transforms, whose ordinates are independent for white noise and random walks. They are
    real: noise that sensors share a quarter of a cycle apart does not count.

    Args:
        case: Recording and simulation without the mechanism.
        left: `(sensor, time)`: the recording without what the mechanism takes off.
        spectra: What the mechanism makes of the simulation's cross-spectra.
        fold: Which one.
    """
    block = case.n_samples // N_JUDGED
    f = torch.arange(_FIRST, block, dtype=torch.float64) / (2 * block)
    plain = torch.diag_embed(case.base.spectrum(f).mT).to(torch.complex128)
    return _log_scores(left, spectra(plain, f).real, fold) - _log_scores(case.recording, plain.real, fold)


def signal_gains(case: Case, taken: Tensor, fold: int) -> Tensor:
    """Gain in log score of each block held out, `(block,)`, nats, from a known signal `(sensor, time)` taken off.

    Signal and recording are whitened over the whole record, so that what is slower than a block counts as well: with
    `e` and `s` in units of the noise the gain of a sample is `e s - s^2 / 2`.
    """
    s = whitened(taken, case.base)
    return held_out_blocks(case.white * s - s.square() / 2, fold).sum((0, -1))


def _log_scores(signal: Tensor, matrices: Tensor, fold: int) -> Tensor:
    """Log likelihood of the blocks held out, `(block,)`, for spectra `(ordinate, sensor, sensor)`."""
    blocks = held_out_blocks(signal, fold)  # (sensor, block, time)
    ordinates = cosine_ordinates(blocks.flatten(0, 1)).view_as(blocks)[..., _FIRST:].permute(1, 2, 0)
    power = matrices.diagonal(dim1=-1, dim2=-2)
    if bool((matrices == torch.diag_embed(power)).all()):
        return -(ordinates.square() / power + power.log()).sum((-1, -2)) / 2
    root = torch.linalg.cholesky(matrices)  # (ordinate, sensor, sensor)
    white = torch.linalg.solve_triangular(root, ordinates.permute(1, 2, 0), upper=False)  # (ordinate, sensor, block)
    log_determinant = 2 * root.diagonal(dim1=-1, dim2=-2).log().sum()
    return -(white.square().sum((0, 1)) + log_determinant) / 2
