"""Delays between sensors: what they share comes later in some of them than the simulation says.

A delay of `tau` samples turns the phase of a cross-spectrum by `-2 pi f tau` at all frequencies where sensors share
anything. With `C` the cross-spectra of the simulation and `D = diag(exp(-2 pi i f tau))` the log likelihood of the
recording's, `S` of `d` ordinates, is `-d tr((D C D*)^-1 S)` beside what no delay changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.data import block_spectra, reference_noise
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.folds import N_FOLDS, N_JUDGED


class Delays(NamedTuple):
    """Delays of the sensors against most of them.

    Attributes:
        delay: Samples, `(sensor,)`; 0 in most.
        sd: Their standard deviations.
        gain: Log likelihood over that of none, nats.
    """

    delay: Tensor
    sd: Tensor
    gain: float


class Phases(NamedTuple):
    """Products of the recording with the inverse of the simulation, by band.

    Attributes:
        frequency: Where the mean power of a band lies, cycles per sample, `(band,)`.
        weights: `-d C^-1 * S^T`, whose sum over pairs turned by delays is a log likelihood, `(band, sensor, sensor)`.
        log_ratio: Logarithms of the recording's powers over the simulation's in all bands, `(any band, sensor)`.
        variance: Of their differences between sensors by chance, `(any band,)`.
    """

    frequency: Tensor
    weights: Tensor
    log_ratio: Tensor
    variance: Tensor

    def likelihood(self, delay: Tensor) -> Tensor:
        """Log likelihoods `(...)` of delays `(..., sensor)`, samples."""
        turn = torch.polar(torch.ones(()).to(delay), 2 * math.pi * delay[..., None, :] * self.frequency[:, None])
        return torch.einsum("...bi,bij,...bj->...", turn.conj(), self.weights, turn).real


@derived
def sensor_delays(comparison: Comparison) -> Delays | None:
    """Delays that the whole recording shows; None of one sensor, where nothing is shared, or of what is no delay."""
    if comparison.n_sensors < 2:
        return None
    phases = phases_of(comparison, torch.ones(N_JUDGED, dtype=torch.bool))
    if phases is None:
        return None
    found = fitted_delays(phases)
    return found if are_delays(phases, found) and not changes_power(phases, found.delay) else None


def phases_of(comparison: Comparison, blocks: Tensor, shared: float = 0.5) -> Phases | None:
    """Those of some of the recording's blocks `(block,)`; None where the simulation's sensors share nothing.

    Args:
        comparison: Recording and simulation.
        blocks: Which blocks.
        shared: Coherence of bands that show a delay.
    """
    floor = 1e-3  # share of its own that a sensor has at least
    both, p = block_spectra(comparison), comparison.n_sensors
    first = len(both.bands.below)
    inner = slice(first, len(both.bands.dof) - len(both.bands.beyond))
    simulated, ordinates = (x[inner] for x in both.reference.mean(torch.ones(N_FOLDS, dtype=torch.bool)))
    seen, d = (x[inner] for x in both.observed.mean(blocks))
    size = simulated.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).rsqrt()
    scale = size[:, :, None] * size[:, None, :]
    c, s = simulated * scale, seen * scale
    off = c - torch.eye(p, dtype=c.dtype)
    plain = (ordinates > 4 * p) & (d > 0)
    by_chance = ((2 * math.log(p) + 7) / ordinates.clamp(min=1.0)).sqrt()  # of any pair, in a band of a thousand
    known = plain & (off.abs().amax((-1, -2)) > by_chance.clamp(min=shared))
    if not bool(known.any()):
        return None
    linked = _linked(off[known], ordinates[known])
    inverse = torch.linalg.inv(torch.where(linked, c[known], 0.0) + floor * torch.eye(p, dtype=c.dtype))
    # The simulation's matrices scatter as well.
    count = d * ordinates / (d + ordinates).clamp(min=1e-300)
    density = reference_noise(comparison).spectrum(both.bands.nodes).mean(0)
    frequency = both.bands.mean_of(density * both.bands.nodes) / both.bands.mean_of(density)
    ratio = (s.diagonal(dim1=-2, dim2=-1).real / c.diagonal(dim1=-2, dim2=-1).real).clamp(min=1e-300).log()
    apart = 1 - (off.abs().square().sum((-1, -2)) / (p * (p - 1))).clamp(max=1)  # squares of coherences are shared
    return Phases(
        frequency[inner][known],
        -count[known, None, None] * inverse * s[known].mT,
        ratio[plain],
        (2 * apart[plain] + floor) / count[plain],
    )


def _linked(coherence: Tensor, ordinates: Tensor) -> Tensor:
    """Which sensors share anything with each other, or with one that does, `(sensor, sensor)`, in some bands together.

    Small coherences of the others are chance, and so would be the phases that these are weighed with.
    """
    sure = 5.0  # standard deviations
    count, p = len(coherence), coherence.shape[-1]
    power = (ordinates[:, None, None] * coherence.abs().square()).sum(0)  # each exponential by chance
    linked = (power > count + sure * (1 + math.sqrt(count))).to(torch.float64) + torch.eye(p, dtype=torch.float64)
    return torch.linalg.matrix_power(linked, p) > 0


def fitted_delays(phases: Phases) -> Delays:
    """One sensor after the other over a grid, then all by Newton's steps; most of them are taken for right."""
    p, farthest, rounds = phases.weights.shape[-1], 16.0, 6
    delay = torch.zeros(p, dtype=torch.float64)
    linked = _groups(phases)
    others = (linked.sum(-1) > 1).nonzero()[:, 0].tolist()  # of a sensor that shares nothing no delay is known
    for _ in range(2):
        delay = delays_on_grid(phases, delay, others, farthest)
    for _ in range(rounds):
        slope, information = _derivatives(phases, delay)
        step = torch.linalg.solve(information, slope)
        moved = delay + step.clamp(-0.5, 0.5)
        if float(phases.likelihood(moved)) < float(phases.likelihood(delay)):
            break
        delay = moved
    delay = delay - torch.stack([_usual(delay[group]) for group in linked])
    sd = torch.linalg.inv(_derivatives(phases, delay)[1]).diagonal().sqrt()
    none, best = float(phases.likelihood(torch.zeros_like(delay))), float(phases.likelihood(delay))
    return Delays(delay, sd, best - none)


