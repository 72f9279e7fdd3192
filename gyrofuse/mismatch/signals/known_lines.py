"""Lines at frequencies that are known: measured, made precise, and taken off."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from scipy import stats
from torch import Tensor

_STRETCH = 2**18  # samples at a time


def without_lines(signal: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Signals `(..., time)` less least-squares lines at known frequencies, cycles per sample.

    Their amplitudes and phases may change linearly, so that a frequency need only be known to a bin. Means stay.
    """
    if not frequencies:
        return signal
    own, n = _coefficients(signal, frequencies)[..., :-1], signal.shape[-1]
    parts = [part - own @ _basis(n, t, frequencies)[:-1] for part, t in _stretches(signal)]
    return torch.cat(parts, -1)


def line_parts(signal: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Amplitudes and phases of lines in the middle of signals `(..., time)`, complex, `(..., line)`."""
    cosine, sine, *_ = _coefficients(signal, frequencies).split(len(frequencies), -1)
    return torch.complex(cosine, -sine)


def amplitudes(signal: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Of lines in the middle of signals `(..., time)`, `(..., line)`; of variance `2 S / n` in noise of density `S`."""
    return line_parts(signal, frequencies).abs()


def line_wander(records: Tensor, frequencies: tuple[float, ...], density: Tensor) -> Tensor:
    """Variance of the amplitudes of lines that have another phase at other times, by that, `(sensor, line)`.

    What their scatter over parts of a record is beyond that of noise, over the number of parts; 0 where it is not.

    Args:
        records: `(record, sensor, time)`.
        frequencies: Cycles per sample.
        density: Of the noise at each, per sample, `(sensor, line)`.
    """
    parts, rare, longer = 16, 1e-3, 3  # of a record; by chance; parts over which a phase goes on
    f, length = torch.tensor(frequencies, dtype=torch.float64), records.shape[-1] // parts
    taper = torch.hann_window(length, periodic=False, dtype=torch.float64)
    angle = -2 * math.pi * f[:, None] * torch.arange(parts * length, dtype=torch.float64)
    turn = torch.polar(torch.ones_like(angle), angle).unflatten(-1, (parts, length))
    segments = records[..., : parts * length].unflatten(-1, (parts, length))
    segments = (segments - segments.mean(-1, keepdim=True)) * taper
    z = torch.einsum("rskt,lkt->rslk", segments.to(turn.dtype), turn) * (2 / taper.sum())
    apart = z - z.mean(-1, keepdim=True)
    scatter = apart.abs().square().mean((0, -1)) * (parts / (parts - 1))
    noise = 4 * taper.square().sum() / taper.sum().square() * density
    dof = 2 * len(records) * (parts - 1)
    follows = [(apart[..., k:] * apart[..., :-k].conj()).real.mean(0).sum(-1) for k in range(1, longer + 1)]
    wander = (scatter - noise + 2 / parts * torch.stack(follows).sum(0).clamp(min=0)) / parts
    return torch.where(scatter > noise * float(stats.chi2.isf(rare, dof)) / dof, wander, 0.0)


def wandering(records: Tensor, frequencies: tuple[float, ...], density: Tensor) -> tuple[float, ...]:
    """Those of lines that have another phase at other times, in the sensor where they are largest; as `line_wander`."""
    most = 0.1  # standard deviations of an amplitude by that, over it
    if not frequencies:
        return ()
    size, at = amplitudes(records, frequencies).mean(0).max(0)
    far = line_wander(records, frequencies, density).gather(0, at[None])[0] > (most * size).square()
    return tuple(f for f, wanders in zip(frequencies, far.tolist(), strict=True) if wanders)


def resized(signal: Tensor, frequency: float, amplitude: Tensor) -> Tensor:
    """Signals `(..., sensor, time)` whose line at a frequency has another amplitude `(sensor,)`, in its own phase."""
    n, own = signal.shape[-1], _coefficients(signal, (frequency,))[..., :2]
    more = own * (amplitude / torch.hypot(own[..., 0], own[..., 1]).clamp(min=1e-300) - 1)[..., None]
    return torch.cat([part + more @ _basis(n, t, (frequency,))[:2] for part, t in _stretches(signal)], -1)


def precise(signal: Tensor, frequencies: tuple[float, ...]) -> tuple[float, ...]:
    """Frequencies known to a fraction of a bin, made precise by how their phases advance in signals `(..., time)`.

    A line that goes on at another frequency than assumed turns its phase, which to first order is a change of
    amplitude at a right angle to it.
    """
    n, found = signal.shape[-1], frequencies
    for _ in range(3 if frequencies else 0):  # Gauss and Newton: from a quarter of a bin to rounding
        parts = _coefficients(signal, found).flatten(0, -2).split(len(found), -1)
        cosine, sine, cosine_change, sine_change, _mean = parts
        turn = (cosine_change * sine - sine_change * cosine).sum(0) / (cosine.square() + sine.square()).sum(0)
        steps = (turn / (math.pi * n)).clamp(-0.5 / n, 0.5 / n)
        found = tuple(f + float(step) for f, step in zip(found, steps, strict=True))
    return found


def _stretches(signal: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Parts of signals and the numbers of their samples: the basis is as large as many sensors."""
    t = torch.arange(signal.shape[-1], dtype=torch.float64)
    return zip(signal.split(_STRETCH, -1), t.split(_STRETCH), strict=True)


def _basis(n: int, t: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Cosines, sines, both times time from -1 to 1, and a constant at `t` of `n` samples, `(4 * line + 1, time)`."""
    angle = 2 * math.pi * torch.tensor(frequencies, dtype=torch.float64)[:, None] * t
    steady = torch.cat([angle.cos(), angle.sin()])
    return torch.cat([steady, steady * (2 * t / n - 1), torch.ones(1, len(t), dtype=torch.float64)])


def _coefficients(signal: Tensor, frequencies: tuple[float, ...]) -> Tensor:
    """Least squares, `(..., row of the basis)`."""
    rows, n = 4 * len(frequencies) + 1, signal.shape[-1]
    gram = torch.zeros(rows, rows, dtype=torch.float64)
    products = torch.zeros(rows, signal[..., 0].numel(), dtype=torch.float64)
    for part, t in _stretches(signal):
        basis = _basis(n, t, frequencies)
        gram += basis @ basis.mT
        products += basis @ part.flatten(0, -2).mT
    return torch.linalg.solve(gram, products).mT.unflatten(0, signal.shape[:-1])
