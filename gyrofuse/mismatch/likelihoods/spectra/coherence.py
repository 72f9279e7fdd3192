"""What chance does to coherences of independent sensors."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

_ORDINATES = 40  # for each sensor, behind a coherence


def coherence_of(matrices: Tensor) -> Tensor:
    """Coherences of cross-spectra, `(band, sensor, sensor)`."""
    size = matrices.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).rsqrt()
    return matrices * (size[:, :, None] * size[:, None, :])


def connected(linked: Tensor) -> Tensor:
    """Which sensors hang together, directly or by others, of those that are linked `(sensor, sensor)`, likewise."""
    p = len(linked)
    reached = linked | linked.mT | torch.eye(p, dtype=torch.bool)
    for _ in range(p.bit_length()):  # twice as far each time
        reached = reached.to(torch.float64) @ reached.to(torch.float64) > 0
    return reached


def smooth_coherence(coherence: Tensor, dof: Tensor) -> Tensor:
    """Coherence in each band from as many neighbouring ones as an inverse takes, `(band, sensor, sensor)`.

    It is drawn towards none by what chance gives to independent sensors: else whatever makes sensors more independent
    would seem to explain something (Stein).
    """
    p = coherence.shape[-1]
    wanted = min(_ORDINATES * p, float(dof.sum()))
    weighted = torch.cat([torch.zeros_like(coherence[:1]), (coherence * dof[:, None, None]).cumsum(0)])
    ordinates_to = torch.cat([torch.zeros_like(dof[:1]), dof.cumsum(0)])
    eye, smooth = torch.eye(p, dtype=coherence.dtype), []
    for b in range(len(dof)):
        low, high = b, b + 1
        while ordinates_to[high] - ordinates_to[low] < wanted and (low, high) != (0, len(dof)):
            low, high = max(low - 1, 0), min(high + 1, len(dof))
        ordinates = ordinates_to[high] - ordinates_to[low]
        c = (weighted[high] - weighted[low]) / ordinates.clamp(min=1e-9)
        size = c.diagonal().real.clamp(min=1e-9).rsqrt()
        c = c * size[:, None] * size
        chance = p * (p - 1) / ordinates.clamp(min=1e-9)
        share = (1 - chance / (c - eye).abs().square().sum().clamp(min=1e-12)).clamp(min=0.0)
        smooth.append(eye + share * (c - eye))
    return torch.stack(smooth)


def decorrelated(transform: Tensor, edges: Sequence[int], dof: Tensor) -> Tensor:
    """Fourier transform `(sensor, bin)` without the coherence of bands, which are ordinates_to `dof`."""
    parts = [transform[:, a:b] for a, b in itertools.pairwise(edges)]
    matrices = torch.stack([part @ part.mH for part in parts])
    coherence = smooth_coherence(coherence_of(matrices), dof)
    roots = torch.linalg.cholesky(coherence)
    solved = [torch.linalg.solve_triangular(r, part, upper=False) for r, part in zip(roots, parts, strict=True)]
    return torch.cat(solved, -1)
