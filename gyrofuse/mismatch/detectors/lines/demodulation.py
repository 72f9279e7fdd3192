"""A tone demodulated in blocks, and the slope of its phase."""

from __future__ import annotations

import math

import torch
from torch import Tensor

BLOCKS = 512  # in which a tone is demodulated: a loss is placed to one, then to the sample
_CYCLES, _FINER = 4, 32  # slopes of the phase that are searched, cycles over the record, and steps of one cycle


def demodulated(signal: Tensor, f: float) -> Tensor:
    """Complex amplitudes of a tone in blocks of signals, in units of their noise, `(row, block)`.

    Args:
        signal: Whitened signals, `(row, time)`.
        f: Frequency of the tone, cycles per sample.
    """
    block = signal.shape[-1] // BLOCKS
    t = torch.arange(block * BLOCKS, dtype=torch.float64)
    angle = 2 * math.pi * f * t
    z = torch.complex(signal[:, : len(t)] * angle.cos(), -signal[:, : len(t)] * angle.sin())
    z = z.unflatten(-1, (BLOCKS, block)).mean(-1)
    # Least squares of both quadratures: in a block they are not orthogonal.
    image = torch.polar(torch.ones_like(t), -2 * angle).unflatten(-1, (BLOCKS, block)).mean(-1)
    z = (z - z.conj() * image) / (1 - image.abs().square())
    # Squares of differences of complex normal noise are exponential; steps of a loud tone hardly move their median.
    noise = z.diff().abs().square().median(-1, keepdim=True).values / (2 * math.log(2))
    return z / noise.sqrt().clamp(min=1e-300)


def best_slope(z: Tensor) -> tuple[float, float]:
    """Slope of the phase of demodulated rows `(row, block)`, cycles over the record, and the tone's energy, nats."""
    energy = energy_by_slope(z).sum(0)
    at = int(energy[1:-1].argmax()) + 1
    left, here, right = energy[at - 1 : at + 2].tolist()
    bend = left - 2 * here + right
    offset = (left - right) / (2 * bend) if bend < 0 else 0.0
    return float(_slopes()[at]) + max(min(offset, 1.0), -1.0) / _FINER, here


def _slopes() -> Tensor:
    """Slopes of the phase that are searched, cycles over the record, `(slope,)`, 0 in the middle."""
    return torch.arange(-_CYCLES * _FINER, _CYCLES * _FINER + 1, dtype=torch.float64) / _FINER


def turn_by(cycles: float | Tensor) -> Tensor:
    """`exp(2 pi i cycles s)` at the middles `s` of the blocks, from 0 to 1."""
    s = (torch.arange(BLOCKS, dtype=torch.float64) + 0.5) / BLOCKS
    phase = 2 * math.pi * torch.as_tensor(cycles, dtype=torch.float64)[..., None] * s
    return torch.polar(torch.ones_like(phase), phase)


def energy_by_slope(z: Tensor) -> Tensor:
    """Energy of a tone with each slope of the phase, nats, `(row, slope)`."""
    return (z @ turn_by(-_slopes()).mT).abs().square() / BLOCKS


def slope_variance(energy: float) -> float:
    """Variance of the slope of a phase, cycles over the record, for a tone of so many nats (Cramer-Rao bound)."""
    return 6 / (4 * math.pi**2 * max(energy, 1.0))
