"""What chance does to spectra that are compared: the law of F as a likelihood, coherences of independent sensors."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from scipy import special, stats
from torch import Tensor

_ORDINATES = 40  # for each sensor, behind a coherence
_QUANTILES = 200
_NEAR_ONE = 1e-8  # nats an ordinate


def equivalent(ratio: Tensor, d: Tensor, s: Tensor) -> Tensor:
    """Power whose gain under Whittle's likelihood of `w` ordinates is that of an F-distributed ratio.

    Both against one: `w (q - 1 - log q) = (d + s) log((s + d r) / (s + d)) - d log r`.
    """
    d, s = torch.broadcast_tensors(d, s.clamp(min=1e-6))
    gain = (d + s) * torch.log1p(d * (ratio - 1) / (s + d)) - d * ratio.clamp(min=1e-300).log()
    h = (gain * (d + s) / (d * s)).clamp(min=0.0)
    argument = -torch.exp(-1 - h.clamp(max=700.0)).numpy()
    low, high = (torch.from_numpy(-special.lambertw(argument, k).real) for k in (0, -1))
    q = torch.where(ratio < 1, low, high)
    # At its branch point Lambert's function is lost to rounding: there `q - 1 - log q = h` has a series.
    root = torch.where(ratio < 1, -1.0, 1.0) * (2 * h).sqrt()
    q = torch.where(h < _NEAR_ONE, 1 + root + root.square() / 3, q)
    return torch.where(h > 700, 1 + h + (1 + h).log(), q).clamp(min=1e-12)


def equivalent_moments(d: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of the equivalent of F-distributed ratios, and its square over their variance, `(band,)`."""
    middle = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    s = s.clamp(min=1.0)
    ratio = stats.f.ppf(middle, 2 * d.numpy()[:, None], 2 * s.clamp(max=1e7).numpy()[:, None])
    q = equivalent(torch.from_numpy(ratio), d[:, None], s[:, None])
    return q.mean(-1), q.mean(-1).square() / q.var(-1)


def smooth_coherence(coherence: Tensor, dof: Tensor) -> Tensor:
    """Coherence in each band from as many neighbouring ones as an inverse takes, `(band, sensor, sensor)`.

    It is drawn towards none by what chance gives to independent sensors: else whatever makes sensors more independent
    would seem to explain something (Stein).
    """
    p = coherence.shape[-1]
    wanted = min(_ORDINATES * p, float(dof.sum()))
    weighted = torch.cat([torch.zeros_like(coherence[:1]), (coherence * dof[:, None, None]).cumsum(0)])
    worth = torch.cat([torch.zeros_like(dof[:1]), dof.cumsum(0)])
    eye, smooth = torch.eye(p, dtype=coherence.dtype), []
    for b in range(len(dof)):
        low, high = b, b + 1
        while worth[high] - worth[low] < wanted and (low, high) != (0, len(dof)):
            low, high = max(low - 1, 0), min(high + 1, len(dof))
        ordinates = worth[high] - worth[low]
        c = (weighted[high] - weighted[low]) / ordinates.clamp(min=1e-9)
        size = c.diagonal().real.clamp(min=1e-9).rsqrt()
        c = c * size[:, None] * size
        chance = p * (p - 1) / ordinates.clamp(min=1e-9)
        share = (1 - chance / (c - eye).abs().square().sum().clamp(min=1e-12)).clamp(min=0.0)
        smooth.append(eye + share * (c - eye))
    return torch.stack(smooth)


def decorrelated(transform: Tensor, edges: Sequence[int], dof: Tensor) -> Tensor:
    """Fourier transform `(sensor, bin)` without the coherence of bands, which are worth `dof`."""
    parts = [transform[:, a:b] for a, b in itertools.pairwise(edges)]
    matrices = torch.stack([part @ part.mH for part in parts])
    size = matrices.diagonal(dim1=-1, dim2=-2).real.clamp(min=1e-300).rsqrt()
    coherence = smooth_coherence(matrices * (size[:, :, None] * size[:, None, :]), dof)
    roots = torch.linalg.cholesky(coherence)
    solved = [torch.linalg.solve_triangular(r, part, upper=False) for r, part in zip(roots, parts, strict=True)]
    return torch.cat(solved, -1)
