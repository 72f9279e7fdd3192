"""The recursion of a first-order autoregression, in parallel along time."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

_BLOCK = 64  # samples that one triangular product advances at once


def ar1_recursion(innovations: Tensor, phi: Tensor) -> Tensor:
    """Solve `x_t = phi x_{t-1} + e_t`, `x_0 = 0`, along the last dimension, differentiably.

    Within a block `x` is a triangular Toeplitz product; the ends of the blocks obey the same recursion with
    `phi**block`, which is solved the same way.

    Args:
        innovations: `(..., time)`.
        phi: `(...)`, broadcast against the leading dimensions of `innovations`.
    """
    n_samples = innovations.shape[-1]
    lag = torch.arange(_BLOCK, dtype=phi.dtype, device=phi.device)
    powers = phi[..., None, None] ** (lag[:, None] - lag).clamp(min=0)
    toeplitz = powers.tril()  # (..., block, block): phi**(i - j) for i >= j
    blocks = pad(innovations, (0, -n_samples % _BLOCK)).unflatten(-1, (-1, _BLOCK))  # (..., n_blocks, block)
    x = blocks @ toeplitz.mT
    if n_samples > _BLOCK:
        ends = ar1_recursion(x[..., -1], phi**_BLOCK)  # (..., n_blocks)
        before = pad(ends[..., :-1], (1, 0))
        x = x + before[..., None] * phi[..., None, None] ** (lag + 1)
    return x.flatten(-2)[..., :n_samples]
