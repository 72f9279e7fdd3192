"""Held-out score of the ordinates that are too slow for blocks."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gyrofuse._base.transforms import cosine_ordinates
from gyrofuse.mismatch.likelihoods.spectra.data import reference_noise
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED, before_converter
from gyrofuse.mismatch.signals.records import Records

N_SLOW = 3 * N_JUDGED - 1  # cosine ordinates of a record below the third of a block, the first that is judged there


@derived
def slow_ordinates(side: Records) -> Tensor:
    """Cosine ordinates of records, from the first, `(record, sensor, ordinate)`."""
    records = side.steady
    return cosine_ordinates(records.flatten(0, 1))[:, 1 : N_SLOW + 1].clone().unflatten(0, records.shape[:2])


def slow_gains(comparison: Comparison, spectra: Callable[[Tensor, Tensor], Tensor], fold: int) -> Tensor:
    """Gain in log score of the slow ordinates that a fold holds out, dealt to its blocks, `(block,)`, nats.

    Args:
        comparison: Recording and simulation without the mechanism.
        spectra: What the mechanism makes of the simulation's cross-spectra.
        fold: The fold.
    """
    gains = torch.zeros(N_JUDGED // N_FOLDS, dtype=torch.float64)
    if comparison.reference.signal.shape[-1] < comparison.n_samples:
        return gains
    k = torch.arange(1 + fold, N_SLOW + 1, N_FOLDS)
    y = slow_ordinates(comparison.observed)[0, :, k - 1].mT  # (ordinate, sensor)
    f = k.to(y.dtype) / (2 * comparison.n_samples)
    plain = torch.diag_embed(reference_noise(comparison).spectrum(f).mT).to(torch.complex128)
    gain = _log_score(y, before_converter(comparison, spectra, plain, f).real) - _log_score(y, plain.real)
    return gains.index_add(0, torch.arange(len(k)) % len(gains), gain)


def _log_score(y: Tensor, matrices: Tensor) -> Tensor:
    """Log likelihood of ordinates `(ordinate, sensor)` of cross-spectra."""
    root = torch.linalg.cholesky(matrices)
    white = torch.linalg.solve_triangular(root, y[..., None], upper=False)
    return -white.square().sum((-1, -2)) / 2 - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
