"""What sample paths are made of: a generator of one's own and the AR(1) recursion."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

_BLOCK = 64  # samples that one triangular product advances at once


def own_generator(generator: torch.Generator | None, device: torch.device | str | None) -> torch.Generator:
    """Return `generator`, or a fresh one seeded by the operating system; never the global one.

    Raises:
        ValueError: `generator` lives on another device than `device`.
    """
    if generator is None:
        generator = torch.Generator(device or "cpu")
        generator.seed()
        return generator
    wanted = generator.device if device is None else torch.device(device)
    if wanted.type != generator.device.type or wanted.index not in (None, generator.device.index):
        raise ValueError(
            f"`generator`: expected a generator on device {str(wanted)!r}, got one on "
            f"{str(generator.device)!r}; make it with torch.Generator(device={str(wanted)!r})"
        )
    return generator


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
