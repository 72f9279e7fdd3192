"""Noise near a place and near a path: how far it is from the simulation's there, octave by octave."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.signals.folds import N_JUDGED
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.stats.level_scan import octave_level


def noise_around(recording: Tensor, base: NoiseSpectrum, onset: int, tau: float) -> Tensor:
    """Density before and after what rings, over that of a base, `(sensor, bin)` at bins from 0 to half the rate.

    Args:
        recording: `(sensor, time)`.
        base: Noise of the simulation.
        onset: Sample at which it sets in.
        tau: Its time constant, samples.
    """
    reach, gone, length = 32, 8, 2 * max(round(2 * tau), 32)
    n, stop = recording.shape[-1], onset + math.ceil(gone * tau)
    first, end = max(onset - round(reach * tau) - length, 0), min(stop + round(reach * tau) + length, n)
    white = whitened(recording[:, first:end], base)
    sides = [white[:, : max(onset - first, 0)], white[:, max(stop - first, 0) :]]
    frames = [side.unfold(-1, length, length // 2) for side in sides if side.shape[-1] >= length]
    least = 6  # frames; from fewer, levels are what chance makes of them
    if sum(frame.shape[1] for frame in frames) < least:
        return torch.ones(len(recording), length // 2 + 1, dtype=recording.dtype)
    power = _powers(torch.cat(frames, 1))
    return octave_level(power, 1)[:, 0]


def noise_along(path: Tensor, white: Tensor) -> Tensor:
    """Variance of whitened noise as a path sees it, of each of the blocks of a record `(sensor, block)`.

    The mean of the noise's density, by octaves in a block and those beside it, over the energy of the path there.

    Args:
        path: Whitened, `(sensor, time)`.
        white: Whitened noise, `(sensor, time)`.
    """
    block = white.shape[-1] // N_JUDGED
    own, noise = (values[:, : N_JUDGED * block].unflatten(-1, (N_JUDGED, block)) for values in (path, white))
    energy = squared_modulus(torch.fft.rfft(own))
    near = pad(_powers(noise).mT, (1, 1), "replicate").unfold(-1, 3, 1)  # (sensor, bin, block, which)
    density = octave_level(near.permute(0, 2, 3, 1), 1)[..., 0, :]
    return (energy * density).sum(-1) / energy.sum(-1).clamp(min=1e-300)


def _powers(frames: Tensor) -> Tensor:
    """Of frames `(..., time)`, `(..., bin)`."""
    taper = torch.hann_window(frames.shape[-1], dtype=frames.dtype)
    return squared_modulus(torch.fft.rfft(frames * (taper / taper.norm())))