def delays_on_grid(phases: Phases, start: Tensor, sensors: Sequence[int], farthest: float) -> Tensor:
    """The likeliest delays `(sensor,)` of some sensors, one after the other, up to so many samples either way."""
    grid, delay = torch.arange(-farthest, farthest + 0.125, 0.25, dtype=torch.float64), start.clone()
    for i in sensors:
        tried = delay.repeat(len(grid), 1)
        tried[:, i] = grid
        delay[i] = grid[int(phases.likelihood(tried).argmax())]
    return delay


def are_delays(phases: Phases, found: Delays) -> bool:
    """Whether phases turn alike in the lower and the upper half of the evidence: those of a resonance do not."""
    sure, share = 5.0, 0.1  # standard deviations, and of the delay, by which halves may differ
    evidence = (phases.frequency.square() * _off(phases).abs().sum((-1, -2))).cumsum(0)
    low = evidence <= evidence[-1] / 2
    if bool(low.all()) or not bool(low.any()):
        return False
    below, above = (
        fitted_delays(phases._replace(frequency=phases.frequency[part], weights=phases.weights[part]))
        for part in (low, ~low)
    )
    most = (sure * torch.hypot(below.sd, above.sd)).maximum(share * found.delay.abs())
    return bool(((below.delay - above.delay).abs() < most).all())


def changes_power(phases: Phases, delay: Tensor) -> bool:
    """Whether a sensor with a delay has a spectrum of another shape, beside the others, as behind a filter."""
    least, sure = 0.05, 5.0  # rms of the change of log power; standard deviations
    late = delay.abs() > 0.1
    if not bool(late.any()) or bool(late.all()):
        return False
    weight = 1 / phases.variance[:, None]
    change = phases.log_ratio[:, late] - phases.log_ratio[:, ~late].mean(-1, keepdim=True)
    change = change - (weight * change).sum(0) / weight.sum(0)  # a level of its own is no filter
    squares, n = (weight * change.square()).sum(0), len(change)
    return bool(((squares / weight.sum(0) > least**2) & (squares > n + sure * math.sqrt(2 * n))).any())


def _off(phases: Phases) -> Tensor:
    """Weights of pairs of different sensors."""
    return phases.weights * (1 - torch.eye(phases.weights.shape[-1], dtype=phases.weights.dtype))


def _groups(phases: Phases) -> Tensor:
    """Which sensors share what shows their delays, `(sensor, sensor)`."""
    return phases.weights.abs().sum(0) > 0


def _usual(delay: Tensor) -> Tensor:
    """The delay from which most sensors are least far: of two the first one's."""
    apart = (delay[:, None] - delay).abs().clamp(max=0.25).sum(-1)
    return delay[int(apart.argmin())]


def _derivatives(phases: Phases, delay: Tensor) -> tuple[Tensor, Tensor]:
    """Slope `(sensor,)` of the log likelihood, and the information `(sensor, sensor)`."""
    turn = torch.polar(torch.ones(()).to(delay), 2 * math.pi * delay * phases.frequency[:, None])
    turned = turn.conj()[:, :, None] * _off(phases) * turn[:, None, :]
    omega = 2 * math.pi * phases.frequency[:, None, None]
    slope = 2 * (omega * turned.imag).sum(0).sum(-1)
    bend = 2 * (omega.square() * turned.abs()).sum(0)  # as where all is in phase
    information = torch.diag(bend.sum(-1)) - bend
    # What all of a group have in common shows nowhere.
    return slope, information + information.diagonal().mean() / len(delay) * _groups(phases)
