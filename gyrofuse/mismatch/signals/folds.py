"""Interleaved blocks of a recording in four folds: each is judged with numbers estimated from the other three.

Cross-validation uses every block to judge and most of them to estimate: with one half for either, the numbers of a
weak effect cost as much as the other half can gain.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.known_lines import without_lines
from gyrofuse.mismatch.signals.lines import whitened

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


def spectral_gains(
    comparison: Comparison,
    left: Tensor,
    spectra: Callable[[Tensor, Tensor], Tensor],
    fold: int,
    before: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> Tensor:
    """Gain in log score of each block held out, `(block,)`, nats.

    The likelihood of cosine transforms, whose ordinates are independent for white noise and random walks. They are
    real: noise that sensors share a quarter of a cycle apart does not count. What rounds the values of both sides comes
    last and stays as it is. Blocks are short: next to a filter's edge, in its stop band and at its zeros most of an
    ordinate's power is what leaks in from elsewhere, so that spectra are seen as a block shows them. Lines that the
    simulation has as well are no noise.

    Args:
        comparison: Recording and simulation without the mechanism.
        left: `(sensor, time)`: the recording without what the mechanism takes off.
        spectra: What the mechanism makes of the simulation's cross-spectra.
        fold: Number of the fold.
        before: What makes the simulation's cross-spectra of its powers; by default its sensors share nothing.
    """
    block = comparison.n_samples // N_JUDGED
    f = torch.arange(block + 1, dtype=torch.float64) / (2 * block)
    f[0] = f[1] / 2  # nothing of a block's mean is in its other ordinates
    noise = comparison.reference.density(f)  # simple spectra have no stop bands, no zeros and no humps
    plain = torch.diag_embed(noise.mT).to(torch.complex128)
    simulated = plain if before is None else before(plain, f)
    made = before_converter(comparison, spectra, plain, f)
    after, without = (seen_in_block(matrices.real)[_FIRST:] for matrices in (made, simulated))
    came = comparison.observed.noise[0]
    own = came if left is comparison.recording else without_lines(left, comparison.observed.lines)
    return _log_scores(own, after, fold) - _log_scores(came, without, fold)


def before_converter(
    comparison: Comparison, spectra: Callable[[Tensor, Tensor], Tensor], matrices: Tensor, f: Tensor
) -> Tensor:
    """What a mechanism makes of the simulation's cross-spectra `(frequency, sensor, sensor)`, rounding as it is."""
    if comparison.rounding is None:
        return spectra(matrices, f)
    most = 0.99  # of a power
    power = matrices.diagonal(dim1=-2, dim2=-1).real
    last = torch.diag_embed(comparison.rounding.minimum(most * power)).to(matrices.dtype)
    return spectra(matrices - last, f) + last


def seen_in_block(spectra: Tensor) -> Tensor:
    """Expected products of a block's cosine ordinates, `(block, ...)`, the first of which is no use.

    With the autocovariance `g` and `a = pi k / n` that of ordinate `k` in a block of `n` samples is

        g_0 + 2 sum_t g_t [(1 - t / n) cos(a t) - sin(a t) / (n sin a)],

    as in the debiased Whittle likelihood (Sykulski et al., Biometrika 106, 2019).

    Args:
        spectra: Densities at `0, 1, .., n` half cycles per block, `(ordinate, ...)`, real.
    """
    n = len(spectra) - 1
    shape = (-1,) + (1,) * (spectra.ndim - 1)
    lags = torch.fft.irfft(spectra, n=2 * n, dim=0)[:n]
    part = torch.arange(n, dtype=spectra.dtype).view(shape) / n
    even = torch.fft.rfft(lags * (1 - part), n=2 * n, dim=0)[:n].real
    odd = torch.fft.rfft(lags, n=2 * n, dim=0)[:n].imag
    return 2 * even - lags[:1] + 2 * odd / (n * torch.sin(math.pi * part).clamp(min=1 / n))


def signal_gains(comparison: Comparison, taken: Tensor, fold: int) -> Tensor:
    """Gain in log score of each block held out, `(block,)`, nats, from a known signal `(sensor, time)` taken off.

    Signal and recording are whitened over the whole record, so that what is slower than a block counts as well: with
    `e` and `s` in units of the noise the gain of a sample is `e s - s^2 / 2`.
    """
    s = whitened(taken, comparison.base)
    return held_out_blocks(comparison.white * s - s.square() / 2, fold).sum((0, -1))


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


def sd_of_sum(blocks: Tensor) -> float:
    """Standard deviation of a sum over blocks `(block,)`, from their scatter."""
    return float(blocks.std()) * math.sqrt(len(blocks))
