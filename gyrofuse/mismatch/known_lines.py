"""Lines at frequencies that are known: measured, made precise, and taken off."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_STEPS = 3  # of Gauss and Newton: from a quarter of a bin to nothing


def without_lines(signal: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Signals `(..., time)` less least-squares lines at known frequencies, cycles per sample.

    Their amplitudes and phases may change linearly, so that a frequency need only be known to a bin. Means stay.
    """
    if not frequencies:
        return signal
    basis = _basis(signal.shape[-1], frequencies)
    return signal - _coefficients(signal, basis)[..., :-1] @ basis[:-1]


def amplitudes(signal: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Of lines in the middle of signals `(..., time)`, `(..., line)`; of variance `2 S / n` in noise of density `S`."""
    cosine, sine, *_ = _coefficients(signal, _basis(signal.shape[-1], frequencies)).split(len(frequencies), -1)
    return torch.hypot(cosine, sine)


def precise(signal: Tensor, frequencies: tuple[float, ...]) -> tuple[float, ...]:
    """Frequencies known to a fraction of a bin, made precise by how their phases advance in signals `(..., time)`.

    A line that goes on at another frequency than assumed turns its phase, which to first order is a change of
    amplitude at a right angle to it.
    """
    n, found = signal.shape[-1], frequencies
    for _ in range(_STEPS if frequencies else 0):
        parts = _coefficients(signal, _basis(n, found)).flatten(0, -2).split(len(found), -1)
        cosine, sine, cosine_change, sine_change, _mean = parts
        turn = (cosine_change * sine - sine_change * cosine).sum(0) / (cosine.square() + sine.square()).sum(0)
        steps = (turn / (math.pi * n)).clamp(-0.5 / n, 0.5 / n)
        found = tuple(f + float(step) for f, step in zip(found, steps, strict=True))
    return found


def _basis(n: int, frequencies: tuple[float, ...]) -> Tensor:
    """Cosines, sines, both times time from -1 to 1, and a constant, `(4 * line + 1, time)`."""
    t = torch.arange(n, dtype=torch.float64)
    angle = 2 * math.pi * torch.tensor(frequencies, dtype=torch.float64)[:, None] * t
    steady = torch.cat([angle.cos(), angle.sin()])
    return torch.cat([steady, steady * (2 * t / n - 1), torch.ones(1, n, dtype=torch.float64)])


def _coefficients(signal: Tensor, basis: Tensor) -> Tensor:
    """Least squares, `(..., row of the basis)`."""
    return torch.linalg.solve(basis @ basis.mT, basis @ signal.flatten(0, -2).mT).mT.unflatten(0, signal.shape[:-1])
